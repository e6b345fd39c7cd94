//! The compiled tick: segments of the exported parts, in tract, with our operators in place of the hot nodes.
//!
//! What needs only the action runs ahead of the image; once it is there, encoder, both posteriors (on two threads) and the actor stand between
//! it and the action.

mod pieces;

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use rcwm_models::ACTION_LEN;
use rcwm_models::bundle::{Bundle, PartName};
use tract_onnx::prelude::{TValue, TVec, TractResult};

use super::noise::NoiseSource;
use super::parts::{BranchBuffers, finite};
use super::stages::StageClock;
use super::tick::Tick;
use super::{Buffers, PolicyError, State};
use crate::compile::{CompileError, Optimizations, compile, inputs};
use crate::engine::{EngineError, weights};
use crate::operators::SharedTeam;
use crate::team::Team;
use pieces::{Piece, Values};

/// How long the helper looks for work after the last before it sleeps.
const HELPER_SPINS: Duration = Duration::from_micros(200);

/// A bundle's tick, ready to run.
pub(super) struct Compiled {
    values: Values,
    /// Early, in the order they run.
    early: Vec<Piece>,
    encoder: Piece,
    /// The posterior of each branch.
    branches: [Piece; 2],
    actor: Piece,
    team: Option<SharedTeam>,
}

const BRANCHES: [PartName; 2] = [PartName::Robot, PartName::Environment];
/// Outputs of a branch that must be known before the image is.
const PRIOR: [&str; 3] = ["h_next", "prior_z", "prior_log_probs"];

impl Compiled {
    pub(super) fn load(
        bundle: &Bundle,
        optimizations: Optimizations,
        threads: usize,
    ) -> Result<Self, PolicyError> {
        for part in PartName::REQUIRED {
            weights::check(part, bundle.part(part).ok_or(EngineError::NoPart { part })?)?;
        }
        let team = match threads {
            0 | 1 => None,
            _ => Some(Team::start(HELPER_SPINS).map_err(|error| PolicyError::Thread(error.to_string()))?),
        };
        let team = team.map(|team| Arc::new(Mutex::new(team)));
        let mut values = Values::default();
        let (mut early, mut late) = (Vec::new(), Vec::new());
        for segment in compile(bundle, optimizations)? {
            // The branches run beside one another: there is nobody to share with within them.
            let shares = segment.late && matches!(segment.part, PartName::Encoder | PartName::Actor);
            let piece = Piece::load(&segment, &mut values, team.as_ref().filter(|_| shares))?;
            if segment.late { late.push(piece) } else { early.push(piece) }
        }
        for branch in BRANCHES {
            for name in PRIOR.map(|name| format!("{branch}/{name}")) {
                if !early.iter().any(|piece| piece.makes(&values, &name)) {
                    let reason = format!("{name} depends on the image; a prior must not");
                    return Err(CompileError::Part { part: branch, reason }.into());
                }
            }
        }
        let mut late = |part: PartName| {
            let found =
                late.iter().position(|piece: &Piece| piece.part == part).map(|index| late.remove(index));
            let reason = || "nothing in it depends on the image".to_owned();
            found.ok_or_else(|| CompileError::Part { part, reason: reason() })
        };
        let (encoder, actor) = (late(PartName::Encoder)?, late(PartName::Actor)?);
        let branches = [late(PartName::Robot)?, late(PartName::Environment)?];
        Ok(Self { values, early, encoder, branches, actor, team })
    }

    /// The posteriors, side by side.
    fn run_branches(&mut self, clock: &mut StageClock) -> TractResult<()> {
        let Some(team) = &self.team else {
            for piece in &mut self.branches {
                piece.run(&mut self.values)?;
                clock.ended(piece.part);
            }
            return Ok(());
        };
        let values = &self.values;
        let lanes = self.branches.each_mut().map(|piece| {
            let inputs = piece.inputs(values);
            Mutex::new(Lane { piece, inputs, result: None, spent_ns: 0 })
        });
        team.lock().unwrap_or_else(std::sync::PoisonError::into_inner).each(lanes.len(), &|index| {
            lanes[index].lock().unwrap_or_else(std::sync::PoisonError::into_inner).run();
        });
        for lane in lanes {
            let lane = lane.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
            let results = lane.result.unwrap_or_else(|| Ok(TVec::new()))?;
            lane.piece.keep(results, &mut self.values);
            clock.took(lane.piece.part, lane.spent_ns);
        }
        clock.restart();
        Ok(())
    }

    fn act(&mut self, buffers: &mut Buffers, clock: &mut StageClock) -> Result<(), PolicyError> {
        self.actor.run(&mut self.values).map_err(|error| run_error(PartName::Actor, &error))?;
        self.values
            .copy("actor/mean", &mut buffers.mean)
            .map_err(|error| run_error(PartName::Actor, &error))?;
        self.values
            .copy("actor/std", &mut buffers.std)
            .map_err(|error| run_error(PartName::Actor, &error))?;
        clock.ended(PartName::Actor);
        finite(PartName::Actor, "mean", &buffers.mean)?;
        finite(PartName::Actor, "std", &buffers.std)
    }
}

/// A branch's piece on one of two threads.
struct Lane<'a> {
    piece: &'a mut Piece,
    inputs: TVec<TValue>,
    result: Option<TractResult<TVec<TValue>>>,
    spent_ns: u64,
}

impl Lane<'_> {
    fn run(&mut self) {
        let start = Instant::now();
        self.result = Some(self.piece.run_on(std::mem::take(&mut self.inputs)));
        self.spent_ns = start.elapsed().as_nanos() as u64;
    }
}

fn run_error(part: PartName, error: &tract_onnx::prelude::TractError) -> PolicyError {
    let reason = format!("{error:#}");
    EngineError::Run { engine: crate::EngineKind::Tract, part, reason: crate::engine::one_line(&reason) }
        .into()
}

impl Tick for Compiled {
    fn work_ahead(
        &mut self,
        state: &State,
        action: &[f32; ACTION_LEN],
        noise: &NoiseSource,
        buffers: &mut Buffers,
        clock: &mut StageClock,
    ) -> Result<(), PolicyError> {
        let fill = |values: &mut Values| {
            values.fill(inputs::ACTION, action.as_slice())?;
            values.fill(inputs::ROBOT_Z, &state.robot.z)?;
            values.fill(inputs::ROBOT_H, &state.robot.h)?;
            values.fill(inputs::ROBOT_NOISE, noise.robot())?;
            values.fill(inputs::ENVIRONMENT_Z, &state.environment.z)?;
            values.fill(inputs::ENVIRONMENT_H, &state.environment.h)?;
            values.fill(inputs::ENVIRONMENT_NOISE, noise.environment())
        };
        fill(&mut self.values).map_err(|error| run_error(PartName::Robot, &error))?;
        for piece in &mut self.early {
            piece.run(&mut self.values).map_err(|error| run_error(piece.part, &error))?;
            clock.ended(piece.part);
        }
        let values = &self.values;
        let copy = |part, branch: &mut BranchBuffers| {
            values.copy(output_name(part, 0), &mut branch.h_next)?;
            values.copy(output_name(part, 1), &mut branch.prior_z)?;
            values.copy(output_name(part, 2), &mut branch.prior_log_probs)
        };
        copy(PartName::Robot, &mut buffers.robot).map_err(|error| run_error(PartName::Robot, &error))?;
        copy(PartName::Environment, &mut buffers.environment)
            .map_err(|error| run_error(PartName::Environment, &error))?;
        values
            .copy("interaction/e", &mut buffers.e)
            .map_err(|error| run_error(PartName::Interaction, &error))?;
        values
            .copy("interaction/attention", &mut buffers.attention)
            .map_err(|error| run_error(PartName::Interaction, &error))?;
        finite(PartName::Interaction, "e", &buffers.e)?;
        buffers.check_priors()
    }

    fn observe(
        &mut self,
        image: &[u8],
        _: &State,
        _: &NoiseSource,
        buffers: &mut Buffers,
        clock: &mut StageClock,
    ) -> Result<(), PolicyError> {
        self.values.fill(inputs::IMAGE, image).map_err(|error| run_error(PartName::Encoder, &error))?;
        self.encoder.run(&mut self.values).map_err(|error| run_error(PartName::Encoder, &error))?;
        clock.ended(PartName::Encoder);
        self.run_branches(clock).map_err(|error| run_error(PartName::Robot, &error))?;
        for (part, branch) in
            [(PartName::Robot, &mut buffers.robot), (PartName::Environment, &mut buffers.environment)]
        {
            let (z, log_probs) = (output_name(part, 3), output_name(part, 4));
            let values = &self.values;
            values.copy(z, &mut branch.posterior_z).map_err(|error| run_error(part, &error))?;
            values
                .copy(log_probs, &mut branch.posterior_log_probs)
                .map_err(|error| run_error(part, &error))?;
        }
        buffers.check_posteriors()?;
        self.act(buffers, clock)
    }

    fn imagine(
        &mut self,
        _: &State,
        _: &NoiseSource,
        buffers: &mut Buffers,
        clock: &mut StageClock,
    ) -> Result<(), PolicyError> {
        for part in BRANCHES {
            self.values.alias(output_name(part, 1), output_name(part, 3));
        }
        buffers.believe_prior();
        self.act(buffers, clock)
    }

    fn wake(&self) {
        if let Some(team) = &self.team {
            team.lock().unwrap_or_else(std::sync::PoisonError::into_inner).wake();
        }
    }
}

/// Name of an output of a branch in the whole tick: h, prior z and log-probabilities, posterior z and log-probabilities.
const fn output_name(part: PartName, output: usize) -> &'static str {
    const ROBOT: [&str; 5] = [
        "robot/h_next",
        "robot/prior_z",
        "robot/prior_log_probs",
        "robot/posterior_z",
        "robot/posterior_log_probs",
    ];
    const ENVIRONMENT: [&str; 5] = [
        "environment/h_next",
        "environment/prior_z",
        "environment/prior_log_probs",
        "environment/posterior_z",
        "environment/posterior_log_probs",
    ];
    match part {
        PartName::Robot => ROBOT[output],
        _ => ENVIRONMENT[output],
    }
}
