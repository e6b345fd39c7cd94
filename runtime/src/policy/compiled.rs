//! The compiled tick: segments of the exported parts, in tract, with our operators in place of the hot nodes.
//!
//! What needs only the action runs ahead of the image; once it is there, encoder, both posteriors (on two threads) and the actor stand between
//! it and the action.

mod branches;
mod pieces;
mod places;

use std::sync::Arc;
use std::time::Duration;

use rcwm_models::bundle::{Bundle, PartName};
use rcwm_models::wire::ActionValues;
use tract_onnx::prelude::TractResult;

use super::buffers::finite;
use super::stages::StageClock;
use super::tick::{Tick, Work};
use super::{Buffers, Inputs, PolicyError};
use crate::compile::{CompileError, Optimizations, compile};
use crate::engine::{EngineError, weights};
use crate::operators::SharedTeam;
use branches::Branches;
use pieces::{Piece, Values};
use places::Places;
use rcwm_kernels::team::Team;

/// How long the helper looks for work after the last before it sleeps.
const HELPER_SPINS: Duration = Duration::from_micros(200);

/// A bundle's tick, ready to run.
pub(super) struct Compiled {
    values: Values,
    places: Places,
    /// Early, in the order they run.
    early: Vec<Piece>,
    encoder: Piece,
    branches: Branches,
    actor: Piece,
    team: Option<SharedTeam>,
}

impl Compiled {
    pub(super) fn load(
        bundle: &Bundle,
        optimizations: Optimizations,
        threads: usize,
    ) -> Result<Self, PolicyError> {
        let weight_max =
            if optimizations.half_weights { weights::HALF_WEIGHT_MAX } else { weights::WEIGHT_MAX };
        let kind = bundle.manifest.kind;
        for part in kind.parts().iter().copied() {
            weights::check(part, bundle.part(part).ok_or(EngineError::NoPart { part })?, weight_max)?;
        }
        let team = match threads {
            0 | 1 => None,
            _ => Some(Team::start(HELPER_SPINS).map_err(|error| PolicyError::Thread(error.to_string()))?),
        };
        let team = team.map(Arc::new);
        let mut values = Values::default();
        let (mut early, mut late) = (Vec::new(), Vec::new());
        for segment in compile(bundle, optimizations)? {
            // Two branches run beside one another: there is nobody to share with within them.
            let shares =
                segment.late && !(kind.branches().len() > 1 && kind.branches().contains(&segment.part));
            let piece = Piece::load(&segment, &mut values, team.as_ref().filter(|_| shares))?;
            if segment.late { late.push(piece) } else { early.push(piece) }
        }
        let places = Places::of(kind, &values, &early)?;
        let mut late = |part: PartName| {
            let found =
                late.iter().position(|piece: &Piece| piece.part == part).map(|index| late.remove(index));
            let reason = || "nothing in it depends on the image".to_owned();
            found.ok_or_else(|| CompileError::Part { part, reason: reason() })
        };
        let (encoder, actor) = (late(PartName::Encoder)?, late(PartName::Actor)?);
        let branches = kind.branches().iter().map(|part| late(*part)).collect::<Result<_, _>>()?;
        let branches = Branches::new(branches, team.as_ref())?;
        Ok(Self { values, places, early, encoder, branches, actor, team })
    }

    /// The actor on the state that is there.
    fn act(&mut self, work: &mut Work<'_>) -> Result<(), PolicyError> {
        let Self { actor, values, places, team, .. } = self;
        let Work { buffers, clock, .. } = work;
        let mut run = || {
            actor.run(values)?;
            values.copy(places.mean, &mut buffers.mean)?;
            values.copy(places.std, &mut buffers.std)
        };
        run().map_err(|error| run_error(PartName::Actor, &error))?;
        clock.ended(PartName::Actor);
        // In the encoder, or just now.
        clock.helper_late |= team.as_ref().is_some_and(|team| team.take_late());
        finite(PartName::Actor, "mean", &buffers.mean)?;
        finite(PartName::Actor, "std", &buffers.std)
    }

    /// The tick's inputs but the image.
    fn fill(&mut self, action: &ActionValues, work: &Work<'_>) -> TractResult<()> {
        let (Self { values, places, .. }, Work { state, noise, .. }) = (self, work);
        values.fill(places.action, action)?;
        for ((at, state), noise) in places.branches.iter().zip(&state.branches).zip(noise.branches()) {
            values.fill(at.z, &state.z)?;
            values.fill(at.h, &state.h)?;
            values.fill(at.noise, noise)?;
        }
        Ok(())
    }

    /// What the early pieces have made.
    fn copy_priors(&self, buffers: &mut Buffers) -> Result<(), PolicyError> {
        let Self { values, places, .. } = self;
        for ((part, branch), at) in buffers.named().zip(&places.branches) {
            let mut copy = || {
                values.copy(at.h_next, &mut branch.h_next)?;
                values.copy(at.prior_z, &mut branch.prior_z)?;
                values.copy(at.prior_log_probs, &mut branch.prior_log_probs)
            };
            copy().map_err(|error| run_error(part, &error))?;
        }
        let Some([e, attention]) = places.interaction else { return Ok(()) };
        let mut copy = || {
            values.copy(e, &mut buffers.e)?;
            values.copy(attention, &mut buffers.attention)
        };
        copy().map_err(|error| run_error(PartName::Interaction, &error))
    }

    /// What the branches have made of the image.
    fn copy_posteriors(&self, buffers: &mut Buffers) -> Result<(), PolicyError> {
        let Self { values, places, .. } = self;
        for ((part, branch), at) in buffers.named().zip(&places.branches) {
            let mut copy = || {
                values.copy(at.posterior_z, &mut branch.posterior_z)?;
                values.copy(at.posterior_log_probs, &mut branch.posterior_log_probs)
            };
            copy().map_err(|error| run_error(part, &error))?;
        }
        Ok(())
    }
}

fn run_error(part: PartName, error: &tract_onnx::prelude::TractError) -> PolicyError {
    let reason = format!("{error:#}");
    EngineError::Run {
        engine: crate::EngineKind::Tract,
        part,
        reason: rcwm_models::errors::on_one_line(&reason),
    }
    .into()
}

impl Tick for Compiled {
    fn work_ahead(&mut self, action: &ActionValues, work: &mut Work<'_>) -> Result<(), PolicyError> {
        let first = self.early.first().map_or(PartName::Actor, |piece| piece.part);
        self.fill(action, work).map_err(|error| run_error(first, &error))?;
        for piece in &mut self.early {
            piece.run(&mut self.values).map_err(|error| run_error(piece.part, &error))?;
            work.clock.ended(piece.part);
        }
        self.copy_priors(work.buffers)?;
        finite(PartName::Interaction, "e", &work.buffers.e)?;
        work.buffers.check_priors()
    }

    fn observe(&mut self, inputs: Inputs<'_>, work: &mut Work<'_>) -> Result<(), PolicyError> {
        let Self { values, places, encoder, .. } = self;
        let encoded = values
            .fill(places.image, inputs.image)
            .and_then(|()| values.fill(places.state, inputs.state))
            .and_then(|()| encoder.run(values));
        encoded.map_err(|error| run_error(PartName::Encoder, &error))?;
        work.clock.ended(PartName::Encoder);
        self.branches.run(&mut self.values, work.clock).map_err(|(part, error)| run_error(part, &error))?;
        self.copy_posteriors(work.buffers)?;
        work.buffers.check_posteriors()?;
        self.act(work)
    }

    fn imagine(&mut self, work: &mut Work<'_>) -> Result<(), PolicyError> {
        for at in &self.places.branches {
            self.values.alias(at.prior_z, at.posterior_z);
        }
        work.buffers.believe_prior();
        self.act(work)
    }

    fn warm_caches(&mut self) {
        // The last image in place of the next. What comes out, an error included, is overwritten by whatever comes next.
        let _ = self.encoder.run(&mut self.values);
        let _ = self.branches.warm_caches(&mut self.values, &mut StageClock::start());
        let _ = self.actor.run(&mut self.values);
        if let Some(team) = &self.team {
            team.take_late();
        }
    }

    fn wake(&self) {
        if let Some(team) = &self.team {
            team.wake();
        }
    }
}
