//! The compiled tick: segments of the exported parts, in tract, with our operators in place of the hot nodes.
//!
//! What needs only the action runs ahead of the image; once it is there, encoder, both posteriors (on two threads) and the actor stand between
//! it and the action.

mod branches;
mod pieces;
mod places;
mod split;

use std::sync::Arc;
use std::time::Duration;

use rcwm_models::bundle::{Bundle, PartName};
use rcwm_models::wire::ActionValues;

use super::stages::StageClock;
use super::tick::{Tick, Work};
use super::{Inputs, PolicyError};
use crate::compile::{CompileError, Optimizations, compile};
use crate::engine::{EngineError, weights};
use crate::operators::SharedTeam;
pub(super) use split::Split;

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
        let places = Places::of(kind, &values, |place| early.iter().any(|piece| piece.makes(place)))?;
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
        actor.run(values).map_err(|error| run_error(PartName::Actor, &error))?;
        places.copy_decision(values, buffers)?;
        clock.ended(PartName::Actor);
        // In the encoder, or just now.
        clock.helper_late |= team.as_ref().is_some_and(|team| team.take_late());
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
        self.places.fill(&mut self.values, action, work).map_err(|error| run_error(first, &error))?;
        for piece in &mut self.early {
            piece.run(&mut self.values).map_err(|error| run_error(piece.part, &error))?;
            work.clock.ended(piece.part);
        }
        self.places.copy_priors(&self.values, work.buffers)
    }

    fn observe(&mut self, inputs: Inputs<'_>, work: &mut Work<'_>) -> Result<(), PolicyError> {
        let Self { values, places, encoder, .. } = self;
        let encoded = places.fill_inputs(values, inputs).and_then(|()| encoder.run(values));
        encoded.map_err(|error| run_error(PartName::Encoder, &error))?;
        work.clock.ended(PartName::Encoder);
        self.branches.run(&mut self.values, work.clock).map_err(|(part, error)| run_error(part, &error))?;
        self.places.copy_posteriors(&self.values, work.buffers)?;
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
