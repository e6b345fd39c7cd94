//! Arrays as numpy writes them: every version of the header, either byte order, C and Fortran order, and every plain numeric type.

use std::io::Read;

use half::f16;
use ndarray::{ArrayD, IxDyn, ShapeBuilder};

use super::EPISODE_BYTES_MAX;

/// Longest header accepted, in bytes; numpy's own have about 128.
const HEADER_BYTES_MAX: u32 = 1 << 16;

/// What the numbers of an array are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Bool,
    Unsigned,
    Signed,
    Float,
}

/// What an array's header says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Header {
    kind: Kind,
    /// Bytes of a number: 1, 2, 4 or 8.
    size: usize,
    big_endian: bool,
    fortran: bool,
    pub(super) shape: Vec<usize>,
}

impl Header {
    /// Reads magic, version and header, and leaves `from` at the first number.
    pub(super) fn read(from: &mut impl Read) -> Result<Self, String> {
        let mut start = [0; 8];
        fill(from, &mut start)?;
        if &start[..6] != b"\x93NUMPY" {
            return Err("no array of numpy (its first bytes are others)".into());
        }
        let len = match start[6] {
            1 => {
                let mut len = [0; 2];
                fill(from, &mut len)?;
                u32::from(u16::from_le_bytes(len))
            }
            2 | 3 => {
                let mut len = [0; 4];
                fill(from, &mut len)?;
                u32::from_le_bytes(len)
            }
            other => return Err(format!("of version {other} of numpy's format; 1 to 3 are read")),
        };
        if len > HEADER_BYTES_MAX {
            return Err(format!("damaged (a header of {len} bytes)"));
        }
        let mut text = vec![0; len as usize];
        fill(from, &mut text)?;
        Self::parse(&String::from_utf8_lossy(&text))
    }

    /// Parses `{'descr': '<f4', 'fortran_order': False, 'shape': (3, 4), }`.
    fn parse(text: &str) -> Result<Self, String> {
        let damaged = || format!("damaged (header {:?})", text.trim());
        let descr = value(text, "descr").ok_or_else(damaged)?;
        let order = value(text, "fortran_order").ok_or_else(damaged)?;
        let shape = value(text, "shape").and_then(|rest| rest.strip_prefix('(')).ok_or_else(damaged)?;
        let (shape, _) = shape.split_once(')').ok_or_else(damaged)?;
        let sizes = shape.split(',').map(str::trim).filter(|size| !size.is_empty());
        let shape = sizes.map(|size| size.trim_end_matches('L').parse()).collect::<Result<Vec<usize>, _>>();
        let (kind, size, big_endian) = number_type(descr)?;
        Ok(Self {
            kind,
            size,
            big_endian,
            fortran: order.starts_with("True"),
            shape: shape.map_err(|_| damaged())?,
        })
    }

    /// How many numbers there are, unless they are too many to count.
    fn len(&self) -> Option<usize> {
        self.shape.iter().try_fold(1_usize, |product, size| product.checked_mul(*size))
    }

    /// Reads the numbers, of which there are as many as the shape says; the caller has checked that.
    pub(super) fn read_numbers(self, from: &mut impl Read) -> Result<Array, String> {
        let bytes = self.len().and_then(|len| len.checked_mul(self.size));
        let bytes = bytes.filter(|bytes| *bytes as u64 <= EPISODE_BYTES_MAX);
        let bytes = bytes.ok_or_else(|| format!("of shape {:?}, too large for an episode", self.shape))?;
        let mut data = Vec::new();
        from.take(bytes as u64).read_to_end(&mut data).map_err(|error| format!("damaged ({error})"))?;
        if data.len() < bytes {
            return Err(format!("cut off: {} of {bytes} bytes are there", data.len()));
        }
        Ok(Array { header: self, data })
    }
}

/// The text behind `'key':`.
fn value<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    ["'", "\""].into_iter().find_map(|quote| {
        let (_, rest) = text.split_once(&format!("{quote}{key}{quote}"))?;
        Some(rest.trim_start().strip_prefix(':')?.trim_start())
    })
}

/// The type behind a description such as `'<f4'`: what, bytes of a number, whether the most significant comes first.
fn number_type(descr: &str) -> Result<(Kind, usize, bool), String> {
    let quoted = descr.strip_prefix(['\'', '"']).and_then(|rest| rest.split(['\'', '"']).next());
    let Some(name) = quoted else {
        return Err("a structured array, with several fields a step; expected one number each".into());
    };
    let plain = name.trim_start_matches(['<', '>', '=', '|']);
    let (kind, size) = match plain {
        "?" | "b1" => (Kind::Bool, 1),
        "u1" | "u2" | "u4" | "u8" => (Kind::Unsigned, usize::from(plain.as_bytes()[1] - b'0')),
        "i1" | "i2" | "i4" | "i8" => (Kind::Signed, usize::from(plain.as_bytes()[1] - b'0')),
        "f2" | "f4" | "f8" => (Kind::Float, usize::from(plain.as_bytes()[1] - b'0')),
        _ if plain.starts_with('O') => {
            return Err("of Python objects (pickled); numpy reads it only with allow_pickle".into());
        }
        _ => return Err(format!("of numpy's type {name:?}")),
    };
    Ok((kind, size, name.starts_with('>')))
}

fn fill(from: &mut impl Read, bytes: &mut [u8]) -> Result<(), String> {
    from.read_exact(bytes).map_err(|error| format!("damaged ({error})"))
}

/// Numbers of any type.
pub(super) struct Array {
    header: Header,
    data: Vec<u8>,
}

impl Array {
    /// Whether the numbers are floating-point ones.
    pub(super) fn is_float(&self) -> bool {
        self.header.kind == Kind::Float
    }

    /// Every number, in the order of the file.
    pub(super) fn numbers(&self) -> impl Iterator<Item = f64> {
        let Header { kind, size, big_endian, .. } = self.header;
        self.data.chunks_exact(size).map(move |bytes| number(kind, big_endian, bytes))
    }

    /// Every number as `convert` makes it, in its place.
    pub(super) fn map<T: Clone>(&self, convert: impl Fn(f64) -> T) -> ArrayD<T> {
        shaped(&self.header, self.numbers().map(convert).collect())
    }

    /// Whole numbers from 0 to 255, or what is there instead.
    pub(super) fn into_bytes(self) -> Result<ArrayD<u8>, String> {
        if let (Kind::Unsigned, 1) = (self.header.kind, self.header.size) {
            return Ok(shaped(&self.header, self.data));
        }
        if self.is_float() {
            return Err("of floating-point numbers; store whole ones from 0 to 255 (times 255, uint8)".into());
        }
        match self.numbers().find(|number| !(0.0..=255.0).contains(number)) {
            Some(beyond) => Err(format!("beyond 0 to 255 ({beyond})")),
            None => Ok(self.map(|number| number as u8)),
        }
    }
}

fn shaped<T: Clone>(header: &Header, numbers: Vec<T>) -> ArrayD<T> {
    let shape = IxDyn(&header.shape).set_f(header.fortran);
    let array = ArrayD::from_shape_vec(shape, numbers).expect("as many numbers were read as the shape says");
    if header.fortran { array.as_standard_layout().into_owned() } else { array }
}

fn number(kind: Kind, big_endian: bool, bytes: &[u8]) -> f64 {
    let mut word = [0; 8];
    word[..bytes.len()].copy_from_slice(bytes);
    if big_endian {
        word[..bytes.len()].reverse();
    }
    let bits = u64::from_le_bytes(word);
    // Unused high bits of a signed number are shifted out and the sign back in.
    let spare = 64 - 8 * bytes.len() as u32;
    match (kind, bytes.len()) {
        (Kind::Bool, _) => f64::from(u8::from(bits != 0)),
        (Kind::Unsigned, _) => bits as f64,
        (Kind::Signed, _) => (((bits << spare) as i64) >> spare) as f64,
        (Kind::Float, 2) => f64::from(f16::from_bits(bits as u16)),
        (Kind::Float, 4) => f64::from(f32::from_bits(bits as u32)),
        (Kind::Float, _) => f64::from_bits(bits),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An array's file, with this header and these bytes.
    fn file(version: u8, header: &str, data: &[u8]) -> Vec<u8> {
        let mut file = b"\x93NUMPY".to_vec();
        file.extend([version, 0]);
        match version {
            1 => file.extend((header.len() as u16).to_le_bytes()),
            _ => file.extend((header.len() as u32).to_le_bytes()),
        }
        file.extend(header.as_bytes());
        file.extend(data);
        file
    }

    fn read(file: &[u8]) -> Result<ArrayD<f64>, String> {
        let mut from = file;
        Ok(Header::read(&mut from)?.read_numbers(&mut from)?.map(|number| number))
    }

    fn dict(descr: &str, fortran: &str, shape: &str) -> String {
        format!("{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': {shape}, }}\n")
    }

    #[test]
    fn every_numeric_type_in_either_byte_order_gives_its_numbers() {
        for (descr, bytes, expected) in [
            ("|b1", vec![0, 1], [0.0, 1.0]),
            ("|u1", vec![7, 255], [7.0, 255.0]),
            ("|i1", vec![7, 255], [7.0, -1.0]),
            ("<u2", vec![1, 2, 0xff, 0xff], [513.0, 65535.0]),
            (">i2", vec![1, 2, 0xff, 0xfe], [258.0, -2.0]),
            ("<i4", [3_i32, -4].map(i32::to_le_bytes).concat(), [3.0, -4.0]),
            (">u4", [3_u32, 4].map(u32::to_be_bytes).concat(), [3.0, 4.0]),
            (">i8", [5_i64, -6].map(i64::to_be_bytes).concat(), [5.0, -6.0]),
            ("<f2", [0x3c00_u16, 0xc100].map(u16::to_le_bytes).concat(), [1.0, -2.5]),
            (">f2", [0x3c00_u16, 0xc100].map(u16::to_be_bytes).concat(), [1.0, -2.5]),
            (">f4", [0.5_f32, -2.0].map(f32::to_be_bytes).concat(), [0.5, -2.0]),
            ("=f8", [0.1_f64, 1e300].map(f64::to_le_bytes).concat(), [0.1, 1e300]),
        ] {
            for version in [1, 2, 3] {
                let found = read(&file(version, &dict(descr, "False", "(2,)"), &bytes));
                assert_eq!(
                    found.unwrap().into_raw_vec_and_offset().0,
                    expected,
                    "{descr}, version {version}"
                );
            }
        }
    }

    #[test]
    fn fortran_order_shapes_of_python_2_and_headers_of_odd_length_are_read() {
        let numbers: Vec<u8> = (0..6).collect();
        let c = read(&file(1, &dict("|u1", "False", "(2, 3)"), &numbers)).unwrap();
        let f = read(&file(1, &dict("|u1", "True", "(2L, 3L)"), &numbers)).unwrap();
        assert_eq!(c[[1, 0]], 3.0);
        assert_eq!(f[[1, 0]], 1.0);
        assert!(f.is_standard_layout(), "rows first, whatever the file's order");
        let odd = "{\"shape\":(1,),\"fortran_order\":False,\"descr\":\"|u1\"}";
        assert_eq!(read(&file(1, odd, &[9])).unwrap()[[0]], 9.0);
    }

    #[test]
    fn what_is_no_plain_array_of_numbers_is_refused_with_what_it_is() {
        let refused = |descr: &str| {
            let header = format!("{{'descr': {descr}, 'fortran_order': False, 'shape': (1,)}}");
            read(&file(1, &header, &[0; 16])).unwrap_err()
        };
        assert!(refused("'|O'").contains("Python objects"));
        assert!(refused("[('a', '<f4')]").contains("structured"));
        assert!(refused("'<c8'").contains("<c8") && refused("'<U3'").contains("<U3"));
        let huge = dict("<f8", "False", "(4611686018427387904, 4)");
        assert!(read(&file(1, &huge, &[])).unwrap_err().contains("too large"));
        let cut = read(&file(1, &dict("<f8", "False", "(4,)"), &[0; 31])).unwrap_err();
        assert!(cut.contains("31 of 32 bytes"), "{cut}");
        for broken in ["", "{'descr': '<f4'}", "{'descr': '<f4', 'fortran_order': False, 'shape': (x,)}"] {
            assert!(read(&file(1, broken, &[0; 16])).unwrap_err().contains("damaged"), "{broken}");
        }
        assert!(read(b"PK\x03\x04 not an array").unwrap_err().contains("no array of numpy"));
    }
}
