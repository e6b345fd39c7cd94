//! One tick of the policy: image and executed action in, action distribution out.
//!
//! With `z` and `h` carried from the last tick (posterior z, spec section 1):
//!
//! ```text
//! features        = encoder(image)
//! h^R, z_hat^R, z^R = robot(z^R_{t-1}, h^R_{t-1}, a_{t-1}, features, noise)          eq. 5, 6
//! e               = interaction(z_hat^R, h^R, z^E_{t-1})                            eq. 7
//! h^E, z_hat^E, z^E = environment(e, h^E_{t-1}, features, noise)                    eq. 5, 6
//! mean, std       = actor(z^R, h^R, z^E, h^E)
//! ```

mod limits;
mod noise;
mod parts;
mod state;

pub use limits::ActionLimits;
pub use noise::Sampling;
pub use parts::{BranchBuffers, Buffers, Parts};
pub use state::{BranchState, State};

use std::path::Path;
use std::time::Instant;

use rcwm_models::bundle::{Bundle, BundleError, Manifest, PartName};
use rcwm_models::{ACTION_LEN, IMAGE_BYTES};

use crate::engine::{EngineError, EngineSettings};
use noise::NoiseSource;

/// Why there is no policy, or no decision.
#[derive(Debug, thiserror::Error)]
pub enum PolicyError {
    /// The bundle was refused.
    #[error(transparent)]
    Bundle(#[from] BundleError),
    /// An engine could not load or run a part.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// What was observed is not fit for the policy.
    #[error("observation refused: {0}")]
    Observation(String),
    /// A part gave a number that is not finite, or a class that does not exist; the carried state is unchanged.
    #[error("{part} gave a value of {output} that is not finite or not a class")]
    NotFinite {
        /// The part.
        part: PartName,
        /// Its output.
        output: &'static str,
    },
}

/// Stages of a tick that are timed one by one, in the order they run.
pub const STAGES: [PartName; 5] = PartName::REQUIRED;

/// What the policy decided on one observation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Decision {
    /// The action to execute, within the bundle's limits.
    pub action: [f32; ACTION_LEN],
    /// Mean of the action distribution.
    pub mean: [f32; ACTION_LEN],
    /// Its standard deviation.
    pub std: [f32; ACTION_LEN],
    /// Time spent in each of [`STAGES`], in ns.
    pub stage_ns: [u64; STAGES.len()],
}

/// A policy that carries its state from tick to tick.
pub struct Policy {
    manifest: Manifest,
    limits: ActionLimits,
    parts: Parts,
    buffers: Buffers,
    initial: State,
    state: State,
    noise: NoiseSource,
}

impl Policy {
    /// Loads and checks a bundle folder; acts with the mean action.
    ///
    /// # Errors
    /// [`PolicyError::Bundle`] or [`PolicyError::Engine`].
    pub fn load(folder: &Path, engine: EngineSettings) -> Result<Self, PolicyError> {
        Self::new(&Bundle::open(folder)?, engine, Sampling::Mode)
    }

    /// A policy of a checked bundle.
    ///
    /// # Errors
    /// [`PolicyError::Engine`].
    pub fn new(bundle: &Bundle, engine: EngineSettings, sampling: Sampling) -> Result<Self, PolicyError> {
        let model = &bundle.manifest.model;
        let initial = State::from(&bundle.initial);
        let mut policy = Self {
            limits: ActionLimits::of(&bundle.manifest.control),
            parts: Parts::load(bundle, engine)?,
            buffers: Buffers::new(model),
            state: initial.clone(),
            initial,
            noise: NoiseSource::new(sampling, model),
            manifest: bundle.manifest.clone(),
        };
        policy.warm_up(sampling)?;
        Ok(policy)
    }

    /// Runs some ticks on a black image, so that the first real one finds memory and caches ready.
    fn warm_up(&mut self, sampling: Sampling) -> Result<(), PolicyError> {
        let image = vec![0; IMAGE_BYTES];
        for tick in 0..3 {
            match self.observe(&image, &[0.0; ACTION_LEN], tick == 0) {
                // Poisoned weights must not stop a controller that has a fallback: they are reported tick by tick.
                Ok(_) | Err(PolicyError::NotFinite { .. }) => {}
                Err(error) => return Err(error),
            }
        }
        self.noise = NoiseSource::new(sampling, &self.manifest.model);
        self.reset();
        Ok(())
    }

    /// Decides on one observation and carries the state on.
    ///
    /// `image` is 64 x 64 x 3, upright, RGB; `executed_action` is what was executed to get here and is ignored where
    /// `is_first`, which starts from the learned initial state.
    ///
    /// # Errors
    /// [`PolicyError::Observation`], [`PolicyError::Engine`] or [`PolicyError::NotFinite`]; the carried state is then that of
    /// the last good tick.
    pub fn observe(
        &mut self,
        image: &[u8],
        executed_action: &[f32; ACTION_LEN],
        is_first: bool,
    ) -> Result<Decision, PolicyError> {
        if image.len() != IMAGE_BYTES {
            return Err(PolicyError::Observation(format!(
                "the image has {} bytes, expected {IMAGE_BYTES}",
                image.len()
            )));
        }
        if executed_action.iter().any(|x| !x.is_finite()) {
            return Err(PolicyError::Observation(format!(
                "executed action {executed_action:?} is not finite"
            )));
        }
        if is_first {
            self.reset();
        }
        let action = if is_first { [0.0; ACTION_LEN] } else { *executed_action };
        self.noise.draw();
        let stage_ns = self.run_stages(image, &action)?;
        self.state.take_posterior(&self.buffers);
        Ok(self.decide(stage_ns))
    }

    fn run_stages(
        &mut self,
        image: &[u8],
        action: &[f32; ACTION_LEN],
    ) -> Result<[u64; STAGES.len()], PolicyError> {
        let Self { parts, buffers, state, noise, .. } = self;
        let mut stage_ns = [0; STAGES.len()];
        let mut last = Instant::now();
        for (stage, spent) in STAGES.into_iter().zip(&mut stage_ns) {
            match stage {
                PartName::Encoder => parts.run_encoder(image, buffers)?,
                PartName::Robot => parts.run_robot(&state.robot, action, noise.robot(), buffers)?,
                PartName::Interaction => parts.run_interaction(&state.environment, buffers)?,
                PartName::Environment => {
                    parts.run_environment(&state.environment, noise.environment(), buffers)?
                }
                _ => parts.run_actor(buffers)?,
            }
            let now = Instant::now();
            *spent = now.duration_since(last).as_nanos() as u64;
            last = now;
        }
        Ok(stage_ns)
    }

    fn decide(&mut self, stage_ns: [u64; STAGES.len()]) -> Decision {
        let (mean, std) = (self.buffers.mean, self.buffers.std);
        let action = self.limits.clamp(self.noise.action(&mean, &std));
        Decision { action, mean, std, stage_ns }
    }

    /// Goes back to the learned initial state.
    pub fn reset(&mut self) {
        self.state.clone_from(&self.initial);
    }

    /// The state carried into the next tick: posterior z and h of both branches.
    #[must_use]
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Carries on from another state.
    ///
    /// # Errors
    /// [`PolicyError::Observation`] when its sizes are not the model's.
    pub fn set_state(&mut self, state: &State) -> Result<(), PolicyError> {
        if !state.same_sizes(&self.initial) {
            return Err(PolicyError::Observation("the state is of another model's size".into()));
        }
        self.state.clone_from(state);
        Ok(())
    }

    /// Every value of the last tick, for monitoring and for checking.
    #[must_use]
    pub fn buffers(&self) -> &Buffers {
        &self.buffers
    }

    /// Uses this noise in the ticks that follow instead of its own: Gumbel noise `[2, n, m]` of the robot and of the
    /// environment, flat.
    ///
    /// # Errors
    /// [`PolicyError::Observation`] when a length is not `2 n m`.
    pub fn set_noise(&mut self, robot: &[f32], environment: &[f32]) -> Result<(), PolicyError> {
        self.noise.set(robot, environment)
    }

    /// The bundle's manifest.
    #[must_use]
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// The bundle's action limits.
    #[must_use]
    pub fn limits(&self) -> ActionLimits {
        self.limits
    }
}
