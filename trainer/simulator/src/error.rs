//! Why the simulator could not start or go on.

use std::path::PathBuf;

use rcwm_models::files::FileError;
use rcwm_models::tasks::UnknownTask;
use rcwm_models::wire::LinkError;

/// One variant per cause; the text says what to do.
#[derive(Debug, thiserror::Error)]
pub enum SimulatorError {
    /// Meta-World has no such task.
    #[error(transparent)]
    UnknownTask(#[from] UnknownTask),
    /// A Python package is not installed.
    #[error(
        "the Python package {package:?} is missing in {venv}: run `scripts/setup demo`, or `{venv}/bin/python -m pip install \
         --require-hashes -r trainer/simulator/requirements.txt`"
    )]
    MissingPackage {
        /// The package that could not be imported.
        package: String,
        /// The virtual environment that was searched.
        venv: PathBuf,
    },
    /// The library for off-screen rendering is not installed.
    #[error(
        "the graphics library lib{library} is missing: run `apt-get install {package}` (as root, or with sudo)"
    )]
    MissingLibrary {
        /// The library, without `lib` and the ending.
        library: String,
        /// The Debian package that holds it.
        package: &'static str,
    },
    /// The virtual environment has no interpreter.
    #[error(
        "no Python interpreter at {path}: run `scripts/setup demo`, or name a virtual environment in RCWM_PYTHON_VENV"
    )]
    NoInterpreter {
        /// The interpreter that was expected.
        path: PathBuf,
    },
    /// The virtual environment, or the library that was loaded, is of another Python than the program was built for.
    #[error("{what} is Python {found}, this program was built for {expected}: build it again (`make build`)")]
    OtherPython {
        /// What was looked at.
        what: String,
        /// Its version.
        found: String,
        /// The version of the build.
        expected: &'static str,
    },
    /// The interpreter did not start.
    #[error("Python did not start: {0}")]
    Start(String),
    /// Python code failed in a way that no other variant describes.
    #[error("{doing}: {reason}")]
    Python {
        /// What was attempted.
        doing: &'static str,
        /// Python's own words.
        reason: String,
    },
    /// The physics has left the numbers.
    #[error(
        "the physics of {task} diverged in episode {episode}, step {step}: a value is not finite; report the seed"
    )]
    Diverged {
        task: String,
        episode: u64,
        /// The step within it.
        step: u32,
    },
    /// No controller answered within the time that was granted.
    #[error(
        "no controller has answered on instance {instance:?} for {seconds} s; start one, or raise --wait-controller"
    )]
    NoController {
        instance: String,
        /// The time granted.
        seconds: u64,
    },
    /// The shared-memory link.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// A file could not be written.
    #[error(transparent)]
    File(#[from] FileError),
    /// A picture could not be encoded.
    #[error("encoding a picture: {0}")]
    Picture(#[from] rcwm_models::picture::PictureError),
}
