use candle_core::{D, Result, Tensor};

/// `1 / (1 + exp(-x))`, through tanh: no overflow and no NaN gradient for any x.
pub fn sigmoid(x: &Tensor) -> Result<Tensor> {
    (x * 0.5)?.tanh()?.affine(0.5, 0.5)
}

/// Softmax over the last dimension.
pub fn softmax(x: &Tensor) -> Result<Tensor> {
    let exp = shifted(x)?.exp()?;
    exp.broadcast_div(&exp.sum_keepdim(D::Minus1)?)
}

/// Logarithm of the softmax over the last dimension.
pub fn log_softmax(x: &Tensor) -> Result<Tensor> {
    let shifted = shifted(x)?;
    shifted.broadcast_sub(&shifted.exp()?.sum_keepdim(D::Minus1)?.log()?)
}

/// `x` minus its largest entry, which cancels in a softmax and so needs no gradient.
fn shifted(x: &Tensor) -> Result<Tensor> {
    x.broadcast_sub(&x.max_keepdim(D::Minus1)?.detach())
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    #[test]
    fn extreme_inputs_give_finite_values_and_gradients() {
        let x = Var::new(&[[-500f32, 0.0, 500.0]], &Device::Cpu).unwrap();
        for op in [sigmoid, softmax, log_softmax] {
            let y = op(&x).unwrap();
            let grads = y.sum_all().unwrap().backward().unwrap();
            let grad = grads.get(&x).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
            let y = y.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            assert!(y.iter().chain(&grad).all(|value| value.is_finite()), "{y:?} {grad:?}");
        }
    }
}
