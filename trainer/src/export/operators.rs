//! The operators our graphs use, one method each, which work out the shape they make.

use rcwm_models::bundle::DType;

use super::graph::{Graph, Value, float, int, ints};

impl Graph {
    /// An operator that keeps type and shape.
    pub fn unary(&mut self, operator: &str, x: &Value) -> Value {
        self.node(operator, &[x], vec![], x.dtype(), x.shape())
    }

    /// An elementwise operator of two values, with broadcasting.
    pub fn binary(&mut self, operator: &str, a: &Value, b: &Value) -> Value {
        let shape = broadcast(a.shape(), b.shape());
        self.node(operator, &[a, b], vec![], a.dtype(), &shape)
    }

    pub fn add(&mut self, a: &Value, b: &Value) -> Value {
        self.binary("Add", a, b)
    }

    pub fn mul(&mut self, a: &Value, b: &Value) -> Value {
        self.binary("Mul", a, b)
    }

    /// `x * factor + shift`.
    pub fn affine(&mut self, x: &Value, factor: f32, shift: f32) -> Value {
        let (factor, shift) = (self.scalar(factor), self.scalar(shift));
        let scaled = self.mul(x, &factor);
        self.add(&scaled, &shift)
    }

    /// `x + shift`.
    pub fn shift(&mut self, x: &Value, shift: f32) -> Value {
        let shift = self.scalar(shift);
        self.add(x, &shift)
    }

    /// `x * sigmoid(x)`.
    pub fn silu(&mut self, x: &Value) -> Value {
        let gate = self.unary("Sigmoid", x);
        self.mul(x, &gate)
    }

    /// Matrix product over the last two dimensions; `b` may be a plain matrix.
    pub fn matmul(&mut self, a: &Value, b: &Value) -> Value {
        let (columns, mut shape) = (last(b.shape()), a.shape().to_vec());
        if let Some(width) = shape.last_mut() {
            *width = columns;
        }
        self.node("MatMul", &[a, b], vec![], DType::F32, &shape)
    }

    /// Softmax over the last dimension.
    pub fn softmax(&mut self, x: &Value) -> Value {
        self.node("Softmax", &[x], vec![int("axis", -1)], DType::F32, x.shape())
    }

    /// LayerNorm over the last dimension.
    pub fn layer_norm(&mut self, x: &Value, weight: &Value, bias: &Value, eps: f64) -> Value {
        let attributes = vec![int("axis", -1), float("epsilon", eps as f32)];
        self.node("LayerNormalization", &[x, weight, bias], attributes, DType::F32, x.shape())
    }

    /// Index of the largest entry of the last dimension (the first of equals).
    pub fn arg_max(&mut self, x: &Value) -> Value {
        let shape = &x.shape()[..x.shape().len() - 1];
        self.node("ArgMax", &[x], vec![int("axis", -1), int("keepdims", 0)], DType::I64, shape)
    }

    /// Rows of a matrix: `table` [rows, width], `index` [...] gives [..., width].
    pub fn gather(&mut self, table: &Value, index: &Value) -> Value {
        let shape = [index.shape(), &table.shape()[1..]].concat();
        self.node("Gather", &[table, index], vec![int("axis", 0)], DType::F32, &shape)
    }

    /// Sum over dimension 1, which disappears.
    pub fn sum_over_1(&mut self, x: &Value) -> Value {
        let axes = self.integers("axis_1", &[1], &[1]);
        let mut shape = x.shape().to_vec();
        shape.remove(1);
        self.node("ReduceSum", &[x, &axes], vec![int("keepdims", 0)], DType::F32, &shape)
    }

    pub fn concat(&mut self, values: &[&Value], axis: usize) -> Value {
        let mut shape = values[0].shape().to_vec();
        shape[axis] = values.iter().map(|value| value.shape()[axis]).sum();
        self.node("Concat", values, vec![int("axis", axis as i64)], values[0].dtype(), &shape)
    }

    /// Cuts `axis` into pieces of these sizes.
    pub fn split(&mut self, x: &Value, axis: usize, sizes: &[usize]) -> Vec<Value> {
        let text: Vec<String> = sizes.iter().map(usize::to_string).collect();
        let values: Vec<i64> = sizes.iter().map(|size| *size as i64).collect();
        let pieces = self.integers(&format!("split_{}", text.join("_")), &[sizes.len()], &values);
        let shapes: Vec<_> = sizes.iter().map(|size| with_axis(x.shape(), axis, *size)).collect();
        self.nodes("Split", &[x, &pieces], vec![int("axis", axis as i64)], x.dtype(), &shapes)
    }

    pub fn reshape(&mut self, x: &Value, shape: &[usize]) -> Value {
        let text: Vec<String> = shape.iter().map(usize::to_string).collect();
        let values: Vec<i64> = shape.iter().map(|dim| *dim as i64).collect();
        let target = self.integers(&format!("shape_{}", text.join("_")), &[shape.len()], &values);
        self.node("Reshape", &[x, &target], vec![], x.dtype(), shape)
    }

    pub fn transpose(&mut self, x: &Value, order: &[usize]) -> Value {
        let shape: Vec<usize> = order.iter().map(|axis| x.shape()[*axis]).collect();
        let perm: Vec<i64> = order.iter().map(|axis| *axis as i64).collect();
        self.node("Transpose", &[x], vec![ints("perm", &perm)], x.dtype(), &shape)
    }

    /// Convolution of kernel 4, stride 2, padding 1 on [1, C, H, W]; `weight` [out, C, 4, 4].
    pub fn conv_down(&mut self, x: &Value, weight: &Value) -> Value {
        let [_, _, height, width] = dims4(x);
        let shape = [1, weight.shape()[0], height / 2, width / 2];
        self.node("Conv", &[x, weight], conv_attributes(), DType::F32, &shape)
    }

    /// Its transpose; `weight` [C, out, 4, 4].
    pub fn conv_up(&mut self, x: &Value, weight: &Value, bias: Option<&Value>) -> Value {
        let [_, _, height, width] = dims4(x);
        let shape = [1, weight.shape()[1], 2 * height, 2 * width];
        let inputs: Vec<&Value> = [x, weight].into_iter().chain(bias).collect();
        self.node("ConvTranspose", &inputs, conv_attributes(), DType::F32, &shape)
    }

    /// u8 to f32.
    pub fn cast_to_float(&mut self, x: &Value) -> Value {
        let to = int("to", DType::F32.to_onnx().into());
        self.node("Cast", &[x], vec![to], DType::F32, x.shape())
    }
}

fn conv_attributes() -> Vec<rcwm_models::onnx::Attribute> {
    vec![ints("kernel_shape", &[4, 4]), ints("strides", &[2, 2]), ints("pads", &[1, 1, 1, 1])]
}

fn dims4(x: &Value) -> [usize; 4] {
    let shape = x.shape();
    [shape[0], shape[1], shape[2], shape[3]]
}

fn last(shape: &[usize]) -> usize {
    shape.last().copied().unwrap_or(1)
}

fn with_axis(shape: &[usize], axis: usize, size: usize) -> Vec<usize> {
    let mut shape = shape.to_vec();
    shape[axis] = size;
    shape
}

/// The shape of an elementwise operation.
fn broadcast(a: &[usize], b: &[usize]) -> Vec<usize> {
    let rank = a.len().max(b.len());
    let dim =
        |shape: &[usize], axis: usize| (axis + shape.len()).checked_sub(rank).map_or(1, |axis| shape[axis]);
    (0..rank).map(|axis| dim(a, axis).max(dim(b, axis))).collect()
}
