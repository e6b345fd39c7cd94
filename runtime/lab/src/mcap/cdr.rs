//! ROS 2's encoding of messages: XCDR1, little-endian. Every number begins at a multiple of its size, counted behind the first 4 bytes.

/// What every message begins with: plain CDR, little-endian, no options.
const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];

/// A message that is being encoded, field after field.
#[derive(Debug)]
pub(super) struct Cdr(Vec<u8>);

impl Cdr {
    pub(super) fn new() -> Self {
        Self(ENCAPSULATION.to_vec())
    }

    pub(super) fn u8(mut self, value: u8) -> Self {
        self.0.push(value);
        self
    }

    pub(super) fn i32(self, value: i32) -> Self {
        self.number(value.to_le_bytes())
    }

    pub(super) fn u32(self, value: u32) -> Self {
        self.number(value.to_le_bytes())
    }

    /// Its bytes and a zero, counted before.
    pub(super) fn string(self, text: &str) -> Self {
        let mut this = self.len(text.len() + 1);
        this.0.extend_from_slice(text.as_bytes());
        this.u8(0)
    }

    pub(super) fn strings(self, texts: &[String]) -> Self {
        texts.iter().fold(self.len(texts.len()), |this, text| this.string(text))
    }

    pub(super) fn bytes(self, bytes: &[u8]) -> Self {
        let mut this = self.len(bytes.len());
        this.0.extend_from_slice(bytes);
        this
    }

    /// Widened without loss.
    pub(super) fn f64s(self, values: &[f32]) -> Self {
        let this = self.len(values.len());
        values.iter().fold(this, |this, value| this.number(f64::from(*value).to_le_bytes()))
    }

    pub(super) fn finish(self) -> Vec<u8> {
        self.0
    }

    /// How many follow. Nothing here has four thousand million: messages are bounded by the interface.
    fn len(self, count: usize) -> Self {
        self.u32(u32::try_from(count).unwrap_or(u32::MAX))
    }

    fn number<const N: usize>(mut self, bytes: [u8; N]) -> Self {
        let end = self.0.len() - ENCAPSULATION.len();
        self.0.resize(ENCAPSULATION.len() + end.next_multiple_of(N), 0);
        self.0.extend_from_slice(&bytes);
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_begin_at_multiples_of_their_size_behind_the_first_four_bytes() {
        let bytes = Cdr::new().u8(7).u32(1).f64s(&[1.5]).finish();
        let mut expected = vec![0, 1, 0, 0];
        expected.extend([7, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0]);
        expected.extend(1.5_f64.to_le_bytes());
        assert_eq!(bytes, expected);
    }

    #[test]
    fn no_number_is_filled_up_to_where_none_follows() {
        assert_eq!(Cdr::new().f64s(&[]).u32(9).finish(), [0, 1, 0, 0, 0, 0, 0, 0, 9, 0, 0, 0]);
        assert_eq!(
            Cdr::new().string("ab").bytes(&[5]).finish()[4..],
            [3, 0, 0, 0, b'a', b'b', 0, 0, 1, 0, 0, 0, 5]
        );
    }
}
