//! What goes into an update and what comes out.

use crate::behaviour::BehaviourScales;
use crate::world::{ImitationScales, Sizes, WorldScales};

/// Adam with clipping by the global norm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamScales {
    /// Added to the root of the second moment.
    pub eps: f32,
    /// Largest norm of all gradients together.
    pub clip_norm: f32,
    /// Decay of the first moment.
    pub beta1: f64,
    /// Decay of the second moment.
    pub beta2: f64,
}

/// What a learner does.
#[derive(Debug, Clone, PartialEq)]
pub struct LearnerSettings {
    /// Sizes of batch and model.
    pub sizes: Sizes,
    /// The world model's losses.
    pub world: WorldScales,
    /// The world model's optimiser.
    pub world_adam: AdamScales,
    /// The actor's part in the world model's loss, whose optimiser then moves the actor, too.
    pub imitation: Option<ImitationScales>,
    /// Actor and critic, where they learn, with their optimisers.
    pub behaviour: Option<(BehaviourScales, AdamScales, AdamScales)>,
    /// Whether some updates are of the environment's side alone.
    pub in_stages: bool,
    /// Decay of the running average of the world model's weights; 0: none is kept.
    pub average_decay: f64,
    /// Images that are kept on the machine, from which batches are gathered; 0: every batch brings its own.
    pub stored_images: usize,
    /// Whether the stored images have masks beside them.
    pub stored_masks: bool,
}

/// A batch as the trainer draws it: sequences first, then steps.
#[derive(Debug, Clone, Copy)]
pub struct Batch<'a> {
    pub images: Images<'a>,
    /// What the encoders see in their place; empty: the same. Only learners that are made for looks take others.
    pub seen: Seen<'a>,
    /// [B, T, action].
    pub action: &'a [f32],
    /// [B, T].
    pub reward: &'a [f32],
    /// [B, T].
    pub terminal: &'a [bool],
    /// [B, T].
    pub first: &'a [bool],
    /// Where an action was demonstrated: the state of such a step is to answer the next step's action. [B, T]; empty: nowhere.
    pub examples: &'a [bool],
    /// Whether the update is of the environment's side alone, and of the actor where it has a part in the loss; masks are not used then.
    pub environment_alone: bool,
    /// Whether masks are used.
    pub masks: bool,
    /// Which batch of a run it is: what is decoded takes turns by it.
    pub number: u64,
    /// By how many pixels each sequence's images move, right and down; empty: none moves.
    pub shift: &'a [[i32; 2]],
}

/// Where a batch's images are.
#[derive(Debug, Clone, Copy)]
pub enum Images<'a> {
    /// Here: u8 [B, T, 64, 64, 3], and [B, T, 64, 64] masks where they are used.
    Host(&'a [u8], &'a [u8]),
    /// On the machine, by number: [B, T].
    Stored(&'a [u32]),
}

/// What the encoders see.
#[derive(Debug, Clone, Copy, Default)]
pub struct Seen<'a> {
    /// u8 [B, T, 64, 64, 3], where the batch brings its images.
    pub host: &'a [u8],
    /// Numbers of images on the machine, where it does not: [B, T].
    pub stored: &'a [u32],
    /// How each sequence's colours change [B], where the pictures are stored.
    pub colours: &'a [Option<Colours>],
}

/// A change of colours: `gain * (colour + grey * (mean - colour)) + offset`, of 255.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Colours {
    pub gain: [f32; 3],
    pub offset: [f32; 3],
    pub grey: f32,
}

/// The generator that noise is drawn from: ChaCha8's key, and its stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Noise {
    /// The seed's 32 bytes.
    pub key: [u8; 32],
    /// The update's number.
    pub stream: u64,
}

/// What an update of the world model was.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct WorldValues {
    /// Squared error of the picture.
    pub image: f64,
    /// The same of the robot's mask, where masks were used.
    pub robot_mask: Option<f64>,
    /// Cross-entropy of the reward.
    pub reward: f64,
    /// Cross-entropy of the continuation.
    pub continues: f64,
    /// KL of each branch.
    pub kl: [f64; 2],
    /// Distance of the actor from what was demonstrated, where it has a part in the loss.
    pub cloning: Option<f64>,
    /// The sum with factors.
    pub total: f64,
    /// Norm of the gradients before clipping.
    pub gradient_norm: f64,
    /// Whether the parameters moved: all losses and gradients were finite.
    pub moved: bool,
}

/// What an update of actor and critic was.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct BehaviourValues {
    /// The actor's loss.
    pub actor_loss: f64,
    /// The critic's loss.
    pub critic_loss: f64,
    /// Norm of the actor's gradients before clipping.
    pub actor_gradient_norm: f64,
    /// Norm of the critic's gradients before clipping.
    pub critic_gradient_norm: f64,
    /// Mean entropy of the actor.
    pub entropy: f64,
    /// Mean predicted reward.
    pub reward: f64,
    /// Mean lambda return.
    pub lambda_return: f64,
    /// Mean value.
    pub value: f64,
    /// The returns' running range.
    pub range: [f64; 2],
    /// Whether the parameters moved: all losses and gradients were finite. Where not, the slow critic and the range have moved all the same.
    pub moved: bool,
}
