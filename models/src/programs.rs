//! The programs of this project that start one another.

use std::path::{Path, PathBuf};

/// A program that comes with this one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Program {
    /// The binary's name.
    pub name: &'static str,
    /// The environment variable that may name its path.
    pub variable: &'static str,
}

/// The program is not there.
#[derive(Debug, thiserror::Error)]
pub enum MissingProgram {
    /// It is nowhere.
    #[error(
        "{name} was found neither beside this program nor on the PATH; build it (cargo build --release -p {name}), or name it with \
         the variable {variable}"
    )]
    Nowhere {
        /// The program's name.
        name: &'static str,
        /// The variable that may name its path.
        variable: &'static str,
    },
    /// It is not where the variable says.
    #[error("{variable} says {path}, where no file is; expected the path of {name}")]
    NotThere {
        /// The program's name.
        name: &'static str,
        /// The variable that names its path.
        variable: &'static str,
        /// What it says.
        path: PathBuf,
    },
}

impl Program {
    /// Meta-World behind shared memory.
    pub const SIMULATOR: Self = Self { name: "rcwm-simulator", variable: "RCWM_SIMULATOR" };
    /// The controller that runs an exported bundle.
    pub const RUNTIME: Self = Self { name: "rcwm-runtime", variable: "RCWM_RUNTIME" };
    /// Replays, films, plots and measurements.
    pub const LAB: Self = Self { name: "rcwm-lab", variable: "RCWM_LAB" };

    /// Its path: what the variable says, else beside this program, else on the PATH.
    pub fn find(self) -> Result<PathBuf, MissingProgram> {
        if let Some(path) = std::env::var_os(self.variable).filter(|path| !path.is_empty()) {
            let path = PathBuf::from(path);
            let Self { name, variable } = self;
            return if path.is_file() {
                Ok(path)
            } else {
                Err(MissingProgram::NotThere { name, variable, path })
            };
        }
        let own = std::env::current_exe().ok();
        let beside = own.as_deref().and_then(Path::parent).map(Path::to_path_buf);
        // Tests and examples live one folder below the binaries.
        let above = beside.as_deref().and_then(Path::parent).map(Path::to_path_buf);
        let search = std::env::var_os("PATH").unwrap_or_default();
        beside
            .into_iter()
            .chain(above)
            .chain(std::env::split_paths(&search))
            .map(|folder| folder.join(self.name))
            .find(|path| path.is_file())
            .ok_or(MissingProgram::Nowhere { name: self.name, variable: self.variable })
    }
}
