//! Where a tick's inputs and outputs lie among the values: found by name once, when a bundle is loaded.

use rcwm_models::bundle::{BundleKind, PartName};
use rcwm_models::wire::ActionValues;
use tract_onnx::prelude::TractResult;

use super::super::buffers::finite;
use super::super::tick::Work;
use super::super::{Buffers, Inputs, PolicyError};
use super::pieces::{Place, Values};
use super::run_error;
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
    /// Of a tick of which what `is_early` is made before the image is there.
    pub(super) fn of(
        kind: BundleKind,
        values: &Values,
        is_early: impl Fn(Place) -> bool,
    ) -> Result<Self, CompileError> {
        let output = |part, name: &str| output(values, part, name);
        let interaction = || -> Result<_, CompileError> {
            Ok([output(PartName::Interaction, "e")?, output(PartName::Interaction, "attention")?])
        };
        let branch = |part: &PartName| BranchPlaces::of(values, *part, &is_early);
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

    /// The tick's inputs but the image.
    pub(super) fn fill(
        &self,
        values: &mut Values,
        action: &ActionValues,
        work: &Work<'_>,
    ) -> TractResult<()> {
        let Work { state, noise, .. } = work;
        values.fill(self.action, action)?;
        for ((at, state), noise) in self.branches.iter().zip(&state.branches).zip(noise.branches()) {
            values.fill(at.z, &state.z)?;
            values.fill(at.h, &state.h)?;
            values.fill(at.noise, noise)?;
        }
        Ok(())
    }

    /// What is observed.
    pub(super) fn fill_inputs(&self, values: &mut Values, inputs: Inputs<'_>) -> TractResult<()> {
        values.fill(self.image, inputs.image)?;
        values.fill(self.state, inputs.state)
    }

    /// What was made before the image was there.
    pub(super) fn copy_priors(&self, values: &Values, buffers: &mut Buffers) -> Result<(), PolicyError> {
        for ((part, branch), at) in buffers.named().zip(&self.branches) {
            let mut copy = || {
                values.copy(at.h_next, &mut branch.h_next)?;
                values.copy(at.prior_z, &mut branch.prior_z)?;
                values.copy(at.prior_log_probs, &mut branch.prior_log_probs)
            };
            copy().map_err(|error| run_error(part, &error))?;
        }
        if let Some([e, attention]) = self.interaction {
            let copied =
                values.copy(e, &mut buffers.e).and_then(|()| values.copy(attention, &mut buffers.attention));
            copied.map_err(|error| run_error(PartName::Interaction, &error))?;
        }
        finite(PartName::Interaction, "e", &buffers.e)?;
        buffers.check_priors()
    }

    /// What the branches have made of the image.
    pub(super) fn copy_posteriors(&self, values: &Values, buffers: &mut Buffers) -> Result<(), PolicyError> {
        for ((part, branch), at) in buffers.named().zip(&self.branches) {
            let mut copy = || {
                values.copy(at.posterior_z, &mut branch.posterior_z)?;
                values.copy(at.posterior_log_probs, &mut branch.posterior_log_probs)
            };
            copy().map_err(|error| run_error(part, &error))?;
        }
        buffers.check_posteriors()
    }

    /// What the actor has made of the state.
    pub(super) fn copy_decision(&self, values: &Values, buffers: &mut Buffers) -> Result<(), PolicyError> {
        let copied =
            values.copy(self.mean, &mut buffers.mean).and_then(|()| values.copy(self.std, &mut buffers.std));
        copied.map_err(|error| run_error(PartName::Actor, &error))?;
        finite(PartName::Actor, "mean", &buffers.mean)?;
        finite(PartName::Actor, "std", &buffers.std)
    }
}

impl BranchPlaces {
    fn of(values: &Values, part: PartName, is_early: &impl Fn(Place) -> bool) -> Result<Self, CompileError> {
        let prior = |name| {
            let place = output(values, part, name)?;
            if is_early(place) {
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
