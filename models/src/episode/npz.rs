//! The archive behind an episode file. Arrays are viewed in the unpacked bytes, so that a header cannot ask for more memory than
//! the archive holds.

use std::io::{BufReader, Cursor, Read, Write};
use std::path::Path;

use ndarray::{Array1, Array4, ArrayD, ArrayViewD, Dimension, Ix1, Ix2, Ix4};
use ndarray_npy::{ViewNpyExt, WriteNpyExt};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use super::{EPISODE_BYTES_MAX, Episode, EpisodeError, STEPS_MAX};
use crate::{ACTION_LEN, IMAGE_CHANNELS, IMAGE_SIDE, PROPRIOCEPTION_LEN};

/// Key of the pictures in another look.
pub(super) const DISTURBED: &str = "disturbed";

/// Whether the archive at `path` has an array of this name.
pub(super) fn has(path: &Path, key: &str) -> Result<bool, EpisodeError> {
    let broken = |reason: String| EpisodeError::Archive { path: path.to_path_buf(), reason };
    let file = std::fs::File::open(path).map_err(|error| broken(error.to_string()))?;
    let archive = ZipArchive::new(BufReader::new(file)).map_err(|error| broken(error.to_string()))?;
    Ok(archive.index_for_name(&format!("{key}.npy")).is_some())
}

/// Reads the arrays of one archive.
struct Reader<'a> {
    path: &'a Path,
    archive: ZipArchive<Cursor<&'a [u8]>>,
}

impl Reader<'_> {
    fn unpack(&mut self, key: &'static str) -> Result<Option<Vec<u8>>, EpisodeError> {
        let broken = |reason: String| EpisodeError::Archive { path: self.path.to_path_buf(), reason };
        let entry = match self.archive.by_name(&format!("{key}.npy")) {
            Ok(entry) => entry,
            Err(zip::result::ZipError::FileNotFound) => return Ok(None),
            Err(error) => return Err(broken(format!("array {key:?}: {error}"))),
        };
        let mut bytes = Vec::new();
        entry
            .take(EPISODE_BYTES_MAX + 1)
            .read_to_end(&mut bytes)
            .map_err(|error| broken(format!("array {key:?}: {error}")))?;
        if bytes.len() as u64 > EPISODE_BYTES_MAX {
            return Err(broken(format!("array {key:?} unpacks to more than {EPISODE_BYTES_MAX} bytes")));
        }
        Ok(Some(bytes))
    }

    fn required(&mut self, key: &'static str) -> Result<Vec<u8>, EpisodeError> {
        let path = self.path.to_path_buf();
        self.unpack(key)?.ok_or(EpisodeError::Missing { path, key })
    }

    fn wrong(&self, key: &'static str, found: String, expected: String) -> EpisodeError {
        EpisodeError::Array { path: self.path.to_path_buf(), key, found, expected }
    }

    /// Floats of any of numpy's usual types; all must be finite.
    fn floats(&self, key: &'static str, bytes: &[u8]) -> Result<ArrayD<f32>, EpisodeError> {
        let array = if let Ok(view) = ArrayViewD::<f32>::view_npy(bytes) {
            view.to_owned()
        } else if let Ok(view) = ArrayViewD::<f64>::view_npy(bytes) {
            view.mapv(|x| x as f32)
        } else {
            return Err(self.wrong(key, "of another type or damaged".into(), "float32 or float64".into()));
        };
        if array.iter().any(|x| !x.is_finite()) {
            return Err(self.wrong(key, "not finite everywhere".into(), "finite numbers".into()));
        }
        Ok(array)
    }

    /// Truth values, also where they were stored as numbers: more than one half of the type's "true".
    fn bools(&self, key: &'static str, bytes: &[u8]) -> Result<ArrayD<bool>, EpisodeError> {
        if let Ok(view) = ArrayViewD::<bool>::view_npy(bytes) {
            return Ok(view.to_owned());
        }
        if let Ok(view) = ArrayViewD::<u8>::view_npy(bytes) {
            // Masks come as 0/1 and as 0/255.
            let half = view.iter().copied().max().unwrap_or(0) / 2;
            return Ok(view.mapv(|x| x > half));
        }
        Ok(self.floats(key, bytes)?.mapv(|x| x > 0.5))
    }

    fn shaped<T, D: Dimension>(
        &self,
        key: &'static str,
        array: ArrayD<T>,
        shape: &[usize],
    ) -> Result<ndarray::Array<T, D>, EpisodeError> {
        let found = format!("of shape {:?}", array.shape());
        let expected = format!("of shape {shape:?}");
        if array.shape() != shape {
            return Err(self.wrong(key, found, expected));
        }
        array.into_dimensionality().map_err(|_| self.wrong(key, found, expected))
    }

    fn flags(&mut self, key: &'static str, steps: usize) -> Result<Option<Array1<bool>>, EpisodeError> {
        let Some(bytes) = self.unpack(key)? else { return Ok(None) };
        let array = self.bools(key, &bytes)?;
        self.shaped::<_, Ix1>(key, array, &[steps]).map(Some)
    }
}

/// Parses an episode's archive; `path` is for messages.
pub(super) fn read(path: &Path, bytes: &[u8]) -> Result<Episode, EpisodeError> {
    let broken = |error| EpisodeError::Archive {
        path: path.to_path_buf(),
        reason: format!("no whole archive of arrays ({error}); remove it or record it again"),
    };
    let archive = ZipArchive::new(Cursor::new(bytes)).map_err(broken)?;
    let mut reader = Reader { path, archive };
    let bytes = reader.required("image")?;
    let image = images(&reader, "image", &bytes)?;
    let steps = image.shape()[0];
    let bytes = reader.required("action")?;
    let action = reader.floats("action", &bytes)?;
    let action = reader.shaped::<_, Ix2>("action", action, &[steps, ACTION_LEN])?;
    let bytes = reader.required("reward")?;
    let reward = reader.floats("reward", &bytes)?;
    let reward = reader.shaped::<_, Ix1>("reward", reward, &[steps])?;
    let missing = || EpisodeError::Missing { path: path.to_path_buf(), key: "is_first" };
    let is_first = reader.flags("is_first", steps)?.ok_or_else(missing)?;
    let none = || Array1::from_elem(steps, false);
    let is_terminal = reader.flags("is_terminal", steps)?.unwrap_or_else(none);
    let is_last = reader.flags("is_last", steps)?.unwrap_or_else(none);
    let success = reader.flags("success", steps)?.unwrap_or_else(none);
    let pushed = reader.flags("pushed", steps)?.unwrap_or_else(none);
    let robot_mask = match reader.unpack("robot_mask")? {
        None => None,
        Some(bytes) => {
            let mut array = reader.bools("robot_mask", &bytes)?;
            if array.ndim() == 4 && array.shape()[3] == 1 {
                array = array.index_axis_move(ndarray::Axis(3), 0);
            }
            Some(reader.shaped("robot_mask", array, &[steps, IMAGE_SIDE, IMAGE_SIDE])?)
        }
    };
    let proprio = match reader.unpack("proprio")? {
        None => None,
        Some(bytes) => {
            let array = reader.floats("proprio", &bytes)?;
            Some(reader.shaped::<_, Ix2>("proprio", array, &[steps, PROPRIOCEPTION_LEN])?)
        }
    };
    let disturbed = match reader.unpack(DISTURBED)? {
        None => None,
        Some(bytes) => {
            let array = images(&reader, DISTURBED, &bytes)?.into_dyn();
            Some(reader.shaped::<_, Ix4>(DISTURBED, array, image.shape())?)
        }
    };
    Ok(Episode {
        image,
        action,
        reward,
        is_first,
        is_last,
        is_terminal,
        success,
        pushed,
        robot_mask,
        proprio,
        disturbed,
    })
}

fn images(reader: &Reader<'_>, key: &'static str, bytes: &[u8]) -> Result<Array4<u8>, EpisodeError> {
    let expected =
        || format!("uint8 of shape [T, {IMAGE_SIDE}, {IMAGE_SIDE}, {IMAGE_CHANNELS}], T at most {STEPS_MAX}");
    let view = ArrayViewD::<u8>::view_npy(bytes)
        .map_err(|error| reader.wrong(key, format!("unreadable ({error})"), expected()))?;
    match view.shape() {
        [steps, IMAGE_SIDE, IMAGE_SIDE, IMAGE_CHANNELS] if (1..=STEPS_MAX).contains(steps) => {}
        shape => return Err(reader.wrong(key, format!("of shape {shape:?}"), expected())),
    }
    view.to_owned()
        .into_dimensionality::<Ix4>()
        .map_err(|error| reader.wrong(key, error.to_string(), expected()))
}

/// Packs an episode into a compressed archive.
pub(super) fn to_bytes(episode: &Episode) -> Result<Vec<u8>, String> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    add(&mut zip, "image", &episode.image)?;
    add(&mut zip, "action", &episode.action)?;
    add(&mut zip, "reward", &episode.reward)?;
    for (key, flags) in [
        ("is_first", &episode.is_first),
        ("is_last", &episode.is_last),
        ("is_terminal", &episode.is_terminal),
        ("success", &episode.success),
    ] {
        add(&mut zip, key, flags)?;
    }
    if episode.pushed.iter().any(|pushed| *pushed) {
        add(&mut zip, "pushed", &episode.pushed)?;
    }
    if let Some(mask) = &episode.robot_mask {
        let with_channel = mask.mapv(u8::from).insert_axis(ndarray::Axis(3));
        add(&mut zip, "robot_mask", &with_channel)?;
    }
    if let Some(proprio) = &episode.proprio {
        add(&mut zip, "proprio", proprio)?;
    }
    if let Some(disturbed) = &episode.disturbed {
        add(&mut zip, DISTURBED, disturbed)?;
    }
    Ok(zip.finish().map_err(|error| error.to_string())?.into_inner())
}

fn add<T, D>(
    zip: &mut ZipWriter<Cursor<Vec<u8>>>,
    key: &str,
    array: &ndarray::Array<T, D>,
) -> Result<(), String>
where
    T: ndarray_npy::WritableElement,
    D: Dimension,
{
    let mut bytes = Vec::new();
    array.write_npy(&mut bytes).map_err(|error| error.to_string())?;
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Deflated);
    zip.start_file(format!("{key}.npy"), options).map_err(|error| error.to_string())?;
    zip.write_all(&bytes).map_err(|error| error.to_string())
}
