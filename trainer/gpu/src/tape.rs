//! Gradients on programs: an op adds its commands and says what to add when gradients come back.

use std::collections::HashMap;
use std::ops::Range;

use crate::machine::Kernel;
use crate::program::{Buffer, Grid, Lane, Matrix, Pointer, Product, Program};

type Backward = Box<dyn FnOnce(&mut Tape)>;

/// A program with the way back.
#[derive(Default)]
pub struct Tape {
    /// The commands so far.
    pub program: Program,
    sizes: HashMap<Buffer, usize>,
    gradients: HashMap<Buffer, Gradient>,
    backward: Vec<(&'static str, Lane, Backward)>,
    detached: bool,
}

/// A gradient's buffer, and which of its numbers have been written: disjoint ranges in order.
struct Gradient {
    place: Buffer,
    written: Vec<Range<usize>>,
}

impl Gradient {
    /// What of `range` has been written: all, nothing, or a part.
    fn covers(&self, range: &Range<usize>) -> Covered {
        let meets = |written: &&Range<usize>| written.start < range.end && range.start < written.end;
        let mut met = self.written.iter().filter(meets);
        match (met.next(), met.next()) {
            (None, _) => Covered::Nothing,
            (Some(written), None) if written.start <= range.start && range.end <= written.end => Covered::All,
            _ => Covered::Part,
        }
    }

    /// Takes note of a range that touches nothing written.
    fn add(&mut self, range: Range<usize>) {
        let at = self.written.partition_point(|written| written.end <= range.start);
        self.written.insert(at, range);
        for next in (1..self.written.len()).rev() {
            if self.written[next - 1].end == self.written[next].start {
                self.written[next - 1].end = self.written[next].end;
                self.written.remove(next);
            }
        }
    }
}

#[derive(PartialEq, Eq)]
enum Covered {
    All,
    Nothing,
    Part,
}

/// The numbers from the first to the last of a matrix.
fn span(x: Matrix) -> Range<usize> {
    x.offset..x.offset + (x.rows - 1) * x.stride + x.cols
}

impl Tape {
    /// A matrix of its own, whose contents are undefined until something is written.
    pub fn matrix(&mut self, rows: usize, cols: usize) -> Matrix {
        let place = self.program.buffer(rows * cols);
        self.sizes.insert(place, rows * cols);
        Matrix { place, offset: 0, rows, cols, stride: cols }
    }

    /// Says what to add backward, in the part that is current now.
    pub fn on_backward(&mut self, body: impl FnOnce(&mut Self) + 'static) {
        if !self.detached {
            let (part, lane) = (self.program.current_part(), self.program.current_lane());
            self.backward.push((part, lane, Box::new(body)));
        }
    }

    /// Adds ops that no gradient goes back through.
    pub fn without_gradient<T>(&mut self, body: impl FnOnce(&mut Self) -> T) -> T {
        let before = std::mem::replace(&mut self.detached, true);
        let result = body(self);
        self.detached = before;
        result
    }

    /// Adds the way back, from the last op to the first.
    pub fn run_backward(&mut self) {
        while let Some((part, lane, body)) = self.backward.pop() {
            self.program.part(part);
            self.program.lane(lane);
            body(self);
        }
        self.program.lane(Lane::Main);
    }

    /// Ops of `body` run beside the main lane, from where that is now; so do theirs backward. The main lane may not add to the gradients
    /// that they add to, but after they are done.
    pub fn beside(&mut self, body: impl FnOnce(&mut Self)) {
        self.hand_over(Lane::Main);
        self.program.lane(Lane::Side);
        body(self);
        self.program.lane(Lane::Main);
    }

    /// The other lane goes on where `from` is; backward the other way.
    fn hand_over(&mut self, from: Lane) {
        self.program.hand_over(from);
        self.on_backward(move |tape| tape.program.hand_over(from.other()));
    }

    /// Ops of `body` may use [`Tape::beside`]; both lanes are through when it ends, backward too.
    pub fn forked(&mut self, body: impl FnOnce(&mut Self)) {
        self.program.fork();
        self.on_backward(|tape| tape.program.join());
        self.hand_over(Lane::Main);
        body(self);
        self.hand_over(Lane::Side);
        self.program.join();
        self.on_backward(|tape| tape.program.fork());
    }

    fn gradient(&mut self, place: Buffer) -> &mut Gradient {
        let Self { program, sizes, gradients, .. } = self;
        gradients.entry(place).or_insert_with(|| {
            let numbers = sizes.get(&place).copied().expect("only matrices of the tape have gradients");
            Gradient { place: program.buffer(numbers), written: Vec::new() }
        })
    }

    /// Where a term of x's gradient goes, and whether it is to be added to what is there.
    pub fn gradient_term(&mut self, x: Matrix) -> (Matrix, bool) {
        let gradient = self.gradient(x.place);
        let place = gradient.place;
        if x.is_contiguous() && gradient.covers(&span(x)) == Covered::Nothing {
            gradient.add(span(x));
            return (Matrix { place, ..x }, false);
        }
        (self.gradient_sum(x), true)
    }

    /// Where a term of x's gradient is added, by a kernel that always adds.
    pub fn gradient_sum(&mut self, x: Matrix) -> Matrix {
        let numbers = self.sizes.get(&x.place).copied().unwrap_or_default();
        let gradient = self.gradient(x.place);
        let place = gradient.place;
        if gradient.covers(&span(x)) != Covered::All {
            // What nobody has written yet is zero, all of it: later terms are added.
            let written = std::mem::replace(&mut gradient.written, std::iter::once(0..numbers).collect());
            let ends = written.iter().map(|range| range.start).chain([numbers]);
            let begins = [0].into_iter().chain(written.iter().map(|range| range.end));
            for (from, to) in begins.zip(ends).filter(|(from, to)| from < to) {
                self.zero(Matrix { place, offset: from, rows: 1, cols: to - from, stride: to - from });
            }
        }
        Matrix { place, ..x }
    }

    /// The gradient of x, all of whose terms have been added.
    pub fn gradient_of(&mut self, x: Matrix) -> Matrix {
        self.gradient_sum(x)
    }

    /// Where x's gradient is written by a kernel that never adds, and that writes all columns.
    pub fn gradient_overwritten(&mut self, x: Matrix) -> Matrix {
        let gradient = self.gradient(x.place);
        assert!(gradient.covers(&span(x)) != Covered::Part, "a gradient is written where a part of it was");
        if gradient.covers(&span(x)) == Covered::Nothing {
            gradient.add(span(x));
        }
        Matrix { place: gradient.place, ..x }
    }

    /// Gradients may reach this matrix at a fixed address.
    pub fn track(&mut self, x: Matrix) {
        self.sizes.insert(x.place, x.len());
    }

    /// x = 0.
    pub fn zero(&mut self, x: Matrix) {
        self.program.kernel(
            Kernel::Zero,
            Grid::elements(x.len()),
            &[x.into()],
            &[x.rows, x.cols, x.stride],
            &[],
        );
    }

    /// y = factor x, or added to y.
    pub fn copy(&mut self, x: Matrix, y: Matrix, add: bool, factor: f32) {
        let n = [x.rows, x.cols, x.stride, y.stride, usize::from(add)];
        self.program.kernel(Kernel::CopyRows, Grid::elements(x.len()), &[x.into(), y.into()], &n, &[factor]);
    }

    /// `c = a b`, each perhaps transposed, or added to c.
    pub fn product(&mut self, a: (Matrix, bool), b: (Matrix, bool), c: Matrix, add: bool) {
        self.program.product(Product { a: a.0, a_transposed: a.1, b: b.0, b_transposed: b.1, c, add });
    }

    /// Adds the sums of columns of x [rows, width] to `out` [width].
    pub fn add_column_sums(&mut self, x: Matrix, out: Matrix) {
        // Narrow matrices are summed as wider ones: 8 rows of 4 are a row of 32.
        let fold =
            if x.is_contiguous() && x.cols < 32 && 32 % x.cols == 0 && x.rows.is_multiple_of(32 / x.cols) {
                32 / x.cols
            } else {
                1
            };
        let wide = if fold > 1 { x.reshape(x.rows / fold, 32) } else { x };
        let (chunks, rows) = chunks_of(wide.rows);
        let partial = self.matrix(chunks, wide.cols);
        let grid = Grid { blocks: chunks * wide.cols.div_ceil(32), threads: 256, shared_bytes: 0 };
        let n = [wide.rows, wide.cols, wide.stride, rows];
        self.program.kernel(Kernel::ColumnSums, grid, &[wide.into(), partial.into()], &n, &[]);
        self.add_partials(partial.pointer(), out, chunks * fold, x.cols, 0);
    }

    /// Adds up shares: `out[j] += sum over chunks of partial[chunk * distance + offset + j]`.
    pub fn add_partials(
        &mut self,
        partial: Pointer,
        out: Matrix,
        chunks: usize,
        distance: usize,
        offset: usize,
    ) {
        let n = [chunks, out.len(), distance, offset];
        let grid = Grid { blocks: out.len().div_ceil(32), threads: 256, shared_bytes: 0 };
        self.program.kernel(Kernel::SumPartials, grid, &[partial, out.into()], &n, &[]);
    }
}

/// Chunks that so many rows are summed in, and the rows of each.
pub fn chunks_of(rows: usize) -> (usize, usize) {
    let each = rows.div_ceil(256).max(32);
    (rows.div_ceil(each), each)
}
