//! What other programs write, and what nobody should.

use std::io::Write;

use zip::ZipWriter;
use zip::write::SimpleFileOptions;

use super::*;

/// What another program may have written: arrays by name, with header and bytes of our choice.
struct Foreign(Vec<(String, Vec<u8>)>);

const T: usize = 6;

impl Foreign {
    fn new() -> Self {
        let mut foreign = Self(Vec::new());
        foreign.set("image", "|u1", &[T, 64, 64, 3], &vec![9; T * 64 * 64 * 3]);
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
    // Pictures whose header asks for nearly 1 GiB, of which none is there.
    let mut foreign = Foreign::new();
    foreign.set("image", "|u1", &[80_000, 64, 64, 3], &[]);
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
    columns.set("image", "|u1", &[T, 1, 64, 64, 3], &vec![9; T * 64 * 64 * 3]);
    assert_eq!(columns.read().unwrap(), plain);
    let one = vec![0; 4 * T];
    assert!(Foreign::with("reward", "<f4", &[1, T], &one).unwrap_err().contains("[1, 6]"), "not a column");
    let images = vec![9_u8; T * 64 * 64 * 3];
    let whole = images.iter().flat_map(|x| i32::from(*x).to_le_bytes()).collect::<Vec<_>>();
    assert_eq!(Foreign::with("image", "<i4", &[T, 64, 64, 3], &whole).unwrap(), plain);
}

#[test]
fn pictures_of_another_form_are_refused_with_what_to_do() {
    let pixels = T * 64 * 64 * 3;
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
    let shape = [T, 64, 64];
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
    let with_channel = [T, 64, 64, 1];
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

#[test]
fn a_camera_that_is_missing_or_of_another_size_is_named() {
    let images = vec![9; T * 64 * 64 * 3];
    let mut foreign = Foreign::new();
    foreign.set("image_2", "|u1", &[T, 64, 64, 3], &images);
    assert_eq!(foreign.read().unwrap().image.shape(), [T, 64, 64, 6]);
    foreign.set("disturbed_2", "|u1", &[T, 64, 64, 3], &images);
    assert!(foreign.read().unwrap_err().contains("\"disturbed\" is missing"));
    let error = Foreign::with("image_2", "|u1", &[T, 128, 128, 3], &[]).unwrap_err();
    assert!(error.contains("\"image_2\"") && error.contains("[6, 64, 64, 3]"), "{error}");
    let error = Foreign::with("action", "<f4", &[T, 2, 4], &[]).unwrap_err();
    assert!(error.contains("[6, 2, 4]") && error.contains("[T, n]"), "{error}");
    // More than memory should hold.
    for side in IMAGE_SIDES {
        let error = Foreign::with("image", "|u1", &[STEPS_MAX, side, side, 3], &[]).unwrap_err();
        assert!(error.contains("bytes of all cameras"), "{error}");
    }
    let error = Foreign::with("image", "|u1", &[T, 96, 96, 3], &[]).unwrap_err();
    assert!(error.contains("[6, 96, 96, 3]") && error.contains("64 or 128"), "{error}");
}

#[test]
fn a_measured_state_without_numbers_is_read_as_none() {
    assert_eq!(Foreign::with("proprio", "<f4", &[T, 0], &[]).unwrap(), Foreign::new().read().unwrap());
    let error = Foreign::with("action", "<f4", &[T, 0], &[]).unwrap_err();
    assert!(error.contains("[6, 0]") && error.contains("from 1 to 64"), "{error}");
    let error = Foreign::with("proprio", "|O", &[T, 0], &[]).unwrap_err();
    assert!(error.contains("Python objects"), "{error}");
}
