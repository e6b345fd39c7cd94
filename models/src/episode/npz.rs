//! The archive behind an episode file. Shapes are checked before numbers are unpacked, so that a header cannot ask for more memory
//! than an episode may take.

mod write;

use std::io::{BufReader, Cursor, Read};
use std::path::Path;

use ndarray::{Array1, Array3, Array4, ArrayD, Axis, Dimension, Ix1, Ix2, Ix3, Ix4, concatenate, stack};
use zip::ZipArchive;

use super::npy::{Array, Header};
use super::{EPISODE_BYTES_MAX, Episode, EpisodeError, STEPS_MAX, robot_above};
use crate::files::open_capped;
pub(super) use write::to_bytes;

use crate::settings::{ACTION_NUMBERS_MAX, CAMERAS_MAX, IMAGE_SIDES, STATE_NUMBERS_MAX};

/// An array of each camera.
type Cameras = [&'static str; CAMERAS_MAX];
const IMAGE: Cameras = ["image", "image_2", "image_3", "image_4"];
const MASK: Cameras = ["robot_mask", "robot_mask_2", "robot_mask_3", "robot_mask_4"];
const DISTURBED_ALL: Cameras = ["disturbed", "disturbed_2", "disturbed_3", "disturbed_4"];
/// Key of the pictures in another look.
pub(super) const DISTURBED: &str = DISTURBED_ALL[0];

const PROPRIO: &str = "proprio";

/// Sizes that an archive has chosen.
#[derive(Debug, Clone, Copy)]
struct Sizes {
    side: usize,
    cameras: usize,
    action: usize,
    state: Option<usize>,
}

/// Whether the archive at `path` has an array of this name.
pub(super) fn has(path: &Path, key: &str) -> Result<bool, EpisodeError> {
    let broken = |reason: String| EpisodeError::Archive { path: path.to_path_buf(), reason };
    let (file, _) = open_capped(path, EPISODE_BYTES_MAX)?;
    let archive = ZipArchive::new(BufReader::new(file)).map_err(|error| broken(error.to_string()))?;
    Ok(archive.index_for_name(&format!("{key}.npy")).is_some())
}

/// Reads the arrays of one archive.
struct Reader<'a> {
    path: &'a Path,
    archive: ZipArchive<Cursor<&'a [u8]>>,
    /// `T`, once the images have told it.
    steps: Option<usize>,
}

impl<'a> Reader<'a> {
    fn open(path: &'a Path, bytes: &'a [u8]) -> Result<Self, EpisodeError> {
        let broken = |error| EpisodeError::Archive {
            path: path.to_path_buf(),
            reason: format!("no whole archive of arrays ({error}); remove it or record it again"),
        };
        let archive = ZipArchive::new(Cursor::new(bytes)).map_err(broken)?;
        Ok(Self { path, archive, steps: None })
    }
}

impl Reader<'_> {
    fn wrong(&self, key: &'static str, found: String, expected: String) -> EpisodeError {
        EpisodeError::Array { path: self.path.to_path_buf(), key, found, expected }
    }

    fn missing(&self, key: &'static str) -> EpisodeError {
        EpisodeError::Missing { path: self.path.to_path_buf(), key }
    }

    /// The array of this name, if it is there, of shape `[T, axes]`; axes of length 1 may be left out or be more.
    fn array(&mut self, key: &'static str, axes: &[usize]) -> Result<Option<Array>, EpisodeError> {
        self.entry(key, axes, |header, mut from| header.read_numbers(&mut from))
    }

    /// Its shape, without unpacking its numbers.
    fn shape(&mut self, key: &'static str, axes: &[usize]) -> Result<Option<Vec<usize>>, EpisodeError> {
        self.entry(key, axes, |header, _| Ok(header.shape))
    }

    /// What `read` makes of an array whose header fits.
    fn entry<T>(
        &mut self,
        key: &'static str,
        axes: &[usize],
        read: impl FnOnce(Header, &mut dyn Read) -> Result<T, String>,
    ) -> Result<Option<T>, EpisodeError> {
        let mut entry = match self.archive.by_name(&format!("{key}.npy")) {
            Ok(entry) => entry,
            Err(zip::result::ZipError::FileNotFound) => return Ok(None),
            Err(error) => {
                let reason = format!("array {key:?}: {error}");
                return Err(EpisodeError::Archive { path: self.path.to_path_buf(), reason });
            }
        };
        let steps = self.steps;
        let found = Header::read(&mut entry).and_then(|mut header| {
            header.shape = fitted(&header.shape, steps, axes).ok_or_else(|| {
                format!("of shape {:?}{}", header.shape, channels_first(&header.shape, axes))
            })?;
            read(header, &mut entry)
        });
        drop(entry);
        let (steps, most) = match steps {
            Some(steps) => (steps.to_string(), String::new()),
            None => ("T".to_owned(), format!(", T from 1 to {STEPS_MAX}")),
        };
        let sizes: Vec<_> = std::iter::once(steps).chain(axes.iter().map(usize::to_string)).collect();
        let expected = format!("numbers of shape [{}]{most}", sizes.join(", "));
        found.map(Some).map_err(|found| self.wrong(key, found, expected))
    }

    /// The shape of an array as it is stored; none where it is not there or unreadable.
    fn stored_shape(&mut self, key: &str) -> Option<Vec<usize>> {
        let mut entry = self.archive.by_name(&format!("{key}.npy")).ok()?;
        Some(Header::read(&mut entry).ok()?.shape)
    }

    /// Numbers of a vector a step, of at most `most`; none where there is no such array.
    fn width(&mut self, key: &'static str, most: usize) -> Result<Option<usize>, EpisodeError> {
        let Some(shape) = self.stored_shape(key) else { return Ok(None) };
        let rest: Vec<usize> = shape.iter().skip(1).copied().filter(|size| *size != 1).collect();
        match *rest.as_slice() {
            [] => Ok(Some(1)),
            [width] if (1..=most).contains(&width) => Ok(Some(width)),
            // A robot that measures nothing, as others may write it.
            [0] if key == PROPRIO => Ok(Some(0)),
            _ => {
                let expected = format!("numbers of shape [T, n], n from 1 to {most}");
                Err(self.wrong(key, format!("of shape {shape:?}"), expected))
            }
        }
    }

    /// The sizes that the headers tell.
    fn sizes(&mut self) -> Result<Sizes, EpisodeError> {
        let side = match self.stored_shape("image") {
            Some(shape) => {
                let side = shape.iter().skip(1).copied().find(|side| IMAGE_SIDES.contains(side));
                side.ok_or_else(|| {
                    let [small, large] = IMAGE_SIDES;
                    let expected = format!("numbers of shape [T, S, S, 3], S {small} or {large}");
                    self.wrong("image", format!("of shape {shape:?}"), expected)
                })?
            }
            // What is missing, or damaged, is told with what is expected of all arrays.
            None => IMAGE_SIDES[0],
        };
        let further =
            IMAGE[1..].iter().take_while(|key| self.archive.index_for_name(&format!("{key}.npy")).is_some());
        Ok(Sizes {
            side,
            cameras: 1 + further.count(),
            action: self.width("action", ACTION_NUMBERS_MAX)?.unwrap_or(1),
            state: self.width(PROPRIO, STATE_NUMBERS_MAX)?,
        })
    }

    /// Whether every array that is read is there and fits the images, before any of them is unpacked.
    fn check_shapes(&mut self) -> Result<Sizes, EpisodeError> {
        let sizes = self.sizes()?;
        let image = [sizes.side, sizes.side, 3];
        let shape = self.shape("image", &image)?.ok_or_else(|| self.missing("image"))?;
        self.steps = shape.first().copied();
        let bytes = shape.iter().product::<usize>() * sizes.cameras;
        if bytes as u64 > EPISODE_BYTES_MAX {
            let expected = format!("at most {EPISODE_BYTES_MAX} bytes of all cameras; cut the episode");
            return Err(self.wrong("image", format!("of {bytes} bytes"), expected));
        }
        for (key, axes) in [("action", &[sizes.action][..]), ("reward", &[]), ("is_first", &[])] {
            self.shape(key, axes)?.ok_or_else(|| self.missing(key))?;
        }
        for key in ["is_terminal", "is_last", "success", "pushed"] {
            self.shape(key, &[])?;
        }
        for camera in 0..sizes.cameras {
            self.shape(IMAGE[camera], &image)?;
            self.shape(MASK[camera], &image[..2])?;
            self.shape(DISTURBED_ALL[camera], &image)?;
        }
        if sizes.state != Some(0) {
            self.shape(PROPRIO, &[sizes.state.unwrap_or(1)])?;
        }
        Ok(sizes)
    }

    /// What `read` makes of every camera's array; none where the first has none, and then no camera may have one.
    fn cameras<T>(
        &mut self,
        keys: &Cameras,
        cameras: usize,
        mut read: impl FnMut(&mut Self, &'static str) -> Result<Option<T>, EpisodeError>,
    ) -> Result<Option<Vec<T>>, EpisodeError> {
        let found = keys[..cameras].iter().map(|key| read(self, key)).collect::<Result<Vec<_>, _>>()?;
        if found.iter().all(Option::is_none) {
            return Ok(None);
        }
        let present = |(key, array): (&&'static str, Option<T>)| array.ok_or_else(|| self.missing(key));
        keys.iter().zip(found).map(present).collect::<Result<Vec<_>, _>>().map(Some)
    }

    /// Numbers of any type; all must be finite.
    fn floats<D: Dimension>(
        &mut self,
        key: &'static str,
        axes: &[usize],
    ) -> Result<Option<ndarray::Array<f32, D>>, EpisodeError> {
        let Some(array) = self.array(key, axes)? else { return Ok(None) };
        let array = array.map(|number| number as f32);
        self.check_finite(key, array.iter())?;
        Ok(Some(dimensions(array)))
    }

    fn check_finite<'a>(
        &self,
        key: &'static str,
        mut numbers: impl Iterator<Item = &'a f32>,
    ) -> Result<(), EpisodeError> {
        if numbers.all(|x| x.is_finite()) {
            return Ok(());
        }
        Err(self.wrong(key, "not finite everywhere".into(), "finite numbers".into()))
    }

    /// Truth values of any type: what is more than a half.
    fn flags(&mut self, key: &'static str) -> Result<Option<Array1<bool>>, EpisodeError> {
        let array = self.array(key, &[])?;
        Ok(array.map(|array| dimensions::<_, Ix1>(array.map(|number| number > 0.5))))
    }

    /// Masks as truth values, 0 and 1, 0 and 255, probabilities, or numbers of objects.
    fn mask(&mut self, key: &'static str, side: usize) -> Result<Option<Array3<bool>>, EpisodeError> {
        let Some(array) = self.array(key, &[side, side])? else { return Ok(None) };
        let (mut least, mut most) = (0.0_f64, 0.0_f64);
        for number in array.numbers() {
            if !number.is_finite() {
                return Err(self.wrong(key, "not finite everywhere".into(), "finite numbers".into()));
            }
            (least, most) = (least.min(number), most.max(number));
        }
        if least < 0.0 {
            let expected = "0 where the robot is not, 1 or 255 where it is (logits: store what is above 0)";
            return Err(self.wrong(key, format!("down to {least}"), expected.into()));
        }
        let above = if array.is_float() && most <= 1.0 { 0.5 } else { robot_above(most) };
        Ok(Some(dimensions::<_, Ix3>(array.map(|number| number > above))))
    }

    /// Refuses actions that stand at the image they were chosen on, one step early: danijar/dreamerv3 stores them so today.
    fn check_actions(&mut self, episode: &Episode) -> Result<(), EpisodeError> {
        let is_zero = |step: usize| episode.action.row(step).iter().all(|x| *x == 0.0);
        let steps = || 0..episode.len();
        let early = steps().find(|step| episode.is_first[*step] && !is_zero(*step));
        // A chunk that begins in the middle of an episode shows it at the end, and `stepid` shows who wrote it.
        let theirs = self.archive.index_for_name("stepid.npy").is_some() && !steps().all(is_zero);
        let late = steps().find(|step| theirs && episode.is_last[*step] && is_zero(*step));
        let Some(step) = early.or(late) else { return Ok(()) };
        let (found, place) = if early.is_some() { ("not zero", "begins") } else { ("zero", "ends") };
        Err(self.wrong(
            "action",
            format!("{found} at step {step}, where an episode {place}: the action chosen at each image"),
            "the action that led to it, zeros at an episode's first; shift it: a[1:] = a[:-1]; a[is_first] = 0"
                .into(),
        ))
    }
}

/// The shape `[steps, axes]` where `found` is that but for axes of length 1 behind the first.
fn fitted(found: &[usize], steps: Option<usize>, axes: &[usize]) -> Option<Vec<usize>> {
    let (first, rest) = found.split_first()?;
    let fits = steps.map_or((1..=STEPS_MAX).contains(first), |steps| steps == *first);
    let without_ones = |sizes: &[usize]| sizes.iter().copied().filter(|size| *size != 1).collect::<Vec<_>>();
    let shape = || std::iter::once(*first).chain(axes.iter().copied()).collect();
    (fits && without_ones(rest) == without_ones(axes)).then(shape)
}

/// A hint where a picture's channels come first.
fn channels_first(found: &[usize], axes: &[usize]) -> &'static str {
    let moved = |axes: &[usize]| matches!((axes, found), ([h, w, c], [_, first, rest @ ..]) if first == c && rest == [*h, *w]);
    if moved(axes) { " (channels first; transpose it: channels last)" } else { "" }
}

fn dimensions<T, D: Dimension>(array: ArrayD<T>) -> ndarray::Array<T, D> {
    array.into_dimensionality().expect("the shape was checked before the numbers were read")
}

/// Parses an episode's archive; `path` is for messages.
pub(super) fn read(path: &Path, bytes: &[u8]) -> Result<Episode, EpisodeError> {
    let mut reader = Reader::open(path, bytes)?;
    let sizes = reader.check_shapes()?;
    let image = read_images(&mut reader, &IMAGE, sizes)?.ok_or_else(|| reader.missing("image"))?;
    let steps = image.shape()[0];
    let action = reader.floats::<Ix2>("action", &[sizes.action])?.ok_or_else(|| reader.missing("action"))?;
    let reward = reader.floats::<Ix1>("reward", &[])?.ok_or_else(|| reader.missing("reward"))?;
    let is_first = reader.flags("is_first")?.ok_or_else(|| reader.missing("is_first"))?;
    let none = || Array1::from_elem(steps, false);
    let episode = Episode {
        image,
        action,
        reward,
        is_first,
        is_terminal: reader.flags("is_terminal")?.unwrap_or_else(none),
        is_last: reader.flags("is_last")?.unwrap_or_else(none),
        success: reader.flags("success")?.unwrap_or_else(none),
        pushed: reader.flags("pushed")?.unwrap_or_else(none),
        robot_mask: read_masks(&mut reader, sizes)?,
        proprio: match sizes.state {
            Some(0) | None => None,
            Some(numbers) => reader.floats::<Ix2>(PROPRIO, &[numbers])?,
        },
        disturbed: read_images(&mut reader, &DISTURBED_ALL, sizes)?,
    };
    reader.check_actions(&episode)?;
    Ok(episode)
}

const ALIKE: &str = "the cameras' shapes were checked before they were read";

/// The images of all cameras, [T, S, S, 3 C].
fn read_images(
    reader: &mut Reader<'_>,
    keys: &Cameras,
    Sizes { side, cameras, .. }: Sizes,
) -> Result<Option<Array4<u8>>, EpisodeError> {
    let found = reader.cameras(keys, cameras, |reader, key| {
        let Some(array) = reader.array(key, &[side, side, 3])? else { return Ok(None) };
        let expected = format!("uint8 of shape [T, {side}, {side}, 3]");
        let images = array.into_bytes().map_err(|found| reader.wrong(key, found, expected))?;
        Ok(Some(dimensions::<_, Ix4>(images)))
    })?;
    Ok(found.map(|mut images| match images.len() {
        1 => images.remove(0),
        _ => {
            let views: Vec<_> = images.iter().map(|images| images.view()).collect();
            concatenate(Axis(3), &views).expect(ALIKE).as_standard_layout().into_owned()
        }
    }))
}

/// The masks of all cameras, [T, S, S * C].
fn read_masks(
    reader: &mut Reader<'_>,
    Sizes { side, cameras, .. }: Sizes,
) -> Result<Option<Array3<bool>>, EpisodeError> {
    let found = reader.cameras(&MASK, cameras, |reader, key| reader.mask(key, side))?;
    Ok(found.map(|mut masks| match masks.len() {
        1 => masks.remove(0),
        _ => {
            let views: Vec<_> = masks.iter().map(|masks| masks.view()).collect();
            let all = stack(Axis(3), &views).expect(ALIKE).as_standard_layout().into_owned();
            let shape = (all.len_of(Axis(0)), side, side * cameras);
            all.into_shape_with_order(shape).expect(ALIKE)
        }
    }))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test that fails panics")]
mod tests;
