//! Finds the Python that pyo3 was built for, and bakes in where its library and its packages are: a program that starts with
//! another libpython, or without the packages of the virtual environment, would fail late and without a word.

use std::path::{Path, PathBuf};

/// One fact a line: what the interpreter says about itself.
const SCRIPT: &str = r#"
import sys, sysconfig
value = sysconfig.get_config_var
print(sys.executable)
print(".".join(map(str, sys.version_info[:3])))
print(value("Py_ENABLE_SHARED"))
print(value("INSTSONAME") or "")
print(value("LDLIBRARY") or "")
print(value("LIBDIR") or "")
print(value("MULTIARCH") or "")
print(value("LIBPL") or "")
"#;

const VERSION_MIN: (u32, u32) = (3, 11);

struct Interpreter {
    executable: String,
    version: String,
    /// The library's file, or nothing when this Python was built without one.
    soname: Option<String>,
    ldlibrary: String,
    folders: Vec<PathBuf>,
}

impl Interpreter {
    fn ask() -> Result<Self, String> {
        let text = pyo3_build_config::get()
            .run_python_script(SCRIPT)
            .map_err(|error| format!("the Python interpreter does not run: {error}"))?;
        let facts: Vec<&str> = text.lines().collect();
        let [executable, version, shared, soname, ldlibrary, libdir, multiarch, libpl] = facts[..] else {
            return Err(format!("the Python interpreter answered with {} lines, expected 8", facts.len()));
        };
        let libdir = Path::new(libdir);
        Ok(Self {
            executable: executable.to_owned(),
            version: version.to_owned(),
            soname: (shared == "1" && !soname.is_empty()).then(|| soname.to_owned()),
            ldlibrary: ldlibrary.to_owned(),
            folders: vec![libdir.to_path_buf(), libdir.join(multiarch), PathBuf::from(libpl)],
        })
    }

    fn version_fits(&self) -> bool {
        let mut numbers = self.version.split('.').map_while(|number| number.parse::<u32>().ok());
        matches!((numbers.next(), numbers.next()), (Some(major), Some(minor)) if (major, minor) >= VERSION_MIN)
    }

    fn folder_of(&self, file: &str) -> Option<&PathBuf> {
        self.folders.iter().find(|folder| folder.join(file).exists())
    }

    /// The folder of the shared library, checked for everything the build needs.
    fn library_folder(&self) -> Result<&PathBuf, String> {
        let Self { executable, version, .. } = self;
        if !self.version_fits() {
            let (major, minor) = VERSION_MIN;
            return Err(format!(
                "{executable} is Python {version}; Meta-World needs {major}.{minor} or later: name a newer one \
                 with PYO3_PYTHON=/path/to/python3"
            ));
        }
        let minor_version = version.rsplit_once('.').map_or(version.as_str(), |(minor, _)| minor);
        let no_library = || {
            format!(
                "{executable} (Python {version}) has no shared library to link with: install it with \
                 `apt-get install libpython{minor_version}-dev`, or build Python with --enable-shared"
            )
        };
        let soname = self.soname.as_deref().ok_or_else(no_library)?;
        self.folder_of(&self.ldlibrary).ok_or_else(no_library)?;
        self.folder_of(soname).ok_or_else(no_library)
    }
}

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed=PYO3_PYTHON");
    println!("cargo::rerun-if-env-changed=VIRTUAL_ENV");
    let found = Interpreter::ask().and_then(|interpreter| {
        let folder = interpreter.library_folder()?.clone();
        Ok((interpreter, folder))
    });
    match found {
        Ok((interpreter, folder)) => {
            let library = folder.join(interpreter.soname.as_deref().unwrap_or_default());
            println!("cargo::rerun-if-changed={}", library.display());
            println!("cargo::rustc-env=RCWM_PYTHON_EXECUTABLE={}", interpreter.executable);
            println!("cargo::rustc-env=RCWM_PYTHON_VERSION={}", interpreter.version);
            // The older kind of path comes before LD_LIBRARY_PATH: no other libpython is picked up.
            println!("cargo::rustc-link-arg=-Wl,--disable-new-dtags,-rpath,{}", folder.display());
        }
        Err(reason) => println!("cargo::error={reason}"),
    }
}
