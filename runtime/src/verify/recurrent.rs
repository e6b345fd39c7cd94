//! The whole tick, carrying its own state.

use rcwm_models::bundle::{Bundle, BundleKind, PartName};

use super::golden::Golden;
use super::parts::{error_max, note_flips, worst};
use super::{Flip, RecurrentReport, VerifyError};
use crate::engine::EngineSettings;
use crate::policy::{Buffers, Policy, Sampling};

/// The state that a tick starts from.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Start {
    /// What the tick before it has left.
    Own,
    /// What the trainer had.
    Golden,
}

pub(super) fn run(
    bundle: &Bundle,
    golden: &Golden<'_>,
    settings: EngineSettings,
    start: Start,
    progress: &mut dyn FnMut(),
) -> Result<RecurrentReport, VerifyError> {
    let kind = bundle.manifest.kind;
    let mut policy = Policy::new(bundle, settings, Sampling::Mode)?;
    let mut report = RecurrentReport {
        ticks: golden.ticks,
        ticks_compared: 0,
        mean_error_max: 0.0,
        std_error_max: None,
        h_error_max: 0.0,
        flips: Vec::new(),
    };
    for tick in 0..golden.ticks {
        progress();
        let noise = kind.branches().iter().map(|branch| golden.noise(*branch, tick));
        policy.set_noise(&noise.collect::<Result<Vec<_>, _>>()?)?;
        let action = if golden.is_first(tick)? { None } else { Some(golden.executed(tick)?) };
        policy.observe(golden.inputs(tick)?, action.as_ref())?;
        let flips = flips_of(kind, golden, policy.buffers(), tick)?;
        if flips.is_empty() {
            report.compare(kind, golden, &policy, tick)?;
        }
        // After a flip the state would go its own way: it goes on from the trainer's, so that later ticks still tell something.
        if start == Start::Golden || !flips.is_empty() {
            policy.set_state(&golden.state_after(tick)?)?;
        }
        report.flips.extend(flips);
    }
    Ok(report)
}

/// The tick's flips, in the order they happen; what comes after the first may follow from it.
fn flips_of(
    kind: BundleKind,
    golden: &Golden<'_>,
    buffers: &Buffers,
    tick: usize,
) -> Result<Vec<Flip>, VerifyError> {
    let mut flips = Vec::new();
    for (branch, found) in kind.branches().iter().copied().zip(&buffers.branches) {
        // Only the robot's prior is used within the tick: through the interaction it moves the environment (eq. 7).
        let prior_moved = flips.iter().any(|flip: &Flip| flip.output == "prior_z");
        let before = flips.len();
        note_flips(golden, branch, 0, tick, &found.prior_z, &mut flips)?;
        note_flips(golden, branch, 1, tick, &found.posterior_z, &mut flips)?;
        for flip in &mut flips[before..] {
            flip.follows = prior_moved;
        }
    }
    Ok(flips)
}

impl RecurrentReport {
    fn compare(
        &mut self,
        kind: BundleKind,
        golden: &Golden<'_>,
        policy: &Policy,
        tick: usize,
    ) -> Result<(), VerifyError> {
        let found = policy.buffers();
        self.ticks_compared += 1;
        if kind == BundleKind::Recurrent {
            let expected = golden.expect_f32(PartName::Policy, "action", tick)?;
            self.mean_error_max = worst(self.mean_error_max, error_max(&found.mean, expected));
        } else {
            let actor = |output| golden.expect_f32(PartName::Actor, output, tick);
            self.mean_error_max = worst(self.mean_error_max, error_max(&found.mean, actor("mean")?));
            let std_error_max = self.std_error_max.get_or_insert(0.0);
            *std_error_max = worst(*std_error_max, error_max(&found.std, actor("std")?));
        }
        for (expected, found) in golden.state_after(tick)?.branches.iter().zip(&found.branches) {
            self.h_error_max = worst(self.h_error_max, error_max(&found.h_next, &expected.h));
        }
        Ok(())
    }
}
