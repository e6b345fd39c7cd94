use std::path::{Component, Path, PathBuf};

use rcwm_models::machine::Machine;
use serde::{Deserialize, Serialize};

/// How many of a long path's last names are shown.
const NAMES_SHOWN: usize = 3;

/// When something was made, with what, and on which machine.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Provenance {
    /// Date and time, UTC.
    pub date: String,
    /// Version of this program.
    pub version: String,
    /// Revision of its source.
    pub revision: String,
    /// The processor's name.
    pub processor: String,
    /// Processors that may be used.
    pub cores: usize,
    /// Where models were computed.
    pub device: String,
}

impl Provenance {
    /// Now and here; `device` as in `--device`.
    #[must_use]
    pub fn now(device: &str) -> Self {
        let Machine { processor, cores, .. } = Machine::here();
        Self {
            date: jiff::Timestamp::now().strftime("%Y-%m-%d %H:%M UTC").to_string(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            revision: env!("RCWM_SOURCE_REVISION").to_owned(),
            processor,
            cores,
            device: device.to_owned(),
        }
    }
}

/// A path as others may read it: relative to the present folder where it lies there, else its last names. Other words stay.
#[must_use]
pub fn shown_path(word: &str) -> String {
    let path = Path::new(word);
    if !path.is_absolute() {
        return word.to_owned();
    }
    let here = std::env::current_dir().unwrap_or_default();
    if let Ok(relative) = path.strip_prefix(&here)
        && here.parent().is_some()
    {
        return relative.display().to_string();
    }
    let names: Vec<_> = path.components().filter(|part| matches!(part, Component::Normal(_))).collect();
    // The first name is never shown: it says where on this machine something lies.
    let last: PathBuf = names.iter().skip(names.len().saturating_sub(NAMES_SHOWN).max(1)).collect();
    format!("…/{}", last.display())
}

/// Words in which paths may stand, with those as [`shown_path`] has them.
#[must_use]
pub fn shown_words(text: &str) -> String {
    let word = |word: &str| {
        let path = word.trim_end_matches([',', ';', ':', '.']);
        shown_path(path) + &word[path.len()..]
    };
    text.split(' ').map(word).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_of_this_machine_are_shortened() {
        assert_eq!(shown_path("runs/a"), "runs/a");
        assert_eq!(shown_path("--seed"), "--seed");
        assert_eq!(shown_path("/home/me/runs/hammer/checkpoints/last"), "…/hammer/checkpoints/last");
        assert_eq!(shown_path("/tmp/a"), "…/a");
        assert_eq!(shown_words("weights: /a/b/c; golden values: 32"), "weights: …/b/c; golden values: 32");
        let here = std::env::current_dir().unwrap().join("models");
        assert_eq!(shown_path(&here.display().to_string()), "models");
    }

    #[test]
    fn what_is_made_now_has_a_date_and_a_machine() {
        let made = Provenance::now("cpu");
        assert!(made.date.starts_with("20") && made.date.ends_with(" UTC"), "{made:?}");
        assert!(made.cores > 0 && !made.processor.is_empty());
    }
}
