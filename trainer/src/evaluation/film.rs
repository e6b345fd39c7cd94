use std::path::Path;

use candle_core::{D, DType, Tensor};
use image::{Rgb, RgbImage};

use crate::model::world::Decoded;
use crate::plots::{Colour, IMAGINED, INK, PAPER, PlotError, text_width, write_gif, write_png, write_text};

/// How long a step of a film is shown, in hundredths of a second.
pub(super) const STEP_CS: u16 = 10;
/// Side of a picture on the screen: pictures of 64 are enlarged.
pub(super) const CELL: u32 = 128;
/// Between two pictures.
pub(super) const GAP: u32 = 4;
/// Thickness of the frame around imagined pictures.
const FRAME: u32 = 2;
pub(super) const LETTERS: u32 = 13;
/// Of a row of words.
pub(super) const WORDS_HEIGHT: u32 = 20;
/// What the panels show; the last two are missing in a model with one branch.
const TITLES: [&str; 7] =
    ["true", "imagined", "error", "robot", "robot mask", "environment", "environment mask"];

/// What a model saw and then imagined, beside the truth: for every step its panels. Of several cameras the first is
/// shown.
#[derive(Debug, Clone)]
pub struct Film {
    steps: Vec<Vec<Vec<Colour>>>,
    context: usize,
}

impl Film {
    /// The film of one row of a batch: `truth` u8 [B, T, S, S, 3 C] and what was decoded of the same steps.
    pub fn of(truth: &Tensor, decoded: &Decoded, row: usize, context: usize) -> candle_core::Result<Self> {
        let one = |x: &Tensor| x.get(row);
        let cameras = truth.dim(D::Minus1)? / 3;
        let colours = |values: &[f32]| colours(values, cameras);
        let branches =
            decoded.pictures.iter().map(|picture| Ok((one(&picture.masked()?)?, one(&picture.mask)?)));
        let branches = branches.collect::<candle_core::Result<Vec<_>>>()?;
        let (truth, imagined) = (one(truth)?, one(&decoded.image)?);
        let panels = |t: usize| {
            let truth: Vec<f32> = values(&truth, t)?.into_iter().map(|x| x / 255.0).collect();
            let imagined = lifted(values(&imagined, t)?);
            let error: Vec<f32> = truth.iter().zip(&imagined).map(|(a, b)| (a - b).abs()).collect();
            let mut panels = vec![colours(&truth), colours(&imagined), colours(&error)];
            for (picture, mask) in &branches {
                // Where the mask is 0 nothing is decoded: that is the middle grey, which the value 0 stands for.
                panels.push(colours(&lifted(values(picture, t)?)));
                let mask: Vec<f32> = values(mask, t)?.into_iter().flat_map(|x| [x; 3]).collect();
                panels.push(colours(&mask));
            }
            Ok(panels)
        };
        let steps = (0..truth.dim(0)?).map(panels).collect::<candle_core::Result<_>>()?;
        Ok(Self { steps, context })
    }

    /// A picture with a row a panel; time goes right, one step in `every` is shown, and what was imagined is framed.
    pub fn strip(&self, every: usize) -> Result<RgbImage, PlotError> {
        let shown: Vec<usize> = (0..self.steps.len()).step_by(every.max(1)).collect();
        let panels = self.panels();
        let titles = TITLES.iter().take(panels).map(|title| text_width(LETTERS, title));
        let left = titles.collect::<Result<Vec<_>, _>>()?.into_iter().max().unwrap_or(0) + 2 * GAP;
        let width = left + shown.len() as u32 * (CELL + GAP);
        let height = WORDS_HEIGHT + panels as u32 * (CELL + GAP);
        let mut strip = RgbImage::from_pixel(width, height, Rgb(PAPER));
        for (row, title) in TITLES.iter().take(panels).enumerate() {
            let y = WORDS_HEIGHT + row as u32 * (CELL + GAP) + CELL / 2 - LETTERS / 2;
            write_text(&mut strip, (GAP as i32, y as i32), LETTERS, INK, title)?;
        }
        for (column, t) in shown.into_iter().enumerate() {
            let x = left + column as u32 * (CELL + GAP);
            write_text(&mut strip, (x as i32, 3), LETTERS, INK, &self.describe(t))?;
            for (row, panel) in self.steps[t].iter().enumerate() {
                self.draw(&mut strip, (x, WORDS_HEIGHT + row as u32 * (CELL + GAP)), panel, t);
            }
        }
        Ok(strip)
    }

    /// The frames of a film, a step each, with the panels side by side.
    pub fn frames(&self) -> Result<Vec<RgbImage>, PlotError> {
        let panels = self.panels();
        let width = panels as u32 * (CELL + GAP) + GAP;
        let mut empty = RgbImage::from_pixel(width, 2 * WORDS_HEIGHT + CELL + GAP, Rgb(PAPER));
        let left = |panel: usize| GAP + panel as u32 * (CELL + GAP);
        for (panel, title) in TITLES.iter().take(panels).enumerate() {
            write_text(&mut empty, (left(panel) as i32, WORDS_HEIGHT as i32 + 2), LETTERS, INK, title)?;
        }
        let frame = |(t, pictures): (usize, &Vec<Vec<Colour>>)| {
            let mut frame = empty.clone();
            write_text(&mut frame, (GAP as i32, 3), LETTERS, INK, &self.describe(t))?;
            for (panel, picture) in pictures.iter().enumerate() {
                self.draw(&mut frame, (left(panel), 2 * WORDS_HEIGHT), picture, t);
            }
            Ok(frame)
        };
        self.steps.iter().enumerate().map(frame).collect()
    }

    /// Writes the strip as PNG, with one step in `every`.
    pub fn write_strip(&self, every: usize, path: &Path) -> Result<(), PlotError> {
        write_png(&self.strip(every)?, path)
    }

    /// Writes the film as GIF.
    pub fn write_gif(&self, path: &Path) -> Result<(), PlotError> {
        write_gif(&self.frames()?, STEP_CS, path)
    }

    fn panels(&self) -> usize {
        self.steps.first().map_or(0, Vec::len)
    }

    /// What the panel with this title shows at a step.
    pub(super) fn panel(&self, t: usize, title: &str) -> Option<&[Colour]> {
        let index = TITLES.iter().position(|known| *known == title)?;
        Some(self.steps.get(t)?.get(index)?)
    }

    pub(super) fn describe(&self, t: usize) -> String {
        if t < self.context { format!("{t}: seen") } else { format!("{t}: imagined") }
    }

    /// Draws what a panel shows at a step.
    pub(super) fn draw(&self, on: &mut RgbImage, place: (u32, u32), picture: &[Colour], t: usize) {
        draw(on, place, picture, t >= self.context);
    }
}

/// Draws a picture enlarged, with a frame if it was imagined.
pub(super) fn draw(on: &mut RgbImage, (left, top): (u32, u32), picture: &[Colour], imagined: bool) {
    if imagined {
        for y in 0..CELL + 2 * FRAME {
            for x in 0..CELL + 2 * FRAME {
                let (x, y) = ((left + x).checked_sub(FRAME), (top + y).checked_sub(FRAME));
                if let (Some(x), Some(y)) = (x, y)
                    && let Some(pixel) = on.get_pixel_mut_checked(x, y)
                {
                    *pixel = Rgb(IMAGINED);
                }
            }
        }
    }
    let side = picture.len().isqrt() as u32;
    for y in 0..CELL {
        for x in 0..CELL {
            let pixel = picture[(y * side / CELL * side + x * side / CELL) as usize];
            on.put_pixel(left + x, top + y, Rgb(pixel));
        }
    }
}

pub(super) fn values(x: &Tensor, t: usize) -> candle_core::Result<Vec<f32>> {
    x.get(t)?.flatten_all()?.to_dtype(DType::F32)?.to_vec1()
}

/// From the range around 0 to that from 0 to 1.
pub(super) fn lifted(values: Vec<f32>) -> Vec<f32> {
    values.into_iter().map(|x| x + 0.5).collect()
}

/// The first camera's pixels.
pub(super) fn colours(values: &[f32], cameras: usize) -> Vec<Colour> {
    let level = |value: f32| (value.clamp(0.0, 1.0) * 255.0).round() as u8;
    values.as_chunks::<3>().0.iter().step_by(cameras).map(|pixel| pixel.map(level)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;

    use crate::model::decoder::Picture;

    #[test]
    fn a_film_shows_truth_imagination_and_error_and_marks_what_was_imagined() {
        let device = Device::Cpu;
        let truth = Tensor::full(255u8, (1, 3, 64, 64, 3), &device).unwrap();
        let image = Tensor::full(0f32, (1, 3, 64, 64, 3), &device).unwrap();
        let mask = Tensor::full(0.25f32, (1, 3, 64, 64, 1), &device).unwrap();
        let decoded = Decoded { image: image.clone(), pictures: vec![Picture { image, mask }] };
        let film = Film::of(&truth, &decoded, 0, 1).unwrap();
        let first: Vec<u8> = film.steps[0].iter().map(|panel| panel[0][0]).collect();
        assert_eq!(first, [255, 128, 128, 128, 64]);
        let frames = film.frames().unwrap();
        let framed = |frame: &RgbImage| frame.pixels().filter(|pixel| pixel.0 == IMAGINED).count();
        assert_eq!((frames.len(), framed(&frames[0])), (3, 0));
        assert!(framed(&frames[1]) > 1000);
        let strip = film.strip(2).unwrap();
        assert!(strip.width() < frames[0].width() && strip.height() > 5 * CELL);
    }
}
