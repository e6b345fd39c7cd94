//! The server's thread: hears requests one after another, prepares, hands over, and says what happened.

use std::io::{self, Read};
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender};
use std::time::{Duration, Instant};

use rcwm_models::errors::one_line;

use super::handover::Handover;
use super::message::{self, Answer, Request};
use super::{SwapError, SwapSettings, prepare, priority};
use crate::policy::Policy;

/// How often the server looks for somebody who asks.
const LOOK: Duration = Duration::from_millis(50);
/// How often it looks whether its policy was taken.
const LOOK_READY: Duration = Duration::from_millis(5);
/// How long somebody who has come may take to say what they want.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(2);

pub(super) struct Server {
    settings: SwapSettings,
    listener: UnixListener,
    handover: Arc<Handover>,
    stop: Arc<AtomicBool>,
    reaper: Sender<Policy>,
}

impl Server {
    pub(super) fn new(
        settings: SwapSettings,
        listener: UnixListener,
        handover: Arc<Handover>,
        stop: Arc<AtomicBool>,
        reaper: Sender<Policy>,
    ) -> Self {
        Self { settings, listener, handover, stop, reaper }
    }

    fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Until the run ends.
    pub(super) fn serve(&self) {
        let lowered = priority::lower().map_err(|error| format!("the priority cannot be lowered: {error}"));
        while !self.stopped() {
            match self.listener.accept() {
                // Somebody who hangs up early has nothing to be told.
                Ok((stream, _)) => drop(self.converse(&stream, &lowered)),
                Err(_) => std::thread::park_timeout(LOOK),
            }
        }
    }

    fn converse(&self, stream: &UnixStream, lowered: &Result<(), String>) -> io::Result<()> {
        stream.set_nonblocking(false)?;
        stream.set_read_timeout(Some(REQUEST_TIMEOUT))?;
        stream.set_write_timeout(Some(REQUEST_TIMEOUT))?;
        let refuse = |reason: String| message::say(stream, &Answer::Refused { reason });
        if !may_ask(stream)? {
            return refuse("only the user of the run, or root, may ask for a swap".into());
        }
        if let Err(reason) = lowered {
            return refuse(format!("loading would disturb the run: {reason}"));
        }
        let request = match message::hear(stream) {
            Ok(Request { version, .. }) if version != message::VERSION => {
                return refuse(format!("version {version} of the request, expected {}", message::VERSION));
            }
            Ok(request) => request,
            Err(error) => return refuse(format!("the request is not understood: {error}")),
        };
        message::say(stream, &Answer::Loading)?;
        let start = Instant::now();
        match self.prepare(&request, &|| !self.stopped() && !has_left(stream)) {
            Ok(policy) => {
                message::say(stream, &Answer::Ready { prepared_s: start.elapsed().as_secs_f64() })?;
                // Who has left before hearing this may rely on it that the bundle is not laid out.
                match has_left(stream) {
                    true => message::say(stream, &Answer::Withdrawn),
                    false => self.hand_over(stream, policy, &request),
                }
            }
            Err(SwapError::Unwanted) => message::say(stream, &Answer::Withdrawn),
            Err(error) => refuse(one_line(&error)),
        }
    }

    fn prepare(&self, request: &Request, wanted: &dyn Fn() -> bool) -> Result<Policy, SwapError> {
        let before = priority::threads().map_err(SwapError::Helpers)?;
        let policy = prepare::prepare(&request.bundle, &self.settings, wanted)?;
        // What the run itself has started meanwhile is among them: it gets what it would have inherited.
        let helpers = &priority::threads().map_err(SwapError::Helpers)? - &before;
        while !helpers.is_empty() && wanted() {
            if let Some(ticking) = self.handover.ticking() {
                let given = helpers.iter().try_for_each(|to| match priority::give(ticking, *to) {
                    // It has ended since.
                    Err(error) if error.raw_os_error() == Some(libc::ESRCH) => Ok(()),
                    other => other,
                });
                given.map_err(SwapError::Helpers)?;
                break;
            }
            std::thread::park_timeout(LOOK);
        }
        Ok(policy)
    }

    /// Until the policy is taken, or nobody wants it any more.
    fn hand_over(&self, stream: &UnixStream, policy: Policy, request: &Request) -> io::Result<()> {
        let provenance = policy.manifest().provenance.clone();
        let task = policy.manifest().task.clone();
        let start = Instant::now();
        self.handover.put(policy, request.when);
        let (old, answer) = loop {
            let left = has_left(stream);
            if let Some(old) = self.handover.old() {
                break (Some(old), None);
            }
            if left || self.stopped() {
                let (policy, taken) = self.handover.withdraw();
                let ended =
                    Answer::Refused { reason: "the run has ended before the bundle was taken".into() };
                let answer = if left { Answer::Withdrawn } else { ended };
                break (policy, (!taken).then_some(answer));
            }
            std::thread::park_timeout(LOOK_READY);
        };
        let waited_s = start.elapsed().as_secs_f64();
        if let Some(old) = old {
            // It is there until this thread has ended.
            let _ = self.reaper.send(old);
        }
        let (preset, updates) = (provenance.preset, provenance.updates);
        let answer = answer.unwrap_or(Answer::Taken { task, preset, updates, waited_s });
        message::say(stream, &answer)
    }
}

/// Drops old policies, on a thread that is not of low priority: their memory belongs to the thread that has ticked with them, and whoever
/// gives it back holds that thread's allocator for a moment. One that is not scheduled meanwhile would hold up a tick.
pub(super) fn reap(policies: &Receiver<Policy>, handover: &Handover) {
    for old in policies {
        if let Some(ticking) = handover.ticking() {
            // Where that is not allowed, the priority it was started with must do.
            let _ = priority::give(ticking, 0);
        }
        drop(old);
    }
}

/// Whether the one who asks has closed its end; never waits.
fn has_left(mut stream: &UnixStream) -> bool {
    let looked = stream.set_nonblocking(true).and_then(|()| stream.read(&mut [0; 64]));
    let left = match looked {
        Ok(len) => len == 0,
        Err(error) => !message::is_timeout(&error),
    };
    left || stream.set_nonblocking(false).is_err()
}

/// The run's own user and root.
fn may_ask(stream: &UnixStream) -> io::Result<bool> {
    let uid = message::user_of_peer(stream)?;
    Ok(uid == 0 || uid == rustix::process::geteuid().as_raw())
}
