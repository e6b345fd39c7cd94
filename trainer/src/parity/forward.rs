use candle_core::{Device, Tensor};

use super::{ParityError, Reference};
use crate::behaviour::{self, Horizon};
use crate::model::agent::{self, Agent};
use crate::model::latent::{FirstSteps, Sampler, State};
use crate::model::parameters::Parameters;
use crate::model::rcwm::{ENVIRONMENT, ROBOT};
use crate::model::world::Observed;

/// Steps that are seen before the open loop begins.
const CONTEXT: usize = 2;

/// A group of reference tensors that we compute.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Group {
    /// Embeddings of the images.
    Encoder,
    /// Priors, posteriors and the interaction over the batch.
    Observe,
    /// Pictures and masks of both branches.
    Decode,
    /// Reward and continuation.
    Heads,
    /// Action distribution.
    Actor,
    /// Value.
    Critic,
    /// Open loop with the recorded actions.
    Imagine,
    /// Imagination with the actor: states, actions, rewards, values, weights, returns.
    Behaviour,
}

impl Group {
    /// All groups, in the order of the data.
    pub const ALL: [Self; 8] = [
        Self::Encoder,
        Self::Observe,
        Self::Decode,
        Self::Heads,
        Self::Actor,
        Self::Critic,
        Self::Imagine,
        Self::Behaviour,
    ];

    /// The first part of its tensors' names.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Encoder => "encoder",
            Self::Observe => "observe",
            Self::Decode => "decode",
            Self::Heads => "heads",
            Self::Actor => "actor",
            Self::Critic => "critic",
            Self::Imagine => "imagine",
            Self::Behaviour => "behaviour",
        }
    }
}

/// Named results.
type Named = Vec<(String, Tensor)>;

/// Our forward values on a reference's weights and inputs; every draw is the mode, every action the mean, as in the reference.
pub struct Forward<'a> {
    reference: &'a Reference,
    agent: Agent,
    embeds: Vec<Tensor>,
    actions: Tensor,
    observed: Observed,
}

impl<'a> Forward<'a> {
    pub fn new(reference: &'a Reference, device: &Device) -> Result<Self, ParityError> {
        let specs = agent::specs(&reference.settings)?;
        let parameters = Parameters::from_tensors(&specs, reference.weights(device)?, device)?;
        let agent = Agent::new(&parameters.frozen(), &reference.settings)?;
        let embeds = agent.world.encode(&reference.tensor("input/image", device)?)?;
        let actions = reference.tensor("input/action", device)?;
        let first = reference.tensor("input/is_first", device)?.flatten_all()?.to_vec1::<f32>()?;
        let first = FirstSteps::new(first.into_iter().map(|flag| flag != 0.0).collect(), reference.length);
        let observed = agent.world.observe(&embeds, &actions, &first, &mut Sampler::Mode)?;
        Ok(Self { reference, agent, embeds, actions, observed })
    }

    /// The tensors of a group under the file's names.
    pub fn compute(&mut self, group: Group) -> Result<Named, ParityError> {
        let prefix = group.as_str();
        let values = match group {
            Group::Encoder => vec![
                ("robot_embed".to_owned(), self.embeds[ROBOT].clone()),
                ("environment_embed".to_owned(), self.embeds[ENVIRONMENT].clone()),
            ],
            Group::Observe => self.observe(),
            Group::Decode => self.decode()?,
            Group::Heads => self.heads()?,
            Group::Actor => self.actor()?,
            Group::Critic => vec![("value".to_owned(), self.value()?)],
            Group::Imagine => self.imagine()?,
            Group::Behaviour => self.behaviour()?,
        };
        Ok(values.into_iter().map(|(name, value)| (format!("{prefix}/{name}"), value)).collect())
    }

    fn observe(&self) -> Named {
        let mut named = state_tensors(&self.observed.priors, "_prior");
        named.extend(state_tensors(&self.observed.posteriors, "_posterior"));
        named.extend(self.observed.interaction.iter().map(|e| ("interaction".to_owned(), e.clone())));
        named
    }

    fn decode(&self) -> Result<Named, ParityError> {
        let decoded = self.agent.world.decode(&self.observed.posteriors)?;
        let mut named = vec![("image".to_owned(), decoded.image)];
        for (branch, picture) in ["robot", "environment"].iter().zip(decoded.pictures) {
            named.push((format!("{branch}_image_masked"), picture.masked()?));
            named.push((format!("{branch}_mask"), picture.mask));
        }
        Ok(named)
    }

    fn heads(&self) -> Result<Named, ParityError> {
        let features = self.observed.posteriors.features()?;
        let heads = &self.agent.heads;
        let logits = heads.reward.logits(&features)?;
        Ok(vec![
            ("reward".to_owned(), heads.reward.mean(&logits)?),
            ("reward_logits".to_owned(), logits),
            ("continue_probability".to_owned(), heads.continue_probability(&features)?),
        ])
    }

    fn actor(&self) -> Result<Named, ParityError> {
        let action = self.agent.actor.forward(&self.observed.posteriors.features()?)?;
        let entropy = action.entropy()?;
        Ok(vec![
            ("mean".to_owned(), action.mean),
            ("std".to_owned(), action.std),
            ("entropy".to_owned(), entropy),
        ])
    }

    fn value(&self) -> Result<Tensor, ParityError> {
        let critic = &self.agent.critic;
        Ok(critic.mean(&critic.logits(&self.observed.posteriors.features()?)?)?)
    }

    fn imagine(&self) -> Result<Named, ParityError> {
        let start = self.observed.posteriors.map(|x| x.narrow(1, CONTEXT - 1, 1)?.squeeze(1))?;
        let actions = self.actions.narrow(1, CONTEXT, self.reference.length - CONTEXT)?;
        let states = self.agent.world.imagine(&start, &actions, &mut Sampler::Mode)?;
        Ok(state_tensors(&states, ""))
    }

    fn behaviour(&self) -> Result<Named, ParityError> {
        let start = self.observed.posteriors.map(|x| x.flatten(0, 1))?; // [B*T, ...]
        let horizon = Horizon { length: self.reference.horizon, ..Horizon::default() };
        let imagined = behaviour::imagine(&self.agent, &start, &horizon, &mut Sampler::Mode)?;
        let before_last = horizon.length - 1;
        Ok(vec![
            ("features".to_owned(), imagined.features),
            ("actions".to_owned(), imagined.actions),
            ("reward".to_owned(), imagined.reward),
            ("value".to_owned(), imagined.value.narrow(0, 0, before_last)?),
            ("weights".to_owned(), imagined.weights),
            ("lambda_return".to_owned(), imagined.returns.transpose(0, 1)?),
        ])
    }
}

/// `robot<suffix>/z`, `/h`, `/logits`, and the environment's.
fn state_tensors(state: &State, suffix: &str) -> Named {
    let branches = ["robot", "environment"].into_iter().zip(&state.branches);
    let tensors = branches.flat_map(|(branch, latent)| {
        [("z", &latent.z), ("h", &latent.h), ("logits", &latent.logits)]
            .map(|(name, tensor)| (format!("{branch}{suffix}/{name}"), tensor.clone()))
    });
    tensors.collect()
}
