//! Golden values, tick by tick.

use std::path::PathBuf;

use rcwm_models::bundle::{Bundle, CARRIED, CARRIED_NEXT, DType, PartName, TensorSpec};
use rcwm_models::interface::{Camera, Normaliser};
use rcwm_models::tensors::{Tensors, TensorsError, Values};
use rcwm_models::wire::ActionValues;

use super::VerifyError;
use crate::policy::{BranchState, Inputs, State};

/// Typed access to a bundle's golden values.
pub struct Golden<'a> {
    bundle: &'a Bundle,
    /// Ticks for which everything that a tick needs is there.
    pub ticks: usize,
    /// Of a policy without a world model: each tick's cameras, one after another.
    images: Vec<u8>,
}

impl<'a> Golden<'a> {
    /// Checks that everything that a tick needs is there.
    ///
    /// # Errors
    /// [`VerifyError::Golden`] says what is missing or of another type or size.
    pub fn of(bundle: &'a Bundle) -> Result<Self, VerifyError> {
        let mut this = Self { bundle, ticks: usize::MAX, images: Vec::new() };
        let manifest = &bundle.manifest;
        let mut ticks = vec![
            this.rows("input/action", DType::F32, manifest.interface.action_numbers())?,
            this.rows("input/is_first", DType::U8, 1)?,
        ];
        let measured = manifest.measured_numbers();
        if measured > 0 {
            ticks.push(this.rows("input/state", DType::F32, measured)?);
        }
        match &manifest.model {
            Some(model) => {
                ticks.push(this.rows("input/image", DType::U8, manifest.image_bytes())?);
                for branch in manifest.kind.branches() {
                    ticks.push(this.rows(&noise_name(*branch), DType::F32, 2 * model.stoch_width())?);
                }
            }
            None => {
                for camera in manifest.cameras() {
                    let len = camera.shape.iter().product();
                    ticks.push(this.rows(&camera_name(camera), DType::U8, len)?);
                }
            }
        }
        this.ticks = ticks.first().copied().unwrap_or(0);
        if ticks.iter().any(|rows| *rows != this.ticks) {
            let (found, expected) = (format!("of {ticks:?} ticks"), "as many ticks of each input".to_owned());
            return Err(this.wrong(TensorsError::Unexpected { name: "input/*".into(), found, expected }));
        }
        if this.ticks == 0 {
            return Err(this.wrong(TensorsError::Missing { name: "input/*, at least one tick".into() }));
        }
        if manifest.model.is_none() {
            for tick in 0..this.ticks {
                for camera in manifest.cameras() {
                    let image = this.u8(&camera_name(camera), tick)?;
                    this.images.extend_from_slice(image);
                }
            }
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

    pub(super) fn image(&self, tick: usize) -> Result<&[u8], VerifyError> {
        if self.bundle.manifest.model.is_some() {
            return self.u8("input/image", tick);
        }
        let len = self.bundle.manifest.image_bytes();
        Ok(self.images.get(tick * len..(tick + 1) * len).unwrap_or_default())
    }

    /// The measured state; empty where the policy reads none.
    pub(super) fn measured(&self, tick: usize) -> Result<&'a [f32], VerifyError> {
        let reads_none = self.bundle.manifest.measured_numbers() == 0;
        if reads_none { Ok(&[]) } else { self.f32("input/state", tick) }
    }

    /// What the policy sees at a tick.
    ///
    /// # Errors
    /// [`VerifyError::Golden`] for a tick that is not there.
    pub fn inputs(&self, tick: usize) -> Result<Inputs<'_>, VerifyError> {
        Ok(Inputs { image: self.image(tick)?, state: self.measured(tick)? })
    }

    pub(super) fn is_first(&self, tick: usize) -> Result<bool, VerifyError> {
        Ok(tick == 0 || self.u8("input/is_first", tick)?[0] != 0)
    }

    /// The action that leads to the tick, as the model has it: zeros where an episode begins.
    pub(super) fn action(&self, tick: usize) -> Result<ActionValues, VerifyError> {
        if self.is_first(tick)? {
            return Ok(ActionValues::zeros(self.bundle.manifest.interface.action_numbers()));
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
        self.f32(&noise_name(branch), tick)
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
        let classes = self.bundle.manifest.model.as_ref().map_or(0, |model| model.classes) as i64;
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
        let manifest = &self.bundle.manifest;
        if manifest.model.is_none() {
            return self.carried_after(tick);
        }
        let branch = |branch: &PartName| -> Result<BranchState, VerifyError> {
            let z = self.expect_i64(*branch, "posterior_z", tick)?.to_vec();
            Ok(BranchState { z, h: self.expect_f32(*branch, "h_next", tick)?.to_vec() })
        };
        Ok(State { branches: manifest.kind.branches().iter().map(branch).collect::<Result<_, _>>()? })
    }

    /// The same of a policy that carries tensors of its own.
    fn carried_after(&self, tick: usize) -> Result<State, VerifyError> {
        let mut all = BranchState::default();
        let entry = self.bundle.manifest.part(PartName::Policy);
        for input in entry.iter().flat_map(|entry| &entry.inputs) {
            if let Some(name) = input.name.strip_prefix(CARRIED) {
                let next = format!("{CARRIED_NEXT}{name}");
                all.h.extend_from_slice(self.expect_f32(PartName::Policy, &next, tick)?);
            }
        }
        Ok(State { branches: vec![all] })
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
        let (n, m) =
            self.bundle.manifest.model.as_ref().map_or((0, 0), |model| (model.categoricals, model.classes));
        let output = ["prior_log_probs", "posterior_log_probs"][index];
        let log_probs = &self.expect_f32(branch, output, tick)?[categorical * m..][..m];
        let noise = &self.noise(branch, tick)?[(index * n + categorical) * m..][..m];
        Ok(two_best_apart(log_probs.iter().zip(noise).map(|(log_prob, noise)| log_prob + noise)))
    }
}

fn expect_name(part: PartName, output: &str) -> String {
    format!("expect/{part}/{output}")
}

fn noise_name(branch: PartName) -> String {
    format!("input/{branch}_noise")
}

fn camera_name(camera: &Camera) -> String {
    format!("input/{}", camera.name)
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
