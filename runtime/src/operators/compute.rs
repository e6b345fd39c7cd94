//! What an operator computes, apart from how tract calls it.

use tract_onnx::tract_hir::internal::*;

/// The arithmetic of an operator.
pub(super) trait Compute: std::fmt::Debug + Send + Sync + 'static {
    /// What it computes.
    type Number: Datum + Copy + Default;
    /// Memory that it needs beside its result.
    type Scratch: std::fmt::Debug + Clone + Send + Sync + 'static;

    /// As it stands in the graph.
    const NAME: &'static str;

    /// Shape of the result.
    fn shape(&self) -> &[usize];

    /// Memory for one stream.
    fn scratch(&self) -> Self::Scratch;

    /// Numbers of the result that are handed over at a time; none where it is too small to be shared with another thread.
    fn piece_len(&self) -> Option<usize> {
        None
    }

    /// What comes before the result, once.
    fn prepare(&self, _inputs: &[TValue], _scratch: &mut Self::Scratch) -> TractResult<()> {
        Ok(())
    }

    /// Fills `out`, which begins at number `first` of the result and is some of its pieces, or all. Its old contents are those of an
    /// earlier run.
    fn fill(
        &self,
        inputs: &[TValue],
        scratch: &Self::Scratch,
        first: usize,
        out: &mut [Self::Number],
    ) -> TractResult<()>;

    /// What comes after the whole result, once.
    fn finish(&self, _out: &mut [Self::Number]) {}
}
