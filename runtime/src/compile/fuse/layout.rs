//! Transpositions between channels first and channels last, which cost as much as they move.

use super::super::graph::Graph;
use super::convolution::is_transposition;
use super::everywhere;

/// A transposition of a transposition is what it began with, across parts as well.
pub(super) fn cancel_transposes(graph: &mut Graph) {
    for index in 0..graph.nodes.len() {
        let node = &graph.nodes[index].node;
        let (true, Some(value)) = (is_transposition(node, true), node.input.first()) else { continue };
        let Some(before) = graph.producer(value) else { continue };
        if is_transposition(&graph.nodes[before].node, false) {
            let (from, to) = (node.output[0].clone(), graph.nodes[before].node.input[0].clone());
            graph.rename_uses(&from, &to);
        }
    }
    graph.drop_unused();
}

/// A product with flattened pixels: the rows of the weight are put into the order that pixels have in memory, in place of the pixels.
pub(super) fn flatten_channels_last(graph: &mut Graph) {
    everywhere(graph, |graph, index| {
        if graph.operator(index) != "MatMul" {
            return None;
        }
        let [flat, weight] = graph.inputs(index) else { return None };
        let reshape = graph.absorbable(index, flat, "Reshape")?;
        // Of whichever part: a view moves nothing, wherever it is taken.
        let turned = graph.inputs(reshape).first()?;
        let transpose = graph.producer(turned).filter(|_| graph.uses(turned) == 1)?;
        if !graph.is_row(flat)
            || !is_transposition(&graph.nodes[transpose].node, false)
            || graph.nodes[transpose].late != graph.nodes[reshape].late
        {
            return None;
        }
        let pixels = graph.inputs(transpose).first()?.clone();
        let [1, height, width, channels] = *graph.shape(&pixels)? else { return None };
        let [rows, columns] = *graph.constant_shape(weight)? else { return None };
        let values = graph.floats(weight).filter(|_| rows == height * width * channels)?;
        let row = |row: usize| {
            let (pixel, channel) = (row / channels, row % channels);
            &values[(channel * height * width + pixel) * columns..][..columns]
        };
        let reordered: Vec<f32> = (0..rows).flat_map(|index| row(index).to_vec()).collect();
        let name = weight.clone();
        let weight = graph.add_floats(&name, &[rows, columns], &reordered);
        graph.nodes[index].node.input[1] = weight;
        graph.nodes[reshape].node.input[0] = pixels;
        graph.nodes.remove(transpose);
        Some(())
    });
}
