//! Masks as pictures, one a step, in any of the ways in which segmentation programs write them.

use std::io::BufReader;
use std::path::{Path, PathBuf};

use ndarray::Array3;
use png::{BitDepth, ColorType, Transformations};
use rcwm_models::episode::robot_above;
use rcwm_models::files::open_capped;

use super::folder::{LoadError, is, sorted};

/// Largest picture of a mask that is read, in bytes.
const MASK_BYTES_MAX: u64 = 16 << 20;

/// A picture's pixels: how bright, or the number of an object; and how opaque, where that is told.
struct Picture {
    values: Vec<u32>,
    opacity: Option<Vec<u32>>,
}

/// Reads one picture a step, in the order of the numbers in their names.
///
/// | picture | the robot is |
/// | --- | --- |
/// | with a palette | every index but 0, as SAM 2 and DAVIS number objects |
/// | grey or colour, brighter than half somewhere in the episode | what is brighter than half |
/// | grey or colour, all darker | everything but black: numbers of objects |
/// | one colour, transparent in parts | what is opaque |
///
/// # Errors
/// [`LoadError::MaskCount`] or [`LoadError::Mask`].
pub(super) fn read_masks(folder: &Path, steps: usize, side: usize) -> Result<Array3<bool>, LoadError> {
    let pictures = in_order(folder)?;
    if pictures.len() != steps {
        let (path, found) = (folder.to_path_buf(), pictures.len());
        return Err(LoadError::MaskCount { path, found, expected: steps });
    }
    let read =
        |path: &PathBuf| decode(path, side).map_err(|reason| LoadError::Mask { path: path.clone(), reason });
    let pictures = pictures.iter().map(read).collect::<Result<Vec<_>, _>>()?;
    let robot = robot(&pictures).map_err(|reason| LoadError::Mask { path: folder.to_path_buf(), reason })?;
    if !robot.contains(&true) {
        let reason =
            "no pixel of all pictures is the robot; expected white, or the number of an object, where it is";
        return Err(LoadError::Mask { path: folder.to_path_buf(), reason: reason.into() });
    }
    let shape = (steps, side, side);
    Ok(Array3::from_shape_vec(shape, robot).expect("every picture has the size that was asked for"))
}

/// The episode's pixels, true where the robot is.
fn robot(pictures: &[Picture]) -> Result<Vec<bool>, String> {
    let values = || pictures.iter().flat_map(|picture| picture.values.iter().copied());
    let above = robot_above(f64::from(values().max().unwrap_or(0)));
    let bright: Vec<bool> = values().map(|value| f64::from(value) > above).collect();
    if pictures.iter().all(|picture| picture.opacity.is_none()) {
        return Ok(bright);
    }
    let opacity = |picture: &Picture| match &picture.opacity {
        Some(opacity) => opacity.iter().map(|opacity| *opacity > u32::from(u16::MAX) / 2).collect(),
        None => vec![true; picture.values.len()],
    };
    let opaque: Vec<bool> = pictures.iter().flat_map(opacity).collect();
    let varies = |pixels: &[bool]| pixels.contains(&true) && pixels.contains(&false);
    match (varies(&bright), varies(&opaque)) {
        (_, false) => Ok(bright),
        (false, true) => Ok(opaque),
        (true, true) if bright == opaque => Ok(bright),
        (true, true) => {
            Err("brightness and transparency show two different masks; write one of them, in grey".into())
        }
    }
}

/// The pictures by the numbers in their names: `2.png` is before `10.png`, and no number is missing.
fn in_order(folder: &Path) -> Result<Vec<PathBuf>, LoadError> {
    let mut pictures: Vec<_> = sorted(folder)?.into_iter().filter(|file| is(file, "png")).collect();
    pictures.sort_by_cached_key(|path| numbers(path));
    let fail = |path: &Path, reason: String| Err(LoadError::Mask { path: path.to_path_buf(), reason });
    let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    for pair in pictures.windows(2) {
        if numbers(&pair[0]) == numbers(&pair[1]) {
            return fail(
                &pair[1],
                format!("has the number of {} too; expected one picture a step", name(&pair[0])),
            );
        }
    }
    // The number that counts the steps is the one that differs.
    let counted: Vec<Vec<u64>> = pictures.iter().map(|path| digits(path)).collect();
    let columns = counted.first().map_or(0, Vec::len);
    if counted.iter().any(|row| row.len() != columns) {
        return Ok(pictures);
    }
    let column =
        (0..columns).find(|column| counted.windows(2).any(|rows| rows[0][*column] != rows[1][*column]));
    let Some(column) = column else { return Ok(pictures) };
    let step = |index: usize| counted[index + 1][column].wrapping_sub(counted[index][column]);
    if let Some(gap) = (1..pictures.len().saturating_sub(1)).find(|index| step(*index) != step(0)) {
        let reason = format!("comes right after {}; a picture between them is missing", name(&pictures[gap]));
        return fail(&pictures[gap + 1], reason);
    }
    Ok(pictures)
}

/// A name in parts, such that numbers compare as numbers.
fn numbers(path: &Path) -> Vec<(String, u64)> {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let mut parts = vec![(String::new(), 0_u64)];
    let mut in_number = false;
    for letter in stem.chars() {
        let last = parts.last_mut().expect("there is one from the beginning");
        match letter.to_digit(10) {
            Some(digit) => {
                last.1 = last.1.saturating_mul(10).saturating_add(u64::from(digit));
                in_number = true;
            }
            None if in_number => {
                parts.push((letter.to_string(), 0));
                in_number = false;
            }
            None => last.0.push(letter),
        }
    }
    parts
}

fn digits(path: &Path) -> Vec<u64> {
    numbers(path).into_iter().map(|(_, number)| number).collect()
}

/// Reads a picture as it is stored: a palette's indices stay what they are.
fn decode(path: &Path, side: usize) -> Result<Picture, String> {
    let (file, _) = open_capped(path, MASK_BYTES_MAX).map_err(|error| error.to_string())?;
    let mut decoder = png::Decoder::new(BufReader::new(file));
    decoder.set_transformations(Transformations::IDENTITY);
    let mut reader = decoder.read_info().map_err(|error| error.to_string())?;
    let info = reader.info();
    if (info.width as usize, info.height as usize) != (side, side) {
        return Err(format!("is {}x{} pixels, expected {side}x{side}", info.width, info.height));
    }
    let bytes = reader.output_buffer_size().ok_or("is larger than memory")?;
    let mut buffer = vec![0; bytes];
    let frame = reader.next_frame(&mut buffer).map_err(|error| error.to_string())?;
    let samples = frame.color_type.samples();
    let mut values = Vec::with_capacity(side * side);
    let mut opacity = Vec::new();
    for row in buffer[..frame.buffer_size()].chunks_exact(frame.line_size) {
        let row = unpack(row, frame.bit_depth);
        for pixel in row.chunks_exact(samples).take(side) {
            let (colours, alpha) = match frame.color_type {
                ColorType::GrayscaleAlpha | ColorType::Rgba => pixel.split_at(samples - 1),
                _ => (pixel, &[][..]),
            };
            values.push(colours.iter().copied().max().unwrap_or(0));
            opacity.extend(alpha.iter().map(|alpha| match frame.bit_depth {
                BitDepth::Sixteen => *alpha,
                _ => *alpha * 257,
            }));
        }
    }
    if frame.color_type == ColorType::Indexed {
        // The number of an object, not a brightness: 255 stays one robot among others.
        values.iter_mut().for_each(|index| *index = u32::from(*index > 0));
    }
    Ok(Picture { values, opacity: Some(opacity).filter(|opacity| !opacity.is_empty()) })
}

/// The samples of a row; those of 1 bit become black and white.
fn unpack(row: &[u8], depth: BitDepth) -> Vec<u32> {
    match depth {
        BitDepth::Sixteen => {
            row.chunks_exact(2).map(|b| u32::from(u16::from_be_bytes([b[0], b[1]]))).collect()
        }
        BitDepth::Eight => row.iter().map(|byte| u32::from(*byte)).collect(),
        _ => {
            let bits = depth as usize;
            let mask = (1_u32 << bits) - 1;
            let sample = |byte: u8, index: usize| u32::from(byte) >> (8 - bits * (index + 1)) & mask;
            row.iter().flat_map(|byte| (0..8 / bits).map(move |index| sample(*byte, index))).collect()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;

    const SIDE: usize = 64;
    const PIXELS: usize = SIDE * SIDE;

    fn is_robot(pixel: usize) -> bool {
        pixel % 7 < 2
    }

    /// A picture with these samples a pixel where the robot is, and those where it is not.
    fn write(path: &Path, colour: ColorType, depth: BitDepth, robot: &[u8], rest: &[u8]) {
        let side = SIDE as u32;
        let mut encoder = png::Encoder::new(File::create(path).unwrap(), side, side);
        encoder.set_color(colour);
        encoder.set_depth(depth);
        if colour == ColorType::Indexed {
            encoder.set_palette(vec![0_u8; 256 * 3]);
        }
        let bytes: Vec<u8> =
            (0..PIXELS).flat_map(|pixel| if is_robot(pixel) { robot } else { rest }).copied().collect();
        encoder.write_header().unwrap().write_image_data(&bytes).unwrap();
    }

    fn read(
        colour: ColorType,
        depth: BitDepth,
        robot: &[u8],
        rest: &[u8],
    ) -> Result<Array3<bool>, LoadError> {
        let folder = tempfile::tempdir().unwrap();
        for step in 0..2 {
            write(&folder.path().join(format!("{step}.png")), colour, depth, robot, rest);
        }
        read_masks(folder.path(), 2, SIDE)
    }

    #[test]
    fn every_way_to_write_a_mask_is_the_same_mask() {
        use BitDepth::{Eight, Sixteen};
        use ColorType::{Grayscale, GrayscaleAlpha, Indexed, Rgb, Rgba};
        for (colour, depth, robot, rest) in [
            (Grayscale, Eight, &[255_u8][..], &[0_u8][..]),
            (Grayscale, Eight, &[250], &[5]),
            (Grayscale, Eight, &[1], &[0]),
            (Grayscale, Eight, &[38], &[0]),
            (Grayscale, Sixteen, &[255, 255], &[0, 0]),
            (Grayscale, Sixteen, &[0, 1], &[0, 0]),
            (Grayscale, Sixteen, &[0, 255], &[0, 0]),
            (Indexed, Eight, &[1], &[0]),
            (Indexed, Eight, &[255], &[0]),
            (Rgb, Eight, &[128, 0, 0], &[0, 0, 0]),
            (GrayscaleAlpha, Eight, &[255, 255], &[0, 255]),
            (GrayscaleAlpha, Eight, &[255, 255], &[255, 0]),
            (GrayscaleAlpha, Eight, &[255, 255], &[0, 0]),
            (Rgba, Eight, &[0, 0, 0, 255], &[0, 0, 0, 0]),
            (Rgba, Sixteen, &[255; 8], &[0, 0, 0, 0, 0, 0, 255, 255]),
        ] {
            let masks = read(colour, depth, robot, rest).unwrap();
            let found: Vec<bool> = masks.iter().copied().collect();
            let expected: Vec<bool> = (0..2 * PIXELS).map(|pixel| is_robot(pixel % PIXELS)).collect();
            assert!(found == expected, "{colour:?} of {depth:?}: {robot:?} and {rest:?}");
        }
    }

    #[test]
    fn pictures_of_one_bit_are_black_and_white() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("0.png");
        let mut encoder = png::Encoder::new(File::create(&path).unwrap(), 64, 64);
        encoder.set_depth(BitDepth::One);
        encoder.write_header().unwrap().write_image_data(&[0b0100_0000; 512]).unwrap();
        let masks = read_masks(folder.path(), 1, SIDE).unwrap();
        assert!(masks[[0, 0, 1]] && !masks[[0, 0, 0]]);
        assert_eq!(masks.iter().filter(|robot| **robot).count(), 512);
    }

    #[test]
    fn a_mask_without_a_robot_or_with_two_is_refused() {
        let error = read(ColorType::Grayscale, BitDepth::Eight, &[0], &[0]).unwrap_err().to_string();
        assert!(error.contains("no pixel"), "{error}");
        let folder = tempfile::tempdir().unwrap();
        write(
            &folder.path().join("0.png"),
            ColorType::GrayscaleAlpha,
            BitDepth::Eight,
            &[255, 255],
            &[0, 255],
        );
        write(&folder.path().join("1.png"), ColorType::GrayscaleAlpha, BitDepth::Eight, &[255, 0], &[0, 255]);
        let error = read_masks(folder.path(), 2, SIDE).unwrap_err().to_string();
        assert!(error.contains("two different masks"), "{error}");
    }

    #[test]
    fn steps_are_in_the_order_of_numbers_and_none_is_missing() {
        let folder = tempfile::tempdir().unwrap();
        let grey = |name: &str| {
            write(&folder.path().join(name), ColorType::Grayscale, BitDepth::Eight, &[255], &[0]);
        };
        let names = || -> Vec<String> {
            let found = in_order(folder.path()).unwrap();
            found.iter().map(|path| path.file_name().unwrap().to_string_lossy().into_owned()).collect()
        };
        for step in (0..=12).rev() {
            grey(&format!("cam2_frame{step}.png"));
        }
        let expected: Vec<String> = (0..=12).map(|step| format!("cam2_frame{step}.png")).collect();
        assert_eq!(names(), expected);
        std::fs::remove_file(folder.path().join("cam2_frame7.png")).unwrap();
        let error = in_order(folder.path()).unwrap_err().to_string();
        assert!(error.contains("frame8") && error.contains("missing"), "{error}");
        grey("cam2_frame7.png");
        grey("cam2_frame07.png");
        let error = in_order(folder.path()).unwrap_err().to_string();
        assert!(error.contains("has the number of"), "{error}");
    }
}
