use std::path::Path;

use candle_core::{DType, Device, Tensor};
use image::{Rgb, RgbImage};
use serde::{Deserialize, Serialize};

use super::film::{CELL, GAP, LETTERS, WORDS_HEIGHT};
use super::open_loop::{filtered, joined};
use super::{AttentionMaps, AttentionSpread, EvaluationError, Film, Latents, TaskTrajectories};
use crate::model::agent::Agent;
use crate::model::latent::Sampler;
use crate::plots::{
    COLOURS, Colour, INK, Line, PAPER, Panel, PlotError, Scale, text_width, write_png, write_text,
};

/// Rows of pictures above the maps.
const SHOWN: [&str; 4] = ["true", "imagined", "robot", "environment"];
/// Between the part of a map that looks at z and the one that looks at h.
const PART_GAP: u32 = 3;
/// The brightest colour stands for this many times the weight that every row gets if all get the same, and for all above.
pub const BRIGHTEST_TIMES_EVEN: f32 = 4.0;
/// Size of the colour scale.
const SCALE_SIZE: (u32, u32) = (256, 14);
/// Dark to bright, evenly for the eye and in grey too (after viridis).
const COLOUR_SCALE: [Colour; 6] =
    [[68, 1, 84], [65, 68, 135], [42, 120, 142], [34, 168, 132], [122, 209, 81], [253, 231, 37]];

/// What an attention film says in numbers; every list holds one number an imagined step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Attention {
    /// Categoricals of the environment's z, which ask.
    pub queries: usize,
    /// Rows that answer: the categoricals of the robot's prior z, then rows made of its h.
    pub keys: usize,
    /// How many of the rows are made of the robot's h.
    pub rows_of_h: usize,
    /// Share of the attention that h gets, mean over the queries.
    pub share_of_h: Vec<f64>,
    /// Largest single weight.
    pub largest: Vec<f64>,
    /// How it is spread over queries and the imagined states.
    #[serde(default)]
    pub spread: Option<AttentionSpread>,
}

/// What a model imagined of one trajectory, and what its environment branch asked of the robot branch at every imagined step (eq. 7;
/// paper, Fig. 15 and 16).
#[derive(Debug, Clone)]
pub struct AttentionFilm {
    film: Film,
    context: usize,
    /// A map an imagined step, by query, then key.
    maps: Vec<Vec<f32>>,
    queries: usize,
    keys: usize,
}

impl AttentionFilm {
    /// Imagines the first of the trajectories after `context` steps; none for a model without interaction.
    pub fn of(
        agent: &Agent,
        task: &TaskTrajectories,
        context: usize,
        latents: Latents,
        seed: u64,
        device: &Device,
    ) -> Result<Option<Self>, EvaluationError> {
        let world = &agent.world;
        let context = context.clamp(1, task.length - 1);
        let batch = task.batch(0, 1, device)?;
        let mut sampler = match latents {
            Latents::Sample => Sampler::numbered(seed, 0),
            Latents::Mode => Sampler::Mode,
        };
        let seen = filtered(world, &batch, context, &mut sampler)?;
        let start = seen.map(|x| x.narrow(1, context - 1, 1)?.squeeze(1)?.contiguous())?;
        let actions = batch.action.narrow(1, context, task.length - context)?;
        let Some((imagined, maps)) = world.imagine_attending(&start, &actions, &mut sampler)? else {
            return Ok(None);
        };
        let decoded = world.decode(&joined(&seen, &imagined)?)?;
        let film = Film::of(&batch.image, &decoded, 0, context)?;
        let (_, steps, queries, keys) = maps.dims4()?;
        let maps = maps_of(&maps, 0, steps)?;
        Ok(Some(Self { film, context, maps, queries, keys }))
    }

    /// It in numbers.
    #[must_use]
    pub fn summary(&self) -> Attention {
        let share = |map: &Vec<f32>| {
            let rows = map.chunks_exact(self.keys);
            let sum: f64 = rows.flat_map(|row| &row[self.queries..]).map(|weight| f64::from(*weight)).sum();
            sum / self.queries as f64
        };
        let mut all = AttentionMaps::new(self.queries);
        all.extend(self.maps.iter().cloned());
        Attention {
            queries: self.queries,
            keys: self.keys,
            rows_of_h: self.keys - self.queries,
            share_of_h: self.maps.iter().map(share).collect(),
            largest: self.maps.iter().map(|map| f64::from(largest(map))).collect(),
            spread: all.spread(),
        }
    }

    /// A picture: time goes right, one imagined step in `every` and the last one are shown; below the pictures the map, a column for
    /// each categorical of the environment's z, a row for each row that answers it.
    pub fn strip(&self, every: usize) -> Result<RgbImage, PlotError> {
        let last = self.maps.len() - 1;
        let mut shown: Vec<usize> = (0..last).step_by(every.max(1)).collect();
        shown.push(last);
        let titles = SHOWN.iter().chain(&["attention on z"]);
        let widths = titles.map(|title| text_width(LETTERS, title)).collect::<Result<Vec<_>, _>>()?;
        let left = widths.into_iter().max().unwrap_or(0) + 2 * GAP;
        let top_of_maps = WORDS_HEIGHT + SHOWN.len() as u32 * (CELL + GAP) + GAP;
        let map_height = self.keys as u32 * self.pixel() + PART_GAP;
        let height = top_of_maps + map_height + 2 * WORDS_HEIGHT + SCALE_SIZE.1;
        let width = (left + shown.len() as u32 * (CELL + GAP)).max(left + SCALE_SIZE.0 + 2 * CELL);
        let mut strip = RgbImage::from_pixel(width, height, Rgb(PAPER));
        self.write_titles(&mut strip, top_of_maps)?;
        for (column, step) in shown.into_iter().enumerate() {
            let (x, t) = (left + column as u32 * (CELL + GAP), self.context + step);
            write_text(&mut strip, (x as i32, 3), LETTERS, INK, &self.film.describe(t))?;
            for (row, title) in SHOWN.iter().enumerate() {
                if let Some(panel) = self.film.panel(t, title) {
                    self.film.draw(&mut strip, (x, WORDS_HEIGHT + row as u32 * (CELL + GAP)), panel, t);
                }
            }
            self.draw_map(&mut strip, (x, top_of_maps), &self.maps[step]);
        }
        self.draw_scale(&mut strip, (left, top_of_maps + map_height + WORDS_HEIGHT / 2))?;
        Ok(strip)
    }

    /// Writes the strip as PNG.
    pub fn write_strip(&self, every: usize, path: &Path) -> Result<(), PlotError> {
        write_png(&self.strip(every)?, path)
    }

    /// Screen pixels per weight of a map.
    fn pixel(&self) -> u32 {
        (CELL / self.queries as u32).max(1)
    }

    fn write_titles(&self, strip: &mut RgbImage, top_of_maps: u32) -> Result<(), PlotError> {
        let rows = (0..SHOWN.len() as u32).map(|row| WORDS_HEIGHT + row * (CELL + GAP) + CELL / 2);
        let on_z = top_of_maps + self.queries as u32 * self.pixel() / 2;
        let on_h = top_of_maps + (self.queries + self.keys) as u32 * self.pixel() / 2 + PART_GAP;
        let words = SHOWN.iter().chain(&["attention on z", "attention on h"]);
        for (title, middle) in words.zip(rows.chain([on_z, on_h])) {
            let y = middle.saturating_sub(LETTERS / 2);
            write_text(strip, (GAP as i32, y as i32), LETTERS, INK, title)?;
        }
        Ok(())
    }

    /// The weight that the brightest colour stands for. Colours begin at 0 and are the same in every film of a model's size: what looks even
    /// is even.
    fn brightest(&self) -> f32 {
        (BRIGHTEST_TIMES_EVEN / self.keys as f32).min(1.0)
    }

    fn draw_map(&self, on: &mut RgbImage, (left, top): (u32, u32), map: &[f32]) {
        let pixel = self.pixel();
        for (query, weights) in map.chunks_exact(self.keys).enumerate() {
            for (key, weight) in weights.iter().enumerate() {
                let gap = if key < self.queries { 0 } else { PART_GAP };
                let (x, y) = (left + query as u32 * pixel, top + gap + key as u32 * pixel);
                fill(on, (x, y), (pixel, pixel), colour(weight / self.brightest()));
            }
        }
    }

    /// The colours from 0 to the brightest, with marks where every row gets the same and at the film's largest weight.
    fn draw_scale(&self, on: &mut RgbImage, (left, top): (u32, u32)) -> Result<(), PlotError> {
        let ((width, height), below) = (SCALE_SIZE, (top + SCALE_SIZE.1 + 4) as i32);
        let mut x = left;
        write_text(on, (x as i32, top as i32), LETTERS, INK, "0")?;
        x += text_width(LETTERS, "0")? + 2 * GAP;
        for step in 0..width {
            fill(on, (x + step, top), (1, height), colour(step as f32 / (width - 1) as f32));
        }
        let place = |weight: f32| (weight / self.brightest()).clamp(0.0, 1.0) * (width - 1) as f32;
        let even = 1.0 / self.keys as f32;
        let most = self.maps.iter().map(|map| largest(map)).fold(0.0, f32::max);
        for (weight, mark, words) in [(even, height + 4, "even"), (most, height + 2, "largest")] {
            let at = x + place(weight).round() as u32;
            fill(on, (at, top), (1, mark), if weight > even { PAPER } else { INK });
            let words = format!("{weight:.4}: {words}");
            // The two may be as good as the same: words of the larger begin at the right half or after those of the smaller.
            let from = if mark > height + 2 { at } else { at.max(x + place(even) as u32 + SCALE_SIZE.0 / 2) };
            write_text(on, (from as i32, below), LETTERS, INK, &words)?;
        }
        let beside = (x + width + 2 * GAP) as i32;
        let words = format!("{:.4} and more ({BRIGHTEST_TIMES_EVEN} x even)", self.brightest());
        write_text(on, (beside, top as i32), LETTERS, INK, &words)
    }
}

impl Attention {
    /// Over the imagined steps: how much of the attention goes to h, and the largest weight; both beside what they are if every row gets
    /// the same.
    #[must_use]
    pub fn panels(&self) -> [Panel; 2] {
        let line = |label: &str, values: &[f64], colour: Colour| Line {
            label: label.to_owned(),
            colour,
            points: (1..).map(f64::from).zip(values.iter().copied()).collect(),
            band: None,
            faint: false,
        };
        let panel = |title: &str, values: &[f64], even: f64, colour: Colour| Panel {
            title: title.to_owned(),
            x_label: "imagined steps".to_owned(),
            scale: Scale::Linear,
            lines: vec![line("even", &vec![even; values.len()], COLOURS[5]), line("found", values, colour)],
            marks: Vec::new(),
        };
        let (rows, keys) = (self.rows_of_h as f64, self.keys as f64);
        [
            panel("share of h", &self.share_of_h, rows / keys, COLOURS[0]),
            panel("largest weight", &self.largest, 1.0 / keys, COLOURS[1]),
        ]
    }
}

/// The maps [B, L, n, n+k] of the first steps of a row, each flattened.
pub(super) fn maps_of(maps: &Tensor, row: usize, steps: usize) -> candle_core::Result<Vec<Vec<f32>>> {
    let row = maps.get(row)?;
    (0..steps).map(|t| row.get(t)?.flatten_all()?.to_dtype(DType::F32)?.to_vec1()).collect()
}

fn largest(map: &[f32]) -> f32 {
    map.iter().copied().fold(f32::MIN_POSITIVE, f32::max)
}

fn fill(on: &mut RgbImage, (left, top): (u32, u32), (width, height): (u32, u32), colour: Colour) {
    for y in top..top + height {
        for x in left..left + width {
            if let Some(pixel) = on.get_pixel_mut_checked(x, y) {
                *pixel = Rgb(colour);
            }
        }
    }
}

/// The colour of a share of the scale.
fn colour(share: f32) -> Colour {
    let place = share.clamp(0.0, 1.0) * (COLOUR_SCALE.len() - 1) as f32;
    let below = (place as usize).min(COLOUR_SCALE.len() - 2);
    let (a, b, part) = (COLOUR_SCALE[below], COLOUR_SCALE[below + 1], place - below as f32);
    std::array::from_fn(|channel| {
        let (a, b) = (f32::from(a[channel]), f32::from(b[channel]));
        (a + (b - a) * part).round() as u8
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use rcwm_models::episode::Episode;
    use rcwm_models::settings::{ModelKind, ModelSettings, Preset};

    use super::*;
    use crate::evaluation::{OTHER_KIND, Trajectory};
    use crate::model::agent::initialise;

    fn film(kind: ModelKind) -> Option<AttentionFilm> {
        let settings = ModelSettings::preset(Preset::Debug, kind);
        let parameters = initialise(&settings, 1, &Device::Cpu).unwrap();
        let agent = Agent::new(&parameters.frozen(), &settings).unwrap();
        let mut episode = Episode::blank(12);
        episode.robot_mask = Some(ndarray::Array3::from_elem((12, 64, 64), false));
        let trajectory =
            Trajectory { episode: Arc::new(episode), number: 0, kind: OTHER_KIND, start: 0, steps: 12 };
        let task = TaskTrajectories { task: "reach".into(), length: 12, chosen: vec![trajectory] };
        AttentionFilm::of(&agent, &task, 3, Latents::Sample, 0, &Device::Cpu).unwrap()
    }

    #[test]
    fn every_imagined_step_has_a_map_whose_weights_sum_to_one_a_query() {
        let film = film(ModelKind::Rcwm).unwrap();
        let settings = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
        let (n, k) = (settings.categoricals, settings.interaction_rows());
        assert_eq!((film.maps.len(), film.queries, film.keys), (9, n, n + k));
        for row in film.maps.iter().flat_map(|map| map.chunks_exact(n + k)) {
            assert!((row.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        }
        let summary = film.summary();
        let even = k as f64 / (n + k) as f64;
        assert!(summary.share_of_h.iter().all(|share| (share - even).abs() < 0.5 * even), "{summary:?}");
        assert!(summary.largest.iter().all(|weight| *weight > 1.1 / (n + k) as f64), "fresh weights choose");
        let strip = film.strip(4).unwrap();
        assert!(strip.width() > 3 * CELL && strip.height() > 5 * CELL);
    }

    #[test]
    fn a_model_without_interaction_has_no_attention() {
        assert!(film(ModelKind::Vanilla).is_none());
    }

    #[test]
    fn colours_are_those_of_the_weight_itself_whatever_else_is_in_the_film() {
        let mut film = film(ModelKind::Rcwm).unwrap();
        let even = 1.0 / film.keys as f32;
        film.maps.iter_mut().for_each(|map| map.fill(even));
        let drawn = |film: &AttentionFilm| {
            let mut picture = RgbImage::new(400, 400);
            film.draw_map(&mut picture, (0, 0), &film.maps[0]);
            picture.get_pixel(0, 0).0
        };
        assert_eq!(drawn(&film), colour(1.0 / BRIGHTEST_TIMES_EVEN));
        film.maps[5][7] = 0.9; // another step's outlier
        assert_eq!(drawn(&film), colour(1.0 / BRIGHTEST_TIMES_EVEN));
        film.maps[0][0] = 2.0 * BRIGHTEST_TIMES_EVEN * even;
        assert_eq!(drawn(&film), COLOUR_SCALE[5]);
        assert!(film.summary().spread.unwrap().largest > 0.89);
    }

    #[test]
    fn the_scale_grows_brighter_from_end_to_end() {
        let grey = |share: f32| colour(share).iter().map(|level| u32::from(*level)).sum::<u32>();
        assert_eq!((colour(-1.0), colour(2.0)), (COLOUR_SCALE[0], COLOUR_SCALE[5]));
        assert!((0..10).all(|step| grey(step as f32 / 10.0) < grey((step + 1) as f32 / 10.0)));
    }
}
