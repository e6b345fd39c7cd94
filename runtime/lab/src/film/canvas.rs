//! A small picture to put panels, bars and letters on.

use std::borrow::Cow;

/// Width of a letter with the space after it, in pixels.
pub(super) const LETTER_WIDTH: usize = 4;
/// Height of a letter, in pixels.
pub(super) const LETTER_HEIGHT: usize = 5;

/// What is behind everything.
pub(super) const BACKGROUND: [u8; 3] = [18, 20, 26];

/// An RGB picture, rows first.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Canvas {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) rgb: Vec<u8>,
}

impl Canvas {
    pub(super) fn new(width: usize, height: usize, colour: [u8; 3]) -> Self {
        Self { width, height, rgb: colour.repeat(width * height) }
    }

    /// Sets a pixel; one outside the picture is ignored.
    fn put(&mut self, x: usize, y: usize, colour: [u8; 3]) {
        if x < self.width && y < self.height {
            let at = 3 * (y * self.width + x);
            self.rgb[at..at + 3].copy_from_slice(&colour);
        }
    }

    pub(super) fn fill(&mut self, x: usize, y: usize, width: usize, height: usize, colour: [u8; 3]) {
        for row in y..y + height {
            for column in x..x + width {
                self.put(column, row, colour);
            }
        }
    }

    /// Puts a picture of these rows and columns, as large as it fits into a square of `side` pixels, with its upper left corner at (x, y).
    pub(super) fn image(
        &mut self,
        [x, y]: [usize; 2],
        side: usize,
        [rows, columns]: [usize; 2],
        pixel: impl Fn(usize) -> [u8; 3],
    ) {
        let longest = rows.max(columns).max(1);
        let shown = |length: usize| (length * side / longest).max(1);
        for row in 0..shown(rows) {
            for column in 0..shown(columns) {
                let at = (row * longest / side) * columns + column * longest / side;
                self.put(x + column, y + row, pixel(at));
            }
        }
    }

    /// Puts another canvas with its upper left corner at (x, y).
    pub(super) fn paste(&mut self, x: usize, y: usize, other: &Self) {
        for (at, pixel) in other.rgb.as_chunks::<3>().0.iter().enumerate() {
            self.put(x + at % other.width, y + at / other.width, *pixel);
        }
    }

    /// The same on a canvas of this size, in its upper left corner.
    pub(super) fn grown(&self, width: usize, height: usize) -> Cow<'_, Self> {
        if (self.width, self.height) == (width, height) {
            return Cow::Borrowed(self);
        }
        let mut large = Self::new(width, height, BACKGROUND);
        large.paste(0, 0, self);
        Cow::Owned(large)
    }

    /// The square of `side` pixels with its upper left corner at (x, y), all of which is inside.
    pub(super) fn part(&self, [x, y]: [usize; 2], side: usize) -> Self {
        let row = |row: usize| {
            let at = 3 * (row * self.width + x);
            &self.rgb[at..at + 3 * side]
        };
        Self { width: side, height: side, rgb: (y..y + side).flat_map(row).copied().collect() }
    }

    /// Writes capital letters, digits and a few signs; anything else is a space.
    pub(super) fn text(&mut self, x: usize, y: usize, text: &str, colour: [u8; 3]) {
        for (index, letter) in text.chars().enumerate() {
            for (row, bits) in glyph(letter).into_iter().enumerate() {
                for column in (0..3).filter(|column| bits >> (2 - column) & 1 == 1) {
                    self.put(x + index * LETTER_WIDTH + column, y + row, colour);
                }
            }
        }
    }

    /// The picture with every pixel repeated `scale` times both ways.
    pub(super) fn enlarged(&self, scale: usize) -> Self {
        let pixels = self.rgb.as_chunks::<3>().0;
        let rgb = enlarge(pixels, self.width, scale).into_iter().flatten().collect();
        Self { width: self.width * scale, height: self.height * scale, rgb }
    }
}

/// Repeats every element `scale` times both ways.
pub(super) fn enlarge<T: Copy>(pixels: &[T], width: usize, scale: usize) -> Vec<T> {
    let mut large = Vec::with_capacity(pixels.len() * scale * scale);
    for row in pixels.chunks_exact(width) {
        let start = large.len();
        for pixel in row {
            large.extend(std::iter::repeat_n(*pixel, scale));
        }
        let end = large.len();
        for _ in 1..scale {
            large.extend_from_within(start..end);
        }
    }
    large
}

/// Five rows of three pixels; the highest of three bits is the left one.
fn glyph(letter: char) -> [u8; LETTER_HEIGHT] {
    match letter {
        'A' => [2, 5, 7, 5, 5],
        'B' => [6, 5, 6, 5, 6],
        'C' => [3, 4, 4, 4, 3],
        'D' => [6, 5, 5, 5, 6],
        'E' => [7, 4, 6, 4, 7],
        'F' => [7, 4, 6, 4, 4],
        'G' => [3, 4, 5, 5, 3],
        'H' => [5, 5, 7, 5, 5],
        'I' => [7, 2, 2, 2, 7],
        'J' => [1, 1, 1, 5, 2],
        'K' => [5, 5, 6, 5, 5],
        'L' => [4, 4, 4, 4, 7],
        'M' => [5, 7, 5, 5, 5],
        'N' => [6, 5, 5, 5, 5],
        'O' => [2, 5, 5, 5, 2],
        'P' => [6, 5, 6, 4, 4],
        'Q' => [2, 5, 5, 6, 3],
        'R' => [6, 5, 6, 5, 5],
        'S' => [3, 4, 2, 1, 6],
        'T' => [7, 2, 2, 2, 2],
        'U' => [5, 5, 5, 5, 7],
        'V' => [5, 5, 5, 5, 2],
        'W' => [5, 5, 7, 7, 5],
        'X' => [5, 5, 2, 5, 5],
        'Y' => [5, 5, 2, 2, 2],
        'Z' => [7, 1, 2, 4, 7],
        '0' => [7, 5, 5, 5, 7],
        '1' => [2, 6, 2, 2, 7],
        '2' => [7, 1, 7, 4, 7],
        '3' => [7, 1, 7, 1, 7],
        '4' => [5, 5, 7, 1, 1],
        '5' => [7, 4, 7, 1, 7],
        '6' => [7, 4, 7, 5, 7],
        '7' => [7, 1, 1, 1, 1],
        '8' => [7, 5, 7, 5, 7],
        '9' => [7, 5, 7, 1, 7],
        '-' => [0, 0, 7, 0, 0],
        '.' => [0, 0, 0, 0, 2],
        ':' => [0, 2, 0, 2, 0],
        _ => [0; LETTER_HEIGHT],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn enlarging_repeats_pixels_both_ways() {
        assert_eq!(enlarge(&[1, 2, 3, 4], 2, 2), [1, 1, 2, 2, 1, 1, 2, 2, 3, 3, 4, 4, 3, 3, 4, 4]);
    }

    #[test]
    fn pictures_of_any_size_fill_a_square_along_their_longer_side() {
        for (rows, columns, filled) in [(8, 8, (8, 8)), (16, 32, (4, 8)), (2, 1, (8, 4)), (4000, 3, (8, 1))] {
            let mut canvas = Canvas::new(10, 10, [0; 3]);
            canvas.image([1, 1], 8, [rows, columns], |pixel| {
                assert!(pixel < rows * columns);
                [if pixel == 0 { 1 } else { 2 }; 3]
            });
            let part = canvas.part([1, 1], 8);
            let is_set = |x: usize, y: usize| part.rgb[3 * (8 * y + x)] > 0;
            let width = (0..8).filter(|x| is_set(*x, 0)).count();
            assert_eq!(((0..8).filter(|y| is_set(0, *y)).count(), width), filled);
            assert_eq!(part.rgb[0], 1);
            assert_eq!(canvas.rgb.iter().filter(|byte| **byte > 0).count(), 3 * filled.0 * filled.1);
        }
    }

    #[test]
    fn what_leaves_the_picture_is_cut_off() {
        let mut canvas = Canvas::new(6, 4, [0; 3]);
        canvas.text(2, 1, "HH", [255; 3]);
        canvas.fill(4, 3, 10, 10, [9; 3]);
        assert_eq!(canvas.rgb.len(), 6 * 4 * 3);
        assert_eq!(&canvas.rgb[3 * (6 + 2)..3 * (6 + 3)], &[255; 3]);
        assert_eq!(&canvas.rgb[3 * (18 + 5)..], &[9; 3]);
    }
}
