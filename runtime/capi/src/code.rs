//! How a call ended: a code, and a text that belongs to the calling thread.

use std::cell::RefCell;
use std::ffi::{CStr, c_char};

use rcwm_models::interface::InterfaceFileError;
use rcwm_models::wire::LinkError;
use rcwm_models::wire::robot::ServeError;
use rcwm_runtime::{EngineError, PolicyError};

/// Version of this header. Programs built against another `MINOR` (from 1.0 on: another `MAJOR`) must be built again.
pub const RCWM_VERSION_MAJOR: u32 = 0;
pub const RCWM_VERSION_MINOR: u32 = 1;
pub const RCWM_VERSION_PATCH: u32 = 0;

/// How a call ended. rcwm_last_error() has the words.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(i32)]
pub enum Code {
    RcwmOk = 0,
    /// What was handed over is wrong: a null pointer, a length, a text that is not UTF-8, a number that is not finite. Nothing was done.
    RcwmErrorArgument = 1,
    /// The handle cannot do this now: it is in use by another thread or by the callback that asks, or its link was closed.
    RcwmErrorState = 2,
    /// A robot.toml cannot be read or is no interface; the text names the line.
    RcwmErrorInterface = 3,
    /// A bundle was refused: missing, damaged or of another version.
    RcwmErrorBundle = 4,
    /// The engine could not load or run a part.
    RcwmErrorEngine = 5,
    /// A number that is not finite: of the policy, whose state is then that of the last good tick, or measured by the robot.
    RcwmErrorNotFinite = 6,
    /// Shared memory: full, not permitted, of another version, or another robot is connected under this name.
    RcwmErrorLink = 7,
    /// No controller has answered in time.
    RcwmErrorNoAnswer = 8,
    /// The robot's own: a callback has failed, or there is no safe action that is known.
    RcwmErrorRobot = 9,
    /// A fault of this library, which has caught it. The handle is of no further use: close it.
    RcwmErrorPanic = 10,
}

/// A call that failed.
#[derive(Debug)]
pub(crate) struct Failure {
    pub(crate) code: Code,
    pub(crate) text: String,
}

impl Failure {
    pub(crate) fn new(code: Code, text: impl Into<String>) -> Self {
        Self { code, text: text.into() }
    }

    pub(crate) fn argument(text: impl Into<String>) -> Self {
        Self::new(Code::RcwmErrorArgument, text)
    }
}

impl From<PolicyError> for Failure {
    fn from(error: PolicyError) -> Self {
        let code = match &error {
            PolicyError::Bundle(_) | PolicyError::Engine(EngineError::Weights { .. }) => {
                Code::RcwmErrorBundle
            }
            PolicyError::Observation(_) => Code::RcwmErrorArgument,
            PolicyError::NotFinite { .. } | PolicyError::Engine(EngineError::NotFinite { .. }) => {
                Code::RcwmErrorNotFinite
            }
            PolicyError::Engine(_)
            | PolicyError::Compile(_)
            | PolicyError::NothingToSample
            | PolicyError::Thread(_) => Code::RcwmErrorEngine,
        };
        Self::new(code, error.to_string())
    }
}

impl From<LinkError> for Failure {
    fn from(error: LinkError) -> Self {
        let code = match error {
            LinkError::InstanceName(_) | LinkError::Prefix(_) => Code::RcwmErrorArgument,
            _ => Code::RcwmErrorLink,
        };
        Self::new(code, error.to_string())
    }
}

impl From<InterfaceFileError> for Failure {
    fn from(error: InterfaceFileError) -> Self {
        Self::new(Code::RcwmErrorInterface, error.to_string())
    }
}

impl From<ServeError> for Failure {
    fn from(error: ServeError) -> Self {
        let cause = match &error {
            ServeError::Unrested { cause, .. } => cause,
            error => error,
        };
        let code = match cause {
            ServeError::Link(_) => match error {
                ServeError::Link(link) => return link.into(),
                _ => Code::RcwmErrorRobot,
            },
            ServeError::Unrested { .. } => Code::RcwmErrorRobot,
            ServeError::Robot { .. } | ServeError::NoRest => Code::RcwmErrorRobot,
            ServeError::NoAnswer { .. } => Code::RcwmErrorNoAnswer,
            ServeError::NotFinite { .. } => Code::RcwmErrorNotFinite,
        };
        Self::new(code, error.to_string())
    }
}

/// Longest text of an error, its end included; longer ones are cut.
const TEXT_BYTES: usize = 4096;

thread_local! {
    // Of a type without a destructor, so that it can be read as long as its thread lives.
    static TEXT: RefCell<[u8; TEXT_BYTES]> = const { RefCell::new([0; TEXT_BYTES]) };
}

/// Notes what went wrong for this thread to read.
pub(crate) fn note(text: &str) {
    TEXT.with_borrow_mut(|to| {
        let end = text.floor_char_boundary(TEXT_BYTES - 1);
        to[..end].copy_from_slice(&text.as_bytes()[..end]);
        // A text of C ends at its first zero.
        to[..end].iter_mut().filter(|byte| **byte == 0).for_each(|byte| *byte = b'?');
        to[end] = 0;
    });
}

/// What was noted last.
pub(crate) fn noted() -> String {
    TEXT.with_borrow(|text| {
        let text = CStr::from_bytes_until_nul(text).unwrap_or_default();
        text.to_string_lossy().into_owned()
    })
}

/// What went wrong in the last call of the calling thread that failed, on one line: what was found, what was expected, what to do. Empty
/// where none has failed. Never null; valid until a call of the same thread fails. (A text for each thread, because a handle that could not
/// be opened has no place for one.)
#[unsafe(no_mangle)]
pub extern "C" fn rcwm_last_error() -> *const c_char {
    TEXT.with(|text| text.as_ptr().cast_const().cast())
}

/// The name of a code, for example "RCWM_ERROR_BUNDLE"; "unknown" for what is none. Never null.
#[unsafe(no_mangle)]
pub extern "C" fn rcwm_code_name(code: i32) -> *const c_char {
    let name = match code {
        0 => c"RCWM_OK",
        1 => c"RCWM_ERROR_ARGUMENT",
        2 => c"RCWM_ERROR_STATE",
        3 => c"RCWM_ERROR_INTERFACE",
        4 => c"RCWM_ERROR_BUNDLE",
        5 => c"RCWM_ERROR_ENGINE",
        6 => c"RCWM_ERROR_NOT_FINITE",
        7 => c"RCWM_ERROR_LINK",
        8 => c"RCWM_ERROR_NO_ANSWER",
        9 => c"RCWM_ERROR_ROBOT",
        10 => c"RCWM_ERROR_PANIC",
        _ => c"unknown",
    };
    name.as_ptr()
}

/// Version of the library that is running, for example "0.1.0".
#[unsafe(no_mangle)]
pub extern "C" fn rcwm_version() -> *const c_char {
    const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), "\0");
    VERSION.as_ptr().cast()
}

/// Says in a callback why it fails: `return rcwm_fail("the brakes are on");`. The text becomes part of what rcwm_robot_serve() fails with.
/// Gives RCWM_ERROR_ROBOT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_fail(text: *const c_char) -> i32 {
    // SAFETY: the caller gives a text that ends with a zero, or null.
    let text = (!text.is_null()).then(|| unsafe { CStr::from_ptr(text) });
    note(&text.map_or_else(|| "without a reason".into(), CStr::to_string_lossy));
    Code::RcwmErrorRobot as i32
}
