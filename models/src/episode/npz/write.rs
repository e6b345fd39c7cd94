//! Writing an archive that can be read again.

use std::io::{Cursor, Write};
use std::path::Path;

use ndarray::{Array4, Axis, Dimension};
use ndarray_npy::WriteNpyExt;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use super::{
    Cameras, DISTURBED, DISTURBED_ALL, EPISODE_BYTES_MAX, Episode, EpisodeError, IMAGE, MASK, PROPRIO, Reader,
};
use crate::files::FileError;
use crate::settings::CAMERAS_MAX;

/// Packs an episode into a compressed archive; `path` is for messages.
pub(in super::super) fn to_bytes(episode: &Episode, path: &Path) -> Result<Vec<u8>, EpisodeError> {
    let bytes = pack(episode).map_err(|reason| EpisodeError::Archive { path: path.to_path_buf(), reason })?;
    let found = bytes.len() as u64;
    if found > EPISODE_BYTES_MAX {
        return Err(FileError::TooLarge { path: path.to_path_buf(), found, limit: EPISODE_BYTES_MAX }.into());
    }
    // By the reader itself: what it refuses is found here, and not when it is too late to record it again.
    let mut reader = Reader::open(path, &bytes)?;
    let sizes = reader.check_shapes()?;
    let channels = episode.image.len_of(Axis(3));
    if channels != 3 * sizes.cameras {
        let expected = format!("3 for each camera, of which there are at most {CAMERAS_MAX}");
        return Err(reader.wrong(IMAGE[0], format!("of {channels} channels"), expected));
    }
    if let Some(other) = episode.disturbed.as_ref().filter(|other| other.shape() != episode.image.shape()) {
        let found = format!("of shape {:?}", other.shape());
        return Err(reader.wrong(DISTURBED, found, format!("{:?}, as the images", episode.image.shape())));
    }
    reader.check_finite("action", episode.action.iter())?;
    reader.check_finite("reward", episode.reward.iter())?;
    reader.check_finite(PROPRIO, episode.proprio.iter().flatten())?;
    reader.check_actions(episode)?;
    Ok(bytes)
}

fn pack(episode: &Episode) -> Result<Vec<u8>, String> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    add_images(&mut zip, &IMAGE, &episode.image)?;
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
        let cameras = episode.image.len_of(Axis(3)) / 3;
        for (camera, key) in MASK.iter().enumerate().take(cameras) {
            let pixels = mask.slice(ndarray::s![.., .., camera..;cameras]);
            add(&mut zip, key, &pixels.mapv(u8::from).insert_axis(Axis(3)))?;
        }
    }
    if let Some(proprio) = episode.proprio.as_ref().filter(|proprio| proprio.ncols() > 0) {
        add(&mut zip, PROPRIO, proprio)?;
    }
    if let Some(disturbed) = &episode.disturbed {
        add_images(&mut zip, &DISTURBED_ALL, disturbed)?;
    }
    Ok(zip.finish().map_err(|error| error.to_string())?.into_inner())
}

/// The images [T, S, S, 3 C], an array a camera.
fn add_images(
    zip: &mut ZipWriter<Cursor<Vec<u8>>>,
    keys: &Cameras,
    images: &Array4<u8>,
) -> Result<(), String> {
    let cameras = images.axis_chunks_iter(Axis(3), 3);
    keys.iter().zip(cameras).try_for_each(|(key, images)| add(zip, key, &images))
}

fn add<S, D>(
    zip: &mut ZipWriter<Cursor<Vec<u8>>>,
    key: &str,
    array: &ndarray::ArrayBase<S, D>,
) -> Result<(), String>
where
    S: ndarray::Data,
    S::Elem: ndarray_npy::WritableElement,
    D: Dimension,
{
    let mut bytes = Vec::new();
    array.write_npy(&mut bytes).map_err(|error| error.to_string())?;
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Deflated);
    zip.start_file(format!("{key}.npy"), options).map_err(|error| error.to_string())?;
    zip.write_all(&bytes).map_err(|error| error.to_string())
}
