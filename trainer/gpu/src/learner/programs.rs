//! What a learner has on its machine: room for batches and results, optimisers, and the programs.

use super::{AdamScales, LearnerSettings};
use crate::behaviour::{self, Sources};
use crate::layers::Source;
use crate::machine::{GpuError, Kernel, Machine, Ready};
use crate::program::{Arena, Grid, Matrix, Pointer, Program};
use crate::tape::Tape;
use crate::weights::{Array, Group, Weights};
use crate::world::{self, Inputs, Sizes};

/// One of a learner's programs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Which {
    World { masks: bool },
    Environment,
    Validation,
    Behaviour,
}

/// An optimiser's place on the machine.
#[derive(Debug, Clone, Copy)]
pub(super) struct Optimiser {
    /// The first and the last of the groups that it moves, which lie one after the other.
    pub(super) groups: (Group, Group),
    pub(super) scales: AdamScales,
    pub(super) table: u64,
    pub(super) clip: u64,
}

/// Room that is uploaded and downloaded.
#[derive(Debug, Clone, Copy)]
pub(super) struct Room {
    pub(super) inputs: Inputs,
    pub(super) batch_images: u64,
    pub(super) batch_masks: u64,
    pub(super) features: Matrix,
    pub(super) scalars: Matrix,
    pub(super) behaviour_scalars: Matrix,
    pub(super) range: Matrix,
    pub(super) keep: u64,
    /// Whether a run is changed by the next program (u32).
    pub(super) taking_part: u64,
}

/// The programs of a learner.
#[derive(Debug)]
pub(super) struct Programs {
    pub(super) world: Ready,
    pub(super) masked: Ready,
    pub(super) validation: Ready,
    /// The environment's side, with the actor where it has a part in the loss.
    pub(super) environment: Option<Ready>,
    pub(super) behaviour: Option<Ready>,
}

fn is_world(name: &str) -> bool {
    !(name.starts_with("actor.") || is_critic(name) || name.starts_with("slow_critic."))
}

/// What knows the scene and the task, and not the robot: as the trainer's sides have it.
fn is_environment(name: &str) -> bool {
    ["environment.", "interaction.", "heads.", "encoder.environment.", "decoder.environment."]
        .iter()
        .any(|side| name.starts_with(side))
}

/// Whether an update of the world model moves a parameter; `imitates`: and the actor.
pub(super) fn moves(which: Which, imitates: bool) -> fn(&str) -> bool {
    match (which, imitates) {
        (Which::Environment, false) => is_environment,
        (Which::Environment, true) => |name| is_environment(name) || is_actor(name),
        (Which::World { .. }, false) => is_world,
        (Which::World { .. }, true) => |name| is_world(name) || is_actor(name),
        (Which::Validation | Which::Behaviour, _) => |_| false,
    }
}

fn is_actor(name: &str) -> bool {
    name.starts_with("actor.")
}

fn is_critic(name: &str) -> bool {
    name.starts_with("critic.")
}

pub(super) fn check(settings: &LearnerSettings) -> Result<(), GpuError> {
    let Sizes { model, length, decode_every, .. } = &settings.sizes;
    let refuse = |text: String| Err(GpuError::Unsupported(text));
    if *decode_every == 0 || !length.is_multiple_of(*decode_every) {
        return refuse(format!(
            "world.decode_every = {decode_every} does not divide replay.length = {length}, as updates on a GPU need"
        ));
    }
    for (name, found, taken) in
        [("image_side", model.image_side, 64), ("cameras", model.cameras, 1), ("state", model.state, 0)]
    {
        if found != taken {
            return refuse(format!(
                "model.{name} = {found}; updates on a GPU take {taken} so far, leave --device out to run on the CPU"
            ));
        }
    }
    if !model.cnn_depth.is_multiple_of(4) {
        return refuse(format!(
            "model.cnn_depth = {}; updates on a GPU take a multiple of 4, or run on the CPU",
            model.cnn_depth
        ));
    }
    if model.classes > 32 || model.categoricals > 64 {
        return refuse(format!(
            "{} categoricals of {} classes; updates on a GPU take at most 64 of 32",
            model.categoricals, model.classes
        ));
    }
    let rows = [model.categoricals, model.classes, model.interaction_rows()];
    if settings.sizes.branches() == 2 && rows.iter().any(|rows| !rows.is_multiple_of(4)) {
        return refuse(format!(
            "{} categoricals of {} classes and a width of {}; on a GPU the interaction takes multiples of 4 rows (categoricals, \
             classes, width / classes)",
            model.categoricals, model.classes, model.deter
        ));
    }
    if settings.behaviour.is_some_and(|(scales, ..)| scales.length < 2) {
        return refuse("behaviour.horizon.length must be at least 2".to_owned());
    }
    Ok(())
}

impl Room {
    pub(super) fn new(machine: &mut Machine, settings: &LearnerSettings) -> Result<Self, GpuError> {
        let sizes = &settings.sizes;
        let rows = sizes.rows();
        let stored = settings.stored_images > 0;
        let images = if stored { settings.stored_images } else { rows };
        let masks = if !stored || settings.stored_masks { images } else { 1 };
        // What the encoders see lies behind a batch's own images.
        let images = if sizes.looks && !stored { 2 * images } else { images };
        let sizes_of = [images * 12288, masks * 4096];
        let [images, masks] = if stored {
            [machine.allocate_shared(sizes_of[0])?, machine.allocate_shared(sizes_of[1])?]
        } else {
            [machine.allocate(sizes_of[0])?, machine.allocate(sizes_of[1])?]
        };
        let mut words = |count: usize| machine.allocate(4 * count);
        let inputs = Inputs {
            images,
            masks,
            index: words(rows)?,
            seen: words(rows)?,
            colours: words(8 * sizes.batch)?,
            shift: words(2 * sizes.batch)?,
            action: words(rows * sizes.model.action)?,
            reward: words(rows)?,
            terminal: words(rows)?,
            first: words(rows)?,
            decoded: words(rows)?,
            noise: words(10)?,
            kl: words(2 * rows)?,
            demonstrated: words(rows * sizes.model.action)?,
            counts: words(rows)?,
        };
        Ok(Self {
            inputs,
            batch_images: images,
            batch_masks: masks,
            features: Matrix::fixed(words(rows * sizes.state())?, rows, sizes.state()),
            scalars: Matrix::fixed(words(world::SCALARS)?, 1, world::SCALARS),
            behaviour_scalars: Matrix::fixed(words(behaviour::SCALARS)?, 1, behaviour::SCALARS),
            range: Matrix::fixed(words(2)?, 1, 2),
            keep: words(1)?,
            taking_part: words(1)?,
        })
    }
}

impl Programs {
    pub(super) fn new(
        machine: &mut Machine,
        weights: &Weights,
        settings: &LearnerSettings,
        room: Room,
        optimisers: &[Optimiser],
    ) -> Result<Self, GpuError> {
        let imitates = settings.imitation.is_some();
        let world = |which: Which| {
            let (learns, masks) = (which != Which::Validation, which == Which::World { masks: true });
            let mut tape = Tape::default();
            let trains = moves(which, imitates);
            // Validation is of what a checkpoint holds.
            let averaged = !learns && settings.average_decay > 0.0;
            let array = if averaged { Array::Average } else { Array::Values };
            let source = Source { weights, trains, array };
            if learns {
                tape.program.part("optimiser");
                tape.zero(weights.groups(Array::Gradients, optimisers[0].groups));
            }
            let parts = (settings.world, settings.imitation.filter(|_| learns), masks);
            let out = (room.features, room.scalars);
            if learns {
                world::losses(&mut tape, source, &settings.sizes, room.inputs, parts, out);
                let average = (settings.average_decay > 0.0).then_some(room.keep);
                step(&mut tape, weights, &optimisers[..1], (room.scalars, room.taking_part), average);
            } else {
                let sizes = &settings.sizes;
                tape.without_gradient(|tape| world::losses(tape, source, sizes, room.inputs, parts, out));
            }
            tape.program
        };
        let behaviour = settings.behaviour.map(|(scales, ..)| {
            let mut tape = Tape::default();
            tape.program.part("optimiser");
            for group in [Group::Actor, Group::Critic] {
                tape.zero(weights.group(Array::Gradients, group));
            }
            let values = |group| weights.group(Array::Values, group);
            let (critic, slow) = (values(Group::Critic), values(Group::SlowCritic));
            let taking_part = Matrix::fixed(room.taking_part, 1, 1);
            let p = [critic, slow, taking_part].map(Pointer::from);
            tape.program.kernel(
                Kernel::Mix,
                Grid::elements(critic.len()),
                &p,
                &[critic.len()],
                &[scales.slow_share],
            );
            let source = |trains: fn(&str) -> bool| Source { weights, trains, array: Array::Values };
            let sources =
                Sources { frozen: source(|_| false), actor: source(is_actor), critic: source(is_critic) };
            let noise = (room.inputs.noise, settings.sizes.words());
            let out = (room.range, room.behaviour_scalars, taking_part);
            behaviour::losses(&mut tape, sources, &settings.sizes, &scales, room.features, noise, out);
            step(&mut tape, weights, &optimisers[1..], (room.behaviour_scalars, room.taking_part), None);
            tape.program
        });
        let programs: Vec<Program> =
            [Which::World { masks: false }, Which::World { masks: true }, Which::Validation]
                .into_iter()
                .chain(settings.in_stages.then_some(Which::Environment))
                .map(world)
                .chain(behaviour)
                .collect();
        let layouts: Vec<_> = programs.iter().map(Program::layout).collect();
        let bytes = layouts.iter().map(|(_, bytes)| *bytes).max().unwrap_or_default();
        let arena = Arena::new(machine, bytes)?;
        let mut ready = programs
            .into_iter()
            .zip(layouts)
            .map(|(program, (offsets, bytes))| machine.prepare(program.finish(&offsets, bytes, &arena)));
        let mut next = || ready.next().expect("there are as many as were built");
        let (world, masked, validation) = (next()?, next()?, next()?);
        let environment = settings.in_stages.then(&mut next).transpose()?;
        Ok(Self { world, masked, validation, environment, behaviour: ready.next().transpose()? })
    }
}

/// Adds the clipping by their norms and one step of Adam for optimisers whose clips lie one after the other: all move, or none does.
fn step(
    tape: &mut Tape,
    weights: &Weights,
    optimisers: &[Optimiser],
    (scalars, taking_part): (Matrix, u64),
    keep: Option<u64>,
) {
    const RUN: usize = 16_384;
    tape.program.part("optimiser");
    let clip = |optimiser: &Optimiser| Matrix::fixed(optimiser.clip, 1, 2);
    for optimiser in optimisers {
        let gradient = weights.groups(Array::Gradients, optimiser.groups);
        let (count, blocks) = (gradient.len(), gradient.len().div_ceil(RUN));
        let partial = tape.matrix(1, blocks);
        let grid = Grid { blocks, threads: 512, shared_bytes: 0 };
        tape.program.kernel(Kernel::Squares, grid, &[gradient.into(), partial.into()], &[count, RUN], &[]);
        let p = [partial, scalars, clip(optimiser), Matrix::fixed(taking_part, 1, 1)].map(Pointer::from);
        let grid = Grid { blocks: 1, threads: 512, shared_bytes: 0 };
        let most = optimiser.scales.clip_norm;
        tape.program.kernel(Kernel::Clip, grid, &p, &[blocks, scalars.len()], &[most]);
    }
    let fixed = |address: u64| Pointer::from(Matrix::fixed(address, 1, 1));
    for optimiser in optimisers {
        let Optimiser { groups, scales, table, .. } = *optimiser;
        let array = |array: Array| weights.groups(array, groups);
        let count = array(Array::Values).len();
        let arrays =
            [Array::Values, Array::First, Array::Second, Array::Gradients].map(|a| Pointer::from(array(a)));
        let average = keep.map_or([Pointer::NULL; 2], |keep| [array(Array::Average).into(), fixed(keep)]);
        let own = [clip(optimiser).into(), fixed(weights.owners(groups.0)), fixed(table)];
        let all = fixed(optimisers[0].clip);
        let p = [&arrays[..], &own, &average, &[all]].concat();
        let f = [scales.beta1 as f32, scales.beta2 as f32, scales.eps];
        tape.program.kernel(Kernel::Adam, Grid::elements(count), &p, &[count, optimisers.len()], &f);
    }
}
