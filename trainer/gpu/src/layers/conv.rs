//! Convolutions of kernel 4, stride 2, padding 1 as products with windows.

use super::{Norm, Weight};
use crate::machine::Kernel;
use crate::program::{Grid, Matrix};
use crate::tape::Tape;

/// Images whose windows are made at a time: their number must stay below 2^32, and they take 0.5 MB an image.
const IMAGES_AT_A_TIME: usize = 1024;

impl Tape {
    /// A convolution that halves the sides of x [images side side, channels], with norm and `SiLU`; `reaches` as in [`Tape::layer`].
    pub fn conv_down(&mut self, x: Matrix, side: usize, weight: Weight, norm: Norm, reaches: bool) -> Matrix {
        let (channels, out, half) = (x.cols, weight.value.rows, side / 2);
        let images = x.rows / (side * side);
        let pre = self.matrix(images * half * half, out);
        for chunk in chunks(images) {
            let windows = self.windows_of(x, side, &chunk);
            let y = pre.rows(chunk.start * half * half..chunk.end * half * half);
            self.product((windows, false), (weight.value, true), y, false);
        }
        self.on_backward(move |tape| {
            let d_pre = tape.gradient_of(pre);
            let dx = reaches.then(|| tape.gradient_term(x));
            for chunk in chunks(images) {
                let dy = d_pre.rows(chunk.start * half * half..chunk.end * half * half);
                if let Some(gradient) = weight.gradient {
                    let windows = tape.windows_of(x, side, &chunk);
                    tape.product((dy, true), (windows, false), gradient, true);
                }
                if let Some((dx, add)) = dx {
                    let d_windows = tape.matrix(dy.rows, 16 * channels);
                    tape.product((dy, false), (weight.value, false), d_windows, false);
                    let rows = chunk.start * side * side..chunk.end * side * side;
                    tape.add_up_windows(d_windows, dx.rows(rows), side, None, add);
                }
            }
        });
        let y = self.matrix(pre.rows, out);
        self.norm(pre, norm, y, true);
        y
    }

    /// A transposed convolution that doubles the sides of x [images side side, channels]: its sums, before norm and activation.
    pub fn conv_up(&mut self, x: Matrix, side: usize, weight: Weight, bias: Option<Weight>) -> Matrix {
        let (out, twice) = (weight.value.cols / 16, 2 * side);
        let images = x.rows / (side * side);
        let y = self.matrix(images * twice * twice, out);
        let parts = move |chunk: &std::ops::Range<usize>| {
            (
                chunk.start * side * side..chunk.end * side * side,
                chunk.start * twice * twice..chunk.end * twice * twice,
            )
        };
        for chunk in chunks(images) {
            let (small, large) = parts(&chunk);
            let windows = self.matrix(small.len(), 16 * out);
            self.product((x.rows(small), false), (weight.value, false), windows, false);
            self.add_up_windows(windows, y.rows(large), twice, bias, false);
        }
        self.on_backward(move |tape| {
            let dy = tape.gradient_of(y);
            let (dx, add) = tape.gradient_term(x);
            for chunk in chunks(images) {
                let (small, _) = parts(&chunk);
                let windows = tape.windows_of(dy, twice, &chunk);
                if let Some(gradient) = weight.gradient {
                    tape.product((x.rows(small.clone()), true), (windows, false), gradient, true);
                }
                tape.product((windows, false), (weight.value, true), dx.rows(small), add);
            }
            if let Some(gradient) = bias.and_then(|bias| bias.gradient) {
                tape.add_column_sums(dy, gradient);
            }
        });
        y
    }

    fn windows_of(&mut self, x: Matrix, side: usize, images: &std::ops::Range<usize>) -> Matrix {
        let (channels, half) = (x.cols, side / 2);
        let windows = self.matrix(images.len() * half * half, 16 * channels);
        let x = x.rows(images.start * side * side..images.end * side * side);
        let n = [images.len(), side, channels];
        self.program.kernel(
            Kernel::Windows,
            Grid::elements(windows.len()),
            &[x.into(), windows.into()],
            &n,
            &[],
        );
        windows
    }

    fn add_up_windows(&mut self, windows: Matrix, x: Matrix, side: usize, bias: Option<Weight>, add: bool) {
        let p = [windows.into(), x.into(), bias.map(|bias| bias.value).into()];
        let n = [x.rows / (side * side), side, x.cols, usize::from(add)];
        self.program.kernel(Kernel::FromWindows, Grid::elements(x.len() / 4), &p, &n, &[]);
    }
}

fn chunks(images: usize) -> impl Iterator<Item = std::ops::Range<usize>> {
    (0..images).step_by(IMAGES_AT_A_TIME).map(move |from| from..(from + IMAGES_AT_A_TIME).min(images))
}
