//! The update of actor and critic in imagination (eq. 10 to 12) as a program. The world model is only read.

use crate::layers::{Dense, Linear, Mlp, Source};
use crate::machine::Kernel;
use crate::program::{Grid, Matrix, Pointer};
use crate::tape::Tape;
use crate::world::{
    Branch, Head, Interacting, Recurrence, Sizes, Target, bins, branch_names, mean, noise, two_hot_loss,
};

/// How far is imagined and what the losses are made of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BehaviourScales {
    /// L: states of an imagination, the start included.
    pub length: usize,
    /// gamma.
    pub discount: f32,
    /// lambda of the return.
    pub lambda: f32,
    /// eta: factor of the actor's entropy.
    pub entropy: f32,
    /// Quantiles of the returns at the ends of their range.
    pub quantiles: [f32; 2],
    /// Share of the newest batch in the range.
    pub range_share: f32,
    /// Share of the critic that is mixed into its slow copy before each update.
    pub slow_share: f32,
    /// Whether the actor's loss moves the critic too, against the definition: for comparisons.
    pub actor_loss_reaches_critic: bool,
}

/// Means on the machine: actor's loss, critic's loss, entropy, reward, return, value.
pub const SCALARS: usize = 6;

/// Parameters of the behaviour's update by who trains them.
#[derive(Clone, Copy)]
pub struct Sources<'a> {
    /// Nothing trains.
    pub frozen: Source<'a>,
    /// The actor trains.
    pub actor: Source<'a>,
    /// The critic trains.
    pub critic: Source<'a>,
}

/// A two-layer perceptron that runs step by step over rows, its input detached.
struct Stepping {
    mlp: Mlp,
    rooms: [(Matrix, Matrix, Matrix); 2],
    out: Matrix,
}

impl Stepping {
    fn new(tape: &mut Tape, mlp: Mlp, x: Matrix) -> Self {
        let room = |tape: &mut Tape, x: Matrix, block: Dense| {
            let width = block.weight.value.rows;
            let (pre, stats, y) =
                (tape.matrix(x.rows, width), tape.matrix(x.rows, 2), tape.matrix(x.rows, width));
            tape.collect_linear(x, block.weight, pre);
            tape.collect_norm(pre, block.norm, stats, y, true);
            (pre, stats, y)
        };
        let [first, second] = mlp.blocks();
        let first = room(tape, x, first);
        let second = room(tape, first.2, second);
        let Linear { weight, bias } = mlp.out();
        let out = tape.matrix(x.rows, weight.value.rows);
        tape.collect_linear(second.2, weight, out);
        tape.fill_bias(bias, out);
        Self { mlp, rooms: [first, second], out }
    }

    fn step(&self, tape: &mut Tape, x: Matrix, rows: std::ops::Range<usize>) -> Matrix {
        let at = |matrix: Matrix| matrix.rows(rows.clone());
        let mut x = x;
        for (layer, (block, (pre, stats, y))) in self.mlp.blocks().into_iter().zip(self.rooms).enumerate() {
            tape.linear(x, block.weight, at(pre), false);
            if layer > 0 {
                tape.linear_back(x, block.weight, at(pre));
            }
            tape.norm_step(at(pre), block.norm, at(stats), at(y), true);
            x = at(y);
        }
        let weight = self.mlp.out().weight;
        tape.linear(x, weight, at(self.out), true);
        tape.linear_back(x, weight, at(self.out));
        at(self.out)
    }
}

/// Adds an imagination from every row of `start` [N, state], both losses and all gradients of actor and critic. `range` [2] is the returns'
/// running range, `scalars` takes the means, `taking_part` [1] says whether the run is changed. Noise comes from `control`, from word `word` on, in the order of sequences.
pub fn losses(
    tape: &mut Tape,
    sources: Sources<'_>,
    sizes: &Sizes,
    scales: &BehaviourScales,
    start: Matrix,
    (control, word): (u64, u64),
    (range, scalars, taking_part): (Matrix, Matrix, Matrix),
) {
    let (n, length) = (start.rows, scales.length);
    let states = tape.matrix(length * n, start.cols);
    let steps = (length - 1) * n;
    tape.program.part("imagine");
    let entropy = rollout(tape, sources, sizes, length, (start, states), (control, word));
    tape.program.part("judge");
    let bins = bins(sources.frozen);
    let value_of = |tape: &mut Tape, source: Source<'_>, name: &str| {
        let logits = tape.mlp(states, &source.mlp(name), true);
        two_hot_mean(tape, logits, bins)
    };
    let reward = value_of(tape, sources.frozen, "heads.reward");
    let judging = if scales.actor_loss_reaches_critic { sources.critic } else { sources.frozen };
    let value = value_of(tape, judging, "critic");
    let discount = discount(tape, sources.frozen, states, scales.discount);
    let (returns, weights) = (tape.matrix(steps, 1), tape.matrix(length * n, 1));
    let p = [reward, value, discount, returns, weights].map(Pointer::from);
    tape.program.kernel(Kernel::LambdaReturns, Grid::elements(n), &p, &[length, n], &[scales.lambda]);
    let [low, high] = scales.quantiles;
    let grid = Grid { blocks: 1, threads: 1024, shared_bytes: 0 };
    let p = [returns, range, taking_part].map(Pointer::from);
    tape.program.kernel(Kernel::ReturnRange, grid, &p, &[steps], &[low, high, scales.range_share]);
    let loss = tape.matrix(steps, 1);
    let d = [reward, value, discount, entropy].map(|x| tape.gradient_overwritten(x));
    let inputs = [reward, value, discount, returns, weights, entropy, range, loss].map(Pointer::from);
    let p = [&inputs[..], &d.map(Pointer::from)].concat();
    let f = [scales.lambda, scales.entropy, 1.0 / steps as f32];
    tape.program.kernel(Kernel::ActorLoss, Grid::elements(n), &p, &[length, n], &f);
    for (at, x) in [(0, loss), (2, entropy), (3, reward), (4, returns), (5, value)] {
        mean(tape, x, scalars, at, None);
    }
    tape.program.part("critic");
    let seen = states.rows(0..steps);
    let slow = tape.without_gradient(|tape| {
        let logits = tape.mlp(seen, &sources.frozen.mlp("slow_critic"), false);
        two_hot_mean(tape, logits, bins)
    });
    let logits = tape.mlp(seen, &sources.critic.mlp("critic"), false);
    let loss = tape.matrix(steps, 1);
    let weight = Some(weights.rows(0..steps));
    for (values, add) in [(returns, false), (slow, true)] {
        let target = Target { values, weight, add, factor: 1.0 / steps as f32 };
        two_hot_loss(tape, logits, target, loss, bins);
    }
    mean(tape, loss, scalars, 1, None);
    tape.run_backward();
}

/// Imagined states into `states` [L N, state], the actor choosing; the entropies of its choices [(L-1) N, 1].
fn rollout(
    tape: &mut Tape,
    sources: Sources<'_>,
    sizes: &Sizes,
    length: usize,
    (start, states): (Matrix, Matrix),
    (control, mut word): (u64, u64),
) -> Matrix {
    let (n, nm, action) = (start.rows, sizes.z(), sizes.model.action);
    let steps = (length - 1) * n;
    let major = (sizes.length, sizes.batch);
    let draw = sizes.draw(Some(major));
    let names = branch_names(sizes.model.kind);
    let branches: Vec<Branch> =
        names.iter().map(|name| Branch::new(sources.frozen, name, &sizes.model)).collect();
    let rooms: Vec<Recurrence> = branches.iter().map(|branch| Recurrence::new(tape, branch, steps)).collect();
    let column = |branch: usize, which: usize| {
        let (z, h) = sizes.columns(branch);
        states.columns(if which == 0 { z } else { h })
    };
    // The states that steps lead to: the first ones are given.
    let reached = |x: Matrix| x.rows(n..length * n);
    let priors: Vec<Head> = branches
        .iter()
        .enumerate()
        .map(|(at, branch)| Head::prior(tape, branch, reached(column(at, 1))))
        .collect();
    let interaction = (branches.len() == 2).then(|| {
        Interacting::new(tape, sources.frozen, &sizes.model, n, (rooms[1].input, reached(column(0, 1))))
    });
    let entropy = tape.matrix(steps, 1);
    let actor = Stepping::new(tape, sources.actor.mlp("actor"), states.rows(0..steps));
    let mut next_noise = |tape: &mut Tape, cols: usize, normal: bool| {
        if sizes.mode {
            return None;
        }
        let numbers = noise(tape, control, n, cols, normal, word);
        word += (n * cols * if normal { 2 } else { 1 }) as u64;
        Some(numbers)
    };
    tape.copy(start, states.rows(0..n), false, 1.0);
    for step in 0..length - 1 {
        let (here, next) = (step * n..(step + 1) * n, (step + 1) * n..(step + 2) * n);
        let at = |x: Matrix| x.rows(here.clone());
        let to = |x: Matrix| x.rows(next.clone());
        let out = actor.step(tape, at(states), here.clone());
        let normal = next_noise(tape, action, true);
        act(tape, out, normal, at(rooms[0].input.columns(nm..nm + action)), at(entropy), major);
        tape.copied(at(column(0, 0)), at(rooms[0].input.columns(0..nm)));
        for (branch, layers) in branches.iter().enumerate() {
            let (z, h) = (column(branch, 0), column(branch, 1));
            if let (Some(interaction), 1) = (&interaction, branch) {
                tape.copied(to(column(0, 0)), at(interaction.prior_z()));
                tape.copied(at(z), at(interaction.z()));
                interaction.step(tape, to(column(0, 1)), here.clone());
            }
            tape.copied(at(h), at(rooms[branch].before()));
            let reached = rooms[branch].input.cols;
            rooms[branch].step(tape, layers, here.clone(), reached, (to(h), None));
            let logits = priors[branch].step(tape, to(h), here.clone());
            let gumbel = next_noise(tape, nm, false);
            tape.draw(logits, gumbel, to(z), draw);
        }
    }
    entropy
}

/// Draws actions from the actor's output.
fn act(
    tape: &mut Tape,
    out: Matrix,
    normal: Option<Matrix>,
    action: Matrix,
    entropy: Matrix,
    (length, batch): (usize, usize),
) {
    let n = move |action: Matrix| [out.rows, action.cols, action.stride, length, batch];
    let p = [out.into(), normal.into(), action.into(), entropy.into()];
    tape.program.kernel(Kernel::ActorDraw, Grid::elements(out.rows), &p, &n(action), &[]);
    tape.on_backward(move |tape| {
        let (d_action, d_entropy) = (tape.gradient_of(action), tape.gradient_of(entropy));
        let d_out = tape.gradient_overwritten(out);
        let p = [out.into(), normal.into(), d_action.into(), d_entropy.into(), d_out.into()];
        tape.program.kernel(Kernel::ActorBackward, Grid::elements(out.rows), &p, &n(d_action), &[]);
    });
}

/// Means of two-hot distributions as values [rows, 1].
fn two_hot_mean(tape: &mut Tape, logits: Matrix, bins: Matrix) -> Matrix {
    let value = tape.matrix(logits.rows, 1);
    let p = [logits, bins, value].map(Pointer::from);
    tape.program.kernel(
        Kernel::TwoHotMean,
        Grid::warps(logits.rows),
        &p,
        &[logits.rows, logits.cols, 0],
        &[],
    );
    tape.on_backward(move |tape| {
        let (d, d_logits) = (tape.gradient_of(value), tape.gradient_overwritten(logits));
        let p = [logits, bins, value, d, d_logits].map(Pointer::from);
        let n = [logits.rows, logits.cols, 1];
        tape.program.kernel(Kernel::TwoHotMean, Grid::warps(logits.rows), &p, &n, &[]);
    });
    value
}

/// gamma times the predicted continuation [rows, 1].
fn discount(tape: &mut Tape, source: Source<'_>, states: Matrix, gamma: f32) -> Matrix {
    let logits = tape.mlp(states, &source.mlp("heads.continue"), true);
    let y = tape.matrix(logits.rows, 1);
    let grid = Grid::elements(y.len());
    tape.program.kernel(Kernel::ScaledSigmoid, grid, &[logits.into(), y.into()], &[y.len(), 0], &[gamma]);
    tape.on_backward(move |tape| {
        let (d, dx) = (tape.gradient_of(y), tape.gradient_overwritten(logits));
        let p = [logits, d, dx].map(Pointer::from);
        tape.program.kernel(Kernel::ScaledSigmoid, grid, &p, &[y.len(), 1], &[gamma]);
    });
    y
}
