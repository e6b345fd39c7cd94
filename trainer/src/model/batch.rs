//! What a world model makes of a batch, and how it steps through one.

use candle_core::{Result, Tensor};

use super::decoder::Picture;
use super::latent::State;

/// A filtered batch: every tensor [B, T, ...].
#[derive(Debug, Clone)]
pub struct Observed {
    /// States predicted before the image was seen.
    pub priors: State,
    /// States after.
    pub posteriors: State,
    /// e_{t-1} at step t [B, T, n, m]; none for the vanilla baseline.
    pub interaction: Option<Tensor>,
}

impl Observed {
    /// Without gradient, which lets go of the graph.
    #[must_use]
    pub fn detached(&self) -> Self {
        Self {
            priors: self.priors.detached(),
            posteriors: self.posteriors.detached(),
            interaction: self.interaction.as_ref().map(Tensor::detach),
        }
    }

    /// Rows after rows.
    pub fn cat(shares: &[&Self]) -> Result<Self> {
        let states = |field: fn(&Self) -> &State| {
            State::cat(&shares.iter().map(|share| field(share).clone()).collect::<Vec<_>>())
        };
        let interactions: Vec<_> = shares.iter().filter_map(|share| share.interaction.as_ref()).collect();
        Ok(Self {
            priors: states(|share| &share.priors)?,
            posteriors: states(|share| &share.posteriors)?,
            interaction: if interactions.is_empty() { None } else { Some(Tensor::cat(&interactions, 0)?) },
        })
    }
}

/// Pictures of a state.
#[derive(Debug, Clone)]
pub struct Decoded {
    /// The whole picture [..., S, S, 3 C], in the range of `x/255 - 0.5` (eq. 8).
    pub image: Tensor,
    /// Each branch's part in it, the robot's first.
    pub pictures: Vec<Picture>,
}

/// `a / max(1, |a|)`: actions beyond the limits count as the limits. The divisor gets no gradient.
pub fn normalised_action(action: &Tensor) -> Result<Tensor> {
    action / action.detach().abs()?.maximum(1.0)?
}

/// [B, T, ...] as contiguous [T, B, ...], whose steps are then slices without a copy.
pub(super) fn sequence(x: &Tensor) -> Result<Tensor> {
    x.transpose(0, 1)?.contiguous()
}

/// Step `t` of [T, B, ...]: [B, ...].
pub(super) fn at_step(x: &Tensor, t: usize) -> Result<Tensor> {
    x.narrow(0, t, 1)?.squeeze(0)
}
