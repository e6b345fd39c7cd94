//! Time of every fused op against its composite, forward and backward, medians of interleaved runs.
//!
//! ```text
//! cargo run --release -p rcwm-trainer --example op_speed -- [repetitions] [part of a name] [fused: leave the composites out]
//! ```

use std::hint::black_box;
use std::time::Instant;

use anyhow::Result;
use candle_core::{DType, Device, Tensor, Var};
use rcwm_trainer::ops::{self, ConvLayer, KlBalance, composite};

type Run = Box<dyn Fn() -> candle_core::Result<()>>;

struct Case {
    name: String,
    /// Forward and backward, by arithmetic.
    flops: f64,
    fused: Run,
    composite: Run,
}

/// Numbers of a fixed sequence between -1 and 1.
fn numbers(shape: &[usize]) -> candle_core::Result<Tensor> {
    let count: usize = shape.iter().product();
    let value = |i: usize| ((i * 2_654_435_761) % 20_011) as f32 / 10_005.5 - 1.0;
    Tensor::from_iter((0..count).map(value), &Device::Cpu)?.reshape(shape)
}

fn vars(shapes: &[&[usize]]) -> candle_core::Result<Vec<Var>> {
    shapes.iter().map(|shape| Var::from_tensor(&numbers(shape)?)).collect()
}

/// A run of `op` on variables, its gradient pass included.
fn run(vars: &[Var], op: impl Fn(&[Var]) -> candle_core::Result<Tensor> + 'static) -> Run {
    let vars = vars.to_vec();
    Box::new(move || {
        let y = op(&vars)?;
        let y = if y.rank() == 0 { y } else { y.sum_all()? };
        black_box(y.backward()?);
        Ok(())
    })
}

fn case(
    name: &str,
    flops: f64,
    shapes: &[&[usize]],
    fused: impl Fn(&[Var]) -> candle_core::Result<Tensor> + 'static,
    composite: impl Fn(&[Var]) -> candle_core::Result<Tensor> + 'static,
) -> candle_core::Result<Case> {
    let vars = vars(shapes)?;
    Ok(Case { name: name.to_owned(), flops, fused: run(&vars, fused), composite: run(&vars, composite) })
}

/// One convolution of a stack with norm and `SiLU`; the input is an image without gradient if there are three channels.
fn convolution(down: bool, batch: usize, side: usize, input: usize, out: usize) -> candle_core::Result<Case> {
    let weight = if down { [out, input, 4, 4] } else { [input, out, 4, 4] };
    let steps = if down { side * side / 4 * 16 } else { side * side * 16 };
    let passes = if input == 3 { 2.0 } else { 3.0 };
    let flops = passes * 2.0 * (batch * steps * input * out) as f64;
    let name = format!("{} {input}->{out} at {side}, {batch}", if down { "conv down" } else { "conv up" });
    let x = move |x: &Var| if input == 3 { x.as_detached_tensor() } else { x.as_tensor().clone() };
    let fused = move |v: &[Var]| {
        let layer = ConvLayer { weight: &v[1], norm: Some((&v[2], &v[3], 1e-3)), bias: None };
        let x = x(&v[0]);
        if down { ops::conv_down_stack(&x, &[layer]) } else { ops::conv_up_stack(&x, &[layer]) }
    };
    let plain = move |v: &[Var]| {
        let x = x(&v[0]);
        let y = if down { composite::conv_down(&x, &v[1])? } else { composite::conv_up(&x, &v[1])? };
        composite::layer_norm_silu(&y, &v[2], &v[3], 1e-3)
    };
    case(&name, flops, &[&[batch, side, side, input], &weight, &[out], &[out]], fused, plain)
}

fn convolutions(batch: usize, depth: usize) -> candle_core::Result<Vec<Case>> {
    let c = depth;
    Ok(vec![
        convolution(true, batch, 64, 3, c)?,
        convolution(true, batch, 32, c, 2 * c)?,
        convolution(true, batch, 16, 2 * c, 4 * c)?,
        convolution(true, batch, 8, 4 * c, 4 * c)?,
        convolution(false, batch, 4, 8 * c, 4 * c)?,
        convolution(false, batch, 8, 4 * c, 2 * c)?,
        convolution(false, batch, 16, 2 * c, c)?,
        convolution(false, batch, 32, c, 4)?,
    ])
}

fn layers() -> candle_core::Result<Vec<Case>> {
    let (b, d) = (256, 128);
    let dense = |rows: usize, input: usize| {
        case(
            &format!("dense block {rows}x{input}->{d}"),
            6.0 * (rows * input * d) as f64,
            &[&[rows, input], &[d, input], &[d], &[d]],
            |v| ops::layer_norm_silu(&ops::linear(&v[0], &v[1], None)?, &v[2], &v[3], 1e-3),
            |v| composite::layer_norm_silu(&composite::linear(&v[0], &v[1], None)?, &v[2], &v[3], 1e-3),
        )
    };
    Ok(vec![
        dense(b, 384)?,
        dense(15 * b, 768)?,
        case(
            "recurrent cell 256x128",
            280.0 * (b * d) as f64,
            &[&[b, 3 * d], &[3 * d], &[3 * d], &[b, d]],
            |v| ops::recurrent_cell(&v[0], &v[1], &v[2], 1e-3, &v[3]),
            |v| composite::recurrent_update(&composite::layer_norm(&v[0], &v[1], &v[2], 1e-3)?, &v[3]),
        )?,
        case(
            "attention 256x16x24x16",
            14.0 * (b * 16 * 24 * 16) as f64,
            &[&[b, 16, 16], &[b, 24, 16], &[b, 24, 16]],
            |v| Ok(ops::cross_attention(&v[0], &v[1], &v[2])?.0),
            |v| Ok(composite::cross_attention(&v[0], &v[1], &v[2])?.0),
        )?,
    ])
}

fn distributions() -> candle_core::Result<Vec<Case>> {
    let logits: &[usize] = &[256, 16, 16];
    let noise = numbers(logits)?;
    let other = noise.clone();
    let balance = KlBalance { free: 1.0, prior_scale: 0.5, posterior_scale: 0.1 };
    let bins = [ops::bins_tensor(255, &Device::Cpu)?, ops::bins_tensor(255, &Device::Cpu)?];
    let [bins, more_bins] = bins;
    let (mean_bins, more_mean_bins) = (bins.clone(), bins.clone());
    let targets = numbers(&[256])?;
    let more_targets = targets.clone();
    let logit_count = 65_536.0;
    Ok(vec![
        case(
            "sample 256x16x16",
            75.0 * logit_count,
            &[logits],
            move |v| ops::straight_through_sample(&v[0], 0.01, Some(&noise))?.sqr(),
            move |v| composite::straight_through_sample(&v[0], 0.01, Some(&other))?.sqr(),
        )?,
        case(
            "balanced KL 256x16x16",
            230.0 * logit_count,
            &[logits, logits],
            move |v| Ok(ops::balanced_kl(&v[0], &v[1], 0.01, balance)?.0),
            move |v| Ok(composite::balanced_kl(&v[0], &v[1], 0.01, balance)?.0),
        )?,
        case(
            "entropy 256x16x16",
            95.0 * logit_count,
            &[logits],
            |v| ops::entropy(&v[0], 0.01),
            |v| composite::entropy(&v[0], 0.01),
        )?,
        case(
            "two-hot loss 256x255",
            50.0 * logit_count,
            &[&[256, 255]],
            move |v| ops::two_hot_loss(&v[0], &bins, &targets),
            move |v| composite::two_hot_loss(&v[0], &more_bins, &more_targets),
        )?,
        case(
            "two-hot mean 3840x255",
            55.0 * 15.0 * logit_count,
            &[&[3840, 255]],
            move |v| ops::two_hot_mean(&v[0], &mean_bins),
            move |v| composite::two_hot_mean(&v[0], &more_mean_bins),
        )?,
    ])
}

fn pictures() -> candle_core::Result<Case> {
    let image = Tensor::zeros((256, 64, 64, 3), DType::U8, &Device::Cpu)?;
    let (other, shape): (Tensor, &[usize]) = (image.clone(), &[256, 64, 64, 4]);
    case(
        "picture loss 256x64x64",
        150.0 * (256 * 64 * 64) as f64,
        &[shape, shape],
        move |v| Ok(ops::picture_loss(&[&v[0], &v[1]], &image, None)?.0),
        move |v| Ok(composite::picture_loss(&[&v[0], &v[1]], &other, None)?.0),
    )
}

fn seconds(run: &Run) -> Result<f64> {
    let start = Instant::now();
    run()?;
    Ok(start.elapsed().as_secs_f64())
}

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

/// Of one product of two square matrices on all threads, in flops a second.
fn peak(repetitions: usize) -> Result<f64> {
    let side = 1024;
    let x = numbers(&[side, side])?;
    let run: Run = Box::new(move || black_box(x.matmul(&x)).map(drop));
    let times = (0..repetitions).map(|_| seconds(&run)).collect::<Result<Vec<_>>>()?;
    Ok(2.0 * (side as f64).powi(3) / median(times))
}

fn main() -> Result<()> {
    ops::leave_threads_to_ops();
    ops::keep_freed_memory();
    let mut arguments = std::env::args().skip(1);
    let repetitions: usize = arguments.next().map_or(Ok(9), |text| text.parse())?;
    let filter = arguments.next().unwrap_or_default();
    let fused_only = arguments.next().is_some_and(|text| text == "fused");
    let mut cases = convolutions(256, 8)?;
    cases.extend(convolutions(64, 32)?);
    cases.extend(layers()?);
    cases.extend(distributions()?);
    cases.push(pictures()?);
    cases.retain(|case| case.name.contains(&filter));
    let peak = peak(repetitions)?;
    println!("gemm peak {:.0} GFLOP/s", peak / 1e9);
    println!(
        "{:28} {:>9} {:>12} {:>7} {:>9} {:>6}",
        "op (forward + backward)", "fused ms", "composite ms", "ratio", "GFLOP/s", "share"
    );
    for case in &cases {
        let (mut fused, mut composite) = (Vec::new(), Vec::new());
        for _ in 0..repetitions {
            fused.push(seconds(&case.fused)?);
            composite.push(if fused_only { f64::NAN } else { seconds(&case.composite)? });
        }
        let (fused, composite) = (median(fused), median(composite));
        let rate = case.flops / fused;
        println!(
            "{:28} {:9.3} {:12.3} {:7.1} {:9.1} {:5.0}%",
            case.name,
            1e3 * fused,
            1e3 * composite,
            composite / fused,
            rate / 1e9,
            100.0 * rate / peak
        );
    }
    Ok(())
}
