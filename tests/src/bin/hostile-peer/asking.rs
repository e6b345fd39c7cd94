//! Swaps in the middle of a run, asked for as a deployer asks. The world's time stands while a bundle is prepared and taken, so that the
//! same message meets the same policy every time.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rcwm_models::wire::LinkSettings;
use rcwm_runtime::swap::{self, Answer};
use rustix::process::{Pid, getpriority_process, setpriority_process};

use crate::bundles::Known;

/// How long preparing may take.
const PREPARED_IN: Duration = Duration::from_secs(120);
/// How often it is looked whether the bundle is ready.
const LOOK: Duration = Duration::from_millis(20);
/// From "ready" until the policy lies where the controller looks.
const LAID_OUT_IN: Duration = Duration::from_millis(15);

/// What has become of a swap.
pub(crate) enum Said {
    Nothing,
    Taken(Known),
    /// The old one runs on.
    Refused(Known),
}

struct Pending {
    answers: Receiver<Answer>,
    known: Known,
    now: bool,
    /// A tick has shown the new policy already.
    shown: bool,
}

/// Whoever asks for swaps.
pub(crate) struct Asking {
    link: LinkSettings,
    bundles: Vec<(PathBuf, Option<Known>)>,
    running: Known,
    pending: Option<Pending>,
    policy: Option<u64>,
    taken: u64,
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Asking {
    pub(crate) fn new(link: LinkSettings, bundles: Vec<(PathBuf, Option<Known>)>, running: Known) -> Self {
        let stop = Arc::default();
        Self { link, bundles, running, pending: None, policy: None, taken: 0, stop, threads: Vec::new() }
    }

    /// Asks, and waits until the bundle is ready; none where it was refused, or another is awaited.
    pub(crate) fn ask(&mut self, bundle: usize, now: bool) -> Option<Known> {
        if self.pending.is_some() {
            return None;
        }
        let (folder, known) = self.bundles.get(bundle)?.clone();
        let (link, stop) = (self.link.clone(), Arc::clone(&self.stop));
        let when = if now { swap::When::Now } else { swap::When::Episode };
        let (sender, answers) = channel();
        self.threads.push(std::thread::spawn(move || {
            // What is said last is said to `listen` as well; nobody there is as good as refused.
            let _ = swap::ask(&link, &folder, when, None, &stop, &mut |answer| {
                let _ = sender.send(answer.clone());
            });
        }));
        let start = Instant::now();
        loop {
            match answers.recv_timeout(LOOK) {
                Ok(Answer::Loading) => {}
                Ok(Answer::Ready { .. }) => break,
                Err(RecvTimeoutError::Timeout) if start.elapsed() < PREPARED_IN => hasten(),
                _ => return None,
            }
        }
        std::thread::sleep(LAID_OUT_IN);
        let known = known?;
        self.pending = Some(Pending { answers, known, now, shown: false });
        Some(known)
    }

    /// Time stands still until the policy is taken.
    pub(crate) fn is_awaited(&self) -> bool {
        self.pending.as_ref().is_some_and(|pending| pending.now)
    }

    pub(crate) fn hear(&mut self) -> Said {
        let Some(pending) = &self.pending else { return Said::Nothing };
        let wait = if pending.now { Duration::from_millis(5) } else { Duration::ZERO };
        match pending.answers.recv_timeout(wait) {
            Ok(Answer::Taken { .. }) => {
                self.taken += 1;
                self.running = pending.known;
                self.pending = None;
                Said::Taken(self.running)
            }
            Ok(Answer::Loading | Answer::Ready { .. }) | Err(RecvTimeoutError::Timeout) => Said::Nothing,
            Ok(_) | Err(RecvTimeoutError::Disconnected) => {
                self.pending = None;
                Said::Refused(self.running)
            }
        }
    }

    /// A tick of the policy of this number was shown; the new policy's limits where it is the first of it.
    pub(crate) fn ticked(&mut self, policy: u64) -> Option<Known> {
        let before = self.policy.replace(policy);
        let pending = self.pending.as_mut()?;
        let is_new = before.is_some_and(|before| before != policy) && !pending.shown;
        pending.shown |= is_new;
        is_new.then_some(pending.known)
    }

    /// How many were taken.
    pub(crate) fn taken(&mut self) -> u64 {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // One that has panicked has been printed.
            let _ = thread.join();
        }
        if let Some(pending) = self.pending.take() {
            self.taken +=
                pending.answers.try_iter().filter(|answer| matches!(answer, Answer::Taken { .. })).count()
                    as u64;
        }
        self.taken
    }
}

/// Takes the threads that load bundles out of the lowest priority, where that is allowed: the controller waits for them here, and a busy
/// machine would take minutes.
fn hasten() {
    let (Ok(own), Ok(tasks)) = (getpriority_process(None), std::fs::read_dir("/proc/self/task")) else {
        return;
    };
    for task in tasks.flatten() {
        let is_swap =
            std::fs::read_to_string(task.path().join("comm")).is_ok_and(|name| name.trim() == "swap");
        let number = task.file_name().to_str().and_then(|name| name.parse().ok());
        if let Some(thread) = number.filter(|_| is_swap).and_then(Pid::from_raw) {
            // Who may not do that waits longer.
            let _ = setpriority_process(Some(thread), own);
        }
    }
}
