use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::ReplayError;
use crate::learning::HostBatch;

/// Why no batch came.
#[derive(Debug, thiserror::Error)]
pub enum PrefetchError {
    /// It could not be drawn.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// The thread could not be started.
    #[error("the thread that draws batches could not be started: {0}")]
    Spawn(#[from] std::io::Error),
    /// The thread ended; it panicked.
    #[error("the thread that draws batches has ended")]
    Ended,
}

/// Draws numbered batches on its own thread, ahead of their use.
#[derive(Debug)]
pub struct Prefetch {
    batches: Option<Receiver<Result<HostBatch, ReplayError>>>,
    thread: Option<JoinHandle<()>>,
    waited: Duration,
}

impl Prefetch {
    /// Starts drawing batches `first`, `first + 1`, ... with `draw`, at most `ahead` of them before they are taken.
    ///
    /// # Errors
    /// [`PrefetchError::Spawn`].
    pub fn start(
        first: u64,
        ahead: usize,
        draw: impl Fn(u64) -> Result<HostBatch, ReplayError> + Send + 'static,
    ) -> Result<Self, PrefetchError> {
        let (sender, receiver) = sync_channel(ahead);
        let thread =
            std::thread::Builder::new().name("replay".into()).spawn(move || feed(first, &draw, &sender))?;
        Ok(Self { batches: Some(receiver), thread: Some(thread), waited: Duration::ZERO })
    }

    pub fn next_batch(&mut self) -> Result<HostBatch, PrefetchError> {
        let begin = Instant::now();
        let batches = self.batches.as_ref().ok_or(PrefetchError::Ended)?;
        let batch = batches.recv().map_err(|_| PrefetchError::Ended)?;
        self.waited += begin.elapsed();
        Ok(batch?)
    }

    /// Time spent waiting for batches so far.
    #[must_use]
    pub fn waited(&self) -> Duration {
        self.waited
    }
}

fn feed(
    first: u64,
    draw: &impl Fn(u64) -> Result<HostBatch, ReplayError>,
    sender: &SyncSender<Result<HostBatch, ReplayError>>,
) {
    for number in first.. {
        let batch = draw(number);
        let failed = batch.is_err();
        // Nobody listens any more, or there is nothing more to say: both end the thread.
        if sender.send(batch).is_err() || failed {
            return;
        }
    }
}

impl Drop for Prefetch {
    fn drop(&mut self) {
        // The thread may be waiting to send: it wakes up when the receiver is gone.
        self.batches = None;
        if let Some(thread) = self.thread.take() {
            // A panic was printed where it happened.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn batch(number: u64) -> HostBatch {
        HostBatch { reward: vec![number as f32], ..HostBatch::default() }
    }

    #[test]
    fn batches_come_in_order_from_the_first_number_on() {
        let mut prefetch = Prefetch::start(5, 2, |number| Ok(batch(number))).unwrap();
        let found: Vec<_> = (0..4).map(|_| prefetch.next_batch().unwrap().reward[0]).collect();
        assert_eq!(found, [5.0, 6.0, 7.0, 8.0]);
    }

    #[test]
    fn an_error_arrives_and_ends_it() {
        let mut prefetch =
            Prefetch::start(0, 1, |_| Err(ReplayError::NothingToDraw { masks: false })).unwrap();
        assert!(matches!(prefetch.next_batch(), Err(PrefetchError::Replay(_))));
        assert!(matches!(prefetch.next_batch(), Err(PrefetchError::Ended)));
    }
}
