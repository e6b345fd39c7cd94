//! Where a tick's inputs and outputs lie among the values: found by name once, when a bundle is loaded.

use rcwm_models::bundle::{BundleKind, PartName};

use super::pieces::{Piece, Place, Values};
use crate::compile::{CompileError, inputs};

/// Places of a whole tick; none for an input that no segment reads.
pub(super) struct Places {
    pub(super) image: Option<Place>,
    pub(super) state: Option<Place>,
    pub(super) action: Option<Place>,
    /// In the order of [`super::Buffers::branches`].
    pub(super) branches: Vec<BranchPlaces>,
    /// What the interaction gives, where there is one: e and its attention.
    pub(super) interaction: Option<[Place; 2]>,
    pub(super) mean: Place,
    pub(super) std: Place,
}

pub(super) struct BranchPlaces {
    pub(super) z: Option<Place>,
    pub(super) h: Option<Place>,
    pub(super) noise: Option<Place>,
    pub(super) h_next: Place,
    pub(super) prior_z: Place,
    pub(super) prior_log_probs: Place,
    pub(super) posterior_z: Place,
    pub(super) posterior_log_probs: Place,
}

impl Places {
    /// Of a tick of which `early` runs before the image is there.
    pub(super) fn of(kind: BundleKind, values: &Values, early: &[Piece]) -> Result<Self, CompileError> {
        let output = |part, name: &str| output(values, part, name);
        let interaction = || -> Result<_, CompileError> {
            Ok([output(PartName::Interaction, "e")?, output(PartName::Interaction, "attention")?])
        };
        let branch = |part: &PartName| BranchPlaces::of(values, *part, early);
        Ok(Self {
            image: values.find(inputs::IMAGE),
            state: values.find(inputs::STATE),
            action: values.find(inputs::ACTION),
            branches: kind.branches().iter().map(branch).collect::<Result<_, _>>()?,
            interaction: (kind == BundleKind::Rcwm).then(interaction).transpose()?,
            mean: output(PartName::Actor, "mean")?,
            std: output(PartName::Actor, "std")?,
        })
    }
}

impl BranchPlaces {
    fn of(values: &Values, part: PartName, early: &[Piece]) -> Result<Self, CompileError> {
        let prior = |name| {
            let place = output(values, part, name)?;
            if early.iter().any(|piece| piece.makes(place)) {
                return Ok(place);
            }
            let reason = format!("{part}/{name} depends on the image; a prior must not");
            Err(CompileError::Part { part, reason })
        };
        let [z, h, noise] = ["z", "h", "noise"].map(|name| values.find(&inputs::of_branch(part, name)));
        Ok(Self {
            z,
            h,
            noise,
            h_next: prior("h_next")?,
            prior_z: prior("prior_z")?,
            prior_log_probs: prior("prior_log_probs")?,
            posterior_z: output(values, part, "posterior_z")?,
            posterior_log_probs: output(values, part, "posterior_log_probs")?,
        })
    }
}

fn output(values: &Values, part: PartName, name: &str) -> Result<Place, CompileError> {
    let reason = || format!("nothing makes {part}/{name}");
    values.find(&format!("{part}/{name}")).ok_or_else(|| CompileError::Part { part, reason: reason() })
}
