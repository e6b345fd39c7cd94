use std::path::{Path, PathBuf};

use candle_core::{Device, Tensor};
use image::{ImageFormat, Rgb, RgbImage};
use rcwm_models::IMAGE_SIDE;
use rcwm_models::episode::Episode;
use rcwm_models::files::write_atomic;
use serde::{Deserialize, Serialize};

use super::TrainingError;
use crate::learning::{Batch, HostBatch};
use crate::model::agent::Agent;
use crate::model::latent::{FirstSteps, Latent, Sampler, State};
use crate::model::world::Decoded;

/// Pixels between two pictures of a strip.
const GAP: u32 = 2;

/// Film strips of the open loop, one a task, with every checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FilmSettings {
    /// Steps that are seen before the model imagines.
    pub context: usize,
    /// Steps in all; 0 makes no films.
    pub length: usize,
    /// Steps from one picture of the strip to the next.
    pub every: usize,
}

impl Default for FilmSettings {
    fn default() -> Self {
        Self { context: 10, length: 64, every: 4 }
    }
}

/// What a model sees, then imagines with the recorded actions, of the first steps of an episode. A strip has a row each for truth,
/// prediction and error, then each branch's masked image and its mask; time goes right, and imagined columns have an orange frame.
///
/// # Errors
/// Those of candle; the episode must be longer than the context.
pub fn film_strip(
    agent: &Agent,
    episode: &Episode,
    settings: &FilmSettings,
    device: &Device,
) -> candle_core::Result<RgbImage> {
    let length = settings.length.min(episode.len());
    let context = settings.context.clamp(1, length.saturating_sub(1).max(1));
    let batch = first_steps(episode, length).into_tensors(device)?;
    let states = open_loop(agent, &batch, context)?;
    let decoded = agent.world.decode(&states)?;
    let shown: Vec<usize> = (0..length).step_by(settings.every.max(1)).collect();
    let mut strip = Strip::new(shown.len(), 3 + 2 * decoded.pictures.len());
    for (column, t) in shown.into_iter().enumerate() {
        let pictures = column_at(&batch, &decoded, t)?;
        for (row, picture) in pictures.iter().enumerate() {
            strip.draw(column, row, picture, t >= context);
        }
    }
    Ok(strip.0)
}

/// Writes a strip as PNG.
///
/// # Errors
/// Those of encoding and writing.
pub fn write_png(strip: &RgbImage, path: &Path) -> Result<(), TrainingError> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    let failed = |error: image::ImageError| TrainingError::Folder {
        path: PathBuf::from(path),
        source: std::io::Error::other(error),
    };
    strip.write_to(&mut bytes, ImageFormat::Png).map_err(failed)?;
    Ok(write_atomic(path, bytes.get_ref())?)
}

fn first_steps(episode: &Episode, length: usize) -> HostBatch {
    let range = ndarray::Slice::from(0..length);
    let axis = ndarray::Axis(0);
    HostBatch {
        rows: 1,
        length,
        image: episode.image.slice_axis(axis, range).iter().copied().collect(),
        action: episode.action.slice_axis(axis, range).iter().copied().collect(),
        reward: episode.reward.slice_axis(axis, range).to_vec(),
        terminal: episode.is_terminal.slice_axis(axis, range).to_vec(),
        first: (0..length).map(|step| step == 0).collect(),
        robot_mask: Vec::new(),
    }
}

/// Posterior states of the context, then imagined ones: every tensor [1, T, ...]. The most probable class is taken throughout, so
/// that strips of two checkpoints differ by the model only.
fn open_loop(agent: &Agent, batch: &Batch, context: usize) -> candle_core::Result<State> {
    let length = batch.first.length();
    let embeds = agent.world.encode(&batch.image.narrow(1, 0, context)?)?;
    let first = FirstSteps::new((0..context).map(|step| step == 0).collect(), context);
    let actions = batch.action.narrow(1, 0, context)?;
    let seen = agent.world.observe(&embeds, &actions, &first, &mut Sampler::Mode)?.posteriors;
    if context == length {
        return Ok(seen);
    }
    let start = seen.map(|x| x.narrow(1, context - 1, 1)?.squeeze(1)?.contiguous())?;
    let actions = batch.action.narrow(1, context, length - context)?;
    let imagined = agent.world.imagine(&start, &actions, &mut Sampler::Mode)?;
    let join = |a: &Tensor, b: &Tensor| Tensor::cat(&[a, b], 1);
    let branches = seen.branches.iter().zip(&imagined.branches).map(|(a, b)| {
        Ok(Latent { z: join(&a.z, &b.z)?, h: join(&a.h, &b.h)?, logits: join(&a.logits, &b.logits)? })
    });
    Ok(State { branches: branches.collect::<candle_core::Result<_>>()? })
}

/// The pictures of one step, top to bottom, each 64 * 64 * 3 values in [0, 1].
fn column_at(batch: &Batch, decoded: &Decoded, t: usize) -> candle_core::Result<Vec<Vec<f32>>> {
    let at =
        |x: &Tensor| x.get(0)?.get(t)?.flatten_all()?.to_dtype(candle_core::DType::F32)?.to_vec1::<f32>();
    let lift = |values: Vec<f32>, by: f32| values.into_iter().map(|x| x + by).collect::<Vec<_>>();
    let truth: Vec<f32> = at(&batch.image)?.into_iter().map(|x| x / 255.0).collect();
    let imagined = lift(at(&decoded.image)?, 0.5);
    let error = truth.iter().zip(&imagined).map(|(a, b)| (a - b).abs()).collect();
    let mut column = vec![truth, imagined, error];
    for picture in &decoded.pictures {
        // Where the mask is 0 nothing is painted: that is the middle grey, which the value 0 stands for.
        column.push(lift(at(&picture.masked()?)?, 0.5));
        column.push(at(&picture.mask)?.into_iter().flat_map(|x| [x; 3]).collect());
    }
    Ok(column)
}

/// The picture that a strip is drawn into.
struct Strip(RgbImage);

impl Strip {
    fn new(columns: usize, rows: usize) -> Self {
        let cell = IMAGE_SIDE as u32 + GAP;
        let (width, height) = (columns as u32 * cell + GAP, rows as u32 * cell + GAP);
        Self(RgbImage::from_pixel(width, height, Rgb([255, 255, 255])))
    }

    fn draw(&mut self, column: usize, row: usize, picture: &[f32], imagined: bool) {
        let side = IMAGE_SIDE as u32;
        let (left, top) = (column as u32 * (side + GAP), row as u32 * (side + GAP));
        if imagined {
            for offset in 0..side + 2 * GAP {
                for (x, y) in [(left + offset, top + 1), (left + offset, top + side + GAP)] {
                    self.0.put_pixel(x, y, Rgb([240, 140, 20]));
                }
            }
        }
        for (index, pixel) in picture.chunks_exact(3).enumerate() {
            let (x, y) = (left + GAP + index as u32 % side, top + GAP + index as u32 / side);
            let level = |value: f32| (value.clamp(0.0, 1.0) * 255.0).round() as u8;
            self.0.put_pixel(x, y, Rgb([level(pixel[0]), level(pixel[1]), level(pixel[2])]));
        }
    }
}
