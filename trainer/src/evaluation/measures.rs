use candle_core::{DType, Result, Tensor};
use serde::{Deserialize, Serialize};

use super::motion::changed;
use crate::learning::Batch;
use crate::model::agent::Agent;
use crate::model::latent::State;
use crate::model::world::Decoded;

/// Pixels of all cameras in a step's image of [B, T, S, S, 3 C].
pub(super) fn pixels_of(images: &Tensor) -> Result<usize> {
    Ok(images.dims().iter().skip(2).product::<usize>() / 3)
}

/// What is measured of every step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Measure {
    /// Squared error of the picture times the true robot mask, mean over the whole picture's values: the robot dynamics
    /// error (paper, 5.2 and Fig. 4). Values of a picture lie in [0, 1].
    RobotError,
    /// The same, mean over the robot's pixels only: does not grow with the robot's size in the picture.
    RobotErrorOnRobot,
    /// Intersection over union of the robot's mask, where it is over one half, and the true one.
    MaskIou,
    /// Squared error of the picture, mean over its values.
    ReconstructionError,
    /// Absolute error of the expected reward.
    RewardError,
    /// Squared error on the pixels outside the robot that have changed since the step before: of what moves but the robot.
    MovingError,
    /// Squared error on the pixels outside the robot that have changed since the last picture that was seen, divided by the error of
    /// that picture there: 1 is what a model gets that lets everything but the robot stand still.
    ChangeError,
}

impl Measure {
    /// All of them.
    pub const ALL: [Self; 7] = [
        Self::RobotError,
        Self::RobotErrorOnRobot,
        Self::MaskIou,
        Self::ReconstructionError,
        Self::RewardError,
        Self::MovingError,
        Self::ChangeError,
    ];
    /// Those by which models are compared.
    pub const COMPARED: [Self; 3] = [Self::RobotError, Self::MovingError, Self::ChangeError];

    /// Its name in files.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::RobotError => "robot_error",
            Self::RobotErrorOnRobot => "robot_error_on_robot",
            Self::MaskIou => "mask_iou",
            Self::ReconstructionError => "reconstruction_error",
            Self::RewardError => "reward_error",
            Self::MovingError => "moving_error",
            Self::ChangeError => "change_error",
        }
    }

    /// How it is computed, exactly.
    #[must_use]
    pub const fn definition(self) -> &'static str {
        match self {
            Self::RobotError => {
                "sum over pixels and channels of (imagined - true)^2 * true robot mask, divided by the picture's number of values; pictures in [0, 1], whole \
                 picture of the model, not clipped"
            }
            Self::RobotErrorOnRobot => {
                "the same sum divided by 3 times the true mask's pixels; steps without robot left out"
            }
            Self::MaskIou => {
                "intersection over union of the robot branch's mask above 0.5 and the true mask; steps where both are empty left out"
            }
            Self::ReconstructionError => {
                "mean over the picture's values of (imagined - true)^2; pictures in [0, 1], not clipped"
            }
            Self::RewardError => "absolute difference of the expected reward and the recorded one",
            Self::MovingError => {
                "mean over the channels of (imagined - true)^2 on pixels that moved: outside the true robot mask of this step and the one \
                 before, and a channel of the true pictures differs between the two by more than 16 of 255 levels; of a trajectory the mean \
                 over all such pixels; pictures in [0, 1], not clipped"
            }
            Self::ChangeError => {
                "sum of (imagined - true)^2 divided by sum of (last seen - true)^2, both over the trajectory's pixels outside the true robot \
                 mask of this step and of the last seen one in which a channel of these two true pictures differs by more than 16 of 255 \
                 levels; 1 if everything is imagined to stand still"
            }
        }
    }

    /// What it is, in words.
    #[must_use]
    pub const fn title(self) -> &'static str {
        match self {
            Self::RobotError => "robot dynamics error (MSE over the picture)",
            Self::RobotErrorOnRobot => "robot dynamics error (MSE over the robot)",
            Self::MaskIou => "IoU of the robot mask",
            Self::ReconstructionError => "reconstruction error (MSE)",
            Self::RewardError => "reward error (absolute)",
            Self::MovingError => "error on moving pixels outside the robot (MSE)",
            Self::ChangeError => "error where the scene changed, standing still = 1",
        }
    }
}

/// Every measure of every step of one trajectory; none where a step has none (no robot in sight, no mask at all, nothing that moves,
/// not a step of the trajectory).
#[derive(Debug, Clone, PartialEq)]
pub struct Trace {
    values: [Vec<Option<f64>>; Measure::ALL.len()],
    /// How much each step weighs in the mean of a measure.
    weights: [Vec<f64>; Measure::ALL.len()],
}

impl Trace {
    fn with_capacity(steps: usize) -> Self {
        let values = std::array::from_fn(|_| Vec::with_capacity(steps));
        Self { values, weights: std::array::from_fn(|_| Vec::with_capacity(steps)) }
    }

    /// The steps' values of a measure.
    #[must_use]
    pub fn of(&self, measure: Measure) -> &[Option<f64>] {
        &self.values[measure as usize]
    }

    /// Mean over the steps that have it: all weigh the same, but for [`Measure::MovingError`] as many pixels as moved and for
    /// [`Measure::ChangeError`] how much has changed.
    #[must_use]
    pub fn mean(&self, measure: Measure) -> Option<f64> {
        let steps = self.of(measure).iter().zip(&self.weights[measure as usize]);
        let (sum, weights) = steps
            .filter_map(|(value, weight)| Some(((*value)?, *weight)))
            .fold((0.0, 0.0), |(sum, weights), (value, weight)| (sum + value * weight, weights + weight));
        (weights > 0.0).then(|| sum / weights)
    }

    /// Takes the steps after the first `count` for no part of the trajectory.
    pub(super) fn end_after(&mut self, count: usize) {
        for values in &mut self.values {
            values.iter_mut().skip(count).for_each(|value| *value = None);
        }
    }
}

/// Measures states of the steps from `from` on, [B, L, ...], and what was decoded of them, against the truth of a batch with masks:
/// a trace a row.
pub fn traces(
    agent: &Agent,
    batch: &Batch,
    states: &State,
    decoded: &Decoded,
    from: usize,
) -> Result<Vec<Trace>> {
    let heads = &agent.heads.reward;
    let rewards = heads.mean(&heads.logits(&states.features()?)?)?.squeeze(2)?; // [B, L]
    let (rows, length) = rewards.dims2()?;
    let host = |x: &Tensor| x.flatten_all()?.to_dtype(DType::F32)?.to_vec1::<f32>();
    let whole = batch.first.length();
    let truth = batch.image.flatten_all()?.to_vec1::<u8>()?;
    let rewarded = host(&batch.reward)?;
    let robot = match &batch.robot_mask {
        Some(mask) => host(mask)?,
        None => vec![0.0; batch.image.elem_count() / 3],
    };
    let (imagined, rewards) = (host(&decoded.image)?, host(&rewards)?);
    // The first picture is the robot's, and of the baseline the only one.
    let mask = host(&decoded.pictures[0].mask)?;
    let pixels = pixels_of(&batch.image)?;
    let values = 3 * pixels;
    let trace = |row: usize| {
        let mut trace = Trace::with_capacity(length);
        let of = |t: usize| True {
            image: &truth[(row * whole + t) * values..][..values],
            robot: &robot[(row * whole + t) * pixels..][..pixels],
        };
        for step in 0..length {
            let (place, t) = (row * length + step, from + step);
            let frame = Frame {
                truth: of(t),
                before: t.checked_sub(1).map(of),
                seen: from.checked_sub(1).map(of),
                imagined: &imagined[place * values..][..values],
                mask: &mask[place * pixels..][..pixels],
            };
            let reward_error = f64::from((rewards[place] - rewarded[row * whole + t]).abs());
            for (measure, value) in Measure::ALL.into_iter().zip(frame.measures(reward_error)) {
                trace.values[measure as usize].push(value.map(|(value, _)| value));
                trace.weights[measure as usize].push(value.map_or(0.0, |(_, weight)| weight));
            }
        }
        trace
    };
    Ok((0..rows).map(trace).collect())
}

/// A true picture, and 1 where the robot truly is, else 0.
#[derive(Clone, Copy)]
pub(super) struct True<'a> {
    pub(super) image: &'a [u8],
    pub(super) robot: &'a [f32],
}

impl True<'_> {
    pub(super) fn pixel(&self, at: usize) -> [u8; 3] {
        self.image.as_chunks::<3>().0[at]
    }

    pub(super) fn is_robot(&self, at: usize) -> bool {
        self.robot[at] > 0.5
    }

    /// Whether a pixel outside the robot, then and now, has changed since another picture.
    pub(super) fn scene_changed(&self, since: &True<'_>, at: usize) -> bool {
        !self.is_robot(at) && !since.is_robot(at) && changed(since.pixel(at), self.pixel(at))
    }
}

/// One step's picture, found and true.
struct Frame<'a> {
    truth: True<'a>,
    /// The step before.
    before: Option<True<'a>>,
    /// The last picture that was seen.
    seen: Option<True<'a>>,
    /// In the range of `x/255 - 0.5`.
    imagined: &'a [f32],
    /// How much of a pixel the model takes for the robot's.
    mask: &'a [f32],
}

impl Frame<'_> {
    /// In the order of [`Measure::ALL`], each with its weight.
    fn measures(&self, reward_error: f64) -> [Option<(f64, f64)>; Measure::ALL.len()] {
        let (mut all, mut on_robot, mut robot_pixels) = (0.0, 0.0, 0usize);
        let (mut both, mut either) = (0usize, 0usize);
        let (mut on_moving, mut moving_pixels) = (0.0, 0usize);
        let (mut on_changed, mut still) = (0.0, 0.0);
        for at in 0..self.mask.len() {
            let truth = self.truth.pixel(at);
            let squares: f64 =
                (0..3).map(|c| (f64::from(self.imagined[3 * at + c]) - level(truth[c])).powi(2)).sum();
            let (is_robot, is_masked) = (self.truth.is_robot(at), self.mask[at] > 0.5);
            all += squares;
            if is_robot {
                on_robot += squares;
            }
            robot_pixels += usize::from(is_robot);
            both += usize::from(is_robot && is_masked);
            either += usize::from(is_robot || is_masked);
            if self.before.is_some_and(|before| self.truth.scene_changed(&before, at)) {
                on_moving += squares;
                moving_pixels += 1;
            }
            if let Some(seen) = self.seen.filter(|seen| self.truth.scene_changed(seen, at)) {
                let seen = seen.pixel(at);
                on_changed += squares;
                still += (0..3).map(|c| (level(seen[c]) - level(truth[c])).powi(2)).sum::<f64>();
            }
        }
        let share = |sum: f64, count: usize| (count > 0).then(|| sum / count as f64);
        let even = |value: Option<f64>| value.map(|value| (value, 1.0));
        [
            even(share(on_robot, self.imagined.len())),
            even(share(on_robot, 3 * robot_pixels)),
            even(share(both as f64, either)),
            even(share(all, self.imagined.len())),
            even(Some(reward_error)),
            share(on_moving, 3 * moving_pixels).map(|error| (error, moving_pixels as f64)),
            (still > 0.0).then(|| (on_changed / still, still)),
        ]
    }
}

/// In the range of `x/255 - 0.5`.
pub(super) fn level(value: u8) -> f64 {
    f64::from(value) / 255.0 - 0.5
}

#[cfg(test)]
mod tests {
    use super::*;

    const PIXELS: usize = 64 * 64;
    const VALUES: usize = 3 * PIXELS;

    fn frame<'a>(truth: True<'a>, imagined: &'a [f32], mask: &'a [f32]) -> Frame<'a> {
        Frame { truth, before: None, seen: None, imagined, mask }
    }

    fn found(frame: &Frame<'_>) -> [Option<f64>; Measure::ALL.len()] {
        frame.measures(2.0).map(|value| value.map(|(value, _)| value))
    }

    #[test]
    fn errors_and_overlap_follow_their_definitions() {
        let truth = vec![255u8; VALUES];
        let imagined = vec![0f32; VALUES]; // off by one half everywhere
        let robot: Vec<f32> = (0..PIXELS).map(|pixel| f32::from(u8::from(pixel < 1024))).collect();
        let mask: Vec<f32> =
            (0..PIXELS).map(|pixel| if (512..2048).contains(&pixel) { 0.8 } else { 0.3 }).collect();
        let found = found(&frame(True { image: &truth, robot: &robot }, &imagined, &mask));
        let expected = [0.25 * 0.25, 0.25, 512.0 / 2048.0, 0.25, 2.0];
        for (found, expected) in found.into_iter().zip(expected) {
            assert!((found.unwrap() - expected).abs() < 1e-9, "{found:?} {expected}");
        }
        assert_eq!(found[5..], [None, None], "nothing came before");
    }

    #[test]
    fn a_step_without_robot_has_no_error_on_it_and_no_overlap() {
        let (truth, imagined, none) = (vec![0u8; VALUES], vec![0f32; VALUES], vec![0f32; PIXELS]);
        let found = found(&frame(True { image: &truth, robot: &none }, &imagined, &none));
        assert_eq!(found[..3], [Some(0.0), None, None]);
    }

    #[test]
    fn what_moves_outside_the_robot_is_measured_there_alone() {
        // Pixels 0 to 9 are the robot now, 10 to 19 were; 20 to 23 changed by 51 levels since the step before, 24 to 29 before that.
        let image = |lit: std::ops::Range<usize>| -> Vec<u8> {
            (0..PIXELS).flat_map(|pixel| [if lit.contains(&pixel) { 51 } else { 0 }; 3]).collect()
        };
        let robot = |at: std::ops::Range<usize>| -> Vec<f32> {
            (0..PIXELS).map(|pixel| f32::from(u8::from(at.contains(&pixel)))).collect()
        };
        let (now, before, seen) = (image(0..30), image(24..30), image(0..0));
        let (robot_now, robot_before) = (robot(0..10), robot(10..20));
        let truth = True { image: &now, robot: &robot_now };
        // A tenth too bright on the four that moved, a fifth too dark on the six that moved earlier, far off everywhere else.
        let imagined: Vec<f32> = (0..PIXELS)
            .flat_map(|pixel| match pixel {
                20..24 => [0.2 - 0.5 + 0.1; 3],
                24..30 => [0.2 - 0.5 - 0.2; 3],
                _ => [0.5; 3],
            })
            .collect();
        let frame = Frame {
            before: Some(True { image: &before, robot: &robot_before }),
            seen: Some(True { image: &seen, robot: &robot_before }),
            ..frame(truth, &imagined, &robot_now)
        };
        let (moving, moved) = frame.measures(0.0)[Measure::MovingError as usize].unwrap();
        assert!((moving - 0.01).abs() < 1e-6, "{moving}");
        assert_eq!(moved, 4.0);
        // Standing still would be off by a fifth on all ten.
        let (change, still) = frame.measures(0.0)[Measure::ChangeError as usize].unwrap();
        assert!((change - (4.0 * 0.01 + 6.0 * 0.04) / (10.0 * 0.04)).abs() < 1e-6, "{change}");
        assert!((still - 30.0 * 0.04).abs() < 1e-6, "{still}");
    }

    #[test]
    fn a_trajectory_s_mean_weighs_steps_by_what_moved_and_ends_where_it_ends() {
        let mut trace = Trace::with_capacity(3);
        let (moving, robot) = (Measure::MovingError as usize, Measure::RobotError as usize);
        trace.values[moving] = vec![Some(1.0), None, Some(3.0)];
        trace.weights[moving] = vec![30.0, 0.0, 10.0];
        trace.values[robot] = vec![Some(1.0), Some(2.0), Some(6.0)];
        trace.weights[robot] = vec![1.0; 3];
        assert_eq!(trace.mean(Measure::MovingError), Some(1.5));
        assert_eq!(trace.mean(Measure::RobotError), Some(3.0));
        assert_eq!(trace.mean(Measure::ChangeError), None);
        trace.end_after(2);
        assert_eq!(
            (trace.mean(Measure::MovingError), trace.mean(Measure::RobotError)),
            (Some(1.0), Some(1.5))
        );
    }
}
