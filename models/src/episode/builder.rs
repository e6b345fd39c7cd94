//! Observations, one after another, as an episode.

use std::sync::Arc;

use ndarray::{Array1, Array2, Array3, Array4};

use super::{Episode, EpisodeError, RECORDED_BYTES_MAX, STEPS_MAX};
use crate::interface::{Camera, Interface};
use crate::settings::{CAMERAS_MAX, IMAGE_SIDES, STATE_NUMBERS_MAX};
use crate::wire::{Format, Observation, ObservationFlags};

/// The side of all cameras of a robot, in pixels, and how many there are.
fn cameras_of(format: &Format) -> (usize, usize) {
    let cameras = &format.interface().camera;
    (cameras.first().map_or(0, |camera| camera.shape[0]), cameras.len())
}

/// Whether the observations of a robot make an episode that can be read again: said at the first one, not after the last.
fn check_robot(robot: &Interface) -> Result<(), EpisodeError> {
    let refuse = |found: String, expected: String| Err(EpisodeError::Robot { found, expected });
    let known =
        IMAGE_SIDES.iter().any(|side| robot.camera.iter().all(|camera| camera.shape == [*side, *side, 3]));
    if !known || !(1..=CAMERAS_MAX).contains(&robot.camera.len()) {
        let sizes: Vec<_> = robot.camera.iter().map(Camera::size).collect();
        let found = match sizes.len() {
            0 => "no camera".to_owned(),
            1 => format!("a camera of {}", sizes[0]),
            count => format!("{count} cameras of {}", sizes.join(", ")),
        };
        let [small, large] = IMAGE_SIDES;
        let expected = format!(
            "1 to {CAMERAS_MAX} cameras, all of {small} x {small} x 3 or all of {large} x {large} x 3; crop, scale or leave out \
             pictures on the robot's side"
        );
        return refuse(found, expected);
    }
    let numbers = robot.state_numbers();
    if numbers > STATE_NUMBERS_MAX {
        let expected = format!("at most {STATE_NUMBERS_MAX}; leave out states on the robot's side");
        return refuse(format!("a state of {numbers} numbers"), expected);
    }
    Ok(())
}

/// Collects observations into an [`Episode`].
#[derive(Debug)]
pub struct EpisodeBuilder {
    /// Most bytes of all observations.
    bytes_max: usize,
    /// Of the first observation, and so of all.
    format: Option<Arc<Format>>,
    image: Vec<u8>,
    action: Vec<f32>,
    reward: Vec<f32>,
    flags: Vec<ObservationFlags>,
    robot_mask: Vec<bool>,
    masks: usize,
    proprio: Vec<f32>,
}

impl Default for EpisodeBuilder {
    fn default() -> Self {
        Self::new()
    }
}

impl EpisodeBuilder {
    /// An empty episode.
    #[must_use]
    pub fn new() -> Self {
        Self::of_at_most(RECORDED_BYTES_MAX)
    }

    /// The same with another limit of all observations, in bytes.
    pub(super) fn of_at_most(bytes_max: usize) -> Self {
        Self {
            bytes_max,
            format: None,
            image: Vec::new(),
            action: Vec::new(),
            reward: Vec::new(),
            flags: Vec::new(),
            robot_mask: Vec::new(),
            masks: 0,
            proprio: Vec::new(),
        }
    }

    /// Steps so far.
    #[must_use]
    pub fn len(&self) -> usize {
        self.flags.len()
    }

    /// Whether nothing was pushed yet.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.flags.is_empty()
    }

    /// Adds an observation. The first one pushed counts as the episode's first.
    ///
    /// # Errors
    /// [`EpisodeError::Robot`] at the first one of a robot of which no episode is made; [`EpisodeError::Full`] where the episode would
    /// grow beyond [`STEPS_MAX`] or [`RECORDED_BYTES_MAX`]; [`EpisodeError::Order`] when it was already over, begins again in its middle,
    /// or the observation is not [valid](Observation::is_valid).
    pub fn push(&mut self, observation: &Observation<'_>) -> Result<(), EpisodeError> {
        let flags = ObservationFlags(observation.flags);
        let refuse = |reason: &str| {
            let (episode, step) = (observation.episode, observation.step);
            Err(EpisodeError::Order(format!("episode {episode}, step {step}: {reason}")))
        };
        if self.flags.last().is_some_and(|last| last.contains(ObservationFlags::LAST)) {
            return refuse("the episode was already over");
        }
        if !self.is_empty() && flags.contains(ObservationFlags::FIRST) {
            return refuse("a new episode began before the last one was finished");
        }
        let (steps, step_bytes) = (self.len(), observation.format().layout().observation_bytes);
        if steps == STEPS_MAX || (steps + 1) * step_bytes > self.bytes_max {
            return Err(EpisodeError::Full { episode: observation.episode, steps, step_bytes });
        }
        if self.format.is_none() {
            check_robot(observation.format().interface())?;
        }
        if !observation.is_finite() {
            return refuse("a number is not finite");
        }
        if !observation.has_executable_action() {
            return refuse("the executed action is out of its limits");
        }
        let format = self.format.get_or_insert_with(|| Arc::clone(observation.format()));
        if format != observation.format() {
            return refuse("it is of another interface than those before it");
        }
        let (side, cameras) = cameras_of(format);
        // The cameras side by side, pixel by pixel.
        for pixel in 0..side * side {
            for camera in 0..cameras {
                self.image.extend_from_slice(&observation.image(camera)[3 * pixel..3 * pixel + 3]);
            }
        }
        let from = self.action.len();
        self.action.resize(from + format.action_numbers(), 0.0);
        // Finite: see above.
        let _ = format.normaliser().from_units(observation.executed(), &mut self.action[from..]);
        self.reward.push(observation.reward);
        self.flags.push(flags);
        let masks: Option<Vec<&[u8]>> = (0..cameras).map(|camera| observation.mask(camera)).collect();
        if let Some(masks) = masks {
            for pixel in 0..side * side {
                self.robot_mask.extend(masks.iter().map(|mask| mask[pixel] > 127));
            }
            self.masks += 1;
        }
        self.proprio.extend_from_slice(observation.state());
        Ok(())
    }

    /// The episode, with masks only if every step had one; `None` if nothing was pushed. The builder is empty afterwards.
    #[must_use]
    pub fn finish(&mut self) -> Option<Episode> {
        let empty = Self::of_at_most(self.bytes_max);
        let this = std::mem::replace(self, empty);
        let steps = this.len();
        let format = this.format?;
        let bits = |flag| this.flags.iter().map(|flags| flags.contains(flag)).collect::<Array1<bool>>();
        let mut is_first = bits(ObservationFlags::FIRST);
        is_first[0] = true;
        let fits = "pushed in whole steps";
        let (side, cameras) = cameras_of(&format);
        let vectors =
            |numbers: Vec<f32>| Array2::from_shape_vec((steps, numbers.len() / steps), numbers).expect(fits);
        let mut action = vectors(this.action);
        // No action led to the first step of what was seen, also where it was joined in its middle.
        action.row_mut(0).fill(0.0);
        Some(Episode {
            is_last: bits(ObservationFlags::LAST),
            is_terminal: bits(ObservationFlags::TERMINAL),
            success: bits(ObservationFlags::SUCCESS),
            pushed: bits(ObservationFlags::PUSHED),
            is_first,
            image: Array4::from_shape_vec((steps, side, side, 3 * cameras), this.image).expect(fits),
            action,
            reward: this.reward.into(),
            robot_mask: (this.masks == steps)
                .then(|| Array3::from_shape_vec((steps, side, side * cameras), this.robot_mask).expect(fits)),
            // A robot need not measure anything.
            proprio: (!this.proprio.is_empty()).then(|| vectors(this.proprio)),
            disturbed: None,
        })
    }
}
