//! What is between the parts of a tick.

use pulp::Arch;
use rcwm_models::bundle::{BundleKind, Manifest, PartName};
use rcwm_models::wire::ActionValues;

use super::PolicyError;
use super::state::{BranchState, State};
use super::surprise::Surprise;
use crate::engine::Output;
use rcwm_kernels::tick::latents;

/// Most branches of a world model.
pub(super) const BRANCHES_MAX: usize = 2;

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
    /// What the encoder gives: `[2c, S/4, S/4]` of kind `rcwm`, `[8c, 4, 4]` of `dreamer`; only where the parts run as exported.
    pub features: Vec<f32>,
    /// In the order of [`BundleKind::branches`]; of a policy without a world model one, whose `h_next` is all that is carried on.
    pub branches: Vec<BranchBuffers>,
    /// The environment's z as the robot moves it (eq. 7), `[n, m]`; of kind `rcwm`.
    pub e: Vec<f32>,
    /// Attention map, `[n, n + k]`; of kind `rcwm`.
    pub attention: Vec<f32>,
    pub mean: ActionValues,
    /// Standard deviation of the action; zeros where the policy gives none.
    pub std: ActionValues,
    /// The branches' names.
    names: &'static [PartName],
    pub(super) classes: usize,
}

impl Buffers {
    /// Hands posterior z and h of the tick that is in the buffers to the state. Copies, allocates nothing.
    pub(super) fn give_posterior(&self, state: &mut State) {
        for (state, branch) in state.branches.iter_mut().zip(&self.branches) {
            state.z.copy_from_slice(&branch.posterior_z);
            state.h.copy_from_slice(&branch.h_next);
        }
    }

    /// Of a policy whose state is `initial`.
    pub(super) fn new(manifest: &Manifest, initial: &State) -> Self {
        let action = ActionValues::zeros(manifest.interface.action_numbers());
        let (width, rows, features) = manifest.model.as_ref().map_or((0, 0, 0), |model| {
            let (_, features) = PartName::Encoder.signature(model);
            let features = features.iter().flat_map(|spec| &spec.shape).product();
            (model.stoch_width(), model.interaction_rows(), features)
        });
        let branch = |state: &BranchState| BranchBuffers {
            h_next: state.h.clone(),
            prior_z: state.z.clone(),
            posterior_z: state.z.clone(),
            prior_log_probs: vec![0.0; width],
            posterior_log_probs: vec![0.0; width],
        };
        let branches: Vec<_> = initial.branches.iter().map(branch).collect();
        // The environment is moved by the robot; where there is one branch, nothing is between them.
        let interacts = manifest.kind == BundleKind::Rcwm;
        let n = branches.first().map_or(0, |branch| branch.prior_z.len());
        Self {
            features: vec![0.0; features],
            branches,
            e: vec![0.0; if interacts { width } else { 0 }],
            attention: vec![0.0; if interacts { n * (n + rows) } else { 0 }],
            mean: action,
            std: action,
            names: manifest.kind.branches(),
            classes: manifest.model.as_ref().map_or(0, |model| model.classes),
        }
    }
}

impl Buffers {
    /// The branches by name.
    pub(super) fn named(&mut self) -> impl Iterator<Item = (PartName, &mut BranchBuffers)> {
        self.names.iter().copied().zip(&mut self.branches)
    }

    /// None where there is no world model to be surprised.
    pub(super) fn surprise(&self) -> Option<Surprise> {
        let mut values = [0.0; BRANCHES_MAX];
        let named = self.names.iter().zip(&self.branches);
        values.iter_mut().zip(named).for_each(|(value, (_, branch))| *value = branch.surprise());
        Surprise::of(&values[..self.names.len()])
    }

    /// Whether all priors are fit to go on with.
    pub(super) fn check_priors(&self) -> Result<(), PolicyError> {
        let mut named = self.names.iter().zip(&self.branches);
        named.try_for_each(|(part, branch)| branch.check_prior(*part, self.classes))
    }

    /// Whether all posteriors are.
    pub(super) fn check_posteriors(&self) -> Result<(), PolicyError> {
        let mut named = self.names.iter().zip(&self.branches);
        named.try_for_each(|(part, branch)| branch.check_posterior(*part, self.classes))
    }

    /// The prior stands in for the posterior, as where there is no image.
    pub(super) fn believe_prior(&mut self) {
        for branch in &mut self.branches {
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

    pub(super) fn outputs(&mut self) -> [Output<'_>; 5] {
        [
            Output::F32(&mut self.h_next),
            Output::I64(&mut self.prior_z),
            Output::I64(&mut self.posterior_z),
            Output::F32(&mut self.prior_log_probs),
            Output::F32(&mut self.posterior_log_probs),
        ]
    }

    pub(super) fn check(&self, part: PartName, classes: usize) -> Result<(), PolicyError> {
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
        let mut branch = BranchBuffers { posterior_z: vec![0; 8], ..BranchBuffers::default() };
        assert!(branch.check(PartName::Robot, 8).is_ok());
        branch.posterior_z[3] = 8;
        assert!(branch.check(PartName::Robot, 8).is_err());
        branch.posterior_z[3] = -1;
        assert!(branch.check(PartName::Robot, 8).is_err());
    }
}
