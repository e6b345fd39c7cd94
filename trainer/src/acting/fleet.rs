use std::sync::atomic::{AtomicBool, Ordering};

use rcwm_models::episode::{Episode, EpisodeBuilder, EpisodeError};
use rcwm_models::interface::NotFinite;
use rcwm_models::wire::{ObservationFlags, ObservationSample};

use super::policy::PolicyInput;
use crate::simulators::{Client, ClientError, Launch, SimulatorProcess, mismatches_to_act};

/// Why acting in simulators failed.
#[derive(Debug, thiserror::Error)]
pub enum FleetError {
    /// A simulator.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// Observations that make no episode.
    #[error(transparent)]
    Episode(#[from] EpisodeError),
    /// A policy that gives numbers that are none.
    #[error("an action of the policy: {0}")]
    NotFinite(#[from] NotFinite),
    /// There is none.
    #[error(
        "there is no simulator to act in; set finetune.simulators to 1 or more, or join one with --join INSTANCE"
    )]
    Nobody,
}

impl From<crate::simulators::ProcessError> for FleetError {
    fn from(error: crate::simulators::ProcessError) -> Self {
        Self::Client(error.into())
    }
}

/// An observation that waits for its answer.
pub struct Gathered {
    /// Which simulator's: its place in the fleet.
    pub simulator: usize,
    /// What it shows.
    pub observation: ObservationSample,
}

impl Gathered {
    /// Whether an episode begins with it.
    #[must_use]
    pub fn is_first(&self) -> bool {
        self.observation.is(ObservationFlags::FIRST)
    }

    /// What a policy decides by.
    #[must_use]
    pub fn seen(&self) -> PolicyInput<'_> {
        let observation = self.observation.view();
        let mut executed = observation.executed_action();
        if observation.format().normaliser().from_units(observation.executed(), &mut executed).is_err() {
            // What is not finite is refused where it is recorded.
            executed.fill(0.0);
        }
        PolicyInput {
            simulator: self.simulator,
            first: self.is_first(),
            image: observation.image(0),
            executed,
        }
    }

    /// Whether it is the last of its episode.
    #[must_use]
    pub fn is_last(&self) -> bool {
        self.observation.is(ObservationFlags::LAST)
    }
}

/// An episode that was seen from its first to its last observation.
#[derive(Debug)]
pub struct Recorded {
    /// The simulator's place in the fleet.
    pub simulator: usize,
    /// All of it.
    pub episode: Episode,
}

struct Member {
    /// `None` once it has ended.
    client: Option<Client>,
    builder: EpisodeBuilder,
}

/// Simulators in lock-step.
pub struct Fleet {
    members: Vec<Member>,
}

impl Fleet {
    /// Starts a simulator for every launch and joins those that run already.
    pub fn new(launches: &[Launch], join: &[String]) -> Result<Self, FleetError> {
        let mut clients = Vec::new();
        // All load at the same time.
        let processes = launches.iter().map(SimulatorProcess::start).collect::<Result<Vec<_>, _>>()?;
        for process in processes {
            clients.push(Client::of(process, mismatches_to_act)?);
        }
        for instance in join {
            clients.push(Client::join(instance, mismatches_to_act)?);
        }
        if clients.is_empty() {
            return Err(FleetError::Nobody);
        }
        let member = |client| Member { client: Some(client), builder: EpisodeBuilder::new() };
        Ok(Self { members: clients.into_iter().map(member).collect() })
    }

    /// Simulators, those that have ended included.
    #[must_use]
    pub fn len(&self) -> usize {
        self.members.len()
    }

    /// Whether there are none; never so after [`Fleet::new`].
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.members.is_empty()
    }

    /// The next observation of every simulator; empty when all have ended or `stop` was set.
    ///
    /// # Errors
    /// See [`FleetError`]; a simulator that died is reported with its last words.
    pub fn gather(&mut self, stop: &AtomicBool) -> Result<Vec<Gathered>, FleetError> {
        let mut gathered = Vec::with_capacity(self.members.len());
        for (simulator, member) in self.members.iter_mut().enumerate() {
            let Some(client) = &mut member.client else { continue };
            match client.next(stop)? {
                Some(observation) => gathered.push(Gathered { simulator, observation }),
                None if stop.load(Ordering::Relaxed) => return Ok(Vec::new()),
                None => member.client = None,
            }
        }
        Ok(gathered)
    }

    /// Answers an observation with an action in [-1, 1]; with none, with the least motion that the robot may be commanded.
    pub fn answer(&mut self, to: &Gathered, action: Option<&[f32]>) -> Result<(), FleetError> {
        let format = to.observation.view().format();
        let action = match action {
            None => format.rest(),
            Some(action) => {
                let mut units = format.zeros();
                format.normaliser().to_units(action, &mut units).map(|()| units)?
            }
        };
        match &mut self.members[to.simulator].client {
            Some(client) => Ok(client.answer(to.observation.sequence, action)?),
            None => Ok(()),
        }
    }

    /// Takes an observation into its simulator's episode, and gives the episode when it is whole. One that was joined in its middle is
    /// let pass.
    ///
    /// # Errors
    /// [`FleetError::Episode`].
    pub fn record(&mut self, gathered: &Gathered) -> Result<Option<Recorded>, FleetError> {
        let builder = &mut self.members[gathered.simulator].builder;
        if gathered.is_first() {
            *builder = EpisodeBuilder::new();
        }
        if gathered.is_first() || !builder.is_empty() {
            builder.push(&gathered.observation.view())?;
        }
        if !gathered.is_last() {
            return Ok(None);
        }
        let simulator = gathered.simulator;
        Ok(builder.finish().map(|episode| Recorded { simulator, episode }))
    }
}
