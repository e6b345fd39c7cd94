//! ONNX files as protobuf messages: the fields that our exported parts use, with the numbers of the published `onnx.proto`.
//!
//! Unknown fields are skipped on reading. Only what both the trainer (writes) and the runtime (reads, inspects) need is here.

mod amounts;

use prost::Message;

pub use amounts::Amounts;

/// `TensorProto.DataType` of the types we use.
pub mod data_type {
    /// 32-bit float.
    pub const FLOAT: i32 = 1;
    /// 8-bit unsigned.
    pub const UINT8: i32 = 2;
    /// 64-bit signed.
    pub const INT64: i32 = 7;
    /// Boolean.
    pub const BOOL: i32 = 9;
}

/// `AttributeProto.AttributeType` of the kinds we use.
pub mod attribute_type {
    /// A float in `f`.
    pub const FLOAT: i32 = 1;
    /// An integer in `i`.
    pub const INT: i32 = 2;
    /// Bytes in `s`.
    pub const STRING: i32 = 3;
    /// A tensor in `t`.
    pub const TENSOR: i32 = 4;
    /// Integers in `ints`.
    pub const INTS: i32 = 7;
}

/// A whole file.
#[derive(Clone, PartialEq, Message)]
pub struct Model {
    /// Version of the file format.
    #[prost(int64, tag = "1")]
    pub ir_version: i64,
    /// Program that wrote it.
    #[prost(string, tag = "2")]
    pub producer_name: String,
    #[prost(string, tag = "3")]
    pub producer_version: String,
    /// What the model is.
    #[prost(string, tag = "6")]
    pub doc_string: String,
    #[prost(message, optional, tag = "7")]
    pub graph: Option<Graph>,
    /// Operator sets used.
    #[prost(message, repeated, tag = "8")]
    pub opset_import: Vec<OperatorSet>,
    /// Functions local to the model; we accept none.
    #[prost(message, repeated, tag = "25")]
    pub functions: Vec<Opaque>,
}

/// A message whose contents do not matter, only whether it is there.
#[derive(Clone, PartialEq, Message)]
pub struct Opaque {}

#[derive(Clone, PartialEq, Message)]
pub struct OperatorSet {
    /// Empty for the standard operators.
    #[prost(string, tag = "1")]
    pub domain: String,
    #[prost(int64, tag = "2")]
    pub version: i64,
}

/// Nodes, weights, inputs and outputs.
#[derive(Clone, PartialEq, Message)]
pub struct Graph {
    /// Operations in topological order.
    #[prost(message, repeated, tag = "1")]
    pub node: Vec<Node>,
    /// Name of the graph.
    #[prost(string, tag = "2")]
    pub name: String,
    /// Weights.
    #[prost(message, repeated, tag = "5")]
    pub initializer: Vec<Tensor>,
    /// What the graph does.
    #[prost(string, tag = "10")]
    pub doc_string: String,
    #[prost(message, repeated, tag = "11")]
    pub input: Vec<ValueInfo>,
    #[prost(message, repeated, tag = "12")]
    pub output: Vec<ValueInfo>,
    /// Types of values in between.
    #[prost(message, repeated, tag = "13")]
    pub value_info: Vec<ValueInfo>,
    /// Sparse weights; we accept none.
    #[prost(message, repeated, tag = "15")]
    pub sparse_initializer: Vec<Opaque>,
}

/// One operation.
#[derive(Clone, PartialEq, Message)]
pub struct Node {
    /// Names of its inputs.
    #[prost(string, repeated, tag = "1")]
    pub input: Vec<String>,
    /// Names of its outputs.
    #[prost(string, repeated, tag = "2")]
    pub output: Vec<String>,
    /// Its own name.
    #[prost(string, tag = "3")]
    pub name: String,
    /// The operator.
    #[prost(string, tag = "4")]
    pub op_type: String,
    /// Its attributes.
    #[prost(message, repeated, tag = "5")]
    pub attribute: Vec<Attribute>,
    /// Empty for the standard operators.
    #[prost(string, tag = "7")]
    pub domain: String,
}

/// An attribute of a node.
#[derive(Clone, PartialEq, Message)]
pub struct Attribute {
    #[prost(string, tag = "1")]
    pub name: String,
    /// A float.
    #[prost(float, tag = "2")]
    pub f: f32,
    /// An integer.
    #[prost(int64, tag = "3")]
    pub i: i64,
    /// Bytes.
    #[prost(bytes = "vec", tag = "4")]
    pub s: Vec<u8>,
    #[prost(message, optional, tag = "5")]
    pub t: Option<Tensor>,
    /// A graph (control flow); we accept none.
    #[prost(message, optional, tag = "6")]
    pub g: Option<Opaque>,
    /// Integers.
    #[prost(int64, repeated, packed = "false", tag = "8")]
    pub ints: Vec<i64>,
    /// Graphs (control flow); we accept none.
    #[prost(message, repeated, tag = "11")]
    pub graphs: Vec<Opaque>,
    /// See [`attribute_type`].
    #[prost(int32, tag = "20")]
    pub r#type: i32,
}

/// A constant array.
#[derive(Clone, PartialEq, Message)]
pub struct Tensor {
    /// Shape.
    #[prost(int64, repeated, packed = "false", tag = "1")]
    pub dims: Vec<i64>,
    /// See [`data_type`].
    #[prost(int32, tag = "2")]
    pub data_type: i32,
    #[prost(string, tag = "8")]
    pub name: String,
    /// Little-endian contents.
    #[prost(bytes = "vec", tag = "9")]
    pub raw_data: Vec<u8>,
    /// Where external contents lie; we accept none.
    #[prost(message, repeated, tag = "13")]
    pub external_data: Vec<Opaque>,
    /// 0: in this file.
    #[prost(int32, tag = "14")]
    pub data_location: i32,
}

impl Tensor {
    /// An f32 constant.
    #[must_use]
    pub fn f32(name: &str, dims: &[usize], values: &[f32]) -> Self {
        Self::raw(name, dims, data_type::FLOAT, values.iter().flat_map(|x| x.to_le_bytes()).collect())
    }

    /// An i64 constant.
    #[must_use]
    pub fn i64(name: &str, dims: &[usize], values: &[i64]) -> Self {
        Self::raw(name, dims, data_type::INT64, values.iter().flat_map(|x| x.to_le_bytes()).collect())
    }

    fn raw(name: &str, dims: &[usize], data_type: i32, raw_data: Vec<u8>) -> Self {
        let dims = dims.iter().map(|dim| *dim as i64).collect();
        Self { dims, data_type, name: name.to_owned(), raw_data, ..Self::default() }
    }
}

/// Name and type of a value.
#[derive(Clone, PartialEq, Message)]
pub struct ValueInfo {
    #[prost(string, tag = "1")]
    pub name: String,
    #[prost(message, optional, tag = "2")]
    pub r#type: Option<Type>,
}

impl ValueInfo {
    /// A tensor of fixed shape.
    #[must_use]
    pub fn tensor(name: &str, elem_type: i32, shape: &[usize]) -> Self {
        let dim = shape.iter().map(|dim| Dim { dim_value: Some(*dim as i64), dim_param: None }).collect();
        let tensor_type = TensorType { elem_type, shape: Some(Shape { dim }) };
        Self { name: name.to_owned(), r#type: Some(Type { tensor_type: Some(tensor_type) }) }
    }

    /// Element type and shape, if it is a tensor whose every dimension is fixed.
    #[must_use]
    pub fn fixed(&self) -> Option<(i32, Vec<usize>)> {
        let tensor = self.r#type.as_ref()?.tensor_type.as_ref()?;
        let dims = &tensor.shape.as_ref()?.dim;
        let shape = dims.iter().map(|dim| usize::try_from(dim.dim_value?).ok()).collect::<Option<_>>()?;
        Some((tensor.elem_type, shape))
    }
}

/// Type of a value.
#[derive(Clone, PartialEq, Message)]
pub struct Type {
    /// A dense tensor.
    #[prost(message, optional, tag = "1")]
    pub tensor_type: Option<TensorType>,
}

#[derive(Clone, PartialEq, Message)]
pub struct TensorType {
    /// See [`data_type`].
    #[prost(int32, tag = "1")]
    pub elem_type: i32,
    /// Shape, if known.
    #[prost(message, optional, tag = "2")]
    pub shape: Option<Shape>,
}

#[derive(Clone, PartialEq, Message)]
pub struct Shape {
    /// Dimensions.
    #[prost(message, repeated, tag = "1")]
    pub dim: Vec<Dim>,
}

/// A dimension.
#[derive(Clone, PartialEq, Message)]
pub struct Dim {
    /// A fixed size.
    #[prost(int64, optional, tag = "1")]
    pub dim_value: Option<i64>,
    /// A symbolic size.
    #[prost(string, optional, tag = "2")]
    pub dim_param: Option<String>,
}

/// Why an ONNX file was refused.
#[derive(Debug, thiserror::Error)]
pub enum OnnxError {
    /// Not a protobuf message of this form.
    #[error("not a readable ONNX file: {0}")]
    Decode(#[from] prost::DecodeError),
    /// Its bytes do not make up messages.
    #[error("not a readable ONNX file: {reason}")]
    Broken {
        /// Where it breaks off.
        reason: &'static str,
    },
    /// It holds more of something than any part does.
    #[error("the ONNX file holds {what}, more than {max} are not accepted; export with the matching trainer")]
    TooMany {
        /// What there is too much of, and where.
        what: &'static str,
        /// The limit.
        max: usize,
    },
    /// The file has no graph.
    #[error("the ONNX file holds no graph")]
    NoGraph,
    /// The file uses something that a self-contained part must not.
    #[error(
        "{what} is not accepted in a bundle; export with standard operators and one self-contained file a part"
    )]
    NotAccepted {
        /// What was found.
        what: String,
    },
}

/// Reads an ONNX file and checks that it is self-contained: standard operators only, no external data, no control flow, no
/// sparse weights, no local functions. What it holds is counted first ([`Amounts`]): decoding a file takes little more memory than
/// the file itself.
pub fn parse_self_contained(bytes: &[u8]) -> Result<Model, OnnxError> {
    Amounts::check(bytes)?;
    let model = Model::decode(bytes)?;
    let graph = model.graph.as_ref().ok_or(OnnxError::NoGraph)?;
    let refuse = |what: String| Err(OnnxError::NotAccepted { what });
    if !model.functions.is_empty() {
        return refuse("a local function".into());
    }
    if !graph.sparse_initializer.is_empty() {
        return refuse("a sparse initializer".into());
    }
    if let Some(set) = model.opset_import.iter().find(|set| !set.domain.is_empty() && set.domain != "ai.onnx")
    {
        return refuse(format!("operator set {:?}", set.domain));
    }
    let in_nodes = graph.node.iter().flat_map(|node| &node.attribute);
    for node in &graph.node {
        if !node.domain.is_empty() && node.domain != "ai.onnx" {
            return refuse(format!("operator {:?} of domain {:?}", node.op_type, node.domain));
        }
    }
    if let Some(attribute) = in_nodes.clone().find(|a| a.g.is_some() || !a.graphs.is_empty()) {
        return refuse(format!("control flow (attribute {:?})", attribute.name));
    }
    let constants = in_nodes.filter_map(|attribute| attribute.t.as_ref());
    for tensor in graph.initializer.iter().chain(constants) {
        if tensor.data_location != 0 || !tensor.external_data.is_empty() {
            return refuse(format!("external data (tensor {:?})", tensor.name));
        }
    }
    Ok(model)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model(node: Node, tensor: Tensor) -> Vec<u8> {
        let graph = Graph { node: vec![node], initializer: vec![tensor], ..Graph::default() };
        Model { graph: Some(graph), ..Model::default() }.encode_to_vec()
    }

    #[test]
    fn a_plain_model_survives_and_external_data_is_refused() {
        let node = Node { op_type: "Relu".into(), ..Node::default() };
        let plain = Tensor::f32("w", &[2], &[1.0, 2.0]);
        let read = parse_self_contained(&model(node.clone(), plain.clone())).unwrap();
        assert_eq!(read.graph.unwrap().initializer[0], plain);
        let outside = Tensor { data_location: 1, ..plain.clone() };
        assert!(matches!(
            parse_self_contained(&model(node.clone(), outside)),
            Err(OnnxError::NotAccepted { .. })
        ));
        let listed = Tensor { external_data: vec![Opaque {}], ..plain };
        assert!(matches!(parse_self_contained(&model(node, listed)), Err(OnnxError::NotAccepted { .. })));
    }

    #[test]
    fn control_flow_and_foreign_operators_are_refused() {
        let body = Attribute { name: "body".into(), g: Some(Opaque {}), ..Attribute::default() };
        let looping = Node { op_type: "Loop".into(), attribute: vec![body], ..Node::default() };
        assert!(parse_self_contained(&model(looping, Tensor::default())).is_err());
        let foreign = Node { op_type: "Relu".into(), domain: "com.example".into(), ..Node::default() };
        assert!(parse_self_contained(&model(foreign, Tensor::default())).is_err());
        assert!(matches!(parse_self_contained(&[]), Err(OnnxError::NoGraph)));
    }
}
