//! What the tests across processes share: the built binaries, a shared-memory domain of their own, children that never outlive
//! a test.
//!
//! The binaries are those beside the test's own in the target folder; `make test` builds them first.

pub mod campaign;
pub mod faults;
pub mod stream;

use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use iceoryx2::prelude::*;
use rcwm_models::wire::{LinkSettings, ObservationHeader, ObserverLink, Wait, forget_prefix, list_leftovers};

/// How long anything in a test may take before it counts as hung.
pub const TIMEOUT: Duration = Duration::from_secs(120);

/// The root of the repository.
#[must_use]
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .expect("the tests are a member of the workspace")
        .to_path_buf()
}

/// The bundle that is shipped for the demo.
#[must_use]
pub fn shipped_bundle() -> PathBuf {
    root().join("models/bundles/untrained")
}

/// A built binary of this workspace.
///
/// # Panics
/// When it was not built: `cargo build --release --workspace --lib --bins`.
#[must_use]
pub fn binary(name: &str) -> PathBuf {
    let own = std::env::current_exe().expect("a test has a path");
    // target/release/deps/test-1234 or target/release/fault-table -> target/release
    let mut folder = own.parent().expect("a program lies in a folder");
    if folder.ends_with("deps") {
        folder = folder.parent().expect("tests lie in target/<profile>/deps");
    }
    let path = folder.join(name);
    assert!(
        path.is_file(),
        "{} is missing: build it first with `make test`, or cargo build --release --workspace --lib --bins",
        path.display()
    );
    path
}

/// The interpreter of the project's Python environment.
///
/// # Panics
/// When it was not set up.
#[must_use]
pub fn python() -> PathBuf {
    let path = root().join(".venv/bin/python");
    assert!(path.exists(), "{} is missing: run scripts/setup test", path.display());
    path
}

/// The Python package with the native module that cargo has built: a folder for `PYTHONPATH`, as a wheel would be unpacked.
///
/// # Panics
/// When the module was not built, or the folder cannot be made.
#[must_use]
pub fn python_package() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let package = folder.path().join("rcwm");
    std::fs::create_dir(&package).expect("a folder in a new folder");
    let link = |from: &Path, name: &std::ffi::OsStr| {
        std::os::unix::fs::symlink(from, package.join(name)).expect("a link in a new folder");
    };
    let sources = std::fs::read_dir(root().join("runtime/python/src/rcwm")).expect("the package's sources");
    for path in sources.map(|entry| entry.expect("a readable folder").path()) {
        // One that was built into the sources is older or newer than what is tested.
        if path.extension().is_none_or(|extension| extension != "so") {
            link(&path, path.file_name().expect("a name in a folder"));
        }
    }
    link(&binary("librcwm_python.so"), "_rcwm.abi3.so".as_ref());
    folder
}

/// A shared-memory domain that only this test uses.
#[derive(Debug)]
pub struct Domain {
    prefix: String,
    package: OnceLock<tempfile::TempDir>,
}

impl Domain {
    /// A new domain.
    #[must_use]
    #[expect(clippy::new_without_default, reason = "every domain is another one")]
    pub fn new() -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let prefix = format!("rcwm_t{}_{}_", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        Self { prefix, package: OnceLock::new() }
    }

    /// The prefix of its files.
    #[must_use]
    pub fn prefix(&self) -> &str {
        &self.prefix
    }

    /// Settings of a link in this domain.
    #[must_use]
    pub fn link(&self, instance: &str) -> LinkSettings {
        LinkSettings { prefix: Some(self.prefix.clone()), ..LinkSettings::new(instance) }
    }

    /// A command for a built binary in this domain.
    #[must_use]
    pub fn command(&self, name: &str) -> Command {
        self.within(Command::new(binary(name)))
    }

    /// A command for a Python program in this domain, which can import the package.
    #[must_use]
    pub fn python(&self, script: &Path) -> Command {
        let mut command = Command::new(python());
        command.arg(script).env("PYTHONPATH", self.package.get_or_init(python_package).path());
        self.within(command)
    }

    fn within(&self, mut command: Command) -> Command {
        command.env("RCWM_PREFIX", &self.prefix).env("RUST_BACKTRACE", "0").stdin(Stdio::null());
        command
    }

    /// Files left in shared memory once nobody is alive.
    ///
    /// # Panics
    /// When shared memory cannot be read.
    #[must_use]
    pub fn leftovers(&self) -> Vec<String> {
        list_leftovers(&self.prefix).expect("shared memory can be read")
    }
}

impl Drop for Domain {
    fn drop(&mut self) {
        forget_prefix(&self.prefix);
    }
}

/// A child process that is killed when the test forgets it. Its output goes to files, so that it never blocks.
#[derive(Debug)]
pub struct Running {
    child: Child,
    name: String,
    output: tempfile::NamedTempFile,
}

impl Running {
    /// Starts a command.
    ///
    /// # Panics
    /// When it cannot be started.
    #[must_use]
    pub fn start(mut command: Command) -> Self {
        let name = format!("{:?}", command.get_program());
        let output = tempfile::NamedTempFile::new().expect("a temporary file");
        let (out, err) = (output.reopen().expect("reopen"), output.reopen().expect("reopen"));
        let append = |file: std::fs::File| {
            rustix::fs::fcntl_setfl(&file, rustix::fs::OFlags::APPEND).expect("append mode");
            file
        };
        let child = command.stdout(append(out)).stderr(append(err)).spawn();
        let child = child.unwrap_or_else(|error| panic!("{name} does not start: {error}"));
        Self { child, name, output }
    }

    /// Everything it has printed so far.
    ///
    /// # Panics
    /// When the file of its output cannot be read.
    #[must_use]
    pub fn printed(&self) -> String {
        let mut bytes = Vec::new();
        self.output.reopen().expect("reopen").read_to_end(&mut bytes).expect("output can be read");
        String::from_utf8_lossy(&bytes).into_owned()
    }

    /// Whether it still runs.
    ///
    /// # Panics
    /// When the system does not say.
    #[must_use]
    pub fn is_running(&mut self) -> bool {
        self.child.try_wait().expect("its state is known").is_none()
    }

    /// The number of its process.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Sends a signal.
    ///
    /// # Panics
    /// When it is gone already.
    pub fn signal(&self, signal: rustix::process::Signal) {
        let pid = rustix::process::Pid::from_child(&self.child);
        rustix::process::kill_process(pid, signal).expect("it takes signals");
    }

    /// Kills it without warning (SIGKILL) and waits until it is gone.
    ///
    /// # Panics
    /// When it was gone already.
    pub fn kill(mut self) {
        self.child.kill().expect("it can be killed");
        self.child.wait().expect("it is gone");
    }

    /// Waits for its end.
    ///
    /// # Panics
    /// When it has not ended within [`TIMEOUT`].
    pub fn end(&mut self) -> ExitStatus {
        let start = Instant::now();
        while start.elapsed() < TIMEOUT {
            if let Some(status) = self.child.try_wait().expect("its state is known") {
                return status;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        panic!("{} still runs after {TIMEOUT:?}; it printed:\n{}", self.name, self.printed());
    }

    /// Waits for its end, which must be a success.
    ///
    /// # Panics
    /// When it fails or hangs.
    pub fn succeed(&mut self) {
        let status = self.end();
        assert!(status.success(), "{} ended with {status}; it printed:\n{}", self.name, self.printed());
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if self.child.try_wait().is_ok_and(|status| status.is_none()) {
            // A test that failed: nothing more can be done about a child that does not die.
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }
}

/// Runs a command to its end and gives what it printed.
///
/// # Panics
/// When it cannot be started.
#[must_use]
pub fn output(mut command: Command) -> Output {
    command.output().unwrap_or_else(|error| panic!("{:?} does not start: {error}", command.get_program()))
}

/// Waits until `condition` holds.
///
/// # Panics
/// When it does not within [`TIMEOUT`].
pub fn eventually(what: &str, mut condition: impl FnMut() -> bool) {
    let start = Instant::now();
    while !condition() {
        assert!(start.elapsed() < TIMEOUT, "{what}: not within {TIMEOUT:?}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Reads a JSON file that a verb has written.
///
/// # Panics
/// When it is missing or no JSON.
#[must_use]
pub fn read_json(path: &Path) -> serde_json::Value {
    let text = std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{}: {error}\n{text}", path.display()))
}

/// Listens in on an instance, so that a test knows how far its simulator has come.
pub struct Observer(ObserverLink);

impl Observer {
    /// Joins an instance.
    ///
    /// # Panics
    /// When shared memory cannot be used.
    #[must_use]
    pub fn new(domain: &Domain, instance: &str) -> Self {
        Self(ObserverLink::open(domain.link(instance)).expect("the instance can be joined"))
    }

    /// Waits for an observation that fits, and gives its sequence.
    ///
    /// # Panics
    /// When none comes within [`TIMEOUT`].
    pub fn wait_for(&self, mut fits: impl FnMut(&ObservationHeader) -> bool) -> u64 {
        let start = Instant::now();
        while start.elapsed() < TIMEOUT {
            let wait = self.0.wait_observation(Duration::from_millis(100)).expect("the link works");
            match wait {
                Wait::Message(sample) if fits(&sample) => return sample.sequence,
                _ => {}
            }
        }
        panic!("no fitting observation within {TIMEOUT:?}");
    }
}

/// An observation as a version before the first would have had it.
#[derive(Debug, Clone, Copy, ZeroCopySend)]
#[type_name("rcwm.Observation.v1")]
#[repr(C)]
struct OldObservation {
    sequence: u64,
}

/// Holds an instance's observation service with the message of another version.
pub struct OldPeer {
    _service:
        iceoryx2::service::port_factory::publish_subscribe::PortFactory<ipc::Service, OldObservation, ()>,
    _node: Node<ipc::Service>,
}

impl OldPeer {
    /// Takes the instance.
    ///
    /// # Panics
    /// When shared memory cannot be used.
    #[must_use]
    pub fn new(domain: &Domain, instance: &str) -> Self {
        let mut config = Config::default();
        config.global.prefix = FileName::new(domain.prefix().as_bytes()).expect("a plain prefix");
        let node = NodeBuilder::new().config(&config).create::<ipc::Service>().expect("a node");
        let name = format!("rcwm/{instance}/observation");
        let service = node
            .service_builder(&name.as_str().try_into().expect("a plain name"))
            .publish_subscribe::<OldObservation>()
            .open_or_create()
            .expect("the instance is free");
        Self { _service: service, _node: node }
    }
}
