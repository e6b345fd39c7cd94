//! What the machine could do at best between image and action: convolutions at the rate of a large matrix product, the weights of all
//! else at the speed that as many bytes as a whole tick reads are read again and again, one after the other.

use std::hint::black_box;
use std::time::{Duration, Instant};

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
/// Least bytes read to measure memory: below it, the clock's steps show.
const READ_BYTES_MIN: u64 = 1 << 20;
/// Repetitions; the best one counts, for the limit is what the machine can do undisturbed.
const REPETITIONS: usize = 12;

/// How long the clock is watched for stalls.
const WATCHED: Duration = Duration::from_secs(1);
/// What counts as a stall: two looks at the clock this far apart, in ns. Undisturbed they are some tens of ns apart.
const STALL_NS_MIN: u64 = 20_000;

/// Measured peaks of one core.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Machine {
    gemm_gflops: f64,
    read_gb_per_s: f64,
}

/// How often the machine stops a thread that does nothing but look at the clock: what no program can be better than.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Stalls {
    /// Stalls of more than 20 us in a second.
    pub per_s: f64,
    /// Share of the time that is lost in them.
    pub share: f64,
    /// The median one; 0 where there is none.
    pub p50_us: f64,
    /// The longest.
    pub max_us: f64,
}

/// Watches the clock for a second.
#[must_use]
pub fn measure_stalls() -> Stalls {
    let mut gaps_ns = Vec::with_capacity(1 << 16);
    let start = Instant::now();
    let mut last_ns = 0;
    while last_ns < WATCHED.as_nanos() as u64 {
        let now_ns = start.elapsed().as_nanos() as u64;
        if now_ns - last_ns > STALL_NS_MIN && gaps_ns.len() < gaps_ns.capacity() {
            gaps_ns.push(now_ns - last_ns);
        }
        last_ns = now_ns;
    }
    gaps_ns.sort_unstable();
    let (seconds, us) = (last_ns as f64 / 1e9, |gap_ns: &u64| *gap_ns as f64 / 1e3);
    Stalls {
        per_s: gaps_ns.len() as f64 / seconds,
        share: gaps_ns.iter().sum::<u64>() as f64 / last_ns as f64,
        p50_us: gaps_ns.get(gaps_ns.len() / 2).map_or(0.0, us),
        max_us: gaps_ns.last().map_or(0.0, us),
    }
}

/// Peaks of one core, and the shortest time between image and action with them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Limit {
    /// Rate of a large matrix product.
    pub gemm_gflops: f64,
    /// Rate at which as many bytes as a tick's weights are read.
    pub read_gb_per_s: f64,
    /// Floating-point operations of the convolutions that need the image.
    pub convolution_flops: u64,
    /// Bytes of the other weights that need the image.
    pub weight_bytes: u64,
    /// Convolutions at that rate.
    pub convolution_us: f64,
    /// Weights at that rate.
    pub weights_us: f64,
    /// Sum of the two: one thread.
    pub tick_us: f64,
}

impl Machine {
    /// The limit of what needs the image.
    #[must_use]
    pub fn of(&self, late: &Cost) -> Limit {
        let weight_bytes = late.weight_bytes - late.convolution_weight_bytes;
        let convolution_us = late.convolution_flops as f64 / (self.gemm_gflops * 1e3);
        let weights_us = weight_bytes as f64 / (self.read_gb_per_s * 1e3);
        Limit {
            gemm_gflops: self.gemm_gflops,
            read_gb_per_s: self.read_gb_per_s,
            convolution_flops: late.convolution_flops,
            weight_bytes,
            convolution_us,
            weights_us,
            tick_us: convolution_us + weights_us,
        }
    }
}

/// Measures the peaks of one core, for ticks that read this many bytes of weights.
///
/// # Errors
/// [`BenchError::Machine`].
pub fn measure_machine(weight_bytes: u64) -> Result<Machine, BenchError> {
    let gemm_gflops = gemm_gflops().map_err(|error| BenchError::Machine(format!("{error:#}")))?;
    Ok(Machine { gemm_gflops, read_gb_per_s: read_gb_per_s(weight_bytes.max(READ_BYTES_MIN)) })
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

fn read_gb_per_s(bytes: u64) -> f64 {
    let words = vec![1_u64; (bytes / 8) as usize];
    let mut best_s = f64::INFINITY;
    for _ in 0..20 * REPETITIONS {
        let start = Instant::now();
        black_box(black_box(&words).iter().fold(0_u64, |sum, word| sum.wrapping_add(*word)));
        best_s = best_s.min(start.elapsed().as_secs_f64());
    }
    (words.len() * 8) as f64 / best_s / 1e9
}
