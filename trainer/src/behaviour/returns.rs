use candle_core::{Result, Tensor};

/// The lambda return of the first L - 1 of L states (eq. 10), from rewards, values and discounts [L, N, 1]:
/// `R_t = r_{t+1} + c_{t+1} ((1 - lambda) v_{t+1} + lambda R_{t+1})`, with `R` of the last state its value. Index t + 1
/// is the state that the action of t leads to, whose reward and continuation are predicted there.
///
/// # Errors
/// Those of candle; L must be at least 2.
pub fn lambda_return(reward: &Tensor, value: &Tensor, discount: &Tensor, lambda: f64) -> Result<Tensor> {
    let length = reward.dim(0)?;
    let mut next = value.get(length - 1)?; // [N, 1]
    let mut returns = Vec::with_capacity(length - 1);
    for t in (1..length).rev() {
        let beyond = ((value.get(t)? * (1.0 - lambda))? + (next * lambda)?)?;
        next = (reward.get(t)? + (discount.get(t)? * beyond)?)?;
        returns.push(next.clone());
    }
    returns.reverse();
    Tensor::stack(&returns, 0)
}

/// The cumulative product of the discounts before each state, [L, N, 1]; 1 for the start. Without gradient.
pub fn step_weights(discount: &Tensor) -> Result<Tensor> {
    let discount = discount.detach();
    let mut weight = discount.get(0)?.ones_like()?;
    let mut weights = vec![weight.clone()];
    for t in 1..discount.dim(0)? {
        weight = (weight * discount.get(t - 1)?)?;
        weights.push(weight.clone());
    }
    Tensor::stack(&weights, 0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;

    fn column(values: &[f32]) -> Tensor {
        Tensor::from_slice(values, (values.len(), 1, 1), &Device::Cpu).unwrap()
    }

    #[test]
    fn with_lambda_one_the_return_is_the_discounted_sum_and_the_last_value() {
        let returns = lambda_return(
            &column(&[9.0, 1.0, 2.0]),
            &column(&[9.0, 9.0, 4.0]),
            &column(&[9.0, 0.5, 0.5]),
            1.0,
        );
        let returns = returns.unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(returns, [1.0 + 0.5 * (2.0 + 0.5 * 4.0), 2.0 + 0.5 * 4.0]);
    }

    #[test]
    fn with_lambda_zero_the_return_is_one_step_and_the_next_value() {
        let returns = lambda_return(
            &column(&[9.0, 1.0, 2.0]),
            &column(&[9.0, 3.0, 4.0]),
            &column(&[9.0, 0.5, 0.5]),
            0.0,
        );
        let returns = returns.unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(returns, [1.0 + 0.5 * 3.0, 2.0 + 0.5 * 4.0]);
    }

    #[test]
    fn weights_are_the_discounts_of_the_states_before() {
        let weights = step_weights(&column(&[0.5, 0.25, 0.1])).unwrap();
        assert_eq!(weights.flatten_all().unwrap().to_vec1::<f32>().unwrap(), [1.0, 0.5, 0.125]);
    }
}
