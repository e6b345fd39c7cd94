//! Who decides: the controller on the link, or a scripted source for collecting data.

use clap::ValueEnum;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::ACTION_LEN;
use serde::Serialize;

use crate::SimulatorError;
use crate::environment::Environment;

/// The scale of the noise of a mixed episode is drawn from 0 to this.
const NOISE_SCALE_MAX: f32 = 0.6;
/// Share of a mixed episode's decisions that begin a burst of random actions, and the burst's length.
const BURST_SHARE: f64 = 0.02;
const BURST_STEPS: std::ops::RangeInclusive<u32> = 5..=20;

/// Chance that an episode begins with a push, share of the other decisions that begin one, and a push's length: one direction all along.
const FIRST_PUSH_SHARE: f64 = 0.5;
const PUSH_SHARE: f64 = 0.05;
const PUSH_STEPS: std::ops::RangeInclusive<u32> = 2..=8;

/// The action's component that opens and closes the gripper.
const GRIPPER: usize = 3;

/// Where the executed actions come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Policy {
    /// The controller on the link.
    #[default]
    Remote,
    /// The task's scripted expert.
    Expert,
    /// Uniform in [-1, 1].
    Random,
    /// The expert with noise of a scale drawn for each episode, and bursts of random actions: varied data around success.
    Mixed,
    /// The expert, pushed off course now and then, also at the start: shows how to recover. What was pushed is marked.
    Pushed,
}

impl Policy {
    /// Whether the simulator itself decides.
    #[must_use]
    pub const fn is_scripted(self) -> bool {
        !matches!(self, Self::Remote)
    }
}

/// A scripted source within one episode; the same seed and episode give the same decisions in the same states.
pub struct Script {
    policy: Policy,
    random: ChaCha8Rng,
    noise_scale: f32,
    burst_steps_left: u32,
    /// Where it is pushed to, and for how many decisions more.
    push: ([f32; ACTION_LEN], u32),
    first: bool,
    pushed: bool,
}

impl Script {
    /// The source of one episode.
    #[must_use]
    pub fn new(policy: Policy, seed: u64, episode: u64) -> Self {
        let mut key = [0; 32];
        key[..8].copy_from_slice(&seed.to_le_bytes());
        key[8..16].copy_from_slice(&episode.to_le_bytes());
        let mut random = ChaCha8Rng::from_seed(key);
        let noise_scale = random.random_range(0.0..NOISE_SCALE_MAX);
        Self {
            policy,
            random,
            noise_scale,
            burst_steps_left: 0,
            push: ([0.0; ACTION_LEN], 0),
            first: true,
            pushed: false,
        }
    }

    /// The next decision, each component in [-1, 1]; `None` where the controller decides.
    ///
    /// # Errors
    /// [`SimulatorError::Python`] from the expert.
    pub fn decide(&mut self, environment: &Environment) -> Result<Option<[f32; ACTION_LEN]>, SimulatorError> {
        Ok(match self.policy {
            Policy::Remote => None,
            Policy::Random => Some(self.uniform()),
            Policy::Expert => Some(environment.expert_action()?),
            Policy::Mixed => Some(self.mixed(environment)?),
            Policy::Pushed => Some(self.pushed_off(environment.expert_action()?)),
        })
    }

    /// Whether the last decision was a push off course.
    #[must_use]
    pub const fn pushed(&self) -> bool {
        self.pushed
    }

    /// The expert's decision, or a push in its place; the gripper does what the expert wants, so that nothing is dropped.
    fn pushed_off(&mut self, expert: [f32; ACTION_LEN]) -> [f32; ACTION_LEN] {
        let share = if std::mem::take(&mut self.first) { FIRST_PUSH_SHARE } else { PUSH_SHARE };
        if self.push.1 == 0 && self.random.random_bool(share) {
            self.push = (self.uniform(), self.random.random_range(PUSH_STEPS));
        }
        self.pushed = self.push.1 > 0;
        if !self.pushed {
            return expert;
        }
        self.push.1 -= 1;
        let [x, y, z, _] = self.push.0;
        [x, y, z, expert[GRIPPER]]
    }

    fn mixed(&mut self, environment: &Environment) -> Result<[f32; ACTION_LEN], SimulatorError> {
        if self.in_burst() {
            return Ok(self.uniform());
        }
        let expert = environment.expert_action()?;
        Ok(expert.map(|x| (x + self.noise_scale * self.normal()).clamp(-1.0, 1.0)))
    }

    fn in_burst(&mut self) -> bool {
        if self.burst_steps_left == 0 && self.random.random_bool(BURST_SHARE) {
            self.burst_steps_left = self.random.random_range(BURST_STEPS);
        }
        let burst = self.burst_steps_left > 0;
        self.burst_steps_left = self.burst_steps_left.saturating_sub(1);
        burst
    }

    fn uniform(&mut self) -> [f32; ACTION_LEN] {
        std::array::from_fn(|_| self.random.random_range(-1.0..=1.0))
    }

    /// Standard normal, by Box and Muller.
    fn normal(&mut self) -> f32 {
        let radius = (-2.0 * (1.0 - self.random.random::<f32>()).ln()).sqrt();
        radius * (std::f32::consts::TAU * self.random.random::<f32>()).cos()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn uniform_actions(seed: u64, episode: u64) -> Vec<[f32; ACTION_LEN]> {
        let mut script = Script::new(Policy::Random, seed, episode);
        (0..100).map(|_| script.uniform()).collect()
    }

    #[test]
    fn an_episode_has_its_own_decisions_and_the_same_ones_again() {
        assert_eq!(uniform_actions(1, 2), uniform_actions(1, 2));
        assert_ne!(uniform_actions(1, 2), uniform_actions(1, 3));
        assert_ne!(uniform_actions(1, 2), uniform_actions(2, 2));
        assert!(uniform_actions(1, 2).iter().flatten().all(|x| (-1.0..=1.0).contains(x)));
    }

    #[test]
    fn the_noise_is_standard_normal() {
        let mut script = Script::new(Policy::Mixed, 0, 0);
        let draws: Vec<f32> = (0..20_000).map(|_| script.normal()).collect();
        let mean = draws.iter().sum::<f32>() / draws.len() as f32;
        let variance = draws.iter().map(|x| (x - mean).powi(2)).sum::<f32>() / draws.len() as f32;
        assert!(mean.abs() < 0.03 && (variance - 1.0).abs() < 0.05, "mean {mean}, variance {variance}");
    }

    #[test]
    fn bursts_come_and_end() {
        let mut script = Script::new(Policy::Mixed, 0, 0);
        let in_burst = (0..10_000).filter(|_| script.in_burst()).count();
        // Each decision outside a burst begins one of 12.5 steps on average in 2 of 100 cases: a fifth of all.
        assert!((1_000..3_500).contains(&in_burst), "{in_burst}");
    }

    #[test]
    fn pushes_come_and_end_and_leave_the_gripper_to_the_expert() {
        let expert = [0.5, -0.5, 0.25, -1.0];
        let (mut pushed, mut pushes, mut first) = (0, 0, 0);
        for episode in 0..200 {
            let mut script = Script::new(Policy::Pushed, 1, episode);
            let mut before: Option<[f32; ACTION_LEN]> = None;
            for step in 0..100 {
                let action = script.pushed_off(expert);
                assert_eq!(action[GRIPPER], expert[GRIPPER]);
                assert_eq!(script.pushed(), action != expert);
                first += u32::from(step == 0 && script.pushed());
                pushed += u32::from(script.pushed());
                pushes += u32::from(script.pushed() && before != Some(action));
                before = script.pushed().then_some(action);
            }
        }
        assert!((70..130).contains(&first), "{first} of 200 episodes began with a push");
        // Pushes of 5 decisions on average, one of 20 others begins one: a fifth of all.
        assert!((3_000..5_500).contains(&pushed) && (700..1_100).contains(&pushes), "{pushed} in {pushes}");
    }
}
