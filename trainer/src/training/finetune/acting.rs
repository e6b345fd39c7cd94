//! Acting while the run learns.

use super::*;

impl Finetuning {
    /// Answers every observation; the last of an episode by zeros, which nobody executes.
    pub(super) fn act(
        &mut self,
        gathered: &[Gathered],
        fleet: &mut Fleet,
        policy: &mut Policy,
    ) -> Result<(), TrainingError> {
        let going_on: Vec<_> = gathered.iter().filter(|one| !one.is_last()).collect();
        let seen: Vec<_> = going_on.iter().map(|one| one.seen()).collect();
        let number = noise_number(self.core.state.policy_steps, gathered.iter().all(Gathered::is_first));
        let mut sampler = Sampler::numbered(self.core.settings.seed ^ ACTING_STREAM, number);
        let decisions = policy.decide(&seen, &mut sampler)?;
        for (one, decision) in going_on.into_iter().zip(&decisions) {
            fleet.answer(one, (!decision.refused).then_some(&*decision.action))?;
        }
        for one in gathered.iter().filter(|one| one.is_last()) {
            fleet.answer(one, None)?;
        }
        self.core.state.policy_steps += gathered.iter().filter(|one| !one.is_first()).count() as u64;
        let refused = decisions.iter().filter(|decision| decision.refused).count() as u64;
        self.refused_actions += refused;
        if refused > 0 {
            check_finite(&self.core.parameters)?;
        }
        Ok(())
    }

    /// Makes the evaluation that is due.
    pub(super) fn evaluate(
        &mut self,
        stop: &AtomicBool,
        show: &mut impl FnMut(&OnlineProgress<'_>),
    ) -> Result<(), TrainingError> {
        let due = self.core.settings.finetune.evaluation.due(self.core.state.policy_steps);
        if due <= self.evaluations || stop.load(Ordering::Relaxed) {
            return Ok(());
        }
        self.write_back()?;
        let agent = Agent::new(&self.core.parameters.frozen(), &self.core.settings.model)?;
        let steps = (self.core.state.policy_steps, ACTION_REPEAT * self.core.state.policy_steps);
        let Core { settings, interval, .. } = &mut self.core;
        let found = interval.time(TimeBucket::Evaluating, || evaluate(agent, settings, steps, stop))?;
        if let Some(evaluation) = found {
            self.evaluations = due;
            let line = EvaluationLine { update: self.core.state.updates, phase: ONLINE, evaluation };
            self.core.run.log(&line)?;
            show(&OnlineProgress { evaluation: Some(&line), ..self.progress() });
        }
        Ok(())
    }

    /// Keeps an episode: on disk, in the replay, in the metrics.
    pub(super) fn keep(
        &mut self,
        recorded: Recorded,
        replay: &SharedReplay,
        show: &mut impl FnMut(&OnlineProgress<'_>),
    ) -> Result<(), TrainingError> {
        let Recorded { simulator, episode } = recorded;
        let path =
            policy_episode(&self.folder, &self.core.settings.task, self.core.state.policy_steps, simulator);
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder)
                .map_err(|source| TrainingError::Folder { path: folder.to_path_buf(), source })?;
        }
        episode.write(&path)?;
        self.core.state.episodes += 1;
        self.newest.push_back(episode.succeeded());
        if self.newest.len() > self.core.settings.finetune.success_episodes {
            self.newest.pop_front();
        }
        let facts = EpisodeFacts {
            number: self.core.state.episodes,
            simulator,
            success: episode.succeeded(),
            total_reward: episode.total_reward(),
            steps: episode.len() as u64 - 1,
            policy_steps: self.core.state.policy_steps,
            environment_steps: ACTION_REPEAT * self.core.state.policy_steps,
        };
        replay.add(&self.core.settings.task, episode)?;
        let line = EpisodeLine { update: self.core.state.updates, phase: ONLINE, episode: facts };
        self.core.run.log(&line)?;
        show(&OnlineProgress { episode: Some(&line), ..self.progress() });
        Ok(())
    }

    /// What simulators are to run: new layouts, also after a run was resumed.
    pub(super) fn launches(&self) -> Vec<Launch> {
        let finetune = &self.core.settings.finetune;
        let launch = |index: usize| {
            let instance = format!("{}-{}-{index}", self.core.settings.phase.verb(), std::process::id());
            let first = FIRST_EPISODE + index as u64 * EPISODES_A_SIMULATOR + self.core.state.episodes;
            let usual = Launch::remote(&self.core.settings.task, &instance, self.core.settings.seed);
            let evaluation = &finetune.evaluation;
            let evaluated = if evaluation.every_steps > 0 { evaluation.episodes } else { 0 };
            Launch {
                // They stand still while separate episodes are run.
                silence_max: usual.silence_max + EVALUATED_EPISODE_MAX * evaluated as u32,
                first_episode: first,
                steps_max: finetune.episode_steps,
                masks: finetune.masks,
                disturb: finetune.disturb.clone(),
                ..usual
            }
        };
        (0..finetune.simulators).map(launch).collect()
    }
}

/// Which noise a decision takes after so many steps. The first decisions of episodes are no steps yet: with steps alone the second
/// ones would take the same noise.
fn noise_number(policy_steps: u64, all_first: bool) -> u64 {
    2 * policy_steps + u64::from(!all_first)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_two_decisions_take_the_same_noise() {
        let (mut steps, mut numbers) = (0, std::collections::BTreeSet::new());
        for _episode in 0..3 {
            for tick in 0..5 {
                assert!(numbers.insert(noise_number(steps, tick == 0)), "tick {tick} after {steps} steps");
                // Two simulators; what leads to an episode's first observation is no step.
                steps += if tick == 0 { 0 } else { 2 };
            }
        }
    }
}
