use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::HostBatch;

/// By how many pixels pictures move, right and down; what was at the edge fills the gap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Shift {
    pub right: isize,
    pub down: isize,
}

impl Shift {
    /// The shift of row `row` of batch `number`: each way at most `pixels`, each equally likely.
    #[must_use]
    pub fn drawn(pixels: usize, seed: u64, number: u64, row: usize) -> Self {
        let mut generator = ChaCha8Rng::seed_from_u64(seed.rotate_left(17) ^ row as u64);
        generator.set_stream(number);
        let most = pixels as i64;
        let mut draw = || generator.random_range(-most..=most) as isize;
        Self { right: draw(), down: draw() }
    }

    /// Shifts pictures [..., side, side, channels] in place.
    pub fn apply(self, pictures: &mut [u8], side: usize, channels: usize) {
        if self == Self::default() {
            return;
        }
        let from = |at: usize, by: isize| at.saturating_add_signed(-by).min(side - 1);
        let mut before = vec![0; side * side * channels];
        for picture in pictures.chunks_exact_mut(before.len()) {
            before.copy_from_slice(picture);
            for (at, pixel) in picture.chunks_exact_mut(channels).enumerate() {
                let (row, column) = (from(at / side, self.down), from(at % side, self.right));
                let source = (row * side + column) * channels;
                pixel.copy_from_slice(&before[source..source + channels]);
            }
        }
    }
}

impl HostBatch {
    /// Shifts each row's pictures and masks by at most `pixels` each way, all steps of a row alike.
    pub fn shift(&mut self, pixels: usize, seed: u64, number: u64) {
        if pixels == 0 || self.rows == 0 {
            return;
        }
        let (side, area) = (self.side, self.length * self.side * self.side);
        let channels = |bytes: usize| bytes / (self.rows * area);
        let (channels, masks) = (channels(self.image.len()), channels(self.robot_mask.len()));
        for row in 0..self.rows {
            let shift = Shift::drawn(pixels, seed, number, row);
            let pixels = row * area * channels..(row + 1) * area * channels;
            shift.apply(&mut self.image[pixels.clone()], side, channels);
            if let Some(seen) = self.seen.get_mut(pixels) {
                shift.apply(seen, side, channels);
            }
            if masks > 0 {
                let pixels = row * area * masks..(row + 1) * area * masks;
                shift.apply(&mut self.robot_mask[pixels], side, masks);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENGTH: usize = 2;
    const SIDE: usize = 64;
    const AREA: usize = SIDE * SIDE;

    fn batch() -> HostBatch {
        let number = |at: usize, every: usize| (at / every % 251) as u8;
        HostBatch {
            rows: 2,
            length: LENGTH,
            side: SIDE,
            image: (0..2 * LENGTH * AREA * 3).map(|at| number(at, 3)).collect(),
            robot_mask: (0..2 * LENGTH * AREA).map(|at| number(at, 1)).collect(),
            ..HostBatch::default()
        }
    }

    #[test]
    fn a_picture_moves_and_its_edge_fills_the_gap() {
        let mut picture: Vec<u8> = (0..AREA).map(|at| (at / SIDE + 3 * (at % SIDE)) as u8).collect();
        let before = picture.clone();
        Shift { right: 2, down: -1 }.apply(&mut picture, SIDE, 1);
        let at = |picture: &[u8], row: usize, column: usize| picture[row * SIDE + column];
        assert_eq!(at(&picture, 10, 10), at(&before, 11, 8));
        assert_eq!(at(&picture, 10, 1), at(&before, 11, 0));
        assert_eq!(at(&picture, 63, 30), at(&before, 63, 28));
    }

    #[test]
    fn steps_of_a_row_move_alike_with_their_masks_and_rows_differ() {
        let mut shifted = batch();
        shifted.shift(4, 3, 9);
        let mut again = batch();
        again.shift(4, 3, 9);
        assert_eq!(shifted, again);
        let mut found = Vec::new();
        for row in 0..2 {
            let shift = Shift::drawn(4, 3, 9, row);
            assert!(shift.right.abs() <= 4 && shift.down.abs() <= 4);
            for step in 0..LENGTH {
                let start = (row * LENGTH + step) * AREA;
                let mut expected = batch().robot_mask[start..start + AREA].to_vec();
                shift.apply(&mut expected, SIDE, 1);
                assert_eq!(shifted.robot_mask[start..start + AREA], expected);
                let red = shifted.image[start * 3..].iter().step_by(3);
                assert!(red.take(AREA).eq(&expected));
            }
            found.push(shift);
        }
        assert_ne!(found[0], found[1]);
    }

    #[test]
    fn no_pixels_change_nothing() {
        let mut same = batch();
        same.shift(0, 3, 9);
        assert_eq!(same, batch());
    }
}
