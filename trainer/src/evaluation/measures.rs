use candle_core::{DType, Result, Tensor};
use rcwm_models::{IMAGE_CHANNELS, IMAGE_SIDE};
use serde::{Deserialize, Serialize};

use crate::learning::Batch;
use crate::model::agent::Agent;
use crate::model::latent::State;
use crate::model::world::Decoded;

const PIXELS: usize = IMAGE_SIDE * IMAGE_SIDE;
const VALUES: usize = PIXELS * IMAGE_CHANNELS;

/// What is measured of every step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Measure {
    /// Squared error of the picture times the true robot mask, mean over the whole picture's 64 * 64 * 3 values: the robot dynamics
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
}

impl Measure {
    /// All of them.
    pub const ALL: [Self; 5] = [
        Self::RobotError,
        Self::RobotErrorOnRobot,
        Self::MaskIou,
        Self::ReconstructionError,
        Self::RewardError,
    ];

    /// Its name in files.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::RobotError => "robot_error",
            Self::RobotErrorOnRobot => "robot_error_on_robot",
            Self::MaskIou => "mask_iou",
            Self::ReconstructionError => "reconstruction_error",
            Self::RewardError => "reward_error",
        }
    }

    /// How it is computed, exactly.
    #[must_use]
    pub const fn definition(self) -> &'static str {
        match self {
            Self::RobotError => {
                "sum over pixels and channels of (imagined - true)^2 * true robot mask, divided by 64*64*3; pictures in [0, 1], whole \
                 picture of the model, not clipped"
            }
            Self::RobotErrorOnRobot => {
                "the same sum divided by 3 times the true mask's pixels; steps without robot left out"
            }
            Self::MaskIou => {
                "intersection over union of the robot branch's mask above 0.5 and the true mask; steps where both are empty left out"
            }
            Self::ReconstructionError => {
                "mean over 64*64*3 values of (imagined - true)^2; pictures in [0, 1], not clipped"
            }
            Self::RewardError => "absolute difference of the expected reward and the recorded one",
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
        }
    }
}

/// Every measure of every step of one trajectory; none where a step has none (no robot in sight, no mask at all).
#[derive(Debug, Clone, PartialEq)]
pub struct Trace {
    values: [Vec<Option<f64>>; Measure::ALL.len()],
}

impl Trace {
    /// The steps' values of a measure.
    #[must_use]
    pub fn of(&self, measure: Measure) -> &[Option<f64>] {
        &self.values[measure as usize]
    }

    /// Mean over the steps that have it.
    #[must_use]
    pub fn mean(&self, measure: Measure) -> Option<f64> {
        super::statistics::mean_and_std(self.of(measure).iter().flatten().copied()).map(|(mean, _)| mean)
    }
}

/// Measures states of the steps from `from` on, [B, L, ...], and what was painted of them, against the truth of a batch with masks:
/// a trace a row.
///
/// # Errors
/// Those of candle.
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
    let part = |x: &Tensor| x.narrow(1, from, length)?.contiguous();
    let truth = part(&batch.image)?.flatten_all()?.to_vec1::<u8>()?;
    let rewarded = host(&part(&batch.reward)?)?;
    let robot = match &batch.robot_mask {
        Some(mask) => host(&part(mask)?)?,
        None => vec![0.0; rows * length * PIXELS],
    };
    let (painted, rewards) = (host(&decoded.image)?, host(&rewards)?);
    // The first picture is the robot's, and of the baseline the only one.
    let mask = host(&decoded.pictures[0].mask)?;
    let trace = |row: usize| {
        let mut trace = Trace { values: std::array::from_fn(|_| Vec::with_capacity(length)) };
        for step in row * length..(row + 1) * length {
            let frame = Frame {
                truth: &truth[step * VALUES..][..VALUES],
                painted: &painted[step * VALUES..][..VALUES],
                robot: &robot[step * PIXELS..][..PIXELS],
                mask: &mask[step * PIXELS..][..PIXELS],
            };
            let reward_error = f64::from((rewards[step] - rewarded[step]).abs());
            for (values, value) in trace.values.iter_mut().zip(frame.measures(reward_error)) {
                values.push(value);
            }
        }
        trace
    };
    Ok((0..rows).map(trace).collect())
}

/// One step's picture, found and true.
struct Frame<'a> {
    truth: &'a [u8],
    /// In the range of `x/255 - 0.5`.
    painted: &'a [f32],
    /// 1 where the robot truly is, else 0.
    robot: &'a [f32],
    /// How much of a pixel the model takes for the robot's.
    mask: &'a [f32],
}

impl Frame<'_> {
    /// In the order of [`Measure::ALL`].
    fn measures(&self, reward_error: f64) -> [Option<f64>; Measure::ALL.len()] {
        let (mut all, mut on_robot, mut robot_pixels) = (0.0, 0.0, 0usize);
        let (mut both, mut either) = (0usize, 0usize);
        let pixels = self.truth.as_chunks::<3>().0.iter().zip(self.painted.as_chunks::<3>().0);
        for ((truth, painted), (robot, mask)) in pixels.zip(self.robot.iter().zip(self.mask)) {
            let error = |(truth, painted): (&u8, &f32)| {
                (f64::from(*painted) - (f64::from(*truth) / 255.0 - 0.5)).powi(2)
            };
            let squares: f64 = truth.iter().zip(painted).map(error).sum();
            let (is_robot, is_masked) = (*robot > 0.5, *mask > 0.5);
            all += squares;
            if is_robot {
                on_robot += squares;
            }
            robot_pixels += usize::from(is_robot);
            both += usize::from(is_robot && is_masked);
            either += usize::from(is_robot || is_masked);
        }
        let share = |sum: f64, count: usize| (count > 0).then(|| sum / count as f64);
        [
            share(on_robot, VALUES),
            share(on_robot, robot_pixels * IMAGE_CHANNELS),
            share(both as f64, either),
            share(all, VALUES),
            Some(reward_error),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_and_overlap_follow_their_definitions() {
        let truth = vec![255u8; VALUES];
        let painted = vec![0f32; VALUES]; // off by one half everywhere
        let robot: Vec<f32> = (0..PIXELS).map(|pixel| f32::from(u8::from(pixel < 1024))).collect();
        let mask: Vec<f32> =
            (0..PIXELS).map(|pixel| if (512..2048).contains(&pixel) { 0.8 } else { 0.3 }).collect();
        let frame = Frame { truth: &truth, painted: &painted, robot: &robot, mask: &mask };
        let expected = [0.25 * 0.25, 0.25, 512.0 / 2048.0, 0.25, 2.0];
        for (found, expected) in frame.measures(2.0).into_iter().zip(expected) {
            assert!((found.unwrap() - expected).abs() < 1e-9, "{found:?} {expected}");
        }
    }

    #[test]
    fn a_step_without_robot_has_no_error_on_it_and_no_overlap() {
        let (truth, painted, none) = (vec![0u8; VALUES], vec![0f32; VALUES], vec![0f32; PIXELS]);
        let frame = Frame { truth: &truth, painted: &painted, robot: &none, mask: &none };
        assert_eq!(frame.measures(0.0)[..3], [Some(0.0), None, None]);
    }
}
