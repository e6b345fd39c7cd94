//! What one frame of a film shows.
//!
//! ```text
//! observation | reconstruction | robot        | environment
//! action      | difference     | robot mask   | environment mask
//! ```
//!
//! Without a decoder only the left column. Branches are shown multiplied by their masks (eq. 8).

use rcwm_models::wire::ActionSource;
use rcwm_models::wire::ActionValues;
use rcwm_models::{IMAGE_BYTES, IMAGE_SIDE, MASK_BYTES};

use super::canvas::{Canvas, LETTER_HEIGHT};

const BACKGROUND: [u8; 3] = [18, 20, 26];
const LETTERS: [u8; 3] = [200, 205, 215];
const AXIS: [u8; 3] = [90, 95, 105];
const BAR: [u8; 3] = [70, 160, 255];
const BAR_FALLBACK: [u8; 3] = [255, 90, 70];
const SOLVED: [u8; 3] = [90, 220, 120];
const GAP: usize = 3;
const LABEL: usize = LETTER_HEIGHT + 2;

/// The decoder's outputs for one state; images are `[64, 64, 3]` in -0.5 to 0.5, masks `[64, 64]` in 0 to 1.
#[derive(Debug, Clone)]
pub(super) struct Decoded {
    pub(super) image: Vec<f32>,
    pub(super) robot_image: Vec<f32>,
    pub(super) robot_mask: Vec<f32>,
    pub(super) environment_image: Vec<f32>,
    pub(super) environment_mask: Vec<f32>,
}

impl Decoded {
    pub(super) fn new() -> Self {
        let (image, mask) = (vec![0.0; IMAGE_BYTES], vec![0.0; MASK_BYTES]);
        Self {
            image: image.clone(),
            robot_image: image.clone(),
            robot_mask: mask.clone(),
            environment_image: image,
            environment_mask: mask,
        }
    }
}

/// What is known of one tick.
pub(super) struct Shown<'a> {
    pub(super) image: &'a [u8],
    pub(super) decoded: Option<&'a Decoded>,
    pub(super) action: ActionValues,
    pub(super) source: u32,
    pub(super) step: u32,
    pub(super) return_sum: f64,
    pub(super) success: bool,
}

/// Rows of a film strip, from the top: the names stand in the film.
pub(super) fn strip_panels(shown: &Shown<'_>) -> Vec<Canvas> {
    let panel = |pixel: &dyn Fn(usize) -> [u8; 3]| {
        let mut canvas = Canvas::new(IMAGE_SIDE, IMAGE_SIDE, BACKGROUND);
        canvas.image(0, 0, pixel);
        canvas
    };
    let mut panels = vec![panel(&observed(shown.image))];
    if let Some(decoded) = shown.decoded {
        panels.push(panel(&bare(&decoded.image)));
        panels.push(panel(&masked(&decoded.robot_image, &decoded.robot_mask)));
        panels.push(panel(&masked(&decoded.environment_image, &decoded.environment_mask)));
    }
    panels
}

/// One frame of the film, at one pixel of the observation per pixel.
pub(super) fn film_frame(shown: &Shown<'_>) -> Canvas {
    let columns = if shown.decoded.is_some() { 4 } else { 1 };
    let cell = IMAGE_SIDE + GAP;
    let width = GAP + columns * cell;
    let height = 2 * (cell + LABEL) + LABEL + GAP;
    let mut canvas = Canvas::new(width, height, BACKGROUND);
    let place = |column: usize, row: usize| (GAP + column * cell, GAP + LABEL + row * (cell + LABEL));
    let mut put = |column: usize, row: usize, label: &str, pixel: &dyn Fn(usize) -> [u8; 3]| {
        let (x, y) = place(column, row);
        canvas.text(x, y - LABEL, label, LETTERS);
        canvas.image(x, y, pixel);
    };
    put(0, 0, "OBSERVATION", &observed(shown.image));
    if let Some(decoded) = shown.decoded {
        put(1, 0, "RECONSTRUCTION", &bare(&decoded.image));
        put(2, 0, "ROBOT", &masked(&decoded.robot_image, &decoded.robot_mask));
        put(3, 0, "ENVIRONMENT", &masked(&decoded.environment_image, &decoded.environment_mask));
        put(1, 1, "DIFFERENCE", &difference(shown.image, &decoded.image));
        put(2, 1, "ROBOT MASK", &mask(&decoded.robot_mask));
        put(3, 1, "ENVIRONMENT MASK", &mask(&decoded.environment_mask));
    }
    let (x, y) = place(0, 1);
    action_panel(&mut canvas, x, y, shown);
    let colour = if shown.success { SOLVED } else { LETTERS };
    canvas.text(GAP, height - LABEL, &status(shown, columns), colour);
    canvas
}

fn status(shown: &Shown<'_>, columns: usize) -> String {
    let Shown { step, return_sum, success, .. } = shown;
    if columns == 1 {
        return format!("{step:<4} {return_sum:>10.1}");
    }
    let solved = if *success { "SUCCESS" } else { "" };
    format!("STEP {step:<4} RETURN {return_sum:<9.1} {solved}")
}

/// One bar per action component, up for positive; red when the action is a fallback.
fn action_panel(canvas: &mut Canvas, x: usize, y: usize, shown: &Shown<'_>) {
    let policy = shown.source == ActionSource::Policy as u32;
    let (label, colour) = if policy { ("ACTION", BAR) } else { ("ACTION FALLBACK", BAR_FALLBACK) };
    canvas.text(x, y - LABEL, label, LETTERS);
    let middle = y + IMAGE_SIDE / 2;
    let slot = (IMAGE_SIDE / shown.action.len().max(1)).max(2);
    for (index, value) in shown.action.iter().enumerate() {
        let length = (value.abs().min(1.0) * (IMAGE_SIDE / 2) as f32).round() as usize;
        let top = if *value > 0.0 { middle - length } else { middle };
        canvas.fill(x + index * slot + 2, top, slot - 4, length, colour);
    }
    canvas.fill(x, middle, IMAGE_SIDE, 1, AXIS);
}

fn observed(image: &[u8]) -> impl Fn(usize) -> [u8; 3] {
    |pixel| [image[3 * pixel], image[3 * pixel + 1], image[3 * pixel + 2]]
}

fn bare(image: &[f32]) -> impl Fn(usize) -> [u8; 3] {
    |pixel| std::array::from_fn(|channel| to_byte(image[3 * pixel + channel] + 0.5))
}

fn masked(image: &[f32], mask: &[f32]) -> impl Fn(usize) -> [u8; 3] {
    |pixel| std::array::from_fn(|channel| to_byte((image[3 * pixel + channel] + 0.5) * mask[pixel]))
}

fn mask(mask: &[f32]) -> impl Fn(usize) -> [u8; 3] {
    |pixel| [to_byte(mask[pixel]); 3]
}

fn difference(image: &[u8], decoded: &[f32]) -> impl Fn(usize) -> [u8; 3] {
    |pixel| {
        std::array::from_fn(|channel| {
            let at = 3 * pixel + channel;
            to_byte((f32::from(image[at]) / 255.0 - (decoded[at] + 0.5)).abs())
        })
    }
}

/// 0 to 1 -> 0 to 255; what is no number becomes 0.
fn to_byte(value: f32) -> u8 {
    (value * 255.0).round().clamp(0.0, 255.0) as u8
}
