//! The five parts of a tick and the buffers between them.

use pulp::Arch;
use rcwm_models::bundle::{Bundle, PartName};
use rcwm_models::settings::ModelSettings;
use rcwm_models::wire::ActionValues;

use super::{BranchState, PolicyError, State, Surprise};
use crate::engine::{self, EngineError, EngineSettings, Input, Output, Part};
use rcwm_kernels::tick::latents;

/// What a branch computes in a tick.
#[derive(Debug, Clone, Default)]
pub struct BranchBuffers {
    /// h_t, d long.
    pub h_next: Vec<f32>,
    /// z_hat_t: n classes of the prior.
    pub prior_z: Vec<i64>,
    /// z_t: n classes of the posterior.
    pub posterior_z: Vec<i64>,
    /// Log-probabilities of the prior, `[n, m]`.
    pub prior_log_probs: Vec<f32>,
    /// Log-probabilities of the posterior, `[n, m]`.
    pub posterior_log_probs: Vec<f32>,
}

/// Everything between the parts of a tick.
#[derive(Debug, Clone, Default)]
pub struct Buffers {
    /// Features of the shared encoder, `[2c, S/4, S/4]`; only where the parts run as exported.
    pub features: Vec<f32>,
    pub robot: BranchBuffers,
    /// The environment's z as the robot moves it (eq. 7), `[n, m]`.
    pub e: Vec<f32>,
    /// Attention map, `[n, n + k]`.
    pub attention: Vec<f32>,
    pub environment: BranchBuffers,
    pub mean: ActionValues,
    /// Standard deviation of the action.
    pub std: ActionValues,
    classes: usize,
}

impl Buffers {
    /// Hands posterior z and h of the tick that is in the buffers to the state. Copies, allocates nothing.
    pub(super) fn give_posterior(&self, state: &mut State) {
        for (state, branch) in [(&mut state.robot, &self.robot), (&mut state.environment, &self.environment)]
        {
            state.z.copy_from_slice(&branch.posterior_z);
            state.h.copy_from_slice(&branch.h_next);
        }
    }

    pub(super) fn new(model: &ModelSettings) -> Self {
        let (n, d, width) = (model.categoricals, model.deter, model.stoch_width());
        let side = model.image_side / 4;
        let branch = BranchBuffers {
            h_next: vec![0.0; d],
            prior_z: vec![0; n],
            posterior_z: vec![0; n],
            prior_log_probs: vec![0.0; width],
            posterior_log_probs: vec![0.0; width],
        };
        Self {
            features: vec![0.0; 2 * model.cnn_depth * side * side],
            robot: branch.clone(),
            e: vec![0.0; width],
            attention: vec![0.0; n * (n + model.interaction_rows())],
            environment: branch,
            mean: ActionValues::zeros(model.action),
            std: ActionValues::zeros(model.action),
            classes: model.classes,
        }
    }
}

impl Buffers {
    /// Both branches by name.
    pub(super) fn branches(&mut self) -> [(PartName, &mut BranchBuffers); 2] {
        [(PartName::Robot, &mut self.robot), (PartName::Environment, &mut self.environment)]
    }

    pub(super) fn surprise(&self) -> Surprise {
        Surprise { robot: self.robot.surprise(), environment: self.environment.surprise() }
    }

    /// Whether both priors are fit to go on with.
    pub(super) fn check_priors(&self) -> Result<(), PolicyError> {
        self.robot.check_prior(PartName::Robot, self.classes)?;
        self.environment.check_prior(PartName::Environment, self.classes)
    }

    /// Whether both posteriors are.
    pub(super) fn check_posteriors(&self) -> Result<(), PolicyError> {
        self.robot.check_posterior(PartName::Robot, self.classes)?;
        self.environment.check_posterior(PartName::Environment, self.classes)
    }

    /// The prior stands in for the posterior, as where there is no image.
    pub(super) fn believe_prior(&mut self) {
        for (_, branch) in self.branches() {
            branch.posterior_z.copy_from_slice(&branch.prior_z);
            branch.posterior_log_probs.copy_from_slice(&branch.prior_log_probs);
        }
    }
}

impl BranchBuffers {
    /// `KL[q || p]` of the posterior against the prior, in nats, summed over the categoricals.
    fn surprise(&self) -> f32 {
        latents::divergence(Arch::new(), &self.posterior_log_probs, &self.prior_log_probs)
    }

    fn outputs(&mut self) -> [Output<'_>; 5] {
        [
            Output::F32(&mut self.h_next),
            Output::I64(&mut self.prior_z),
            Output::I64(&mut self.posterior_z),
            Output::F32(&mut self.prior_log_probs),
            Output::F32(&mut self.posterior_log_probs),
        ]
    }

    fn check(&self, part: PartName, classes: usize) -> Result<(), PolicyError> {
        self.check_prior(part, classes)?;
        self.check_posterior(part, classes)
    }

    fn check_prior(&self, part: PartName, classes: usize) -> Result<(), PolicyError> {
        finite(part, "h_next", &self.h_next)?;
        finite(part, "prior_log_probs", &self.prior_log_probs)?;
        exists(part, "prior_z", &self.prior_z, classes)
    }

    fn check_posterior(&self, part: PartName, classes: usize) -> Result<(), PolicyError> {
        finite(part, "posterior_log_probs", &self.posterior_log_probs)?;
        exists(part, "posterior_z", &self.posterior_z, classes)
    }
}

/// A class that does not exist would be an index out of bounds in the next part.
fn exists(part: PartName, output: &'static str, z: &[i64], classes: usize) -> Result<(), PolicyError> {
    if z.iter().all(|class| (0..classes as i64).contains(class)) {
        return Ok(());
    }
    Err(PolicyError::NotFinite { part, output })
}

pub(super) fn finite(part: PartName, output: &'static str, values: &[f32]) -> Result<(), PolicyError> {
    // Summing |x| * 0 gives 0 for finite numbers and NaN otherwise, and compiles to vector instructions.
    if values.iter().map(|x| x * 0.0).sum::<f32>() == 0.0 {
        return Ok(());
    }
    Err(PolicyError::NotFinite { part, output })
}

/// The parts of a tick, loaded.
pub struct Parts {
    encoder: Box<dyn Part>,
    robot: Box<dyn Part>,
    interaction: Box<dyn Part>,
    environment: Box<dyn Part>,
    actor: Box<dyn Part>,
}

impl Parts {
    pub(super) fn load(bundle: &Bundle, settings: EngineSettings) -> Result<Self, EngineError> {
        let load = |part| engine::load(bundle, part, settings);
        Ok(Self {
            encoder: load(PartName::Encoder)?,
            robot: load(PartName::Robot)?,
            interaction: load(PartName::Interaction)?,
            environment: load(PartName::Environment)?,
            actor: load(PartName::Actor)?,
        })
    }

    pub(super) fn run_encoder(&mut self, image: &[u8], to: &mut Buffers) -> Result<(), PolicyError> {
        self.encoder.run(&[Input::U8(image)], &mut [Output::F32(&mut to.features)])?;
        finite(PartName::Encoder, "features", &to.features)
    }

    pub(super) fn run_robot(
        &mut self,
        state: &BranchState,
        action: &ActionValues,
        measured: &[f32],
        noise: &[f32],
        to: &mut Buffers,
    ) -> Result<(), PolicyError> {
        let inputs = [
            Input::I64(&state.z),
            Input::F32(&state.h),
            Input::F32(action),
            Input::F32(&to.features),
            Input::F32(noise),
            Input::F32(measured),
        ];
        // Models without a measured state have no such input.
        let inputs = &inputs[..if measured.is_empty() { 5 } else { 6 }];
        self.robot.run(inputs, &mut to.robot.outputs())?;
        to.robot.check(PartName::Robot, to.classes)
    }

    pub(super) fn run_interaction(
        &mut self,
        environment: &BranchState,
        to: &mut Buffers,
    ) -> Result<(), PolicyError> {
        // The robot's PRIOR sample: the interaction is known before the image is (A.2).
        let inputs =
            [Input::I64(&to.robot.prior_z), Input::F32(&to.robot.h_next), Input::I64(&environment.z)];
        self.interaction.run(&inputs, &mut [Output::F32(&mut to.e), Output::F32(&mut to.attention)])?;
        finite(PartName::Interaction, "e", &to.e)
    }

    pub(super) fn run_environment(
        &mut self,
        state: &BranchState,
        noise: &[f32],
        to: &mut Buffers,
    ) -> Result<(), PolicyError> {
        let inputs = [Input::F32(&to.e), Input::F32(&state.h), Input::F32(&to.features), Input::F32(noise)];
        self.environment.run(&inputs, &mut to.environment.outputs())?;
        to.environment.check(PartName::Environment, to.classes)
    }

    pub(super) fn run_actor(&mut self, to: &mut Buffers) -> Result<(), PolicyError> {
        let inputs = [
            Input::I64(&to.robot.posterior_z),
            Input::F32(&to.robot.h_next),
            Input::I64(&to.environment.posterior_z),
            Input::F32(&to.environment.h_next),
        ];
        self.actor.run(&inputs, &mut [Output::F32(&mut to.mean), Output::F32(&mut to.std)])?;
        finite(PartName::Actor, "mean", &to.mean)?;
        finite(PartName::Actor, "std", &to.std)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_number_that_is_not_finite_is_found_among_many() {
        let mut values = vec![f32::MAX; 1000];
        assert!(finite(PartName::Actor, "mean", &values).is_ok());
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            values[777] = bad;
            assert!(finite(PartName::Actor, "mean", &values).is_err());
        }
    }

    #[test]
    fn a_class_that_does_not_exist_is_found() {
        let model = ModelSettings::preset(
            rcwm_models::settings::Preset::Debug,
            rcwm_models::settings::ModelKind::Rcwm,
        );
        let mut buffers = Buffers::new(&model);
        assert!(buffers.robot.check(PartName::Robot, model.classes).is_ok());
        buffers.robot.posterior_z[3] = model.classes as i64;
        assert!(buffers.robot.check(PartName::Robot, model.classes).is_err());
        buffers.robot.posterior_z[3] = -1;
        assert!(buffers.robot.check(PartName::Robot, model.classes).is_err());
    }
}
