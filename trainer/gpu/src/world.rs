//! The world model's update (eq. 2, 3, 5 to 9) as a program: encode, scan, decode, losses, and the way back.

mod branch;
mod losses;
mod sizes;

use rcwm_models::settings::ModelKind;

use crate::layers::{Draw, Source};
use crate::machine::Kernel;
use crate::program::{Grid, Matrix, Pointer};
use crate::tape::Tape;

use losses::{cloning_loss, decoded, other_losses};

pub use branch::{Branch, Head, Interacting, Recurrence};
pub use losses::{Target, bins, mean, two_hot_loss};
pub use sizes::Sizes;

/// What the losses are multiplied with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WorldScales {
    pub image: f32,
    /// Of the robot's mask.
    pub mask: f32,
    pub reward: f32,
    /// Of the continuation.
    pub continues: f32,
    /// Of KL[sg(q) || p].
    pub dynamics: f32,
    /// Of KL[q || sg(p)].
    pub representation: f32,
    /// KL below which nothing is learned.
    pub free_nats: f32,
}

/// Where a batch lies on the machine; rows are time-major.
#[derive(Debug, Clone, Copy)]
pub struct Inputs {
    /// Images u8 [.., 64, 64, 3], of a batch or of a store.
    pub images: u64,
    /// Masks u8 [.., 64, 64], as the images.
    pub masks: u64,
    /// Which image each row has, u32 [T B].
    pub index: u64,
    /// Which image the encoders see in each row, u32 [T B].
    pub seen: u64,
    /// How they see its colours, by sequence: [B, 8], gain [3], offset [3], grey, whether any changes.
    pub colours: u64,
    /// Shift of each sequence's images, i32 [B, 2]: right, down.
    pub shift: u64,
    /// Actions that led to the images, divided by max(1, |a|) and zero where an episode begins: [T B, action].
    pub action: u64,
    /// [T B].
    pub reward: u64,
    /// [T B].
    pub terminal: u64,
    /// u32 [T B].
    pub first: u64,
    /// Rows that are decoded, u32.
    pub decoded: u64,
    /// Key and stream of the noise, u32 [10].
    pub noise: u64,
    /// Where each branch's KL goes, [2, T B].
    pub kl: u64,
    /// Actions that were demonstrated in the states, [T B, action], and what each counts, [T B].
    pub demonstrated: u64,
    pub counts: u64,
}

/// The actor's part in the world model's loss.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImitationScales {
    /// Factor of the distance from what was demonstrated.
    pub scale: f32,
    /// Whether the distance is the negative log-likelihood, or the squared error of the mean.
    pub likelihood: bool,
}

/// Losses on the machine, each a number: image, mask, reward, continue, for each branch its KL and its KL raised to the free nats, and the actor's
/// distance from what was demonstrated.
pub const SCALARS: usize = 9;

/// Gumbel or normal noise from word `from` on.
pub fn noise(tape: &mut Tape, control: u64, rows: usize, cols: usize, normal: bool, from: u64) -> Matrix {
    let out = tape.matrix(rows, cols);
    let blocks = (out.len() * if normal { 2 } else { 1 }).div_ceil(16) + 1;
    let p = [Matrix::fixed(control, 1, 10).into(), out.into()];
    let n = [out.len(), usize::from(normal), (from >> 24) as usize, (from & 0xff_ffff) as usize];
    tape.program.kernel(Kernel::Noise, Grid::elements(blocks), &p, &n, &[]);
    out
}

/// Adds the losses of a batch and all gradients of the world model; the posterior states go to `features` [T B, state], the losses to
/// `scalars` [`SCALARS`].
pub fn losses(
    tape: &mut Tape,
    source: Source<'_>,
    sizes: &Sizes,
    inputs: Inputs,
    (scales, imitation, masks): (WorldScales, Option<ImitationScales>, bool),
    (features, scalars): (Matrix, Matrix),
) {
    tape.track(features);
    tape.program.part("gather");
    let images = gather(tape, sizes, inputs.images, inputs, 3);
    let masks = masks.then(|| gather(tape, sizes, inputs.masks, inputs, 1));
    tape.program.part("encode");
    let seen = if sizes.looks { seen(tape, sizes, inputs) } else { images };
    let embeds = encode(tape, source, sizes, seen);
    tape.program.part("scan");
    let pairs = scan(tape, source, sizes, inputs, &embeds, features);
    tape.program.part("decode");
    decoded(tape, source, sizes, inputs, (images, masks, features), scales, scalars);
    tape.program.part("heads");
    other_losses(tape, source, sizes, inputs, &pairs, scales, (features, scalars));
    if let Some(imitation) = imitation {
        tape.program.part("imitate");
        cloning_loss(tape, source, inputs, imitation, (features, scalars));
    }
    tape.run_backward();
}

/// The batch's images as floats [T B 64 64, 3], or masks as bytes.
fn gather(tape: &mut Tape, sizes: &Sizes, from: u64, inputs: Inputs, channels: usize) -> Matrix {
    let rows = sizes.rows();
    let masks = channels == 1;
    let out = if masks { tape.matrix(rows, 1024) } else { tape.matrix(rows * 4096, 3) };
    let fixed = |address: u64| Pointer::from(Matrix::fixed(address, 1, 1));
    let p = [fixed(from), fixed(inputs.index), fixed(inputs.shift), out.into()];
    let n = [rows, sizes.batch, channels, usize::from(masks)];
    tape.program.kernel(Kernel::GatherImages, Grid::elements(rows * 4096 * channels), &p, &n, &[]);
    out
}

/// What the encoders see, as floats [T B 64 64, 3].
fn seen(tape: &mut Tape, sizes: &Sizes, inputs: Inputs) -> Matrix {
    let out = tape.matrix(sizes.rows() * 4096, 3);
    let fixed = |address: u64| Pointer::from(Matrix::fixed(address, 1, 1));
    let p = [inputs.images, inputs.seen, inputs.shift, inputs.colours].map(fixed);
    let p = [&p[..], &[out.into()]].concat();
    let n = [sizes.rows(), sizes.batch];
    tape.program.kernel(Kernel::GatherSeen, Grid::elements(sizes.rows() * 4096), &p, &n, &[]);
    out
}

fn encode(tape: &mut Tape, source: Source<'_>, sizes: &Sizes, images: Matrix) -> Vec<Matrix> {
    let layer = |tape: &mut Tape, x: Matrix, side: usize, name: String, reaches: bool| {
        let (weight, norm) =
            (source.weight(&format!("{name}.conv.weight")), source.norm(&format!("{name}.norm")));
        tape.conv_down(x, side, weight, norm, reaches)
    };
    let flat = |x: Matrix| x.reshape(x.rows / 16, 16 * x.cols);
    match sizes.model.kind {
        ModelKind::Rcwm => {
            let x = layer(tape, images, 64, "encoder.shared.0".into(), false);
            let x = layer(tape, x, 32, "encoder.shared.1".into(), true);
            let mut branch = |name: &str| {
                let x = layer(tape, x, 16, format!("encoder.{name}.0"), true);
                flat(layer(tape, x, 8, format!("encoder.{name}.1"), true))
            };
            ["robot", "environment"].map(&mut branch).to_vec()
        }
        ModelKind::Vanilla => {
            let x = (0..4).fold(images, |x, i| layer(tape, x, 64 >> i, format!("encoder.{i}"), i > 0));
            vec![flat(x)]
        }
    }
}

/// Names of the model's branches, as parameters have them.
#[must_use]
pub fn branch_names(kind: ModelKind) -> &'static [&'static str] {
    match kind {
        ModelKind::Rcwm => &["robot", "environment"],
        ModelKind::Vanilla => &["dynamics"],
    }
}

/// Filters the batch: logits of posterior and prior of each branch, all rows.
fn scan(
    tape: &mut Tape,
    source: Source<'_>,
    sizes: &Sizes,
    inputs: Inputs,
    embeds: &[Matrix],
    features: Matrix,
) -> Vec<(Matrix, Matrix)> {
    let (b, rows, nm) = (sizes.batch, sizes.rows(), sizes.z());
    let draws = sizes.draws();
    let gumbel = (!sizes.mode).then(|| noise(tape, inputs.noise, draws * rows, nm, false, 0));
    let gumbel = move |t: usize, which: usize| {
        let from = (t * draws + which) * b;
        gumbel.map(|gumbel| gumbel.rows(from..from + b))
    };
    let draw = sizes.draw(None);
    let branches: Vec<Branch> = branch_names(sizes.model.kind)
        .iter()
        .map(|name| Branch::new(source, name, &sizes.model).transposed(tape, b))
        .collect();
    let columns: Vec<_> = (0..branches.len()).map(|branch| sizes.columns(branch)).collect();
    let h_of = |branch: usize| features.columns(columns[branch].1.clone());
    let z_of = |branch: usize| features.columns(columns[branch].0.clone());

    // What collects over all rows comes first: backward it is last.
    let initial: Vec<(Matrix, Matrix)> = branches
        .iter()
        .map(|branch| {
            let h = tape.tanh(branch.initial);
            let head = Head::prior(tape, branch, h);
            let logits = head.step(tape, h, 0..1);
            let z = tape.matrix(1, nm);
            tape.draw(logits, None, z, Draw { of_mode: true, ..draw });
            (z, h)
        })
        .collect();
    let rooms: Vec<Recurrence> = branches.iter().map(|branch| Recurrence::new(tape, branch, rows)).collect();
    let posteriors: Vec<Head> = branches
        .iter()
        .enumerate()
        .map(|(at, branch)| {
            let [of_h, of_embed] = branch.posterior;
            let pre = tape.matrix(rows, of_embed.value.rows);
            tape.collect_linear(embeds[at], of_embed, pre);
            tape.linear(embeds[at], of_embed, pre, false);
            tape.linear_back(embeds[at], of_embed, pre);
            Head::new(tape, (of_h, branch.posterior_norm, branch.posterior_logits), h_of(at), Some(pre))
        })
        .collect();
    let interaction = (branches.len() == 2).then(|| {
        let head = Head::prior(tape, &branches[0], h_of(0));
        (head, Interacting::new(tape, source, &sizes.model, b, (rooms[1].input, h_of(0))))
    });
    let actions = Matrix::fixed(inputs.action, rows, sizes.model.action);
    tape.copy(actions, rooms[0].input.columns(nm..nm + sizes.model.action), false, 1.0);

    // What the other lanes see of the robot has gradients of its own: they do not add to what its lane adds to.
    let robot_h = interaction.map(|_| tape.matrix(rows, sizes.model.deter));
    tape.forked(|tape| {
        for t in 0..sizes.length {
            let here = t * b..(t + 1) * b;
            let first = Matrix::fixed(inputs.first, rows, 1).rows(here.clone());
            let at = |x: Matrix| x.rows(here.clone());
            let carry = |tape: &mut Tape, branch: usize, z: Matrix| {
                let carried = |x: Matrix| (t > 0).then(|| x.rows((t - 1) * b..t * b));
                let (z_0, h_0) = initial[branch];
                let before = carried(z_of(branch)).zip(carried(h_of(branch))).map(|(z, h)| [z, h]);
                tape.carry(first, [z_0, h_0], before, [at(z), at(rooms[branch].before())]);
            };
            carry(tape, 0, rooms[0].input.columns(0..nm));
            rooms[0].step(tape, &branches[0], here.clone(), nm, (at(h_of(0)), robot_h.map(at)));
            if let (Some((prior, interaction)), Some(robot_h)) = (&interaction, robot_h) {
                let logits = prior.step(tape, at(robot_h), here.clone());
                tape.draw(logits, gumbel(t, 0), at(interaction.prior_z()), draw);
                tape.beside(|tape| {
                    carry(tape, 1, interaction.z());
                    interaction.step(tape, at(robot_h), here.clone());
                    rooms[1].step(tape, &branches[1], here.clone(), nm, (at(h_of(1)), None));
                    let logits = posteriors[1].step(tape, at(h_of(1)), here.clone());
                    tape.draw(logits, gumbel(t, 2), at(z_of(1)), draw);
                });
            }
            let logits = posteriors[0].step(tape, at(h_of(0)), here.clone());
            tape.draw(logits, gumbel(t, draws.min(2) - 1), at(z_of(0)), draw);
        }
    });
    // Nothing in the scan needs the last branch's prior: its head runs once over all rows.
    let last = branches.len() - 1;
    let head = Head::prior(tape, &branches[last], h_of(last));
    let last_prior = head.step(tape, h_of(last), 0..rows);
    let mut priors: Vec<Matrix> = interaction.iter().map(|(prior, _)| prior.logits).collect();
    priors.push(last_prior);
    posteriors.iter().map(|head| head.logits).zip(priors).collect()
}
