//! How a node of ours in an ONNX graph becomes an operator in tract.

use std::sync::Arc;

use tract_onnx::model::ParsingContext;
use tract_onnx::pb::NodeProto;
use tract_onnx::tract_hir::internal::*;

/// What an operator is made of: the node with its attributes, and its inputs that are constants.
pub(super) struct OpContext<'a> {
    pub(super) node: &'a NodeProto,
    pub(super) shape: &'a [usize],
    pub(super) facts: Vec<TypedFact>,
    constants: Vec<Option<Arc<Tensor>>>,
}

impl OpContext<'_> {
    /// The floats of a constant input, and its shape.
    pub(super) fn floats(&self, input: usize) -> TractResult<(&[f32], &[usize])> {
        let tensor = self.constant(input)?;
        Ok((tensor.try_as_plain_ram()?.as_slice::<f32>()?, tensor.shape()))
    }

    /// The integers of a constant input.
    pub(super) fn integers(&self, input: usize) -> TractResult<&[i64]> {
        self.constant(input)?.try_as_plain_ram()?.as_slice::<i64>()
    }

    fn constant(&self, input: usize) -> TractResult<&Tensor> {
        let constant = self.constants.get(input).and_then(Option::as_deref);
        constant.ok_or_else(|| format_err!("input {input} of {} is not a constant", self.node.name))
    }

    pub(super) fn is_constant(&self, input: usize) -> bool {
        self.constants.get(input).is_some_and(Option::is_some)
    }

    /// Number of elements of an input.
    pub(super) fn input_len(&self, input: usize) -> TractResult<usize> {
        let fact =
            self.facts.get(input).ok_or_else(|| format_err!("{} has no input {input}", self.node.name))?;
        let shape = fact.shape.as_concrete().ok_or_else(|| format_err!("an input of unknown shape"))?;
        Ok(shape.iter().product())
    }
}

/// Makes the operator, and says which inputs it still reads.
pub(super) type Make = fn(&OpContext<'_>) -> TractResult<(Box<dyn TypedOp>, Vec<usize>)>;

#[derive(Clone)]
struct OwnNode {
    node: NodeProto,
    dtype: DatumType,
    shape: Vec<usize>,
    make: Make,
}

impl std::fmt::Debug for OwnNode {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.node.op_type)
    }
}

/// The builder of a node with one output, whose shape stands in the attribute `shape`.
pub(super) fn custom_op(
    node: &NodeProto,
    dtype: DatumType,
    make: Make,
) -> TractResult<(Box<dyn InferenceOp>, Vec<String>)> {
    let shape = node.get_attr_vec::<usize>("shape")?;
    Ok((expand(OwnNode { node: node.clone(), dtype, shape, make }), vec![]))
}

impl Expansion for OwnNode {
    fn name(&self) -> StaticName {
        self.node.op_type.clone().into()
    }

    fn rules<'r, 'p: 'r, 's: 'r>(
        &'s self,
        s: &mut Solver<'r>,
        _: &'p [TensorProxy],
        outputs: &'p [TensorProxy],
    ) -> InferenceResult {
        check_output_arity(outputs, 1)?;
        s.equals(&outputs[0].datum_type, self.dtype)?;
        let shape: TVec<TDim> = self.shape.iter().map(|size| size.to_dim()).collect();
        s.equals(&outputs[0].shape, shape)?;
        Ok(())
    }

    fn wire(&self, prefix: &str, model: &mut TypedModel, inputs: &[OutletId]) -> TractResult<TVec<OutletId>> {
        let facts =
            inputs.iter().map(|input| model.outlet_fact(*input).cloned()).collect::<TractResult<Vec<_>>>()?;
        let constants = facts.iter().map(|fact| fact.konst.clone()).collect();
        let context = OpContext { node: &self.node, shape: &self.shape, facts, constants };
        let (op, read) = (self.make)(&context)?;
        let read: Vec<OutletId> = read.into_iter().map(|input| inputs[input]).collect();
        model.wire_node(prefix, op, &read)
    }
}

/// What tract's reader hands to a builder.
pub(super) type Context<'a> = ParsingContext<'a>;
