use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use serde::Serialize;
use serde_json::{Map, Value};

/// Means of numbers under dotted names, as they come: the fields of a serialised value that are numbers, at any depth.
#[derive(Debug, Clone, Default)]
pub struct Averages {
    sums: BTreeMap<String, (f64, u64)>,
}

impl Averages {
    /// Takes in the numbers of `value`, under `name`.
    pub fn add(&mut self, name: &str, value: &Value) {
        match value {
            Value::Object(fields) => {
                fields.iter().for_each(|(field, value)| self.add(&format!("{name}.{field}"), value));
            }
            value => {
                if let Some(number) = value.as_f64() {
                    let (sum, count) = self.sums.entry(name.to_owned()).or_default();
                    *sum += number;
                    *count += 1;
                }
            }
        }
    }

    /// The mean under a dotted name.
    #[must_use]
    pub fn mean(&self, name: &str) -> Option<f64> {
        self.sums.get(name).map(|(sum, count)| sum / *count as f64)
    }

    fn nested(&self) -> Map<String, Value> {
        let mut root = Map::new();
        for name in self.sums.keys() {
            let mut place = &mut root;
            let (path, leaf) = name.rsplit_once('.').unwrap_or(("", name));
            for part in path.split('.').filter(|part| !part.is_empty()) {
                let slot = place.entry(part).or_insert_with(|| Value::Object(Map::new()));
                let Value::Object(inner) = slot else { return root };
                place = inner;
            }
            place.insert(leaf.to_owned(), self.mean(name).into());
        }
        root
    }
}

/// What time was spent on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum TimeBucket {
    /// Updates.
    Learning,
    /// Deciding on actions, and keeping what came of them.
    Acting,
    /// Separate episodes.
    Evaluating,
    /// Until simulators had answered.
    WaitingForSimulators,
    /// Until batches were drawn.
    WaitingForBatches,
}

impl TimeBucket {
    const fn name(self) -> &'static str {
        match self {
            Self::Learning => "learning_share",
            Self::Acting => "acting_share",
            Self::Evaluating => "evaluating_share",
            Self::WaitingForSimulators => "waiting_for_simulators_share",
            Self::WaitingForBatches => "waiting_share",
        }
    }
}

/// One line of metrics: means since the line before.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Line {
    /// Updates made so far.
    pub update: u64,
    /// The stage that the run is in.
    pub phase: &'static str,
    /// Means by name, nested.
    #[serde(flatten)]
    pub values: Map<String, Value>,
}

impl Line {
    /// Tells another number.
    pub fn set(&mut self, name: &str, number: f64) {
        self.values.insert(name.to_owned(), number.into());
    }

    /// The number under a dotted name.
    #[must_use]
    pub fn number(&self, name: &str) -> Option<f64> {
        let mut path = name.split('.');
        let first = self.values.get(path.next()?)?;
        path.try_fold(first, |value, part| value.get(part))?.as_f64()
    }
}

/// What happens between two lines of metrics.
#[derive(Debug)]
pub struct Interval {
    begin: Instant,
    updates: u64,
    spent: BTreeMap<TimeBucket, Duration>,
    averages: Averages,
}

impl Interval {
    /// Begins now.
    #[must_use]
    pub fn begin() -> Self {
        Self { begin: Instant::now(), updates: 0, spent: BTreeMap::new(), averages: Averages::default() }
    }

    /// Counts an update and takes in what it says: the numbers of an object, by their names.
    pub fn update(&mut self, values: &Value) {
        self.updates += 1;
        let fields = values.as_object().into_iter().flatten();
        fields.for_each(|(name, value)| self.averages.add(name, value));
    }

    /// Runs `work` and counts its time.
    pub fn time<T>(&mut self, on: TimeBucket, work: impl FnOnce() -> T) -> T {
        let begin = Instant::now();
        let result = work();
        self.add(on, begin.elapsed());
        result
    }

    /// Counts time that was spent.
    pub fn add(&mut self, on: TimeBucket, time: Duration) {
        *self.spent.entry(on).or_default() += time;
    }

    /// Counts as if this time had not passed.
    pub fn leave_out(&mut self, time: Duration) {
        self.begin += time;
    }

    /// The line that ends here; the next one begins.
    pub fn end(&mut self, update: u64, phase: &'static str) -> Line {
        let done = std::mem::replace(self, Self::begin());
        let seconds = done.begin.elapsed().as_secs_f64().max(1e-9);
        let mut values = done.averages.nested();
        values.insert("updates_per_second".into(), (done.updates as f64 / seconds).into());
        for (on, time) in &done.spent {
            values.insert(on.name().into(), (time.as_secs_f64() / seconds).into());
        }
        Line { update, phase, values }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn numbers_are_averaged_under_their_names_at_any_depth() {
        let mut interval = Interval::begin();
        for image in [1.0, 3.0] {
            let losses = json!({"image": image, "kl": {"robot": 2.0 * image}, "kind": "text"});
            interval.update(&json!({"losses": losses, "norm": 7.0}));
        }
        let line = interval.end(9, "world");
        assert_eq!(line.number("losses.image"), Some(2.0));
        assert_eq!(line.number("losses.kl.robot"), Some(4.0));
        assert_eq!((line.number("norm"), line.number("losses.kind")), (Some(7.0), None));
        assert_eq!(interval.end(10, "world").number("norm"), None, "the next line begins anew");
    }
}
