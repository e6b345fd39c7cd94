/// What a parameter belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// What knows the robot: shared encoder, robot's encoder, dynamics and decoder. All of the vanilla baseline's but its heads.
    Robot,
    /// What knows the scene and the task: environment's encoder, dynamics and decoder, interaction, reward, continuation.
    Environment,
    Actor,
    Critic,
    /// The critic's slow copy, which no gradient trains.
    SlowCritic,
}

/// The side of the parameter of this name.
#[must_use]
pub fn side_of(name: &str) -> Side {
    let mut words = name.split('.');
    match (words.next().unwrap_or_default(), words.next().unwrap_or_default()) {
        ("actor", _) => Side::Actor,
        ("critic", _) => Side::Critic,
        ("slow_critic", _) => Side::SlowCritic,
        ("environment" | "interaction" | "heads", _) | ("encoder" | "decoder", "environment") => {
            Side::Environment
        }
        _ => Side::Robot,
    }
}

/// Which parameters a loss trains; the others are frozen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Trained {
    /// The whole world model with its heads.
    World,
    /// The environment's side alone (first stage of few-shot adaptation).
    Environment,
    /// The whole world model and the actor, by one loss.
    WorldAndActor,
    /// The environment's side and the actor, by one loss.
    EnvironmentAndActor,
    Actor,
    Critic,
    /// Actor and critic by one loss.
    Behaviour,
    Nothing,
}

impl Trained {
    /// Whether it holds this parameter, as a plain function of the name.
    #[must_use]
    pub fn filter(self) -> fn(&str) -> bool {
        match self {
            Self::World => |name| matches!(side_of(name), Side::Robot | Side::Environment),
            Self::Environment => |name| side_of(name) == Side::Environment,
            Self::WorldAndActor => {
                |name| matches!(side_of(name), Side::Robot | Side::Environment | Side::Actor)
            }
            Self::EnvironmentAndActor => |name| matches!(side_of(name), Side::Environment | Side::Actor),
            Self::Actor => |name| side_of(name) == Side::Actor,
            Self::Critic => |name| side_of(name) == Side::Critic,
            Self::Behaviour => |name| matches!(side_of(name), Side::Actor | Side::Critic),
            Self::Nothing => |_| false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_fall_on_their_sides() {
        for (name, side) in [
            ("encoder.shared.0.conv.weight", Side::Robot),
            ("encoder.0.conv.weight", Side::Robot),
            ("encoder.environment.0.conv.weight", Side::Environment),
            ("decoder.robot.linear.bias", Side::Robot),
            ("decoder.environment.linear.bias", Side::Environment),
            ("robot.initial", Side::Robot),
            ("environment.initial", Side::Environment),
            ("interaction.key.bias", Side::Environment),
            ("heads.reward.out.weight", Side::Environment),
            ("dynamics.cell.norm.bias", Side::Robot),
            ("actor.out.bias", Side::Actor),
            ("critic.out.bias", Side::Critic),
            ("slow_critic.out.bias", Side::SlowCritic),
        ] {
            assert_eq!(side_of(name), side, "{name}");
        }
    }
}
