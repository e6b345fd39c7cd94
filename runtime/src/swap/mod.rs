//! Another policy in place of the running one, without a missed tick.
//!
//! ```text
//! rcwm-runtime swap --instance arm --bundle DIR        asks, waits, says what happened
//!        |  socket of the instance
//!   server's thread, lowest priority        loads the bundle, verifies it against its golden values, warms it up
//!        |  handover                      one place; nobody waits for it
//!   controller's thread                   looks in after an action was sent, and exchanges the two policies
//! ```
//!
//! The controller's thread never loads, waits, allocates or frees for a swap: it moves the new policy out of the [`Handover`] and the
//! old one in, for a third thread to drop. A bundle that is damaged, that was made for another rate, that misses its
//! golden values or holds numbers that are not finite is refused with one line, and the old policy runs on.
//!
//! **When.** At an episode's start, or at once (`--now`), between two ticks.
//!
//! **State.** The new policy always starts from its own learned initial state, also in the middle of an episode: latents of two trainings
//! mean different things even where their sizes match. It was trained like that: every training sequence begins so, wherever in an
//! episode it was cut from.

mod handover;
mod message;
mod prepare;
mod priority;
mod server;

/// Name of the server of a link: that of an abstract Unix socket.
#[must_use]
pub fn name_of_server(link: &LinkSettings) -> String {
    message::server_name(link)
}

pub use handover::Moment;
pub use message::{Answer, When, ask};

use std::io;
use std::os::unix::net::UnixListener;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::channel;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rcwm_models::bundle::BundleError;
use rcwm_models::interface::{Interface, Mismatch};
use rcwm_models::wire::LinkSettings;

use crate::engine::EngineSettings;
use crate::policy::{NoSuchSurprise, Policy, PolicyError, Sampling, SurpriseLimits};
use crate::verify::VerifyError;
use handover::Handover;
use server::Server;

/// Why a bundle was not taken over, or nobody could be asked.
#[derive(Debug, thiserror::Error)]
pub enum SwapError {
    /// The bundle was refused.
    #[error(transparent)]
    Bundle(#[from] BundleError),
    /// The policy does not load or run.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// It cannot be told whether the bundle computes what it should.
    #[error(transparent)]
    Verify(#[from] VerifyError),
    /// The bundle computes something else than the trainer did.
    #[error("golden values are missed: {first}{}; export the bundle again", more(*others))]
    NotVerified {
        /// What is wrong first.
        first: String,
        /// How much else is.
        others: usize,
    },
    /// The bundle was made for another pace.
    #[error(
        "the bundle decides at {found} Hz, the running one at {expected} Hz; export it for the same rate, or start a new run"
    )]
    Rate {
        /// The new bundle's rate, in Hz.
        found: f64,
        /// The running bundle's rate, in Hz.
        expected: f64,
    },
    /// The bundle was made for another robot.
    #[error("the bundle is for another robot than the running one: {0}; start a new run")]
    DoesNotFit(Mismatch),
    /// The run has a limit of a surprise that the new policy does not have.
    #[error("the run was started with {0}; start a new run")]
    Surprise(#[from] NoSuchSurprise),
    /// Loading panicked; the thread that loads has gone on.
    #[error("loading the bundle failed inside the engine: {0}; export it again")]
    Panicked(String),
    /// The engine's own threads would be slower than the one that ticks.
    #[error(
        "the threads that the engine has started for the bundle cannot get the priority of the run: {0}; use --threads 1, or give \
         the run CAP_SYS_NICE"
    )]
    Helpers(io::Error),
    /// The one who asked has left, or the run ends.
    #[error("nobody wants the bundle any more")]
    Unwanted,
    /// The server could not be opened.
    #[error(
        "the swap server {name:?} cannot be opened: {source}; another run with this instance and RCWM_PREFIX may have it, also one in a \
         container on this network"
    )]
    Server {
        /// Name of the socket.
        name: String,
        source: io::Error,
    },
    /// Nobody answers.
    #[error(
        "no run on instance {instance:?} takes swaps: {source}; start `rcwm-runtime run --bundle DIR --instance {instance}` (same machine, \
         same RCWM_PREFIX)"
    )]
    NoServer { instance: String, source: io::Error },
    /// Somebody else has the server's name.
    #[error(
        "the swap server of instance {instance:?} belongs to user {user}, who is neither you nor root: nothing was asked; start the run and \
         this program as the same user"
    )]
    Stranger {
        instance: String,
        /// The server's user.
        user: u32,
    },
    /// The run ended or spoke in a way that is not understood.
    #[error("the run on the instance {0}")]
    Conversation(String),
}

fn more(others: usize) -> String {
    if others > 0 { format!(" (and {others} more)") } else { String::new() }
}

/// How the server prepares a policy.
#[derive(Debug, Clone)]
pub struct SwapSettings {
    /// The controller's link; names the server.
    pub link: LinkSettings,
    /// Engine of the policies.
    pub engine: EngineSettings,
    /// How they choose latents and actions.
    pub sampling: Sampling,
    /// That of the running policy; another one must fit it.
    pub interface: Interface,
    /// The run's limits; another policy must have what they limit.
    pub surprise: SurpriseLimits,
}

/// How long the end of a run waits for its server.
const TIMEOUT: Duration = Duration::from_millis(500);
/// A server was left in the middle of its work.
static SERVER_LEFT: AtomicBool = AtomicBool::new(false);

/// Whether a server was still loading when its run ended. Its thread goes on, in memory that a process's usual end would tear down under
/// it: such a process is to end at once.
#[must_use]
pub fn server_is_left() -> bool {
    SERVER_LEFT.load(Ordering::Relaxed)
}

/// The controller's end: takes over a policy that is ready.
pub struct Swapper {
    handover: Arc<Handover>,
    stop: Arc<AtomicBool>,
    server: Option<JoinHandle<()>>,
    reaper: Option<JoinHandle<()>>,
}

impl Swapper {
    /// Opens the server of an instance and starts its thread.
    ///
    /// # Errors
    /// [`SwapError::Server`].
    pub fn start(settings: SwapSettings) -> Result<Self, SwapError> {
        let name = message::server_name(&settings.link);
        let failed = |source| SwapError::Server { name: name.clone(), source };
        let listener = message::address(&name).and_then(|at| UnixListener::bind_addr(&at)).map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let (handover, stop) = (Arc::new(Handover::default()), Arc::new(AtomicBool::new(false)));
        let (old, policies) = channel();
        let named = |name: &str| std::thread::Builder::new().name(name.into());
        let shared = Arc::clone(&handover);
        let reaper = named("swap-reaper").spawn(move || server::reap(&policies, &shared)).map_err(failed)?;
        let server = Server::new(settings, listener, Arc::clone(&handover), Arc::clone(&stop), old);
        let server = named("swap").spawn(move || server.serve()).map_err(failed)?;
        Ok(Self { handover, stop, server: Some(server), reaper: Some(reaper) })
    }

    /// Exchanges `policy` for one that is ready and wanted at this moment; true if so. To be called by the thread that ticks, in its
    /// idle time: reads one atomic, and takes a lock only if nobody has it.
    ///
    /// The new policy is in its initial state: its next observation is the first of an episode to it.
    pub fn poll(&self, moment: Moment, policy: &mut Policy) -> bool {
        self.handover.exchange(moment, policy)
    }
}

impl Drop for Swapper {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let start = Instant::now();
        // The server first: the reaper ends when nobody can bring it anything.
        for thread in self.server.take().into_iter().chain(self.reaper.take()) {
            thread.thread().unpark();
            while !thread.is_finished() && start.elapsed() < TIMEOUT {
                std::thread::sleep(Duration::from_millis(2));
            }
            // Whatever a bundle makes it do, the end of the run does not wait for it.
            if !thread.is_finished() {
                SERVER_LEFT.store(true, Ordering::Relaxed);
                return;
            }
            // A panic there has been printed; there is nothing left to do about it.
            let _ = thread.join();
        }
    }
}
