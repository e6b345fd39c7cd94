//! Every part alone, on the inputs the trainer had.

use rcwm_models::bundle::{Bundle, DType, PartName, TensorSpec};

use super::golden::Golden;
use super::{Flip, OutputError, PartReport, VerifyError};
use crate::engine::{self, EngineSettings, Input, Output, Part};
use crate::policy::State;

pub(super) struct Checker<'a> {
    bundle: &'a Bundle,
    golden: &'a Golden<'a>,
    settings: EngineSettings,
    /// For ticks whose golden features were left out of the file.
    encoder: Box<dyn Part>,
    features: Vec<f32>,
    features_covered: usize,
}

/// One output's place and what was found about it.
struct Place {
    spec: TensorSpec,
    covered: usize,
    f32: Vec<f32>,
    i64: Vec<i64>,
    error: OutputError,
}

impl<'a> Checker<'a> {
    pub(super) fn new(
        bundle: &'a Bundle,
        golden: &'a Golden<'a>,
        settings: EngineSettings,
    ) -> Result<Self, VerifyError> {
        let (_, outputs) = PartName::Encoder.signature(&bundle.manifest.model);
        let features = &outputs[0];
        Ok(Self {
            bundle,
            golden,
            settings,
            encoder: engine::load(bundle, PartName::Encoder, settings)?,
            features: vec![0.0; features.shape.iter().product()],
            features_covered: golden.covered(PartName::Encoder, features)?,
        })
    }

    pub(super) fn check(
        &mut self,
        part: PartName,
        progress: &mut dyn FnMut(),
    ) -> Result<PartReport, VerifyError> {
        let mut loaded = engine::load(self.bundle, part, self.settings)?;
        let (_, outputs) = part.signature(&self.bundle.manifest.model);
        let mut places = outputs
            .into_iter()
            .map(|spec| Ok(Place::new(self.golden.covered(part, &spec)?, spec)))
            .collect::<Result<Vec<_>, VerifyError>>()?;
        let mut flips = Vec::new();
        for tick in 0..self.golden.ticks {
            progress();
            if places.iter().all(|place| place.covered <= tick) {
                continue;
            }
            self.run(part, loaded.as_mut(), tick, &mut places)?;
            for place in places.iter_mut().filter(|place| place.covered > tick) {
                place.compare(self.golden, part, tick, &mut flips)?;
            }
        }
        let outputs = places.into_iter().map(|place| place.error).collect();
        Ok(PartReport { part, outputs, flips })
    }

    fn run(
        &mut self,
        part: PartName,
        loaded: &mut dyn Part,
        tick: usize,
        places: &mut [Place],
    ) -> Result<(), VerifyError> {
        let golden = self.golden;
        let mut outputs: Vec<_> = places.iter_mut().map(Place::output).collect();
        let before = golden.state_before(tick)?;
        let action = golden.action(tick)?;
        match part {
            PartName::Encoder => loaded.run(&[Input::U8(golden.image(tick)?)], &mut outputs)?,
            PartName::Robot => {
                let noise = Input::F32(golden.noise(part, tick)?);
                let State { robot, .. } = &before;
                let features = Input::F32(self.features(tick)?);
                let measured = golden.measured(tick)?;
                let inputs = [
                    Input::I64(&robot.z),
                    Input::F32(&robot.h),
                    Input::F32(&action),
                    features,
                    noise,
                    Input::F32(measured),
                ];
                loaded.run(&inputs[..if measured.is_empty() { 5 } else { 6 }], &mut outputs)?;
            }
            PartName::Interaction => {
                let inputs = [
                    Input::I64(golden.expect_i64(PartName::Robot, "prior_z", tick)?),
                    Input::F32(golden.expect_f32(PartName::Robot, "h_next", tick)?),
                    Input::I64(&before.environment.z),
                ];
                loaded.run(&inputs, &mut outputs)?;
            }
            PartName::Environment => {
                let noise = Input::F32(golden.noise(part, tick)?);
                let e = Input::F32(golden.expect_f32(PartName::Interaction, "e", tick)?);
                let features = Input::F32(self.features(tick)?);
                loaded.run(&[e, Input::F32(&before.environment.h), features, noise], &mut outputs)?;
            }
            PartName::Actor | PartName::Reward | PartName::Continue | PartName::Decoder => {
                let State { robot, environment } = golden.state_after(tick)?;
                let inputs = [
                    Input::I64(&robot.z),
                    Input::F32(&robot.h),
                    Input::I64(&environment.z),
                    Input::F32(&environment.h),
                ];
                loaded.run(&inputs, &mut outputs)?;
            }
        }
        Ok(())
    }

    fn features(&mut self, tick: usize) -> Result<&[f32], VerifyError> {
        if tick < self.features_covered {
            return self.golden.expect_f32(PartName::Encoder, "features", tick);
        }
        let image = Input::U8(self.golden.image(tick)?);
        self.encoder.run(&[image], &mut [Output::F32(&mut self.features)])?;
        Ok(&self.features)
    }
}

impl Place {
    fn new(covered: usize, spec: TensorSpec) -> Self {
        let len = spec.shape.iter().product();
        let classes = spec.dtype == DType::I64;
        let error = OutputError { output: spec.name.clone(), ticks: 0, error_max: 0.0, scale: 1.0, classes };
        let (f32, i64) = if classes { (Vec::new(), vec![0; len]) } else { (vec![0.0; len], Vec::new()) };
        Self { spec, covered, f32, i64, error }
    }

    fn output(&mut self) -> Output<'_> {
        match self.error.classes {
            true => Output::I64(&mut self.i64),
            false => Output::F32(&mut self.f32),
        }
    }

    fn compare(
        &mut self,
        golden: &Golden<'_>,
        part: PartName,
        tick: usize,
        flips: &mut Vec<Flip>,
    ) -> Result<(), VerifyError> {
        self.error.ticks += 1;
        if !self.error.classes {
            let expected = golden.expect_f32(part, &self.spec.name, tick)?;
            self.error.error_max = worst(self.error.error_max, error_max(&self.f32, expected));
            self.error.scale = expected
                .iter()
                .filter(|x| x.is_finite())
                .fold(self.error.scale, |scale, x| scale.max(x.abs()));
            return Ok(());
        }
        let index = usize::from(self.spec.name == "posterior_z");
        let before = flips.len();
        note_flips(golden, part, index, tick, &self.i64, flips)?;
        self.error.error_max += (flips.len() - before) as f32;
        Ok(())
    }
}

/// Appends the classes of a branch that differ from the trainer's; `index` is 0 for the prior, 1 for the posterior.
pub(super) fn note_flips(
    golden: &Golden<'_>,
    branch: PartName,
    index: usize,
    tick: usize,
    found: &[i64],
    flips: &mut Vec<Flip>,
) -> Result<(), VerifyError> {
    let output = ["prior_z", "posterior_z"][index];
    let expected = golden.expect_i64(branch, output, tick)?;
    for (categorical, (expected, found)) in expected.iter().zip(found).enumerate() {
        if expected != found {
            let margin = golden.margin(branch, index, tick, categorical)?;
            let (expected, found) = (*expected, *found);
            flips.push(Flip { tick, branch, output, categorical, expected, found, margin, follows: false });
        }
    }
    Ok(())
}

/// Largest absolute difference; NaN if there is one anywhere.
pub(super) fn error_max(found: &[f32], expected: &[f32]) -> f32 {
    found.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, worst)
}

/// The larger of two errors; NaN is the largest.
pub(super) fn worst(a: f32, b: f32) -> f32 {
    if a.is_nan() || b.is_nan() { f32::NAN } else { a.max(b) }
}

#[cfg(test)]
mod tests {
    #[test]
    fn no_error_hides_behind_a_number_that_is_none() {
        assert_eq!(super::error_max(&[1.0, 2.0], &[1.5, 2.0]), 0.5);
        assert!(super::error_max(&[f32::NAN, 2.0], &[1.5, 2.0]).is_nan());
        assert!(super::error_max(&[2.0, f32::NAN], &[1.5, 2.0]).is_nan());
    }
}
