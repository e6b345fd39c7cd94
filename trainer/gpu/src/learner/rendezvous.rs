//! Runs in threads of their own that share programs: one is launched when every run that is still there asks for an update.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use super::programs::Which;
use super::runs::Runs;
use crate::machine::GpuError;

/// Where the runs' threads meet.
#[derive(Debug)]
pub(super) struct Rendezvous {
    state: Mutex<State>,
    /// Something was launched, or somebody left.
    changed: Condvar,
}

#[derive(Debug)]
struct State {
    runs: Runs,
    runs_now: Vec<RunState>,
    /// Launches that each run took part in.
    launches: Vec<u64>,
    /// What a launch failed of; nobody goes on after that.
    failed: Option<String>,
    /// The same, for the first who asks.
    error: Option<GpuError>,
}

/// What a run is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum RunState {
    /// Something else: the others wait for it.
    Busy,
    Waiting(Which),
    Gone,
}

impl Rendezvous {
    pub(super) fn new(runs: Runs) -> Self {
        let runs_now = vec![RunState::Busy; runs.machine().runs()];
        Self {
            state: Mutex::new(State {
                launches: vec![0; runs_now.len()],
                runs,
                runs_now,
                failed: None,
                error: None,
            }),
            changed: Condvar::new(),
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Does something with the runs' memory.
    pub(super) fn with<T>(&self, body: impl FnOnce(&mut Runs) -> T) -> T {
        body(&mut self.state().runs)
    }

    /// Waits until a program has been launched in which this run takes part, and gives what it left.
    pub(super) fn launch<T>(
        &self,
        run: usize,
        which: Which,
        values: impl FnOnce(&mut Runs) -> Result<T, GpuError>,
    ) -> Result<T, GpuError> {
        let mut state = self.state();
        state.runs_now[run] = RunState::Waiting(which);
        self.launch_what_is_ready(&mut state);
        while state.runs_now[run] != RunState::Busy && state.failed.is_none() {
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        match (state.error.take(), &state.failed) {
            (Some(error), _) => Err(error),
            (None, Some(reason)) => {
                Err(GpuError::Failed { what: "an update with other runs", reason: reason.clone() })
            }
            (None, None) => values(&mut state.runs),
        }
    }

    /// This run asks for nothing any more.
    pub(super) fn leave(&self, run: usize) {
        let mut state = self.state();
        state.runs_now[run] = RunState::Gone;
        self.launch_what_is_ready(&mut state);
    }

    /// Launches a program where nobody is busy any more.
    fn launch_what_is_ready(&self, state: &mut State) {
        if state.failed.is_some() || state.runs_now.contains(&RunState::Busy) {
            return;
        }
        let waiting = |now: &RunState| match now {
            RunState::Waiting(which) => Some(*which),
            RunState::Busy | RunState::Gone => None,
        };
        let wanted = || {
            state.runs_now.iter().zip(&state.launches).filter_map(|(now, made)| Some((waiting(now)?, *made)))
        };
        // Behaviour first: an update of the world model writes over the states that it begins from. Then whoever is furthest behind, so
        // that runs that were resumed at different updates come to ask for the same ones.
        let behaviour = wanted().find(|(which, _)| *which == Which::Behaviour);
        let Some((which, _)) = behaviour.or_else(|| wanted().min_by_key(|(_, made)| *made)) else { return };
        let takes_part = |now: &RunState| *now == RunState::Waiting(which);
        let taking_part: Vec<bool> = state.runs_now.iter().map(takes_part).collect();
        match state.runs.launch(which, taking_part) {
            Ok(()) => {
                for (now, made) in state.runs_now.iter_mut().zip(&mut state.launches) {
                    if takes_part(now) {
                        *now = RunState::Busy;
                        *made += 1;
                    }
                }
            }
            Err(error) => {
                state.failed = Some(error.to_string());
                state.error = Some(error);
            }
        }
        self.changed.notify_all();
    }
}
