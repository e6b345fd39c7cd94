//! The memory and programs of all runs that learn together.

use super::programs::{Optimiser, Programs, Room, Which, check, moves};
use super::values::{BehaviourValues, LearnerSettings, WorldValues};
use crate::behaviour;
use crate::machine::{CommandTime, GpuError, Machine, PartTime, Ready};
use crate::program::Matrix;
use crate::weights::{Array, Entry, Group, Weights};
use crate::world;

/// World models, actors and critics on a machine: one of each for every run.
#[derive(Debug)]
pub(super) struct Runs {
    pub(super) machine: Machine,
    pub(super) weights: Weights,
    pub(super) settings: LearnerSettings,
    pub(super) room: Room,
    pub(super) optimisers: Vec<Optimiser>,
    /// Steps of every parameter's optimiser, by run, in the weights' order.
    pub(super) steps: Vec<Vec<u64>>,
    /// Which runs the last program moved.
    taking_part: Vec<bool>,
    pub(super) programs: Programs,
}

impl Runs {
    pub(super) fn new(
        mut machine: Machine,
        specs: &[(String, Vec<usize>)],
        bins: &[f32],
        settings: LearnerSettings,
    ) -> Result<Self, GpuError> {
        check(&settings)?;
        let weights = Weights::new(&mut machine, specs, bins, settings.sizes.model.deter)?;
        let room = Room::new(&mut machine, &settings)?;
        let mut optimisers = Vec::new();
        let last = if settings.imitation.is_some() { Group::Actor } else { Group::World };
        let mut wanted = vec![((Group::World, last), settings.world_adam)];
        if let Some((_, actor, critic)) = settings.behaviour {
            wanted.extend([((Group::Actor, Group::Actor), actor), ((Group::Critic, Group::Critic), critic)]);
        }
        let clips = machine.allocate(8 * wanted.len())?;
        for (at, (groups, scales)) in wanted.into_iter().enumerate() {
            let table = machine.allocate(8 * weights.entries().len())?;
            optimisers.push(Optimiser { groups, scales, table, clip: clips + 8 * at as u64 });
        }
        let programs = Programs::new(&mut machine, &weights, &settings, room, &optimisers)?;
        let runs = machine.runs();
        let steps = vec![vec![0; weights.entries().len()]; runs];
        let taking_part = vec![false; runs];
        Ok(Self { machine, weights, settings, room, optimisers, steps, taking_part, programs })
    }

    pub(super) fn entries(&self) -> &[Entry] {
        self.weights.entries()
    }

    pub(super) fn settings(&self) -> &LearnerSettings {
        &self.settings
    }

    pub(super) fn machine(&self) -> &Machine {
        &self.machine
    }

    pub(super) fn set(
        &mut self,
        run: usize,
        array: Array,
        at: usize,
        values: &[f32],
    ) -> Result<(), GpuError> {
        let Self { machine, weights, .. } = self;
        weights.set(machine, (array, run), &weights.entries()[at], values)
    }

    pub(super) fn get(&mut self, run: usize, array: Array, at: usize) -> Result<Vec<f32>, GpuError> {
        let Self { machine, weights, .. } = self;
        weights.get(machine, (array, run), &weights.entries()[at])
    }

    pub(super) fn steps_mut(&mut self, run: usize) -> &mut [u64] {
        &mut self.steps[run]
    }

    pub(super) fn set_range(&mut self, run: usize, range: [f64; 2]) -> Result<(), GpuError> {
        self.machine.upload(address(self.room.range), run, &range.map(|x| x as f32))
    }

    pub(super) fn store(&mut self, from: usize, images: &[u8], masks: &[u8]) -> Result<(), GpuError> {
        let image = 64 * 64 * 3;
        let count = images.len() / image;
        if from + count > self.settings.stored_images || (!masks.is_empty() && masks.len() != count * 4096) {
            return Err(GpuError::Unsupported(format!(
                "images {from} to {} do not fit a store of {}",
                from + count,
                self.settings.stored_images
            )));
        }
        self.machine.upload(self.room.inputs.images + (from * image) as u64, 0, images)?;
        if self.settings.stored_masks && !masks.is_empty() {
            self.machine.upload(self.room.inputs.masks + (from * 4096) as u64, 0, masks)?;
        }
        Ok(())
    }

    /// Runs a program; only the runs that take part are changed by it.
    pub(super) fn launch(&mut self, which: Which, taking_part: Vec<bool>) -> Result<(), GpuError> {
        let Self { machine, room, .. } = self;
        for (run, takes_part) in taking_part.iter().enumerate() {
            if self.taking_part[run] != *takes_part {
                machine.upload(room.taking_part, run, &[u32::from(*takes_part)])?;
            }
        }
        self.taking_part = taking_part;
        let program = match which {
            Which::World { masks: false } => Some(&self.programs.world),
            Which::World { masks: true } => Some(&self.programs.masked),
            Which::Environment => self.programs.environment.as_ref(),
            Which::Validation => Some(&self.programs.validation),
            Which::Behaviour => self.programs.behaviour.as_ref(),
        };
        let Some(program) = program else {
            return Err(GpuError::Unsupported(format!(
                "this learner was made without programs for {which:?}"
            )));
        };
        self.machine.run(program)
    }

    /// What the last update of a run's actor and critic was.
    pub(super) fn behaviour_values(&mut self, run: usize) -> Result<BehaviourValues, GpuError> {
        let mut scalars = [0f32; behaviour::SCALARS];
        self.machine.download(address(self.room.behaviour_scalars), run, &mut scalars)?;
        let mut range = [0f32; 2];
        self.machine.download(address(self.room.range), run, &mut range)?;
        let [actor_loss, critic_loss, entropy, reward, lambda_return, value] = scalars.map(f64::from);
        let mut clips = [[0f32; 2]; 2];
        self.machine.download(self.optimisers[1].clip, run, clips.as_flattened_mut())?;
        let [actor_gradient_norm, critic_gradient_norm] = clips.map(|clip| f64::from(clip[0]));
        let moved = clips.iter().all(|clip| clip[1] != 0.0);
        let values = BehaviourValues {
            actor_loss,
            critic_loss,
            actor_gradient_norm,
            critic_gradient_norm,
            entropy,
            reward,
            lambda_return,
            value,
            range: range.map(f64::from),
            moved,
        };
        if moved {
            for group in [Group::Actor, Group::Critic] {
                self.count_steps(run, |entry| entry.group == group);
            }
        }
        Ok(values)
    }

    pub(super) fn time_parts(&mut self) -> Result<(Vec<PartTime>, Vec<PartTime>), GpuError> {
        let world = self.machine.time_parts(&self.programs.world)?;
        let behaviour = self.programs.behaviour.as_ref().map(|program| self.machine.time_parts(program));
        Ok((world, behaviour.transpose()?.unwrap_or_default()))
    }

    pub(super) fn time_commands(&mut self) -> Result<(Vec<CommandTime>, Vec<CommandTime>), GpuError> {
        let world = self.machine.time_commands(&self.programs.world)?;
        let behaviour = self.programs.behaviour.as_ref().map(|program| self.machine.time_commands(program));
        Ok((world, behaviour.transpose()?.unwrap_or_default()))
    }

    pub(super) fn commands(&self) -> (usize, usize) {
        (self.programs.world.commands(), self.programs.behaviour.as_ref().map_or(0, Ready::commands))
    }

    pub(super) fn features(&mut self, run: usize) -> Result<Vec<f32>, GpuError> {
        let mut features = vec![0.0; self.room.features.len()];
        self.machine.download(address(self.room.features), run, &mut features)?;
        Ok(features)
    }

    pub(super) fn kl(&mut self, run: usize, branch: usize) -> Result<Vec<f32>, GpuError> {
        let rows = self.settings.sizes.rows();
        let mut kl = vec![0.0; rows];
        self.machine.download(self.room.inputs.kl + (4 * branch.min(1) * rows) as u64, run, &mut kl)?;
        Ok(kl)
    }

    fn count_steps(&mut self, run: usize, moved: impl Fn(&Entry) -> bool) {
        for (steps, entry) in self.steps[run].iter_mut().zip(self.weights.entries()) {
            *steps += u64::from(moved(entry));
        }
    }

    /// What the last update of a run's world model was, or its validation.
    pub(super) fn world_values(&mut self, run: usize, which: Which) -> Result<WorldValues, GpuError> {
        let masks = which == Which::World { masks: true };
        let mut scalars = [0f32; world::SCALARS];
        self.machine.download(address(self.room.scalars), run, &mut scalars)?;
        let mut clip = [0f32; 2];
        self.machine.download(self.optimisers[0].clip, run, &mut clip)?;
        let [image, mask, reward, continues, first, first_floored, second, second_floored, cloning] =
            scalars.map(f64::from);
        let scales = self.settings.world;
        let factor = f64::from(scales.dynamics) + f64::from(scales.representation);
        let mut total = f64::from(scales.image) * image
            + f64::from(scales.reward) * reward
            + f64::from(scales.continues) * continues
            + factor * first_floored;
        if self.settings.sizes.branches() == 2 {
            total += factor * second_floored;
        }
        if masks {
            total += f64::from(scales.mask) * mask;
        }
        let imitation = self.settings.imitation.filter(|_| which != Which::Validation);
        total += imitation.map_or(0.0, |imitation| f64::from(imitation.scale) * cloning);
        let robot_mask = masks.then_some(mask);
        let updated = which != Which::Validation;
        let gradient_norm = if updated { f64::from(clip[0]) } else { 0.0 };
        let moved = updated && clip[1] != 0.0;
        if moved {
            let moves = moves(which, self.settings.imitation.is_some());
            self.count_steps(run, |entry| moves(&entry.name));
        }
        Ok(WorldValues {
            image,
            robot_mask,
            reward,
            continues,
            kl: [first, second],
            cloning: imitation.map(|_| cloning),
            total,
            gradient_norm,
            moved,
        })
    }
}

fn address(matrix: Matrix) -> u64 {
    match matrix.place {
        crate::program::Buffer::Fixed(address) => address,
        crate::program::Buffer::Transient(_) => unreachable!("a room has fixed places alone"),
    }
}
