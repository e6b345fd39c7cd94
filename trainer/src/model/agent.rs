//! Everything that is learned, together.

use candle_core::Device;
use rcwm_models::settings::ModelSettings;

use super::heads::{Actor, Heads, TwoHotHead};
use super::parameters::{ParameterError, ParameterSpec, Parameters, Recorder, Scope};
use super::world::World;

/// World model, heads, actor, critic and the critic's slow copy.
#[derive(Debug, Clone)]
pub struct Agent {
    /// The sizes.
    pub settings: ModelSettings,
    /// Encoder, dynamics, decoder.
    pub world: World,
    /// Reward and continuation.
    pub heads: Heads,
    /// The policy.
    pub actor: Actor,
    /// Its value.
    pub critic: TwoHotHead,
    /// Exponential average of the critic, a regression target.
    pub slow_critic: TwoHotHead,
}

impl Agent {
    /// An agent on the parameters of `scope`.
    pub fn new(scope: &Scope<'_>, settings: &ModelSettings) -> Result<Self, ParameterError> {
        Ok(Self {
            settings: settings.clone(),
            world: World::new(scope, settings)?,
            heads: Heads::new(&scope.at("heads"), settings)?,
            actor: Actor::new(&scope.at("actor"), settings)?,
            critic: TwoHotHead::new(&scope.at("critic"), settings)?,
            slow_critic: TwoHotHead::new(&scope.at("slow_critic"), settings)?,
        })
    }
}

/// Every parameter of an agent of these sizes.
pub fn specs(settings: &ModelSettings) -> Result<Vec<ParameterSpec>, ParameterError> {
    let recorder = Recorder::default();
    Agent::new(&recorder.scope(), settings)?;
    Ok(recorder.into_specs())
}

/// Fresh parameters of an agent of these sizes; the same seed gives the same weights.
pub fn initialise(
    settings: &ModelSettings,
    seed: u64,
    device: &Device,
) -> Result<Parameters, ParameterError> {
    Parameters::initialise(&specs(settings)?, seed, device)
}

/// A named group of parameters, as the table of parts shows it.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Part {
    /// Common beginning of the names.
    pub name: String,
    /// Scalars in it.
    pub parameters: usize,
}

/// The parts of an agent, in the order of the data, with their numbers of parameters.
pub fn parts(settings: &ModelSettings) -> Result<Vec<Part>, ParameterError> {
    let mut parts: Vec<Part> = Vec::new();
    for spec in specs(settings)? {
        let name = part_of(&spec.name);
        let parameters = spec.shape.iter().product();
        match parts.iter_mut().find(|part| part.name == name) {
            Some(part) => part.parameters += parameters,
            None => parts.push(Part { name: name.to_owned(), parameters }),
        }
    }
    Ok(parts)
}

/// `encoder.robot.0.conv.weight` belongs to `encoder.robot`, `robot.cell.linear.weight` to `robot`.
fn part_of(name: &str) -> &str {
    let mut dots = name.match_indices('.').map(|(at, _)| at);
    let first = dots.next().unwrap_or(name.len());
    let second = dots.next().unwrap_or(name.len());
    let has_parts = matches!(&name[..first], "encoder" | "decoder" | "heads");
    let is_word = |text: &str| text.chars().all(char::is_alphabetic);
    let inner = name.get(first + 1..second).unwrap_or_default();
    if has_parts && is_word(inner) && inner != "linear" { &name[..second] } else { &name[..first] }
}
