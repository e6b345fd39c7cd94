use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::{IMAGE_CHANNELS, IMAGE_SIDE};

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

    /// Shifts pictures [..., 64, 64, channels] in place.
    pub fn apply(self, pictures: &mut [u8], channels: usize) {
        if self == Self::default() {
            return;
        }
        let from = |at: usize, by: isize| at.saturating_add_signed(-by).min(IMAGE_SIDE - 1);
        let mut before = vec![0; IMAGE_SIDE * IMAGE_SIDE * channels];
        for picture in pictures.chunks_exact_mut(before.len()) {
            before.copy_from_slice(picture);
            for (at, pixel) in picture.chunks_exact_mut(channels).enumerate() {
                let (row, column) = (from(at / IMAGE_SIDE, self.down), from(at % IMAGE_SIDE, self.right));
                let source = (row * IMAGE_SIDE + column) * channels;
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
        let area = self.length * IMAGE_SIDE * IMAGE_SIDE;
        for row in 0..self.rows {
            let shift = Shift::drawn(pixels, seed, number, row);
            let pixels = row * area * IMAGE_CHANNELS..(row + 1) * area * IMAGE_CHANNELS;
            shift.apply(&mut self.image[pixels.clone()], IMAGE_CHANNELS);
            if let Some(seen) = self.seen.get_mut(pixels) {
                shift.apply(seen, IMAGE_CHANNELS);
            }
            if let Some(masks) = self.robot_mask.get_mut(row * area..(row + 1) * area) {
                shift.apply(masks, 1);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENGTH: usize = 2;
    const AREA: usize = IMAGE_SIDE * IMAGE_SIDE;

    fn batch() -> HostBatch {
        let number = |at: usize, every: usize| (at / every % 251) as u8;
        HostBatch {
            rows: 2,
            length: LENGTH,
            image: (0..2 * LENGTH * AREA * IMAGE_CHANNELS).map(|at| number(at, IMAGE_CHANNELS)).collect(),
            robot_mask: (0..2 * LENGTH * AREA).map(|at| number(at, 1)).collect(),
            ..HostBatch::default()
        }
    }

    #[test]
    fn a_picture_moves_and_its_edge_fills_the_gap() {
        let mut picture: Vec<u8> =
            (0..AREA).map(|at| (at / IMAGE_SIDE + 3 * (at % IMAGE_SIDE)) as u8).collect();
        let before = picture.clone();
        Shift { right: 2, down: -1 }.apply(&mut picture, 1);
        let at = |picture: &[u8], row: usize, column: usize| picture[row * IMAGE_SIDE + column];
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
                shift.apply(&mut expected, 1);
                assert_eq!(shifted.robot_mask[start..start + AREA], expected);
                let red = shifted.image[start * IMAGE_CHANNELS..].iter().step_by(IMAGE_CHANNELS);
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
