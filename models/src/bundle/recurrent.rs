//! What a policy of kind `recurrent` looks like from outside: one graph, whose inputs and outputs say by their names what they are.
//!
//! | input | type and shape |
//! | --- | --- |
//! | a camera's name, or `image` where there is one camera | u8 `[1, H, W, 3]`; or f32 of 0 to 1, `[1, H, W, 3]` or `[1, 3, H, W]` |
//! | `state` | f32 `[1, N]`: the states of `policy.inputs`, one after another, in units |
//! | `executed_action` | f32 `[1, A]`: what was executed, limits at -1 and 1; zeros where an episode begins |
//! | `state.NAME` | f32, any shape: what `next_state.NAME` gave at the last tick |
//!
//! | output | type and shape |
//! | --- | --- |
//! | `action` | f32 `[1, A]`, limits at -1 and 1 |
//! | `next_state.NAME` | as `state.NAME` |
//!
//! What enters and what leaves have different names because ONNX gives each name once.

use std::ops::Range;

use super::error::BundleError;
use super::kind::PartName;
use super::manifest::{Manifest, PartEntry};
use super::spec::{DType, TensorSpec};
use crate::interface::Camera;

/// What the name of a carried tensor begins with where it enters.
pub const CARRIED: &str = "state.";
/// What it begins with where it leaves.
pub const CARRIED_NEXT: &str = "next_state.";
/// The input that is the executed action.
pub const EXECUTED: &str = "executed_action";
/// Most numbers that are carried from tick to tick.
const CARRIED_MAX: usize = 1 << 16;

/// How a picture enters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pixels {
    /// Bytes as they came, channels last.
    Bytes,
    /// 0 to 1, channels last.
    ChannelsLast,
    /// 0 to 1, channels first.
    ChannelsFirst,
}

/// What an input of the graph is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PolicyInput {
    /// A camera, by its place among those of `policy.inputs`.
    Camera(usize, Pixels),
    /// All measured numbers, in units.
    State,
    /// The executed action, -1 to 1.
    Action,
    /// These of the carried numbers.
    Carried(Range<usize>),
}

/// What an output of the graph is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PolicyOutput {
    /// The action, -1 to 1.
    Action,
    /// These of the carried numbers, for the next tick.
    Carried(Range<usize>),
}

/// What goes into the graph and what comes out, in its order.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct PolicySignature {
    pub inputs: Vec<PolicyInput>,
    pub outputs: Vec<PolicyOutput>,
    /// The carried tensors as they enter, one after another.
    pub carried: Vec<TensorSpec>,
}

impl PolicySignature {
    /// Most inputs, and as many outputs.
    pub const BORDER_MAX: usize = 32;

    /// How many numbers are carried.
    #[must_use]
    pub fn carried_numbers(&self) -> usize {
        self.carried.iter().map(elements).sum()
    }

    /// What a graph's inputs and outputs are to a manifest's robot and `policy.inputs`.
    ///
    /// # Errors
    /// [`BundleError::Invalid`] names the input or output, what was found and what is accepted.
    pub fn of(manifest: &Manifest, entry: &PartEntry) -> Result<Self, BundleError> {
        for (role, specs) in [("inputs", &entry.inputs), ("outputs", &entry.outputs)] {
            if specs.len() > Self::BORDER_MAX {
                let (found, max) = (specs.len(), Self::BORDER_MAX);
                return invalid(format!("has {found} {role}, at most {max} are accepted"));
            }
        }
        let border = Border { manifest, cameras: manifest.cameras().collect() };
        let mut signature = Self::default();
        let mut carried = 0;
        for spec in &entry.inputs {
            let input = match spec.name.strip_prefix(CARRIED) {
                Some(name) if !name.is_empty() && spec.dtype == DType::F32 => {
                    let from = carried;
                    carried = elements(spec).saturating_add(carried);
                    signature.carried.push(spec.clone());
                    PolicyInput::Carried(from..carried)
                }
                _ => border.input(spec)?,
            };
            signature.inputs.push(input);
        }
        if carried > CARRIED_MAX {
            return invalid(format!("carries {carried} numbers, at most {CARRIED_MAX} are accepted"));
        }
        for spec in &entry.outputs {
            signature.outputs.push(border.output(spec, &signature)?);
        }
        border.check_all_there(entry, &signature)?;
        Ok(signature)
    }
}

/// The names that a policy may use.
struct Border<'a> {
    manifest: &'a Manifest,
    cameras: Vec<&'a Camera>,
}

impl Border<'_> {
    fn action(&self) -> TensorSpec {
        TensorSpec::new("action", DType::F32, &[1, self.manifest.interface.action_numbers()])
    }

    fn input(&self, spec: &TensorSpec) -> Result<PolicyInput, BundleError> {
        let measured = self.manifest.measured_numbers();
        let camera = match (self.cameras.as_slice(), spec.name.as_str()) {
            ([camera], "image") => Some((0, *camera)),
            (cameras, name) => {
                cameras.iter().position(|camera| camera.name == name).map(|at| (at, cameras[at]))
            }
        };
        match (camera, spec.name.as_str()) {
            (Some((at, camera)), _) => {
                pixels(spec, camera).map(|pixels| PolicyInput::Camera(at, pixels)).ok_or_else(|| {
                    let [height, width, channels] = camera.shape;
                    let expected = format!(
                        "u8 or f32 [1, {height}, {width}, {channels}], or f32 [1, {channels}, {height}, {width}]"
                    );
                    misfit("input", spec, &expected)
                })
            }
            (None, "state") if measured > 0 => {
                same("input", spec, &TensorSpec::new("state", DType::F32, &[1, measured]))?;
                Ok(PolicyInput::State)
            }
            (None, EXECUTED) => same("input", spec, &self.action()).map(|()| PolicyInput::Action),
            _ => Err(misfit("input", spec, &format!("one of {}", self.names()))),
        }
    }

    fn output(&self, spec: &TensorSpec, inputs: &PolicySignature) -> Result<PolicyOutput, BundleError> {
        if spec.name == "action" {
            return same("output", spec, &self.action()).map(|()| PolicyOutput::Action);
        }
        let mut from = 0;
        for carried in &inputs.carried {
            let range = from..from + elements(carried);
            from = range.end;
            if spec.name == next_name(carried) {
                same("output", spec, carried)?;
                return Ok(PolicyOutput::Carried(range));
            }
        }
        let carried: Vec<_> = inputs.carried.iter().map(next_name).collect();
        let expected =
            format!("action{}", carried.iter().map(|name| format!(", {name}")).collect::<String>());
        Err(misfit("output", spec, &format!("one of {expected}")))
    }

    /// What a robot must offer is read, and what is carried comes out again.
    fn check_all_there(&self, entry: &PartEntry, found: &PolicySignature) -> Result<(), BundleError> {
        for (at, camera) in self.cameras.iter().enumerate() {
            let reads = |input: &PolicyInput| matches!(input, PolicyInput::Camera(read, _) if *read == at);
            match found.inputs.iter().filter(|input| reads(input)).count() {
                1 => {}
                0 => return self.unread(&camera.name),
                _ => return invalid(format!("reads camera {} twice", camera.name)),
            }
        }
        if self.manifest.measured_numbers() > 0 && !found.inputs.contains(&PolicyInput::State) {
            return self.unread("state");
        }
        if self.cameras.is_empty() && !found.inputs.contains(&PolicyInput::State) {
            return invalid("reads no camera and no state: policy.inputs is empty".into());
        }
        let names: Vec<_> = found.carried.iter().map(next_name).collect();
        for name in std::iter::once("action").chain(names.iter().map(String::as_str)) {
            match entry.outputs.iter().filter(|spec| spec.name == name).count() {
                1 => {}
                0 => {
                    return invalid(format!(
                        "has no output {name:?}; its outputs are {}",
                        list(&entry.outputs)
                    ));
                }
                _ => return invalid(format!("has the output {name:?} twice")),
            }
        }
        Ok(())
    }

    fn unread(&self, name: &str) -> Result<(), BundleError> {
        invalid(format!(
            "has no input {name:?}, which policy.inputs promises; give the graph one, or leave it out of policy.inputs"
        ))
    }

    fn names(&self) -> String {
        let mut names: Vec<&str> = self.cameras.iter().map(|camera| camera.name.as_str()).collect();
        if self.cameras.len() == 1 {
            names.push("image");
        }
        names.extend((self.manifest.measured_numbers() > 0).then_some("state"));
        names.extend([EXECUTED, "state.NAME (f32)"]);
        names.join(", ")
    }
}

/// The name of a carried tensor where it leaves.
fn next_name(carried: &TensorSpec) -> String {
    format!("{CARRIED_NEXT}{}", carried.name.strip_prefix(CARRIED).unwrap_or(&carried.name))
}

fn pixels(spec: &TensorSpec, camera: &Camera) -> Option<Pixels> {
    let [height, width, channels] = camera.shape;
    let last = spec.shape == [1, height, width, channels];
    match (spec.dtype, last) {
        (DType::U8, true) => Some(Pixels::Bytes),
        (DType::F32, true) => Some(Pixels::ChannelsLast),
        (DType::F32, false) if spec.shape == [1, channels, height, width] => Some(Pixels::ChannelsFirst),
        _ => None,
    }
}

fn elements(spec: &TensorSpec) -> usize {
    spec.shape.iter().fold(1_usize, |product, dim| product.saturating_mul(*dim))
}

/// Type and shape, whatever the names.
fn same(role: &str, found: &TensorSpec, expected: &TensorSpec) -> Result<(), BundleError> {
    if (found.dtype, &found.shape) == (expected.dtype, &expected.shape) {
        return Ok(());
    }
    Err(misfit(role, found, &format!("{} {:?}", expected.dtype.as_str(), expected.shape)))
}

fn misfit(role: &str, found: &TensorSpec, expected: &str) -> BundleError {
    let TensorSpec { name, dtype, shape } = found;
    BundleError::Invalid(format!(
        "{}: {role} {name:?} is {} {shape:?}, expected {expected}",
        PartName::Policy,
        dtype.as_str()
    ))
}

fn invalid<T>(what: String) -> Result<T, BundleError> {
    Err(BundleError::Invalid(format!("{} {what}", PartName::Policy)))
}

fn list(specs: &[TensorSpec]) -> String {
    specs.iter().map(|spec| spec.name.as_str()).collect::<Vec<_>>().join(", ")
}
