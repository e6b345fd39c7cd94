//! What Linux says about a process.

use std::time::Duration;

use anyhow::Context;
use serde::Serialize;

/// A process at one moment.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Sample {
    /// Since the start, in s.
    pub(crate) time_s: f64,
    /// Which tenth of the time it is.
    pub(crate) tenth: usize,
    /// Resident memory in all.
    pub(crate) resident_kib: u64,
    /// That of it which is in no file and not shared: what the program itself has asked for.
    pub(crate) anonymous_kib: u64,
    pub(crate) threads: u64,
    pub(crate) open_files: usize,
}

impl Sample {
    pub(crate) fn of(process: u32, time: Duration, tenth: usize) -> anyhow::Result<Self> {
        let path = format!("/proc/{process}/status");
        let text = std::fs::read_to_string(&path).with_context(|| format!("{path}: has the run ended?"))?;
        let number = |name: &str| -> anyhow::Result<u64> {
            let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'));
            let word = line.and_then(|line| line.split_whitespace().next());
            // A process that has ended and was not waited for has no memory.
            word.with_context(|| format!("{path} has no {name}: has the run ended?"))?
                .parse()
                .context(path.clone())
        };
        let open_files =
            std::fs::read_dir(format!("/proc/{process}/fd")).context("the run's open files")?.count();
        Ok(Self {
            time_s: time.as_secs_f64(),
            tenth,
            resident_kib: number("VmRSS")?,
            anonymous_kib: number("RssAnon")?,
            threads: number("Threads")?,
            open_files,
        })
    }
}

/// The one in the middle; none of nothing.
pub(crate) fn median(values: impl Iterator<Item = u64>) -> Option<f64> {
    let mut values: Vec<u64> = values.collect();
    values.sort_unstable();
    let (lower, upper) = (values.get(values.len().checked_sub(1)? / 2)?, values.get(values.len() / 2)?);
    Some((*lower as f64 + *upper as f64) / 2.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn this_process_has_memory_threads_and_files() {
        let sample = Sample::of(std::process::id(), Duration::ZERO, 0).unwrap();
        assert!(sample.resident_kib >= sample.anonymous_kib && sample.anonymous_kib > 0, "{sample:?}");
        assert!(sample.threads > 0 && sample.open_files > 2, "{sample:?}");
        assert!(Sample::of(u32::MAX, Duration::ZERO, 0).is_err());
    }

    #[test]
    fn the_median_is_the_middle_or_between_the_two() {
        assert_eq!(median([5, 1, 3].into_iter()), Some(3.0));
        assert_eq!(median([4, 1, 3, 2].into_iter()), Some(2.5));
        assert_eq!(median(std::iter::empty()), None);
    }
}
