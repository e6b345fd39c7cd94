use candle_core::{D, Result, Tensor};

use super::softmax;

/// One head of cross-attention (eq. 7): `softmax(Q K^T / sqrt(m)) V`.
///
/// `queries` [B, n, m], `keys` and `values` [B, r, m]; gives the mixture [B, n, m] and the attention map [B, n, r].
pub fn cross_attention(queries: &Tensor, keys: &Tensor, values: &Tensor) -> Result<(Tensor, Tensor)> {
    let scale = 1.0 / (queries.dim(D::Minus1)? as f64).sqrt();
    let keys = keys.contiguous()?.transpose(1, 2)?;
    let scores = (queries.contiguous()?.matmul(&keys)? * scale)?; // [B, n, r]
    let attention = softmax(&scores)?;
    Ok((attention.matmul(&values.contiguous()?)?, attention))
}
