//! What our operators have in common: one result of a fixed shape, memory of their own, one stream.

use std::sync::Arc;

use tract_onnx::tract_hir::internal::*;

use super::SharedTeam;
use super::memory::Results;

/// The arithmetic of an operator.
pub(super) trait Compute: std::fmt::Debug + Send + Sync + 'static {
    /// What it computes.
    type Number: Datum;
    /// Memory that it needs beside its result.
    type Scratch: std::fmt::Debug + Clone + Send + 'static;

    /// As it stands in the graph.
    const NAME: &'static str;

    /// Shape of the result.
    fn shape(&self) -> &[usize];

    /// Memory for one stream.
    fn scratch(&self) -> Self::Scratch;

    /// Whether it is large enough to share with another thread.
    fn is_worth_sharing(&self) -> bool {
        false
    }

    /// Fills `out`, whose old contents are those of an earlier run.
    fn run(
        &self,
        inputs: &[TValue],
        scratch: &mut Self::Scratch,
        team: Option<&SharedTeam>,
        out: &mut [Self::Number],
    ) -> TractResult<()>;
}

/// An operator in tract, and with whom it shares its work.
#[derive(Debug)]
pub(super) struct Own<C>(Arc<C>, Option<SharedTeam>);

impl<C: Compute> Own<C> {
    pub(super) fn boxed(compute: C) -> Box<dyn TypedOp> {
        Box::new(Self(Arc::new(compute), None))
    }

    /// Shares with this team what is worth it, if the node is an operator of this kind.
    pub(super) fn settle(node: &mut TypedNode, team: Option<&SharedTeam>) {
        if let Some(own) = node.op_as_mut::<Self>() {
            own.1 = team.filter(|_| own.0.is_worth_sharing()).cloned();
        }
    }
}

impl<C> Clone for Own<C> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0), self.1.clone())
    }
}

impl<C> PartialEq for Own<C> {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }
}

impl<C> Eq for Own<C> {}

impl<C: Compute> Op for Own<C> {
    fn name(&self) -> StaticName {
        C::NAME.into()
    }

    op_as_typed_op!();
}

impl<C: Compute> EvalOp for Own<C> {
    not_out_of_plan!();

    fn state(&self, _: &EvalContext<'_>) -> TractResult<Option<Box<dyn OpState>>> {
        let results = Results::new(C::Number::datum_type(), self.0.shape());
        Ok(Some(Box::new(OwnState { op: self.clone(), scratch: self.0.scratch(), results })))
    }
}

impl<C: Compute> TypedOp for Own<C> {
    fn output_facts(&self, _: &[&TypedFact]) -> TractResult<TVec<TypedFact>> {
        Ok(tvec!(C::Number::fact(self.0.shape())))
    }

    as_op!();
}

/// The operator with its memory.
#[derive(Debug)]
struct OwnState<C: Compute> {
    op: Own<C>,
    scratch: C::Scratch,
    results: Results,
}

impl<C: Compute> Clone for OwnState<C> {
    fn clone(&self) -> Self {
        Self { op: self.op.clone(), scratch: self.scratch.clone(), results: self.results.clone() }
    }
}

impl<C: Compute> OpState for OwnState<C> {
    fn eval(&mut self, _: &EvalContext<'_>, _: &dyn Op, inputs: TVec<TValue>) -> TractResult<TVec<TValue>> {
        let Self { op: Own(compute, team), scratch, results } = self;
        results.write(|out| compute.run(&inputs, scratch, team.as_ref(), out))
    }

    fn reset_lanes(&mut self, _: &[LaneId]) -> TractResult<()> {
        Ok(())
    }
}
