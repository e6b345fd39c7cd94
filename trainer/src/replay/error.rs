use rcwm_models::episode::Misfit;

/// Why an episode was refused or a batch could not be drawn.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// It holds no steps.
    #[error("an episode of {task} holds no steps")]
    Empty { task: String },
    /// An action or a reward is NaN or infinite.
    #[error("an episode of {task} holds a {what} at step {step} that is not finite; leave the episode out")]
    NotFinite {
        task: String,
        what: &'static str,
        /// Where.
        step: usize,
    },
    /// It does not fit.
    #[error(
        "an episode of {task} has {steps} steps, the replay holds at most {capacity}; set replay.capacity_steps higher"
    )]
    TooLong {
        task: String,
        steps: usize,
        /// The replay's capacity in steps.
        capacity: usize,
    },
    /// It was recorded of another robot than the model is for.
    #[error("an episode of {task} does not fit the model: {} is {}, expected {}", misfit.key, misfit.found, misfit.expected)]
    Misfit { task: String, misfit: Misfit },
    /// There is nothing to draw from.
    #[error("the replay holds no {}; collect some first", if *masks { "episode with robot masks" } else { "episode" })]
    NothingToDraw {
        /// Whether masks were asked for.
        masks: bool,
    },
    /// Masks are asked for and an episode in the sequence has none.
    #[error("an episode of {task} has no robot masks; draw from the masked episodes only")]
    NoMasks { task: String },
}
