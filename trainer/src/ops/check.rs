//! Fused ops against their composites and against finite differences.

use candle_core::{Device, Result, Tensor, Var};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Numbers between the limits; the same seed gives the same.
pub fn uniform(shape: &[usize], seed: u64, low: f32, high: f32) -> Tensor {
    let mut generator = ChaCha8Rng::seed_from_u64(seed);
    let values: Vec<f32> = (0..shape.iter().product()).map(|_| generator.random_range(low..high)).collect();
    Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
}

/// Numbers between -1.5 and 1.5.
pub fn random(shape: &[usize], seed: u64) -> Tensor {
    uniform(shape, seed, -1.5, 1.5)
}

fn numbers(x: &Tensor) -> Vec<f32> {
    x.flatten_all().unwrap().to_vec1().unwrap()
}

/// Largest difference, relative to the largest entry of the second.
fn difference(found: &Tensor, expected: &Tensor) -> f32 {
    assert_eq!(found.dims(), expected.dims());
    let (found, expected) = (numbers(found), numbers(expected));
    let largest = expected.iter().fold(f32::MIN_POSITIVE, |most, x| most.max(x.abs()));
    let worst = found
        .iter()
        .zip(&expected)
        .fold(0f32, |most, (a, b)| if (a - b).is_nan() { f32::NAN } else { most.max((a - b).abs()) });
    worst / largest.max(1e-3)
}

/// Outputs and the gradients of all inputs under random gradients of the outputs.
fn run(inputs: &[Tensor], op: impl Fn(&[Tensor]) -> Result<Vec<Tensor>>) -> (Vec<Tensor>, Vec<Tensor>) {
    let vars: Vec<Var> = inputs.iter().map(|x| Var::from_tensor(x).unwrap()).collect();
    // A step between variable and op, as in a model: gradients must reach what is no variable, too.
    let steps: Vec<Tensor> = vars.iter().map(|var| (var.as_tensor() * 1.0).unwrap()).collect();
    let outputs = op(&steps).unwrap();
    let grads = score(&outputs).backward().unwrap();
    let grads = vars.iter().map(|var| match grads.get(var) {
        Some(grad) => grad.contiguous().unwrap(),
        None => var.zeros_like().unwrap(),
    });
    (outputs.clone(), grads.collect())
}

/// A number that depends on every entry of the outputs.
fn score(outputs: &[Tensor]) -> Tensor {
    let terms = outputs.iter().enumerate().filter(|(_, y)| y.track_op() || outputs.len() == 1);
    let terms = terms.map(|(i, y)| (y * random(y.dims(), 900 + i as u64)).unwrap().sum_all().unwrap());
    terms.reduce(|a, b| (a + b).unwrap()).unwrap()
}

/// Asserts that both give the same values and gradients, up to 1e-5 of the largest entry, and that the op repeats itself bit for bit.
pub fn agree(
    inputs: &[Tensor],
    op: impl Fn(&[Tensor]) -> Result<Vec<Tensor>>,
    oracle: impl Fn(&[Tensor]) -> Result<Vec<Tensor>>,
) {
    let (outputs, grads) = run(inputs, &op);
    let (expected, expected_grads) = run(inputs, oracle);
    let (again, grads_again) = run(inputs, op);
    for (i, (found, expected)) in outputs.iter().zip(&expected).enumerate() {
        let error = difference(found, expected);
        assert!(error <= 1e-5, "output {i} of {:?}: {error:e}", shapes(inputs));
    }
    for (i, (found, expected)) in grads.iter().zip(&expected_grads).enumerate() {
        let error = difference(found, expected);
        assert!(error <= 1e-5, "gradient of input {i} of {:?}: {error:e}", shapes(inputs));
    }
    for (once, again) in outputs.iter().chain(&grads).zip(again.iter().chain(&grads_again)) {
        assert_eq!(numbers(once), numbers(again), "not the same twice: {:?}", shapes(inputs));
    }
}

/// Asserts that the gradient of each input is the slope of the op along a random direction.
pub fn slopes_agree(inputs: &[Tensor], op: impl Fn(&[Tensor]) -> Result<Vec<Tensor>>) {
    const STEP: f64 = 4e-3;
    let (_, grads) = run(inputs, &op);
    for (i, grad) in grads.iter().enumerate() {
        let direction = random(inputs[i].dims(), 700 + i as u64);
        let value = |sign: f64| -> f64 {
            let mut moved = inputs.to_vec();
            moved[i] = (&inputs[i] + (&direction * (sign * STEP)).unwrap()).unwrap();
            // Sums in f64: the difference of two of them is what is looked at.
            let outputs = op(&moved).unwrap();
            let terms = outputs.iter().enumerate().flat_map(|(i, y)| {
                let weights = numbers(&random(y.dims(), 900 + i as u64));
                numbers(y)
                    .into_iter()
                    .zip(weights)
                    .map(|(y, w)| f64::from(y) * f64::from(w))
                    .collect::<Vec<_>>()
            });
            terms.sum()
        };
        let slope = (value(1.0) - value(-1.0)) / (2.0 * STEP);
        let pairs = numbers(grad).into_iter().zip(numbers(&direction));
        let expected: f64 = pairs.map(|(g, d)| f64::from(g) * f64::from(d)).sum();
        let scale = numbers(grad).iter().map(|g| f64::from(*g).abs()).sum::<f64>().max(1e-2);
        assert!(
            (slope - expected).abs() <= 2e-3 * scale,
            "input {i} of {:?}: slope {slope}, gradient {expected}",
            shapes(inputs)
        );
    }
}

fn shapes(inputs: &[Tensor]) -> Vec<&[usize]> {
    inputs.iter().map(Tensor::dims).collect()
}
