//! Every part alone, on the inputs the trainer had.

use rcwm_models::bundle::{Bundle, DType, PartEntry, PartName, TensorSpec};
use rcwm_models::wire::ActionValues;

use super::golden::Golden;
use super::{Flip, OutputError, PartReport, VerifyError};
use crate::engine::{self, EngineError, EngineSettings, Input, Output, Part};
use crate::policy::{Graph, State};

pub(super) struct Checker<'a> {
    bundle: &'a Bundle,
    golden: &'a Golden<'a>,
    settings: EngineSettings,
    /// Where the kind has one.
    encoder: Option<Encoder>,
}

/// For ticks whose golden features were left out of the file.
struct Encoder {
    part: Box<dyn Part>,
    covered: usize,
    features: Vec<f32>,
}

/// A part, ready to run.
enum Loaded {
    Part(Box<dyn Part>),
    /// All of a policy without a world model.
    Policy(Graph),
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
        let encoder = bundle.manifest.part(PartName::Encoder).map(|entry| {
            let features = &entry.outputs[0];
            Ok::<_, VerifyError>(Encoder {
                part: engine::load(bundle, PartName::Encoder, settings)?,
                covered: golden.covered(PartName::Encoder, features)?,
                features: vec![0.0; features.shape.iter().product()],
            })
        });
        Ok(Self { bundle, golden, settings, encoder: encoder.transpose()? })
    }

    pub(super) fn check(
        &mut self,
        part: PartName,
        progress: &mut dyn FnMut(),
    ) -> Result<PartReport, VerifyError> {
        let mut loaded = match part {
            PartName::Policy => Loaded::Policy(Graph::load(self.bundle, self.settings)?),
            _ => Loaded::Part(engine::load(self.bundle, part, self.settings)?),
        };
        let entry = self.bundle.manifest.part(part).ok_or(EngineError::NoPart { part })?;
        let mut places = entry
            .outputs
            .iter()
            .map(|spec| Ok(Place::new(self.golden.covered(part, spec)?, spec.clone())))
            .collect::<Result<Vec<_>, VerifyError>>()?;
        let mut flips = Vec::new();
        for tick in 0..self.golden.ticks {
            progress();
            if places.iter().all(|place| place.covered <= tick) {
                continue;
            }
            self.run(entry, &mut loaded, tick, &mut places)?;
            for place in places.iter_mut().filter(|place| place.covered > tick) {
                place.compare(self.golden, part, tick, &mut flips)?;
            }
        }
        let outputs = places.into_iter().map(|place| place.error).collect();
        Ok(PartReport { part, outputs, flips })
    }

    fn run(
        &mut self,
        entry: &PartEntry,
        loaded: &mut Loaded,
        tick: usize,
        places: &mut [Place],
    ) -> Result<(), VerifyError> {
        let golden = self.golden;
        let (before, action) = (golden.state_before(tick)?, golden.action(tick)?);
        match loaded {
            Loaded::Policy(graph) => {
                graph.run(golden.inputs(tick)?, &action, &before.branches[0].h)?;
                for (place, found) in places.iter_mut().zip(graph.outputs()) {
                    place.f32.copy_from_slice(found);
                }
            }
            Loaded::Part(part) => {
                if entry.inputs.iter().any(|input| input.name == "features") {
                    self.encode(tick)?;
                }
                let after = golden.state_after(tick)?;
                let states = States { before: &before, after: &after, action: &action };
                let inputs =
                    entry.inputs.iter().map(|input| self.input(entry.name, &input.name, &states, tick));
                let inputs = inputs.collect::<Result<Vec<_>, VerifyError>>()?;
                let mut outputs: Vec<_> = places.iter_mut().map(Place::output).collect();
                part.run(&inputs, &mut outputs)?;
            }
        }
        Ok(())
    }

    /// What the trainer gave to an input of a part.
    fn input<'b>(
        &'b self,
        part: PartName,
        name: &str,
        states: &States<'b>,
        tick: usize,
    ) -> Result<Input<'b>, VerifyError> {
        let (golden, branches) = (self.golden, self.bundle.manifest.kind.branches());
        let own = || branches.iter().position(|branch| *branch == part).expect("z and h enter branches only");
        Ok(match (part, name) {
            (_, "image") => Input::U8(golden.image(tick)?),
            (_, "features") => Input::F32(self.encoder.as_ref().map_or(&[], |encoder| &encoder.features)),
            (_, "action") => Input::F32(states.action),
            (_, "state") => Input::F32(golden.measured(tick)?),
            (_, "noise") => Input::F32(golden.noise(part, tick)?),
            (_, "z") => Input::I64(&states.before.branches[own()].z),
            (_, "h") => Input::F32(&states.before.branches[own()].h),
            (_, "e") => Input::F32(golden.expect_f32(PartName::Interaction, "e", tick)?),
            (_, "robot_prior_z") => Input::I64(golden.expect_i64(PartName::Robot, "prior_z", tick)?),
            // It runs before the environment has moved on.
            (PartName::Interaction, "environment_z") => Input::I64(&states.before.branches[1].z),
            (_, of_branch) => {
                let is_of = |branch: &PartName| of_branch.starts_with(branch.as_str());
                let branch = &states.after.branches
                    [branches.iter().position(is_of).expect("the signature names branches of the kind")];
                if of_branch.ends_with("_z") { Input::I64(&branch.z) } else { Input::F32(&branch.h) }
            }
        })
    }

    /// The features of a tick.
    fn encode(&mut self, tick: usize) -> Result<(), VerifyError> {
        let Some(Encoder { part, covered, features }) = &mut self.encoder else { return Ok(()) };
        if tick < *covered {
            features.copy_from_slice(self.golden.expect_f32(PartName::Encoder, "features", tick)?);
            return Ok(());
        }
        let image = Input::U8(self.golden.image(tick)?);
        Ok(part.run(&[image], &mut [Output::F32(features)])?)
    }
}

/// What the trainer had around a tick.
struct States<'a> {
    before: &'a State,
    after: &'a State,
    action: &'a ActionValues,
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
