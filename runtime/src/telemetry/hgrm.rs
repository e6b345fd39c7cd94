//! Histograms as HdrHistogram's percentile files, which the usual plotters read: one file a stage, in microseconds.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use hdrhistogram::Histogram;
use rcwm_models::files::FileError;

use super::{Stage, Telemetry};

/// Rows between one power of two of `1 / (1 - percentile)` and the next.
const TICKS_PER_HALF_DISTANCE: u32 = 5;
/// Of a histogram with three significant digits.
const SUB_BUCKETS: u32 = 2048;
const NS_PER_US: f64 = 1e3;

impl Telemetry {
    /// Writes `STAGE.hgrm` of every stage that has recorded anything into a folder, which is made where it is missing.
    pub fn write_hgrm(&self, folder: &Path) -> Result<Vec<PathBuf>, FileError> {
        std::fs::create_dir_all(folder)
            .map_err(|source| FileError::Io { path: folder.to_path_buf(), source })?;
        let stages = Stage::ALL.into_iter().filter(|stage| !self.histogram(*stage).is_empty());
        stages
            .map(|stage| {
                let path = folder.join(format!("{}.hgrm", stage.as_str()));
                rcwm_models::files::write_atomic(&path, text(self.histogram(stage)).as_bytes())?;
                Ok(path)
            })
            .collect()
    }
}

/// The percentile distribution of a histogram of nanoseconds, in microseconds.
fn text(histogram: &Histogram<u64>) -> String {
    let mut text =
        format!("{:>12} {:>14} {:>10} {:>14}\n\n", "Value", "Percentile", "TotalCount", "1/(1-Percentile)");
    let mut below = 0;
    for step in histogram.iter_quantiles(TICKS_PER_HALF_DISTANCE) {
        let value = step.value_iterated_to() as f64 / NS_PER_US;
        let quantile = step.quantile_iterated_to();
        below += step.count_since_last_iteration();
        let distance = match 1.0 - quantile {
            left if left > 0.0 => format!("{:>14.2}", 1.0 / left),
            _ => String::new(),
        };
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{value:>12.3} {quantile:>14.12} {below:>10} {distance}");
    }
    let us = |ns: f64| ns / NS_PER_US;
    let _ = writeln!(
        text,
        "#[Mean    = {:>12.3}, StdDeviation   = {:>12.3}]",
        us(histogram.mean()),
        us(histogram.stdev())
    );
    let _ = writeln!(
        text,
        "#[Max     = {:>12.3}, Total count    = {:>12}]",
        us(histogram.max() as f64),
        histogram.len()
    );
    let _ = writeln!(text, "#[Buckets = {:>12}, SubBuckets     = {SUB_BUCKETS:>12}]", histogram.buckets());
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stage_s_file_holds_its_distribution_in_microseconds() {
        let mut telemetry = Telemetry::new();
        for time_us in 1..=1000 {
            telemetry.record(Stage::Tick, time_us * 1000);
        }
        let folder = tempfile::tempdir().unwrap();
        let files = telemetry.write_hgrm(&folder.path().join("hgrm")).unwrap();
        assert_eq!(files, [folder.path().join("hgrm/tick.hgrm")], "stages without times have no file");
        let text = std::fs::read_to_string(&files[0]).unwrap();
        let rows: Vec<Vec<f64>> = text
            .lines()
            .skip(2)
            .filter(|line| !line.starts_with('#'))
            .map(|line| line.split_whitespace().map(|word| word.parse().unwrap()).collect())
            .collect();
        assert!(rows.iter().rev().skip(1).all(|row| row.len() == 4), "{text}");
        assert!(rows.is_sorted_by(|a, b| a[0] <= b[0] && a[1] <= b[1] && a[2] <= b[2]), "{text}");
        let median = rows.iter().find(|row| row[1] >= 0.5).unwrap();
        assert!((median[0] / 500.0 - 1.0).abs() < 2e-3 && (median[3] - 2.0).abs() < 1e-9, "{median:?}");
        let last = rows.last().unwrap();
        assert!((last[0] / 1000.0 - 1.0).abs() < 2e-3 && last[1..] == [1.0, 1000.0], "{last:?}");
        assert!(text.contains("Total count    =         1000]"), "{text}");
    }
}
