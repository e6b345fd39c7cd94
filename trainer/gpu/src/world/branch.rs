//! One branch's layers, and what a scan or an imagination works in: recurrence, latent heads, interaction.

use rcwm_models::settings::ModelSettings;

use crate::layers::{Attending, Dense, Interaction, Linear, Norm, Source, Store, Weight};
use crate::program::Matrix;
use crate::tape::Tape;

/// One branch's layers.
#[derive(Debug, Clone, Copy)]
pub struct Branch {
    pub(super) input: Dense,
    pub(super) cell: Weight,
    pub(super) cell_norm: Norm,
    pub(super) prior: Dense,
    pub(super) prior_logits: Linear,
    pub(super) posterior: [Weight; 2],
    pub(super) posterior_norm: Norm,
    pub(super) posterior_logits: Linear,
    pub(super) initial: Weight,
}

impl Branch {
    /// The branch of this name: `robot`, `environment` or vanilla's `dynamics`.
    #[must_use]
    pub fn new(source: Source<'_>, name: &str, model: &ModelSettings) -> Self {
        let at = |part: &str| format!("{name}.{part}");
        let posterior = source.dense(&at("posterior.dense"));
        let (d, width) = (model.deter, posterior.weight.value.cols);
        Self {
            input: source.dense(&at("input")),
            cell: source.weight(&at("cell.linear.weight")),
            cell_norm: source.norm(&at("cell.norm")),
            prior: source.dense(&at("prior.dense")),
            prior_logits: source.linear(&at("prior.logits")),
            posterior: [posterior.weight.columns(0..d), posterior.weight.columns(d..width)],
            posterior_norm: posterior.norm,
            posterior_logits: source.linear(&at("posterior.logits")),
            initial: source.weight(&at("initial")),
        }
    }

    /// The same with copies of the weights that the way back of `rows` at a time reads.
    #[must_use]
    pub fn transposed(self, tape: &mut Tape, rows: usize) -> Self {
        let mut copied = |weight: Weight| tape.transposed(weight, rows);
        let [of_h, of_embed] = self.posterior;
        Self {
            input: Dense { weight: copied(self.input.weight), ..self.input },
            cell: copied(self.cell),
            prior: Dense { weight: copied(self.prior.weight), ..self.prior },
            prior_logits: Linear { weight: copied(self.prior_logits.weight), ..self.prior_logits },
            posterior: [copied(of_h), of_embed],
            posterior_logits: Linear {
                weight: copied(self.posterior_logits.weight),
                ..self.posterior_logits
            },
            ..self
        }
    }
}

/// What the recurrence of a branch works in, all rows.
#[derive(Debug, Clone, Copy)]
pub struct Recurrence {
    /// Input of the branch [rows, input].
    pub input: Matrix,
    /// Input layer's output beside h_{t-1}: [rows, hidden + d].
    pub joined: Matrix,
    pre: Matrix,
    stats: Matrix,
    cell: Matrix,
    cell_stats: Matrix,
    gates: Matrix,
    hidden: usize,
}

impl Recurrence {
    /// Room for so many rows; collects the weights' gradients over all of them.
    pub fn new(tape: &mut Tape, branch: &Branch, rows: usize) -> Self {
        let (hidden, d) = (branch.input.weight.value.rows, branch.initial.value.cols);
        let room = Self {
            input: tape.matrix(rows, branch.input.weight.value.cols),
            joined: tape.matrix(rows, hidden + d),
            pre: tape.matrix(rows, hidden),
            stats: tape.matrix(rows, 2),
            cell: tape.matrix(rows, 3 * d),
            cell_stats: tape.matrix(rows, 2),
            gates: tape.matrix(rows, 3 * d),
            hidden,
        };
        tape.collect_linear(room.input, branch.input.weight, room.pre);
        tape.collect_norm(room.pre, branch.input.norm, room.stats, room.joined.columns(0..hidden), true);
        tape.collect_linear(room.joined, branch.cell, room.cell);
        if branch.cell.gradient.is_some() {
            tape.collect_cell(room.cell, branch.cell_norm, room.cell_stats, room.gates);
        }
        room
    }

    /// Where h_{t-1} goes.
    #[must_use]
    pub fn before(&self) -> Matrix {
        self.joined.columns(self.hidden..self.joined.cols)
    }

    /// h_t of some rows (eq. 5, 6), to one or two places. Gradients reach the first `reached` columns of the input.
    pub fn step(
        &self,
        tape: &mut Tape,
        branch: &Branch,
        rows: std::ops::Range<usize>,
        reached: usize,
        h: (Matrix, Option<Matrix>),
    ) {
        let at = |matrix: Matrix| matrix.rows(rows.clone());
        let x = at(self.joined.columns(0..self.hidden));
        tape.linear(at(self.input), branch.input.weight, at(self.pre), false);
        let weight = branch.input.weight.columns(0..reached);
        tape.linear_back(at(self.input.columns(0..reached)), weight, at(self.pre));
        tape.norm_step(at(self.pre), branch.input.norm, at(self.stats), x, true);
        tape.linear(at(self.joined), branch.cell, at(self.cell), false);
        tape.linear_back(at(self.joined), branch.cell, at(self.cell));
        let (cell, stats, gates) = (at(self.cell), at(self.cell_stats), at(self.gates));
        tape.cell_step(cell, branch.cell_norm, stats, gates, at(self.before()), h);
    }
}

/// What a latent head works in, all rows: a dense block and logits.
#[derive(Debug, Clone, Copy)]
pub struct Head {
    weight: Weight,
    norm: Norm,
    out: Linear,
    pre: Matrix,
    stats: Matrix,
    inner: Matrix,
    /// [rows, n m].
    pub logits: Matrix,
    adds: bool,
}

impl Head {
    /// Room for rows of h [rows, d]; collects the weights' gradients over all of them. `pre` is there where the sum before the norm has
    /// another term already.
    pub(super) fn new(
        tape: &mut Tape,
        (weight, norm, out): (Weight, Norm, Linear),
        h: Matrix,
        pre: Option<Matrix>,
    ) -> Self {
        let (rows, hidden) = (h.rows, weight.value.rows);
        let adds = pre.is_some();
        let pre = pre.unwrap_or_else(|| tape.matrix(rows, hidden));
        let (stats, inner) = (tape.matrix(rows, 2), tape.matrix(rows, hidden));
        let logits = tape.matrix(rows, out.weight.value.rows);
        tape.collect_linear(h, weight, pre);
        tape.collect_norm(pre, norm, stats, inner, true);
        tape.collect_linear(inner, out.weight, logits);
        tape.fill_bias(out.bias, logits);
        Self { weight, norm, out, pre, stats, inner, logits, adds }
    }

    /// The prior's head.
    pub fn prior(tape: &mut Tape, branch: &Branch, h: Matrix) -> Self {
        Self::new(tape, (branch.prior.weight, branch.prior.norm, branch.prior_logits), h, None)
    }

    /// Logits of some rows.
    pub fn step(&self, tape: &mut Tape, h: Matrix, rows: std::ops::Range<usize>) -> Matrix {
        let at = |matrix: Matrix| matrix.rows(rows.clone());
        tape.linear(h, self.weight, at(self.pre), self.adds);
        tape.linear_back(h, self.weight, at(self.pre));
        tape.norm_step(at(self.pre), self.norm, at(self.stats), at(self.inner), true);
        tape.linear(at(self.inner), self.out.weight, at(self.logits), true);
        tape.linear_back(at(self.inner), self.out.weight, at(self.logits));
        at(self.logits)
    }
}

/// What the interaction works in, all rows.
#[derive(Debug, Clone, Copy)]
pub struct Interacting {
    parts: Interaction,
    all: Attending,
    classes: usize,
}

impl Interacting {
    /// Room for rows; e goes to `e` [rows, n m] and h^R comes from `h` [rows, d]. Collects the weights' gradients over all of them.
    /// Steps have `at_once` rows each.
    pub fn new(
        tape: &mut Tape,
        source: Source<'_>,
        model: &ModelSettings,
        at_once: usize,
        (e, h): (Matrix, Matrix),
    ) -> Self {
        let mut parts = source.interaction();
        parts.deter.weight = tape.transposed(parts.deter.weight, at_once);
        let (rows, nm, m) = (e.rows, model.stoch_width(), model.classes);
        let wide = nm + model.interaction_rows() * m;
        let trained = parts.deter.weight.gradient.is_some();
        let (n, r) = (nm / m, wide / m);
        let store = trained.then(|| Store {
            at: tape.matrix(1, 2 * rows * (n + r) * m),
            distances: [rows * nm, 2 * rows * nm, 2 * rows * nm + rows * wide],
        });
        let all = Attending {
            z: tape.matrix(rows, nm),
            u: tape.matrix(rows, wide),
            e,
            mix: trained.then(|| tape.matrix(rows, nm)),
            sum: trained.then(|| tape.matrix(rows, nm)),
            stats: tape.matrix(rows * n, 2),
            store,
        };
        let g = all.u.columns(nm..wide);
        tape.collect_linear(h, parts.deter.weight, g);
        tape.fill_bias(parts.deter.bias, g);
        tape.collect_interaction(&parts, m, all);
        Self { parts, all, classes: m }
    }

    /// Where the environment's z_{t-1} goes.
    #[must_use]
    pub fn z(&self) -> Matrix {
        self.all.z
    }

    /// Where the robot's prior z_t goes.
    #[must_use]
    pub fn prior_z(&self) -> Matrix {
        self.all.u.columns(0..self.all.z.cols)
    }

    /// e_{t-1} of some rows (eq. 7).
    pub fn step(&self, tape: &mut Tape, h: Matrix, rows: std::ops::Range<usize>) {
        let (nm, n) = (self.all.z.cols, self.all.z.cols / self.classes);
        let at = |matrix: Matrix| matrix.rows(rows.clone());
        let u = at(self.all.u);
        let g = u.columns(nm..u.cols);
        tape.linear(h, self.parts.deter.weight, g, true);
        tape.linear_back(h, self.parts.deter.weight, g);
        // The parts of the store are laid out by all rows; this step's begin further on in each.
        let store = self.all.store.map(|store| {
            let (z, r) = (rows.start * nm, rows.start * (u.cols - nm));
            let [q, k, v] = store.distances;
            let at = Matrix { offset: store.at.offset + z, cols: store.at.cols - z, ..store.at };
            Store { at, distances: [q, k + r, v + r] }
        });
        let here = Attending {
            z: at(self.all.z),
            u,
            e: at(self.all.e),
            mix: self.all.mix.map(at),
            sum: self.all.sum.map(at),
            stats: self.all.stats.rows(rows.start * n..rows.end * n),
            store,
        };
        tape.interaction_step(&self.parts, self.classes, here);
    }
}
