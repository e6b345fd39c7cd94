//! Starts the embedded interpreter so that it is the one the program was built for, with the packages of its virtual
//! environment, whatever the caller's environment variables say.

use std::ffi::{CStr, CString};
use std::mem::MaybeUninit;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use pyo3::exceptions::PyImportError;
use pyo3::ffi;
use pyo3::prelude::*;

use crate::SimulatorError;

/// Of the Python the program was built for, `major.minor.micro`.
const BUILT_FOR: &str = env!("RCWM_PYTHON_VERSION");
/// Its interpreter; in a virtual environment, the environment's.
const BUILT_WITH: &str = env!("RCWM_PYTHON_EXECUTABLE");
const VENV_VARIABLE: &str = "RCWM_PYTHON_VENV";

/// The embedded modules, each before those that import it; the last one is the bridge.
const MODULES: [(&CStr, &CStr, &str); 2] = [
    (c"metaworld_look", c"metaworld_look.py", include_str!("../python/metaworld_look.py")),
    (c"metaworld_bridge", c"metaworld_bridge.py", include_str!("../python/metaworld_bridge.py")),
];

/// The virtual environment whose packages are used: `RCWM_PYTHON_VENV`, or that of the build.
fn venv() -> PathBuf {
    let named = std::env::var_os(VENV_VARIABLE).filter(|value| !value.is_empty()).map(PathBuf::from);
    // .../bin/python -> ...
    let built = || Path::new(BUILT_WITH).ancestors().nth(2).unwrap_or(Path::new("/usr")).to_path_buf();
    named.unwrap_or_else(built)
}

/// Starts Python if it does not run yet, and gives the module of `python/metaworld_bridge.py`.
///
/// # Errors
/// Any variant of [`SimulatorError`] that is about Python, its packages or the graphics library.
pub fn bridge() -> Result<Py<PyModule>, SimulatorError> {
    // Held while importing, so that two threads cannot start the interpreter or run the module twice.
    static MODULE: Mutex<Option<Py<PyModule>>> = Mutex::new(None);
    let venv = venv();
    // A thread that panicked while importing leaves the place empty: the import is tried again.
    let mut module = MODULE.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    start(&venv)?;
    Python::attach(|py| {
        if module.is_none() {
            for (name, file, source) in MODULES {
                let code = CString::new(source).expect("the embedded module holds no zero byte");
                let made = PyModule::from_code(py, &code, file, name);
                *module = Some(made.map_err(|error| import_error(py, &error, &venv))?.unbind());
            }
        }
        Ok(module.as_ref().expect("set above").clone_ref(py))
    })
}

/// Starts the interpreter, isolated from the caller's `PYTHON*` variables; does nothing where it already runs.
fn start(venv: &Path) -> Result<(), SimulatorError> {
    // SAFETY: may be called at any time.
    if unsafe { ffi::Py_IsInitialized() } != 0 {
        return Ok(());
    }
    check_venv(venv)?;
    check_library()?;
    let executable = venv.join("bin/python");
    let executable = CString::new(executable.as_os_str().as_bytes())
        .map_err(|_| SimulatorError::NoInterpreter { path: executable })?;
    // SAFETY: no interpreter runs, and `bridge` holds a lock; the calls come in the order that CPython's documentation
    // of `PyConfig` asks for, and the configuration is initialised before it is changed and cleared after its last use.
    unsafe {
        let mut preconfig = MaybeUninit::uninit();
        ffi::PyPreConfig_InitIsolatedConfig(preconfig.as_mut_ptr());
        // Paths are UTF-8, whatever the locale.
        (*preconfig.as_mut_ptr()).utf8_mode = 1;
        check(ffi::Py_PreInitialize(preconfig.as_ptr()))?;

        let mut config = MaybeUninit::<ffi::PyConfig>::uninit();
        let config = config.as_mut_ptr();
        ffi::PyConfig_InitIsolatedConfig(config);
        // From the interpreter's place Python finds `pyvenv.cfg`, and with it library and packages.
        let set = ffi::PyConfig_SetBytesString(config, &raw mut (*config).program_name, executable.as_ptr());
        let started = check(set).and_then(|()| check(ffi::Py_InitializeFromConfig(config)));
        ffi::PyConfig_Clear(config);
        started?;
        // This thread holds the interpreter now; pyo3 takes it again for each call.
        ffi::PyEval_SaveThread();
    }
    Ok(())
}

fn check(status: ffi::PyStatus) -> Result<(), SimulatorError> {
    // SAFETY: a status is plain data.
    if unsafe { ffi::PyStatus_Exception(status) } == 0 {
        return Ok(());
    }
    if status.err_msg.is_null() {
        return Err(SimulatorError::Start(format!("it asked to exit with code {}", status.exitcode)));
    }
    // SAFETY: a failed status points to a constant text.
    let text = unsafe { CStr::from_ptr(status.err_msg) };
    Err(SimulatorError::Start(text.to_string_lossy().into_owned()))
}

/// The library that the linker has loaded must be the one of the build: another one starts without complaint.
fn check_library() -> Result<(), SimulatorError> {
    // SAFETY: returns a constant text, also before the interpreter starts.
    let running = unsafe { CStr::from_ptr(ffi::Py_GetVersion()) }.to_string_lossy();
    let found = running.split_whitespace().next().unwrap_or_default().to_owned();
    if found.trim_end_matches('+') == BUILT_FOR {
        return Ok(());
    }
    Err(SimulatorError::OtherPython {
        what: "the libpython that was loaded".into(),
        found,
        expected: BUILT_FOR,
    })
}

fn check_venv(venv: &Path) -> Result<(), SimulatorError> {
    let path = venv.join("bin/python");
    if !path.exists() {
        return Err(SimulatorError::NoInterpreter { path });
    }
    // Absent where the build used an interpreter without a virtual environment.
    let Ok(settings) = std::fs::read_to_string(venv.join("pyvenv.cfg")) else { return Ok(()) };
    let found = settings.lines().find_map(|line| {
        let (key, value) = line.split_once('=')?;
        matches!(key.trim(), "version" | "version_info").then(|| value.trim().to_owned())
    });
    match found {
        // Packages are compiled for a minor version.
        Some(found) if minor_version(&found) != minor_version(BUILT_FOR) => {
            Err(SimulatorError::OtherPython { what: venv.display().to_string(), found, expected: BUILT_FOR })
        }
        _ => Ok(()),
    }
}

fn minor_version(version: &str) -> Vec<&str> {
    version.split('.').take(2).collect()
}

fn import_error(py: Python<'_>, error: &PyErr, venv: &Path) -> SimulatorError {
    if error.is_instance_of::<PyImportError>(py) {
        let name = error.value(py).getattr("name").and_then(|name| name.extract::<String>());
        if let Ok(package) = name {
            return SimulatorError::MissingPackage { package, venv: venv.to_path_buf() };
        }
    }
    python_error(py, "loading Meta-World", error)
}

/// Turns a Python exception into the variant that says what to do about it.
pub fn python_error(py: Python<'_>, doing: &'static str, error: &PyErr) -> SimulatorError {
    let kind = error.get_type(py).name().map(|name| name.to_string()).unwrap_or_default();
    let text = error.value(py).to_string();
    match kind.as_str() {
        "MissingLibrary" => {
            let package = if text == "EGL" { "libegl1" } else { "libosmesa6" };
            SimulatorError::MissingLibrary { library: text, package }
        }
        _ => SimulatorError::Python { doing, reason: format!("{kind}: {text}") },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_library_that_the_linker_does_not_find_is_reported_with_the_package_that_holds_it() {
        let module = bridge().unwrap();
        Python::attach(|py| {
            let error = module.bind(py).call_method1("load_library", ("NotThere",)).unwrap_err();
            let text = python_error(py, "testing", &error).to_string();
            assert!(text.contains("libNotThere") && text.contains("apt-get install libosmesa6"), "{text}");
        });
    }

    #[test]
    fn a_virtual_environment_of_another_python_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("bin")).unwrap();
        std::fs::write(folder.path().join("bin/python"), "").unwrap();
        std::fs::write(folder.path().join("pyvenv.cfg"), "home = /usr/bin\nversion = 2.7.18\n").unwrap();
        let error = check_venv(folder.path()).unwrap_err();
        assert!(matches!(&error, SimulatorError::OtherPython { found, .. } if found == "2.7.18"), "{error}");
    }

    #[test]
    fn a_folder_without_an_interpreter_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        assert!(matches!(check_venv(folder.path()), Err(SimulatorError::NoInterpreter { .. })));
    }
}
