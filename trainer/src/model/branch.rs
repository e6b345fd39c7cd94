//! The recurrent part that robot, environment and the vanilla baseline have alike (eq. 5, 6).

use candle_core::{D, Result, Tensor};
use rcwm_models::settings::ModelSettings;

use super::init::Init;
use super::latent::{Latent, Sampler};
use super::layers::{Dense, Linear, NORM_EPS, Norm};
use super::parameters::{Built, Scope};
use crate::ops;

/// A dense block and the logits of n categoricals of m classes.
#[derive(Debug, Clone)]
struct LatentHead {
    dense: Dense,
    logits: Linear,
}

impl LatentHead {
    fn new(scope: &Scope<'_>, input: usize, settings: &ModelSettings) -> Built<Self> {
        let dense = Dense::new(&scope.at("dense"), input, settings.hidden)?;
        let logits = Linear::output(&scope.at("logits"), settings.hidden, settings.stoch_width(), 1.0)?;
        Ok(Self { dense, logits })
    }
}

/// One branch: input layer, recurrent cell, prior and posterior, learned initial state.
#[derive(Debug, Clone)]
pub struct Branch {
    input: Dense,
    cell_weight: Tensor,
    cell_norm: Norm,
    prior: LatentHead,
    posterior: LatentHead,
    /// Columns of the posterior's dense block for h and for the embedding. Cut once: in a scan, the gradients of all steps are summed before
    /// they are put into place.
    posterior_columns: [Tensor; 2],
    initial: Tensor,
    categoricals: usize,
    classes: usize,
    unimix: f64,
}

impl Branch {
    /// A branch whose input layer takes `input` values and whose posterior takes `embed` values of the image.
    pub fn new(scope: &Scope<'_>, settings: &ModelSettings, input: usize, embed: usize) -> Built<Self> {
        let (d, hidden) = (settings.deter, settings.hidden);
        let cell = scope.at("cell");
        let init = Init::TruncatedNormal { fans: hidden + d + 3 * d };
        let posterior = LatentHead::new(&scope.at("posterior"), d + embed, settings)?;
        Ok(Self {
            input: Dense::new(&scope.at("input"), input, hidden)?,
            cell_weight: cell.at("linear").get("weight", &[3 * d, hidden + d], init)?,
            cell_norm: Norm::new(&cell.at("norm"), 3 * d, NORM_EPS)?,
            prior: LatentHead::new(&scope.at("prior"), d, settings)?,
            posterior_columns: [posterior.dense.columns(0, d)?, posterior.dense.columns(d, embed)?],
            posterior,
            initial: scope.get("initial", &[1, d], Init::Zeros)?,
            categoricals: settings.categoricals,
            classes: settings.classes,
            unimix: settings.unimix,
        })
    }

    /// The learned state an episode starts from: `h_0 = tanh(w)`, `z_0` = mode of the prior at `h_0`; every tensor [B, ...].
    pub fn initial(&self, batch: usize) -> Result<Latent> {
        let h = self.initial.tanh()?; // [1, d]
        let logits = self.prior_logits(&h)?; // [1, n, m]
        let z = ops::straight_through_mode(&logits, self.unimix)?;
        let repeat = |x: &Tensor| {
            let mut shape = x.dims().to_vec();
            shape[0] = batch;
            x.broadcast_as(shape)
        };
        Ok(Latent { z: repeat(&z)?, h: repeat(&h)?, logits: repeat(&logits)? })
    }

    /// One step of the recurrence (eq. 5, 6): `x` [B, input] and `h` [B, d] to h' [B, d].
    pub fn recur(&self, x: &Tensor, h: &Tensor) -> Result<Tensor> {
        let x = self.input.forward(x)?; // [B, hidden]
        let gates = ops::linear(&Tensor::cat(&[&x, h], D::Minus1)?, &self.cell_weight, None)?; // [B, 3d]
        self.cell_norm.cell(&gates, h)
    }

    /// Logits of the prior `p(z_t | h_t)`: `h` [..., d] to [..., n, m].
    pub fn prior_logits(&self, h: &Tensor) -> Result<Tensor> {
        self.to_latent_shape(&self.prior.logits.forward(&self.prior.dense.forward(h)?)?)
    }

    /// The image's share in the posterior's dense block: `embed` [..., E] to [..., hidden]. It does not depend on the
    /// recurrence, so a whole sequence is done at once.
    pub fn embed_share(&self, embed: &Tensor) -> Result<Tensor> {
        ops::linear(embed, &self.posterior_columns[1], None)
    }

    /// Logits of the posterior `q(z_t | h_t, o_t)`: `h` [..., d] and the image's share [..., hidden] to [..., n, m].
    pub fn posterior_logits(&self, h: &Tensor, embed_share: &Tensor) -> Result<Tensor> {
        let sum = (ops::linear(h, &self.posterior_columns[0], None)? + embed_share)?;
        let hidden = self.posterior.dense.finish(&sum)?;
        self.to_latent_shape(&self.posterior.logits.forward(&hidden)?)
    }

    /// A latent drawn from `logits` [..., n, m].
    pub fn draw(&self, logits: Tensor, h: &Tensor, sampler: &mut Sampler) -> Result<Latent> {
        let gumbel = sampler.gumbel(logits.dims(), logits.device())?;
        self.draw_with(logits, h, gumbel.as_ref())
    }

    /// A latent drawn with given Gumbel noise (none: the mode).
    pub fn draw_with(&self, logits: Tensor, h: &Tensor, gumbel: Option<&Tensor>) -> Result<Latent> {
        let z = ops::straight_through_sample(&logits, self.unimix, gumbel)?;
        Ok(Latent { z, h: h.clone(), logits })
    }

    fn to_latent_shape(&self, logits: &Tensor) -> Result<Tensor> {
        let lead = &logits.dims()[..logits.rank() - 1];
        logits.reshape([lead, &[self.categoricals, self.classes]].concat())
    }
}
