use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use candle_core::Device;
use rcwm_models::episode::Episode;

use super::closed_loop::{ClosedLoopError, ClosedLoopReport, ClosedLoopSettings, Position, Served};
use crate::acting::{Fleet, Policy};
use crate::model::agent::Agent;
use crate::model::latent::Sampler;
use crate::simulators::Launch;

/// What a report of [`closed_loop_in_trainer`] gives as its engine.
pub const TRAINER_ENGINE: &str = "trainer";

/// Runs a policy in simulators and counts its successes, deciding in this process: `--engine trainer`, and while a policy learns.
/// The agent's parameters must be frozen. Layouts, episodes and what counts as success are those of [`super::closed_loop`].
///
/// # Errors
/// See [`ClosedLoopError`]; every process has ended then.
pub fn closed_loop_in_trainer(
    agent: Agent,
    settings: &ClosedLoopSettings,
    stop: &AtomicBool,
    mut seen: impl FnMut(&[Position]),
) -> Result<ClosedLoopReport, ClosedLoopError> {
    let begin = Instant::now();
    let shares = settings.shares();
    let launches: Vec<_> =
        shares.iter().enumerate().map(|(index, share)| launch(settings, index, share)).collect();
    let mut fleet = Fleet::new(&launches, &[])?;
    let mut policy = Policy::new(agent, fleet.len(), &Device::Cpu);
    let mut sampler = if settings.sample { Sampler::seeded(settings.seed) } else { Sampler::Mode };
    let mut served: Vec<_> = shares.iter().map(|_| Served::default()).collect();
    let mut positions = vec![Position::default(); fleet.len()];
    loop {
        let gathered = fleet.gather(stop)?;
        if stop.load(Ordering::Relaxed) {
            return Err(ClosedLoopError::Interrupted);
        }
        if gathered.is_empty() {
            break;
        }
        let sights: Vec<_> = gathered.iter().map(|one| one.seen()).collect();
        let decisions = policy.decide(&sights, &mut sampler)?;
        for (one, decision) in gathered.iter().zip(decisions) {
            if decision.refused {
                let (episode, step) = (one.observation.episode, one.observation.step);
                return Err(ClosedLoopError::NotFinite { episode, step });
            }
            fleet.answer(one, Some(&decision.action))?;
            if let Some(recorded) = fleet.record(one)? {
                served[recorded.simulator].add(&recorded.episode);
            }
            let episodes = served[one.simulator].successful.len() as u64;
            positions[one.simulator] = Position { episodes, steps: one.observation.step };
        }
        seen(&positions);
    }
    let found: u64 = served.iter().map(|served| served.successful.len() as u64).sum();
    if found != settings.episodes {
        return Err(ClosedLoopError::Short { found, expected: settings.episodes });
    }
    let settings = ClosedLoopSettings { engine: TRAINER_ENGINE.to_owned(), ..settings.clone() };
    Ok(ClosedLoopReport::new(settings, &served, Vec::new(), begin.elapsed()))
}

fn launch(settings: &ClosedLoopSettings, index: usize, share: &std::ops::Range<u64>) -> Launch {
    let instance = format!("evaluate-{}-{index}", std::process::id());
    Launch {
        layouts: settings.layouts.clone(),
        first_episode: share.start,
        episodes: share.end - share.start,
        steps_max: settings.steps_max,
        disturb: settings.disturb.clone(),
        program: settings.simulator.clone(),
        ..Launch::remote(&settings.task, &instance, settings.seed)
    }
}

impl Served {
    fn add(&mut self, episode: &Episode) {
        self.returns.push(episode.reward.iter().map(|reward| f64::from(*reward)).sum());
        self.successful.push(episode.success.iter().any(|success| *success));
        self.steps += episode.reward.len().saturating_sub(1) as u64;
    }
}
