use crate::model::parameters::{ParameterError, Parameters};

/// The running average of a run's weights: what its checkpoints hold, while the weights themselves go on jumping with every small batch.
///
/// After update t it moves towards the weights by `1 - min(decay, (1 + t) / (10 + t))`, so that it forgets where it began.
#[derive(Debug)]
pub(super) struct WeightAverage {
    decay: f64,
    weights: Parameters,
}

impl WeightAverage {
    /// An average that goes on from these weights, which it takes for its own.
    pub(super) fn of(weights: Parameters, decay: f64) -> Self {
        Self { decay, weights }
    }

    /// Follows `parameters`, where `trained` accepts their names, after update number `updates`, from 1.
    pub(super) fn ema_update(
        &mut self,
        parameters: &Parameters,
        trained: impl Fn(&str) -> bool,
        updates: u64,
    ) -> Result<(), ParameterError> {
        let updates = updates as f64;
        let keep = self.decay.min((1.0 + updates) / (10.0 + updates));
        self.weights.mix(parameters, 1.0 - keep, trained)
    }

    /// The averaged weights.
    pub(super) fn weights(&self) -> &Parameters {
        &self.weights
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::init::Init;
    use crate::model::parameters::ParameterSpec;
    use candle_core::{Device, Tensor};

    fn numbers(parameters: &Parameters) -> Vec<f32> {
        let number = |(_, var): (&str, &candle_core::Var)| var.to_vec1::<f32>().unwrap()[0];
        parameters.iter().map(number).collect()
    }

    #[test]
    fn it_forgets_its_beginning_and_then_follows_slowly() {
        let names = ["actor", "robot"];
        let specs = names.map(|name| ParameterSpec { name: name.into(), shape: vec![1], init: Init::Zeros });
        let raw = Parameters::initialise(&specs, 0, &Device::Cpu).unwrap();
        let mut average = WeightAverage::of(raw.copied().unwrap(), 0.9);
        let mut expected = 0.0;
        for update in 1..=400u32 {
            let value: f32 = if update % 2 == 0 { 3.0 } else { 1.0 };
            for (_, var) in raw.iter() {
                var.set(&Tensor::new(&[value], &Device::Cpu).unwrap()).unwrap();
            }
            average.ema_update(&raw, |name| name == "robot", u64::from(update)).unwrap();
            let keep = (f64::from(1 + update) / f64::from(10 + update)).min(0.9);
            expected = keep * expected + (1.0 - keep) * f64::from(value);
        }
        let found = numbers(average.weights());
        assert_eq!(found[0], 0.0, "what is not trained stays");
        assert!((f64::from(found[1]) - expected).abs() < 1e-5 && (expected - 2.0).abs() < 0.2, "{found:?}");
        assert_eq!(numbers(&raw), [3.0, 3.0], "the weights themselves are left alone");
    }
}
