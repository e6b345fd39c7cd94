//! What of an observation a policy reads.

use std::ops::Range;
use std::sync::Arc;

use rcwm_models::bundle::Manifest;
use rcwm_models::interface::Interface;
use rcwm_models::wire::{Format, Observation};

use super::Policy;

/// What a policy decides on.
#[derive(Debug, Clone, Copy)]
pub struct Inputs<'a> {
    /// Upright, RGB. Of kinds with a world model the cameras side by side, pixel by pixel: [S, S, 3 C]; else one after another, [H, W, 3]
    /// each.
    pub image: &'a [u8],
    /// The measured numbers, in units; empty where the policy reads none.
    pub state: &'a [f32],
}

impl<'a, I: AsRef<[u8]> + ?Sized> From<&'a I> for Inputs<'a> {
    fn from(image: &'a I) -> Self {
        Self { image: image.as_ref(), state: &[] }
    }
}

/// Takes a policy's inputs out of observations, wherever they lie there.
#[derive(Debug)]
pub struct InputReader {
    inputs: Vec<String>,
    /// Cameras go side by side, else one after another.
    side_by_side: bool,
    /// Of the last format, and what was found in it.
    places: Option<(Arc<Format>, Places)>,
    image: Vec<u8>,
    state: Vec<f32>,
}

#[derive(Debug)]
struct Places {
    cameras: Vec<usize>,
    states: Vec<Range<usize>>,
}

impl Places {
    /// None where the robot lacks something.
    fn of(inputs: &[String], robot: &Interface) -> Option<Self> {
        let mut places = Self { cameras: Vec::new(), states: Vec::new() };
        for name in inputs {
            match robot.camera.iter().position(|camera| camera.name == *name) {
                Some(camera) => places.cameras.push(camera),
                None => places.states.push(robot.state_range(name)?),
            }
        }
        Some(places)
    }
}

impl InputReader {
    #[must_use]
    pub fn of(manifest: &Manifest) -> Self {
        let (inputs, side_by_side) = (manifest.policy.inputs.clone(), manifest.model.is_some());
        Self { inputs, side_by_side, places: None, image: Vec::new(), state: Vec::new() }
    }

    /// The inputs; none where the observation is of a robot that lacks one. Allocates nothing after the first of a robot.
    pub fn read<'a>(&'a mut self, observation: &Observation<'a>) -> Option<Inputs<'a>> {
        let format = observation.format();
        if self.places.as_ref().is_none_or(|(known, _)| !Arc::ptr_eq(known, format)) {
            let found = Places::of(&self.inputs, format.interface())?;
            self.places = Some((Arc::clone(format), found));
        }
        let (_, places) = self.places.as_ref()?;
        let cameras = places.cameras.iter().map(|camera| observation.image(*camera));
        let states = places.states.iter().map(|range| &observation.state()[range.clone()]);
        Some(laid_out(&mut self.image, &mut self.state, self.side_by_side, cameras, states))
    }

    /// Inputs of pictures and states that are given in the order of the bundle's `policy.inputs`; [`Policy::observe`] looks at their sizes.
    pub fn arrange<'a>(
        &'a mut self,
        cameras: impl ExactSizeIterator<Item = &'a [u8]> + Clone,
        states: impl Iterator<Item = &'a [f32]>,
    ) -> Inputs<'a> {
        laid_out(&mut self.image, &mut self.state, self.side_by_side, cameras, states)
    }
}

/// One camera's picture is taken where it lies; all else is put together in memory that was allocated at the first tick.
fn laid_out<'a>(
    image: &'a mut Vec<u8>,
    state: &'a mut Vec<f32>,
    side_by_side: bool,
    mut cameras: impl ExactSizeIterator<Item = &'a [u8]> + Clone,
    states: impl Iterator<Item = &'a [f32]>,
) -> Inputs<'a> {
    state.clear();
    states.for_each(|numbers| state.extend_from_slice(numbers));
    let count = cameras.len();
    if count == 1
        && let Some(only) = cameras.next()
    {
        return Inputs { image: only, state };
    }
    image.clear();
    if !side_by_side {
        cameras.for_each(|camera| image.extend_from_slice(camera));
        return Inputs { image, state };
    }
    image.resize(cameras.clone().map(<[u8]>::len).sum(), 0);
    for (at, camera) in cameras.enumerate() {
        let pixels = camera.as_chunks::<3>().0.iter();
        for (to, pixel) in image.chunks_exact_mut(3).skip(at).step_by(count).zip(pixels) {
            to.copy_from_slice(pixel);
        }
    }
    Inputs { image, state }
}

impl Policy {
    /// What about the inputs is not of the bundle's sizes, or no number.
    pub(super) fn misfit(&self, inputs: Inputs<'_>) -> Option<String> {
        let (found, expected) = (inputs.image.len(), self.image_bytes());
        if found != expected {
            return Some(format!("the image has {found} bytes, expected {expected}"));
        }
        let (found, expected) = (inputs.state.len(), self.manifest.measured_numbers());
        if found != expected {
            return Some(format!("the state has {found} numbers, expected {expected}"));
        }
        inputs.state.iter().any(|x| !x.is_finite()).then(|| "the state holds what is no number".to_owned())
    }

    /// Bytes of all cameras' images.
    #[must_use]
    pub fn image_bytes(&self) -> usize {
        self.manifest.image_bytes()
    }
}

#[cfg(test)]
mod tests {
    use rcwm_models::wire::OwnedObservation;

    use super::*;

    fn format(cameras: &[&str]) -> Arc<Format> {
        let mut interface = Interface::metaworld();
        let first = interface.camera[0].clone();
        let named =
            |name: &&str| rcwm_models::interface::Camera { name: (*name).to_owned(), ..first.clone() };
        interface.camera = cameras.iter().map(named).collect();
        Format::of(interface)
    }

    #[test]
    fn cameras_are_taken_by_name_and_laid_side_by_side() {
        let mut observation = OwnedObservation::zeroed(&format(&["top", "wrist", "front"]));
        for (camera, value) in [(0, 1), (1, 2), (2, 3)] {
            observation.edit().image(camera).fill(value);
        }
        observation.edit().state().iter_mut().enumerate().for_each(|(at, x)| *x = at as f32);
        let arranged = |names: &[&str], side_by_side| {
            let inputs = names.iter().map(|name| (*name).to_owned()).collect();
            InputReader { inputs, side_by_side, places: None, image: Vec::new(), state: Vec::new() }
        };
        let reader = |names: &[&str]| arranged(names, true);
        let mut both = reader(&["front", "finger_vel", "top"]);
        let found = both.read(&observation.view()).unwrap();
        assert_eq!(
            (found.image.len(), &found.image[..9]),
            (2 * 64 * 64 * 3, &[3, 3, 3, 1, 1, 1, 3, 3, 3][..])
        );
        assert_eq!(found.state, [16.0, 17.0]);
        assert_eq!(reader(&["wrist"]).read(&observation.view()).unwrap().image[..2], [2, 2]);
        assert!(reader(&["front", "side"]).read(&observation.view()).is_none());
        let mut one_after_another = arranged(&["front", "top"], false);
        let found = one_after_another.read(&observation.view()).unwrap().image;
        let one = 64 * 64 * 3;
        assert_eq!((found.len(), found[0], found[one - 1], found[one]), (2 * one, 3, 3, 1));
        let nothing =
            arranged(&["finger_vel"], false).read(&observation.view()).map(|found| found.image.len());
        assert_eq!(nothing, Some(0));
    }
}
