//! A model's parameters on the host, in the layouts that the graphs want.

use std::collections::BTreeMap;

use ndarray::{Array2, ArrayD, Axis, Ix2, s};

use super::ExportError;
use crate::model::parameters::Parameters;

/// Named arrays in PyTorch's layouts.
#[derive(Debug)]
pub struct Weights(BTreeMap<String, ArrayD<f32>>);

impl Weights {
    /// Copies all parameters to the host.
    pub fn new(parameters: &Parameters) -> Result<Self, ExportError> {
        let array = |(name, var): (&str, &candle_core::Var)| {
            let values = var.flatten_all()?.to_vec1::<f32>()?;
            let array = ArrayD::from_shape_vec(var.dims(), values)
                .expect("candle gives as many values as the shape holds");
            Ok((name.to_owned(), array))
        };
        Ok(Self(parameters.iter().map(array).collect::<Result<_, ExportError>>()?))
    }

    /// An array as it is.
    ///
    /// # Panics
    /// If there is none of this name. The parameters were checked against the model before, so the name is wrong.
    pub fn get(&self, name: &str) -> &ArrayD<f32> {
        self.0.get(name).unwrap_or_else(|| panic!("no parameter is called {name}"))
    }

    /// A linear layer's weight, transposed to [in, out].
    pub fn matrix(&self, name: &str) -> Array2<f32> {
        let weight = self.get(name).view().into_dimensionality::<Ix2>();
        let weight = weight.expect("a linear layer's weight has two dimensions");
        weight.t().as_standard_layout().into_owned()
    }

    /// Rows `[from, from + count)` of [`Weights::matrix`]: the part for these inputs.
    pub fn rows(&self, name: &str, from: usize, count: usize) -> Array2<f32> {
        self.matrix(name).slice(s![from..from + count, ..]).into_owned()
    }

    /// What a linear layer with bias makes of each one-hot input: [in, out].
    pub fn table(&self, name: &str) -> Array2<f32> {
        let bias = self.get(&format!("{name}.bias"));
        let mut table = self.matrix(&format!("{name}.weight"));
        for mut row in table.axis_iter_mut(Axis(0)) {
            row.iter_mut().zip(bias.iter()).for_each(|(x, bias)| *x += bias);
        }
        table
    }
}
