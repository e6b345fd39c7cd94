use candle_core::{Device, Tensor};

use super::{Group, ParityError, Reference};
use crate::behaviour::{self, BehaviourSettings, ReturnRange};
use crate::learning::Batch;
use crate::model::agent::{self, Agent};
use crate::model::latent::{FirstSteps, Sampler, State};
use crate::model::parameters::Parameters;
use crate::model::rcwm::{ENVIRONMENT, ROBOT};
use crate::model::world::Observed;

/// Steps that are seen before the open loop begins.
const CONTEXT: usize = 2;

/// Named results.
pub(super) type Named = Vec<(String, Tensor)>;

/// Our forward values on a reference's weights and inputs; every draw is the mode, every action the mean, as in the reference.
pub(super) struct Forward<'a> {
    reference: &'a Reference,
    agent: Agent,
    embeds: Vec<Tensor>,
    actions: Tensor,
    observed: Observed,
}

impl<'a> Forward<'a> {
    pub fn new(reference: &'a Reference, device: &Device) -> Result<Self, ParityError> {
        let parameters = parameters(reference, device)?;
        let agent = Agent::new(&parameters.frozen(), &reference.settings)?;
        let Batch { image, action: actions, first, .. } = batch(reference, device)?;
        let embeds = agent.world.encode(&image, None)?;
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
            _ => Vec::new(),
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
        let settings = behaviour_settings(self.reference);
        let start = self.observed.posteriors.map(|x| x.flatten(0, 1))?; // [B*T, ...]
        let imagined = behaviour::imagine(&self.agent, &start, &settings.horizon, &mut Sampler::Mode)?;
        let before_last = settings.horizon.length - 1;
        // The file also holds the action that would be taken in the last state.
        let last =
            self.agent.actor.forward(&imagined.features.get(before_last)?)?.sample(&mut Sampler::Mode)?;
        let mut range = ReturnRange::default();
        range.update(&imagined.returns, &settings)?;
        let range = Tensor::new(&[range.low as f32, range.high as f32], imagined.returns.device())?;
        Ok(vec![
            ("features".to_owned(), imagined.features),
            ("actions".to_owned(), Tensor::cat(&[&imagined.actions, &last.unsqueeze(0)?], 0)?),
            ("reward".to_owned(), imagined.reward),
            ("value".to_owned(), imagined.value.narrow(0, 0, before_last)?),
            ("weights".to_owned(), imagined.weights),
            ("lambda_return".to_owned(), imagined.returns.transpose(0, 1)?),
            ("return_range".to_owned(), range),
        ])
    }
}

/// The file's weights.
pub(super) fn parameters(reference: &Reference, device: &Device) -> Result<Parameters, ParityError> {
    let specs = agent::specs(&reference.settings)?;
    Ok(Parameters::from_tensors(&specs, reference.weights(device)?, device)?)
}

/// The file's inputs.
pub(super) fn batch(reference: &Reference, device: &Device) -> Result<Batch, ParityError> {
    let input = |name: &str| reference.tensor(&format!("input/{name}"), device);
    let first = input("is_first")?.flatten_all()?.to_vec1::<f32>()?;
    Ok(Batch {
        seen: None,
        image: input("image")?,
        action: input("action")?,
        state: None,
        reward: input("reward")?,
        terminal: input("is_terminal")?,
        first: FirstSteps::new(first.into_iter().map(|flag| flag != 0.0).collect(), reference.length),
        robot_mask: Some(input("robot_mask")?),
        pushed: vec![false; reference.batch * reference.length],
        number: 0,
    })
}

/// The paper's settings with the file's horizon. In the file, the critic's gradients hold those of the actor's loss as well (a
/// least-squares fit finds both with a factor of 1), against the definition: that is switched on here and nowhere else.
pub(super) fn behaviour_settings(reference: &Reference) -> BehaviourSettings {
    let mut settings = BehaviourSettings { actor_loss_reaches_critic: true, ..BehaviourSettings::default() };
    settings.horizon.length = reference.horizon;
    settings
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
