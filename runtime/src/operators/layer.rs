//! One row: the sum of products, of table rows and of values, perhaps with norm and `SiLU`.

use std::sync::Arc;

use pulp::Arch;
use tract_onnx::pb::NodeProto;
use tract_onnx::tract_hir::internal::*;

use super::build::{Context, Recipe, own};
use super::memory::{Pieces, Results, slice, stateful_op};
use super::norm::norm_of;
use super::{LAYER, SharedTeam, Term};
use crate::kernels::matrix::{Matrix, Precision, Table};
use crate::kernels::norm::Norm;

/// Weights below this are not worth sharing.
const SHARED_WEIGHTS_MIN: usize = 1 << 16;
/// Columns that are handed over at a time: a multiple of what a panel holds.
const COLUMNS: usize = 128;

pub(super) fn build(_: &Context<'_>, node: &NodeProto) -> TractResult<(Box<dyn InferenceOp>, Vec<String>)> {
    own(node, f32::datum_type(), |recipe| {
        let (layer, read) = Layer::of(recipe)?;
        Ok((Box::new(LayerOp(Arc::new(layer), None)), read))
    })
}

/// A term, with its constants.
#[derive(Debug)]
enum Part {
    /// Reads x.
    Product(Matrix),
    /// Reads z.
    Rows { offsets: Vec<i64>, table: Table },
    /// Reads a row.
    Value,
    /// Reads nothing.
    Bias(Vec<f32>),
}

#[derive(Debug)]
struct Layer {
    parts: Vec<Part>,
    norm: Option<Norm>,
    width: usize,
    shape: TVec<usize>,
}

impl Layer {
    fn of(recipe: &Recipe<'_>) -> TractResult<(Self, Vec<usize>)> {
        let width = *recipe.shape.last().ok_or_else(|| format_err!("a layer without a shape"))?;
        if recipe.shape.iter().product::<usize>() != width {
            bail!("a layer of shape {:?}, expected one row", recipe.shape);
        }
        let precision = match recipe.node.get_attr_opt::<i64>("half")? {
            Some(1) => Precision::F16,
            _ => Precision::F32,
        };
        let (mut parts, mut read, mut input) = (Vec::new(), Vec::new(), 0);
        let letters = recipe.node.get_attr::<String>("terms")?;
        for letter in letters.bytes() {
            let term =
                Term::of_letter(letter).ok_or_else(|| format_err!("a layer with terms {letters:?}"))?;
            let (part, inputs) = Part::of(recipe, term, input, width, precision)?;
            if !matches!(part, Part::Bias(_)) {
                read.push(input);
            }
            parts.push(part);
            input += inputs;
        }
        let norm = match recipe.node.get_attr_opt::<f32>("epsilon")? {
            Some(_) => Some(norm_of(recipe, input)?),
            None => None,
        };
        Ok((Self { parts, norm, width, shape: recipe.shape.into() }, read))
    }

    /// Number of weights.
    fn weights(&self) -> usize {
        let of = |part: &Part| match part {
            Part::Product(matrix) => matrix.rows() * matrix.columns(),
            Part::Rows { offsets, table } => offsets.len() * table.columns(),
            Part::Value | Part::Bias(_) => 0,
        };
        self.parts.iter().map(of).sum()
    }

    /// The sum in these columns.
    fn sum(&self, arch: Arch, inputs: &[TValue], first: usize, out: &mut [f32]) -> TractResult<()> {
        let columns = first..first + out.len();
        out.fill(0.0);
        let mut inputs = inputs.iter();
        let mut next = || inputs.next().ok_or_else(|| format_err!("a layer with too few inputs"));
        for part in &self.parts {
            match part {
                Part::Product(matrix) => matrix.add_product(arch, slice(next()?)?, columns.clone(), out),
                Part::Rows { offsets, table } => {
                    let z = slice::<i64>(next()?)?;
                    let rows = z
                        .iter()
                        .zip(offsets)
                        .map(|(z, offset)| usize::try_from(z + offset).unwrap_or(usize::MAX));
                    if rows.clone().any(|row| row >= table.rows()) {
                        bail!("a class that does not exist among {z:?}");
                    }
                    table.add_rows(arch, rows, columns.clone(), out);
                }
                Part::Value => add(out, &slice(next()?)?[columns.clone()]),
                Part::Bias(bias) => add(out, &bias[columns.clone()]),
            }
        }
        Ok(())
    }
}

fn add(out: &mut [f32], values: &[f32]) {
    out.iter_mut().zip(values).for_each(|(out, value)| *out += value);
}

impl Part {
    /// The part that begins at an input, and how many inputs of the node it takes.
    fn of(
        recipe: &Recipe<'_>,
        term: Term,
        input: usize,
        width: usize,
        precision: Precision,
    ) -> TractResult<(Self, usize)> {
        let refuse =
            |shape: &[usize]| Err(format_err!("a weight of shape {shape:?} in a layer {width} wide"));
        match term {
            Term::Product => {
                let (values, shape) = recipe.floats(input + 1)?;
                match *shape {
                    [rows, columns] if columns == width && rows == recipe.input_len(input)? => {
                        Ok((Self::Product(Matrix::new(values, rows, columns, precision)), 2))
                    }
                    _ => refuse(shape),
                }
            }
            Term::Rows => {
                let offsets = recipe.integers(input + 1)?.to_vec();
                let (values, shape) = recipe.floats(input + 2)?;
                match *shape {
                    [rows, columns] if columns == width && offsets.len() == recipe.input_len(input)? => {
                        Ok((Self::Rows { offsets, table: Table::new(values, rows, columns, precision) }, 3))
                    }
                    _ => refuse(shape),
                }
            }
            Term::Value if recipe.input_len(input)? != width => {
                bail!("a layer {width} wide with another value")
            }
            Term::Value if recipe.is_constant(input) => Ok((Self::Bias(recipe.floats(input)?.0.to_vec()), 1)),
            Term::Value => Ok((Self::Value, 1)),
        }
    }
}

#[derive(Debug, Clone)]
pub(super) struct LayerOp(Arc<Layer>, Option<SharedTeam>);

impl LayerOp {
    pub(super) fn settle(&mut self, team: Option<&SharedTeam>) {
        self.1 = team.filter(|_| self.0.weights() >= SHARED_WEIGHTS_MIN).cloned();
    }
}

#[derive(Debug, Clone)]
struct LayerState(Results);

impl LayerState {
    fn new(op: &LayerOp) -> Self {
        Self(Results::new(f32::datum_type(), &op.0.shape))
    }

    fn run(&mut self, op: &LayerOp, inputs: &[TValue]) -> TractResult<TVec<TValue>> {
        let (arch, layer) = (Arch::new(), &*op.0);
        let mut done = Ok(());
        let results = self.0.write(|out: &mut [f32]| {
            done = match &op.1 {
                None => layer.sum(arch, inputs, 0, out),
                Some(team) => shared_sum(arch, layer, inputs, out, team),
            };
            if let Some(norm) = &layer.norm {
                norm.run(arch, out);
            }
        });
        done.and(results)
    }
}

fn shared_sum(
    arch: Arch,
    layer: &Layer,
    inputs: &[TValue],
    out: &mut [f32],
    team: &SharedTeam,
) -> TractResult<()> {
    let failed = std::sync::atomic::AtomicBool::new(false);
    let pieces = Pieces::new(out, COLUMNS);
    let mut team = team.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    team.each(pieces.count(), &|index| {
        // SAFETY: a team runs every index once.
        let out = unsafe { pieces.take(index) };
        if layer.sum(arch, inputs, COLUMNS * index, out).is_err() {
            failed.store(true, std::sync::atomic::Ordering::Relaxed);
        }
    });
    if failed.into_inner() { layer.sum(arch, inputs, 0, &mut vec![0.0; layer.width]) } else { Ok(()) }
}

stateful_op!(LayerOp, LayerState, LAYER);

impl TypedOp for LayerOp {
    fn output_facts(&self, _: &[&TypedFact]) -> TractResult<TVec<TypedFact>> {
        Ok(tvec!(f32::fact(&self.0.shape)))
    }

    as_op!();
}
