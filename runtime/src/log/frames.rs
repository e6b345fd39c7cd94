//! Frames of a log: length, checksum, payload.

use std::io::{self, Read, Write};

use super::record::VERSION;

/// The first bytes of a log.
pub const MAGIC: [u8; 8] = *b"rcwm-log";
/// Largest payload of a frame, in bytes: far more than a tick of large cameras takes.
pub const PAYLOAD_BYTES_MAX: usize = 64 << 20;

/// What comes next in a file.
pub enum Next<'a> {
    /// A whole frame.
    Payload(&'a [u8]),
    /// The file ends here, between two frames.
    End,
    /// It goes on with something that is no frame.
    Damaged(String),
}

/// Writes what every log begins with.
pub fn write_start(to: &mut impl Write) -> io::Result<()> {
    to.write_all(&MAGIC)?;
    to.write_all(&VERSION.to_le_bytes())
}

/// Gives the frame's bytes. A payload that could not be read back is refused, and nothing of it is written.
pub fn write_frame(to: &mut impl Write, payload: &[u8]) -> io::Result<u64> {
    let found = payload.len();
    let len = u32::try_from(found).ok().filter(|_| found <= PAYLOAD_BYTES_MAX).ok_or_else(|| {
        io::Error::other(format!(
            "a tick of {found} bytes, at most {PAYLOAD_BYTES_MAX} can be read back; log fewer or smaller cameras"
        ))
    })?;
    to.write_all(&len.to_le_bytes())?;
    to.write_all(&crc32c::crc32c(payload).to_le_bytes())?;
    to.write_all(payload)?;
    Ok(8 + u64::from(len))
}

/// Reads frame after frame.
pub struct FrameReader<R> {
    from: R,
    payload: Vec<u8>,
    /// Where the next frame begins, in bytes.
    pub offset: u64,
}

impl<R: Read> FrameReader<R> {
    /// `offset` is how many bytes were read before.
    pub fn new(from: R, offset: u64) -> Self {
        Self { from, payload: Vec::new(), offset }
    }

    /// The next frame.
    pub fn read(&mut self) -> io::Result<Next<'_>> {
        let mut head = [0; 8];
        match read_up_to(&mut self.from, &mut head)? {
            0 => return Ok(Next::End),
            8 => {}
            found => return Ok(Next::Damaged(format!("the file ends {found} bytes into a record"))),
        }
        let number = |at: usize| u32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
        let (len, checksum) = (number(0) as usize, number(4));
        if len > PAYLOAD_BYTES_MAX {
            return Ok(Next::Damaged(format!(
                "a record of {len} bytes, at most {PAYLOAD_BYTES_MAX} are possible"
            )));
        }
        self.payload.resize(len, 0);
        let found = read_up_to(&mut self.from, &mut self.payload)?;
        if found < len {
            return Ok(Next::Damaged(format!(
                "the file ends within a record, {found} of {len} bytes are there"
            )));
        }
        if crc32c::crc32c(&self.payload) != checksum {
            return Ok(Next::Damaged("a record's checksum does not fit".into()));
        }
        self.offset += 8 + len as u64;
        Ok(Next::Payload(&self.payload))
    }
}

/// Reads until `to` is full or the file ends.
pub fn read_up_to(from: &mut impl Read, to: &mut [u8]) -> io::Result<usize> {
    let mut filled = 0;
    while filled < to.len() {
        match from.read(&mut to[filled..]) {
            Ok(0) => break,
            Ok(count) => filled += count,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(filled)
}
