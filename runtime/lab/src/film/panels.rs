//! What one frame of a film shows.
//!
//! ```text
//! observation | reconstruction | robot        | environment
//! action      | difference     | robot mask   | environment mask
//! ```
//!
//! These two rows again for each further camera that the policy reads. Without a decoder the observations of all cameras side by side, and
//! the action below the first. Branches are shown multiplied by their masks (eq. 8).

use rcwm_models::settings::ModelSettings;
use rcwm_models::wire::ActionSource;

use super::canvas::{BACKGROUND, Canvas, LETTER_HEIGHT, LETTER_WIDTH};

const LETTERS: [u8; 3] = [200, 205, 215];
const AXIS: [u8; 3] = [90, 95, 105];
const BAR: [u8; 3] = [70, 160, 255];
const BAR_FALLBACK: [u8; 3] = [255, 90, 70];
const SOLVED: [u8; 3] = [90, 220, 120];
const GAP: usize = 3;
const LABEL: usize = LETTER_HEIGHT + 2;
/// Sides of a panel, in pixels: of small pictures, and where one is larger.
const SIDES: [usize; 2] = [64, 128];
/// Screen pixels that a panel takes at least, in a film and in a strip.
const FILM_SIDE: usize = 192;
const STRIP_SIDE: usize = 128;

/// The decoder's outputs for one state. The cameras are side by side, pixel by pixel: images `[S, S, 3 C]` in -0.5 to 0.5, masks
/// `[S, S, C]` in 0 to 1.
#[derive(Debug, Clone)]
pub(super) struct Decoded {
    cameras: usize,
    image: Vec<f32>,
    robot_image: Vec<f32>,
    robot_mask: Vec<f32>,
    environment_image: Vec<f32>,
    environment_mask: Vec<f32>,
}

impl Decoded {
    pub(super) fn of(model: &ModelSettings) -> Self {
        let pixels = model.image_side * model.image_side;
        let (image, mask) = (vec![0.0; pixels * model.image_channels()], vec![0.0; pixels * model.cameras]);
        Self {
            cameras: model.cameras,
            image: image.clone(),
            robot_image: image.clone(),
            robot_mask: mask.clone(),
            environment_image: image,
            environment_mask: mask,
        }
    }

    /// In the order of the decoder's signature.
    pub(super) fn outputs(&mut self) -> [&mut [f32]; 5] {
        let Self { image, robot_image, robot_mask, environment_image, environment_mask, .. } = self;
        [image, robot_image, robot_mask, environment_image, environment_mask]
    }
}

/// What the decoder made of one camera.
#[derive(Clone, Copy)]
struct DecodedView<'a> {
    decoded: &'a Decoded,
    camera: usize,
}

impl DecodedView<'_> {
    /// Red, green and blue of a pixel, 0 to 1.
    fn rgb(self, image: &[f32], pixel: usize) -> [f32; 3] {
        let at = 3 * (self.decoded.cameras * pixel + self.camera);
        std::array::from_fn(|channel| image[at + channel] + 0.5)
    }

    fn share(self, mask: &[f32], pixel: usize) -> f32 {
        mask[self.decoded.cameras * pixel + self.camera]
    }

    fn bare(self, pixel: usize) -> [u8; 3] {
        self.rgb(&self.decoded.image, pixel).map(to_byte)
    }

    fn masked(self, image: &[f32], mask: &[f32], pixel: usize) -> [u8; 3] {
        let share = self.share(mask, pixel);
        self.rgb(image, pixel).map(|value| to_byte(value * share))
    }

    fn mask(self, mask: &[f32], pixel: usize) -> [u8; 3] {
        [to_byte(self.share(mask, pixel)); 3]
    }

    fn difference(self, image: &[u8], pixel: usize) -> [u8; 3] {
        let (seen, decoded) = (seen(image, pixel), self.rgb(&self.decoded.image, pixel));
        std::array::from_fn(|channel| to_byte((f32::from(seen[channel]) / 255.0 - decoded[channel]).abs()))
    }
}

/// What a camera shows.
#[derive(Debug, Clone, Copy)]
pub(super) struct View<'a> {
    pub(super) name: &'a str,
    /// Rows and columns.
    pub(super) size: [usize; 2],
    pub(super) image: &'a [u8],
}

/// What is known of one tick.
pub(super) struct Shown<'a> {
    /// Of those cameras that the decoder has, in its order, where there is one.
    pub(super) views: &'a [View<'a>],
    pub(super) decoded: Option<&'a Decoded>,
    /// Each number in [-1, 1], from its lower limit to its upper one.
    pub(super) action: &'a [f32],
    pub(super) source: u32,
    pub(super) step: u32,
    pub(super) return_sum: f64,
    pub(super) success: bool,
}

/// Where the panels of a frame are.
#[derive(Debug, Clone, Copy)]
struct Layout {
    side: usize,
    cameras: usize,
    decoded: bool,
}

impl Layout {
    fn of(shown: &Shown<'_>) -> Self {
        let is_small = |view: &View<'_>| view.size.iter().all(|side| *side <= SIDES[0]);
        let side = SIDES[usize::from(!shown.views.iter().all(is_small))];
        Self { side, cameras: shown.views.len(), decoded: shown.decoded.is_some() }
    }

    /// Columns and rows of panels.
    fn panels(self) -> [usize; 2] {
        if self.decoded { [4, 2 * self.cameras] } else { [self.cameras, 2] }
    }

    /// Column and row of a camera's observation; what was decoded of it is to the right.
    fn of_camera(self, camera: usize) -> [usize; 2] {
        if self.decoded { [0, 2 * camera] } else { [camera, 0] }
    }

    /// Where the upper left corner of a panel is.
    fn place(self, [column, row]: [usize; 2]) -> [usize; 2] {
        let cell = self.side + GAP;
        [GAP + column * cell, GAP + LABEL + row * (cell + LABEL)]
    }
}

/// A frame of the film.
pub(super) struct Frame {
    pub(super) canvas: Canvas,
    layout: Layout,
}

impl Frame {
    /// Screen pixels per pixel of a film of such frames.
    pub(super) fn film_scale(&self) -> usize {
        FILM_SIDE.div_ceil(self.layout.side)
    }

    /// The same in a strip.
    pub(super) fn strip_scale(&self) -> usize {
        STRIP_SIDE.div_ceil(self.layout.side)
    }

    /// The panels that a strip shows, from the top: the names stand in the film.
    pub(super) fn strip(&self) -> Vec<Canvas> {
        let layout = self.layout;
        let columns = if layout.decoded { 4 } else { 1 };
        let of_camera = |camera: usize| {
            let [column, row] = layout.of_camera(camera);
            (column..column + columns).map(move |column| [column, row])
        };
        let panels = (0..layout.cameras).flat_map(of_camera);
        panels.map(|panel| self.canvas.part(layout.place(panel), layout.side)).collect()
    }
}

/// One frame of the film.
pub(super) fn film_frame(shown: &Shown<'_>) -> Frame {
    let layout = Layout::of(shown);
    let [width, height] = layout.place(layout.panels());
    let mut canvas = Canvas::new(width, height, BACKGROUND);
    for (camera, View { name, size, image }) in shown.views.iter().enumerate() {
        let [column, row] = layout.of_camera(camera);
        let mut put = |right: usize, below: usize, text: &str, pixel: &dyn Fn(usize) -> [u8; 3]| {
            let place = layout.place([column + right, row + below]);
            label(&mut canvas, place, layout.side, text);
            canvas.image(place, layout.side, *size, pixel);
        };
        let several = shown.views.len() > 1;
        put(0, 0, if several { name } else { "OBSERVATION" }, &|pixel| seen(image, pixel));
        let Some(decoded) = shown.decoded else { continue };
        let Decoded { robot_image, robot_mask, environment_image, environment_mask, .. } = decoded;
        let view = DecodedView { decoded, camera };
        put(1, 0, "RECONSTRUCTION", &|pixel| view.bare(pixel));
        put(2, 0, "ROBOT", &|pixel| view.masked(robot_image, robot_mask, pixel));
        put(3, 0, "ENVIRONMENT", &|pixel| view.masked(environment_image, environment_mask, pixel));
        put(1, 1, "DIFFERENCE", &|pixel| view.difference(image, pixel));
        put(2, 1, "ROBOT MASK", &|pixel| view.mask(robot_mask, pixel));
        put(3, 1, "ENVIRONMENT MASK", &|pixel| view.mask(environment_mask, pixel));
    }
    action_panel(&mut canvas, layout.place([0, 1]), layout.side, shown);
    let colour = if shown.success { SOLVED } else { LETTERS };
    canvas.text(GAP, height - LABEL, &status(shown, width), colour);
    Frame { canvas, layout }
}

/// What stands above a panel, as much of it as has room.
fn label(canvas: &mut Canvas, [x, y]: [usize; 2], side: usize, text: &str) {
    let text: String = text.to_uppercase().chars().take(side / LETTER_WIDTH).collect();
    canvas.text(x, y - LABEL, &text, LETTERS);
}

fn status(shown: &Shown<'_>, width: usize) -> String {
    let Shown { step, return_sum, success, .. } = shown;
    let solved = if *success { "SUCCESS" } else { "" };
    let long = format!("STEP {step:<4} RETURN {return_sum:<9.1} {solved}");
    let fits = GAP + long.len() * LETTER_WIDTH <= width;
    if fits { long } else { format!("{step:<4} {return_sum:>10.1}") }
}

/// One bar per number of the action, up from the middle of its limits to the upper one, down to the lower one; red when it is a fallback.
fn action_panel(canvas: &mut Canvas, [x, y]: [usize; 2], side: usize, shown: &Shown<'_>) {
    let policy = shown.source == ActionSource::Policy as u32;
    let (text, colour) = if policy { ("ACTION", BAR) } else { ("ACTION FALLBACK", BAR_FALLBACK) };
    label(canvas, [x, y], side, text);
    let (middle, numbers) = (y + side / 2, shown.action.len());
    for (index, value) in shown.action.iter().enumerate() {
        let (left, right) = (index * side / numbers, (index + 1) * side / numbers);
        let gap = ((right - left) / 4).min(2);
        let length = (value.abs().min(1.0) * (side / 2) as f32).round() as usize;
        let top = if *value > 0.0 { middle - length } else { middle };
        canvas.fill(x + left + gap, top, right - left - 2 * gap, length, colour);
    }
    canvas.fill(x, middle, side, 1, AXIS);
}

fn seen(image: &[u8], pixel: usize) -> [u8; 3] {
    std::array::from_fn(|channel| image[3 * pixel + channel])
}

/// 0 to 1 -> 0 to 255; what is no number becomes 0.
fn to_byte(value: f32) -> u8 {
    (value * 255.0).round().clamp(0.0, 255.0) as u8
}

#[cfg(test)]
mod tests {
    use rcwm_models::settings::{ModelKind, Preset};

    use super::*;

    fn shown<'a>(views: &'a [View<'a>], decoded: Option<&'a Decoded>, action: &'a [f32]) -> Shown<'a> {
        Shown { views, decoded, action, source: 0, step: 3, return_sum: 1.0, success: false }
    }

    fn colour(canvas: &Canvas, [x, y]: [usize; 2]) -> [u8; 3] {
        let at = 3 * (y * canvas.width + x);
        std::array::from_fn(|channel| canvas.rgb[at + channel])
    }

    #[test]
    fn every_number_of_an_action_has_a_bar_within_the_panel() {
        let image = vec![0; 64 * 64 * 3];
        let view = [View { name: "front", size: [64, 64], image: &image }];
        for numbers in [0_usize, 1, 4, 16, 17, 33, 64] {
            let action: Vec<_> = (0..numbers).map(|at| if at % 2 == 0 { 1.0 } else { -0.5 }).collect();
            let Frame { canvas, layout } = film_frame(&shown(&view, None, &action));
            let [x, y] = layout.place([0, 1]);
            let bars = |row: usize| (0..64).filter(|at| colour(&canvas, [x + at, y + row]) == BAR).count();
            assert!(bars(0) >= numbers.div_ceil(2) && bars(40) >= numbers / 2, "{numbers}");
            assert_eq!(bars(60), 0, "half of the way down to the lower limit");
            let outside = |at: &usize| colour(&canvas, [*at, y]) == BAR;
            assert_eq!((0..x).chain(x + 64..canvas.width).filter(outside).count(), 0);
        }
    }

    #[test]
    fn two_cameras_of_128_are_shown_with_what_was_decoded_of_each() {
        let small = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
        let mut decoded = Decoded::of(&ModelSettings { image_side: 128, cameras: 2, ..small });
        // Of the second camera all is white, and half of it the robot.
        decoded.image.iter_mut().enumerate().for_each(|(at, x)| *x = if at % 6 < 3 { -0.5 } else { 0.5 });
        decoded.robot_image.clone_from(&decoded.image);
        decoded.robot_mask.iter_mut().skip(1).step_by(2).for_each(|x| *x = 0.5);
        let images = [10, 250].map(|value| vec![value; 128 * 128 * 3]);
        let view = |name, image| View { name, size: [128, 128], image };
        let views = [view("front", &images[0]), view("wrist", &images[1])];
        let frame = film_frame(&shown(&views, Some(&decoded), &[0.5; 7]));
        assert_eq!(frame.canvas.height, frame.layout.place([0, 4])[1]);
        let inside = |panel| frame.layout.place(panel).map(|at| at + 100);
        let at = |panel| colour(&frame.canvas, inside(panel))[0];
        assert_eq!([[0, 0], [1, 0], [2, 0], [1, 1]].map(at), [10, 0, 0, 10]);
        assert_eq!([[0, 2], [1, 2], [2, 2], [1, 3], [2, 3]].map(at), [250, 255, 128, 5, 128]);
        let strip = frame.strip();
        assert_eq!((strip.len(), strip[0].width, strip[5].rgb[0]), (8, 128, 255));
        assert_eq!((frame.film_scale(), frame.strip_scale()), (2, 1));
    }
}
