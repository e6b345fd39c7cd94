//! Walks the opcodes of a pickle before candle builds its objects: a text of some hundred bytes can describe more objects than memory holds, or
//! nest them deeper than a stack.

use std::collections::HashMap;

/// Objects that a file may describe; a checkpoint of some thousand tensors has about a hundred thousand.
const OBJECTS_MAX: u64 = 4_000_000;
const DEPTH_MAX: u32 = 64;

/// What is known of an object: how deep it nests, and how many objects it holds.
#[derive(Debug, Clone, Copy)]
struct Size {
    depth: u32,
    objects: u64,
}

const LEAF: Size = Size { depth: 1, objects: 1 };

#[derive(Debug, Default)]
struct Walk {
    stack: Vec<Size>,
    marks: Vec<usize>,
    memo: HashMap<u32, Size>,
    made: u64,
}

/// Why candle should not be given this pickle, if anything.
pub(super) fn refused(bytes: &[u8]) -> Option<String> {
    Walk::default().walk(bytes).err()
}

impl Walk {
    fn walk(&mut self, bytes: &[u8]) -> Result<(), String> {
        let mut at = 0;
        let cut = || "it ends within an object".to_owned();
        let number = |at: usize, width: usize| {
            let bytes = bytes.get(at..at + width)?;
            Some(bytes.iter().rev().fold(0u64, |all, byte| all << 8 | u64::from(*byte)))
        };
        let line = |at: usize| bytes.get(at..)?.iter().position(|byte| *byte == b'\n').map(|end| end + 1);
        loop {
            let op = *bytes.get(at).ok_or_else(cut)?;
            at += 1;
            // How many bytes of argument follow.
            at += match op {
                0x80 | b'K' | b'q' | b'h' => 1,
                b'M' => 2,
                b'J' | b'r' | b'j' => 4,
                b'G' => 8,
                b'U' | 0x8a => 1 + number(at, 1).ok_or_else(cut)? as usize,
                b'X' | b'T' => 4 + number(at, 4).ok_or_else(cut)? as usize,
                b'c' => {
                    let module = line(at).ok_or_else(cut)?;
                    module + line(at + module).ok_or_else(cut)?
                }
                _ => 0,
            };
            let argument = |width: usize| number(at - width, width).unwrap_or_default() as u32;
            match op {
                b'.' => return Ok(()),
                0x80 => {}
                b'K' | b'M' | b'J' | b'G' | b'U' | 0x8a | b'X' | b'T' | b'c' | b'N' | 0x88 | 0x89 | b']'
                | b'}' | b')' => self.push(LEAF)?,
                b'(' => self.marks.push(self.stack.len()),
                b't' | b'l' | b'd' => {
                    let inner = self.since_mark()?;
                    self.push(inner)?;
                }
                0x85 => self.gather(1)?,
                0x86 | b'R' | 0x81 => self.gather(2)?,
                0x87 => self.gather(3)?,
                b'Q' => self.gather(1)?,
                b'a' | b'b' => self.add(1)?,
                b's' => self.add(2)?,
                b'e' | b'u' => {
                    let inner = self.since_mark()?;
                    self.stack.push(inner);
                    self.add(1)?;
                }
                b'q' => self.remember(argument(1))?,
                b'r' => self.remember(argument(4))?,
                b'h' => self.recall(argument(1))?,
                b'j' => self.recall(argument(4))?,
                b'0' => drop(self.pop()?),
                _ => {
                    return Err(format!(
                        "opcode {op:#04x} of another pickle protocol; load it in PyTorch and write it again with torch.save's default protocol"
                    ));
                }
            }
        }
    }

    fn push(&mut self, size: Size) -> Result<(), String> {
        self.made = self.made.saturating_add(size.objects);
        if size.depth > DEPTH_MAX || self.made > OBJECTS_MAX {
            return Err(format!("more than {OBJECTS_MAX} objects, or {DEPTH_MAX} within one another"));
        }
        self.stack.push(size);
        Ok(())
    }

    fn pop(&mut self) -> Result<Size, String> {
        self.stack.pop().ok_or_else(|| "its structure is damaged".to_owned())
    }

    /// The objects since the last mark, as one around them.
    fn since_mark(&mut self) -> Result<Size, String> {
        let mark = self.marks.pop().filter(|mark| *mark <= self.stack.len());
        let mark = mark.ok_or_else(|| "its structure is damaged".to_owned())?;
        Ok(self.stack.drain(mark..).fold(LEAF, around))
    }

    /// The last objects become one.
    fn gather(&mut self, count: usize) -> Result<(), String> {
        let mut all = LEAF;
        for _ in 0..count {
            all = around(all, self.pop()?);
        }
        self.push(all)
    }

    /// The last objects are put into the one before them.
    fn add(&mut self, count: usize) -> Result<(), String> {
        let mut all = LEAF;
        for _ in 0..count {
            all = around(all, self.pop()?);
        }
        let into = self.pop()?;
        self.push(around(into, all))
    }

    fn remember(&mut self, place: u32) -> Result<(), String> {
        let top = self.stack.last().copied().ok_or_else(|| "its structure is damaged".to_owned())?;
        self.made = self.made.saturating_add(top.objects);
        self.memo.insert(place, top);
        Ok(())
    }

    fn recall(&mut self, place: u32) -> Result<(), String> {
        let known = self.memo.get(&place).copied().ok_or_else(|| "its structure is damaged".to_owned())?;
        self.push(known)
    }
}

fn around(outer: Size, inner: Size) -> Size {
    Size { depth: outer.depth.max(inner.depth + 1), objects: outer.objects.saturating_add(inner.objects) }
}

#[cfg(test)]
mod tests {
    use super::refused;

    #[test]
    fn objects_that_double_and_objects_within_objects_are_refused() {
        // A tuple of the last one twice, forty times.
        let mut doubles = vec![0x80, 2, b'N', b'q', 0];
        for place in 0..40 {
            doubles.extend([b'h', place, b'h', place, 0x86, b'q', place + 1]);
        }
        doubles.push(b'.');
        assert!(refused(&doubles).unwrap().contains("objects"));
        let deep = [vec![b'N'], vec![0x85; 1000], vec![b'.']].concat();
        assert!(refused(&deep).unwrap().contains("within one another"));
        let fine = [vec![b'N'], vec![0x85; 10], vec![b'.']].concat();
        assert_eq!(refused(&fine), None);
    }

    #[test]
    fn what_is_cut_short_or_out_of_order_is_refused() {
        for bytes in [&b""[..], b"N", b"X\xff\xff\xff\xffabc.", b"t.", b"h\x07.", b"a.", b"\x95\x00."] {
            assert!(refused(bytes).is_some(), "{bytes:?}");
        }
    }
}
