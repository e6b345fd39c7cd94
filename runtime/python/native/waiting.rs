//! Waits that let Python's other threads run and that Ctrl-C ends.

use std::time::{Duration, Instant};

use pyo3::prelude::*;

use crate::errors::input;

/// Signals may reach another thread of the program, which does not wake this one: they are looked for so often.
const SLICE: Duration = Duration::from_millis(50);

/// Runs `work` without the interpreter's lock, on this very thread.
pub(crate) fn released<R>(py: Python<'_>, work: impl FnOnce() -> R) -> R {
    struct SameThread<T>(T);
    // SAFETY: `detach` calls it on the thread that gave it, and only there.
    unsafe impl<T> Send for SameThread<T> {}
    impl<R, F: FnOnce() -> R> SameThread<F> {
        fn call(self) -> SameThread<R> {
            SameThread((self.0)())
        }
    }
    let work = SameThread(work);
    py.detach(move || work.call()).0
}

/// Calls `attempt`, each time with how long it may wait, until it gives something or the time is up; it gives up the interpreter's lock
/// itself. Raises `InputError`, and what a signal's handler raises.
pub(crate) fn wait<T>(
    py: Python<'_>,
    timeout_s: f64,
    mut attempt: impl FnMut(Duration) -> PyResult<Option<T>>,
) -> PyResult<Option<T>> {
    let timeout = match Duration::try_from_secs_f64(timeout_s) {
        Ok(timeout) => timeout,
        Err(_) if timeout_s == f64::INFINITY => Duration::MAX,
        Err(_) => return Err(input(py, format!("timeout_s = {timeout_s}: expected seconds, 0 or more"))),
    };
    let start = Instant::now();
    loop {
        let left = timeout.saturating_sub(start.elapsed());
        if let Some(found) = attempt(left.min(SLICE))? {
            return Ok(Some(found));
        }
        py.check_signals()?;
        if left.is_zero() {
            return Ok(None);
        }
    }
}
