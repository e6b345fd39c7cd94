//! Our numbers against the authors': a reference file holds weights, inputs and what their implementation made of them.
//!
//! A group of tensors is checked by computing it with our model on the file's weights, from the file's inputs on. What the file
//! holds and nothing here computes is listed as not checked; it never counts as a pass.

mod forward;
mod group;
mod programs;
mod reference;
mod report;
mod updates;

use std::path::Path;

use candle_core::Device;

pub use group::{Group, Measure};
pub use reference::{Reference, ReferenceError};
pub use report::{Comparison, GroupReport, Report, Unchecked};

use crate::gpu::Share;
use crate::learning::LearningError;
use crate::model::parameters::ParameterError;

/// Why a file could not be compared.
#[derive(Debug, thiserror::Error)]
pub enum ParityError {
    /// The file is unusable.
    #[error(transparent)]
    Reference(#[from] ReferenceError),
    /// Its weights do not fit the model.
    #[error("reference weights: {0}")]
    Parameters(#[from] ParameterError),
    /// An update could not be made.
    #[error(transparent)]
    Learning(#[from] LearningError),
    /// A tensor operation failed.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}

/// Compares a reference file with our model.
///
/// # Errors
/// See [`ParityError`]; a difference is no error but part of the report.
pub fn check_file(
    path: &Path,
    groups: &[Group],
    device: &Device,
    done: &mut dyn FnMut(&GroupReport),
) -> Result<Report, ParityError> {
    check(&Reference::read(path)?, groups, device, done)
}

/// Compares a reference file with the updates that programs make on `machine`: the groups from [`Group::Loss`] on,
/// each of which `done` hears of.
///
/// # Errors
/// See [`ParityError`]; a difference is no error but part of the report.
pub fn check_programs(
    path: &Path,
    groups: &[Group],
    share: &Share,
    done: &mut dyn FnMut(&GroupReport),
) -> Result<Report, ParityError> {
    let reference = Reference::read(path)?;
    let made = programs::Programs::new(&reference, share)?;
    let mut reports = Vec::new();
    for group in groups.iter().filter(|group| **group > Group::Behaviour) {
        let report = compare(&reference, *group, made.compute(*group)?)?;
        done(&report);
        reports.push(report);
    }
    Ok(Report::new(&reference, reports))
}

/// Compares a reference with our model, group by group, each of which `done` hears of.
///
/// # Errors
/// See [`ParityError`]; a difference is no error but part of the report.
pub fn check(
    reference: &Reference,
    groups: &[Group],
    device: &Device,
    done: &mut dyn FnMut(&GroupReport),
) -> Result<Report, ParityError> {
    let mut forward = forward::Forward::new(reference, device)?;
    let mut updates = None;
    let mut reports = Vec::new();
    for group in groups {
        let found = if *group <= Group::Behaviour {
            forward.compute(*group)?
        } else {
            // Made once, and only if one of its groups is asked for.
            let made = updates.take().map_or_else(|| updates::Updates::new(reference, device), Ok)?;
            updates.insert(made).compute(*group)?
        };
        let report = compare(reference, *group, found)?;
        done(&report);
        reports.push(report);
    }
    Ok(Report::new(reference, reports))
}

fn compare(
    reference: &Reference,
    group: Group,
    found: Vec<(String, candle_core::Tensor)>,
) -> Result<GroupReport, ParityError> {
    let (measure, tolerance) = group.tolerance();
    let compare =
        |(name, found): (String, candle_core::Tensor)| Comparison::new(reference, &name, &found, measure);
    let comparisons = found.into_iter().map(compare).collect::<Result<_, ParityError>>()?;
    Ok(GroupReport { group, measure, tolerance, comparisons })
}
