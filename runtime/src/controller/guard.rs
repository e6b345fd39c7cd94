//! A panic in the loop is an error of the run, which is told when the robot has been told.

use std::any::Any;
use std::cell::{Cell, RefCell};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Once;

thread_local! {
    static GUARDED: Cell<bool> = const { Cell::new(false) };
    /// What the last panic in this thread has said, and where.
    static SAID: RefCell<Option<String>> = const { RefCell::new(None) };
}

/// Runs `run`; a panic in it becomes what it says.
///
/// Nothing is printed meanwhile: a terminal that does not drain would hold up the thread before the robot is told.
pub(super) fn guarded<T>(run: impl FnOnce() -> T) -> Result<T, String> {
    keep_quiet();
    let outer = GUARDED.replace(true);
    let result = catch_unwind(AssertUnwindSafe(run));
    GUARDED.set(outer);
    result.map_err(|payload| SAID.take().unwrap_or_else(|| message(payload.as_ref())))
}

/// Panics of guarded threads are kept instead of printed; those of others are printed as before.
fn keep_quiet() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let others = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            if GUARDED.get() {
                let at = panic.location().map_or_else(String::new, |at| format!(" ({at})"));
                SAID.set(Some(message(panic.payload()) + &at));
            } else {
                others(panic);
            }
        }));
    });
}

fn message(payload: &(dyn Any + Send)) -> String {
    let text = payload.downcast_ref::<&str>().copied();
    let text = text.or_else(|| payload.downcast_ref::<String>().map(String::as_str));
    text.unwrap_or("a panic without a message").to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_becomes_what_it_says_and_where_and_the_next_run_is_guarded_again() {
        for number in 0..2 {
            let error = guarded(|| assert!(number > 1, "number {number}")).unwrap_err();
            assert!(error.contains(&format!("number {number}")) && error.contains("guard.rs:"), "{error}");
        }
        assert_eq!(guarded(|| 7), Ok(7));
    }
}
