//! What every experiment stands on: a domain of its own, a controller, a robot, a witness.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rcwm_models::wire::LinkSettings;

use super::peer::{Fault, Served, serve};
use super::witness::Witness;
use crate::{Domain, Running, read_json, shipped_bundle};

const INSTANCE: &str = "fault";

/// How the controller is started.
#[derive(Debug, Clone)]
pub struct ControllerOptions {
    pub bundle: PathBuf,
    /// `--imagined-ticks-max`.
    pub imagined_ticks_max: u32,
    /// `--fallback-ticks-max`.
    pub fallback_ticks_max: u32,
}

impl Default for ControllerOptions {
    fn default() -> Self {
        Self { bundle: shipped_bundle(), imagined_ticks_max: 5, fallback_ticks_max: 200 }
    }
}

/// A place for one experiment.
pub struct Bed {
    domain: Domain,
    witness: Option<Witness>,
    folder: tempfile::TempDir,
    /// The control period.
    pub period: Duration,
}

impl Bed {
    /// A new place, with a witness already there.
    ///
    /// # Panics
    /// When shared memory or temporary files cannot be used.
    #[must_use]
    pub fn new(period: Duration) -> Self {
        let domain = Domain::new();
        let witness = Some(Witness::start(domain.link(INSTANCE)));
        Self { domain, witness, folder: tempfile::tempdir().expect("a temporary folder"), period }
    }

    /// The witness.
    ///
    /// # Panics
    /// Never: it leaves with the bed.
    #[must_use]
    pub fn witness(&self) -> &Witness {
        self.witness.as_ref().expect("it leaves with the bed")
    }

    /// The link's settings.
    #[must_use]
    pub fn link(&self) -> LinkSettings {
        self.domain.link(INSTANCE)
    }

    fn json(&self) -> PathBuf {
        self.folder.path().join("run.json")
    }

    /// Starts the controller's binary.
    #[must_use]
    pub fn start_controller(&self, options: &ControllerOptions) -> Running {
        let mut command = self.domain.command("rcwm-runtime");
        command.args(["run", "--instance", INSTANCE, "--stay", "--bundle"]).arg(&options.bundle);
        command.args(["--imagined-ticks-max", &options.imagined_ticks_max.to_string()]);
        command.args(["--fallback-ticks-max", &options.fallback_ticks_max.to_string()]);
        command.arg("--json").arg(self.json());
        Running::start(command)
    }

    /// Ends a controller with Ctrl-C, and gives its report.
    ///
    /// # Panics
    /// When it does not end well.
    #[must_use]
    pub fn end_controller(&self, mut controller: Running) -> serde_json::Value {
        controller.signal(rustix::process::Signal::INT);
        controller.succeed();
        read_json(&self.json())
    }

    /// Starts a robot in a process of its own, which can be killed and stopped; it never ends by itself.
    #[must_use]
    pub fn start_peer(&self) -> Running {
        let mut command = self.domain.command("fault-table");
        command.args(["peer", "--instance", INSTANCE, "--period-us", &self.period.as_micros().to_string()]);
        Running::start(command)
    }

    /// Starts a robot with faults in a thread; it ends by itself after so many of them.
    #[must_use]
    pub fn start_faulty_peer(&self, fault: Fault, hits_max: usize) -> FaultyPeer {
        let (link, period) = (self.link(), self.period);
        let stop = Arc::<AtomicBool>::default();
        let stopped = Arc::clone(&stop);
        let thread = std::thread::spawn(move || {
            serve(link, period, fault, hits_max, &stopped).expect("the link works")
        });
        FaultyPeer { thread, stop }
    }

    /// Leaves, and gives what is left in shared memory.
    #[must_use]
    pub fn leave(mut self) -> Vec<String> {
        self.witness = None;
        self.domain.leftovers()
    }

    /// A folder for files of the experiment.
    #[must_use]
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }
}

/// A robot in a thread.
pub struct FaultyPeer {
    thread: JoinHandle<Served>,
    stop: Arc<AtomicBool>,
}

impl FaultyPeer {
    /// Waits until it has had all its faults.
    ///
    /// # Panics
    /// When its link has failed.
    #[must_use]
    pub fn served(self) -> Served {
        self.thread.join().expect("the peer's link works")
    }

    /// Ends it.
    ///
    /// # Panics
    /// When its link has failed.
    #[must_use]
    pub fn stop(self) -> Served {
        self.stop.store(true, Ordering::Relaxed);
        self.served()
    }
}
