//! One tick of the policy: observation and executed action in, action out.
//!
//! `sequential` runs the exported parts as they are, `compiled` their segments, which work ahead of the image, `recurrent` a policy in one
//! graph. Kind `dreamer` has `dynamics` in place of robot, interaction and environment. Of kind `rcwm`, with `z` and `h` carried from the
//! last tick (z the posterior, eq. 6):
//!
//! ```text
//! features        = encoder(image)
//! h^R, z_hat^R, z^R = robot(z^R_{t-1}, h^R_{t-1}, a_{t-1}, features, noise)          eq. 5, 6
//! e               = interaction(z_hat^R, h^R, z^E_{t-1})                            eq. 7
//! h^E, z_hat^E, z^E = environment(e, h^E_{t-1}, features, noise)                    eq. 5, 6
//! mean, std       = actor(z^R, h^R, z^E, h^E)
//! ```

mod buffers;
mod calls;
mod compiled;
mod error;
mod held;
mod inputs;
mod limits;
mod noise;
mod parts;
mod recurrent;
mod sequential;
mod stages;
mod state;
mod surprise;
mod tick;

pub use buffers::{BranchBuffers, Buffers};
pub use calls::{CALLS_MAX, Call, CallKind, CallOutcome};
pub use error::PolicyError;
pub use inputs::{InputReader, Inputs};
pub use limits::ActionLimits;
pub use noise::Sampling;

pub use recurrent::Graph;
pub(crate) use recurrent::no_half_weights;
pub use state::{BranchState, State};
pub use surprise::{NoSuchSurprise, Surprise, SurpriseLimits};

use std::path::{Path, PathBuf};
use std::time::Instant;

use rcwm_models::bundle::{Bundle, BundleKind, Manifest, PartName};
use rcwm_models::interface::Normaliser;
use rcwm_models::settings::ModelSettings;
use rcwm_models::wire::ActionValues;

use crate::engine::{EngineSettings, Form};
use calls::CallRing;
use noise::NoiseSource;
use stages::StageClock;
use tick::{Tick, Work};

/// Stages of a tick that are timed one by one, in the order they run: of each kind some.
pub const STAGES: [PartName; 7] = [
    PartName::Encoder,
    PartName::Robot,
    PartName::Interaction,
    PartName::Environment,
    PartName::Dynamics,
    PartName::Policy,
    PartName::Actor,
];

/// What the policy decided on one observation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Decision {
    /// The action to execute, in the interface's units and within the bundle's limits.
    pub action: ActionValues,
    /// Mean of the action distribution, which is over [-1, 1].
    pub mean: ActionValues,
    /// Its standard deviation.
    pub std: ActionValues,
    /// Time spent in each of [`STAGES`] after the image was there, in ns; 0 for one that had been worked ahead.
    pub stage_ns: [u64; STAGES.len()],
    /// How unexpected the image was; none where there was no image ([`Policy::imagine`]).
    pub surprise: Option<Surprise>,
    /// What had been worked ahead was for another action than was executed, and was done again.
    pub recomputed: bool,
    /// The second thread was not there in time, and its branch was computed by the first.
    pub helper_late: bool,
}

/// What led to the observation to come.
#[derive(Debug, Clone, Copy, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "copied by a loop that must not allocate")]
enum Before {
    /// Nothing: it is the first of its episode.
    Start,
    Action(ActionValues),
}

/// A policy that carries its state from tick to tick.
pub struct Policy {
    folder: PathBuf,
    manifest: Manifest,
    limits: ActionLimits,
    /// Between the interface's units and the model's [-1, 1].
    normaliser: Normaliser,
    tick: Box<dyn Tick>,
    buffers: Buffers,
    initial: State,
    state: State,
    noise: NoiseSource,
    /// What the buffers hold the work ahead for.
    ahead: Option<Before>,
    calls: CallRing,
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
    /// [`PolicyError::Engine`], or [`PolicyError::NothingToSample`].
    pub fn new(bundle: &Bundle, engine: EngineSettings, sampling: Sampling) -> Result<Self, PolicyError> {
        if bundle.manifest.model.is_none() && sampling != Sampling::Mode {
            return Err(PolicyError::NothingToSample);
        }
        let initial = State::from(&bundle.initial);
        let mut policy = Self {
            limits: ActionLimits::of(&bundle.manifest),
            normaliser: Normaliser::of(&bundle.manifest.interface),
            tick: load_tick(bundle, engine)?,
            buffers: Buffers::new(&bundle.manifest, &initial),
            state: initial.clone(),
            initial,
            noise: noise_of(&bundle.manifest, sampling),
            folder: bundle.folder.clone(),
            manifest: bundle.manifest.clone(),
            ahead: None,
            calls: CallRing::new(),
        };
        policy.warm_up(sampling)?;
        Ok(policy)
    }

    /// Runs some ticks on a black image, so that the first real one finds memory and caches ready.
    fn warm_up(&mut self, sampling: Sampling) -> Result<(), PolicyError> {
        let (image, state) = (vec![0; self.image_bytes()], vec![0.0; self.manifest.measured_numbers()]);
        let inputs = Inputs { image: &image, state: &state };
        let middle = self.limits.clamp(ActionValues::zeros(self.limits.numbers()));
        for tick in 0..3 {
            match self.observe(inputs, (tick > 0).then_some(&middle)) {
                // Poisoned weights must not stop a controller that has a fallback: they are reported tick by tick.
                Ok(_) | Err(PolicyError::NotFinite { .. }) => {}
                Err(error) => return Err(error),
            }
            self.warm_caches();
        }
        self.noise = noise_of(&self.manifest, sampling);
        self.ahead = None;
        self.calls = CallRing::new();
        self.reset();
        Ok(())
    }

    /// Decides on one observation and carries the state on.
    ///
    /// `inputs` are the cameras' pictures, and the measured state where the bundle reads one; `executed_action`, in the interface's
    /// units, is what was really executed to get here, and none at the first observation of an episode, which starts from the
    /// bundle's initial state.
    ///
    /// # Errors
    /// [`PolicyError::Observation`], [`PolicyError::Engine`] or [`PolicyError::NotFinite`]; the carried state is then that of
    /// the last good tick.
    pub fn observe<'a>(
        &mut self,
        inputs: impl Into<Inputs<'a>>,
        executed_action: Option<&ActionValues>,
    ) -> Result<Decision, PolicyError> {
        let inputs = inputs.into();
        let before = match self.misfit(inputs) {
            None => self.before(executed_action),
            Some(text) => Err(PolicyError::Observation(text)),
        };
        self.decide(CallKind::Observe, executed_action, before, |tick, work| {
            tick.observe(inputs, work)?;
            Ok(work.buffers.surprise())
        })
    }

    /// Computes all of the next tick that needs only the action before it (robot prior, interaction, environment's recurrence),
    /// as if `action` were executed: to be called in the idle time after an action was sent. `None` is for an episode's start, and
    /// goes back to the learned initial state. When [`Self::observe`] then gets the same action, it has that much less to do.
    ///
    /// # Errors
    /// As [`Self::observe`].
    pub fn work_ahead(&mut self, action: Option<&ActionValues>) -> Result<(), PolicyError> {
        let start = Instant::now();
        let result =
            self.before(action).and_then(|before| self.prepare(before, &mut StageClock::start()).map(drop));
        let outcome = CallOutcome::of_work_ahead(&result, start.elapsed().as_nanos() as u64);
        self.calls.note(CallKind::WorkAhead, action, outcome);
        result
    }

    /// Gets ready for an image that will come soon: since the last one others have used the caches, so what stands between image and
    /// action is computed once more from the last image, and dropped. Takes as long as a tick; results do not depend on it.
    pub fn warm_caches(&mut self) {
        self.tick.wake();
        self.tick.warm_caches();
    }

    /// Says that an image may come at any moment: a second thread, where there is one, looks for work from now on, for a short while.
    pub fn wake(&self) {
        self.tick.wake();
    }

    /// Whether there is a world model, which imagines what is not observed.
    #[must_use]
    pub fn imagines(&self) -> bool {
        self.manifest.model.is_some()
    }

    /// Goes on without an image: the world model imagines the missing frame. The prior stands in for the posterior, and the state is
    /// carried on from it. A policy without a world model decides on the action that was executed last once more, and its state stays.
    ///
    /// # Errors
    /// As [`Self::observe`].
    pub fn imagine(&mut self, executed_action: &ActionValues) -> Result<Decision, PolicyError> {
        let before = self.before(Some(executed_action));
        if !self.imagines() {
            let result = before.map(|_| self.hold(executed_action));
            self.calls.note(CallKind::Imagine, Some(executed_action), (&result).into());
            return result;
        }
        self.decide(CallKind::Imagine, Some(executed_action), before, |tick, work| {
            tick.imagine(work).map(|()| None)
        })
    }

    /// The action that was executed last, as far as the limits allow it.
    fn hold(&self, executed_action: &ActionValues) -> Decision {
        let mut mean = *executed_action;
        // Finite: see `before`.
        let _ = self.normaliser.from_units(executed_action, &mut mean);
        Decision {
            action: self.limits.clamp(*executed_action),
            mean,
            std: ActionValues::zeros(mean.len()),
            stage_ns: [0; STAGES.len()],
            surprise: None,
            recomputed: false,
            helper_late: false,
        }
    }

    /// What stands before the tick; an episode's start goes back to the learned initial state.
    fn before(&mut self, action: Option<&ActionValues>) -> Result<Before, PolicyError> {
        match action {
            None => {
                self.reset();
                Ok(Before::Start)
            }
            Some(action) if action.is_finite() && action.len() == self.limits.numbers() => {
                Ok(Before::Action(*action))
            }
            Some(action) => {
                let expected = self.limits.numbers();
                let text = format!("executed action {action:?}, expected {expected} finite numbers");
                Err(PolicyError::Observation(text))
            }
        }
    }

    /// Makes the buffers hold what is known before the image; true when they held it for another action.
    fn prepare(&mut self, before: Before, clock: &mut StageClock) -> Result<bool, PolicyError> {
        if self.ahead == Some(before) {
            return Ok(false);
        }
        let other = self.ahead.take().is_some();
        if !other {
            // Done again, a tick keeps its noise: one draw a tick, whatever was assumed.
            self.noise.draw();
        }
        let mut action = ActionValues::zeros(self.limits.numbers());
        if let Before::Action(executed) = before {
            // Finite: see `before`.
            let _ = self.normaliser.from_units(&executed, &mut action);
        }
        let (tick, mut work) = self.work(clock);
        tick.work_ahead(&action, &mut work)?;
        self.ahead = Some(before);
        Ok(other)
    }

    fn work<'a>(&'a mut self, clock: &'a mut StageClock) -> (&'a mut dyn Tick, Work<'a>) {
        let Self { tick, buffers, state, noise, .. } = self;
        (tick.as_mut(), Work { state, noise, buffers, clock })
    }

    /// A decision by `tick`, which gives the surprise; the call is noted, however it ends.
    fn decide(
        &mut self,
        kind: CallKind,
        executed_action: Option<&ActionValues>,
        before: Result<Before, PolicyError>,
        tick: impl FnOnce(&mut dyn Tick, &mut Work<'_>) -> Result<Option<Surprise>, PolicyError>,
    ) -> Result<Decision, PolicyError> {
        let result = before.and_then(|before| self.try_decide(before, tick));
        self.calls.note(kind, executed_action, (&result).into());
        result
    }

    fn try_decide(
        &mut self,
        before: Before,
        tick: impl FnOnce(&mut dyn Tick, &mut Work<'_>) -> Result<Option<Surprise>, PolicyError>,
    ) -> Result<Decision, PolicyError> {
        let mut clock = StageClock::start();
        let recomputed = self.prepare(before, &mut clock)?;
        // From here on the buffers hold a tick that may fail half-way.
        self.ahead = None;
        let (of_engine, mut work) = self.work(&mut clock);
        let surprise = tick(of_engine, &mut work)?;
        let StageClock { spent_ns: stage_ns, helper_late, .. } = clock;
        let (mean, std) = (self.buffers.mean, self.buffers.std);
        let decided = self.noise.action(&mean, &std);
        // A sample of two finite numbers can be too large for one: no limit makes that an action.
        buffers::finite(PartName::Actor, "mean", &decided)?;
        self.buffers.give_posterior(&mut self.state);
        let mut action = decided;
        // Finite: see above.
        let _ = self.normaliser.to_units(&decided, &mut action);
        let action = self.limits.clamp(action);
        Ok(Decision { action, mean, std, stage_ns, surprise, recomputed, helper_late })
    }

    /// Goes back to the learned initial state.
    fn reset(&mut self) {
        if self.state != self.initial {
            self.state.clone_from(&self.initial);
        }
    }
}

fn noise_of(manifest: &Manifest, sampling: Sampling) -> NoiseSource {
    let width = manifest.model.as_ref().map_or(0, ModelSettings::stoch_width);
    NoiseSource::new(sampling, manifest.kind.branches().len(), width)
}

fn load_tick(bundle: &Bundle, settings: EngineSettings) -> Result<Box<dyn Tick>, PolicyError> {
    if bundle.manifest.kind == BundleKind::Recurrent {
        return Ok(Box::new(recurrent::Recurrent::load(bundle, settings)?));
    }
    Ok(match settings.form {
        Form::Exported => Box::new(sequential::Sequential::load(bundle, settings)?),
        Form::Compiled(optimizations) => {
            Box::new(compiled::Compiled::load(bundle, optimizations, settings.threads)?)
        }
        Form::Split => Box::new(compiled::Split::load(bundle, settings)?),
    })
}
