//! World model, actor and critic on one machine: weights, optimisers, and the programs that update them.

mod programs;
mod values;

use crate::behaviour;
use crate::machine::{CommandTime, GpuError, Machine, PartTime, Ready};
use crate::program::Matrix;
use crate::weights::{Array, Group, Weights};
use crate::world;

pub use values::{AdamScales, Batch, BehaviourValues, Images, LearnerSettings, Noise, WorldValues};

use programs::{Optimiser, Programs, Room, check};

/// World model, actor and critic on a machine.
#[derive(Debug)]
pub struct Learner {
    machine: Machine,
    weights: Weights,
    settings: LearnerSettings,
    room: Room,
    optimisers: Vec<Optimiser>,
    /// Steps of every parameter's optimiser, in the weights' order.
    steps: Vec<u64>,
    programs: Programs,
}

impl Learner {
    /// A learner of parameters of these names and shapes, all zero; `bins` are the two-hot bins.
    ///
    /// # Errors
    /// [`GpuError`], also where the settings ask for what no program does.
    pub fn new(
        mut machine: Machine,
        specs: &[(String, Vec<usize>)],
        bins: &[f32],
        settings: LearnerSettings,
    ) -> Result<Self, GpuError> {
        check(&settings)?;
        let weights = Weights::new(&mut machine, specs, bins, settings.sizes.model.deter)?;
        let room = Room::new(&mut machine, &settings)?;
        let mut optimisers = Vec::new();
        let mut wanted = vec![(Group::World, settings.world_adam)];
        if let Some((_, actor, critic)) = settings.behaviour {
            wanted.extend([(Group::Actor, actor), (Group::Critic, critic)]);
        }
        let clips = machine.allocate(8 * wanted.len())?;
        for (at, (group, scales)) in wanted.into_iter().enumerate() {
            let table = machine.allocate(8 * weights.entries().len())?;
            optimisers.push(Optimiser { group, scales, table, clip: clips + 8 * at as u64 });
        }
        let programs = Programs::new(&mut machine, &weights, &settings, room, &optimisers)?;
        let steps = vec![0; weights.entries().len()];
        Ok(Self { machine, weights, settings, room, optimisers, steps, programs })
    }

    /// The parameters and everything beside them.
    #[must_use]
    pub fn weights(&self) -> &Weights {
        &self.weights
    }

    #[must_use]
    pub fn settings(&self) -> &LearnerSettings {
        &self.settings
    }

    /// Where it runs.
    #[must_use]
    pub fn machine(&self) -> &Machine {
        &self.machine
    }

    /// Sets a parameter, a moment or the average, in the trainer's order of numbers.
    pub fn set(&mut self, array: Array, at: usize, values: &[f32]) -> Result<(), GpuError> {
        let Self { machine, weights, .. } = self;
        weights.set(machine, array, &weights.entries()[at], values)
    }

    /// The numbers of a parameter, a gradient, a moment or the average.
    pub fn get(&mut self, array: Array, at: usize) -> Result<Vec<f32>, GpuError> {
        let Self { machine, weights, .. } = self;
        weights.get(machine, array, &weights.entries()[at])
    }

    /// Steps of every parameter's optimiser, in the weights' order.
    pub fn steps_mut(&mut self) -> &mut [u64] {
        &mut self.steps
    }

    /// The returns' running range, to be set when a run is resumed.
    pub fn set_range(&mut self, range: [f64; 2]) -> Result<(), GpuError> {
        let address = address(self.room.range);
        self.machine.upload(address, &range.map(|x| x as f32))
    }

    /// Puts images, and masks where the settings store them, at places `from` and on of the store.
    pub fn store(&mut self, from: usize, images: &[u8], masks: &[u8]) -> Result<(), GpuError> {
        let image = 64 * 64 * 3;
        let count = images.len() / image;
        if from + count > self.settings.stored_images || (!masks.is_empty() && masks.len() != count * 4096) {
            return Err(GpuError::Unsupported(format!(
                "images {from} to {} do not fit a store of {}",
                from + count,
                self.settings.stored_images
            )));
        }
        self.machine.upload(self.room.inputs.images + (from * image) as u64, images)?;
        if self.settings.stored_masks && !masks.is_empty() {
            self.machine.upload(self.room.inputs.masks + (from * 4096) as u64, masks)?;
        }
        Ok(())
    }

    /// One update of the world model. `rate` is each parameter's learning rate, by name. The running average follows by the batch's number.
    /// Where a loss or a gradient is not finite, nothing moves.
    pub fn update_world(
        &mut self,
        batch: &Batch<'_>,
        noise: Noise,
        rate: impl Fn(&str) -> f64,
    ) -> Result<WorldValues, GpuError> {
        self.upload(batch, noise)?;
        self.upload_rates(0, rate)?;
        let number = batch.number as f64 + 1.0;
        // The average begins as the weights after the first update.
        let keep = if number > 1.0 {
            self.settings.average_decay.min((1.0 + number) / (10.0 + number))
        } else {
            0.0
        };
        self.machine.upload(self.room.keep, &[keep as f32])?;
        let program = if batch.masks { &self.programs.masked } else { &self.programs.world };
        self.machine.run(program)?;
        let values = self.world_values(batch.masks)?;
        if values.moved {
            self.count_step(0);
        }
        Ok(values)
    }

    /// The world model's losses of a batch; nothing moves.
    pub fn validate_world(&mut self, batch: &Batch<'_>, noise: Noise) -> Result<WorldValues, GpuError> {
        self.upload(batch, noise)?;
        self.machine.run(&self.programs.validation)?;
        let values = self.world_values(false)?;
        Ok(WorldValues { gradient_norm: 0.0, ..values })
    }

    /// One update of actor and critic from the posterior states of the last update of the world model, with the noise that follows its.
    ///
    /// # Errors
    /// [`GpuError::Unsupported`] if the learner was made without behaviour, or [`GpuError::Failed`].
    pub fn update_behaviour(&mut self, rate: impl Fn(&str) -> f64) -> Result<BehaviourValues, GpuError> {
        self.upload_rates(1, &rate)?;
        self.upload_rates(2, &rate)?;
        let Some(program) = &self.programs.behaviour else {
            return Err(GpuError::Unsupported("this learner was made without actor and critic".to_owned()));
        };
        self.machine.run(program)?;
        let mut scalars = [0f32; behaviour::SCALARS];
        self.machine.download(address(self.room.behaviour_scalars), &mut scalars)?;
        let mut range = [0f32; 2];
        self.machine.download(address(self.room.range), &mut range)?;
        let [actor_loss, critic_loss, entropy, reward, lambda_return, value] = scalars.map(f64::from);
        let mut clips = [[0f32; 2]; 2];
        self.machine.download(self.optimisers[1].clip, clips.as_flattened_mut())?;
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
            self.count_step(1);
            self.count_step(2);
        }
        Ok(values)
    }

    /// How long the parts of the last updates' programs take, run command by command: world model, then behaviour. Moves the parameters as
    /// an update does.
    pub fn time_parts(&mut self) -> Result<(Vec<PartTime>, Vec<PartTime>), GpuError> {
        let world = self.machine.time_parts(&self.programs.world)?;
        let behaviour = self.programs.behaviour.as_ref().map(|program| self.machine.time_parts(program));
        Ok((world, behaviour.transpose()?.unwrap_or_default()))
    }

    /// How long each kind of command takes by itself: world model, then behaviour. The weights are worth nothing afterwards.
    pub fn time_commands(&mut self) -> Result<(Vec<CommandTime>, Vec<CommandTime>), GpuError> {
        let world = self.machine.time_commands(&self.programs.world)?;
        let behaviour = self.programs.behaviour.as_ref().map(|program| self.machine.time_commands(program));
        Ok((world, behaviour.transpose()?.unwrap_or_default()))
    }

    /// Commands of an update of the world model and of behaviour.
    #[must_use]
    pub fn commands(&self) -> (usize, usize) {
        (self.programs.world.commands(), self.programs.behaviour.as_ref().map_or(0, Ready::commands))
    }

    /// The posterior states of the last batch [T B, state], time-major.
    pub fn features(&mut self) -> Result<Vec<f32>, GpuError> {
        let mut features = vec![0.0; self.room.features.len()];
        self.machine.download(address(self.room.features), &mut features)?;
        Ok(features)
    }

    /// The KL of the robot's branch (0) or the environment's (1) in the last batch, before it is clipped [T B], time-major.
    pub fn kl(&mut self, branch: usize) -> Result<Vec<f32>, GpuError> {
        let rows = self.settings.sizes.rows();
        let mut kl = vec![0.0; rows];
        self.machine.download(self.room.inputs.kl + (4 * branch.min(1) * rows) as u64, &mut kl)?;
        Ok(kl)
    }

    fn count_step(&mut self, which: usize) {
        let group = self.optimisers[which].group;
        for (steps, entry) in self.steps.iter_mut().zip(self.weights.entries()) {
            *steps += u64::from(entry.group == group);
        }
    }

    fn upload_rates(&mut self, which: usize, rate: impl Fn(&str) -> f64) -> Result<(), GpuError> {
        let Some(Optimiser { scales, table, .. }) = self.optimisers.get(which).copied() else {
            return Ok(());
        };
        let row = |(entry, steps): (&crate::weights::Entry, &u64)| {
            let number = (*steps + 1).min(1 << 30) as i32;
            let corrections = [scales.beta1, scales.beta2].map(|beta| 1.0 - beta.powi(number));
            [(rate(&entry.name) / corrections[0]) as f32, (1.0 / corrections[1]) as f32]
        };
        let rows: Vec<f32> = self.weights.entries().iter().zip(&self.steps).flat_map(row).collect();
        self.machine.upload(table, &rows)
    }

    fn upload(&mut self, batch: &Batch<'_>, noise: Noise) -> Result<(), GpuError> {
        let sizes = &self.settings.sizes;
        let (b, t) = (sizes.batch, sizes.length);
        let (rows, action) = (b * t, sizes.model.action);
        let fits = batch.action.len() == rows * action
            && [batch.reward.len(), batch.terminal.len(), batch.first.len()] == [rows; 3]
            && (batch.shift.is_empty() || batch.shift.len() == b);
        if !fits {
            return Err(GpuError::Unsupported(format!("the batch is not one of {b} sequences of {t} steps")));
        }
        // Row t * B + b is step t of sequence b.
        let from = |row: usize| row % b * t + row / b;
        let begins = |row: usize| row < b || batch.first[from(row)];
        let flags: Vec<u32> = (0..rows).map(|row| u32::from(begins(row))).collect();
        let mut actions = vec![0.0; rows * action];
        for row in (0..rows).filter(|row| !begins(*row)) {
            for (to, x) in
                actions[row * action..][..action].iter_mut().zip(&batch.action[from(row) * action..])
            {
                *to = x / x.abs().max(1.0);
            }
        }
        let reward: Vec<f32> = (0..rows).map(|row| batch.reward[from(row)]).collect();
        let terminal: Vec<f32> =
            (0..rows).map(|row| f32::from(u8::from(batch.terminal[from(row)]))).collect();
        let every = sizes.decode_every as u64;
        let decoded: Vec<u32> = (0..rows as u32)
            .filter(|row| (u64::from(*row) / b as u64 + batch.number).is_multiple_of(every))
            .collect();
        let mut control = [0u32; 10];
        for (word, bytes) in control.iter_mut().zip(noise.key.as_chunks::<4>().0) {
            *word = u32::from_le_bytes(*bytes);
        }
        [control[8], control[9]] = [noise.stream as u32, (noise.stream >> 32) as u32];
        let shift = if batch.shift.is_empty() { vec![[0; 2]; b] } else { batch.shift.to_vec() };

        let Room { inputs, batch_images, batch_masks, .. } = self.room;
        let index: Vec<u32> = match batch.images {
            Images::Stored(places)
                if places.len() == rows
                    && places.iter().all(|place| (*place as usize) < self.settings.stored_images)
                    && (!batch.masks || self.settings.stored_masks) =>
            {
                (0..rows).map(|row| places[from(row)]).collect()
            }
            Images::Host(images, masks)
                if images.len() == rows * 12288
                    && self.settings.stored_images == 0
                    && (!batch.masks || masks.len() == rows * 4096) =>
            {
                self.machine.upload(batch_images, images)?;
                if batch.masks {
                    self.machine.upload(batch_masks, masks)?;
                }
                (0..rows).map(|row| from(row) as u32).collect()
            }
            _ => {
                return Err(GpuError::Unsupported(
                    "the batch's images are not where they are expected".to_owned(),
                ));
            }
        };
        let machine = &mut self.machine;
        machine.upload(inputs.index, &index)?;
        machine.upload(inputs.shift, &shift)?;
        machine.upload(inputs.action, &actions)?;
        machine.upload(inputs.reward, &reward)?;
        machine.upload(inputs.terminal, &terminal)?;
        machine.upload(inputs.first, &flags)?;
        machine.upload(inputs.decoded, &decoded)?;
        machine.upload(inputs.noise, &control)
    }

    fn world_values(&mut self, masks: bool) -> Result<WorldValues, GpuError> {
        let mut scalars = [0f32; world::SCALARS];
        self.machine.download(address(self.room.scalars), &mut scalars)?;
        let mut clip = [0f32; 2];
        self.machine.download(self.optimisers[0].clip, &mut clip)?;
        let [image, mask, reward, continues, first, first_floored, second, second_floored] =
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
        let robot_mask = masks.then_some(mask);
        let gradient_norm = f64::from(clip[0]);
        let moved = clip[1] != 0.0;
        Ok(WorldValues {
            image,
            robot_mask,
            reward,
            continues,
            kl: [first, second],
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
