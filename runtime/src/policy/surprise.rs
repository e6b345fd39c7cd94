//! How unexpected an observation was, and how much of it is borne.

use rcwm_models::bundle::{BundleKind, PartName};
use serde::{Deserialize, Serialize};

/// How far what was observed is from what was expected, per branch: `KL[q || p]` of posterior against prior in nats, summed over
/// the categoricals.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(from = "[f32; 2]", into = "[f32; 2]")]
pub enum Surprise {
    /// The robot's says "my arm does not move as I expect", the environment's "the scene changed".
    Rcwm {
        /// Robot branch.
        robot: f32,
        /// Environment branch.
        environment: f32,
    },
    /// A world model of one branch cannot tell the two apart.
    Dreamer(f32),
}

impl Surprise {
    /// Of the branches in their kind's order; none where there is no world model.
    pub(super) fn of(branches: &[f32]) -> Option<Self> {
        match branches {
            [dynamics] => Some(Self::Dreamer(*dynamics)),
            [robot, environment] => Some(Self::Rcwm { robot: *robot, environment: *environment }),
            _ => None,
        }
    }

    /// The bits of each branch's number, to compare with.
    #[must_use]
    pub fn to_bits(self) -> [u32; 2] {
        <[f32; 2]>::from(self).map(f32::to_bits)
    }
}

// In a log there are always two numbers; a divergence is one, so that NaN says that there is no second branch.
impl From<Surprise> for [f32; 2] {
    fn from(surprise: Surprise) -> Self {
        match surprise {
            Surprise::Rcwm { robot, environment } => [robot, environment],
            Surprise::Dreamer(dynamics) => [dynamics, f32::NAN],
        }
    }
}

impl From<[f32; 2]> for Surprise {
    fn from([first, second]: [f32; 2]) -> Self {
        if second.is_nan() { Self::Dreamer(first) } else { Self::Rcwm { robot: first, environment: second } }
    }
}

/// Largest surprise that is borne, in nats; none for any.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct SurpriseLimits {
    /// Of the robot branch.
    pub robot_max: Option<f32>,
    /// Of the environment branch.
    pub environment_max: Option<f32>,
    /// Of a world model of one branch.
    pub dynamics_max: Option<f32>,
}

/// A limit of a surprise that the policy does not have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("--surprise-{limit}-max: a policy of kind {kind} {}", instead(*kind))]
pub struct NoSuchSurprise {
    /// Whose surprise.
    pub limit: PartName,
    pub kind: BundleKind,
}

fn instead(kind: BundleKind) -> &'static str {
    match kind {
        BundleKind::Rcwm => {
            "has one surprise for each branch: use --surprise-robot-max, --surprise-environment-max"
        }
        BundleKind::Dreamer => "has one surprise: use --surprise-dynamics-max",
        BundleKind::Recurrent => "has no world model and no surprise: leave it out",
    }
}

impl SurpriseLimits {
    /// A limit that says nothing is a limit that is not there: every one must be of a branch that the kind has.
    ///
    /// # Errors
    /// The first that is not.
    pub fn check(&self, kind: BundleKind) -> Result<(), NoSuchSurprise> {
        let of = [
            (PartName::Robot, self.robot_max),
            (PartName::Environment, self.environment_max),
            (PartName::Dynamics, self.dynamics_max),
        ];
        match of.into_iter().find(|(branch, max)| max.is_some() && !kind.branches().contains(branch)) {
            None => Ok(()),
            Some((limit, _)) => Err(NoSuchSurprise { limit, kind }),
        }
    }

    /// The branch whose surprise is over its limit, the robot's first.
    #[must_use]
    pub fn exceeded_by(&self, surprise: &Surprise) -> Option<PartName> {
        // Written so that NaN is over every limit.
        let over = |value: f32, max: Option<f32>| {
            max.is_some_and(|max| !matches!(value.partial_cmp(&max), Some(order) if order.is_le()))
        };
        match *surprise {
            Surprise::Rcwm { robot, .. } if over(robot, self.robot_max) => Some(PartName::Robot),
            Surprise::Rcwm { environment, .. } if over(environment, self.environment_max) => {
                Some(PartName::Environment)
            }
            Surprise::Dreamer(dynamics) if over(dynamics, self.dynamics_max) => Some(PartName::Dynamics),
            Surprise::Rcwm { .. } | Surprise::Dreamer(_) => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_branch_has_its_own_limit_and_no_number_passes_one() {
        let limits =
            SurpriseLimits { robot_max: Some(2.0), environment_max: Some(5.0), dynamics_max: Some(7.0) };
        let exceeded = |robot, environment| limits.exceeded_by(&Surprise::Rcwm { robot, environment });
        assert_eq!(exceeded(2.0, 5.0), None);
        assert_eq!(exceeded(2.1, 9.0), Some(PartName::Robot));
        assert_eq!(exceeded(0.0, 5.1), Some(PartName::Environment));
        assert_eq!(exceeded(f32::NAN, 0.0), Some(PartName::Robot));
        let exceeded = |dynamics| limits.exceeded_by(&Surprise::Dreamer(dynamics));
        assert_eq!((exceeded(7.0), exceeded(7.1)), (None, Some(PartName::Dynamics)));
        assert_eq!(exceeded(f32::NAN), Some(PartName::Dynamics));
        let none = SurpriseLimits::default();
        let huge = Surprise::Rcwm { robot: 1e9, environment: f32::INFINITY };
        assert_eq!((none.exceeded_by(&huge), none.exceeded_by(&Surprise::Dreamer(1e9))), (None, None));
    }

    #[test]
    fn a_limit_of_a_branch_that_the_kind_does_not_have_is_refused_by_its_name() {
        let robot = SurpriseLimits { robot_max: Some(1.0), ..SurpriseLimits::default() };
        let dynamics = SurpriseLimits { dynamics_max: Some(1.0), ..SurpriseLimits::default() };
        let said = |limits: SurpriseLimits, kind| limits.check(kind).map_err(|error| error.to_string());
        assert_eq!(said(robot, BundleKind::Rcwm), Ok(()));
        assert_eq!(said(dynamics, BundleKind::Dreamer), Ok(()));
        assert_eq!(said(SurpriseLimits::default(), BundleKind::Recurrent), Ok(()));
        let refused = said(robot, BundleKind::Dreamer).unwrap_err();
        assert!(
            refused.contains("--surprise-robot-max") && refused.contains("--surprise-dynamics-max"),
            "{refused}"
        );
        assert!(said(dynamics, BundleKind::Rcwm).unwrap_err().contains("--surprise-environment-max"));
        assert!(said(dynamics, BundleKind::Recurrent).unwrap_err().contains("no surprise"));
    }

    #[test]
    fn a_log_tells_one_branch_from_two() {
        for surprise in [Surprise::Rcwm { robot: 1.5, environment: 0.25 }, Surprise::Dreamer(2.5)] {
            let bytes = postcard::to_stdvec(&surprise).unwrap();
            assert_eq!((bytes.len(), postcard::from_bytes::<Surprise>(&bytes).unwrap()), (8, surprise));
        }
    }
}
