use std::collections::BTreeMap;

use candle_core::{DType, Result, Tensor};
use serde::{Deserialize, Serialize};

use super::measures::{True, level, pixels_of};
use super::statistics::{Bootstrap, Interval};
use crate::learning::Batch;
use crate::model::rcwm::{ENVIRONMENT, ROBOT};
use crate::model::world::Decoded;

/// What is done in place of the recorded actions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OtherActions {
    /// The robot holds still: no motion, the gripper as it was commanded last. Then the truth is known: the scene stays as it was last
    /// seen, if nothing falls or slides.
    Still,
    /// The recorded motion the other way, the gripper as recorded.
    Mirrored,
}

impl OtherActions {
    /// Its name in files and on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Still => "still",
            Self::Mirrored => "mirrored",
        }
    }

    /// What the robot does, in words.
    #[must_use]
    pub const fn title(self) -> &'static str {
        match self {
            Self::Still => "held still",
            Self::Mirrored => "mirrored",
        }
    }

    /// The actions of the steps from `context` on, [B, L, action], that take the place of a batch's.
    pub fn of(self, batch: &Batch, context: usize) -> Result<Tensor> {
        // The last number is the gripper's.
        let (motion, steps) = (batch.action.dim(2)? - 1, batch.first.length() - context);
        let recorded = batch.action.narrow(1, context, steps)?;
        match self {
            Self::Still => {
                let gripper =
                    batch.action.narrow(1, context - 1, 1)?.narrow(2, motion, 1)?.repeat((1, steps, 1))?;
                Tensor::cat(&[&recorded.narrow(2, 0, motion)?.zeros_like()?, &gripper], 2)
            }
            Self::Mirrored => {
                Tensor::cat(&[&recorded.narrow(2, 0, motion)?.neg()?, &recorded.narrow(2, motion, 1)?], 2)
            }
        }
    }
}

/// Which picture is compared, and where.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Answer {
    /// The environment branch's picture, on pixels outside the robot that have changed since the last picture seen.
    Environment,
    /// The same on pixels outside the robot that have not changed: what the actions should leave alone.
    Elsewhere,
    /// The robot branch's picture, on pixels of the robot, then or now, that have changed.
    Robot,
    /// The whole picture, where the environment's is compared.
    Picture,
    /// The whole picture, where the robot's is compared.
    PictureOnRobot,
}

impl Answer {
    /// All of them.
    pub const ALL: [Self; 5] =
        [Self::Environment, Self::Elsewhere, Self::Robot, Self::Picture, Self::PictureOnRobot];

    /// How it is computed, exactly.
    #[must_use]
    pub const fn definition(self) -> &'static str {
        match self {
            Self::Environment => {
                "the environment branch's picture times its mask; pixels outside the true robot mask of this step and of the last seen one \
                 in which a channel of these two true pictures differs by more than 16 of 255 levels"
            }
            Self::Elsewhere => {
                "the same picture on the other pixels outside both masks; no share, as the truth does not change there"
            }
            Self::Robot => {
                "the robot branch's picture times its mask; pixels inside either mask in which the two true pictures differ by more than 16 \
                 of 255 levels"
            }
            Self::Picture => "the whole picture on the environment's pixels",
            Self::PictureOnRobot => "the whole picture on the robot's pixels",
        }
    }
}

/// Two imaginations from one start, by the recorded actions and by others, with the same draws: sums over values.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Difference {
    /// Of the imagined difference times the true one.
    product: f64,
    /// Of the imagined difference, squared.
    imagined: f64,
    /// Of the true one, squared: between this step and the last that was seen.
    truth: f64,
    values: f64,
}

/// The differences of one trajectory; those of branches are missing in a model without.
pub type Differences = [Option<Difference>; Answer::ALL.len()];

/// How much of what the actions change is imagined to change.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Share {
    /// Sum of imagined times true difference, divided by the sum of the true one's square: 1 for the truth, 0 for a picture that does not
    /// depend on the actions, or not as the truth does. None where the truth is not known.
    pub share: Option<f64>,
    /// 95% bootstrap interval; episodes are drawn.
    pub interval: Option<Interval>,
    /// Root mean square of the imagined difference, in pictures in [0, 1].
    pub imagined: f64,
    /// The same of the true one.
    pub truth: f64,
}

/// What other actions change in what a model imagines.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Response {
    /// What is done in place of the recorded actions.
    pub other: OtherActions,
    /// By picture and place.
    pub answers: BTreeMap<Answer, Share>,
}

impl Response {
    /// Sums up trajectories; none where there are none.
    pub(super) fn of(found: &[Differences], other: OtherActions, bootstrap: &Bootstrap) -> Option<Self> {
        let answers = Answer::ALL.into_iter().filter_map(|answer| {
            let found: Vec<Difference> =
                found.iter().map(|found| found[answer as usize]).collect::<Option<_>>()?;
            let sum = |draw: &[usize], of: fn(&Difference) -> f64| {
                draw.iter().map(|at| of(&found[*at])).sum::<f64>()
            };
            let known = other == OtherActions::Still && answer != Answer::Elsewhere;
            let share = |draw: &[usize]| {
                let share = sum(draw, |x| x.product) / sum(draw, |x| x.truth);
                (known && share.is_finite()).then_some(share)
            };
            let all: Vec<usize> = (0..found.len()).collect();
            let values = sum(&all, |x| x.values);
            let size = |of| (sum(&all, of) / values).sqrt();
            let share = Share {
                share: share(&all),
                interval: bootstrap.interval(share),
                imagined: size(|x| x.imagined),
                truth: size(|x| x.truth),
            };
            (values > 0.0).then_some((answer, share))
        });
        let answers: BTreeMap<_, _> = answers.collect();
        (!answers.is_empty()).then_some(Self { other, answers })
    }
}

/// Compares what was imagined of the steps from `context` on by the recorded actions and by others, both [B, L, ...]. Of each row the
/// first `steps` count, context included.
pub fn differences(
    batch: &Batch,
    recorded: &Decoded,
    other: &Decoded,
    context: usize,
    steps: &[usize],
) -> Result<Vec<Differences>> {
    let host = |x: &Tensor| x.flatten_all()?.to_dtype(DType::F32)?.to_vec1::<f32>();
    let length = batch.first.length();
    let (truth, robot) = (
        batch.image.flatten_all()?.to_vec1::<u8>()?,
        match &batch.robot_mask {
            Some(mask) => host(mask)?,
            None => vec![0.0; batch.image.elem_count() / 3],
        },
    );
    let pixels = pixels_of(&batch.image)?;
    let difference = |a: &Tensor, b: &Tensor| host(&(a - b)?);
    let picture = difference(&recorded.image, &other.image)?;
    let branch = |index: usize| -> Result<Option<Vec<f32>>> {
        if recorded.pictures.len() < 2 {
            return Ok(None);
        }
        let pictures = (&recorded.pictures[index].masked()?, &other.pictures[index].masked()?);
        difference(pictures.0, pictures.1).map(Some)
    };
    let (robot_picture, environment) = (branch(ROBOT)?, branch(ENVIRONMENT)?);
    let of_row = |row: usize| {
        let of = |t: usize| True {
            image: &truth[(row * length + t) * 3 * pixels..][..3 * pixels],
            robot: &robot[(row * length + t) * pixels..][..pixels],
        };
        let seen = of(context - 1);
        let mut found = [Difference::default(); Answer::ALL.len()];
        for t in context..steps[row] {
            let (now, place) = (of(t), (row * (length - context) + t - context) * 3 * pixels);
            for at in 0..pixels {
                let mut add = |answer: Answer, picture: Option<&Vec<f32>>| {
                    let Some(picture) = picture else { return };
                    found[answer as usize].add(
                        &picture[place + 3 * at..][..3],
                        now.pixel(at),
                        seen.pixel(at),
                    );
                };
                if now.is_robot(at) || seen.is_robot(at) {
                    if super::motion::changed(seen.pixel(at), now.pixel(at)) {
                        add(Answer::Robot, robot_picture.as_ref());
                        add(Answer::PictureOnRobot, Some(&picture));
                    }
                } else if now.scene_changed(&seen, at) {
                    add(Answer::Environment, environment.as_ref());
                    add(Answer::Picture, Some(&picture));
                } else {
                    add(Answer::Elsewhere, environment.as_ref());
                }
            }
        }
        let of_branch = |answer| matches!(answer, Answer::Environment | Answer::Elsewhere | Answer::Robot);
        Answer::ALL
            .map(|answer| (environment.is_some() || !of_branch(answer)).then_some(found[answer as usize]))
    };
    Ok((0..steps.len()).map(of_row).collect())
}

impl Difference {
    fn add(&mut self, imagined: &[f32], now: [u8; 3], seen: [u8; 3]) {
        for ((imagined, now), seen) in imagined.iter().zip(now).zip(seen) {
            let (imagined, truth) = (f64::from(*imagined), level(now) - level(seen));
            self.product += imagined * truth;
            self.imagined += imagined * imagined;
            self.truth += truth * truth;
            self.values += 1.0;
        }
    }
}

#[cfg(test)]
mod tests {
    use candle_core::Device;
    use rcwm_models::episode::Episode;

    use super::*;
    use crate::evaluation::{OTHER_KIND, Recordings, TaskTrajectories};
    use crate::model::decoder::Picture;

    const STEPS: usize = 4;
    const CONTEXT: usize = 2;

    fn is_robot(t: usize, y: usize, x: usize) -> bool {
        y < 8 && (4 * t..4 * t + 8).contains(&x)
    }

    /// The robot goes right at the top; a block in the middle is lit from step 2 on.
    fn batch() -> Batch {
        let image = ndarray::Array4::from_shape_fn((STEPS, 64, 64, 3), |(t, y, x, _)| {
            if is_robot(t, y, x) { 255 } else { 102 * u8::from(t >= CONTEXT && is_block(y, x)) }
        });
        let mut recordings = Recordings::default();
        let episode = Episode {
            image,
            action: ndarray::Array2::from_shape_fn((STEPS, 4), |(t, i)| 0.1 * (t * 4 + i) as f32),
            robot_mask: Some(ndarray::Array3::from_shape_fn((STEPS, 64, 64), |(t, y, x)| is_robot(t, y, x))),
            ..Episode::blank(STEPS)
        };
        recordings.add("push", OTHER_KIND, episode).unwrap();
        TaskTrajectories::whole(&recordings, "push", STEPS, 0).unwrap().batch(0, 1, &Device::Cpu).unwrap()
    }

    fn is_block(y: usize, x: usize) -> bool {
        (30..34).contains(&y) && (20..28).contains(&x)
    }

    /// What is imagined of steps 2 and 3: `block` is how bright the block is, `noise` how bright a corner.
    fn decoded(block: f32, noise: f32) -> Decoded {
        let image = |on: bool| {
            let values: Vec<f32> = (0..2 * 64 * 64)
                .flat_map(|at| {
                    let (y, x) = (at / 64 % 64, at % 64);
                    let value = if is_block(y, x) {
                        block
                    } else if y > 60 {
                        noise
                    } else {
                        0.0
                    };
                    [if on { value } else { 0.0 }; 3]
                })
                .collect();
            Tensor::from_vec(values, (1, 2, 64, 64, 3), &Device::Cpu).unwrap()
        };
        let mask = Tensor::ones((1, 2, 64, 64, 1), DType::F32, &Device::Cpu).unwrap();
        let pictures =
            vec![Picture { image: image(false), mask: mask.clone() }, Picture { image: image(true), mask }];
        Decoded { image: image(true), pictures }
    }

    fn response(recorded: &Decoded, other: &Decoded) -> Response {
        let found = differences(&batch(), recorded, other, CONTEXT, &[STEPS]).unwrap();
        Response::of(&found, OtherActions::Still, &Bootstrap::new(&[0], 0)).unwrap()
    }

    #[test]
    fn the_environment_s_share_is_how_much_of_the_true_change_depends_on_the_actions() {
        let of = |recorded, other| response(&recorded, &other).answers;
        let whole = of(decoded(0.4, 0.0), decoded(0.0, 0.0));
        assert!((whole[&Answer::Environment].share.unwrap() - 1.0).abs() < 1e-6);
        assert!((whole[&Answer::Environment].truth - 0.4).abs() < 1e-6);
        assert_eq!(whole[&Answer::Robot].share, Some(0.0), "the robot branch does the same in both");
        assert!(whole[&Answer::Robot].truth > 0.5 && whole[&Answer::Elsewhere].imagined == 0.0);
        let half = of(decoded(0.3, 0.0), decoded(0.1, 0.0));
        assert!((half[&Answer::Environment].share.unwrap() - 0.5).abs() < 1e-6);
        let none = of(decoded(0.4, 0.2), decoded(0.4, 0.0));
        assert_eq!(none[&Answer::Environment].share, Some(0.0), "right, but whatever the robot does");
        assert!(none[&Answer::Elsewhere].imagined > 0.01 && none[&Answer::Elsewhere].share.is_none());
        let wrong = of(decoded(0.0, 0.0), decoded(0.4, 0.0));
        assert!((wrong[&Answer::Environment].share.unwrap() + 1.0).abs() < 1e-6, "the other way round");
    }

    #[test]
    fn steps_after_the_end_of_a_trajectory_do_not_count() {
        let of =
            |steps| differences(&batch(), &decoded(0.4, 0.0), &decoded(0.0, 0.0), CONTEXT, &[steps]).unwrap();
        let values = |found: &[Differences]| found[0][Answer::Environment as usize].unwrap().values;
        assert_eq!((values(&of(STEPS)), values(&of(STEPS - 1))), (2.0 * 96.0, 96.0));
    }

    #[test]
    fn other_actions_keep_the_gripper() {
        let batch = batch();
        let of = |other: OtherActions| {
            other.of(&batch, CONTEXT).unwrap().squeeze(0).unwrap().to_vec2::<f32>().unwrap()
        };
        let held = 0.1 * 7.0;
        assert_eq!(of(OtherActions::Still), [[0.0, 0.0, 0.0, held], [0.0, 0.0, 0.0, held]]);
        let mirrored = of(OtherActions::Mirrored);
        assert_eq!(mirrored[0], [-0.1f32 * 8.0, -0.1 * 9.0, -0.1 * 10.0, 0.1 * 11.0]);
    }
}
