//! The model's building blocks as graphs. Names are those of the parameters.

use ndarray::{Array2, ArrayD, Axis, concatenate};
use rcwm_models::settings::ModelSettings;

use super::graph::{Graph, Value};
use super::weights::Weights;
use crate::model::layers::NORM_EPS;

/// A graph with the weights and sizes that go into it.
pub struct Part<'a> {
    pub graph: Graph,
    pub weights: &'a Weights,
    pub settings: &'a ModelSettings,
}

/// A state [1, n] of class indices and [1, d], of every branch.
pub struct StateInputs {
    pub z: Vec<Value>,
    pub h: Vec<Value>,
}

impl Part<'_> {
    pub fn parameter(&mut self, name: &str) -> Value {
        self.array(name, self.weights.get(name))
    }

    /// A constant array.
    pub fn array(&mut self, name: &str, array: &ArrayD<f32>) -> Value {
        let values: Vec<f32> = array.iter().copied().collect();
        self.graph.floats(name, array.shape(), &values)
    }

    /// A constant matrix.
    pub fn matrix(&mut self, name: &str, matrix: Array2<f32>) -> Value {
        self.array(name, &matrix.into_dyn())
    }

    /// `x W^T + b` with the layer `name`.
    pub fn linear(&mut self, name: &str, x: &Value) -> Value {
        let weight = self.matrix(&format!("{name}.weight"), self.weights.matrix(&format!("{name}.weight")));
        let product = self.graph.matmul(x, &weight);
        let bias = self.parameter(&format!("{name}.bias"));
        self.graph.add(&product, &bias)
    }

    /// The share of inputs `[from, from + width)` in the product with `name`.weight.
    pub fn linear_share(&mut self, name: &str, x: &Value, from: usize) -> Value {
        let width = x.shape()[x.shape().len() - 1];
        let rows = self.weights.rows(&format!("{name}.weight"), from, width);
        let rows = self.matrix(&format!("{name}.weight.from_{from}"), rows);
        self.graph.matmul(x, &rows)
    }

    /// LayerNorm with the layer `name`.
    pub fn norm(&mut self, name: &str, x: &Value, eps: f64) -> Value {
        let weight = self.parameter(&format!("{name}.weight"));
        let bias = self.parameter(&format!("{name}.bias"));
        self.graph.layer_norm(x, &weight, &bias, eps)
    }

    /// What follows the linear layer of a dense block.
    pub fn norm_silu(&mut self, name: &str, x: &Value) -> Value {
        let normed = self.norm(name, x, NORM_EPS);
        self.graph.silu(&normed)
    }

    /// LayerNorm over the channels of [1, C, H, W], then `SiLU`.
    pub fn channel_norm_silu(&mut self, name: &str, x: &Value) -> Value {
        let last = self.graph.transpose(x, &[0, 2, 3, 1]);
        let active = self.norm_silu(name, &last);
        self.graph.transpose(&active, &[0, 3, 1, 2])
    }

    /// A dense block on a plain input.
    pub fn dense(&mut self, name: &str, x: &Value) -> Value {
        let weight = format!("{name}.linear.weight");
        let weight = self.matrix(&weight, self.weights.matrix(&weight));
        let product = self.graph.matmul(x, &weight);
        self.norm_silu(&format!("{name}.norm"), &product)
    }

    /// The product of one-hot rows with a weight: the sum of one row of `table` [latents * m, out] for each latent.
    ///
    /// `z` [1, latents] are class indices; latent i with class j is row i * m + j.
    pub fn one_hot_product(&mut self, name: &str, z: &Value, table: Array2<f32>) -> Value {
        let (latents, m) = (z.shape()[1], self.settings.classes);
        let table = self.matrix(name, table);
        let offsets: Vec<i64> = (0..latents).map(|latent| (latent * m) as i64).collect();
        let offsets = self.graph.integers(&format!("offsets_{latents}"), &[1, latents], &offsets);
        let index = self.graph.add(z, &offsets); // [1, latents]
        let rows = self.graph.gather(&table, &index); // [1, latents, out]
        self.graph.sum_over_1(&rows) // [1, out]
    }

    /// Declares the inputs of a part that reads the whole state.
    pub fn state_inputs(&mut self, inputs: &[rcwm_models::bundle::TensorSpec]) -> StateInputs {
        let mut state = StateInputs { z: Vec::new(), h: Vec::new() };
        for spec in inputs {
            let value = self.graph.input(spec);
            let of = if spec.name.ends_with("_z") { &mut state.z } else { &mut state.h };
            of.push(value);
        }
        state
    }

    /// Two dense blocks and an output layer on the whole state.
    pub fn head(&mut self, name: &str, state: &StateInputs) -> Value {
        let hidden = self.head_hidden(name, state);
        self.linear(&format!("{name}.out"), &hidden)
    }

    /// A linear layer with its outputs in another order.
    pub fn reordered_linear(&mut self, name: &str, x: &Value, order: &[usize]) -> Value {
        let weight = self.weights.matrix(&format!("{name}.weight")).select(Axis(1), order);
        let weight = self.matrix(&format!("{name}.weight"), weight);
        let product = self.graph.matmul(x, &weight);
        let bias = self.weights.get(&format!("{name}.bias")).select(Axis(0), order);
        let bias = self.array(&format!("{name}.bias"), &bias);
        self.graph.add(&product, &bias)
    }

    /// Two dense blocks on the whole state.
    pub fn head_hidden(&mut self, name: &str, state: &StateInputs) -> Value {
        let (nm, s) = (self.settings.stoch_width(), self.settings.branch_width());
        let weight = format!("{name}.0.linear.weight");
        let d = self.settings.deter;
        let rows = |from, count| self.weights.rows(&weight, from, count);
        // The state is [z^R, h^R, z^E, h^E]; its z rows and its h rows are taken together.
        let join = |from: usize, count: usize| {
            let each = (0..state.z.len()).map(|branch| rows(branch * s + from, count));
            let each: Vec<Array2<f32>> = each.collect();
            let views: Vec<_> = each.iter().map(|rows| rows.view()).collect();
            concatenate(Axis(0), &views).expect("all have the head's width")
        };
        let (z_rows, h_rows) = (join(0, nm), join(nm, d));
        let z = self.side_by_side(&state.z); // [1, branches * n]
        let h = self.side_by_side(&state.h); // [1, branches * d]
        let z_share = self.one_hot_product(&format!("{weight}.z"), &z, z_rows);
        let h_rows = self.matrix(&format!("{weight}.h"), h_rows);
        let h_share = self.graph.matmul(&h, &h_rows);
        let sum = self.graph.add(&z_share, &h_share);
        let x = self.norm_silu(&format!("{name}.0.norm"), &sum);
        self.dense(&format!("{name}.1"), &x)
    }

    /// One value after another on the second axis.
    fn side_by_side(&mut self, values: &[Value]) -> Value {
        match values {
            [one] => one.clone(),
            several => self.graph.concat(&several.iter().collect::<Vec<_>>(), 1),
        }
    }
}
