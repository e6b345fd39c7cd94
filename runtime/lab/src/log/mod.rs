//! What is made of the log of a run ([`rcwm_runtime::log`]): a replay, its times, its episodes.

mod episodes;
mod latencies;
mod replay;
mod report;

pub use episodes::{LoggedEpisode, WrittenEpisodes, write_episodes};
pub(crate) use latencies::stage_times;
pub use latencies::{LoggedLatencies, LoggedLatencyReport};
pub use replay::Replayer;
pub use report::{Answers, Difference, ReplayReport};

use rcwm_models::bundle::BundleError;
use rcwm_models::episode::EpisodeError;
use rcwm_models::wire::ActionSource;
use rcwm_runtime::PolicyError;
use rcwm_runtime::log::LogError;

/// Why nothing could be made of a log.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The log could not be read.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The log was made with a bundle that is not at hand.
    #[error(
        "the log was made with another bundle than {tried}: {difference}; name that bundle with --bundle"
    )]
    OtherBundle {
        /// The folders that were tried.
        tried: String,
        /// What differs.
        difference: String,
    },
    /// A bundle was refused.
    #[error(transparent)]
    Bundle(#[from] BundleError),
    /// The policy could not be loaded.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// An episode could not be written.
    #[error(transparent)]
    Episode(#[from] EpisodeError),
}

/// What the controller was up to when it sent an answer of this source, as `docs/controller.md` names it.
pub(crate) fn mode(source: u32) -> &'static str {
    match ActionSource::from_wire(source) {
        Some(ActionSource::Policy) => "tracking",
        Some(ActionSource::Imagined) => "imagining",
        Some(ActionSource::Fallback) => "fallback",
        None => "unknown",
    }
}
