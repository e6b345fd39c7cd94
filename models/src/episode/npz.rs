//! The archive behind an episode file. Shapes are checked before numbers are unpacked, so that a header cannot ask for more memory
//! than an episode may take.

use std::io::{BufReader, Cursor, Read, Write};
use std::path::Path;

use ndarray::{Array1, Array4, ArrayD, Dimension, Ix1, Ix2, Ix3, Ix4};
use ndarray_npy::WriteNpyExt;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use super::npy::{Array, Header};
use super::{EPISODE_BYTES_MAX, Episode, EpisodeError, STEPS_MAX, robot_above};
use crate::files::open_capped;
use crate::{ACTION_LEN, IMAGE_CHANNELS, IMAGE_SIDE, PROPRIOCEPTION_LEN};

/// Key of the pictures in another look.
pub(super) const DISTURBED: &str = "disturbed";

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

    /// Whether every array that is read is there and fits the images, before any of them is unpacked.
    fn check_shapes(&mut self) -> Result<(), EpisodeError> {
        let image = [IMAGE_SIDE, IMAGE_SIDE, IMAGE_CHANNELS];
        let shape = self.shape("image", &image)?.ok_or_else(|| self.missing("image"))?;
        self.steps = shape.first().copied();
        for (key, axes) in [("action", &[ACTION_LEN][..]), ("reward", &[]), ("is_first", &[])] {
            self.shape(key, axes)?.ok_or_else(|| self.missing(key))?;
        }
        for key in ["is_terminal", "is_last", "success", "pushed"] {
            self.shape(key, &[])?;
        }
        self.shape("robot_mask", &image[..2])?;
        self.shape("proprio", &[PROPRIOCEPTION_LEN])?;
        self.shape(DISTURBED, &image).map(drop)
    }

    /// Numbers of any type; all must be finite.
    fn floats<D: Dimension>(
        &mut self,
        key: &'static str,
        axes: &[usize],
    ) -> Result<Option<ndarray::Array<f32, D>>, EpisodeError> {
        let Some(array) = self.array(key, axes)? else { return Ok(None) };
        let array = array.map(|number| number as f32);
        if array.iter().any(|x| !x.is_finite()) {
            return Err(self.wrong(key, "not finite everywhere".into(), "finite numbers".into()));
        }
        Ok(Some(dimensions(array)))
    }

    /// Truth values of any type: what is more than a half.
    fn flags(&mut self, key: &'static str) -> Result<Option<Array1<bool>>, EpisodeError> {
        let array = self.array(key, &[])?;
        Ok(array.map(|array| dimensions::<_, Ix1>(array.map(|number| number > 0.5))))
    }

    /// Masks as truth values, 0 and 1, 0 and 255, probabilities, or numbers of objects.
    fn mask(&mut self) -> Result<Option<ndarray::Array<bool, Ix3>>, EpisodeError> {
        let key = "robot_mask";
        let Some(array) = self.array(key, &[IMAGE_SIDE, IMAGE_SIDE])? else { return Ok(None) };
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
        Ok(Some(dimensions(array.map(|number| number > above))))
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
    let broken = |error| EpisodeError::Archive {
        path: path.to_path_buf(),
        reason: format!("no whole archive of arrays ({error}); remove it or record it again"),
    };
    let archive = ZipArchive::new(Cursor::new(bytes)).map_err(broken)?;
    let mut reader = Reader { path, archive, steps: None };
    reader.check_shapes()?;
    let image = read_images(&mut reader, "image")?.ok_or_else(|| reader.missing("image"))?;
    let steps = image.shape()[0];
    let action = reader.floats::<Ix2>("action", &[ACTION_LEN])?.ok_or_else(|| reader.missing("action"))?;
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
        robot_mask: reader.mask()?,
        proprio: reader.floats::<Ix2>("proprio", &[PROPRIOCEPTION_LEN])?,
        disturbed: read_images(&mut reader, DISTURBED)?,
    };
    reader.check_actions(&episode)?;
    Ok(episode)
}

fn read_images(reader: &mut Reader<'_>, key: &'static str) -> Result<Option<Array4<u8>>, EpisodeError> {
    let axes = [IMAGE_SIDE, IMAGE_SIDE, IMAGE_CHANNELS];
    let Some(array) = reader.array(key, &axes)? else { return Ok(None) };
    let expected = format!("uint8 of shape [T, {IMAGE_SIDE}, {IMAGE_SIDE}, {IMAGE_CHANNELS}]");
    let images = array.into_bytes().map_err(|found| reader.wrong(key, found, expected))?;
    Ok(Some(dimensions::<_, Ix4>(images)))
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

#[cfg(test)]
mod tests {
    use super::*;

    /// What another program may have written: arrays by name, with header and bytes of our choice.
    struct Foreign(Vec<(String, Vec<u8>)>);

    const T: usize = 6;

    impl Foreign {
        fn new() -> Self {
            let mut foreign = Self(Vec::new());
            foreign.set("image", "|u1", &[T, 64, 64, 3], &vec![9; T * IMAGE_SIDE * IMAGE_SIDE * 3]);
            let mut action = vec![0.0_f32; 4];
            action.extend((1..T).flat_map(|step| [step as f32 / 10.0; 4]));
            foreign.set(
                "action",
                "<f4",
                &[T, 4],
                &action.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<_>>(),
            );
            foreign.set("reward", "<f4", &[T], &[0; 4 * T]);
            foreign.set("is_first", "|b1", &[T], &[1, 0, 0, 0, 0, 0]);
            foreign.set("is_last", "|b1", &[T], &[0, 0, 0, 0, 0, 1]);
            foreign
        }

        fn set(&mut self, key: &str, descr: &str, shape: &[usize], bytes: &[u8]) {
            let sizes: String = shape.iter().map(|size| format!("{size}, ")).collect();
            let header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({sizes})}}\n");
            let mut file = b"\x93NUMPY\x01\x00".to_vec();
            file.extend((header.len() as u16).to_le_bytes());
            file.extend(header.as_bytes());
            file.extend(bytes);
            self.0.retain(|(name, _)| name != key);
            self.0.push((key.to_owned(), file));
        }

        fn read(&self) -> Result<Episode, String> {
            let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
            for (key, file) in &self.0 {
                zip.start_file(format!("{key}.npy"), SimpleFileOptions::default()).unwrap();
                zip.write_all(file).unwrap();
            }
            let bytes = zip.finish().unwrap().into_inner();
            read(Path::new("a.npz"), &bytes).map_err(|error| error.to_string())
        }

        fn with(key: &str, descr: &str, shape: &[usize], bytes: &[u8]) -> Result<Episode, String> {
            let mut foreign = Self::new();
            foreign.set(key, descr, shape, bytes);
            foreign.read()
        }
    }

    #[test]
    fn what_does_not_fit_is_refused_before_any_array_is_unpacked() {
        // Pictures whose header asks for 1 GiB, of which none is there.
        let mut foreign = Foreign::new();
        foreign.set("image", "|u1", &[STEPS_MAX, 64, 64, 3], &[]);
        assert!(foreign.read().unwrap_err().contains("\"action\""), "{:?}", foreign.read().err());
        foreign.0.retain(|(name, _)| name != "action");
        assert!(foreign.read().unwrap_err().contains("array \"action\" is missing"));
    }

    #[test]
    fn columns_and_axes_of_one_environment_are_read_as_the_same_numbers() {
        let plain = Foreign::new().read().unwrap();
        let mut columns = Foreign::new();
        columns.set("reward", ">f8", &[T, 1], &[0; 8 * T]);
        columns.set("is_first", "<i8", &[T, 1, 1], &[&[1_u8][..], &[0; 8 * T - 1]].concat());
        columns.set("is_last", "|u1", &[T, 1], &[0, 0, 0, 0, 0, 255]);
        columns.set("image", "|u1", &[T, 1, 64, 64, 3], &vec![9; T * IMAGE_SIDE * IMAGE_SIDE * 3]);
        assert_eq!(columns.read().unwrap(), plain);
        let one = vec![0; 4 * T];
        assert!(
            Foreign::with("reward", "<f4", &[1, T], &one).unwrap_err().contains("[1, 6]"),
            "not a column"
        );
        let images = vec![9_u8; T * IMAGE_SIDE * IMAGE_SIDE * 3];
        let whole = images.iter().flat_map(|x| i32::from(*x).to_le_bytes()).collect::<Vec<_>>();
        assert_eq!(Foreign::with("image", "<i4", &[T, 64, 64, 3], &whole).unwrap(), plain);
    }

    #[test]
    fn pictures_of_another_form_are_refused_with_what_to_do() {
        let pixels = T * IMAGE_SIDE * IMAGE_SIDE * 3;
        let error = Foreign::with("image", "<f4", &[T, 64, 64, 3], &vec![0; 4 * pixels]).unwrap_err();
        assert!(error.contains("floating-point") && error.contains("uint8"), "{error}");
        let error = Foreign::with("image", "|u1", &[T, 3, 64, 64], &vec![0; pixels]).unwrap_err();
        assert!(error.contains("channels first") && error.contains("transpose"), "{error}");
        let large = vec![1_u8; 2 * pixels];
        let error = Foreign::with("image", "<u2", &[T, 64, 64, 3], &large).unwrap_err();
        assert!(error.contains("beyond 0 to 255"), "{error}");
    }

    #[test]
    fn masks_of_every_convention_are_the_same_mask() {
        let shape = [T, IMAGE_SIDE, IMAGE_SIDE];
        let pixels: usize = shape.iter().product();
        let robot = |index: usize| index.is_multiple_of(5);
        let expected: Vec<bool> = (0..pixels).map(robot).collect();
        let masks = |descr: &str, shape: &[usize], on: &[u8]| {
            let off = vec![0; on.len()];
            let bytes: Vec<u8> =
                (0..pixels).flat_map(|i| if robot(i) { on.to_vec() } else { off.clone() }).collect();
            let episode = Foreign::with("robot_mask", descr, shape, &bytes).unwrap();
            episode.robot_mask.unwrap().into_raw_vec_and_offset().0
        };
        let with_channel = [T, IMAGE_SIDE, IMAGE_SIDE, 1];
        assert_eq!(masks("|b1", &shape, &[1]), expected);
        assert_eq!(masks("|u1", &shape, &[255]), expected);
        assert_eq!(masks("|u1", &with_channel, &[3]), expected, "the number of an object");
        assert_eq!(masks("<i4", &with_channel, &1_i32.to_le_bytes()), expected);
        assert_eq!(masks(">i8", &with_channel, &255_i64.to_be_bytes()), expected);
        assert_eq!(masks("<u2", &shape, &65535_u16.to_le_bytes()), expected);
        assert_eq!(masks("<f4", &shape, &0.75_f32.to_le_bytes()), expected, "a probability");
        let logits: Vec<u8> = (0..pixels).flat_map(|_| (-2.5_f32).to_le_bytes()).collect();
        assert!(Foreign::with("robot_mask", "<f4", &shape, &logits).unwrap_err().contains("logits"));
    }

    #[test]
    fn objects_are_named_and_what_nobody_asks_for_is_not_looked_at() {
        let error = Foreign::with("reward", "|O", &[T], b"pickle").unwrap_err();
        assert!(error.contains("\"reward\"") && error.contains("Python objects"), "{error}");
        Foreign::with("info", "|O", &[T], b"pickle").unwrap();
        let error = Foreign::with("reward", "<f4", &[T], &f32::NAN.to_le_bytes().repeat(T)).unwrap_err();
        assert!(error.contains("not finite"), "{error}");
        let error = Foreign::with("reward", "<f2", &[T], &[0; 3]).unwrap_err();
        assert!(error.contains("cut off"), "{error}");
    }

    #[test]
    fn actions_at_the_image_they_were_chosen_on_are_refused_with_the_remedy() {
        let chosen: Vec<u8> = (1..=T)
            .flat_map(|step| [if step == T { 0.0 } else { step as f32 / 10.0 }; 4])
            .flat_map(f32::to_le_bytes)
            .collect();
        let error = Foreign::with("action", "<f4", &[T, 4], &chosen).unwrap_err();
        assert!(error.contains("step 0") && error.contains("a[1:] = a[:-1]"), "{error}");
        // A chunk out of the middle of an episode tells it at the end only.
        let mut chunk = Foreign::new();
        chunk.set("action", "<f4", &[T, 4], &chosen);
        chunk.set("is_first", "|b1", &[T], &[0; T]);
        chunk.read().unwrap();
        chunk.set("stepid", "|u1", &[T, 20], &[0; 20 * T]);
        assert!(chunk.read().unwrap_err().contains("ends"));
    }
}
