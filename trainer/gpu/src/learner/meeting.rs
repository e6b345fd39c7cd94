//! Runs in threads of their own that share programs: one is launched when every run that is still there asks for an update.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use super::runs::{Runs, Which};
use crate::machine::GpuError;

/// Where the runs' threads meet.
#[derive(Debug)]
pub(super) struct Meeting {
    state: Mutex<State>,
    /// Something was launched, or somebody left.
    news: Condvar,
}

#[derive(Debug)]
struct State {
    runs: Runs,
    guests: Vec<Guest>,
    /// What a launch failed of; nobody goes on after that.
    failed: Option<String>,
}

/// What a run is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Guest {
    /// Something else: the others wait for it.
    Busy,
    Waiting(Which),
    Gone,
}

impl Meeting {
    pub(super) fn new(runs: Runs) -> Self {
        let guests = vec![Guest::Busy; runs.machine().runs()];
        Self { state: Mutex::new(State { runs, guests, failed: None }), news: Condvar::new() }
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
        state.guests[run] = Guest::Waiting(which);
        self.launch_what_is_ready(&mut state);
        while state.guests[run] != Guest::Busy && state.failed.is_none() {
            state = self.news.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        match &state.failed {
            Some(reason) => {
                Err(GpuError::Failed { what: "an update of several runs", reason: reason.clone() })
            }
            None => values(&mut state.runs),
        }
    }

    /// This run asks for nothing any more.
    pub(super) fn leave(&self, run: usize) {
        let mut state = self.state();
        state.guests[run] = Guest::Gone;
        self.launch_what_is_ready(&mut state);
    }

    /// Launches a program where nobody is busy any more.
    fn launch_what_is_ready(&self, state: &mut State) {
        if state.failed.is_some() || state.guests.contains(&Guest::Busy) {
            return;
        }
        // Behaviour first: an update of the world model writes over the states that it begins from.
        let waiting = |guest: &Guest| match guest {
            Guest::Waiting(which) => Some(*which),
            Guest::Busy | Guest::Gone => None,
        };
        let wanted = || state.guests.iter().filter_map(waiting);
        let Some(which) = wanted().find(|which| *which == Which::Behaviour).or_else(|| wanted().next())
        else {
            return;
        };
        let taking_part: Vec<bool> =
            state.guests.iter().map(|guest| *guest == Guest::Waiting(which)).collect();
        match state.runs.launch(which, taking_part) {
            Ok(()) => {
                for guest in state.guests.iter_mut().filter(|guest| **guest == Guest::Waiting(which)) {
                    *guest = Guest::Busy;
                }
            }
            Err(error) => state.failed = Some(error.to_string()),
        }
        self.news.notify_all();
    }
}
