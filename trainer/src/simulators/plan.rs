use std::path::{Path, PathBuf};

use rcwm_models::episode::{Episode, EpisodeError};

/// Who decides while episodes are collected.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Script {
    /// The task's scripted expert.
    Expert,
    /// The expert with noise and bursts of random actions.
    Mixed,
    /// The expert, pushed off course now and then.
    Pushed,
    /// Uniform in [-1, 1].
    Random,
}

impl Script {
    /// The first number that no script's episodes have.
    pub const END: u64 = 4_000_000;

    /// All of them.
    pub const ALL: [Self; 4] = [Self::Expert, Self::Mixed, Self::Random, Self::Pushed];

    /// The simulator's name of it, and the beginning of its episodes' file names.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Expert => "expert",
            Self::Mixed => "mixed",
            Self::Random => "random",
            Self::Pushed => "pushed",
        }
    }

    /// Number of its first episode: layouts depend on the number, and no two scripts are to share them.
    const fn first_number(self) -> u64 {
        match self {
            Self::Expert => 0,
            Self::Mixed => 1_000_000,
            Self::Random => 2_000_000,
            Self::Pushed => 3_000_000,
        }
    }
}

/// Episodes a task, by who decides.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Amounts {
    pub expert: u64,
    /// By the disturbed expert.
    pub mixed: u64,
    /// By chance.
    pub random: u64,
    /// By the expert, pushed off course now and then.
    pub pushed: u64,
    /// How many of all these have robot masks.
    pub masked: u64,
}

impl Amounts {
    /// Episodes of one script.
    #[must_use]
    pub const fn of(&self, script: Script) -> u64 {
        match script {
            Script::Expert => self.expert,
            Script::Mixed => self.mixed,
            Script::Random => self.random,
            Script::Pushed => self.pushed,
        }
    }

    /// All episodes of a task.
    #[must_use]
    pub const fn total(&self) -> u64 {
        self.expert + self.mixed + self.random + self.pushed
    }

    /// How many of a script's episodes have masks, its first ones: equal shares as far as they go, the most varied first.
    fn masked_of(&self, script: Script) -> u64 {
        let mut left = self.masked.min(self.total());
        let mut given = [0_u64; 4];
        let order = [Script::Mixed, Script::Random, Script::Expert, Script::Pushed];
        while left > 0 {
            for (share, script) in given.iter_mut().zip(order) {
                if left > 0 && *share < self.of(script) {
                    *share += 1;
                    left -= 1;
                }
            }
        }
        order.iter().zip(given).find(|(candidate, _)| **candidate == script).map_or(0, |(_, share)| share)
    }
}

/// Episodes of one task and script in a row: the work of one simulator.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Job {
    /// Name of the task.
    pub task: String,
    /// Who decides.
    pub script: Script,
    /// Whether with masks.
    pub masks: bool,
    /// First episode, counted within the script.
    pub first: u64,
    /// How many.
    pub episodes: u64,
}

impl Job {
    /// Number of the first episode on the wire.
    #[must_use]
    pub fn first_number(&self) -> u64 {
        self.script.first_number() + self.first
    }

    /// Where the episode of this number on the wire belongs.
    #[must_use]
    pub fn file(&self, out: &Path, seed: u64, number: u64) -> PathBuf {
        file(out, &self.task, self.script, seed, number.saturating_sub(self.script.first_number()))
    }
}

fn file(out: &Path, task: &str, script: Script, seed: u64, index: u64) -> PathBuf {
    out.join(task).join(format!("{}-seed{seed}-{index:05}.npz", script.name()))
}

/// What is still to be collected.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Plan {
    /// In the order of work.
    pub jobs: Vec<Job>,
    /// Episodes that were there already.
    pub present: u64,
}

impl Plan {
    /// The episodes that `out` does not hold yet, in runs of at most `run` episodes: a simulator takes seconds to load, but short
    /// runs keep several of them busy to the end.
    #[must_use]
    pub fn new(out: &Path, tasks: &[String], amounts: &Amounts, seed: u64, run: u64) -> Self {
        let mut plan = Self::default();
        for task in tasks {
            for script in Script::ALL {
                plan.add(task, script, amounts, run, |index| file(out, task, script, seed, index).exists());
            }
        }
        plan
    }

    /// Episodes still to be collected.
    #[must_use]
    pub fn episodes(&self) -> u64 {
        self.jobs.iter().map(|job| job.episodes).sum()
    }

    /// The same for pictures in another look: the episodes that have none yet.
    ///
    /// # Errors
    /// Those of reading an episode that is there.
    pub fn of_disturbed(
        out: &Path,
        tasks: &[String],
        amounts: &Amounts,
        seed: u64,
        run: u64,
    ) -> Result<Self, EpisodeError> {
        let amounts = Amounts { masked: 0, ..*amounts };
        let mut plan = Self::default();
        let mut failed = None;
        for task in tasks {
            for script in Script::ALL {
                plan.add(task, script, &amounts, run, |index| {
                    let found = Episode::is_disturbed(&file(out, task, script, seed, index));
                    found.unwrap_or_else(|error| {
                        failed.get_or_insert(error);
                        true
                    })
                });
            }
        }
        if let Some(error) = failed {
            return Err(error);
        }
        Ok(plan)
    }

    /// Episodes of a script for which nothing `is_done` yet.
    fn add(
        &mut self,
        task: &str,
        script: Script,
        amounts: &Amounts,
        run: u64,
        mut is_done: impl FnMut(u64) -> bool,
    ) {
        let masked = amounts.masked_of(script);
        let mut open: Option<Job> = None;
        for index in 0..amounts.of(script) {
            let masks = index < masked;
            if is_done(index) {
                self.present += 1;
                self.jobs.extend(open.take());
                continue;
            }
            match &mut open {
                Some(job) if job.masks == masks && job.episodes < run => job.episodes += 1,
                _ => {
                    let job = Job { task: task.to_owned(), script, masks, first: index, episodes: 1 };
                    self.jobs.extend(open.replace(job));
                }
            }
        }
        self.jobs.extend(open);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const AMOUNTS: Amounts = Amounts { expert: 5, mixed: 3, random: 1, pushed: 0, masked: 4 };

    #[test]
    fn masks_are_spread_over_the_scripts() {
        let shares = [Script::Mixed, Script::Random, Script::Expert].map(|script| AMOUNTS.masked_of(script));
        assert_eq!(shares, [2, 1, 1]);
        let all = Amounts { masked: 99, ..AMOUNTS };
        assert_eq!(Script::ALL.map(|script| all.masked_of(script)), [5, 3, 1, 0]);
    }

    #[test]
    fn a_plan_covers_every_episode_once_in_short_runs() {
        let folder = tempfile::tempdir().unwrap();
        let tasks = ["reach".to_owned(), "hammer".to_owned()];
        let plan = Plan::new(folder.path(), &tasks, &AMOUNTS, 0, 2);
        assert_eq!((plan.episodes(), plan.present), (18, 0));
        assert!(plan.jobs.iter().all(|job| job.episodes <= 2));
        let masked: u64 = plan.jobs.iter().filter(|job| job.masks).map(|job| job.episodes).sum();
        assert_eq!(masked, 8);
    }

    #[test]
    fn what_is_there_is_not_collected_again() {
        let folder = tempfile::tempdir().unwrap();
        let present = file(folder.path(), "reach", Script::Expert, 0, 2);
        std::fs::create_dir_all(present.parent().unwrap()).unwrap();
        std::fs::write(&present, b"").unwrap();
        let amounts = Amounts { expert: 5, ..Amounts::default() };
        let plan = Plan::new(folder.path(), &["reach".to_owned()], &amounts, 0, 10);
        assert_eq!((plan.episodes(), plan.present), (4, 1));
        let runs: Vec<_> = plan.jobs.iter().map(|job| (job.first, job.episodes)).collect();
        assert_eq!(runs, [(0, 2), (3, 2)]);
        assert_eq!(
            Plan::new(folder.path(), &["reach".to_owned()], &amounts, 1, 10).episodes(),
            5,
            "another seed"
        );
    }

    #[test]
    fn scripts_share_no_layout() {
        let job = |script| Job { task: "reach".into(), script, masks: false, first: 7, episodes: 1 };
        let numbers = Script::ALL.map(|script| job(script).first_number());
        assert!(numbers[0] != numbers[1] && numbers[1] != numbers[2] && numbers[0] != numbers[2]);
        let path = job(Script::Mixed).file(Path::new("data"), 3, numbers[1]);
        assert_eq!(path, Path::new("data/reach/mixed-seed3-00007.npz"));
    }
}
