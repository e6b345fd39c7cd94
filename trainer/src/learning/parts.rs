//! Where the time of an update goes: its parts say when they run, and who wants to know listens.

use std::cell::RefCell;
use std::time::{Duration, Instant};

/// Time of one part of an update.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PartTime {
    pub part: &'static str,
    /// How long it took.
    pub time: Duration,
}

thread_local! {
    static LISTENER: RefCell<Option<Vec<PartTime>>> = const { RefCell::new(None) };
}

/// Runs a part of an update. Costs some nanoseconds if nobody listens on this thread.
pub fn part<T>(part: &'static str, body: impl FnOnce() -> T) -> T {
    if LISTENER.with_borrow(Option::is_none) {
        return body();
    }
    let start = Instant::now();
    let result = body();
    let time = start.elapsed();
    LISTENER.with_borrow_mut(|listener| {
        listener.iter_mut().for_each(|times| times.push(PartTime { part, time }))
    });
    result
}

/// Runs `body` and gives the times of all parts that ran in it on this thread, in the order of their ends.
pub fn listen<T>(body: impl FnOnce() -> T) -> (T, Vec<PartTime>) {
    let outer = LISTENER.replace(Some(Vec::new()));
    let result = body();
    (result, LISTENER.replace(outer).unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_heard_in_order_and_only_while_somebody_listens() {
        part("before", || ());
        let (sum, times) = listen(|| part("first", || 1) + part("second", || 2));
        assert_eq!(
            (sum, times.iter().map(|time| time.part).collect::<Vec<_>>()),
            (3, vec!["first", "second"])
        );
        assert!(listen(|| ()).1.is_empty());
    }

    #[test]
    fn a_listener_within_another_hears_its_own_parts() {
        let ((_, inner), outer) = listen(|| {
            part("outer", || ());
            listen(|| part("inner", || ()))
        });
        assert_eq!((inner.len(), outer.len(), inner[0].part, outer[0].part), (1, 1, "inner", "outer"));
    }
}
