//! One row: the sum of products, of table rows and of values, perhaps with norm and `SiLU`.

use pulp::Arch;
use tract_onnx::pb::NodeProto;
use tract_onnx::tract_hir::internal::*;

use super::build::{Context, OpContext, custom_op};
use super::compute::Compute;
use super::custom_op::CustomOp;
use super::memory::slice;
use super::norm::norm_of;
use super::{LAYER, Term};
use rcwm_kernels::tick::matrix::Matrix;
use rcwm_kernels::tick::norm::Norm;
use rcwm_kernels::tick::table::Table;
use rcwm_kernels::tick::weights::Precision;

/// Weights below this are not worth sharing.
const SHARED_WEIGHTS_MIN: usize = 1 << 16;
/// Columns that are handed over at a time: a multiple of what a panel holds.
const COLUMNS: usize = 128;

pub(super) fn build(_: &Context<'_>, node: &NodeProto) -> TractResult<(Box<dyn InferenceOp>, Vec<String>)> {
    custom_op(node, f32::datum_type(), |context| {
        let (layer, read) = Layer::of(context)?;
        Ok((CustomOp::boxed(layer), read))
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
pub(super) struct Layer {
    parts: Vec<Part>,
    norm: Option<Norm>,
    shape: TVec<usize>,
}

impl Layer {
    fn of(context: &OpContext<'_>) -> TractResult<(Self, Vec<usize>)> {
        let width = *context.shape.last().ok_or_else(|| format_err!("a layer without a shape"))?;
        if context.shape.iter().product::<usize>() != width {
            bail!("a layer of shape {:?}, expected one row", context.shape);
        }
        let precision = match context.node.get_attr_opt::<i64>("half")? {
            Some(1) => Precision::F16,
            _ => Precision::F32,
        };
        let (mut parts, mut read, mut input) = (Vec::new(), Vec::new(), 0);
        let letters = context.node.get_attr::<String>("terms")?;
        for letter in letters.bytes() {
            let term =
                Term::of_letter(letter).ok_or_else(|| format_err!("a layer with terms {letters:?}"))?;
            let (part, inputs) = Part::of(context, term, input, width, precision)?;
            if !matches!(part, Part::Bias(_)) {
                read.push(input);
            }
            parts.push(part);
            input += inputs;
        }
        let norm = match context.node.get_attr_opt::<f32>("epsilon")? {
            Some(_) => Some(norm_of(context, input)?),
            None => None,
        };
        Ok((Self { parts, norm, shape: context.shape.into() }, read))
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
                    let row = |z: &i64, offset: &i64| usize::try_from(z.checked_add(*offset)?).ok();
                    let rows = z.iter().zip(offsets).map(|(z, offset)| row(z, offset).unwrap_or(usize::MAX));
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
        context: &OpContext<'_>,
        term: Term,
        input: usize,
        width: usize,
        precision: Precision,
    ) -> TractResult<(Self, usize)> {
        let refuse =
            |shape: &[usize]| Err(format_err!("a weight of shape {shape:?} in a layer {width} wide"));
        match term {
            Term::Product => {
                let (values, shape) = context.floats(input + 1)?;
                match *shape {
                    [rows, columns] if columns == width && rows == context.input_len(input)? => {
                        Ok((Self::Product(Matrix::new(values, rows, columns, precision)), 2))
                    }
                    _ => refuse(shape),
                }
            }
            Term::Rows => {
                let offsets = context.integers(input + 1)?.to_vec();
                let (values, shape) = context.floats(input + 2)?;
                match *shape {
                    [rows, columns] if columns == width && offsets.len() == context.input_len(input)? => {
                        Ok((Self::Rows { offsets, table: Table::new(values, rows, columns, precision) }, 3))
                    }
                    _ => refuse(shape),
                }
            }
            Term::Value if context.input_len(input)? != width => {
                bail!("a layer {width} wide with another value")
            }
            Term::Value if context.is_constant(input) => {
                Ok((Self::Bias(context.floats(input)?.0.to_vec()), 1))
            }
            Term::Value => Ok((Self::Value, 1)),
        }
    }
}

impl Compute for Layer {
    type Number = f32;
    type Scratch = ();
    const NAME: &'static str = LAYER;

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn scratch(&self) {}

    fn piece_len(&self) -> Option<usize> {
        (self.weights() >= SHARED_WEIGHTS_MIN).then_some(COLUMNS)
    }

    fn fill(&self, inputs: &[TValue], (): &(), first: usize, out: &mut [f32]) -> TractResult<()> {
        self.sum(Arch::new(), inputs, first, out)
    }

    fn finish(&self, out: &mut [f32]) {
        if let Some(norm) = &self.norm {
            norm.run(Arch::new(), out);
        }
    }
}
