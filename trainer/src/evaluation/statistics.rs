use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// How many times a bootstrap draws anew.
const RESAMPLES: usize = 1000;
/// The same where whole trainings are drawn, of which there are few.
const RESAMPLES_OF_SEEDS: usize = 10_000;
/// Training seeds from which on an interval over them says something.
pub const SEEDS_LEAST: usize = 5;
/// Share of the draws left out at each end: a 95% interval.
const TAIL: f64 = 0.025;
/// Quantile of the normal distribution behind a 95% interval.
const Z: f64 = 1.959_963_985;

/// An interval that holds the true value in 95 of 100 such experiments.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// Wilson's 95% interval of a rate: `successes` of `trials`. Unlike the usual one it is sensible for few trials and for all or none.
#[must_use]
pub fn wilson(successes: usize, trials: usize) -> Interval {
    if trials == 0 {
        return Interval { low: 0.0, high: 1.0 };
    }
    let (n, rate) = (trials as f64, successes as f64 / trials as f64);
    let shrink = 1.0 + Z * Z / n;
    let middle = (rate + Z * Z / (2.0 * n)) / shrink;
    let half = Z / shrink * (rate * (1.0 - rate) / n + Z * Z / (4.0 * n * n)).sqrt();
    Interval { low: (middle - half).max(0.0), high: (middle + half).min(1.0) }
}

/// Mean and standard deviation (of the population) of what is there; none where there is nothing.
#[must_use]
pub fn mean_and_std(values: impl IntoIterator<Item = f64>) -> Option<(f64, f64)> {
    let values: Vec<f64> = values.into_iter().collect();
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
    (!values.is_empty()).then(|| (mean, variance.sqrt()))
}

/// Draws of trajectories with replacement. Whole episodes are drawn, because the trajectories of one are alike: an interval over
/// trajectories drawn one by one would be too narrow.
#[derive(Debug)]
pub struct Bootstrap {
    /// Empty where there are fewer than two episodes.
    draws: Vec<Vec<usize>>,
}

impl Bootstrap {
    /// `episodes` says of every trajectory which episode it is of.
    #[must_use]
    pub fn new(episodes: &[usize], seed: u64) -> Self {
        let count = episodes.iter().max().map_or(0, |last| last + 1);
        let mut members = vec![Vec::new(); count];
        for (trajectory, episode) in episodes.iter().enumerate() {
            members[*episode].push(trajectory);
        }
        members.retain(|trajectories| !trajectories.is_empty());
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut draw = || -> Vec<usize> {
            let drawn = (0..members.len()).map(|_| random.random_range(0..members.len()));
            drawn.flat_map(|episode| members[episode].iter().copied()).collect()
        };
        let resamples = if members.len() < 2 { 0 } else { RESAMPLES };
        Self { draws: (0..resamples).map(|_| draw()).collect() }
    }

    /// The interval of what `of` makes of drawn trajectories; none of fewer than two episodes: there is nothing to draw.
    #[must_use]
    pub fn interval(&self, of: impl Fn(&[usize]) -> Option<f64>) -> Option<Interval> {
        middle(self.draws.iter().filter_map(|draw| of(draw)).collect())
    }
}

/// The range that holds 95 of 100.
fn middle(mut found: Vec<f64>) -> Option<Interval> {
    found.sort_by(f64::total_cmp);
    let last = found.len().checked_sub(1)?;
    let at = |share: f64| found[(share * last as f64).round() as usize];
    Some(Interval { low: at(TAIL), high: at(1.0 - TAIL) })
}

/// The 95% bootstrap interval of what `of` makes of the means of two groups of training seeds, which are drawn with replacement and
/// independently; each value is one seed's, over all its episodes. None where both have fewer than two seeds: there is nothing to draw.
#[must_use]
pub fn interval_over_seeds(
    ours: &[f64],
    theirs: &[f64],
    of: impl Fn(f64, f64) -> f64,
    seed: u64,
) -> Option<Interval> {
    if ours.len().max(theirs.len()) < 2 || ours.is_empty() || theirs.is_empty() {
        return None;
    }
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut mean = |values: &[f64]| {
        let drawn = (0..values.len()).map(|_| values[random.random_range(0..values.len())]);
        drawn.sum::<f64>() / values.len() as f64
    };
    let found = (0..RESAMPLES_OF_SEEDS).map(|_| of(mean(ours), mean(theirs)));
    middle(found.filter(|value| value.is_finite()).collect())
}

/// The 95% bootstrap interval of the mean of training seeds, each value one seed's; none of fewer than two.
#[must_use]
pub fn mean_over_seeds(values: &[f64], seed: u64) -> Option<Interval> {
    if values.len() < 2 { None } else { interval_over_seeds(values, &[0.0], |mean, _| mean, seed) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wilson_agrees_with_published_values() {
        let near = |found: Interval, low: f64, high: f64| {
            assert!((found.low - low).abs() < 5e-4 && (found.high - high).abs() < 5e-4, "{found:?}");
        };
        near(wilson(0, 20), 0.0, 0.1611);
        near(wilson(20, 20), 0.8389, 1.0);
        near(wilson(81, 263), 0.2553, 0.3662);
        near(wilson(0, 0), 0.0, 1.0);
    }

    #[test]
    fn a_bootstrap_interval_holds_the_mean_and_shrinks_with_more_episodes() {
        let width = |episodes: usize| {
            let values: Vec<f64> = (0..episodes).map(|i| (i * 7919 % 100) as f64).collect();
            let bootstrap = Bootstrap::new(&(0..episodes).collect::<Vec<_>>(), 3);
            let mean = |draw: &[usize]| mean_and_std(draw.iter().map(|i| values[*i])).map(|(mean, _)| mean);
            let interval = bootstrap.interval(mean).unwrap();
            let (truth, _) = mean_and_std(values.iter().copied()).unwrap();
            assert!(interval.low < truth && truth < interval.high);
            interval.high - interval.low
        };
        let (few, many) = (width(25), width(400));
        assert!((3.0..5.5).contains(&(few / many)), "{few} {many}");
    }

    #[test]
    fn trajectories_of_one_episode_are_drawn_together() {
        // Ten trajectories a value, but two episodes only: the mean is 0, 1 or half.
        let episodes: Vec<usize> = (0..20).map(|trajectory| trajectory / 10).collect();
        let bootstrap = Bootstrap::new(&episodes, 1);
        let mean =
            |draw: &[usize]| mean_and_std(draw.iter().map(|i| episodes[*i] as f64)).map(|(mean, _)| mean);
        assert_eq!(bootstrap.interval(mean), Some(Interval { low: 0.0, high: 1.0 }));
    }

    #[test]
    fn one_episode_has_no_interval_however_many_trajectories_are_of_it() {
        let bootstrap = Bootstrap::new(&[3; 20], 1);
        let mean = |draw: &[usize]| mean_and_std(draw.iter().map(|i| *i as f64)).map(|(mean, _)| mean);
        assert_eq!(bootstrap.interval(mean), None);
    }

    #[test]
    fn an_interval_over_seeds_is_as_wide_as_seeds_differ() {
        let ratio = |ours: &[f64], theirs: &[f64]| interval_over_seeds(ours, theirs, |a, b| a / b, 0);
        let same = ratio(&[1.0; 5], &[2.0; 5]).unwrap();
        assert_eq!((same.low, same.high), (0.5, 0.5), "no matter how many episodes each has");
        let found = ratio(&[0.9, 1.0, 1.1, 0.8, 1.2], &[2.0; 5]).unwrap();
        // The standard error of the mean of five is 0.063: 1.96 of them on either side, halved by the division.
        assert!((found.low - 0.438).abs() < 0.01 && (found.high - 0.562).abs() < 0.01, "{found:?}");
        let both = ratio(&[0.9, 1.0, 1.1, 0.8, 1.2], &[1.8, 2.0, 2.2, 1.6, 2.4]).unwrap();
        assert!(both.high - both.low > 1.3 * (found.high - found.low), "both groups are drawn: {both:?}");
        assert_eq!(ratio(&[1.0], &[2.0]), None, "one seed each: nothing to draw");
        assert!(ratio(&[1.0, 2.0], &[2.0]).is_some() && ratio(&[], &[2.0, 1.0]).is_none());
        assert_eq!(mean_over_seeds(&[3.0], 0), None);
        assert_eq!(mean_over_seeds(&[1.0, 2.0], 0), Some(Interval { low: 1.0, high: 2.0 }));
    }

    #[test]
    fn nothing_has_no_mean_and_no_interval() {
        assert_eq!(mean_and_std([]), None);
        assert_eq!(Bootstrap::new(&[], 0).interval(|_| None), None);
    }
}
