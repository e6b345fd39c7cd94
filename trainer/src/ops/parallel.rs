//! Work in fixed shares on a few threads: the same number of threads gives the same bits.

use std::cell::Cell;
use std::ops::Range;
use std::sync::OnceLock;

use candle_core::Device;

thread_local! {
    /// Threads that a task may use, where it is one of several.
    static GRANTED: Cell<Option<usize>> = const { Cell::new(None) };
}

/// Threads that work together, the caller included; `RAYON_NUM_THREADS` limits them, and so does [`in_parallel`] within its tasks.
pub fn threads() -> usize {
    static THREADS: OnceLock<usize> = OnceLock::new();
    GRANTED.get().unwrap_or_else(|| *THREADS.get_or_init(|| candle_core::utils::get_num_threads().max(1)))
}

/// Runs `body` on every item at the same time, and gives the results in the items' order. The tasks divide the threads among
/// themselves: with as many items as threads, each runs on one alone, ops included, and waits for no other until the end.
///
/// # Panics
/// If `body` does.
pub fn in_parallel<I: Send, T: Send>(items: Vec<I>, body: impl Fn(I) -> T + Sync) -> Vec<T> {
    let granted = (threads() / items.len().max(1)).max(1);
    let mut results: Vec<Option<T>> = items.iter().map(|_| None).collect();
    let body = &body;
    let tasks = items.into_iter().zip(&mut results).map(|(item, result)| {
        move || {
            let before = GRANTED.replace(Some(granted));
            *result = Some(body(item));
            GRANTED.set(before);
        }
    });
    run(tasks.collect());
    results.into_iter().map(|result| result.expect("every task has run to its end")).collect()
}

/// Shares of `count` items for [`in_parallel`]: one a thread, none empty. A GPU is fast with all of them at once.
pub fn shares_of(count: usize, device: &Device) -> Vec<Range<usize>> {
    if device.is_cpu() { shares(count, 1) } else { std::iter::once(0..count).collect() }
}

/// Leaves the cores to the fused ops: candle's own elementwise operations then run on the calling thread. Its pool spins between
/// operations, which are short and many in a backward pass, and so takes the core that a fused op's second share needs (an actor's backward
/// pass took four times as long on two busy cores). `CANDLE_NUM_THREADS`, if set, is respected.
///
/// Call it first in `main`, before any thread is started.
pub fn leave_threads_to_ops() {
    const NAME: &str = "CANDLE_NUM_THREADS";
    if std::env::var_os(NAME).is_none() {
        // SAFETY: the caller has started no thread yet, so nobody reads the environment meanwhile.
        unsafe { std::env::set_var(NAME, "1") };
    }
}

/// Shares of `count` items, at most one a thread and none below `least` items (but for a single one).
pub fn shares(count: usize, least: usize) -> Vec<Range<usize>> {
    let parts = (count / least.max(1)).clamp(1, threads());
    (0..parts).map(|part| part * count / parts..(part + 1) * count / parts).collect()
}

/// Runs all tasks and returns when they are done. The caller runs the first, so that only the others wait for a thread to wake.
pub fn run<T: FnOnce() + Send>(tasks: Vec<T>) {
    let mut tasks = tasks.into_iter();
    let Some(first) = tasks.next() else { return };
    if tasks.len() == 0 {
        return first();
    }
    rayon::in_place_scope(|scope| {
        for task in tasks {
            scope.spawn(move |_| task());
        }
        first();
    });
}

/// Runs `body` on every share with its part.
pub fn each<P: Send>(
    shares: &[Range<usize>],
    parts: impl IntoIterator<Item = P>,
    body: impl Fn(Range<usize>, P) + Sync,
) {
    let body = &body;
    let task = |(share, part): (&Range<usize>, P)| {
        let share = share.clone();
        move || body(share, part)
    };
    run(shares.iter().zip(parts).map(task).collect());
}

/// Cuts a slice of rows of `width` at the shares.
pub fn split<'a, T>(mut data: &'a mut [T], shares: &[Range<usize>], width: usize) -> Vec<&'a mut [T]> {
    let mut parts = Vec::with_capacity(shares.len());
    for share in shares {
        let (part, rest) = data.split_at_mut(share.len() * width);
        parts.push(part);
        data = rest;
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_cover_everything_once() {
        for (count, least) in [(0, 1), (1, 1), (7, 2), (100, 1000), (1000, 1)] {
            let shares = shares(count, least);
            assert_eq!(
                shares.iter().flat_map(Clone::clone).collect::<Vec<_>>(),
                (0..count).collect::<Vec<_>>()
            );
            assert!(shares.len() == 1 || shares.iter().all(|share| share.len() >= least));
        }
    }

    #[test]
    fn tasks_give_their_results_in_order_and_divide_the_threads() {
        let all = threads();
        let found = in_parallel(shares_of(5, &Device::Cpu), |share| (share.start, threads()));
        assert!(found.is_sorted() && found.iter().all(|(_, granted)| granted * found.len() <= all.max(1)));
        assert_eq!(threads(), all);
    }

    #[test]
    fn every_task_runs_on_its_own_part() {
        let mut data = vec![0; 10];
        let shares = [0..2, 2..3, 3..5];
        let parts = split(&mut data, &shares, 2);
        run(parts.into_iter().enumerate().map(|(i, part)| move || part.fill(i + 1)).collect());
        assert_eq!(data, [1, 1, 1, 1, 2, 2, 3, 3, 3, 3]);
    }
}
