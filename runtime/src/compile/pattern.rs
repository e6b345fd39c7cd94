//! Finding groups of nodes.

use super::graph::{Graph, TickNode};

impl Graph {
    /// The node that makes `value`, if `reader` is the only one that reads it, both are of the same part and equally late, and it is
    /// of this operator: it can be taken into `reader`.
    pub(super) fn absorbable(&self, reader: usize, value: &str, operator: &str) -> Option<usize> {
        let index = self.producer(value).filter(|_| self.uses(value) == 1)?;
        (self.same_segment(reader, index) && self.nodes[index].node.op_type == operator).then_some(index)
    }

    pub(super) fn same_segment(&self, a: usize, b: usize) -> bool {
        let place = |node: &TickNode| (node.part, node.late);
        place(&self.nodes[a]) == place(&self.nodes[b])
    }

    /// Inputs of a node.
    pub(super) fn inputs(&self, index: usize) -> &[String] {
        &self.nodes[index].node.input
    }

    pub(super) fn operator(&self, index: usize) -> &str {
        &self.nodes[index].node.op_type
    }

    /// Of a node with two inputs, the constant one that holds one float, and the other input.
    pub(super) fn scalar_and_other(&self, index: usize) -> Option<(f32, &str)> {
        let [a, b] = self.inputs(index) else { return None };
        match (self.scalar(a), self.scalar(b)) {
            (Some(scalar), None) => Some((scalar, b)),
            (None, Some(scalar)) => Some((scalar, a)),
            _ => None,
        }
    }

    /// Whether an axis attribute means the last of `value`'s dimensions; `default` is the operator's.
    pub(super) fn is_last_axis(&self, index: usize, default: i64, value: &str) -> bool {
        let axis = super::graph::int(&self.nodes[index].node, "axis").unwrap_or(default);
        let rank = self.shape(value).map_or(0, <[usize]>::len) as i64;
        axis == -1 || (rank > 0 && axis == rank - 1)
    }

    /// Whether a value is one row of numbers: `[1, width]`.
    pub(super) fn is_row(&self, value: &str) -> bool {
        matches!(self.shape(value), Some([1, _]))
    }
}
