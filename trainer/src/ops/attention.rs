use candle_core::{Result, Tensor};

use super::composite;
use super::node::{Backward, floats, fusible, mismatch, record};
use rcwm_kernels::batch::attention::{self, Sizes};

/// One head of cross-attention (eq. 7): `softmax(Q K^T / sqrt(m)) V`.
///
/// `queries` [B, n, m], `keys` and `values` [B, r, m]; gives the mixture [B, n, m] and the attention map [B, n, r].
///
/// Cost: `4 B n r m` flops forward, `10 B n r m` backward, and a softmax of `B n r` numbers.
pub fn cross_attention(queries: &Tensor, keys: &Tensor, values: &Tensor) -> Result<(Tensor, Tensor)> {
    if !fusible(&[queries, keys, values]) {
        return composite::cross_attention(queries, keys, values);
    }
    let (batch, n, m) = queries.dims3()?;
    let (_, r, _) = keys.dims3()?;
    if keys.dims() != [batch, r, m] || r == 0 || n == 0 || m == 0 {
        return mismatch(OP, queries, keys);
    }
    if values.dims() != keys.dims() {
        return mismatch(OP, keys, values);
    }
    let sizes = Sizes { queries: n, keys: r, width: m };
    let inputs = [queries.contiguous()?, keys.contiguous()?, values.contiguous()?];
    let (mut attention, mut mixture) = (vec![0.0; batch * n * r], vec![0.0; batch * n * m]);
    {
        let [q, k, v] = [floats(OP, &inputs[0])?, floats(OP, &inputs[1])?, floats(OP, &inputs[2])?];
        attention::forward(sizes, &q, &k, &v, &mut attention, &mut mixture);
    }
    let kept = Kept { sizes, inputs: inputs.each_ref().map(Tensor::detach), attention: attention.clone() };
    let outputs = vec![(mixture, (batch, n, m).into()), (attention, (batch, n, r).into())];
    let mut outputs = record(&inputs.each_ref(), outputs, kept)?;
    let attention = outputs.swap_remove(1);
    Ok((outputs.swap_remove(0), attention))
}

const OP: &str = "cross-attention";

struct Kept {
    sizes: Sizes,
    inputs: [Tensor; 3],
    attention: Vec<f32>,
}

impl Backward for Kept {
    fn name(&self) -> &'static str {
        OP
    }

    fn backward(&self, grads: &[Option<Tensor>], _: &[bool]) -> Result<Vec<Option<Tensor>>> {
        let [d_mixture, d_attention] = grads else { return Ok(vec![None; 3]) };
        let [q, k, v] =
            [floats(OP, &self.inputs[0])?, floats(OP, &self.inputs[1])?, floats(OP, &self.inputs[2])?];
        let d_mixture = match d_mixture {
            Some(grad) => grad.clone(),
            None => self.inputs[0].zeros_like()?,
        };
        let d_attention = d_attention.as_ref().map(|grad| floats(OP, grad)).transpose()?;
        let [mut dq, mut dk, mut dv] = [vec![0.0; q.len()], vec![0.0; k.len()], vec![0.0; v.len()]];
        attention::backward(
            self.sizes,
            [&q, &k, &v],
            &self.attention,
            &floats(OP, &d_mixture)?,
            d_attention.as_deref(),
            [&mut dq, &mut dk, &mut dv],
        );
        let grads = [dq, dk, dv].into_iter().zip(&self.inputs);
        grads.map(|(grad, input)| Tensor::from_vec(grad, input.shape(), input.device()).map(Some)).collect()
    }
}
