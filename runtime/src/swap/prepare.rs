//! A policy made ready beside the running one.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use rcwm_models::bundle::Bundle;

use super::{SwapError, SwapSettings};
use crate::policy::Policy;
use crate::verify::verify;

/// Largest absolute error of a part's output against its golden values.
const TOLERANCE: f32 = 1e-5;

/// Loads, verifies and warms up. An engine that panics is an error like any other: the run must go on. Gives up between two steps when
/// nobody wants the bundle any more.
pub(super) fn prepare(
    folder: &Path,
    settings: &SwapSettings,
    wanted: &dyn Fn() -> bool,
) -> Result<Policy, SwapError> {
    // Nothing of what a panic may have left half-done is used again.
    match catch_unwind(AssertUnwindSafe(|| try_prepare(folder, settings, wanted))) {
        Ok(result) => result,
        Err(panic) => {
            let text = panic.downcast_ref::<String>().map(String::as_str);
            let text =
                text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("a panic without words");
            Err(SwapError::Panicked(text.split_whitespace().collect::<Vec<_>>().join(" ")))
        }
    }
}

fn try_prepare(
    folder: &Path,
    settings: &SwapSettings,
    wanted: &dyn Fn() -> bool,
) -> Result<Policy, SwapError> {
    let still_wanted = || if wanted() { Ok(()) } else { Err(SwapError::Unwanted) };
    still_wanted()?;
    let bundle = Bundle::open(folder)?;
    let (found, expected) = (bundle.manifest.interface.rate_hz, settings.interface.rate_hz);
    if found != expected {
        return Err(SwapError::Rate { found, expected });
    }
    if let Some(mismatch) = bundle.manifest.mismatches(&settings.interface).into_iter().next() {
        return Err(SwapError::DoesNotFit(mismatch));
    }
    settings.surprise.check(bundle.manifest.kind)?;
    still_wanted()?;
    // In the form that will run: its threads, its weights.
    let report = verify(&bundle, settings.engine, TOLERANCE, &mut || {})?;
    if let Some((first, others)) = report.failures.split_first() {
        return Err(SwapError::NotVerified { first: first.clone(), others: others.len() });
    }
    still_wanted()?;
    // Loading ends with some ticks, so that the first real one finds memory and caches ready.
    Ok(Policy::new(&bundle, settings.engine, settings.sampling)?)
}
