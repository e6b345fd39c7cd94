//! What is done to the files, decided by the seed alone.

use rand::seq::IndexedRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::bundle::MANIFEST_FILE;
use rcwm_models::tensors::{Tensors, Values};

use crate::bundle::{Files, Original};
use crate::graph::HARD_INTEGERS;
use crate::{bomb, graph};

/// A damaged bundle.
pub(crate) struct Case {
    /// What was done, for people.
    pub(crate) what: String,
    /// The files that differ from the sound ones.
    pub(crate) files: Files,
}

impl Case {
    /// The case of a seed.
    pub(crate) fn of(seed: u64, original: &Original) -> Self {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed);
        match rng.random_range(0..100) {
            0..16 => manifest_text(rng, original),
            16..20 => small_for_its_cost(rng, original),
            20..35 => damaged_bytes(rng, original, false),
            35..60 => damaged_bytes(rng, original, true),
            60..90 => changed_graph(rng, original),
            _ => changed_tensors(rng, original),
        }
    }

    fn one(original: &Original, what: String, name: &str, bytes: Vec<u8>, repair: bool) -> Self {
        let mut files = Files::new();
        if repair {
            files.insert(MANIFEST_FILE.to_owned(), original.repaired_manifest(name, &bytes).into_bytes());
        }
        files.insert(name.to_owned(), bytes);
        Self { what: format!("{name}: {what}{}", if repair { ", checksum repaired" } else { "" }), files }
    }
}

fn small_for_its_cost(rng: &mut ChaCha8Rng, original: &Original) -> Case {
    let (what, name, bytes) = bomb::of(rng, original);
    Case::one(original, what, &name, bytes, name != MANIFEST_FILE)
}

fn manifest_text(rng: &mut ChaCha8Rng, original: &Original) -> Case {
    let text = original.manifest();
    let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
    let mut what = Vec::new();
    for _ in 0..rng.random_range(1..=3) {
        let (at, other) = (rng.random_range(0..lines.len()), rng.random_range(0..lines.len()));
        what.push(match rng.random_range(0..6) {
            0 => format!("line {at} left out: {}", lines.remove(at)),
            1 => {
                lines.insert(other, lines[at].clone());
                format!("line {at} again at {other}")
            }
            2 => {
                lines.swap(at, other);
                format!("lines {at} and {other} change places")
            }
            3 | 4 => {
                lines[at] = with_hard_number(rng, &lines[at]);
                format!("line {at} becomes {}", lines[at])
            }
            _ => {
                let mut bytes = std::mem::take(&mut lines[at]).into_bytes();
                let what = damage(rng, &mut bytes, b"[[[[[[[[=\"\"\"nan inf -0x 1e999 {}\\u0000");
                lines[at] = String::from_utf8_lossy(&bytes).into_owned();
                format!("line {at}: {what}")
            }
        });
        if lines.is_empty() {
            break;
        }
    }
    Case::one(original, what.join("; "), MANIFEST_FILE, lines.join("\n").into_bytes(), false)
}

/// The line with the value behind `=` replaced by one that is hard to digest.
fn with_hard_number(rng: &mut ChaCha8Rng, line: &str) -> String {
    const WORDS: [&str; 9] =
        ["nan", "-inf", "1e-320", "1e308", "-0.0", "\"\"", "[]", "{}", "\"../encoder.onnx\""];
    let value = match rng.random_bool(0.6) {
        true => HARD_INTEGERS.choose(rng).map_or_else(String::new, ToString::to_string),
        false => WORDS.choose(rng).map_or_else(String::new, ToString::to_string),
    };
    let before = line.split('=').next().unwrap_or_default();
    if line.contains('[') && line.contains('=') && rng.random_bool(0.7) {
        return format!("{before}= [{value}, {value}, {value}, {value}]");
    }
    format!("{before}= {value}")
}

fn damaged_bytes(rng: &mut ChaCha8Rng, original: &Original, repair: bool) -> Case {
    let mut names = original.listed.clone();
    if !repair {
        names.push(MANIFEST_FILE.to_owned());
    }
    let name = names.choose(rng).cloned().unwrap_or_default();
    let donor = names.choose(rng).cloned().unwrap_or_default();
    let mut bytes = original.files[&name].clone();
    let what = damage(rng, &mut bytes, &original.files[&donor]);
    Case::one(original, format!("{what} (donor {donor})"), &name, bytes, repair)
}

/// One kind of damage to some bytes; grafts come from `donor`.
fn damage(rng: &mut ChaCha8Rng, bytes: &mut Vec<u8>, donor: &[u8]) -> String {
    if bytes.is_empty() {
        bytes.extend_from_slice(donor);
        return "replaced".into();
    }
    match rng.random_range(0..10) {
        0..4 => {
            let count = 1 << rng.random_range(0..6);
            for _ in 0..count {
                let at = place(rng, bytes.len());
                bytes[at] ^= 1 << rng.random_range(0..8);
            }
            format!("{count} bits flipped")
        }
        4..6 => {
            let len = place(rng, bytes.len());
            bytes.truncate(len);
            format!("cut to {len} bytes")
        }
        6 => {
            let (from, to) = piece(rng, bytes.len());
            bytes.drain(from..to);
            format!("bytes {from} to {to} left out")
        }
        7 | 8 => {
            let ((from, to), (at, end)) = (piece(rng, donor.len()), piece(rng, bytes.len()));
            let end = if rng.random_bool(0.5) { at } else { end };
            bytes.splice(at..end, donor[from..to].iter().copied());
            format!("bytes {at} to {end} replaced by a donor's {from} to {to}")
        }
        _ => {
            bytes.clear();
            bytes.extend_from_slice(donor);
            "replaced by the donor".into()
        }
    }
}

/// A place in a file: half of them near its beginning or end, where the structure of many formats lies.
fn place(rng: &mut ChaCha8Rng, len: usize) -> usize {
    let near = len.min(4096);
    match rng.random_range(0..4) {
        0 => rng.random_range(0..near),
        1 => len - 1 - rng.random_range(0..near),
        _ => rng.random_range(0..len),
    }
}

fn piece(rng: &mut ChaCha8Rng, len: usize) -> (usize, usize) {
    let from = place(rng, len);
    let longest = (len - from).min(1 << rng.random_range(1..16));
    (from, from + rng.random_range(0..=longest))
}

fn changed_graph(rng: &mut ChaCha8Rng, original: &Original) -> Case {
    let name = original.parts.choose(rng).cloned().unwrap_or_default();
    let (what, bytes) = graph::change(rng, &original.files[&name]);
    Case::one(original, what, &name, bytes, true)
}

/// Sound files of wrong numbers: initial states and golden values.
fn changed_tensors(rng: &mut ChaCha8Rng, original: &Original) -> Case {
    let others: Vec<&String> = original.listed.iter().filter(|name| !original.parts.contains(name)).collect();
    let name = others.choose(rng).map_or_else(String::new, |name| (*name).clone());
    let mut tensors = Tensors::from_bytes(&original.files[&name]).unwrap_or_default();
    let keys: Vec<String> = tensors.0.keys().cloned().collect();
    let key = keys.choose(rng).cloned().unwrap_or_default();
    let what = match rng.random_range(0..5) {
        0 => {
            tensors.0.remove(&key);
            format!("{key} left out")
        }
        1 => {
            let donor = keys.choose(rng).and_then(|donor| tensors.0.get(donor)).cloned();
            tensors.0.extend(donor.map(|values| (key.clone(), values)));
            format!("{key} replaced by another")
        }
        _ => match tensors.0.get_mut(&key) {
            Some(values) => format!("{key}: {}", hard_value(rng, values)),
            None => "unchanged".into(),
        },
    };
    // A name that is taken twice cannot happen in a map: writing does not fail.
    let bytes = tensors.to_bytes().unwrap_or_default();
    Case::one(original, what, &name, bytes, true)
}

fn hard_value(rng: &mut ChaCha8Rng, values: &mut Values) -> String {
    const FLOATS: [f32; 7] =
        [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, -1e30, f32::MIN_POSITIVE, 1e7];
    let len: usize = values.shape().iter().product();
    let at = rng.random_range(0..len.max(1));
    match values {
        Values::F32(array) => {
            let value = FLOATS.choose(rng).copied().unwrap_or(f32::NAN);
            array.iter_mut().skip(at).take(1).for_each(|place| *place = value);
            format!("element {at} is {value}")
        }
        Values::I64(array) => {
            let value = HARD_INTEGERS.choose(rng).copied().unwrap_or(-1);
            array.iter_mut().skip(at).take(1).for_each(|place| *place = value);
            format!("element {at} is {value}")
        }
        Values::U8(array) => {
            array.iter_mut().skip(at).take(1000).for_each(|place| *place = !*place);
            format!("bytes inverted from {at}")
        }
    }
}
