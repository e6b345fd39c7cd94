//! The decoders as a graph.

use ndarray::{Array2, ArrayD, IxDyn};
use rcwm_models::bundle::PartName;
use rcwm_models::settings::ModelKind;

use super::blocks::Part;
use super::graph::Value;

impl Part<'_> {
    /// State -> the whole picture (eq. 8), each branch's image times its mask, and the masks; of the vanilla model its picture and the
    /// robot's mask.
    pub fn decoder(&mut self) {
        let (inputs, _) = PartName::Decoder.signature(self.settings);
        let state = self.state_inputs(&inputs);
        if self.settings.kind == ModelKind::Vanilla {
            let (image, mask) = self.picture("decoder", &state.z[0], &state.h[0]);
            let (image, mask) = (self.channels(image, 3), self.channels(mask, 1));
            self.graph.output("image", &image);
            self.graph.output("mask", &mask);
            return;
        }
        let mut masked = Vec::with_capacity(2);
        let mut masks = Vec::with_capacity(2);
        for (index, branch) in ["robot", "environment"].into_iter().enumerate() {
            let (image, mask) = self.picture(&format!("decoder.{branch}"), &state.z[index], &state.h[index]);
            let product = self.graph.mul(&image, &mask);
            masked.push(self.channels(product, 3));
            masks.push(self.channels(mask, 1));
        }
        let whole = self.graph.add(&masked[0], &masked[1]);
        self.graph.output("image", &whole);
        for (index, branch) in ["robot", "environment"].into_iter().enumerate() {
            self.graph.output(&format!("{branch}_image"), &masked[index]);
            self.graph.output(&format!("{branch}_mask"), &masks[index]);
        }
    }

    /// Of several cameras [1, S, S * C, each] those of a pixel on its channels: [1, S, S, each * C].
    fn channels(&mut self, x: Value, each: usize) -> Value {
        let (side, cameras) = (self.settings.image_side, self.settings.cameras);
        if cameras == 1 { x } else { self.graph.reshape(&x, &[1, side, side, each * cameras]) }
    }

    /// One branch's image [1, S, S * C, 3] and mask [1, S, S * C, 1]; a pixel's cameras are side by side.
    fn picture(&mut self, name: &str, z: &Value, h: &Value) -> (Value, Value) {
        let (nm, d) = (self.settings.stoch_width(), self.settings.deter);
        let channels = 8 * self.settings.cnn_depth;
        let weight = channels_first(&self.weights.matrix(&format!("{name}.linear.weight")), channels);
        let bias = self.weights.get(&format!("{name}.linear.bias")).clone();
        let bias = bias
            .into_shape_with_order((1, 16 * channels))
            .expect("a bias for each of the 4x4 pixels' channels");
        let bias = channels_first(&bias, channels);

        let z_rows = weight.slice(ndarray::s![..nm, ..]).to_owned();
        let z_share = self.one_hot_product(&format!("{name}.linear.weight.z"), z, z_rows);
        let h_rows = weight.slice(ndarray::s![nm..nm + d, ..]).to_owned();
        let h_rows = self.matrix(&format!("{name}.linear.weight.h"), h_rows);
        let h_share = self.graph.matmul(h, &h_rows);
        let bias = self.matrix(&format!("{name}.linear.bias"), bias);
        let sum = self.graph.add(&z_share, &h_share);
        let sum = self.graph.add(&sum, &bias);

        let mut x = self.graph.reshape(&sum, &[1, channels, 4, 4]);
        let last = self.settings.stages() - 1;
        for index in 0..last {
            let weight = self.parameter(&format!("{name}.{index}.conv.weight"));
            x = self.graph.conv_up(&x, &weight, None);
            x = self.channel_norm_silu(&format!("{name}.{index}.norm"), &x);
        }
        let weight = self.parameter(&format!("{name}.{last}.conv.weight"));
        let bias = self.parameter(&format!("{name}.{last}.conv.bias"));
        let x = self.graph.conv_up(&x, &weight, Some(&bias)); // [1, 4 C, S, S]
        let mut x = self.graph.transpose(&x, &[0, 2, 3, 1]);
        let (side, cameras) = (self.settings.image_side, self.settings.cameras);
        if cameras > 1 {
            x = self.graph.reshape(&x, &[1, side, side * cameras, 4]);
        }
        let pieces = self.graph.split(&x, 3, &[3, 1]);
        let mask = self.graph.unary("Sigmoid", &pieces[1]);
        (pieces[0].clone(), mask)
    }
}

/// Reorders columns from (row, column, channel), as the layer was learned, to (channel, row, column), as convolutions want them.
fn channels_first(matrix: &Array2<f32>, channels: usize) -> Array2<f32> {
    let rows = matrix.nrows();
    let pixels: ArrayD<f32> = matrix.clone().into_dyn();
    let pixels = pixels
        .into_shape_with_order(IxDyn(&[rows, 16, channels]))
        .expect("the layer makes 4x4 pixels of these channels");
    let swapped = pixels.permuted_axes(IxDyn(&[0, 2, 1])).as_standard_layout().into_owned();
    swapped.into_shape_with_order((rows, 16 * channels)).expect("a standard layout can be reshaped")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_move_from_channels_last_to_channels_first() {
        let columns: Vec<f32> = (0..32).map(|x| x as f32).collect();
        let matrix = Array2::from_shape_vec((1, 32), columns).unwrap();
        let moved = channels_first(&matrix, 2);
        assert_eq!(moved[[0, 0]], 0.0);
        assert_eq!(moved[[0, 1]], 2.0);
        assert_eq!(moved[[0, 16]], 1.0);
    }
}
