//! One operator's work on two threads, without ever waiting for the second.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use tract_onnx::tract_hir::internal::*;

use super::compute::Compute;
use rcwm_kernels::team::{Job, Pieces, TIMEOUT_MIN, Team, try_lock};

/// What the helper computes for one operator. It writes to memory of its own, from the last piece on: a helper that was stopped half-way
/// and goes on much later touches nothing that anybody else reads or has given to the next tick.
#[derive(Debug)]
pub(super) struct WorkerSlot<C: Compute> {
    compute: Arc<C>,
    pieces: Pieces,
    work: Mutex<Work<C>>,
}

#[derive(Debug)]
struct Work<C: Compute> {
    inputs: Vec<TValue>,
    /// There until the helper begins.
    scratch: Option<Arc<C::Scratch>>,
    /// The whole result, of which the helper fills the end.
    out: Vec<C::Number>,
    /// The first piece that is filled.
    filled_from: usize,
}

impl<C: Compute> Job for WorkerSlot<C> {
    fn help(&self) {
        let mut work = self.work.lock().unwrap_or_else(PoisonError::into_inner);
        let Work { inputs, scratch, out, filled_from } = &mut *work;
        // Nothing where it comes too late, or once more.
        let (Some(scratch), Some(len)) = (scratch.take(), self.compute.piece_len()) else { return };
        while let Some(piece) = self.pieces.claim_back() {
            let end = out.len().min(len * (piece + 1));
            if self.compute.fill(inputs, &scratch, len * piece, &mut out[len * piece..end]).is_err() {
                // The caller meets the same error.
                break;
            }
            *filled_from = piece;
        }
        // Before anybody else may look: whose memory it is sees that nobody reads it any more.
        inputs.clear();
    }
}

impl<C: Compute> WorkerSlot<C> {
    pub(super) fn new(compute: &Arc<C>) -> Arc<Self> {
        let out = vec![C::Number::default(); compute.shape().iter().product()];
        let work = Work { inputs: Vec::with_capacity(8), scratch: None, out, filled_from: 0 };
        Arc::new(Self { compute: Arc::clone(compute), pieces: Pieces::default(), work: Mutex::new(work) })
    }

    /// Fills `out` on both threads; on one where the helper is late.
    pub(super) fn fill(
        self: &Arc<Self>,
        team: &Team,
        inputs: &[TValue],
        scratch: &Arc<C::Scratch>,
        out: &mut [C::Number],
    ) -> TractResult<()> {
        let compute = &*self.compute;
        let len = compute.piece_len().unwrap_or(out.len());
        let count = out.len().div_ceil(len);
        if !self.send(team, inputs, scratch, count as u32) {
            // It has not come back from an earlier tick.
            team.note_late();
            return compute.fill(inputs, scratch, 0, out);
        }
        let start = Instant::now();
        while let Some(piece) = self.pieces.claim_front() {
            let end = out.len().min(len * (piece + 1));
            compute.fill(inputs, scratch, len * piece, &mut out[len * piece..end])?;
        }
        let own = self.pieces.front();
        // Twice the time of one piece: the helper has at most one to finish.
        let timeout = TIMEOUT_MIN.max(start.elapsed() * 2 / own.max(1) as u32);
        let own_len = out.len().min(len * own);
        let rest = &mut out[own_len..];
        let waited = Instant::now();
        while !self.fetch(team, own, rest) {
            if rest.is_empty() {
                break;
            }
            if waited.elapsed() >= timeout {
                team.note_late();
                return compute.fill(inputs, scratch, own_len, rest);
            }
            std::hint::spin_loop();
        }
        Ok(())
    }

    /// Sends the helper, unless it has not come back from the last time.
    fn send(self: &Arc<Self>, team: &Team, inputs: &[TValue], scratch: &Arc<C::Scratch>, count: u32) -> bool {
        let Some(mut work) = try_lock(&self.work) else { return false };
        work.inputs.clear();
        work.inputs.extend_from_slice(inputs);
        work.scratch = Some(Arc::clone(scratch));
        work.filled_from = usize::MAX;
        self.pieces.lay_out(count);
        drop(work);
        team.send(Arc::clone(self) as Arc<dyn Job>);
        true
    }

    /// Takes over the pieces from `own` on; false while the helper is at them, or where it has failed.
    fn fetch(&self, team: &Team, own: usize, rest: &mut [C::Number]) -> bool {
        let Some(mut work) = try_lock(&self.work) else { return false };
        if work.scratch.take().is_some() {
            // It has not begun, and need not.
            team.call_off();
            work.inputs.clear();
        }
        let filled = rest.is_empty() || work.filled_from == own;
        if filled {
            let first = work.out.len() - rest.len();
            rest.copy_from_slice(&work.out[first..]);
        }
        filled
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rcwm_kernels::team::HELPER_NAME;
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::time::Duration;

    const LEN: usize = 64;

    /// Doubles what is in its scratch. The helper does not get on while it is stopped.
    #[derive(Debug, Default)]
    struct Doubling {
        stopped: AtomicBool,
        helped: AtomicBool,
    }

    impl Compute for Doubling {
        type Number = f32;
        type Scratch = Vec<f32>;
        const NAME: &'static str = "Doubling";

        fn shape(&self) -> &[usize] {
            &[LEN]
        }

        fn scratch(&self) -> Vec<f32> {
            vec![0.0; LEN]
        }

        fn piece_len(&self) -> Option<usize> {
            Some(4)
        }

        fn fill(&self, _: &[TValue], scratch: &Vec<f32>, first: usize, out: &mut [f32]) -> TractResult<()> {
            if std::thread::current().name() == Some(HELPER_NAME) {
                self.helped.store(true, Ordering::SeqCst);
                while self.stopped.load(Ordering::SeqCst) {
                    std::thread::sleep(Duration::from_millis(1));
                }
            } else if self.stopped.load(Ordering::SeqCst) {
                // The helper has something to be stopped at.
                while !self.helped.load(Ordering::SeqCst) {
                    std::thread::sleep(Duration::from_millis(1));
                }
            } else {
                std::thread::sleep(Duration::from_micros(50));
            }
            out.iter_mut().zip(&scratch[first..]).for_each(|(out, x)| *out = 2.0 * x);
            Ok(())
        }
    }

    fn run(slot: &Arc<WorkerSlot<Doubling>>, team: &Team, number: f32) -> Vec<f32> {
        let mut out = vec![-1.0; LEN];
        slot.fill(team, &[], &Arc::new(vec![number; LEN]), &mut out).unwrap();
        out
    }

    #[test]
    fn both_threads_fill_one_result() {
        let (compute, team) = (Arc::new(Doubling::default()), Team::start(Duration::from_secs(1)).unwrap());
        let slot = WorkerSlot::new(&compute);
        for number in 0..200 {
            assert_eq!(run(&slot, &team, number as f32), [2.0 * number as f32; LEN]);
        }
        assert!(compute.helped.load(Ordering::SeqCst), "the helper never came");
    }

    #[test]
    fn a_helper_that_is_stopped_in_its_share_is_not_waited_for_and_touches_nothing_afterwards() {
        let (compute, team) = (Arc::new(Doubling::default()), Team::start(Duration::from_secs(1)).unwrap());
        let slot = WorkerSlot::new(&compute);
        compute.stopped.store(true, Ordering::SeqCst);
        // Returns although the helper holds a piece for as long as it takes.
        assert_eq!(run(&slot, &team, 1.0), [2.0; LEN]);
        assert!(team.take_late() && !team.take_late());
        // It is still at it in the next ticks.
        assert_eq!(run(&slot, &team, 3.0), [6.0; LEN]);
        assert!(team.take_late());
        compute.stopped.store(false, Ordering::SeqCst);
        // And comes back with what nobody wants any more.
        while try_lock(&slot.work).is_none() {
            std::thread::sleep(Duration::from_millis(1));
        }
        for number in 4..100 {
            assert_eq!(run(&slot, &team, number as f32), [2.0 * number as f32; LEN]);
        }
    }
}
