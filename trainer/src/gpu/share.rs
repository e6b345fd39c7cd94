//! Runs that learn together on one machine: whoever comes first lays out the programs, for all of them.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rcwm_gpu::{GpuError, Learner, LearnerSettings, Machine};

/// One run's share of a machine.
#[derive(Debug)]
pub struct Share {
    machine: Arc<Mutex<Shared>>,
    run: usize,
}

#[derive(Debug)]
struct Shared {
    state: State,
    /// Runs that ended before they had a learner.
    gone: Vec<bool>,
}

#[derive(Debug)]
enum State {
    Bare(Machine),
    /// Learners that nobody has taken yet, by run.
    Ready(Vec<Option<Learner>>),
    Failed,
}

impl Share {
    /// The shares of all the machine's runs.
    #[must_use]
    pub fn all(machine: Machine) -> Vec<Self> {
        let runs = machine.runs();
        let shared = Shared { state: State::Bare(machine), gone: vec![false; runs] };
        let machine = Arc::new(Mutex::new(shared));
        (0..runs).map(|run| Self { machine: Arc::clone(&machine), run }).collect()
    }

    /// All of a machine, for one run.
    #[must_use]
    pub fn alone(machine: Machine) -> Self {
        let shared = Shared { state: State::Bare(machine), gone: vec![false] };
        Self { machine: Arc::new(Mutex::new(shared)), run: 0 }
    }

    fn shared(&self) -> MutexGuard<'_, Shared> {
        self.machine.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// This run's learner. `bring` takes to the machine what all runs share, once.
    ///
    /// # Errors
    /// [`GpuError`], also where another run has other settings or could not lay the programs out.
    pub(super) fn learner(
        &self,
        specs: &[(String, Vec<usize>)],
        bins: &[f32],
        settings: LearnerSettings,
        bring: impl FnOnce(&mut Learner) -> Result<(), GpuError>,
    ) -> Result<Learner, GpuError> {
        let mut shared = self.shared();
        let Shared { state, gone } = &mut *shared;
        if matches!(state, State::Bare(_))
            && let State::Bare(machine) = std::mem::replace(state, State::Failed)
        {
            let mut learners: Vec<_> =
                Learner::new(machine, specs, bins, settings.clone())?.into_iter().map(Some).collect();
            learners[self.run].as_mut().map_or(Ok(()), bring)?;
            for (learner, gone) in learners.iter_mut().zip(gone) {
                if *gone {
                    *learner = None;
                }
            }
            *state = State::Ready(learners);
        }
        let State::Ready(learners) = state else {
            let reason = "another run could not lay them out".to_owned();
            return Err(GpuError::Failed { what: "the programs of several runs", reason });
        };
        match learners.get_mut(self.run).and_then(Option::take) {
            Some(learner) if learner.settings() == settings => Ok(learner),
            Some(_) => Err(GpuError::Unsupported(
                "the settings of runs that learn together differ in more than their seed; resume them one by one"
                    .to_owned(),
            )),
            None => Err(GpuError::Unsupported("a run has one learner".to_owned())),
        }
    }
}

impl Drop for Share {
    /// The other runs do not wait for a learner that nobody takes.
    fn drop(&mut self) {
        let run = self.run;
        let mut shared = self.shared();
        shared.gone[run] = true;
        if let State::Ready(learners) = &mut shared.state {
            learners[run] = None;
        }
    }
}
