use std::path::Path;

use candle_core::{D, Tensor};
use image::{Rgb, RgbImage};

use super::film::{CELL, GAP, LETTERS, STEP_CS, WORDS_HEIGHT, colours, draw, lifted, values};
use super::response::OtherActions;
use crate::model::world::Decoded;
use crate::plots::{Colour, INK, PAPER, PlotError, text_width, write_gif, write_png, write_text};

/// What the columns of a frame show; the last two are missing in a model with one branch.
const COLUMNS: [&str; 4] = ["true", "imagined", "robot", "environment"];
/// Rows of a frame: by the recorded actions, by the others, and how far these are apart.
const ROWS: usize = 3;
/// The panels of a strip, by row and column of a frame.
const STRIP: [(usize, usize); 8] = [(0, 0), (0, 1), (0, 3), (1, 1), (1, 3), (2, 0), (2, 1), (2, 3)];

/// Two imaginations from one start: by the recorded actions and by others. Beside the first stands what truly happened, beside the
/// second the last picture that was seen.
#[derive(Debug, Clone)]
pub struct ResponseFilm {
    /// By imagined step, row and column.
    steps: Vec<[Vec<Vec<Colour>>; ROWS]>,
    context: usize,
    other: OtherActions,
}

impl ResponseFilm {
    /// The film of one row of a batch: `truth` u8 [B, T, S, S, 3 C], and what was imagined of its first `steps` steps but the context's.
    pub fn of(
        truth: &Tensor,
        (recorded, imagined): (&Decoded, &Decoded),
        other: OtherActions,
        row: usize,
        (context, steps): (usize, usize),
    ) -> candle_core::Result<Self> {
        let (truth, cameras) = (truth.get(row)?, truth.dim(D::Minus1)? / 3);
        let pictures = |decoded: &Decoded| -> candle_core::Result<Vec<Tensor>> {
            let branches = if decoded.pictures.len() > 1 { decoded.pictures.as_slice() } else { &[] };
            let branches = branches.iter().map(|picture| picture.masked()?.get(row));
            std::iter::once(decoded.image.get(row)).chain(branches).collect()
        };
        let (recorded, imagined) = (pictures(recorded)?, pictures(imagined)?);
        let true_at = |t: usize| -> candle_core::Result<Vec<f32>> {
            Ok(values(&truth, t)?.into_iter().map(|x| x / 255.0).collect())
        };
        let at = |pictures: &[Tensor], t: usize| -> candle_core::Result<Vec<Vec<f32>>> {
            pictures.iter().map(|picture| Ok(lifted(values(picture, t)?))).collect()
        };
        let seen = true_at(context - 1)?;
        let step = |t: usize| {
            let first: Vec<_> = std::iter::once(true_at(t)?).chain(at(&recorded, t - context)?).collect();
            let second: Vec<_> = std::iter::once(seen.clone()).chain(at(&imagined, t - context)?).collect();
            let apart =
                |(a, b): (&Vec<f32>, &Vec<f32>)| a.iter().zip(b).map(|(a, b)| (a - b).abs()).collect();
            let third: Vec<Vec<f32>> = first.iter().zip(&second).map(apart).collect();
            Ok([first, second, third]
                .map(|row| row.iter().map(|picture| colours(picture, cameras)).collect()))
        };
        let steps = (context..steps).map(step).collect::<candle_core::Result<_>>()?;
        Ok(Self { steps, context, other })
    }

    /// The frames of a film, an imagined step each.
    pub fn frames(&self) -> Result<Vec<RgbImage>, PlotError> {
        let labels = self.labels();
        let left = widest(labels.iter())? + 2 * GAP;
        let columns = self.columns();
        let (width, height) =
            (left + columns as u32 * (CELL + GAP), 2 * WORDS_HEIGHT + ROWS as u32 * (CELL + GAP));
        let mut empty = RgbImage::from_pixel(width, height, Rgb(PAPER));
        for (column, title) in COLUMNS.iter().take(columns).enumerate() {
            let x = left + column as u32 * (CELL + GAP);
            write_text(&mut empty, (x as i32, WORDS_HEIGHT as i32 + 2), LETTERS, INK, title)?;
        }
        let top = |row: usize| 2 * WORDS_HEIGHT + row as u32 * (CELL + GAP);
        for (row, label) in labels.iter().enumerate() {
            let y = top(row) + CELL / 2 - LETTERS / 2;
            write_text(&mut empty, (GAP as i32, y as i32), LETTERS, INK, label)?;
        }
        let frame = |(t, step): (usize, &[Vec<Vec<Colour>>; ROWS])| {
            let mut frame = empty.clone();
            write_text(&mut frame, (GAP as i32, 3), LETTERS, INK, &self.describe(t))?;
            for (row, pictures) in step.iter().enumerate() {
                for (column, picture) in pictures.iter().enumerate() {
                    let x = left + column as u32 * (CELL + GAP);
                    draw(&mut frame, (x, top(row)), picture, column > 0 && row < 2);
                }
            }
            Ok(frame)
        };
        self.steps.iter().enumerate().map(frame).collect()
    }

    /// A picture with a row a panel; time goes right, one imagined step in `every` and the last one are shown.
    pub fn strip(&self, every: usize) -> Result<RgbImage, PlotError> {
        let last = self.steps.len().saturating_sub(1);
        let shown: Vec<usize> = (0..last).step_by(every.max(1)).chain([last]).collect();
        let rows: Vec<_> = STRIP.iter().filter(|(_, column)| *column < self.columns()).collect();
        let labels = self.labels();
        let title = |(row, column): &(usize, usize)| match (row, column) {
            (0, 0) => COLUMNS[0].to_owned(),
            _ => format!("{}: {}", labels[*row], COLUMNS[*column]),
        };
        let titles: Vec<String> = rows.iter().map(|place| title(place)).collect();
        let left = widest(titles.iter())? + 2 * GAP;
        let width = left + shown.len() as u32 * (CELL + GAP);
        let height = WORDS_HEIGHT + rows.len() as u32 * (CELL + GAP);
        let mut strip = RgbImage::from_pixel(width, height, Rgb(PAPER));
        let top = |place: usize| WORDS_HEIGHT + place as u32 * (CELL + GAP);
        for (place, title) in titles.iter().enumerate() {
            let y = top(place) + CELL / 2 - LETTERS / 2;
            write_text(&mut strip, (GAP as i32, y as i32), LETTERS, INK, title)?;
        }
        for (index, t) in shown.into_iter().enumerate() {
            let x = left + index as u32 * (CELL + GAP);
            write_text(&mut strip, (x as i32, 3), LETTERS, INK, &self.describe(t))?;
            let Some(step) = self.steps.get(t) else { continue };
            for (place, (row, column)) in rows.iter().enumerate() {
                draw(&mut strip, (x, top(place)), &step[*row][*column], *column > 0 && *row < 2);
            }
        }
        Ok(strip)
    }

    /// Writes the strip as PNG, with one step in `every`.
    pub fn write_strip(&self, every: usize, path: &Path) -> Result<(), PlotError> {
        write_png(&self.strip(every)?, path)
    }

    /// Writes the film as GIF.
    pub fn write_gif(&self, path: &Path) -> Result<(), PlotError> {
        write_gif(&self.frames()?, STEP_CS, path)
    }

    fn labels(&self) -> [&'static str; ROWS] {
        ["recorded", self.other.title(), "difference"]
    }

    fn columns(&self) -> usize {
        self.steps.first().map_or(0, |step| step[0].len())
    }

    fn describe(&self, t: usize) -> String {
        format!("{}: imagined", self.context + t)
    }
}

fn widest<T: AsRef<str>>(titles: impl Iterator<Item = T>) -> Result<u32, PlotError> {
    let widths = titles.map(|title| text_width(LETTERS, title.as_ref())).collect::<Result<Vec<_>, _>>()?;
    Ok(widths.into_iter().max().unwrap_or(0))
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Device};

    use super::*;
    use crate::model::decoder::Picture;
    use crate::plots::IMAGINED;

    #[test]
    fn a_film_shows_both_imaginations_and_how_far_they_are_apart() {
        let device = Device::Cpu;
        let truth: Vec<u8> = [0u8, 51, 255].into_iter().flat_map(|level| [level; 64 * 64 * 3]).collect();
        let truth = Tensor::from_vec(truth, (1, 3, 64, 64, 3), &device).unwrap();
        let decoded = |level: f64| {
            let image = Tensor::full(level as f32, (1, 1, 64, 64, 3), &device).unwrap();
            let mask = Tensor::ones((1, 1, 64, 64, 1), DType::F32, &device).unwrap();
            let pictures = vec![
                Picture { image: image.clone(), mask: mask.clone() },
                Picture { image: image.clone(), mask },
            ];
            Decoded { image, pictures }
        };
        let (recorded, other) = (decoded(0.3), decoded(-0.1));
        let film = ResponseFilm::of(&truth, (&recorded, &other), OtherActions::Still, 0, (2, 3)).unwrap();
        let found = |row: usize| film.steps[0][row].iter().map(|picture| picture[0][0]).collect::<Vec<u8>>();
        assert_eq!(film.steps.len(), 1);
        assert_eq!(found(0), [255, 204, 204, 204]);
        assert_eq!(found(1), [51, 102, 102, 102], "beside it the last picture that was seen");
        assert_eq!(found(2), [204, 102, 102, 102]);
        let frames = film.frames().unwrap();
        assert!(frames[0].pixels().filter(|pixel| pixel.0 == IMAGINED).count() > 1000);
        let strip = film.strip(4).unwrap();
        assert!(strip.height() > 8 * CELL && strip.width() > CELL);
    }
}
