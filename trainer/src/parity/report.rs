use std::collections::{BTreeMap, BTreeSet};

use candle_core::{DType, Device, Tensor};
use serde::Serialize;

use super::{Group, Measure, ParityError, Reference};

/// One tensor, ours against the reference's.
#[derive(Debug, Clone, Serialize)]
pub struct Comparison {
    /// Name in the file.
    pub name: String,
    /// Numbers compared.
    pub values: usize,
    /// Largest error, in the group's measure; NaN if any of our numbers is NaN, infinite if the shapes differ.
    pub error_max: f32,
    /// Largest magnitude in the reference.
    pub largest: f32,
}

impl Comparison {
    /// The largest difference between `found` and the reference tensor `name`.
    pub(super) fn new(
        reference: &Reference,
        name: &str,
        found: &Tensor,
        measure: Measure,
    ) -> Result<Self, ParityError> {
        let expected = reference.tensor(name, &Device::Cpu)?;
        if found.dims() != expected.dims() {
            return Ok(Self { name: name.to_owned(), values: 0, error_max: f32::INFINITY, largest: 0.0 });
        }
        let values = |x: &Tensor| x.to_dtype(DType::F32)?.flatten_all()?.to_vec1::<f32>();
        let (found, expected) = (values(found)?, values(&expected)?);
        let error = |worst: f32, (a, b): (&f32, &f32)| {
            // f32::max drops NaN; a NaN of ours must survive.
            let error = (a - b).abs();
            if worst.is_nan() || error.is_nan() { f32::NAN } else { worst.max(error) }
        };
        let largest = expected.iter().fold(0f32, |largest, x| largest.max(x.abs()));
        let unit = match measure {
            Measure::Absolute => 1.0,
            Measure::Relative => reference.unit(name)?,
        };
        let error_max = found.iter().zip(&expected).fold(0.0, error) / unit;
        Ok(Self { name: name.to_owned(), values: expected.len(), error_max, largest })
    }
}

/// A group's tensors.
#[derive(Debug, Clone, Serialize)]
pub struct GroupReport {
    pub group: Group,
    /// How its errors are measured.
    pub measure: Measure,
    /// Largest error accepted.
    pub tolerance: f32,
    /// Its tensors.
    pub comparisons: Vec<Comparison>,
}

impl GroupReport {
    /// The tensor with the largest error; one with NaN or another shape before all others.
    #[must_use]
    pub fn worst(&self) -> Option<&Comparison> {
        let rank = |comparison: &&Comparison| {
            if comparison.error_max.is_nan() { f32::INFINITY } else { comparison.error_max }
        };
        self.comparisons.iter().max_by(|a, b| rank(a).total_cmp(&rank(b)))
    }

    /// Whether it holds at least one tensor and every one is within tolerance.
    #[must_use]
    pub fn passes(&self) -> bool {
        // Written so that NaN fails.
        !self.comparisons.is_empty() && self.comparisons.iter().all(|c| c.error_max <= self.tolerance)
    }
}

/// Reference tensors that nothing was compared with.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Unchecked {
    /// First part of their names.
    pub prefix: String,
    /// How many.
    pub tensors: usize,
}

/// The outcome of a comparison.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    /// The groups compared.
    pub groups: Vec<GroupReport>,
    /// What the file holds beyond them.
    pub unchecked: Vec<Unchecked>,
}

impl Report {
    pub(super) fn new(reference: &Reference, groups: Vec<GroupReport>) -> Self {
        let checked: BTreeSet<&str> =
            groups.iter().flat_map(|group| &group.comparisons).map(|c| c.name.as_str()).collect();
        let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
        for name in reference.tensors.0.keys() {
            let prefix = name.split('/').next().unwrap_or(name);
            if !matches!(prefix, "weights" | "input") && !checked.contains(name.as_str()) {
                *counts.entry(prefix).or_default() += 1;
            }
        }
        let unchecked =
            counts.into_iter().map(|(prefix, tensors)| Unchecked { prefix: prefix.to_owned(), tensors });
        Self { unchecked: unchecked.collect(), groups }
    }

    /// Whether every group compared is within tolerance.
    #[must_use]
    pub fn passes(&self) -> bool {
        !self.groups.is_empty() && self.groups.iter().all(GroupReport::passes)
    }
}
