//! What a log says about its run.

use rcwm_models::bundle::{Limits, Manifest};
use rcwm_models::wire::ACTION_NUMBERS_MAX;
use serde::{Deserialize, Serialize};

use crate::controller::Fallback;
use crate::engine::EngineSettings;
use crate::policy::{STAGES, Sampling};

/// Most threads that a run may have.
const THREADS_MAX: usize = 64;

/// What the run was made with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Header {
    /// Version of the program that wrote it.
    pub program: String,
    /// Seconds since 1970 at the start.
    pub started_unix_s: u64,
    /// What is to be added to times of CLOCK_MONOTONIC, in ns, for nanoseconds since 1970, as of the start; logs of older programs do not
    /// say.
    #[serde(default)]
    pub monotonic_to_unix_ns: Option<i64>,
    /// The link's instance.
    pub instance: String,
    pub bundle: BundleIdentity,
    pub engine: EngineSettings,
    /// How latents and actions were chosen, and the seed.
    pub sampling: Sampling,
    /// What was sent where the policy had nothing valid to send.
    pub fallback: Fallback,
    /// Largest change of each number from one action to the next, as a share of half of its range.
    pub rate_max: Option<f32>,
    /// Names of the stages of a tick whose times each record holds, in order.
    pub stages: Vec<String>,
    /// The machine: other processors may round otherwise.
    pub machine: Machine,
}

impl Header {
    /// What in it no run could have written; a checksum only says that nothing was changed since.
    pub fn invalid(&self) -> Option<String> {
        if !(1..=THREADS_MAX).contains(&self.engine.threads) {
            return Some(format!(
                "an engine with {} threads, expected 1 to {THREADS_MAX}",
                self.engine.threads
            ));
        }
        // It becomes part of the names of files.
        if self.instance.contains('/') {
            return Some(format!("an instance {:?}, expected a name without /", self.instance));
        }
        let Limits { low, high } = &self.bundle.action_limits;
        let numbers = self.bundle.action_numbers();
        if low.len() != high.len() || !(1..=ACTION_NUMBERS_MAX).contains(&numbers) {
            return Some(format!(
                "an action of {} lowest and {} highest values, expected 1 to {ACTION_NUMBERS_MAX} of each",
                low.len(),
                high.len()
            ));
        }
        if let Fallback::Given(action) = self.fallback
            && let Err(other) = check_count("a fallback", action.len(), numbers)
        {
            return Some(other);
        }
        let rate_max = self.rate_max.filter(|rate_max| !rate_max.is_finite() || *rate_max < 0.0);
        rate_max.map(|rate_max| format!("a rate limit of {rate_max}"))
    }
}

/// The machine a log was written on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Machine {
    /// As in `x86_64`.
    pub architecture: String,
    /// The processor's name, empty where the system does not say.
    pub processor: String,
}

impl Machine {
    #[must_use]
    pub fn here() -> Self {
        let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        let name = text.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
        Self {
            architecture: std::env::consts::ARCH.to_owned(),
            processor: name.map(|(_, name)| name.trim().to_owned()).unwrap_or_default(),
        }
    }
}

/// Which bundle, by content.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BundleIdentity {
    pub task: String,
    pub preset: String,
    /// sha256 of the initial state and of every part, by name.
    pub sha256: Vec<(String, String)>,
    /// Smallest and largest values of each number of an action, in units.
    pub action_limits: Limits,
}

/// Whether there are as many numbers as in an action of the log's bundle; if not, what has another count.
pub(super) fn check_count(what: &str, found: usize, expected: usize) -> Result<(), String> {
    let other = || format!("{what} of {found} numbers, expected {expected} as in the bundle's actions");
    if found == expected { Ok(()) } else { Err(other()) }
}

impl BundleIdentity {
    /// Numbers of an action. They are the same in a whole log: a policy that takes over commands the same robot.
    #[must_use]
    pub fn action_numbers(&self) -> usize {
        self.action_limits.low.len()
    }

    /// Of a manifest, whose checksums were checked when the bundle was loaded.
    #[must_use]
    pub fn of(manifest: &Manifest) -> Self {
        let parts = manifest.parts.iter().map(|part| (part.name.to_string(), part.sha256.clone()));
        let initial = ("initial".to_owned(), manifest.initial.sha256.clone());
        Self {
            task: manifest.task.clone(),
            preset: manifest.provenance.preset.clone(),
            sha256: std::iter::once(initial).chain(parts).collect(),
            action_limits: manifest.limits(),
        }
    }

    /// What another bundle differs in, as far as it matters for a tick; none where it is the same.
    #[must_use]
    pub fn difference(&self, other: &Self) -> Option<String> {
        let parts = STAGES.iter().map(|part| part.as_str());
        let of = |bundle: &Self, name: &str| {
            bundle.sha256.iter().find(|(part, _)| part == name).map(|(_, sha256)| sha256.clone())
        };
        let differing =
            std::iter::once("initial").chain(parts).find(|name| of(self, name) != of(other, name));
        let short = |sha256: Option<String>| {
            sha256.map_or("missing".into(), |sha256| sha256.chars().take(12).collect::<String>())
        };
        match differing {
            Some(name) => {
                let (logged, found) = (short(of(self, name)), short(of(other, name)));
                Some(format!(
                    "sha256 of {name} begins with {found}, logged was {logged} ({}, {})",
                    self.task, self.preset
                ))
            }
            None if self.action_limits != other.action_limits => Some("its action limits are others".into()),
            None => None,
        }
    }
}
