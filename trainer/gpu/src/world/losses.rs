//! What a filtered batch is judged by: its pictures, heads, divergences, and the actor's distance from what was demonstrated.

use rcwm_models::settings::ModelKind;

use super::{ImitationScales, Inputs, Sizes, WorldScales};
use crate::layers::Source;
use crate::machine::Kernel;
use crate::program::{Grid, Matrix, Pointer};
use crate::tape::Tape;

pub(super) fn decoded(
    tape: &mut Tape,
    source: Source<'_>,
    sizes: &Sizes,
    inputs: Inputs,
    (images, masks, features): (Matrix, Option<Matrix>, Matrix),
    scales: WorldScales,
    scalars: Matrix,
) {
    let count = sizes.decoded();
    let index = Matrix::fixed(inputs.decoded, 1, count);
    let every = sizes.decode_every;
    let chosen = if every == 1 {
        features
    } else {
        let chosen = tape.matrix(count, features.cols);
        let n = move |x: Matrix, back: usize| [count, x.cols, x.stride, chosen.stride, back];
        let p = [features, chosen, index].map(Pointer::from);
        tape.program.kernel(Kernel::GatherRows, Grid::elements(chosen.len()), &p, &n(features, 0), &[]);
        tape.on_backward(move |tape| {
            let dy = tape.gradient_of(chosen);
            let dx = tape.gradient_sum(features);
            let p = [dx, dy, index].map(Pointer::from);
            tape.program.kernel(Kernel::GatherRows, Grid::elements(chosen.len()), &p, &n(dx, 1), &[]);
        });
        chosen
    };
    let prefixes: &[&str] = match sizes.model.kind {
        ModelKind::Rcwm => &["decoder.robot", "decoder.environment"],
        ModelKind::Vanilla => &["decoder"],
    };
    let raws: Vec<Matrix> = prefixes
        .iter()
        .enumerate()
        .map(|(branch, prefix)| {
            let (z, h) = sizes.columns(branch);
            let map =
                tape.layer(chosen.columns(z.start..h.end), source.linear(&format!("{prefix}.linear")), true);
            let mut x = map.reshape(count * 16, map.cols / 16);
            for layer in 0..3 {
                let name = format!("{prefix}.{layer}");
                let pre = tape.conv_up(x, 4 << layer, source.weight(&format!("{name}.conv.weight")), None);
                x = tape.matrix(pre.rows, pre.cols);
                tape.norm(pre, source.norm(&format!("{name}.norm")), x, true);
            }
            let last = source.linear(&format!("{prefix}.3.conv"));
            tape.conv_up(x, 32, last.weight, Some(last.bias))
        })
        .collect();
    let (loss, mask_loss) = (tape.matrix(1, count), tape.matrix(1, count));
    let d: Vec<Matrix> = raws.iter().map(|raw| tape.gradient_overwritten(*raw)).collect();
    let two = |of: &[Matrix]| [Pointer::from(of[0]), of.get(1).copied().into()];
    let rows: Pointer = if every == 1 { Pointer::NULL } else { index.into() };
    let inputs = [images.into(), masks.into(), rows, loss.into(), mask_loss.into()];
    let p = [&two(&raws)[..], &inputs, &two(&d)].concat();
    let weights = [scales.image / count as f32, scales.mask / count as f32];
    let grid = Grid { blocks: count, threads: 256, shared_bytes: 0 };
    tape.program.kernel(Kernel::PictureLoss, grid, &p, &[count], &weights);
    mean(tape, loss, scalars, 0, None);
    if masks.is_some() {
        mean(tape, mask_loss, scalars, 1, None);
    }
}

pub(super) fn cloning_loss(
    tape: &mut Tape,
    source: Source<'_>,
    inputs: Inputs,
    imitation: ImitationScales,
    (features, scalars): (Matrix, Matrix),
) {
    let out = tape.mlp(features, &source.mlp("actor"), true);
    let (rows, actions) = (out.rows, out.cols / 2);
    let (loss, d) = (tape.matrix(1, rows), tape.gradient_overwritten(out));
    let demonstrated = Matrix::fixed(inputs.demonstrated, rows, actions);
    let p = [out, demonstrated, Matrix::fixed(inputs.counts, rows, 1), loss, d].map(Pointer::from);
    let n = [rows, actions, usize::from(imitation.likelihood)];
    tape.program.kernel(Kernel::CloningLoss, Grid::elements(rows), &p, &n, &[imitation.scale]);
    sum(tape, loss, scalars, 8, None, 1.0);
}

/// The mean of numbers, each raised to a floor where there is one, to a place of the scalars.
pub fn mean(tape: &mut Tape, x: Matrix, scalars: Matrix, at: usize, floor: Option<f32>) {
    sum(tape, x, scalars, at, floor, 1.0 / x.len() as f32);
}

fn sum(tape: &mut Tape, x: Matrix, scalars: Matrix, at: usize, floor: Option<f32>, factor: f32) {
    let p = [x.into(), scalars.columns(at..at + 1).into()];
    let grid = Grid { blocks: 1, threads: 512, shared_bytes: 0 };
    let n = [x.len(), usize::from(floor.is_some())];
    tape.program.kernel(Kernel::SumOf, grid, &p, &n, &[factor, floor.unwrap_or_default()]);
}

pub(super) fn other_losses(
    tape: &mut Tape,
    source: Source<'_>,
    sizes: &Sizes,
    inputs: Inputs,
    pairs: &[(Matrix, Matrix)],
    scales: WorldScales,
    (features, scalars): (Matrix, Matrix),
) {
    let rows = sizes.rows();
    let share = 1.0 / rows as f32;
    let logits = tape.mlp(features, &source.mlp("heads.reward"), true);
    let values = Matrix::fixed(inputs.reward, rows, 1);
    let loss = tape.matrix(1, rows);
    let target = Target { values, weight: None, add: false, factor: scales.reward * share };
    two_hot_loss(tape, logits, target, loss, bins(source));
    mean(tape, loss, scalars, 2, None);

    let logits = tape.mlp(features, &source.mlp("heads.continue"), true);
    let loss = tape.matrix(1, rows);
    let d = tape.gradient_overwritten(logits);
    let p = [logits, Matrix::fixed(inputs.terminal, rows, 1), loss, d].map(Pointer::from);
    tape.program.kernel(Kernel::ContinueLoss, Grid::elements(rows), &p, &[rows], &[scales.continues * share]);
    mean(tape, loss, scalars, 3, None);

    let m = sizes.model.classes;
    for (branch, (q, p)) in pairs.iter().enumerate() {
        let kl = Matrix::fixed(inputs.kl, 2, rows).rows(branch..branch + 1);
        let (dq, dp) = (tape.gradient_overwritten(*q), tape.gradient_overwritten(*p));
        let pointers = [*q, *p, kl, dq, dp].map(Pointer::from);
        let n = [rows, q.cols / m, m, q.stride, p.stride, dq.stride, dp.stride];
        let unimix = sizes.model.unimix as f32;
        let f = [unimix, scales.free_nats, scales.dynamics * share, scales.representation * share];
        tape.program.kernel(Kernel::BalancedKl, Grid::warps(rows), &pointers, &n, &f);
        mean(tape, kl, scalars, 4 + 2 * branch, None);
        mean(tape, kl, scalars, 5 + 2 * branch, Some(scales.free_nats));
    }
}

/// The two-hot bins [1, count], a constant beside the weights.
pub fn bins(source: Source<'_>) -> Matrix {
    source.weights.bins()
}

/// What a two-hot head is compared with.
#[derive(Debug, Clone, Copy)]
pub struct Target {
    /// [rows, 1].
    pub values: Matrix,
    /// [rows], or 1 each.
    pub weight: Option<Matrix>,
    /// Whether loss and gradient are added to what is there.
    pub add: bool,
    /// What the gradient is multiplied with.
    pub factor: f32,
}

/// Cross-entropy of logits [rows, bins] with two-hot distributions, with its gradient.
pub fn two_hot_loss(tape: &mut Tape, logits: Matrix, target: Target, loss: Matrix, bins: Matrix) {
    let d = tape.gradient_overwritten(logits);
    let p = [logits.into(), target.values.into(), target.weight.into(), bins.into(), loss.into(), d.into()];
    let n = [logits.rows, logits.cols, target.values.stride, usize::from(target.add)];
    tape.program.kernel(Kernel::TwoHotLoss, Grid::warps(logits.rows), &p, &n, &[target.factor]);
}
