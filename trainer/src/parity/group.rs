/// A group of reference tensors that we compute.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
#[value(rename_all = "snake_case")]
pub enum Group {
    /// Embeddings of the images.
    Encoder,
    /// Priors, posteriors and the interaction over the batch.
    Observe,
    /// Pictures and masks of both branches.
    Decode,
    /// Reward and continuation.
    Heads,
    /// Action distribution.
    Actor,
    /// Value.
    Critic,
    /// Open loop with the recorded actions.
    Imagine,
    /// Imagination with the actor: states, actions, rewards, values, weights, returns and their range.
    Behaviour,
    /// Every term of the world model's, the actor's and the critic's losses.
    Loss,
    /// Gradients of the world model's loss.
    Grad,
    /// Norms of the gradients of world model, actor and critic.
    GradNorm,
    /// Gradients of actor and critic.
    BehaviourGrad,
    /// The world model's parameters after one step of Adam.
    Updated,
    /// Actor, critic and slow critic after one step.
    BehaviourUpdated,
}

/// How a group's errors are measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Measure {
    /// The difference itself.
    Absolute,
    /// The difference over the tensor's largest magnitude.
    Relative,
}

impl Group {
    /// All groups, in the order of the data.
    pub const ALL: [Self; 14] = [
        Self::Encoder,
        Self::Observe,
        Self::Decode,
        Self::Heads,
        Self::Actor,
        Self::Critic,
        Self::Imagine,
        Self::Behaviour,
        Self::Loss,
        Self::Grad,
        Self::GradNorm,
        Self::BehaviourGrad,
        Self::Updated,
        Self::BehaviourUpdated,
    ];

    /// The first part of its tensors' names.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Encoder => "encoder",
            Self::Observe => "observe",
            Self::Decode => "decode",
            Self::Heads => "heads",
            Self::Actor => "actor",
            Self::Critic => "critic",
            Self::Imagine => "imagine",
            Self::Behaviour => "behaviour",
            Self::Loss => "loss",
            Self::Grad => "grad",
            Self::GradNorm => "grad_norm",
            Self::BehaviourGrad => "behaviour_grad",
            Self::Updated => "updated",
            Self::BehaviourUpdated => "behaviour_updated",
        }
    }

    /// How its errors are measured, and the largest that f32 excuses.
    #[must_use]
    pub const fn tolerance(self) -> (Measure, f32) {
        match self {
            Self::Loss => (Measure::Relative, 1e-5),
            Self::Grad | Self::GradNorm | Self::BehaviourGrad => (Measure::Relative, 1e-4),
            _ => (Measure::Absolute, 1e-5),
        }
    }
}
