//! The Robo-Centric World Model: a robot branch that acts, an environment branch that is acted upon.

use candle_core::{Result, Tensor};
use rcwm_models::settings::ModelSettings;

use super::batch::{Decoded, Observed, at_step, normalised_action, sequence};
use super::branch::Branch;
use super::decoder::Decoder;
use super::encoder::{ConvStack, branch_channels, flatten_channels_first, image_to_float};
use super::interaction::Interaction;
use super::latent::{FirstSteps, Latent, Sampler, State};
use super::measured::Measured;
use super::parameters::{Built, Scope};

/// Index of the robot in a [`State`].
pub const ROBOT: usize = 0;
/// Index of the environment in a [`State`].
pub const ENVIRONMENT: usize = 1;

/// Encoder, two branches, interaction, two decoders. Fields with two entries hold the robot's first.
#[derive(Debug, Clone)]
pub struct Rcwm {
    /// Convolutions that both branches share.
    pub shared_encoder: ConvStack,
    /// Each branch's own convolutions.
    pub encoders: [ConvStack; 2],
    /// The recurrent parts.
    pub branches: [Branch; 2],
    /// Robot to environment.
    pub interaction: Interaction,
    /// Each branch's picture.
    pub decoders: [Decoder; 2],
    /// The robot's measured state, where the model looks at it.
    pub measured: Option<Measured>,
}

impl Rcwm {
    /// Parts `encoder.*`, `robot.*`, `interaction.*`, `environment.*`, `decoder.*`.
    pub fn new(scope: &Scope<'_>, settings: &ModelSettings) -> Built<Self> {
        let (c, nm) = (settings.cnn_depth, settings.stoch_width());
        let encoder = scope.at("encoder");
        let channels = branch_channels(settings);
        let own = |name| ConvStack::new(&encoder.at(name), &channels);
        let embed = 16 * 4 * c;
        let branch = |name, input, embed| Branch::new(&scope.at(name), settings, input, embed);
        let decoder = |name| Decoder::new(&scope.at("decoder").at(name), settings);
        Ok(Self {
            shared_encoder: ConvStack::new(&encoder.at("shared"), &[settings.image_channels(), c, 2 * c])?,
            encoders: [own("robot")?, own("environment")?],
            branches: [
                branch("robot", nm + settings.action, embed + Measured::width(settings))?,
                branch("environment", nm, embed)?,
            ],
            interaction: Interaction::new(&scope.at("interaction"), settings)?,
            decoders: [decoder("robot")?, decoder("environment")?],
            measured: Measured::new(scope, settings)?,
        })
    }

    /// Embeddings of u8 images [N, S, S, 3 C], robot's and environment's: [N, 16*4c] each, the robot's with what it measured
    /// [N, state], [N, 16*4c + hidden].
    pub fn encode(&self, images: &Tensor, state: Option<&Tensor>) -> Result<Vec<Tensor>> {
        let features = self.features(images)?;
        Ok(vec![self.embed_robot(&features, state)?, self.embed(ENVIRONMENT, &features)?])
    }

    /// The robot's embedding of features [N, S/4, S/4, 2c] and of what it measured [N, state].
    pub fn embed_robot(&self, features: &Tensor, state: Option<&Tensor>) -> Result<Tensor> {
        let embed = self.embed(ROBOT, features)?;
        match &self.measured {
            Some(measured) => measured.join(&embed, state),
            None => Ok(embed),
        }
    }

    /// Features of u8 images [N, S, S, 3 C] that both branches see: [N, S/4, S/4, 2c].
    pub fn features(&self, images: &Tensor) -> Result<Tensor> {
        self.shared_encoder.forward(&image_to_float(images)?)
    }

    /// A branch's embedding [N, 16*4c] of features [N, S/4, S/4, 2c].
    pub fn embed(&self, branch: usize, features: &Tensor) -> Result<Tensor> {
        flatten_channels_first(&self.encoders[branch].forward(features)?)
    }

    /// The learned state an episode starts from.
    pub fn initial(&self, batch: usize) -> Result<State> {
        let branches = self.branches.iter().map(|branch| branch.initial(batch)).collect::<Result<_>>()?;
        Ok(State { branches })
    }

    /// Robot h_t [B, d] from its z_{t-1}, h_{t-1} and the action a_{t-1} [B, action] (eq. 5, 6 left).
    pub fn recur_robot(&self, previous: &Latent, action: &Tensor) -> Result<Tensor> {
        let x = Tensor::cat(&[&previous.z.flatten_from(1)?, &normalised_action(action)?], 1)?;
        self.branches[ROBOT].recur(&x, &previous.h)
    }

    /// Environment h_t [B, d] from e_{t-1} [B, n, m] and its h_{t-1} (eq. 5, 6 right). It never sees the action.
    pub fn recur_environment(&self, e: &Tensor, h: &Tensor) -> Result<Tensor> {
        self.branches[ENVIRONMENT].recur(&e.flatten_from(1)?, h)
    }

    /// Filters a batch of sequences: `embeds` [B, T, E] per branch, `actions` [B, T, action], each the one that led to its image.
    pub fn observe(
        &self,
        embeds: &[Tensor],
        actions: &Tensor,
        first: &FirstSteps,
        sampler: &mut Sampler,
    ) -> Result<Observed> {
        let [robot, environment] = &self.branches;
        let robot_share = sequence(&robot.embed_share(&embeds[ROBOT])?)?; // [T, B, hidden]
        let environment_share = sequence(&environment.embed_share(&embeds[ENVIRONMENT])?)?;
        let actions = sequence(actions)?; // [T, B, action]
        let initial = self.initial(first.batch())?;
        let mut previous = initial.clone();
        let mut posteriors = Vec::with_capacity(first.length());
        let mut robot_priors = Vec::with_capacity(first.length());
        let mut interactions = Vec::with_capacity(first.length());
        for t in 0..first.length() {
            let carry = first.carry(t, actions.device())?;
            previous = carry.select_state(&initial, &previous)?;
            let action = at_step(&actions, t)?;
            let action = carry.select(&action.zeros_like()?, &action)?;

            let robot_h = self.recur_robot(&previous.branches[ROBOT], &action)?;
            let prior = robot.draw(robot.prior_logits(&robot_h)?, &robot_h, sampler)?;
            let logits = robot.posterior_logits(&robot_h, &at_step(&robot_share, t)?)?;
            let robot_posterior = robot.draw(logits, &robot_h, sampler)?;

            let before = &previous.branches[ENVIRONMENT];
            let (e, _) = self.interaction.forward(&prior.z, &robot_h, &before.z)?;
            let environment_h = self.recur_environment(&e, &before.h)?;
            let logits = environment.posterior_logits(&environment_h, &at_step(&environment_share, t)?)?;
            let environment_posterior = environment.draw(logits, &environment_h, sampler)?;

            previous = State { branches: vec![robot_posterior, environment_posterior] };
            posteriors.push(previous.clone());
            robot_priors.push(prior);
            interactions.push(e);
        }
        let posteriors = State::stack(&posteriors, 1)?; // [B, T, ...]
        // Nothing in the scan needs the environment's prior: its head runs once over all steps.
        let environment_h = &posteriors.branches[ENVIRONMENT].h;
        let logits = environment.prior_logits(environment_h)?;
        let environment_prior = environment.draw(logits, environment_h, sampler)?;
        let priors = State { branches: vec![Latent::stack(robot_priors.iter(), 1)?, environment_prior] };
        Ok(Observed { priors, posteriors, interaction: Some(Tensor::stack(&interactions, 1)?) })
    }

    /// One imagined step: the state after `action` [B, action], drawn from the priors.
    pub fn imagine_step(&self, state: &State, action: &Tensor, sampler: &mut Sampler) -> Result<State> {
        self.attend_step(state, action, sampler).map(|(state, _)| state)
    }

    /// The same, with the attention map [B, n, n+k] of the interaction that led to it.
    pub fn attend_step(
        &self,
        state: &State,
        action: &Tensor,
        sampler: &mut Sampler,
    ) -> Result<(State, Tensor)> {
        let [robot, environment] = &self.branches;
        let h = self.recur_robot(&state.branches[ROBOT], action)?;
        let robot = robot.draw(robot.prior_logits(&h)?, &h, sampler)?;
        let before = &state.branches[ENVIRONMENT];
        let (e, attention) = self.interaction.forward(&robot.z, &robot.h, &before.z)?;
        let h = self.recur_environment(&e, &before.h)?;
        let environment = environment.draw(environment.prior_logits(&h)?, &h, sampler)?;
        Ok((State { branches: vec![robot, environment] }, attention))
    }

    /// Both branches' pictures and their sum (eq. 8).
    pub fn decode(&self, state: &State) -> Result<Decoded> {
        let pairs = self.decoders.iter().zip(&state.branches);
        let pictures = pairs
            .map(|(decoder, latent)| decoder.forward(&latent.features()?))
            .collect::<Result<Vec<_>>>()?;
        let image = (pictures[ROBOT].masked()? + pictures[ENVIRONMENT].masked()?)?;
        Ok(Decoded { image, pictures })
    }
}
