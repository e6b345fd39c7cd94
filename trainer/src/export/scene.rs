//! The images, actions and measured states that golden values are made from: a recorded episode, or moving shapes.

use std::path::Path;

use candle_core::{Device, Tensor};
use ndarray::{Array1, Array2, Array4};
use rcwm_models::episode::Episode;
use rcwm_models::settings::ModelSettings;
use rcwm_models::tensors::{Tensors, Values};

use super::ExportError;

/// Images and the actions that led to them.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// [K, S, S, 3 C].
    images: Array4<u8>,
    /// [K, action]; zeros where an episode begins.
    actions: Array2<f32>,
    /// [K, state], where the model looks at it.
    states: Option<Array2<f32>>,
    /// [K].
    first: Array1<bool>,
    /// What it shows, in words.
    pub description: String,
}

impl Scene {
    /// The first `ticks` steps of a recorded episode.
    pub fn from_episode(path: &Path, ticks: usize, model: &ModelSettings) -> Result<Self, ExportError> {
        let episode = Episode::read(path)?;
        if let Some(misfit) = episode.misfit(model) {
            return Err(ExportError::Misfit { path: path.to_path_buf(), misfit });
        }
        let ticks = ticks.min(episode.len());
        if ticks == 0 {
            return Err(ExportError::NoTicks);
        }
        let name = path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
        let part = ndarray::s![..ticks];
        let mut first = episode.is_first.slice(part).to_owned();
        // The file may hold the middle of an episode; golden ticks begin from the initial state.
        first[0] = true;
        let scene = Self {
            images: episode.image.slice(ndarray::s![..ticks, .., .., ..]).to_owned(),
            actions: episode.action.slice(ndarray::s![..ticks, ..]).to_owned(),
            states: (episode.proprio.as_ref().filter(|_| model.state > 0))
                .map(|state| state.slice(ndarray::s![..ticks, ..]).to_owned()),
            first,
            description: format!("the first {ticks} steps of the episode {name}"),
        };
        Ok(scene.with_resting_beginnings())
    }

    /// Coloured discs that move smoothly over a gradient; actions swing a little beyond their limits; a second episode begins
    /// after two thirds.
    pub fn synthetic(ticks: usize, model: &ModelSettings) -> Result<Self, ExportError> {
        if ticks == 0 {
            return Err(ExportError::NoTicks);
        }
        let side = model.image_side;
        let images =
            Array4::from_shape_fn((ticks, side, side, model.image_channels()), |place| pixel(place, side));
        let swing = |tick: usize, axis: usize| (0.3 * tick as f64 + 1.7 * axis as f64).sin();
        let actions =
            Array2::from_shape_fn((ticks, model.action), |(tick, axis)| (1.2 * swing(tick, axis)) as f32);
        // Of different sizes, as angles and velocities are.
        let state = |(tick, axis)| (f64::from(1 << (axis % 8) as u32) * swing(tick, axis)) as f32;
        let states = (model.state > 0).then(|| Array2::from_shape_fn((ticks, model.state), state));
        let first = Array1::from_shape_fn(ticks, |tick| tick == 0 || (ticks > 2 && tick == 2 * ticks / 3));
        let description = format!("{ticks} synthetic images of moving shapes");
        Ok(Self { images, actions, states, first, description }.with_resting_beginnings())
    }

    fn with_resting_beginnings(mut self) -> Self {
        for (mut action, _) in
            self.actions.rows_mut().into_iter().zip(&self.first).filter(|(_, first)| **first)
        {
            action.fill(0.0);
        }
        self
    }

    /// K.
    pub fn len(&self) -> usize {
        self.first.len()
    }

    /// Whether an episode begins at this tick.
    pub fn is_first(&self, tick: usize) -> bool {
        self.first[tick]
    }

    /// [1, S, S, 3 C] u8.
    pub fn image(&self, tick: usize) -> candle_core::Result<Tensor> {
        let image = self.images.index_axis(ndarray::Axis(0), tick);
        let pixels: Vec<u8> = image.iter().copied().collect();
        let (height, width, channels) = image.dim();
        Tensor::from_vec(pixels, (1, height, width, channels), &Device::Cpu)
    }

    /// [1, action].
    pub fn action(&self, tick: usize) -> candle_core::Result<Tensor> {
        vector(&self.actions, tick)
    }

    /// [1, state], where the model looks at it.
    pub fn state(&self, tick: usize) -> candle_core::Result<Option<Tensor>> {
        self.states.as_ref().map(|states| vector(states, tick)).transpose()
    }

    /// The inputs as golden tensors.
    pub fn inputs(&self) -> Result<Tensors, ExportError> {
        let first = self.first.mapv(u8::from);
        let mut tensors = Tensors::default();
        tensors.0.insert("input/image".into(), Values::U8(self.images.clone().into_dyn()));
        tensors.0.insert("input/action".into(), Values::F32(self.actions.clone().into_dyn()));
        if let Some(states) = &self.states {
            tensors.0.insert("input/state".into(), Values::F32(states.clone().into_dyn()));
        }
        tensors.0.insert("input/is_first".into(), Values::U8(first.into_dyn()));
        Ok(tensors)
    }
}

fn vector(rows: &Array2<f32>, tick: usize) -> candle_core::Result<Tensor> {
    Tensor::from_vec(rows.row(tick).to_vec(), (1, rows.ncols()), &Device::Cpu)
}

/// Radius of a disc in pixels, its colour, and the speeds of its path in radians a tick.
const DISCS: [(f64, [u8; 3], f64, f64); 3] =
    [(9.0, [220, 60, 50], 0.21, 0.13), (6.0, [50, 90, 210], 0.11, 0.27), (12.0, [240, 220, 190], 0.07, 0.05)];

fn pixel((tick, row, column, channel): (usize, usize, usize, usize), side: usize) -> u8 {
    let side = side as f64;
    // A further camera shows what was there some ticks before.
    let (tick, channel) = (tick + channel / 3 * 5, channel % 3);
    let (t, y, x) = (tick as f64, row as f64, column as f64);
    for (index, (radius, colour, speed_x, speed_y)) in DISCS.iter().enumerate() {
        let phase = index as f64;
        let centre_x = side * (0.5 + 0.35 * (speed_x * t + phase).sin());
        let centre_y = side * (0.5 + 0.35 * (speed_y * t + 2.0 * phase).cos());
        if (x - centre_x).powi(2) + (y - centre_y).powi(2) <= radius * radius {
            return colour[channel];
        }
    }
    // Saturating: the gradient stays within 20 to 147.
    (20.0 + x + y * if channel == 1 { 1.0 } else { 0.5 }) as u8
}
