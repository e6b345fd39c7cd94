//! What our operators have in common: one result of a fixed shape, memory of their own, one stream.

use std::sync::Arc;

use tract_onnx::tract_hir::internal::*;

use super::SharedTeam;
use super::compute::Compute;
use super::memory::Results;
use super::shared::WorkerSlot;

/// An operator in tract, and with whom it shares its work.
#[derive(Debug)]
pub(super) struct CustomOp<C>(Arc<C>, Option<SharedTeam>);

impl<C: Compute> CustomOp<C> {
    pub(super) fn boxed(compute: C) -> Box<dyn TypedOp> {
        Box::new(Self(Arc::new(compute), None))
    }

    /// Shares with this team what is worth it, if the node is an operator of this kind.
    pub(super) fn bind_threads(node: &mut TypedNode, team: Option<&SharedTeam>) {
        if let Some(own) = node.op_as_mut::<Self>() {
            own.1 = team.filter(|_| own.0.piece_len().is_some()).cloned();
        }
    }
}

impl<C> Clone for CustomOp<C> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0), self.1.clone())
    }
}

impl<C> PartialEq for CustomOp<C> {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }
}

impl<C> Eq for CustomOp<C> {}

impl<C: Compute> Op for CustomOp<C> {
    fn name(&self) -> StaticName {
        C::NAME.into()
    }

    op_as_typed_op!();
}

impl<C: Compute> EvalOp for CustomOp<C> {
    not_out_of_plan!();

    fn state(&self, _: &EvalContext<'_>) -> TractResult<Option<Box<dyn OpState>>> {
        let results = Results::new(C::Number::datum_type(), self.0.shape());
        Ok(Some(Box::new(OwnState::new(self, results))))
    }
}

impl<C: Compute> TypedOp for CustomOp<C> {
    fn output_facts(&self, _: &[&TypedFact]) -> TractResult<TVec<TypedFact>> {
        Ok(tvec!(C::Number::fact(self.0.shape())))
    }

    as_op!();
}

/// The operator with its memory.
#[derive(Debug)]
struct OwnState<C: Compute> {
    op: CustomOp<C>,
    /// More than one only where another thread may still read the last.
    scratch: Vec<Arc<C::Scratch>>,
    slot: Option<Arc<WorkerSlot<C>>>,
    results: Results,
}

impl<C: Compute> OwnState<C> {
    fn new(op: &CustomOp<C>, results: Results) -> Self {
        let scratch = (0..1 + usize::from(op.1.is_some())).map(|_| Arc::new(op.0.scratch())).collect();
        let slot = op.1.is_some().then(|| WorkerSlot::new(&op.0));
        Self { op: op.clone(), scratch, slot, results }
    }
}

impl<C: Compute> Clone for OwnState<C> {
    fn clone(&self) -> Self {
        Self::new(&self.op, self.results.clone())
    }
}

impl<C: Compute> OpState for OwnState<C> {
    fn eval(&mut self, _: &EvalContext<'_>, _: &dyn Op, inputs: TVec<TValue>) -> TractResult<TVec<TValue>> {
        let Self { op: CustomOp(compute, team), scratch, slot, results } = self;
        let free = scratch.iter_mut().position(|scratch| Arc::get_mut(scratch).is_some());
        let index = free.unwrap_or_else(|| {
            scratch.push(Arc::new(compute.scratch()));
            scratch.len() - 1
        });
        if let Some(scratch) = Arc::get_mut(&mut scratch[index]) {
            compute.prepare(&inputs, scratch)?;
        }
        let scratch = &scratch[index];
        results.write(|out| {
            match (team, slot) {
                (Some(team), Some(slot)) => slot.fill(team, &inputs, scratch, out)?,
                _ => compute.fill(&inputs, scratch, 0, out)?,
            }
            compute.finish(out);
            Ok(())
        })
    }

    fn reset_lanes(&mut self, _: &[LaneId]) -> TractResult<()> {
        Ok(())
    }
}
