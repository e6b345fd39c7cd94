//! World model, actor and critic on one machine: weights, optimisers, and the programs that update them. Runs that learn together share the
//! programs: each has its own learner, from a thread of its own.

mod bring;
mod programs;
mod rendezvous;
mod runs;
mod values;

use std::sync::Arc;

use crate::machine::{CommandTime, GpuError, Machine, PartTime};
use crate::weights::{Array, Entry};

pub use values::{
    AdamScales, Batch, BehaviourValues, Colours, Images, LearnerSettings, Noise, Seen, WorldValues,
};

use programs::Which;
use rendezvous::Rendezvous;
use runs::Runs;

/// World model, actor and critic of one run on a machine.
#[derive(Debug)]
pub struct Learner {
    rendezvous: Arc<Rendezvous>,
    run: usize,
    entries: Arc<[Entry]>,
}

impl Learner {
    /// A learner for each of the machine's runs, of parameters of these names and shapes, all zero; `bins` are the two-hot bins. Where there are
    /// several, an update waits until all others ask for one, too: each belongs to a thread of its own, and is dropped when its run ends.
    ///
    /// # Errors
    /// [`GpuError`], also where the settings ask for what no program does.
    pub fn new(
        machine: Machine,
        specs: &[(String, Vec<usize>)],
        bins: &[f32],
        settings: LearnerSettings,
    ) -> Result<Vec<Self>, GpuError> {
        let runs = Runs::new(machine, specs, bins, settings)?;
        let (count, entries) = (runs.machine().runs(), Arc::from(runs.entries()));
        let rendezvous = Arc::new(Rendezvous::new(runs));
        let learner = |run| Self { rendezvous: rendezvous.clone(), run, entries: Arc::clone(&entries) };
        Ok((0..count).map(learner).collect())
    }

    /// All parameters, in the order of the arrays.
    #[must_use]
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    #[must_use]
    pub fn settings(&self) -> LearnerSettings {
        self.rendezvous.with(|runs| runs.settings().clone())
    }

    /// The machine's name, and the bytes that all runs take there.
    #[must_use]
    pub fn machine(&self) -> (String, usize) {
        self.rendezvous.with(|runs| (runs.machine().name(), runs.machine().allocated()))
    }

    /// Sets a parameter, a moment or the average, in the trainer's order of numbers.
    pub fn set(&mut self, array: Array, at: usize, values: &[f32]) -> Result<(), GpuError> {
        self.rendezvous.with(|runs| runs.set(self.run, array, at, values))
    }

    /// The numbers of a parameter, a gradient, a moment or the average.
    pub fn get(&mut self, array: Array, at: usize) -> Result<Vec<f32>, GpuError> {
        self.rendezvous.with(|runs| runs.get(self.run, array, at))
    }

    /// Steps that a parameter's optimiser has made.
    #[must_use]
    pub fn steps(&self, at: usize) -> u64 {
        self.rendezvous.with(|runs| runs.steps_mut(self.run)[at])
    }

    /// Says how many steps a parameter's optimiser has made, when a run is resumed.
    pub fn set_steps(&mut self, at: usize, steps: u64) {
        self.rendezvous.with(|runs| runs.steps_mut(self.run)[at] = steps);
    }

    /// The returns' running range, to be set when a run is resumed.
    pub fn set_range(&mut self, range: [f64; 2]) -> Result<(), GpuError> {
        self.rendezvous.with(|runs| runs.set_range(self.run, range))
    }

    /// Puts images, and masks where the settings store them, at places `from` and on of the store, which all runs share.
    pub fn store(&mut self, from: usize, images: &[u8], masks: &[u8]) -> Result<(), GpuError> {
        self.rendezvous.with(|runs| runs.store(from, images, masks))
    }

    /// One update of the world model. `rate` is each parameter's learning rate, by name. The running average follows by the batch's number.
    /// Where a loss or a gradient is not finite, nothing moves.
    pub fn update_world(
        &mut self,
        batch: &Batch<'_>,
        noise: Noise,
        rate: impl Fn(&str) -> f64,
    ) -> Result<WorldValues, GpuError> {
        let which = match batch.environment_alone {
            true => Which::Environment,
            false => Which::World { masks: batch.masks },
        };
        self.rendezvous.with(|runs| runs.bring_world(self.run, (which, batch), noise, rate))?;
        self.rendezvous.launch(self.run, which, |runs| runs.world_values(self.run, which))
    }

    /// The world model's losses of a batch; nothing moves.
    pub fn validate_world(&mut self, batch: &Batch<'_>, noise: Noise) -> Result<WorldValues, GpuError> {
        self.rendezvous.with(|runs| runs.bring_batch(self.run, batch, noise))?;
        let which = Which::Validation;
        self.rendezvous.launch(self.run, which, |runs| runs.world_values(self.run, which))
    }

    /// One update of actor and critic from the posterior states of the last update of the world model, with the noise that follows its.
    ///
    /// # Errors
    /// [`GpuError::Unsupported`] if the learner was made without behaviour, or [`GpuError::Failed`].
    pub fn update_behaviour(&mut self, rate: impl Fn(&str) -> f64) -> Result<BehaviourValues, GpuError> {
        self.rendezvous.with(|runs| runs.bring_behaviour(self.run, rate))?;
        self.rendezvous.launch(self.run, Which::Behaviour, |runs| runs.behaviour_values(self.run))
    }

    /// How long the parts of the last updates' programs take, run command by command: world model, then behaviour. Moves the parameters as
    /// an update does.
    pub fn time_parts(&mut self) -> Result<(Vec<PartTime>, Vec<PartTime>), GpuError> {
        self.rendezvous.with(Runs::time_parts)
    }

    /// How long each kind of command takes by itself: world model, then behaviour. The weights are worth nothing afterwards.
    pub fn time_commands(&mut self) -> Result<(Vec<CommandTime>, Vec<CommandTime>), GpuError> {
        self.rendezvous.with(Runs::time_commands)
    }

    /// Commands of an update of the world model and of behaviour.
    #[must_use]
    pub fn commands(&self) -> (usize, usize) {
        self.rendezvous.with(|runs| runs.commands())
    }

    /// The posterior states of the last batch [T B, state], time-major.
    pub fn features(&mut self) -> Result<Vec<f32>, GpuError> {
        self.rendezvous.with(|runs| runs.features(self.run))
    }

    /// The KL of the robot's branch (0) or the environment's (1) in the last batch, before it is clipped [T B], time-major.
    pub fn kl(&mut self, branch: usize) -> Result<Vec<f32>, GpuError> {
        self.rendezvous.with(|runs| runs.kl(self.run, branch))
    }
}

impl Drop for Learner {
    /// The others no longer wait for this run.
    fn drop(&mut self) {
        self.rendezvous.leave(self.run);
    }
}
