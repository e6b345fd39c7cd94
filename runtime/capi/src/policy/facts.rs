//! What of a policy cannot change, and whether what is handed over fits it.

use std::ffi::CString;

use rcwm_models::bundle::Manifest;

use crate::code::Failure;

/// Read by any thread.
pub(super) struct Facts {
    pub(super) interface: CString,
    pub(super) rate_hz: f64,
    pub(super) action_numbers: usize,
    pub(super) imagines: bool,
    /// In the order of `policy.inputs`.
    pub(super) inputs: Vec<Known>,
}

pub(super) struct Known {
    pub(super) name: CString,
    /// Rows and columns; none of a state.
    pub(super) picture: Option<[usize; 2]>,
    /// Bytes of a picture, numbers of a state.
    pub(super) len: usize,
}

impl Facts {
    pub(super) fn of(manifest: &Manifest, imagines: bool) -> Self {
        let interface = &manifest.interface;
        let known = |name: &String| {
            let camera = interface.camera.iter().find(|camera| camera.name == *name);
            let numbers = interface.state_range(name).map_or(0, |range| range.len());
            Known {
                name: c_text(name),
                picture: camera.map(|camera| [camera.shape[0], camera.shape[1]]),
                len: camera.map_or(numbers, |camera| camera.shape.iter().product()),
            }
        };
        Self {
            interface: c_text(&interface.canonical()),
            rate_hz: interface.rate_hz,
            action_numbers: interface.action_numbers(),
            imagines,
            inputs: manifest.policy.inputs.iter().map(known).collect(),
        }
    }

    pub(super) fn pictures(&self) -> impl Iterator<Item = &Known> + Clone {
        self.inputs.iter().filter(|input| input.picture.is_some())
    }

    pub(super) fn states(&self) -> impl Iterator<Item = &Known> + Clone {
        self.inputs.iter().filter(|input| input.picture.is_none())
    }

    /// The caller's pictures or states must be those that the policy reads, one by one.
    pub(super) fn check<'a>(
        what: &str,
        expected: impl Iterator<Item = &'a Known> + Clone,
        found: impl ExactSizeIterator<Item = usize>,
    ) -> Result<(), Failure> {
        let (count, known) = (found.len(), expected.clone().count());
        if count != known {
            let names: Vec<_> = expected.map(|known| known.name.to_string_lossy()).collect();
            return Err(Failure::argument(format!(
                "{count} {what}s, expected {known} ({})",
                names.join(", ")
            )));
        }
        for (known, len) in expected.zip(found) {
            if len != known.len {
                let unit = if known.picture.is_some() { "bytes" } else { "numbers" };
                let name = known.name.to_string_lossy();
                return Err(Failure::argument(format!(
                    "{what} {name} has {len} {unit}, expected {}",
                    known.len
                )));
            }
        }
        Ok(())
    }
}

/// Names and texts of an interface hold no zeros.
pub(crate) fn c_text(text: &str) -> CString {
    CString::new(text).unwrap_or_default()
}
