//! Golden values, tick by tick.

use std::path::PathBuf;

use rcwm_models::bundle::{Bundle, DType, PartName, TensorSpec};
use rcwm_models::interface::Normaliser;
use rcwm_models::tensors::{Tensors, TensorsError, Values};
use rcwm_models::wire::ActionValues;

use super::VerifyError;
use crate::policy::{Inputs, State};

pub(super) const BRANCHES: [PartName; 2] = [PartName::Robot, PartName::Environment];

/// Typed access to a bundle's golden values.
pub(super) struct Golden<'a> {
    bundle: &'a Bundle,
    /// Ticks for which everything that a tick needs is there.
    pub(super) ticks: usize,
}

impl<'a> Golden<'a> {
    pub(super) fn of(bundle: &'a Bundle) -> Result<Self, VerifyError> {
        let mut this = Self { bundle, ticks: usize::MAX };
        let noise_len = 2 * bundle.manifest.model.stoch_width();
        let encoder = bundle.manifest.parts.iter().find(|part| part.name == PartName::Encoder);
        let image = encoder.and_then(|part| part.inputs.first());
        let image_bytes = image.map_or(0, |image| image.shape.iter().product());
        let ticks = [
            this.rows("input/image", DType::U8, image_bytes)?,
            this.rows("input/action", DType::F32, bundle.manifest.model.action)?,
            this.rows("input/is_first", DType::U8, 1)?,
            this.rows("input/robot_noise", DType::F32, noise_len)?,
            this.rows("input/environment_noise", DType::F32, noise_len)?,
        ];
        let state = bundle.manifest.model.state;
        let measured = if state == 0 { usize::MAX } else { this.rows("input/state", DType::F32, state)? };
        this.ticks = ticks.into_iter().chain([measured]).min().unwrap_or(0);
        if this.ticks == 0 {
            return Err(this.wrong(TensorsError::Missing { name: "input/*, at least one tick".into() }));
        }
        Ok(this)
    }

    fn wrong(&self, source: TensorsError) -> VerifyError {
        let file: PathBuf = self.bundle.folder.join(&self.bundle.manifest.golden.file);
        VerifyError::Golden { file, source }
    }

    fn tensors(&self) -> &'a Tensors {
        &self.bundle.golden
    }

    /// How many ticks a tensor covers; checks type and size of a tick.
    fn rows(&self, name: &str, dtype: DType, len: usize) -> Result<usize, VerifyError> {
        let values = self.tensors().get(name).map_err(|source| self.wrong(source))?;
        let found = match values {
            Values::U8(_) => DType::U8,
            Values::I64(_) => DType::I64,
            Values::F32(_) => DType::F32,
        };
        let shape = values.shape();
        let per_tick: usize = shape.iter().skip(1).product();
        if found != dtype || shape.is_empty() || per_tick != len {
            return Err(self.wrong(TensorsError::Unexpected {
                name: name.to_owned(),
                found: format!("{found:?} {shape:?}"),
                expected: format!("{dtype:?} with {len} elements a tick"),
            }));
        }
        Ok(shape[0])
    }

    /// How many ticks of a part's output are there.
    pub(super) fn covered(&self, part: PartName, output: &TensorSpec) -> Result<usize, VerifyError> {
        self.rows(&expect_name(part, &output.name), output.dtype, output.shape.iter().product())
    }

    /// Whether any expected value of the part is there.
    pub(super) fn has(&self, part: PartName) -> bool {
        let prefix = format!("expect/{part}/");
        self.tensors().0.keys().any(|name| name.starts_with(&prefix))
    }

    fn f32(&self, name: &str, tick: usize) -> Result<&'a [f32], VerifyError> {
        let array = self.tensors().f32(name).map_err(|source| self.wrong(source))?;
        self.row(name, array.as_slice(), array.shape(), tick)
    }

    fn i64(&self, name: &str, tick: usize) -> Result<&'a [i64], VerifyError> {
        let array = self.tensors().i64(name).map_err(|source| self.wrong(source))?;
        self.row(name, array.as_slice(), array.shape(), tick)
    }

    fn u8(&self, name: &str, tick: usize) -> Result<&'a [u8], VerifyError> {
        let array = self.tensors().u8(name).map_err(|source| self.wrong(source))?;
        self.row(name, array.as_slice(), array.shape(), tick)
    }

    fn row<T>(
        &self,
        name: &str,
        values: Option<&'a [T]>,
        shape: &[usize],
        tick: usize,
    ) -> Result<&'a [T], VerifyError> {
        let len: usize = shape.iter().skip(1).product();
        values.and_then(|values| values.get(tick * len..(tick + 1) * len)).ok_or_else(|| {
            self.wrong(TensorsError::Unexpected {
                name: name.to_owned(),
                found: format!("{shape:?}"),
                expected: format!("at least {} ticks", tick + 1),
            })
        })
    }

    pub(super) fn image(&self, tick: usize) -> Result<&'a [u8], VerifyError> {
        self.u8("input/image", tick)
    }

    /// The measured state; empty where the model reads none.
    pub(super) fn measured(&self, tick: usize) -> Result<&'a [f32], VerifyError> {
        if self.bundle.manifest.model.state == 0 { Ok(&[]) } else { self.f32("input/state", tick) }
    }

    pub(super) fn inputs(&self, tick: usize) -> Result<Inputs<'a>, VerifyError> {
        Ok(Inputs { image: self.image(tick)?, state: self.measured(tick)? })
    }

    pub(super) fn is_first(&self, tick: usize) -> Result<bool, VerifyError> {
        Ok(tick == 0 || self.u8("input/is_first", tick)?[0] != 0)
    }

    /// The action that leads to the tick, as the model has it: zeros where an episode begins.
    pub(super) fn action(&self, tick: usize) -> Result<ActionValues, VerifyError> {
        if self.is_first(tick)? {
            return Ok(ActionValues::zeros(self.bundle.manifest.model.action));
        }
        Ok(self.f32("input/action", tick)?.iter().copied().collect())
    }

    /// The same in the interface's units, as a robot reports it.
    pub(super) fn executed(&self, tick: usize) -> Result<ActionValues, VerifyError> {
        let action = self.action(tick)?;
        let mut units = action;
        let wrong = |_| VerifyError::Golden {
            file: self.bundle.folder.join(&self.bundle.manifest.golden.file),
            source: TensorsError::Unexpected {
                name: "input/action".into(),
                found: format!("{action:?}"),
                expected: "finite numbers".into(),
            },
        };
        Normaliser::of(&self.bundle.manifest.interface).to_units(&action, &mut units).map_err(wrong)?;
        Ok(units)
    }

    /// Gumbel noise of a branch, `[2, n, m]`.
    pub(super) fn noise(&self, branch: PartName, tick: usize) -> Result<&'a [f32], VerifyError> {
        self.f32(&format!("input/{branch}_noise"), tick)
    }

    pub(super) fn expect_f32(
        &self,
        part: PartName,
        output: &str,
        tick: usize,
    ) -> Result<&'a [f32], VerifyError> {
        self.f32(&expect_name(part, output), tick)
    }

    pub(super) fn expect_i64(
        &self,
        part: PartName,
        output: &str,
        tick: usize,
    ) -> Result<&'a [i64], VerifyError> {
        let name = expect_name(part, output);
        let indices = self.i64(&name, tick)?;
        let classes = self.bundle.manifest.model.classes as i64;
        // They enter parts as indices of a table's rows.
        match indices.iter().find(|class| !(0..classes).contains(*class)) {
            None => Ok(indices),
            Some(class) => Err(self.wrong(TensorsError::Unexpected {
                name,
                found: format!("class {class} at tick {tick}"),
                expected: format!("classes 0 to {}", classes - 1),
            })),
        }
    }

    /// The state after a tick.
    pub(super) fn state_after(&self, tick: usize) -> Result<State, VerifyError> {
        let mut state = State::default();
        for (branch, to) in BRANCHES.into_iter().zip([&mut state.robot, &mut state.environment]) {
            to.z = self.expect_i64(branch, "posterior_z", tick)?.to_vec();
            to.h = self.expect_f32(branch, "h_next", tick)?.to_vec();
        }
        Ok(state)
    }

    /// The state that enters a tick: the initial one at the first of an episode.
    pub(super) fn state_before(&self, tick: usize) -> Result<State, VerifyError> {
        if self.is_first(tick)? {
            return Ok(State::from(&self.bundle.initial));
        }
        self.state_after(tick - 1)
    }

    /// How clearly a class won: the difference of the two largest of log-probability + noise.
    /// `index` is 0 for the prior and 1 for the posterior.
    pub(super) fn margin(
        &self,
        branch: PartName,
        index: usize,
        tick: usize,
        categorical: usize,
    ) -> Result<f32, VerifyError> {
        let model = &self.bundle.manifest.model;
        let (n, m) = (model.categoricals, model.classes);
        let output = ["prior_log_probs", "posterior_log_probs"][index];
        let log_probs = &self.expect_f32(branch, output, tick)?[categorical * m..][..m];
        let noise = &self.noise(branch, tick)?[(index * n + categorical) * m..][..m];
        Ok(two_best_apart(log_probs.iter().zip(noise).map(|(log_prob, noise)| log_prob + noise)))
    }
}

fn expect_name(part: PartName, output: &str) -> String {
    format!("expect/{part}/{output}")
}

fn two_best_apart(scores: impl Iterator<Item = f32>) -> f32 {
    let (mut best, mut second) = (f32::NEG_INFINITY, f32::NEG_INFINITY);
    for score in scores {
        if score > best {
            (best, second) = (score, best);
        } else if score > second {
            second = score;
        }
    }
    best - second
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_margin_is_between_the_two_best() {
        assert_eq!(super::two_best_apart([1.0, 4.0, 3.5, -2.0].into_iter()), 0.5);
        assert_eq!(super::two_best_apart([4.0, 4.0].into_iter()), 0.0);
    }
}
