//! The model's layers on a tape. Forward of an op and the way back stand together; gradients of weights are collected apart from it, so that a
//! scan over time has one product a weight and not one a step: what collects is added before the scan and so runs after it backward.

mod conv;
mod interaction;
mod norm;

use crate::machine::Kernel;
use crate::program::{FEW_ROWS, Grid, Matrix, Pointer};
use crate::tape::Tape;
use crate::weights::{Array, Weights};

pub use interaction::{Attending, Interaction, Store};

/// LayerNorm's epsilon everywhere but in the interaction model.
const NORM_EPS: f32 = 1e-3;
/// LayerNorm's epsilon in the interaction model.
const INTERACTION_NORM_EPS: f32 = 1e-5;
/// Blocks of a norm of narrow rows: what an H100 holds at once, twice.
const NARROW_BLOCKS: usize = 132 * 8;

/// A parameter, with its gradient where it is trained.
#[derive(Debug, Clone, Copy)]
pub struct Weight {
    /// Its numbers.
    pub value: Matrix,
    /// Where its gradient is added up.
    pub gradient: Option<Matrix>,
    /// The other way round, where it is read so on the way back of few rows.
    pub transposed: Option<Matrix>,
}

impl Weight {
    /// Some of its columns.
    #[must_use]
    pub fn columns(self, columns: std::ops::Range<usize>) -> Self {
        let cut = |matrix: Matrix| matrix.columns(columns.clone());
        let transposed = self.transposed.map(|matrix| matrix.rows(columns.clone()));
        Self { value: cut(self.value), gradient: self.gradient.map(cut), transposed }
    }
}

/// Gain and shift of a LayerNorm.
#[derive(Debug, Clone, Copy)]
pub struct Norm {
    gain: Weight,
    shift: Weight,
    eps: f32,
}

/// A linear layer with bias.
#[derive(Debug, Clone, Copy)]
pub struct Linear {
    /// [out, in].
    pub weight: Weight,
    /// [out].
    pub bias: Weight,
}

/// A dense block: linear without bias, LayerNorm, `SiLU`.
#[derive(Debug, Clone, Copy)]
pub struct Dense {
    /// [out, in].
    pub weight: Weight,
    /// Of width out.
    pub norm: Norm,
}

/// Two dense blocks and an output layer.
#[derive(Debug, Clone, Copy)]
pub struct Mlp {
    blocks: [Dense; 2],
    out: Linear,
}

impl Mlp {
    /// The dense blocks.
    #[must_use]
    pub fn blocks(&self) -> [Dense; 2] {
        self.blocks
    }

    /// The output layer.
    #[must_use]
    pub fn out(&self) -> Linear {
        self.out
    }
}

/// Parameters by name; those that `trains` accepts have gradients.
#[derive(Clone, Copy)]
pub struct Source<'a> {
    /// The arrays.
    pub weights: &'a Weights,
    /// Which are trained.
    pub trains: fn(&str) -> bool,
    /// The parameters themselves, or their average.
    pub array: Array,
}

impl Source<'_> {
    /// The parameter of this name.
    #[must_use]
    pub fn weight(&self, name: &str) -> Weight {
        let gradient = (self.trains)(name).then(|| self.weights.matrix(Array::Gradients, name));
        Weight { value: self.weights.matrix(self.array, name), gradient, transposed: None }
    }

    /// `NAME.weight` and `NAME.bias` of a norm.
    #[must_use]
    pub fn norm(&self, name: &str) -> Norm {
        let [gain, shift] = ["weight", "bias"].map(|part| self.weight(&format!("{name}.{part}")));
        Norm { gain, shift, eps: NORM_EPS }
    }

    /// `NAME.weight` and `NAME.bias` of a linear layer.
    #[must_use]
    pub fn linear(&self, name: &str) -> Linear {
        let [weight, bias] = ["weight", "bias"].map(|part| self.weight(&format!("{name}.{part}")));
        Linear { weight, bias }
    }

    /// `NAME.linear.weight` and `NAME.norm`.
    #[must_use]
    pub fn dense(&self, name: &str) -> Dense {
        Dense {
            weight: self.weight(&format!("{name}.linear.weight")),
            norm: self.norm(&format!("{name}.norm")),
        }
    }

    /// `NAME.0`, `NAME.1`, `NAME.out`.
    #[must_use]
    pub fn mlp(&self, name: &str) -> Mlp {
        let blocks = [0, 1].map(|block| self.dense(&format!("{name}.{block}")));
        Mlp { blocks, out: self.linear(&format!("{name}.out")) }
    }

    /// `interaction.*`.
    #[must_use]
    pub fn interaction(&self) -> Interaction {
        let linear = |part: &str| self.linear(&format!("interaction.{part}"));
        let norm = Norm { eps: INTERACTION_NORM_EPS, ..self.norm("interaction.norm") };
        let (query, key, value) = (linear("query"), linear("key"), linear("value"));
        Interaction { deter: linear("deter"), query, key, value, output: linear("output"), norm }
    }
}

/// Means and scales of a norm's rows, which the way back needs.
fn stats_of(tape: &mut Tape, rows: usize) -> Matrix {
    tape.matrix(rows, 2)
}

impl Tape {
    /// `y = x w^T`, or added to y.
    pub fn linear(&mut self, x: Matrix, weight: Weight, y: Matrix, add: bool) {
        self.product((x, false), (weight.value, true), y, add);
    }

    /// The weight with a copy that lies the other way round, for products with `rows` at a time: where they are few, a kernel that reads along the
    /// rows of the copy is much faster than one that reads across those of the weight.
    pub fn transposed(&mut self, weight: Weight, rows: usize) -> Weight {
        if rows > FEW_ROWS {
            return weight;
        }
        let x = weight.value;
        let y = self.matrix(x.cols, x.rows);
        let grid = Grid { blocks: x.rows.div_ceil(32) * x.cols.div_ceil(32), threads: 256, shared_bytes: 0 };
        let n = [x.rows, x.cols, x.stride];
        self.program.kernel(Kernel::Transpose, grid, &[x.into(), y.into()], &n, &[]);
        Weight { transposed: Some(y), ..weight }
    }

    /// The way back of [`Tape::linear`] to x.
    pub fn linear_back(&mut self, x: Matrix, weight: Weight, y: Matrix) {
        self.on_backward(move |tape| {
            let dy = tape.gradient_of(y);
            let (dx, add) = tape.gradient_term(x);
            let few = dy.rows <= FEW_ROWS;
            let back = weight.transposed.filter(|_| few).map_or((weight.value, false), |back| (back, true));
            tape.product((dy, false), back, dx, add);
        });
    }

    /// Collects the weight's gradient over all rows.
    pub fn collect_linear(&mut self, x: Matrix, weight: Weight, y: Matrix) {
        let Some(gradient) = weight.gradient else { return };
        self.on_backward(move |tape| {
            let dy = tape.gradient_of(y);
            tape.product((dy, true), (x, false), gradient, true);
        });
    }

    /// Every row of y becomes the bias, to which a product is then added; collects the bias's gradient.
    pub fn fill_bias(&mut self, bias: Weight, y: Matrix) {
        let n = [y.rows, y.cols, y.stride];
        self.program.kernel(
            Kernel::FillRows,
            Grid::elements(y.len()),
            &[bias.value.into(), y.into()],
            &n,
            &[],
        );
        let Some(gradient) = bias.gradient else { return };
        self.on_backward(move |tape| {
            let dy = tape.gradient_of(y);
            tape.add_column_sums(dy, gradient);
        });
    }

    /// A linear layer with bias, all at once: y; `reaches` says whether the gradient goes on to x.
    pub fn layer(&mut self, x: Matrix, layer: Linear, reaches: bool) -> Matrix {
        let y = self.matrix(x.rows, layer.weight.value.rows);
        self.fill_bias(layer.bias, y);
        self.collect_linear(x, layer.weight, y);
        self.linear(x, layer.weight, y, true);
        if reaches {
            self.linear_back(x, layer.weight, y);
        }
        y
    }

    /// A dense block, all at once.
    pub fn dense(&mut self, x: Matrix, block: Dense, reaches: bool) -> Matrix {
        let pre = self.matrix(x.rows, block.weight.value.rows);
        self.collect_linear(x, block.weight, pre);
        self.linear(x, block.weight, pre, false);
        if reaches {
            self.linear_back(x, block.weight, pre);
        }
        let y = self.matrix(pre.rows, pre.cols);
        self.norm(pre, block.norm, y, true);
        y
    }

    /// Two dense blocks and an output layer.
    pub fn mlp(&mut self, x: Matrix, mlp: &Mlp, reaches: bool) -> Matrix {
        let inner = self.dense(x, mlp.blocks[0], reaches);
        let inner = self.dense(inner, mlp.blocks[1], true);
        self.layer(inner, mlp.out, true)
    }

    /// The recurrent cell of some of the rows: h' from its layer's output `pre` [rows, 3d] and h, to one or two places whose gradients are added.
    /// `gates` [rows, 3d] takes the gradients after the norm.
    pub fn cell_step(
        &mut self,
        pre: Matrix,
        norm: Norm,
        stats: Matrix,
        gates: Matrix,
        h: Matrix,
        (next, again): (Matrix, Option<Matrix>),
    ) {
        let stride = |again: Option<Matrix>| again.map_or(0, |again| again.stride);
        let (grid, wide) = Grid::rows(pre.rows, pre.cols);
        let p = [pre, norm.gain.value, norm.shift.value, h, next, stats].map(Pointer::from);
        let p = [&p[..], &[again.into()]].concat();
        let n = [pre.rows, h.cols, pre.stride, h.stride, next.stride, usize::from(wide), stride(again)];
        self.program.kernel(Kernel::CellForward, grid, &p, &n, &[norm.eps]);
        self.on_backward(move |tape| {
            let d_next = tape.gradient_of(next);
            let d_again = again.map(|again| tape.gradient_of(again));
            let d_pre = tape.gradient_overwritten(pre);
            let dh = tape.gradient_sum(h);
            let p = [pre, norm.gain.value, norm.shift.value, h, stats, d_next, gates, d_pre, dh]
                .map(Pointer::from);
            let p = [&p[..], &[d_again.into()]].concat();
            let strides = [pre.stride, h.stride, d_next.stride, dh.stride];
            let n = [&[pre.rows, h.cols][..], &strides, &[usize::from(wide), stride(d_again)]].concat();
            tape.program.kernel(Kernel::CellBackward, grid, &p, &n, &[]);
        });
    }

    /// Collects the gradients of the cell's gain and shift over all rows.
    pub fn collect_cell(&mut self, pre: Matrix, norm: Norm, stats: Matrix, gates: Matrix) {
        self.on_backward(move |tape| tape.add_norm_gradients(pre, norm, stats, gates, false));
    }

    /// One-hot draws z [rows, n m] from logits [rows, n m], with a straight-through gradient. `noise` are Gumbel numbers (none: the mode); its
    /// row b * T + t belongs to row t * B + b where `major` is (T, B).
    pub fn draw(&mut self, logits: Matrix, noise: Option<Matrix>, z: Matrix, draw: Draw) {
        let Draw { classes, unimix, major, of_mode: mode } = draw;
        let n = logits.cols / classes;
        let (t, b) = major.unwrap_or((0, 1));
        let grid = Grid::warps(logits.rows * n);
        let counts = [logits.rows, n, classes, logits.stride, z.stride, t, b];
        self.program.kernel(Kernel::Draw, grid, &[logits.into(), noise.into(), z.into()], &counts, &[unimix]);
        self.on_backward(move |tape| {
            let dz = tape.gradient_of(z);
            let (dx, add) = tape.gradient_term(logits);
            let n = [
                &[logits.rows, n, classes, logits.stride, dz.stride, dx.stride][..],
                &[usize::from(mode), usize::from(add)],
            ];
            let p = [logits, dz, dx].map(Pointer::from);
            tape.program.kernel(Kernel::DrawBackward, grid, &p, &n.concat(), &[unimix]);
        });
    }

    /// The state that some rows carry, z and h: `initial` where `first` is set, else `carried`; all `initial` without `carried`.
    pub fn carry(
        &mut self,
        first: Matrix,
        initial: [Matrix; 2],
        carried: Option<[Matrix; 2]>,
        y: [Matrix; 2],
    ) {
        let arguments = move |initial: [Matrix; 2], carried: Option<[Matrix; 2]>, y: [Matrix; 2]| {
            let of_carried = carried.map_or([Pointer::NULL; 2], |both| both.map(Pointer::from));
            let strides = carried.map_or([0; 2], |both| both.map(|x| x.stride));
            let p = [&[first.into()][..], &initial.map(Pointer::from), &of_carried, &y.map(Pointer::from)]
                .concat();
            let [z, h] = y;
            (p, [z.rows, z.cols, h.cols, strides[0], strides[1], z.stride, h.stride])
        };
        let (p, n) = arguments(initial, carried, y);
        let numbers = y[0].len() + y[1].len();
        self.program.kernel(Kernel::Carry, Grid::elements(numbers), &p, &n, &[]);
        self.on_backward(move |tape| {
            let dy = y.map(|y| tape.gradient_of(y));
            let d_initial = initial.map(|x| tape.gradient_sum(x));
            let d_carried = carried.map(|both| both.map(|x| tape.gradient_sum(x)));
            let (p, n) = arguments(d_initial, d_carried, dy);
            let blocks = y[0].cols.div_ceil(32) + y[1].cols.div_ceil(32);
            let grid = Grid { blocks, threads: 512, shared_bytes: 0 };
            tape.program.kernel(Kernel::CarryBackward, grid, &p, &n, &[]);
        });
    }

    /// y = x, with a gradient.
    pub fn copied(&mut self, x: Matrix, y: Matrix) {
        self.copy(x, y, false, 1.0);
        self.on_backward(move |tape| {
            let dy = tape.gradient_of(y);
            let (dx, add) = tape.gradient_term(x);
            tape.copy(dy, dx, add, 1.0);
        });
    }

    /// y = tanh(x) of a parameter [1, width].
    pub fn tanh(&mut self, x: Weight) -> Matrix {
        let y = self.matrix(1, x.value.cols);
        let n = [y.len(), 0];
        self.program.kernel(Kernel::Tanh, Grid::elements(y.len()), &[x.value.into(), y.into()], &n, &[]);
        if let Some(dx) = x.gradient {
            self.on_backward(move |tape| {
                let dy = tape.gradient_of(y);
                let p = [y, dy, dx].map(Pointer::from);
                tape.program.kernel(Kernel::Tanh, Grid::elements(y.len()), &p, &[y.len(), 1], &[]);
            });
        }
        y
    }
}

/// How categoricals are drawn.
#[derive(Debug, Clone, Copy)]
pub struct Draw {
    /// m.
    pub classes: usize,
    /// Share of the uniform distribution.
    pub unimix: f32,
    /// (T, B) where the noise's rows are those of sequences first.
    pub major: Option<(usize, usize)>,
    /// Whether the gradient passes through log p, as that of the initial state's mode does, and not through p.
    pub of_mode: bool,
}
