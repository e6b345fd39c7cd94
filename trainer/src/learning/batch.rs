use std::ops::Range;

use candle_core::{Device, Result, Tensor};

use super::Jitter;
use crate::model::latent::FirstSteps;

/// Sequences of experience as tensors.
#[derive(Debug, Clone)]
pub struct Batch {
    /// u8 [B, T, S, S, 3 C].
    pub image: Tensor,
    /// What the encoders see in place of `image`, which the decoder is to draw all the same; of the same shape.
    pub seen: Option<Tensor>,
    /// The action that led to the image: [B, T, action].
    pub action: Tensor,
    /// What the robot measured of itself, as it was measured: [B, T, state]; none where the model does not look at it.
    pub state: Option<Tensor>,
    /// [B, T].
    pub reward: Tensor,
    /// 1 where the episode truly ended, else 0: [B, T].
    pub terminal: Tensor,
    /// Where episodes begin.
    pub first: FirstSteps,
    /// 1 where the robot is, else 0: u8 or f32 [B, T, S, S, C]; none when masks are not used.
    pub robot_mask: Option<Tensor>,
    /// By row, then step: true where the action was a push off course and is no example.
    pub pushed: Vec<bool>,
    /// Which batch of a run it is: where only some steps are decoded, these take turns by it.
    pub number: u64,
}

impl Batch {
    /// Some of the sequences, without a copy of the tensors.
    ///
    /// # Errors
    /// Those of candle, also if there are fewer.
    pub fn rows(&self, rows: &Range<usize>) -> Result<Self> {
        let part = |x: &Tensor| x.narrow(0, rows.start, rows.len());
        Ok(Self {
            image: part(&self.image)?,
            seen: self.seen.as_ref().map(part).transpose()?,
            action: part(&self.action)?,
            state: self.state.as_ref().map(part).transpose()?,
            reward: part(&self.reward)?,
            terminal: part(&self.terminal)?,
            first: self.first.rows(rows),
            robot_mask: self.robot_mask.as_ref().map(part).transpose()?,
            pushed: self.pushed[rows.start * self.first.length()..rows.end * self.first.length()].to_vec(),
            number: self.number,
        })
    }
}

/// The same on the host, as replay makes it; rows first, then steps.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct HostBatch {
    /// B.
    pub rows: usize,
    /// T.
    pub length: usize,
    /// S: side of the images.
    pub side: usize,
    /// B * T images; empty where `place` tells them.
    pub image: Vec<u8>,
    /// B * T images that the encoders see; empty where these are the images.
    pub seen: Vec<u8>,
    /// B * T places of images in a store; empty where the images are here.
    pub place: Vec<u32>,
    /// B * T places of the images that the encoders see there, and by row how these change; empty where `seen` holds them.
    pub seen_place: Vec<u32>,
    pub seen_jitter: Vec<Option<Jitter>>,
    /// Whether masks are used.
    pub masks: bool,
    /// B * T actions.
    pub action: Vec<f32>,
    /// Whether the robot's measured state is used.
    pub states: bool,
    /// B * T states; empty where they are not used.
    pub state: Vec<f32>,
    /// B * T rewards.
    pub reward: Vec<f32>,
    /// B * T flags.
    pub terminal: Vec<bool>,
    /// B * T flags.
    pub first: Vec<bool>,
    /// B * T masks, 1 where the robot is; empty when masks are not used, or stored.
    pub robot_mask: Vec<u8>,
    /// B * T flags.
    pub pushed: Vec<bool>,
    /// See [`Batch`].
    pub number: u64,
}

/// Which of B * T steps are examples for an actor: the action of the next step was taken in their state, and is no push.
pub(super) fn examples(first: &[bool], pushed: &[bool], length: usize) -> impl Iterator<Item = bool> {
    (0..first.len()).map(move |at| !(at + 1).is_multiple_of(length) && !first[at + 1] && !pushed[at + 1])
}

impl HostBatch {
    /// Which of the B * T steps are examples for an actor.
    #[must_use]
    pub fn examples(&self) -> Vec<bool> {
        examples(&self.first, &self.pushed, self.length).collect()
    }

    /// The batch as tensors on `device`.
    ///
    /// # Errors
    /// Those of candle, also if a field has the wrong length.
    pub fn into_tensors(self, device: &Device) -> Result<Batch> {
        let (b, t, side) = (self.rows, self.length, self.side);
        let terminal: Vec<f32> = self.terminal.iter().map(|flag| f32::from(u8::from(*flag))).collect();
        let images = |images| Tensor::from_vec(images, (b, t, side, side, ()), device);
        let vectors = |vectors| Tensor::from_vec(vectors, (b, t, ()), device);
        Ok(Batch {
            image: images(self.image)?,
            seen: if self.seen.is_empty() { None } else { Some(images(self.seen)?) },
            action: vectors(self.action)?,
            state: if self.states { Some(vectors(self.state)?) } else { None },
            reward: Tensor::from_vec(self.reward, (b, t), device)?,
            terminal: Tensor::from_vec(terminal, (b, t), device)?,
            first: FirstSteps::new(self.first, t),
            pushed: self.pushed,
            robot_mask: if self.robot_mask.is_empty() { None } else { Some(images(self.robot_mask)?) },
            number: self.number,
        })
    }
}
