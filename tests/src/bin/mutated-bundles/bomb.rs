//! Files that are small for what they make a reader do: millions of empty messages, long packed lists, headers of thousands of arrays,
//! fields that come again and again. Refusing one must cost little, whatever is in it.

use prost::encoding::encode_varint;
use rand::Rng;
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;
use rcwm_models::bundle::MANIFEST_FILE;

use crate::bundle::Original;

/// Fields of the published `onnx.proto`.
const GRAPH: u64 = 7;

/// Largest bomb, in bytes.
const BYTES_MAX: usize = 12 << 20;

/// A field that holds bytes.
fn field(number: u64, bytes: &[u8]) -> Vec<u8> {
    let mut message = Vec::with_capacity(bytes.len() + 12);
    encode_varint(number << 3 | 2, &mut message);
    encode_varint(bytes.len() as u64, &mut message);
    message.extend_from_slice(bytes);
    message
}

/// Fields within fields, the outermost first.
fn nested(path: &[u64], bytes: Vec<u8>) -> Vec<u8> {
    path.iter().rev().fold(bytes, |bytes, number| field(*number, &bytes))
}

/// What was done, the file's name, and its bytes.
pub(crate) fn of(rng: &mut ChaCha8Rng, original: &Original) -> (String, String, Vec<u8>) {
    // From thousands to millions, each order of magnitude as often as the others.
    let count = 1 << rng.random_range(10..22);
    match rng.random_range(0..10) {
        0 => manifest(rng, count, original),
        1 | 2 => tensors(rng, count, original),
        _ => {
            let name = original.parts.choose(rng).cloned().unwrap_or_default();
            let (what, more) = onnx(rng, count);
            let bytes = if rng.random_bool(0.5) {
                [original.files[&name].clone(), more].concat()
            } else {
                [more, original.files[&name].clone()].concat()
            };
            (what, name, bytes)
        }
    }
}

fn onnx(rng: &mut ChaCha8Rng, count: usize) -> (String, Vec<u8>) {
    // Places of repeated fields: nodes, constants, inputs, described values, functions, operator sets; inputs, outputs and attributes of a
    // node; integers and graphs of an attribute; dimensions of a constant and of a value.
    const REPEATED: [&[u64]; 14] = [
        &[GRAPH, 1],
        &[GRAPH, 5],
        &[GRAPH, 11],
        &[GRAPH, 13],
        &[25],
        &[8],
        &[GRAPH],
        &[GRAPH, 1, 1],
        &[GRAPH, 1, 2],
        &[GRAPH, 1, 5],
        &[GRAPH, 1, 5, 11],
        &[GRAPH, 1, 5, 5, 13],
        &[GRAPH, 13, 2, 1, 2, 1],
        &[GRAPH, 1, 5, 5],
    ];
    match rng.random_range(0..8) {
        0 => {
            let attributes =
                (0..count.min(1 << 18)).flat_map(|i| field(5, &field(1, format!("{i:x}").as_bytes())));
            (format!("{count} attributes of one node"), nested(&[GRAPH, 1], attributes.collect()))
        }
        1 => {
            let path: &[u64] = if rng.random_bool(0.5) { &[GRAPH, 1, 5, 8] } else { &[GRAPH, 5, 1] };
            (format!("{count} packed numbers at {path:?}"), nested(path, vec![1; count]))
        }
        2 => {
            let path: &[u64] = if rng.random_bool(0.5) { &[GRAPH, 1, 4] } else { &[GRAPH, 5, 8] };
            (format!("a name of {count} bytes at {path:?}"), nested(path, vec![b'n'; count]))
        }
        3 => (format!("{count} beginnings of groups"), vec![30 << 3 | 3; count]),
        4 => {
            let weights = nested(&[GRAPH, 5], field(9, &vec![0; (4 * count).min(BYTES_MAX)]));
            (format!("a constant of {count} zeros"), weights)
        }
        _ => {
            let path = REPEATED.choose(rng).copied().unwrap_or(&[GRAPH]);
            let (last, outer) = path.split_last().unwrap_or((&GRAPH, &[]));
            (format!("{count} empty fields at {path:?}"), nested(outer, field(*last, &[]).repeat(count)))
        }
    }
}

/// A header that describes thousands of empty arrays, or says that it is longer than any.
fn tensors(rng: &mut ChaCha8Rng, count: usize, original: &Original) -> (String, String, Vec<u8>) {
    let others: Vec<&String> = original.listed.iter().filter(|name| !original.parts.contains(name)).collect();
    let name = others.choose(rng).map_or_else(String::new, |name| (*name).clone());
    let count = count.min(1 << 17);
    let array = |i: usize| format!("\"{i}\":{{\"dtype\":\"U8\",\"shape\":[0],\"data_offsets\":[0,0]}}");
    let header = format!("{{{}}}", (0..count).map(array).collect::<Vec<_>>().join(","));
    let len = if rng.random_bool(0.3) {
        rng.random::<u64>() >> rng.random_range(0..64)
    } else {
        header.len() as u64
    };
    let bytes = [&len.to_le_bytes()[..], header.as_bytes()].concat();
    (format!("a header of {count} arrays that says it has {len} bytes"), name, bytes)
}

fn manifest(rng: &mut ChaCha8Rng, count: usize, original: &Original) -> (String, String, Vec<u8>) {
    let count = count.min(1 << 18);
    let (what, more) = match rng.random_range(0..5) {
        0 => ("tables in tables", format!("x = {}", "{a=".repeat(count))),
        1 => ("lists in lists", format!("x = {}", "[".repeat(count))),
        2 => ("dotted keys", format!("{}a = 1", "a.".repeat(count))),
        3 => ("keys", (0..count).map(|i| format!("k{i} = 1\n")).collect()),
        _ => ("numbers", format!("x = [{}]", "1,".repeat(count))),
    };
    let text = if rng.random_bool(0.5) {
        format!("{more}\n{}", original.manifest())
    } else {
        format!("{}\n{more}", original.manifest())
    };
    (format!("{count} {what}"), MANIFEST_FILE.to_owned(), text.into_bytes())
}
