//! A camera's picture in a terminal: two pixels a cell, one above the other.

use super::canvas::{Area, Canvas, Colour, Style};

/// What colours a terminal has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Colours {
    /// 24 bits a pixel
    #[value(name = "24bit")]
    True,
    /// A cube of 6 x 6 x 6 colours, and greys
    #[value(name = "256")]
    Indexed,
    /// Letters from dark to bright
    None,
}

/// Letters from dark to bright, where there are no colours.
const LETTERS: [char; 10] = [' ', '.', ':', '-', '=', '+', '*', '#', '%', '@'];

impl Colours {
    /// What the environment says of the terminal.
    #[must_use]
    pub fn of_terminal() -> Self {
        let variable = |name: &str| std::env::var(name).unwrap_or_default();
        Self::of(&variable("NO_COLOR"), &variable("COLORTERM"), &variable("TERM"))
    }

    fn of(no_color: &str, colorterm: &str, term: &str) -> Self {
        match (no_color, colorterm) {
            ("", "truecolor" | "24bit") => Self::True,
            ("", _) if term.contains("256") || term.contains("direct") => Self::Indexed,
            _ => Self::None,
        }
    }

    fn colour(self, [red, green, blue]: [u8; 3]) -> Option<Colour> {
        let level = |byte: u8| (u16::from(byte) * 5 + 127) / 255;
        let (r, g, b) = (level(red), level(green), level(blue));
        match self {
            Self::True => Some(Colour::True([red, green, blue])),
            // 24 greys lie closer together than those of the cube.
            Self::Indexed if r == g && g == b => {
                let grey = (u16::from(red) + u16::from(green) + u16::from(blue)) / 3;
                Some(Colour::Indexed(232 + (grey * 23 / 255) as u8))
            }
            Self::Indexed => Some(Colour::Indexed((16 + 36 * r + 6 * g + b) as u8)),
            Self::None => None,
        }
    }
}

/// Draws a picture as large as it fits, its sides in proportion; `size` is its rows and columns.
pub fn draw(to: &mut Canvas, area: Area, image: &[u8], [rows, columns]: [usize; 2], colours: Colours) {
    let (width, height) = (area.columns, area.rows * 2);
    if width == 0 || height == 0 || image.len() < rows * columns * 3 {
        return;
    }
    // Rows and columns on the screen: the larger share of the two that still fits.
    let (shown_columns, shown_rows) = match width * rows <= height * columns {
        true => (width, (width * rows / columns).max(1)),
        false => ((height * columns / rows).max(1), height),
    };
    let pixel =
        |row: usize, column: usize| mean(image, [rows, columns], [shown_rows, shown_columns], [row, column]);
    for cell_row in 0..shown_rows.div_ceil(2) {
        for column in 0..shown_columns {
            let upper = pixel(2 * cell_row, column);
            // Below the last row there is nothing.
            let lower = (2 * cell_row + 1 < shown_rows).then(|| pixel(2 * cell_row + 1, column));
            let (letter, style) = if colours == Colours::None {
                let light = (brightness(upper) + brightness(lower.unwrap_or(upper))) / 2;
                (LETTERS[light * (LETTERS.len() - 1) / 255], Style::default())
            } else {
                let back = lower.and_then(|lower| colours.colour(lower));
                ('▀', Style { front: colours.colour(upper), back, bold: false })
            };
            to.put(area.column + column, area.row + cell_row, letter, style);
        }
    }
}

fn brightness([red, green, blue]: [u8; 3]) -> usize {
    (usize::from(red) * 3 + usize::from(green) * 6 + usize::from(blue)) / 10
}

/// The mean of all pixels that become this one; where the picture grows, the one that it lies in.
fn mean(image: &[u8], of: [usize; 2], to: [usize; 2], at: [usize; 2]) -> [u8; 3] {
    let range = |side: usize| {
        let begin = at[side] * of[side] / to[side];
        begin..((at[side] + 1) * of[side] / to[side]).max(begin + 1)
    };
    let (rows, columns) = (range(0), range(1));
    let count = (rows.len() * columns.len()) as u32;
    let mut sum = [0_u32; 3];
    for row in rows {
        for column in columns.clone() {
            let at = (row * of[1] + column) * 3;
            sum.iter_mut().zip(&image[at..at + 3]).for_each(|(sum, byte)| *sum += u32::from(*byte));
        }
    }
    sum.map(|sum| (sum / count) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_environment_says_what_colours_there_are() {
        assert_eq!(Colours::of("", "truecolor", "xterm"), Colours::True);
        assert_eq!(Colours::of("", "", "tmux-256color"), Colours::Indexed);
        assert_eq!(Colours::of("", "", "linux"), Colours::None);
        assert_eq!(Colours::of("1", "truecolor", "xterm-256color"), Colours::None);
    }

    #[test]
    fn two_pixels_share_a_cell_and_sides_keep_their_proportion() {
        // Four rows of two columns: red, green, blue, white.
        let rows = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255; 3]];
        let image: Vec<u8> = rows.iter().flat_map(|row| [*row; 2]).flatten().collect();
        let mut canvas = Canvas::new(9, 2);
        let area = canvas.area();
        draw(&mut canvas, area, &image, [4, 2], Colours::True);
        let cell = |column, row| (canvas.style(column, row).front, canvas.style(column, row).back);
        let colour = |rgb| Some(Colour::True(rgb));
        assert_eq!(cell(1, 0), (colour([255, 0, 0]), colour([0, 255, 0])));
        assert_eq!(cell(1, 1), (colour([0, 0, 255]), colour([255; 3])));
        assert_eq!(canvas.row(0), "▀▀       ", "twice as high as wide");
    }

    #[test]
    fn fewer_colours_are_the_nearest_and_none_are_letters() {
        for (rgb, number) in [([255, 0, 0], 196), ([0; 3], 232), ([255; 3], 255)] {
            assert_eq!(Colours::Indexed.colour(rgb), Some(Colour::Indexed(number)), "{rgb:?}");
        }
        let mut canvas = Canvas::new(2, 1);
        let area = canvas.area();
        let image = [0, 0, 0, 255, 255, 255, 0, 0, 0, 255, 255, 255];
        draw(&mut canvas, area, &image, [2, 2], Colours::None);
        assert_eq!(canvas.row(0), " @");
    }

    #[test]
    fn a_picture_that_shrinks_is_the_mean_of_its_pixels() {
        let image = [0, 0, 0, 100, 100, 100, 200, 200, 200, 100, 100, 100];
        assert_eq!(mean(&image, [2, 2], [1, 1], [0, 0]), [100; 3]);
    }
}
