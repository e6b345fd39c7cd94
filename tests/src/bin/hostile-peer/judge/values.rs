//! The numbers of each action: where it may start from, and what it is made of.

use rcwm_models::ACTION_LEN;
use rcwm_models::wire::{Action, ActionSource, ObservationFlags};
use rcwm_runtime::controller::Fallback;
use rcwm_runtime::policy::ActionLimits;

use super::{Judge, Newest, Vector};
use crate::bundles::Known;

impl Judge {
    /// What the robot may have executed last: the rate limit counts from one of them, and holding means one of them.
    pub(super) fn bases_of(&self, newest: &Newest) -> Vec<Vector> {
        let mut bases: Vec<Vector> = self.last.iter().map(|last| last.action).collect();
        let starts = !self.in_episode;
        // What the peer says was executed counts as long as no stand-in was sent since.
        if newest.stand_ins == 0 && newest.heard.is_executable() {
            bases.push(newest.heard.executed);
        }
        bases.extend(newest.executed_again);
        bases.extend(&self.unanswered_executed);
        let rests = self.running.iter().any(|running| !running.is_absolute);
        if rests && starts && (newest.heard.flags.contains(ObservationFlags::FIRST) || bases.is_empty()) {
            bases.push([0.0; ACTION_LEN].into());
        }
        bases
    }

    pub(super) fn check_rate(&mut self, action: &Action) {
        let Some(rate_max) = self.setup.rate_max.filter(|_| !self.is_free) else { return };
        let near = |base: &Vector, limits: &ActionLimits| {
            let base: Vec<f64> = base.iter().copied().map(f64::from).collect();
            (0..ACTION_LEN).all(|i| {
                let (low, high) = (f64::from(limits.low[i]), f64::from(limits.high[i]));
                let slack = 1e-6 * (1.0 + base[i].abs());
                // Limits come last, so that one that lies beyond the rate's reach is gone to at once.
                let lowest = (base[i] - f64::from(rate_max)).clamp(low, high) - slack;
                let highest = (base[i] + f64::from(rate_max)).clamp(low, high) + slack;
                (lowest..=highest).contains(&f64::from(action.action[i]))
            })
        };
        if !self.bases.iter().any(|base| self.running.iter().any(|running| near(base, &running.limits))) {
            let (bases, newest) = (self.bases.clone(), self.newest.map(|newest| newest.heard));
            self.object("rate", || {
                format!("{action:?} after one of {bases:?}, limit {rate_max}; {newest:?}")
            });
        }
    }

    /// Whether an action is what the filter makes of a target, from any base.
    pub(super) fn is_made_of(&self, action: &Action, target: &Vector) -> bool {
        let made = |limits: &ActionLimits, base: &Vector, i: usize| {
            let wanted = target[i].clamp(limits.low[i], limits.high[i]);
            let Some(rate_max) = self.setup.rate_max.filter(|_| !self.is_free) else { return wanted };
            let near = |base: f32| (base - rate_max, base + rate_max);
            let (mut low, mut high) = near(base[i]);
            // Near to what was sent last, too, where that is possible.
            let last = near(self.before.map_or(base[i], |before| before.action[i]));
            if low.max(last.0) <= high.min(last.1) {
                (low, high) = (low.max(last.0), high.min(last.1));
            }
            wanted.clamp(low, high).clamp(limits.low[i], limits.high[i])
        };
        let near = |a: f32, b: f32| (a - b).abs() <= 1e-6 * (1.0 + b.abs());
        let same = |limits: &ActionLimits, base: &Vector| {
            (0..ACTION_LEN).all(|i| near(made(limits, base, i), action.action[i]))
        };
        // Where the robot stands may not be known, and then does not count.
        let nowhere = [*target];
        let bases = if self.is_free && self.bases.is_empty() { &nowhere } else { self.bases.as_slice() };
        let any = |running: &Known| bases.iter().any(|base| same(&running.limits, base));
        self.running.iter().any(any)
    }

    /// A fallback is the one that was asked for.
    pub(super) fn check_target(&mut self, action: &Action, source: ActionSource) {
        if source != ActionSource::Fallback || self.repeats(action) {
            return;
        }
        let holds = || self.bases.iter().any(|base| self.is_made_of(action, base));
        let fits = match self.setup.fallback {
            Fallback::Hold => holds(),
            // Zeros are no rest where actions are positions; so do our interfaces say it.
            Fallback::Zero | Fallback::Interface => {
                let any = |absolute: bool| self.running.iter().any(|running| running.is_absolute == absolute);
                any(true) && holds() || any(false) && self.is_made_of(action, &[0.0; ACTION_LEN].into())
            }
            Fallback::Given(target) => self.is_made_of(action, &target),
        };
        if !fits {
            let (fallback, bases) = (self.setup.fallback, self.bases.clone());
            let newest = self.newest.map(|newest| newest.heard);
            self.object("fallback", || {
                format!("{action:?} is not {fallback:?} after one of {bases:?}; {newest:?}")
            });
        }
    }

    fn repeats(&self, action: &Action) -> bool {
        self.newest.is_some_and(|newest| newest.heard.sequence == action.answers && newest.answer.is_some())
    }

    /// The policy's decision of the tick whose action was just sent.
    pub(crate) fn decided(&mut self, action: &Action, decision: Option<Vector>) {
        if action.source == ActionSource::Fallback as u32 {
            return;
        }
        match decision {
            Some(decision) if self.is_made_of(action, &decision) => {}
            other => {
                let bases = self.bases.clone();
                self.object("marked", || {
                    format!("{action:?}, but the policy decided {other:?} after {bases:?}")
                });
            }
        }
    }
}
