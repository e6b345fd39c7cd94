//! Layers with parameters.

use candle_core::{Result, Tensor};

use super::init::Init;
use super::parameters::{Built, Scope};
use crate::ops::{self, ConvLayer};

/// LayerNorm's epsilon everywhere but in the interaction model.
pub const NORM_EPS: f64 = 1e-3;

/// Gain and shift of a LayerNorm over the last dimension.
#[derive(Debug, Clone)]
pub struct Norm {
    weight: Tensor,
    bias: Tensor,
    eps: f64,
}

impl Norm {
    /// `weight` and `bias` [width].
    pub fn new(scope: &Scope<'_>, width: usize, eps: f64) -> Built<Self> {
        let weight = scope.get("weight", &[width], Init::Ones)?;
        Ok(Self { weight, bias: scope.get("bias", &[width], Init::Zeros)?, eps })
    }

    /// LayerNorm of `x` [..., width].
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        ops::layer_norm(x, &self.weight, &self.bias, self.eps)
    }

    /// LayerNorm, then `SiLU`.
    pub fn silu(&self, x: &Tensor) -> Result<Tensor> {
        ops::layer_norm_silu(x, &self.weight, &self.bias, self.eps)
    }

    /// A convolution of this weight with this normalisation and `SiLU` after it.
    #[must_use]
    pub fn after<'a>(&'a self, weight: &'a Tensor) -> ConvLayer<'a> {
        ConvLayer { weight, norm: Some((&self.weight, &self.bias, self.eps)), bias: None }
    }

    /// The recurrent cell's update of `h` [..., d] from its linear layer's output `pre` [..., 3d].
    pub fn cell(&self, pre: &Tensor, h: &Tensor) -> Result<Tensor> {
        ops::recurrent_cell(pre, &self.weight, &self.bias, self.eps, h)
    }
}

/// A linear layer with bias.
#[derive(Debug, Clone)]
pub struct Linear {
    weight: Tensor,
    bias: Tensor,
}

impl Linear {
    /// An output layer: uniform start of this scale.
    pub fn output(scope: &Scope<'_>, input: usize, out: usize, scale: f64) -> Built<Self> {
        Self::new(scope, input, out, Init::Uniform { fans: input + out, scale })
    }

    /// `weight` [out, input] and `bias` [out].
    pub fn new(scope: &Scope<'_>, input: usize, out: usize, init: Init) -> Built<Self> {
        let weight = scope.get("weight", &[out, input], init)?;
        Ok(Self { weight, bias: scope.get("bias", &[out], Init::Zeros)? })
    }

    /// `x` [..., input] to [..., out].
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        ops::linear(x, &self.weight, Some(&self.bias))
    }
}

/// A dense block: linear without bias, LayerNorm, `SiLU`.
#[derive(Debug, Clone)]
pub struct Dense {
    weight: Tensor,
    norm: Norm,
}

impl Dense {
    /// `linear.weight` [out, input], `norm.*` [out].
    pub fn new(scope: &Scope<'_>, input: usize, out: usize) -> Built<Self> {
        let init = Init::TruncatedNormal { fans: input + out };
        let weight = scope.at("linear").get("weight", &[out, input], init)?;
        Ok(Self { weight, norm: Norm::new(&scope.at("norm"), out, NORM_EPS)? })
    }

    /// `x` [..., input] to [..., out].
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        self.norm.silu(&ops::linear(x, &self.weight, None)?)
    }

    /// Weights [out, width] of columns `[from, from + width)` of the input, by which they have their share in the sum before the
    /// normalisation: parts of an input that are known early can be multiplied early, and for many steps at once.
    pub fn columns(&self, from: usize, width: usize) -> Result<Tensor> {
        self.weight.narrow(1, from, width)
    }

    /// The block's output from the summed shares of [`Dense::columns`].
    pub fn finish(&self, sum: &Tensor) -> Result<Tensor> {
        self.norm.silu(sum)
    }
}

/// Dense blocks of equal width, then an output layer: the heads, actor and critic.
#[derive(Debug, Clone)]
pub struct Mlp {
    blocks: [Dense; 2],
    out: Linear,
}

impl Mlp {
    /// `0.*`, `1.*`, `out.*`; the output layer starts uniform of scale `out_scale`.
    pub fn new(scope: &Scope<'_>, input: usize, units: usize, out: usize, out_scale: f64) -> Built<Self> {
        let blocks = [Dense::new(&scope.at(0), input, units)?, Dense::new(&scope.at(1), units, units)?];
        Ok(Self { blocks, out: Linear::output(&scope.at("out"), units, out, out_scale)? })
    }

    /// `x` [..., input] to [..., out].
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let x = self.blocks[1].forward(&self.blocks[0].forward(x)?)?;
        self.out.forward(&x)
    }
}
