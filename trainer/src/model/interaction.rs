//! What the robot does to the environment (eq. 7, A.2).

use candle_core::{Result, Tensor};
use rcwm_models::settings::ModelSettings;

use super::init::Init;
use super::layers::{Linear, Norm};
use super::parameters::{Built, Scope};
use crate::ops;

/// Epsilon of this part's LayerNorm.
pub const INTERACTION_NORM_EPS: f64 = 1e-5;

/// Cross-attention: the environment's z asks, the robot's prior answers.
#[derive(Debug, Clone)]
pub struct Interaction {
    deter: Linear,
    query: Linear,
    key: Linear,
    value: Linear,
    output: Linear,
    norm: Norm,
    rows: usize,
    classes: usize,
}

impl Interaction {
    /// `deter`, `query`, `key`, `value`, `output`, `norm`.
    pub fn new(scope: &Scope<'_>, settings: &ModelSettings) -> Built<Self> {
        let (d, m) = (settings.deter, settings.classes);
        let linear = |name: &str, width: usize| {
            Linear::new(&scope.at(name), width, width, Init::TruncatedNormal { fans: 2 * width })
        };
        Ok(Self {
            deter: linear("deter", d)?,
            query: linear("query", m)?,
            key: linear("key", m)?,
            value: linear("value", m)?,
            output: linear("output", m)?,
            norm: Norm::new(&scope.at("norm"), m, INTERACTION_NORM_EPS)?,
            rows: settings.interaction_rows(),
            classes: m,
        })
    }

    /// The interaction features e_{t-1} [B, n, m] and the attention map [B, n, n+k], from the robot's prior z_t [B, n, m],
    /// its h_t [B, d] and the environment's z_{t-1} [B, n, m].
    pub fn forward(
        &self,
        robot_prior_z: &Tensor,
        robot_h: &Tensor,
        environment_z: &Tensor,
    ) -> Result<(Tensor, Tensor)> {
        let (x, attention) = self.attend(robot_prior_z, robot_h, environment_z)?;
        let e = self.norm.forward(&(environment_z + x)?)?; // [B, n, m]
        Ok((e, attention))
    }

    /// What the environment receives from the robot, x = W_o softmax(Q K^T / sqrt(m)) V [B, n, m], and the attention map, from the same.
    pub fn attend(
        &self,
        robot_prior_z: &Tensor,
        robot_h: &Tensor,
        environment_z: &Tensor,
    ) -> Result<(Tensor, Tensor)> {
        let g = self.deter.forward(robot_h)?.reshape(((), self.rows, self.classes))?; // [B, k, m]
        let u = Tensor::cat(&[robot_prior_z, &g], 1)?; // [B, n+k, m]
        let queries = self.query.forward(environment_z)?; // [B, n, m]
        let (keys, values) = (self.key.forward(&u)?, self.value.forward(&u)?); // [B, n+k, m]
        let (mixture, attention) = ops::cross_attention(&queries, &keys, &values)?;
        Ok((self.output.forward(&mixture)?, attention)) // [B, n, m]
    }
}
