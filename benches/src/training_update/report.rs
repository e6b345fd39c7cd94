//! From times to tables and JSON.

use std::time::Duration;

use anyhow::Result;
use serde::Serialize;

use crate::arithmetic::Work;
use crate::case::{Case, Times};

/// A part's time and what it did in it.
#[derive(Debug, Serialize)]
pub struct Row {
    pub part: String,
    pub median_ms: f64,
    pub least_ms: f64,
    pub p90_ms: f64,
    pub most_ms: f64,
    pub gflop: f64,
    pub gflops_per_s: f64,
    /// Of the product measured in the same run.
    pub share_of_peak: f64,
    pub mbyte: f64,
    pub gbyte_per_s: f64,
}

/// A case's results.
#[derive(Debug, Serialize)]
pub struct Report {
    pub name: String,
    pub batch: usize,
    pub length: usize,
    pub horizon: usize,
    pub updates: usize,
    pub parameters: usize,
    /// Median of the products measured between the updates.
    pub peak_gflops_per_s: f64,
    pub memory_peak_mbyte: f64,
    /// Load of the machine (1 minute) when the case ended, this program included.
    pub load: Option<f64>,
    pub parts: Vec<Row>,
    pub world: Row,
    pub behaviour: Row,
}

/// Parts that belong to the world model's update; the others are the behaviour's.
const WORLD: [&str; 7] =
    ["encode", "observe", "decode", "other losses", "world backward", "world sum", "world Adam"];

impl Report {
    pub fn new(case: &Case, times: &Times) -> Result<Self> {
        let work = case.work()?;
        let mut peaks = times.peaks.clone();
        peaks.sort_by(f64::total_cmp);
        let peak = peaks.get(peaks.len() / 2).copied().unwrap_or(f64::NAN);
        let of = |part: &str| work.get(part).copied().unwrap_or_default();
        let parts = times.parts.iter().map(|(part, times)| Row::new(part, times, of(part), peak)).collect();
        let sum = |world: bool| -> Work {
            work.iter().filter(|(part, _)| WORLD.contains(part) == world).map(|(_, work)| *work).sum()
        };
        let specs = rcwm_trainer::model::agent::specs(&case.settings)?;
        Ok(Self {
            name: case.name.clone(),
            batch: case.scale.batch,
            length: case.scale.length,
            horizon: case.scale.horizon,
            updates: times.world.len(),
            parameters: specs.iter().map(|spec| spec.shape.iter().product::<usize>()).sum(),
            peak_gflops_per_s: peak / 1e9,
            memory_peak_mbyte: times.memory_bytes as f64 / 1e6,
            load: load(),
            parts,
            world: Row::new("world model", &times.world, sum(true), peak),
            behaviour: Row::new("behaviour", &times.behaviour, sum(false), peak),
        })
    }

    /// The table of parts.
    pub fn print(&self) {
        rcwm_models::outln!(
            "{}: batch {} x {}, imagination {}, {:.1} M parameters; {} updates; gemm peak {:.0} GFLOP/s; memory {:.0} MB; load {}",
            self.name,
            self.batch,
            self.length,
            self.horizon,
            self.parameters as f64 / 1e6,
            self.updates,
            self.peak_gflops_per_s,
            self.memory_peak_mbyte,
            self.load.map_or("unknown".to_owned(), |load| format!("{load:.1}")),
        );
        rcwm_models::outln!(
            "  {:16} {:>9} {:>9} {:>9} {:>9} {:>8} {:>9} {:>6} {:>8} {:>6}",
            "part",
            "median ms",
            "least",
            "90 %",
            "most",
            "GFLOP",
            "GFLOP/s",
            "peak",
            "MB",
            "GB/s"
        );
        for row in self.parts.iter().chain([&self.world, &self.behaviour]) {
            row.print();
        }
        rcwm_models::outln!();
    }

    /// One line of the growth table.
    pub fn print_line(&self) {
        rcwm_models::outln!(
            "  {:12} {:>9.1} {:>9.1} {:>9.1} {:>9.1} {:>10.2} {:>10.2} {:>9.0}",
            self.name,
            self.world.median_ms,
            self.world.least_ms,
            self.behaviour.median_ms,
            self.behaviour.least_ms,
            self.world.gflop,
            self.behaviour.gflop,
            self.memory_peak_mbyte
        );
    }

    pub fn print_heading() {
        rcwm_models::outln!("growth of the small update, one size changed at a time");
        rcwm_models::outln!(
            "  {:12} {:>9} {:>9} {:>9} {:>9} {:>10} {:>10} {:>9}",
            "changed",
            "world ms",
            "least",
            "behav. ms",
            "least",
            "w. GFLOP",
            "b. GFLOP",
            "memory MB"
        );
    }
}

impl Row {
    fn new(part: &str, times: &[Duration], work: Work, peak: f64) -> Self {
        let mut seconds: Vec<f64> = times.iter().map(Duration::as_secs_f64).collect();
        seconds.sort_by(f64::total_cmp);
        let at = |share: f64| seconds.get((share * seconds.len() as f64) as usize).or(seconds.last());
        let [least, median, p90, most] =
            [0.0, 0.5, 0.9, 1.0].map(|share| at(share).copied().unwrap_or(f64::NAN));
        let rate = work.flops / median;
        Self {
            part: part.to_owned(),
            median_ms: 1e3 * median,
            least_ms: 1e3 * least,
            p90_ms: 1e3 * p90,
            most_ms: 1e3 * most,
            gflop: work.flops / 1e9,
            gflops_per_s: rate / 1e9,
            share_of_peak: rate / peak,
            mbyte: work.bytes / 1e6,
            gbyte_per_s: work.bytes / median / 1e9,
        }
    }

    fn print(&self) {
        rcwm_models::outln!(
            "  {:16} {:>9.2} {:>9.2} {:>9.2} {:>9.2} {:>8.2} {:>9.1} {:>5.0}% {:>8.1} {:>6.1}",
            self.part,
            self.median_ms,
            self.least_ms,
            self.p90_ms,
            self.most_ms,
            self.gflop,
            self.gflops_per_s,
            100.0 * self.share_of_peak,
            self.mbyte,
            self.gbyte_per_s
        );
    }
}

fn load() -> Option<f64> {
    std::fs::read_to_string("/proc/loadavg").ok()?.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_has_the_order_statistics_of_its_times() {
        let times: Vec<Duration> = [5, 1, 4, 2, 3].map(Duration::from_millis).to_vec();
        let row = Row::new("part", &times, Work { flops: 3e6, bytes: 6e6 }, 2e9);
        let found =
            [row.least_ms, row.median_ms, row.p90_ms, row.most_ms].map(|ms| (ms * 1e3).round() as u64);
        assert_eq!(found, [1000, 3000, 5000, 5000]);
        assert!((row.gflops_per_s - 1.0).abs() < 1e-9 && (row.share_of_peak - 0.5).abs() < 1e-9);
        assert!((row.gbyte_per_s - 2.0).abs() < 1e-9);
    }
}
