//! Success of policies that are trainings of the same with other seeds. Episodes are pooled within a training; what a bootstrap draws is
//! trainings, because a rate over all their episodes does not hold how much trainings differ.

use serde::Serialize;

use crate::evaluation::{
    Interval, Over, SEEDS_LEAST, interval_over_seeds, mean_and_std, mean_over_seeds, wilson,
};

/// Of the bootstrap.
const SEED: u64 = 0;

/// All episodes of one training.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Training {
    successes: usize,
    episodes: usize,
    return_sum: f64,
}

/// Trainings of one label on one task, taken together.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Pooled {
    pub label: String,
    pub task: String,
    /// Visual disturbance.
    pub disturb: String,
    /// Episodes in all.
    pub episodes: usize,
    /// Those that were solved.
    pub successes: usize,
    /// 95% interval: a bootstrap over trainings, or Wilson's over the episodes of one.
    pub interval: Interval,
    /// Which of the two; seeds as the first of the pair.
    pub over: Over,
    /// Mean return of an episode.
    pub return_mean: Option<f64>,
    /// Success rate of each training.
    pub rates: Vec<f64>,
    /// Their mean and standard deviation, from two on.
    pub spread: Option<(f64, f64)>,
}

/// Two labels on one task.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SuccessComparison {
    pub task: String,
    /// Visual disturbance.
    pub disturb: String,
    pub label: String,
    /// The label it is compared with.
    pub against: String,
    /// Mean success rate of its trainings less that of the other's.
    pub difference: f64,
    /// 95% bootstrap interval of the difference; trainings of both are drawn. None of one training each.
    pub interval: Option<Interval>,
    /// Trainings of both.
    pub over: Over,
}

impl Training {
    pub(super) fn of(successes: usize, episodes: usize, return_mean: f64) -> Self {
        Self { successes, episodes, return_sum: return_mean * episodes as f64 }
    }

    /// Takes more episodes of the same training in.
    pub(super) fn add(&mut self, other: &Self) {
        self.successes += other.successes;
        self.episodes += other.episodes;
        self.return_sum += other.return_sum;
    }
}

/// Takes trainings together.
pub(super) fn pool(label: &str, task: &str, disturb: &str, trainings: &[Training]) -> Pooled {
    let episodes = trainings.iter().map(|training| training.episodes).sum();
    let successes = trainings.iter().map(|training| training.successes).sum();
    let returned: f64 = trainings.iter().map(|training| training.return_sum).sum();
    let rate = |training: &Training| training.successes as f64 / training.episodes.max(1) as f64;
    let rates: Vec<f64> = trainings.iter().map(rate).collect();
    let over_seeds = mean_over_seeds(&rates, SEED);
    Pooled {
        label: label.to_owned(),
        task: task.to_owned(),
        disturb: disturb.to_owned(),
        episodes,
        successes,
        interval: over_seeds.unwrap_or_else(|| wilson(successes, episodes)),
        over: if over_seeds.is_some() { Over::Seeds(rates.len(), 0) } else { Over::Episodes },
        return_mean: (episodes > 0).then(|| returned / episodes as f64),
        spread: if rates.len() > 1 { mean_and_std(rates.iter().copied()) } else { None },
        rates,
    }
}

/// Every later label against the first of the same task and disturbance.
pub(super) fn compared(pooled: &[Pooled]) -> Vec<SuccessComparison> {
    let mut found = Vec::new();
    for (place, ours) in pooled.iter().enumerate() {
        let same = |other: &&Pooled| (&other.task, &other.disturb) == (&ours.task, &ours.disturb);
        let Some(first) = pooled[..place].iter().find(same) else { continue };
        let mean = |rates: &[f64]| rates.iter().sum::<f64>() / rates.len().max(1) as f64;
        found.push(SuccessComparison {
            task: ours.task.clone(),
            disturb: ours.disturb.clone(),
            label: ours.label.clone(),
            against: first.label.clone(),
            difference: mean(&ours.rates) - mean(&first.rates),
            interval: interval_over_seeds(&ours.rates, &first.rates, |a, b| a - b, SEED),
            over: Over::Seeds(ours.rates.len(), first.rates.len()),
        });
    }
    found
}

/// How many trainings, and whether that is enough to say something.
pub(super) fn trainings(over: Over) -> String {
    match over {
        Over::Episodes => "one training: interval over its episodes".to_owned(),
        Over::Seeds(count, 0) if count < SEEDS_LEAST => {
            format!("{count} seeds; fewer than {SEEDS_LEAST}: no result yet")
        }
        Over::Seeds(count, 0) => format!("{count} seeds"),
        Over::Seeds(..) => over.to_string().trim_start_matches("over ").to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pooled(label: &str, successes: &[usize]) -> Pooled {
        let trainings: Vec<Training> =
            successes.iter().map(|solved| Training::of(*solved, 50, 1.0)).collect();
        pool(label, "hammer", "none", &trainings)
    }

    #[test]
    fn a_difference_between_labels_is_held_against_how_trainings_differ() {
        // 250 episodes each: over episodes the difference of ten points would be sure.
        let spread = [pooled("scratch", &[45, 10, 40, 20, 35]), pooled("pre-trained", &[50, 15, 45, 25, 40])];
        let [found] = compared(&spread).try_into().unwrap();
        let interval = found.interval.unwrap();
        assert!(
            (found.difference - 0.1).abs() < 1e-9 && interval.low < -0.1 && interval.high > 0.3,
            "{found:?}"
        );
        let alike = [pooled("scratch", &[30, 31, 29, 30, 30]), pooled("pre-trained", &[35, 36, 34, 35, 35])];
        let interval = compared(&alike)[0].interval.unwrap();
        assert!(interval.low > 0.08 && interval.high < 0.12, "{interval:?}");
        assert_eq!(trainings(compared(&alike)[0].over), "5 and 5 training seeds");
    }

    #[test]
    fn one_training_has_wilsons_interval_and_a_difference_of_two_has_none() {
        let pair = [pooled("a", &[40]), pooled("b", &[45])];
        assert_eq!((pair[0].over, pair[0].interval), (Over::Episodes, wilson(40, 50)));
        let found = &compared(&pair)[0];
        assert_eq!(found.interval, None);
        assert!(trainings(found.over).contains("fewer than 5"));
    }
}
