//! The parts of a world model's tick.

use rcwm_models::bundle::{Bundle, BundleKind, PartName};
use rcwm_models::wire::ActionValues;

use super::PolicyError;
use super::buffers::{BRANCHES_MAX, Buffers, finite};
use super::tick::Work;
use crate::engine::{self, EngineError, EngineSettings, Input, Output, Part};

/// The parts of a tick, loaded.
pub struct Parts {
    encoder: Box<dyn Part>,
    /// The branch that takes the action: robot or dynamics.
    first: (PartName, Box<dyn Part>),
    /// The branch that the first one moves.
    second: Option<Moved>,
    actor: Box<dyn Part>,
}

struct Moved {
    interaction: Box<dyn Part>,
    environment: Box<dyn Part>,
}

impl Parts {
    pub(super) fn load(bundle: &Bundle, settings: EngineSettings) -> Result<Self, EngineError> {
        let load = |part| engine::load(bundle, part, settings);
        let (first, moves) = match bundle.manifest.kind {
            BundleKind::Rcwm => (PartName::Robot, true),
            BundleKind::Dreamer | BundleKind::Recurrent => (PartName::Dynamics, false),
        };
        let moved = || -> Result<Moved, EngineError> {
            let (interaction, environment) = (load(PartName::Interaction)?, load(PartName::Environment)?);
            Ok(Moved { interaction, environment })
        };
        Ok(Self {
            encoder: load(PartName::Encoder)?,
            first: (first, load(first)?),
            second: moves.then(moved).transpose()?,
            actor: load(PartName::Actor)?,
        })
    }

    pub(super) fn run_encoder(&mut self, image: &[u8], to: &mut Buffers) -> Result<(), PolicyError> {
        self.encoder.run(&[Input::U8(image)], &mut [Output::F32(&mut to.features)])?;
        finite(PartName::Encoder, "features", &to.features)
    }

    /// The branches, one after the other.
    pub(super) fn run_branches(
        &mut self,
        action: &ActionValues,
        measured: &[f32],
        work: &mut Work<'_>,
    ) -> Result<(), PolicyError> {
        let Work { state, noise, buffers: to, clock } = work;
        let (Buffers { features, branches, e, attention, classes, .. }, noise) =
            (&mut **to, noise.branches());
        let (name, part) = &mut self.first;
        let (before, first) = (&state.branches[0], &mut branches[0]);
        let inputs = [
            Input::I64(&before.z),
            Input::F32(&before.h),
            Input::F32(action),
            Input::F32(features),
            Input::F32(&noise[0]),
            Input::F32(measured),
        ];
        // Models without a measured state have no such input.
        let inputs = &inputs[..if measured.is_empty() { 5 } else { 6 }];
        part.run(inputs, &mut first.outputs())?;
        first.check(*name, *classes)?;
        clock.ended(*name);
        let Some(Moved { interaction, environment }) = &mut self.second else { return Ok(()) };
        let before = &state.branches[1];
        // The robot's PRIOR sample: the interaction is known before the image is (A.2).
        let inputs = [Input::I64(&first.prior_z), Input::F32(&first.h_next), Input::I64(&before.z)];
        interaction.run(&inputs, &mut [Output::F32(e), Output::F32(attention)])?;
        finite(PartName::Interaction, "e", e)?;
        clock.ended(PartName::Interaction);
        let second = &mut branches[1];
        let inputs = [Input::F32(e), Input::F32(&before.h), Input::F32(features), Input::F32(&noise[1])];
        environment.run(&inputs, &mut second.outputs())?;
        second.check(PartName::Environment, *classes)?;
        clock.ended(PartName::Environment);
        Ok(())
    }

    pub(super) fn run_actor(&mut self, to: &mut Buffers) -> Result<(), PolicyError> {
        let mut inputs = [Input::F32(&[]); 2 * BRANCHES_MAX];
        for (pair, branch) in inputs.chunks_exact_mut(2).zip(&to.branches) {
            pair.copy_from_slice(&[Input::I64(&branch.posterior_z), Input::F32(&branch.h_next)]);
        }
        let inputs = &inputs[..2 * to.branches.len()];
        self.actor.run(inputs, &mut [Output::F32(&mut to.mean), Output::F32(&mut to.std)])?;
        finite(PartName::Actor, "mean", &to.mean)?;
        finite(PartName::Actor, "std", &to.std)
    }
}
