//! Pictures of what was published, for people to look at.

use std::fs;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use image::imageops::{FilterType, resize};
use image::{ImageFormat, Rgb, RgbImage};
use rcwm_models::IMAGE_SIDE;
use rcwm_models::files::{FileError, write_atomic};
use rcwm_models::wire::{Observation, ObservationFlags};

use crate::SimulatorError;

/// Each pixel of an observation becomes a square of this side.
const ZOOM: u32 = 6;
/// Width of the black gap between picture and mask, in pixels of the observation.
const GAP: u32 = 2;

/// Makes the folder, and makes sure that it holds no picture of an earlier run of this task, whose episodes may have the same numbers.
///
/// # Errors
/// [`SimulatorError::File`].
pub fn prepare(folder: &Path, task: &str) -> Result<(), SimulatorError> {
    let failed = |source| FileError::Io { path: folder.to_path_buf(), source };
    let made = fs::create_dir_all(folder).and_then(|()| fs::read_dir(folder)?.collect::<Result<Vec<_>, _>>());
    let begin = format!("{task}-e");
    let is_picture = |name: &str| name.starts_with(&begin) && name.ends_with(".png");
    let found = made.map_err(failed)?;
    match found.iter().find(|entry| entry.file_name().to_str().is_some_and(is_picture)) {
        Some(picture) => Err(FileError::Exists { path: picture.path() }.into()),
        None => Ok(()),
    }
}

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
    fn pictures_of_an_earlier_run_are_not_written_over() {
        let folder = tempfile::tempdir().unwrap();
        let pictures = folder.path().join("pictures");
        prepare(&pictures, "reach").unwrap();
        let first = write(&pictures, "reach", &Observation::zeroed()).unwrap();
        prepare(&pictures, "reach-wall").unwrap();
        let error = prepare(&pictures, "reach").unwrap_err().to_string();
        assert!(error.contains(&first.display().to_string()), "{error}");
    }

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
