//! What the machine could do at best: convolutions at the rate of a large matrix product, all other weights at the speed memory
//! is read, one after another on one core.

use std::hint::black_box;
use std::time::Instant;

use prost::Message;
use rcwm_models::onnx::{Graph, Model, Node, OperatorSet, Tensor as OnnxTensor, ValueInfo, data_type};
use serde::Serialize;
use tract_onnx::prelude::{
    Framework, InferenceModelExt, IntoRunnable, Tensor, TractResult, TypedSimpleState, tvec,
};

use super::BenchError;
use crate::inspect::Cost;

/// Side of the matrices of the measured product: they fit into a core's second cache.
const GEMM_SIDE: usize = 256;
/// Bytes read to measure memory: larger than any last cache.
const READ_BYTES: usize = 256 << 20;
/// Repetitions; the best one counts, for the limit is what the machine can do undisturbed.
const REPETITIONS: usize = 12;

/// Measured peaks of one core.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Machine {
    gemm_gflops: f64,
    read_gb_per_s: f64,
}

/// Peaks of one core, and the shortest a tick can take with them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Limit {
    /// Rate of a large matrix product.
    pub gemm_gflops: f64,
    /// Rate at which memory is read.
    pub read_gb_per_s: f64,
    /// Convolutions of a tick at that rate.
    pub convolution_us: f64,
    /// Weights of a tick at that rate.
    pub weights_us: f64,
    /// Sum of the two.
    pub tick_us: f64,
}

impl Machine {
    /// The limit of a tick.
    #[must_use]
    pub fn of(&self, tick: &Cost) -> Limit {
        let convolution_us = tick.convolution_flops as f64 / (self.gemm_gflops * 1e3);
        let weights_us = tick.weight_bytes as f64 / (self.read_gb_per_s * 1e3);
        Limit {
            gemm_gflops: self.gemm_gflops,
            read_gb_per_s: self.read_gb_per_s,
            convolution_us,
            weights_us,
            tick_us: convolution_us + weights_us,
        }
    }
}

/// Measures the peaks of one core.
///
/// # Errors
/// [`BenchError::Machine`].
pub fn measure_machine() -> Result<Machine, BenchError> {
    let gemm_gflops = gemm_gflops().map_err(|error| BenchError::Machine(format!("{error:#}")))?;
    Ok(Machine { gemm_gflops, read_gb_per_s: read_gb_per_s() })
}

/// The best rate of a square product with constant right-hand side, in tract: the kernel that convolutions run on.
fn gemm_gflops() -> TractResult<f64> {
    let model = tract_onnx::onnx().model_for_read(&mut &product()[..])?.into_optimized()?;
    let mut state = TypedSimpleState::new(&model.into_runnable()?)?;
    let mut best_s = f64::INFINITY;
    for _ in 0..10 * REPETITIONS {
        let input = Tensor::zero::<f32>(&[GEMM_SIDE, GEMM_SIDE])?;
        let start = Instant::now();
        black_box(state.run(tvec!(input.into()))?);
        best_s = best_s.min(start.elapsed().as_secs_f64());
    }
    Ok(2.0 * (GEMM_SIDE as f64).powi(3) / best_s / 1e9)
}

fn product() -> Vec<u8> {
    let shape = [GEMM_SIDE, GEMM_SIDE];
    let weights: Vec<f32> = (0..GEMM_SIDE * GEMM_SIDE).map(|i| (i % 7) as f32 - 3.0).collect();
    let node = Node {
        op_type: "MatMul".into(),
        input: vec!["x".into(), "w".into()],
        output: vec!["y".into()],
        name: "product".into(),
        ..Node::default()
    };
    let graph = Graph {
        name: "product".into(),
        node: vec![node],
        initializer: vec![OnnxTensor::f32("w", &shape, &weights)],
        input: vec![ValueInfo::tensor("x", data_type::FLOAT, &shape)],
        output: vec![ValueInfo::tensor("y", data_type::FLOAT, &shape)],
        ..Graph::default()
    };
    let opset_import = vec![OperatorSet { domain: String::new(), version: 17 }];
    Model { ir_version: 8, graph: Some(graph), opset_import, ..Model::default() }.encode_to_vec()
}

fn read_gb_per_s() -> f64 {
    let words = vec![1_u64; READ_BYTES / 8];
    let mut best_s = f64::INFINITY;
    for _ in 0..REPETITIONS {
        let start = Instant::now();
        black_box(black_box(&words).iter().fold(0_u64, |sum, word| sum.wrapping_add(*word)));
        best_s = best_s.min(start.elapsed().as_secs_f64());
    }
    READ_BYTES as f64 / best_s / 1e9
}
