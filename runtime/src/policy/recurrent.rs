//! A policy in one graph, with carried state or without: what goes in is given the graph's own form, and nothing is imagined.

use std::ops::Range;

use rcwm_models::bundle::{Bundle, PartName, Pixels, PolicyInput, PolicyOutput, PolicySignature};
use rcwm_models::wire::ActionValues;

use super::buffers::finite;
use super::tick::{Tick, Work};
use super::{Inputs, PolicyError};
use crate::engine::{self, EngineError, EngineSettings, Input, Output, Part};

/// The policy's graph, and memory for what goes in and comes out.
pub struct Graph {
    part: Box<dyn Part>,
    signature: PolicySignature,
    cameras: Vec<Camera>,
    /// In the order of the signature.
    outputs: Vec<Vec<f32>>,
}

/// A camera as the graph wants it.
struct Camera {
    /// Where its bytes lie in [`Inputs::image`].
    bytes: Range<usize>,
    channels: usize,
    /// For graphs that want floats.
    floats: Vec<f32>,
}

impl Graph {
    /// Of a bundle of kind `recurrent`.
    ///
    /// # Errors
    /// [`PolicyError::Bundle`] or [`PolicyError::Engine`].
    pub fn load(bundle: &Bundle, settings: EngineSettings) -> Result<Self, PolicyError> {
        let (manifest, part) = (&bundle.manifest, PartName::Policy);
        let entry = manifest.part(part).ok_or(EngineError::NoPart { part })?;
        let signature = PolicySignature::of(manifest, entry)?;
        let mut at = 0;
        let mut cameras = Vec::new();
        for (index, camera) in manifest.cameras().enumerate() {
            let len: usize = camera.shape.iter().product();
            let wants_floats = |input: &PolicyInput| matches!(input, PolicyInput::Camera(of, pixels) if *of == index && *pixels != Pixels::Bytes);
            let floats = if signature.inputs.iter().any(wants_floats) { len } else { 0 };
            let [.., channels] = camera.shape;
            cameras.push(Camera { bytes: at..at + len, channels, floats: vec![0.0; floats] });
            at += len;
        }
        let len = |output: &PolicyOutput| match output {
            PolicyOutput::Action => manifest.interface.action_numbers(),
            PolicyOutput::Carried(range) => range.len(),
        };
        let outputs = signature.outputs.iter().map(|output| vec![0.0; len(output)]).collect();
        Ok(Self { part: engine::load(bundle, part, settings)?, signature, cameras, outputs })
    }

    /// Runs the graph. `action` is -1 to 1, `carried` what the last tick left.
    ///
    /// # Errors
    /// [`EngineError::Tensor`] or [`EngineError::Run`].
    pub fn run(&mut self, inputs: Inputs<'_>, action: &[f32], carried: &[f32]) -> Result<(), EngineError> {
        let Self { part, signature, cameras, outputs } = self;
        for input in &signature.inputs {
            if let PolicyInput::Camera(index, pixels) = input {
                cameras[*index].fill(*pixels, inputs.image);
            }
        }
        let mut fed = [Input::F32(&[]); PolicySignature::BORDER_MAX];
        for (place, input) in fed.iter_mut().zip(&signature.inputs) {
            *place = match input {
                PolicyInput::Camera(index, Pixels::Bytes) => {
                    Input::U8(&inputs.image[cameras[*index].bytes.clone()])
                }
                PolicyInput::Camera(index, _) => Input::F32(&cameras[*index].floats),
                PolicyInput::State => Input::F32(inputs.state),
                PolicyInput::Action => Input::F32(action),
                PolicyInput::Carried(range) => Input::F32(&carried[range.clone()]),
            };
        }
        let count = outputs.len();
        let mut places = outputs.iter_mut();
        let mut places: [Output<'_>; PolicySignature::BORDER_MAX] =
            std::array::from_fn(|_| Output::F32(places.next().map_or(&mut [], |place| place)));
        part.run(&fed[..signature.inputs.len()], &mut places[..count])
    }

    /// What came out last, in the order of the graph.
    pub fn outputs(&self) -> &[Vec<f32>] {
        &self.outputs
    }
}

impl Camera {
    fn fill(&mut self, pixels: Pixels, image: &[u8]) {
        let (bytes, channels) = (&image[self.bytes.clone()], self.channels);
        let unit = |byte: &u8| f32::from(*byte) / 255.0;
        match pixels {
            Pixels::Bytes => {}
            Pixels::ChannelsLast => {
                self.floats.iter_mut().zip(bytes).for_each(|(to, byte)| *to = unit(byte));
            }
            Pixels::ChannelsFirst => {
                let plane = bytes.len() / channels;
                for (channel, to) in self.floats.chunks_exact_mut(plane).enumerate() {
                    let from = bytes.iter().skip(channel).step_by(channels);
                    to.iter_mut().zip(from).for_each(|(to, byte)| *to = unit(byte));
                }
            }
        }
    }
}

/// Why there are no 16-bit weights.
pub(crate) fn no_half_weights() -> EngineError {
    let what = "--half-weights with a bundle of kind recurrent".to_owned();
    EngineError::Choice { what, instead: "its graph runs as it is; leave it out".to_owned() }
}

/// The tick of kind `recurrent`.
pub(super) struct Recurrent {
    graph: Graph,
    action: ActionValues,
    /// Black pictures, and zeros measured and carried: what the caches are warmed with.
    nothing: (Vec<u8>, Vec<f32>, Vec<f32>),
}

impl Recurrent {
    pub(super) fn load(bundle: &Bundle, settings: EngineSettings) -> Result<Self, PolicyError> {
        if settings.has_half_weights() {
            return Err(no_half_weights().into());
        }
        let manifest = &bundle.manifest;
        let action = ActionValues::zeros(manifest.interface.action_numbers());
        let graph = Graph::load(bundle, settings)?;
        let carried = vec![0.0; graph.signature.carried_numbers()];
        let nothing = (vec![0; manifest.image_bytes()], vec![0.0; manifest.measured_numbers()], carried);
        Ok(Self { graph, action, nothing })
    }
}

impl Tick for Recurrent {
    /// Remembers the action: the graph waits for what is observed.
    fn work_ahead(&mut self, action: &ActionValues, _: &mut Work<'_>) -> Result<(), PolicyError> {
        self.action = *action;
        Ok(())
    }

    fn observe(&mut self, inputs: Inputs<'_>, work: &mut Work<'_>) -> Result<(), PolicyError> {
        let Self { graph, action, .. } = self;
        let Work { state, buffers, clock, .. } = work;
        graph.run(inputs, action, &state.branches[0].h).map_err(|error| match error {
            EngineError::NotFinite { part } => PolicyError::NotFinite { part, output: "a value inside" },
            error => error.into(),
        })?;
        for (output, found) in graph.signature.outputs.iter().zip(&graph.outputs) {
            match output {
                PolicyOutput::Action => buffers.mean.copy_from_slice(found),
                PolicyOutput::Carried(range) => {
                    buffers.branches[0].h_next[range.clone()].copy_from_slice(found);
                }
            }
        }
        clock.ended(PartName::Policy);
        finite(PartName::Policy, "action", &buffers.mean)?;
        finite(PartName::Policy, "next_state", &buffers.branches[0].h_next)
    }

    /// Never asked: [`super::Policy::imagine`] holds the last action where there is no world model.
    fn imagine(&mut self, _: &mut Work<'_>) -> Result<(), PolicyError> {
        Err(PolicyError::Observation("a policy without a world model imagines nothing".into()))
    }

    fn warm_caches(&mut self) {
        let Self { graph, action, nothing: (image, state, carried) } = self;
        // What comes out, an error included, is read by nobody.
        let _ = graph.run(Inputs { image, state }, action, carried);
    }
}
