//! Pictures of what was published, for people to look at.

use std::fs;
use std::path::{Path, PathBuf};

use rcwm_models::IMAGE_SIDE;
use rcwm_models::files::FileError;
use rcwm_models::picture::write_png;
use rcwm_models::wire::Observation;

use crate::SimulatorError;

/// Each pixel of an observation becomes a square of this side.
const ZOOM: usize = 6;
/// Width of the black gap between picture and mask, in pixels of the observation.
const GAP: usize = 2;

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
/// [`SimulatorError::Picture`].
pub fn write(folder: &Path, task: &str, observation: &Observation<'_>) -> Result<PathBuf, SimulatorError> {
    let path = folder.join(format!("{task}-e{:04}-s{:03}.png", observation.episode, observation.step));
    let [width, height] = [width(observation), IMAGE_SIDE].map(|side| side * ZOOM);
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x / ZOOM, y / ZOOM)));
    let rgb: Vec<u8> = pixels.flat_map(|(x, y)| pixel(observation, x, y)).collect();
    write_png(&path, [width as u32, height as u32], &rgb)?;
    Ok(path)
}

/// Width of the picture, with the mask beside it where there is one.
fn width(observation: &Observation<'_>) -> usize {
    if observation.mask(0).is_some() { 2 * IMAGE_SIDE + GAP } else { IMAGE_SIDE }
}

fn pixel(observation: &Observation<'_>, x: usize, y: usize) -> [u8; 3] {
    if x < IMAGE_SIDE {
        let at = 3 * (y * IMAGE_SIDE + x);
        let image = observation.image(0);
        [image[at], image[at + 1], image[at + 2]]
    } else if x < IMAGE_SIDE + GAP {
        [0; 3]
    } else {
        [observation.mask(0).map_or(0, |mask| mask[y * IMAGE_SIDE + x - IMAGE_SIDE - GAP]); 3]
    }
}

#[cfg(test)]
mod tests {
    use rcwm_models::wire::{Format, ObservationFlags, OwnedObservation};

    use super::*;

    #[test]
    fn pictures_of_an_earlier_run_are_not_written_over() {
        let folder = tempfile::tempdir().unwrap();
        let pictures = folder.path().join("pictures");
        prepare(&pictures, "reach").unwrap();
        let first =
            write(&pictures, "reach", &OwnedObservation::zeroed(&Format::metaworld()).view()).unwrap();
        prepare(&pictures, "reach-wall").unwrap();
        let error = prepare(&pictures, "reach").unwrap_err().to_string();
        assert!(error.contains(&first.display().to_string()), "{error}");
    }

    #[test]
    fn picture_and_mask_lie_beside_each_other_the_first_row_on_top() {
        let mut observation = OwnedObservation::zeroed(&Format::metaworld());
        observation.edit().image(0)[..3].copy_from_slice(&[1, 2, 3]);
        assert_eq!(width(&observation.view()), 64);
        observation.flags = ObservationFlags::MASK_VALID.0;
        observation.edit().mask(0).unwrap()[63 * 64] = 255;
        let folder = tempfile::tempdir().unwrap();
        let path = write(folder.path(), "reach", &observation.view()).unwrap();
        let picture = image::open(path).unwrap().into_rgb8();
        assert_eq!(picture.dimensions(), (6 * 130, 6 * 64));
        for (x, y, found) in
            [(0, 0, [1, 2, 3]), (5, 5, [1, 2, 3]), (6, 0, [0; 3]), (6 * 66, 6 * 63, [255; 3])]
        {
            assert_eq!(picture.get_pixel(x, y).0, found, "{x} {y}");
        }
        assert_eq!(picture.get_pixel(6 * 66, 6 * 62).0, [0; 3]);
    }
}
