//! What a bundle holds, and what a tick of it costs.

mod cost;

pub use cost::{Cost, CostError};

use rcwm_models::bundle::{Bundle, Manifest, PartName, Provenance, TensorSpec};
use serde::Serialize;

/// Why a bundle could not be inspected.
#[derive(Debug, thiserror::Error)]
#[error("{part}: {source}")]
pub struct InspectError {
    part: PartName,
    source: CostError,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PartInfo {
    pub part: PartName,
    /// Whether it runs in every tick.
    pub in_tick: bool,
    /// Size of its file.
    pub file_bytes: u64,
    pub inputs: Vec<TensorSpec>,
    pub outputs: Vec<TensorSpec>,
    /// Cost of a run.
    #[serde(flatten)]
    pub cost: Cost,
}

/// A whole bundle.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BundleInfo {
    pub manifest: Manifest,
    /// Ticks of golden values.
    pub golden_ticks: usize,
    /// Parts, in the order they run.
    pub parts: Vec<PartInfo>,
    /// Cost of a tick: the parts that run in each.
    pub tick: Cost,
}

/// Inspects a bundle.
///
/// # Errors
/// [`InspectError`] when a part's shapes cannot be worked out.
pub fn inspect(bundle: &Bundle) -> Result<BundleInfo, InspectError> {
    let mut parts = Vec::new();
    for entry in &bundle.manifest.parts {
        let part = entry.name;
        let bytes = bundle.part(part).unwrap_or_default();
        let cost = Cost::of(bytes).map_err(|source| InspectError { part, source })?;
        parts.push(PartInfo {
            part,
            in_tick: bundle.manifest.kind.parts().contains(&part),
            file_bytes: entry.bytes,
            inputs: entry.inputs.clone(),
            outputs: entry.outputs.clone(),
            cost,
        });
    }
    let in_tick = parts.iter().filter(|part| part.in_tick);
    let tick = in_tick.fold(Cost::default(), |sum, part| sum.plus(&part.cost));
    let golden_ticks = bundle.golden.get("input/action").map_or(0, |values| values.shape()[0]);
    Ok(BundleInfo { manifest: bundle.manifest.clone(), golden_ticks, parts, tick })
}

impl BundleInfo {
    /// The tables for people.
    #[must_use]
    pub fn text(&self) -> String {
        self.heading() + &self.cost_table() + &self.operator_lines() + &self.border_lines()
    }

    fn heading(&self) -> String {
        let Manifest { task, kind, model, interface, provenance, .. } = &self.manifest;
        let limits = self.manifest.limits();
        let model = model.as_ref().map_or_else(
            || "one graph, no world model".to_owned(),
            |model| {
                format!(
                    "{} preset: {} categoricals of {} classes, deterministic width {}, cnn depth {}, hidden {}, units {}",
                    provenance.preset,
                    model.categoricals,
                    model.classes,
                    model.deter,
                    model.cnn_depth,
                    model.hidden,
                    model.units
                )
            },
        );
        // A policy of another library says nothing of how it was trained.
        let trained = self.manifest.model.as_ref().map_or_else(String::new, |_| {
            let Provenance { updates, seeds, source_revision, .. } = provenance;
            format!("; {updates} updates, seeds {seeds:?}, source {source_revision}")
        });
        format!(
            "task       {task}, robot {} at {} Hz, actions {:?} to {:?}\n\
             model      {kind}, {model}\n\
             origin     {}{trained}\n\
             golden     {} ticks\n",
            interface.name, interface.rate_hz, limits.low, limits.high, provenance.data, self.golden_ticks
        )
    }

    fn cost_table(&self) -> String {
        let mut text = format!(
            "\n  {:<12} {:>10} {:>11} {:>10} {:>13} {:>10}\n",
            "part", "file, kB", "parameters", "MFLOP/run", "weights, kB", "operators"
        );
        let row = |name: &str, file_bytes: u64, cost: &Cost| {
            format!(
                "  {name:<12} {:>10.1} {:>11} {:>10.3} {:>13.1} {:>10}\n",
                file_bytes as f64 / 1e3,
                cost.parameters,
                cost.flops as f64 / 1e6,
                cost.weight_bytes as f64 / 1e3,
                cost.operators.values().sum::<u64>()
            )
        };
        for part in &self.parts {
            text += &row(part.part.as_str(), part.file_bytes, &part.cost);
        }
        let file_bytes = self.parts.iter().filter(|part| part.in_tick).map(|part| part.file_bytes).sum();
        text + &row("one tick", file_bytes, &self.tick)
    }

    fn operator_lines(&self) -> String {
        let mut text = String::from("\noperators\n");
        for part in &self.parts {
            let counts: Vec<_> =
                part.cost.operators.iter().map(|(name, count)| format!("{name} {count}")).collect();
            text += &format!("  {:<12} {}\n", part.part.as_str(), counts.join(", "));
        }
        text
    }

    fn border_lines(&self) -> String {
        let list = |specs: &[TensorSpec]| {
            let each = specs.iter().map(|s| format!("{} {:?}{:?}", s.name, s.dtype, s.shape).to_lowercase());
            each.collect::<Vec<_>>().join(", ")
        };
        let mut text = String::from("\ninputs and outputs\n");
        for part in &self.parts {
            text += &format!("  {:<12} {}\n", part.part.as_str(), list(&part.inputs));
            text += &format!("  {:<12} -> {}\n", "", list(&part.outputs));
        }
        text
    }
}
