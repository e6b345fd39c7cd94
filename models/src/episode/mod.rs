//! Recorded episodes as Dreamer's `.npz` files, so that data moves both ways between this project and DreamerV3 code.
//!
//! | key | type | shape | meaning |
//! | --- | --- | --- | --- |
//! | `image` | u8 | [T, S, S, 3] | upright, RGB; S is 64 or 128 |
//! | `image_2` to `image_4` (optional) | u8 | [T, S, S, 3] | the same moments through further cameras |
//! | `action` | f32 | [T, a] | the action that LED TO `image[t]`, in [-1, 1] from limit to limit; zeros at the first |
//! | `reward` | f32 | [T] | of that transition |
//! | `is_first`, `is_last`, `is_terminal`, `success` | bool | [T] | |
//! | `robot_mask` (optional) | u8 | [T, S, S, 1] | 1 where the robot is, else 0 |
//! | `proprio` (optional) | f32 | [T, p] | the robot's measured state: joint positions, velocities and the like; left out where p is 0 |
//! | `disturbed` (optional) | u8 | [T, S, S, 3] | the same moments in another look |
//!
//! `robot_mask` and `disturbed` have a `_2` to `_4` of their own, for every further camera or for none. In memory the cameras are side by
//! side, pixel by pixel: an [`Episode`]'s images have 3 C channels.
//!
//! These are written. Read is what numpy reads and others write: numbers of any size and byte order, Fortran order, axes of length 1
//! more or less (`[T, 1]` for `[T]`), masks as 0 and 255 or as numbers of objects. An action that stands at the image it was
//! chosen on, as danijar/dreamerv3 stores it, is refused.

mod builder;
mod npy;
mod npz;

use std::path::{Path, PathBuf};

use ndarray::{Array1, Array2, Array3, Array4, Axis, Slice};

use crate::files::{FileError, read_capped, write_atomic, write_new};
use crate::settings::ModelSettings;

pub use builder::EpisodeBuilder;

/// Longest episode accepted, in steps.
pub const STEPS_MAX: usize = 100_000;
/// Largest episode file accepted, in bytes; also most bytes of all its images.
pub const EPISODE_BYTES_MAX: u64 = 1 << 30;
/// Most bytes that an episode is recorded to: the file is still accepted where nothing in it can be packed.
pub const RECORDED_BYTES_MAX: usize = 1_000_000_000;

/// One episode, or the part of one that was seen.
#[derive(Debug, Clone, PartialEq)]
pub struct Episode {
    /// [T, S, S, 3 C]: red, green and blue of the first camera, then of the next.
    pub image: Array4<u8>,
    /// [T, action]: the action that led to the image of the same step.
    pub action: Array2<f32>,
    /// [T].
    pub reward: Array1<f32>,
    /// [T].
    pub is_first: Array1<bool>,
    /// [T].
    pub is_last: Array1<bool>,
    /// [T].
    pub is_terminal: Array1<bool>,
    /// [T].
    pub success: Array1<bool>,
    /// [T], true where the action was a push off course and no example of what to do.
    pub pushed: Array1<bool>,
    /// [T, S, S * C], true where the robot is; a pixel's cameras are side by side.
    pub robot_mask: Option<Array3<bool>>,
    /// [T, state]: what the robot measured of itself.
    pub proprio: Option<Array2<f32>>,
    /// [T, S, S, 3 C]: what `image` shows, in another look.
    pub disturbed: Option<Array4<u8>>,
}

/// Why an episode could not be read, made or written.
#[derive(Debug, thiserror::Error)]
pub enum EpisodeError {
    /// The file could not be read or written.
    #[error("episode: {0}")]
    File(#[from] FileError),
    /// Not an archive of arrays, or a damaged one.
    #[error("episode {path}: {reason}")]
    Archive { path: PathBuf, reason: String },
    /// An array is missing.
    #[error(
        "episode {path}: array {key:?} is missing; expected Dreamer's keys (image, action, reward, is_first, ...)"
    )]
    Missing {
        path: PathBuf,
        /// The array's name.
        key: &'static str,
    },
    /// An array has another type or shape than it must have.
    #[error("episode {path}: array {key:?} is {found}, expected {expected}")]
    Array {
        path: PathBuf,
        /// The array's name.
        key: &'static str,
        found: String,
        /// What it must be.
        expected: String,
    },
    /// An observation that does not continue the episode.
    #[error("recording: {0}")]
    Order(String),
    /// A robot whose observations make no episode that could be read again.
    #[error("recording: the robot has {found}, an episode holds {expected}")]
    Robot {
        found: String,
        /// What it must be.
        expected: String,
    },
    /// The episode is as long as one may be.
    #[error(
        "recording: episode {episode} is full after {steps} steps of {step_bytes} bytes, at most {STEPS_MAX} steps and \
         {RECORDED_BYTES_MAX} bytes are kept; end episodes sooner, or record fewer or smaller cameras"
    )]
    Full {
        /// Its number on the wire.
        episode: u64,
        steps: usize,
        step_bytes: usize,
    },
}

/// What an episode has in another size than a model needs it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Misfit {
    /// The array's name.
    pub key: &'static str,
    pub found: String,
    /// What the model needs.
    pub expected: String,
}

impl Episode {
    /// [`Episode::blank_of`] the paper's robot: one camera of 64 x 64, four numbers.
    #[must_use]
    pub fn blank(steps: usize) -> Self {
        Self::blank_of(steps, 64, 1, 4)
    }

    /// `steps` black pictures with zero actions and rewards, no masks; the first step is marked as such.
    #[must_use]
    pub fn blank_of(steps: usize, side: usize, cameras: usize, action: usize) -> Self {
        let no = Array1::from_elem(steps, false);
        Self {
            image: Array4::zeros((steps, side, side, 3 * cameras)),
            action: Array2::zeros((steps, action)),
            reward: Array1::zeros(steps),
            is_first: (0..steps).map(|step| step == 0).collect(),
            is_last: no.clone(),
            is_terminal: no.clone(),
            success: no.clone(),
            pushed: no,
            robot_mask: None,
            proprio: None,
            disturbed: None,
        }
    }

    /// Steps, `T`.
    #[must_use]
    pub fn len(&self) -> usize {
        self.reward.len()
    }

    /// Whether it holds no step.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.reward.is_empty()
    }

    /// `S`: the images' side.
    #[must_use]
    pub fn side(&self) -> usize {
        self.image.len_of(Axis(1))
    }

    /// What does not fit a model of these sizes, if anything. A state that the model does not look at may be anything.
    #[must_use]
    pub fn misfit(&self, model: &ModelSettings) -> Option<Misfit> {
        let images = |side: usize, channels: usize| {
            let cameras = channels / 3;
            format!("{side} x {side} of {cameras} {}", if cameras == 1 { "camera" } else { "cameras" })
        };
        let (found, needed) = (
            images(self.side(), self.image.len_of(Axis(3))),
            images(model.image_side, model.image_channels()),
        );
        if found != needed {
            return Some(Misfit { key: "image", found, expected: needed });
        }
        let numbers = |count: usize| format!("of {count} numbers");
        let action = self.action.ncols();
        if action != model.action {
            return Some(Misfit { key: "action", found: numbers(action), expected: numbers(model.action) });
        }
        let state = self.proprio.as_ref().map(Array2::ncols);
        (model.state > 0 && state != Some(model.state)).then(|| Misfit {
            key: "proprio",
            found: state.map_or_else(|| "missing".to_owned(), numbers),
            expected: numbers(model.state),
        })
    }

    /// Sum of the rewards.
    #[must_use]
    pub fn total_reward(&self) -> f64 {
        self.reward.iter().map(|reward| f64::from(*reward)).sum()
    }

    /// Whether the task was solved at any step.
    #[must_use]
    pub fn succeeded(&self) -> bool {
        self.success.iter().any(|success| *success)
    }

    /// The first `steps` steps, or all if there are no more.
    #[must_use]
    pub fn shortened(&self, steps: usize) -> Self {
        let range = Slice::from(..steps.min(self.len()));
        Self {
            image: self.image.slice_axis(Axis(0), range).to_owned(),
            action: self.action.slice_axis(Axis(0), range).to_owned(),
            reward: self.reward.slice_axis(Axis(0), range).to_owned(),
            is_first: self.is_first.slice_axis(Axis(0), range).to_owned(),
            is_last: self.is_last.slice_axis(Axis(0), range).to_owned(),
            is_terminal: self.is_terminal.slice_axis(Axis(0), range).to_owned(),
            success: self.success.slice_axis(Axis(0), range).to_owned(),
            pushed: self.pushed.slice_axis(Axis(0), range).to_owned(),
            robot_mask: self.robot_mask.as_ref().map(|mask| mask.slice_axis(Axis(0), range).to_owned()),
            proprio: self.proprio.as_ref().map(|proprio| proprio.slice_axis(Axis(0), range).to_owned()),
            disturbed: self.disturbed.as_ref().map(|images| images.slice_axis(Axis(0), range).to_owned()),
        }
    }

    /// Reads a `.npz` file; every array's size is checked before it is unpacked.
    pub fn read(path: &Path) -> Result<Self, EpisodeError> {
        let bytes = read_capped(path, EPISODE_BYTES_MAX)?;
        npz::read(path, &bytes)
    }

    /// The same, but never over a file that is there.
    ///
    /// # Errors
    /// [`FileError::Exists`] or see [`EpisodeError`].
    pub fn write_new(&self, path: &Path) -> Result<(), EpisodeError> {
        Ok(write_new(path, &self.to_bytes(path)?)?)
    }

    /// The file that [`Episode::write`] writes; `path` is for messages. What [`Episode::read`] would refuse is refused here.
    ///
    /// # Errors
    /// [`EpisodeError::Archive`], [`EpisodeError::Array`], or [`FileError::TooLarge`].
    pub fn to_bytes(&self, path: &Path) -> Result<Vec<u8>, EpisodeError> {
        npz::to_bytes(self, path)
    }

    /// Whether a `.npz` file has disturbed pictures; the pictures themselves are not read.
    pub fn is_disturbed(path: &Path) -> Result<bool, EpisodeError> {
        npz::has(path, npz::DISTURBED)
    }

    /// Writes a compressed `.npz` file atomically.
    pub fn write(&self, path: &Path) -> Result<(), EpisodeError> {
        Ok(write_atomic(path, &self.to_bytes(path)?)?)
    }
}

/// Above which value a pixel of a mask is the robot, by the largest one in all masks of an episode. Grey ones (255 or 65535 for white)
/// are cut at half of white; small numbers are those of objects, of which every one counts.
#[must_use]
pub fn robot_above(largest: f64) -> f64 {
    match largest {
        x if x <= 127.0 => 0.0,
        x if x <= 255.0 => 127.0,
        x if x <= 32767.0 => 0.0,
        _ => 32767.0,
    }
}

#[cfg(test)]
mod tests;
