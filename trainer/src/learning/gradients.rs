use std::collections::BTreeMap;

use candle_core::Tensor;

use super::LearningError;
use crate::model::parameters::Parameters;
use crate::ops::sum_of_squares;

/// Gradients of one loss, by the parameters' names.
#[derive(Debug, Clone)]
pub struct Gradients {
    tensors: BTreeMap<String, Tensor>,
    norm: f64,
}

impl Gradients {
    /// The gradients of `loss` in every parameter whose name `trains` accepts.
    ///
    /// # Errors
    /// [`LearningError::NotFinite`], [`LearningError::NoGradient`] if a parameter has none, or candle's.
    pub fn of(
        loss: &Tensor,
        parameters: &Parameters,
        trains: fn(&str) -> bool,
    ) -> Result<Self, LearningError> {
        Self::new(Self::of_share(loss, parameters, trains)?)
    }

    /// The same of a share of the loss, to be summed by [`Gradients::sum`].
    pub fn of_share(
        loss: &Tensor,
        parameters: &Parameters,
        trains: fn(&str) -> bool,
    ) -> Result<BTreeMap<String, Tensor>, LearningError> {
        let value = f64::from(loss.to_scalar::<f32>()?);
        if !value.is_finite() {
            return Err(LearningError::NotFinite { what: "the loss", value });
        }
        let mut store = loss.backward()?;
        let mut tensors = BTreeMap::new();
        for (name, var) in parameters.iter().filter(|(name, _)| trains(name)) {
            let gradient =
                store.remove(var).ok_or_else(|| LearningError::NoGradient { name: name.to_owned() })?;
            tensors.insert(name.to_owned(), gradient);
        }
        Ok(tensors)
    }

    /// The sum over shares of a loss.
    pub fn sum(shares: Vec<BTreeMap<String, Tensor>>) -> Result<Self, LearningError> {
        let mut shares = shares.into_iter();
        let mut sum = shares.next().unwrap_or_default();
        for share in shares {
            for (name, term) in share {
                let total = match sum.get(&name) {
                    Some(total) => (total + term)?,
                    None => term,
                };
                sum.insert(name, total);
            }
        }
        Self::new(sum)
    }

    /// Gradients that are known already.
    ///
    /// # Errors
    /// [`LearningError::NotFinite`] or candle's.
    pub fn new(tensors: BTreeMap<String, Tensor>) -> Result<Self, LearningError> {
        let mut squares = 0.0;
        for gradient in tensors.values() {
            squares += sum_of_squares(gradient)?;
        }
        let norm = squares.sqrt();
        if !norm.is_finite() {
            return Err(LearningError::NotFinite { what: "the norm of the gradients", value: norm });
        }
        Ok(Self { tensors, norm })
    }

    /// Those whose names `wanted` accepts, with their own norm.
    pub fn part(&self, wanted: fn(&str) -> bool) -> Result<Self, LearningError> {
        let chosen = self.tensors.iter().filter(|(name, _)| wanted(name));
        Self::new(chosen.map(|(name, tensor)| (name.clone(), tensor.clone())).collect())
    }

    /// Euclidean norm over all of them.
    #[must_use]
    pub fn norm(&self) -> f64 {
        self.norm
    }

    /// All gradients, by name.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Tensor)> {
        self.tensors.iter().map(|(name, tensor)| (name.as_str(), tensor))
    }

    /// The gradient in this parameter.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&Tensor> {
        self.tensors.get(name)
    }
}
