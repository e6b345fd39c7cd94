//! Pictures of what was published, for people to look at.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use image::imageops::{FilterType, resize};
use image::{ImageFormat, Rgb, RgbImage};
use rcwm_models::IMAGE_SIDE;
use rcwm_models::files::write_atomic;
use rcwm_models::wire::{Observation, ObservationFlags};

use crate::SimulatorError;

/// Each pixel of an observation becomes a square of this side.
const ZOOM: u32 = 6;
/// Width of the black gap between picture and mask, in pixels of the observation.
const GAP: u32 = 2;

/// Writes an observation as `DIR/<task>-e<episode>-s<step>.png`, with its mask beside it where there is one.
///
/// # Errors
/// [`SimulatorError::Picture`], [`SimulatorError::File`].
pub fn write(folder: &Path, task: &str, observation: &Observation) -> Result<PathBuf, SimulatorError> {
    let picture = beside(observation);
    let picture = resize(&picture, picture.width() * ZOOM, picture.height() * ZOOM, FilterType::Nearest);
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, ImageFormat::Png)?;
    let path = folder.join(format!("{task}-e{:04}-s{:03}.png", observation.episode, observation.step));
    write_atomic(&path, bytes.get_ref())?;
    Ok(path)
}

fn beside(observation: &Observation) -> RgbImage {
    let size = IMAGE_SIDE as u32;
    let with_mask = observation.is(ObservationFlags::MASK_VALID);
    let width = if with_mask { 2 * size + GAP } else { size };
    RgbImage::from_fn(width, size, |x, y| {
        if x < size {
            let at = 3 * (y * size + x) as usize;
            Rgb([observation.image[at], observation.image[at + 1], observation.image[at + 2]])
        } else if x < size + GAP {
            Rgb([0; 3])
        } else {
            Rgb([observation.robot_mask[(y * size + x - size - GAP) as usize]; 3])
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn picture_and_mask_lie_beside_each_other_the_first_row_on_top() {
        let mut observation = Observation::zeroed();
        observation.image[..3].copy_from_slice(&[1, 2, 3]);
        assert_eq!(beside(&observation).dimensions(), (64, 64));
        observation.flags = ObservationFlags::MASK_VALID.0;
        observation.robot_mask[63 * 64] = 255;
        let picture = beside(&observation);
        assert_eq!(picture.dimensions(), (130, 64));
        assert_eq!(picture.get_pixel(0, 0), &Rgb([1, 2, 3]));
        assert_eq!(picture.get_pixel(66, 63), &Rgb([255; 3]));
        assert_eq!(picture.get_pixel(66, 62), &Rgb([0; 3]));
    }
}
