//! How much an ONNX file holds, counted before anything of it is decoded.
//!
//! Two bytes of a file make an empty node, which takes two hundred in memory; a byte of a packed list makes a number of eight. So the
//! limits come first: one pass over the bytes that follows the messages of [`super`], allocates nothing, and takes time in
//! proportion to the file. What it lets through decodes into about as much memory as the file has bytes.

use super::OnnxError;

/// What a file may hold at most. The paper's largest part has 65 nodes and 60 constants.
pub struct Amounts;

impl Amounts {
    /// Nodes of the graph.
    pub const NODES: usize = 1024;
    /// Constants of the graph.
    pub const CONSTANTS: usize = 1024;
    /// Inputs of a node, and as many outputs.
    pub const NODE_INPUTS: usize = 16;
    pub const NODE_ATTRIBUTES: usize = 16;
    pub const NAME_BYTES: usize = 256;

    /// Counts what a file holds.
    ///
    /// # Errors
    /// [`OnnxError::TooMany`], or [`OnnxError::Broken`] where the bytes are no messages.
    pub fn check(bytes: &[u8]) -> Result<(), OnnxError> {
        Walk::default().message(Message::Model, bytes)
    }
}

/// The messages that are decoded.
#[derive(Clone, Copy, PartialEq)]
enum Message {
    Model,
    OperatorSet,
    Graph,
    Node,
    Attribute,
    Tensor,
    ValueInfo,
    Type,
    TensorType,
    Shape,
    Dim,
}

/// What is in a field.
enum Content {
    Message(Message),
    /// A string that is shown and compared.
    Name,
    /// Integers, one a field or packed.
    Numbers,
}

/// What is counted of a field.
struct Rule {
    content: Content,
    what: &'static str,
    /// In one message.
    each: usize,
    /// In the whole file.
    all: usize,
    /// Place among the counts of the whole file.
    place: usize,
}

const COUNTS: usize = 18;

/// The rule of a field; none for one that takes no memory of its own, or no more than its bytes.
fn rule(message: Message, number: u64) -> Option<Rule> {
    use Content::{Name, Numbers};
    use Message as M;
    let of = |place, what, each, all, content| Some(Rule { content, what, each, all, place });
    let name = || of(2, "names", usize::MAX, usize::MAX, Name);
    match (message, number) {
        (M::Model, 7) => of(0, "graphs", 1, 1, Content::Message(M::Graph)),
        (M::Model, 8) => of(1, "operator sets", 16, 16, Content::Message(M::OperatorSet)),
        (M::Node, 3 | 4 | 7) | (M::OperatorSet | M::Attribute | M::ValueInfo, 1) => name(),
        (M::Tensor, 8) | (M::Dim, 2) => name(),
        (M::Graph, 1) => of(3, "nodes", Amounts::NODES, Amounts::NODES, Content::Message(M::Node)),
        (M::Graph, 5) => {
            of(4, "constants", Amounts::CONSTANTS, Amounts::CONSTANTS, Content::Message(M::Tensor))
        }
        (M::Graph, 11) => of(5, "inputs of the graph", 64, 64, Content::Message(M::ValueInfo)),
        (M::Graph, 12) => of(6, "outputs of the graph", 64, 64, Content::Message(M::ValueInfo)),
        (M::Graph, 13) => of(7, "described values", 4096, 4096, Content::Message(M::ValueInfo)),
        (M::Node, 1) => of(8, "inputs of a node", Amounts::NODE_INPUTS, 16_384, Name),
        (M::Node, 2) => of(9, "outputs of a node", Amounts::NODE_INPUTS, 16_384, Name),
        (M::Node, 5) => {
            of(10, "attributes of a node", Amounts::NODE_ATTRIBUTES, 8192, Content::Message(M::Attribute))
        }
        (M::Attribute, 5) => of(11, "tensors in an attribute", 1, 8192, Content::Message(M::Tensor)),
        (M::Attribute, 8) => of(12, "integers of an attribute", 64, 65_536, Numbers),
        (M::Tensor, 1) => of(13, "dimensions of a constant", 64, 65_536, Numbers),
        (M::ValueInfo, 2) => of(14, "types of a value", 1, usize::MAX, Content::Message(M::Type)),
        (M::Type, 1) => of(15, "types of a tensor", 1, usize::MAX, Content::Message(M::TensorType)),
        (M::TensorType, 2) => of(16, "shapes of a tensor", 1, usize::MAX, Content::Message(M::Shape)),
        (M::Shape, 1) => of(17, "dimensions of a value", 64, 65_536, Content::Message(M::Dim)),
        _ => None,
    }
}

#[derive(Default)]
struct Walk {
    counts: [usize; COUNTS],
}

impl Walk {
    /// As deep as the messages are nested: they do not contain themselves.
    fn message(&mut self, message: Message, mut bytes: &[u8]) -> Result<(), OnnxError> {
        let mut here = [0_usize; COUNTS];
        while !bytes.is_empty() {
            let (number, payload) = field(&mut bytes)?;
            let Some(rule) = rule(message, number) else { continue };
            let (found, nested) = match (&rule.content, payload) {
                (Content::Message(nested), Payload::Bytes(payload)) => (1, Some((*nested, payload))),
                (Content::Name, Payload::Bytes(name)) => {
                    if name.len() > Amounts::NAME_BYTES {
                        return Err(OnnxError::TooMany { what: "bytes in a name", max: Amounts::NAME_BYTES });
                    }
                    (1, None)
                }
                (Content::Numbers, Payload::Number) => (1, None),
                // The last byte of every number has its highest bit clear.
                (Content::Numbers, Payload::Bytes(packed)) => {
                    (packed.iter().filter(|byte| **byte < 0x80).count(), None)
                }
                _ => return Err(OnnxError::Broken { reason: "a field is of another kind than its number" }),
            };
            for (counts, max) in [(&mut here, rule.each), (&mut self.counts, rule.all)] {
                let count = &mut counts[rule.place];
                *count = count.saturating_add(found);
                if *count > max {
                    return Err(OnnxError::TooMany { what: rule.what, max });
                }
            }
            if let Some((nested, payload)) = nested {
                self.message(nested, payload)?;
            }
        }
        Ok(())
    }
}

enum Payload<'a> {
    /// Of variable or fixed length.
    Number,
    Bytes(&'a [u8]),
}

/// Number and payload of the next field.
fn field<'a>(bytes: &mut &'a [u8]) -> Result<(u64, Payload<'a>), OnnxError> {
    let key = varint(bytes)?;
    let payload = match key & 7 {
        0 => {
            varint(bytes)?;
            Payload::Number
        }
        1 => skip(bytes, 8)?,
        2 => {
            let len = varint(bytes)?;
            Payload::Bytes(take(bytes, len)?)
        }
        5 => skip(bytes, 4)?,
        _ => return Err(OnnxError::Broken { reason: "a field of a kind that these files do not have" }),
    };
    Ok((key >> 3, payload))
}

fn skip<'a>(bytes: &mut &[u8], len: u64) -> Result<Payload<'a>, OnnxError> {
    take(bytes, len).map(|_| Payload::Number)
}

fn take<'a>(bytes: &mut &'a [u8], len: u64) -> Result<&'a [u8], OnnxError> {
    let split = usize::try_from(len).ok().and_then(|len| bytes.split_at_checked(len));
    let (taken, rest) = split.ok_or(OnnxError::Broken { reason: "it ends within a field" })?;
    *bytes = rest;
    Ok(taken)
}

fn varint(bytes: &mut &[u8]) -> Result<u64, OnnxError> {
    let mut value = 0_u64;
    for shift in (0..70).step_by(7) {
        let (byte, rest) =
            bytes.split_first().ok_or(OnnxError::Broken { reason: "it ends within a field" })?;
        *bytes = rest;
        // Bits beyond the 64th are dropped, as every reader of the format does.
        value |= u64::from(byte & 0x7f).checked_shl(shift).unwrap_or(0);
        if *byte < 0x80 {
            return Ok(value);
        }
    }
    Err(OnnxError::Broken { reason: "a number of more than ten bytes" })
}

#[cfg(test)]
mod tests {
    use prost::Message as _;

    use super::super::{
        Attribute, Dim, Graph, Model, Node, OperatorSet, Shape, Tensor, ValueInfo, data_type,
    };
    use super::*;

    fn refused(graph: Graph) -> &'static str {
        match Amounts::check(&Model { graph: Some(graph), ..Model::default() }.encode_to_vec()) {
            Err(OnnxError::TooMany { what, .. }) => what,
            other => panic!("{other:?}"),
        }
    }

    fn with_node(node: Node) -> Graph {
        Graph { node: vec![node], ..Graph::default() }
    }

    fn with_attribute(attribute: Attribute) -> Graph {
        with_node(Node { attribute: vec![attribute], ..Node::default() })
    }

    #[test]
    fn a_usual_graph_passes_and_as_much_as_is_accepted() {
        let node = Node {
            input: vec!["x".into(); Amounts::NODE_INPUTS],
            output: vec!["y".into()],
            name: "n".repeat(Amounts::NAME_BYTES),
            attribute: vec![
                Attribute { ints: vec![-1; 64], ..Attribute::default() };
                Amounts::NODE_ATTRIBUTES
            ],
            ..Node::default()
        };
        let graph = Graph {
            node: vec![Node::default(); Amounts::NODES - 1].into_iter().chain([node]).collect(),
            initializer: vec![Tensor::f32("w", &[2, 3], &[0.0; 6]); Amounts::CONSTANTS],
            input: vec![ValueInfo::tensor("x", data_type::FLOAT, &[1, 2, 3])],
            ..Graph::default()
        };
        let opset_import = vec![OperatorSet { domain: "ai.onnx".into(), version: 17 }];
        Amounts::check(&Model { graph: Some(graph), opset_import, ..Model::default() }.encode_to_vec())
            .unwrap();
    }

    #[test]
    fn one_more_of_anything_than_is_accepted_is_refused() {
        let many = |count| vec![Node::default(); count];
        assert_eq!(refused(Graph { node: many(Amounts::NODES + 1), ..Graph::default() }), "nodes");
        let constants = vec![Tensor::default(); Amounts::CONSTANTS + 1];
        assert_eq!(refused(Graph { initializer: constants, ..Graph::default() }), "constants");
        let value_info = vec![ValueInfo::default(); 4097];
        assert_eq!(refused(Graph { value_info, ..Graph::default() }), "described values");
        let attribute = vec![Attribute::default(); Amounts::NODE_ATTRIBUTES + 1];
        assert_eq!(refused(with_node(Node { attribute, ..Node::default() })), "attributes of a node");
        let input = vec![String::new(); Amounts::NODE_INPUTS + 1];
        assert_eq!(refused(with_node(Node { input, ..Node::default() })), "inputs of a node");
        let ints = vec![0; 65];
        assert_eq!(
            refused(with_attribute(Attribute { ints, ..Attribute::default() })),
            "integers of an attribute"
        );
        let name = "n".repeat(Amounts::NAME_BYTES + 1);
        assert_eq!(refused(with_node(Node { op_type: name, ..Node::default() })), "bytes in a name");
        let mut info = ValueInfo::tensor("x", data_type::FLOAT, &[]);
        let tensor = info.r#type.as_mut().unwrap().tensor_type.as_mut().unwrap();
        tensor.shape = Some(Shape { dim: vec![Dim::default(); 65] });
        assert_eq!(refused(Graph { input: vec![info], ..Graph::default() }), "dimensions of a value");
    }

    #[test]
    fn packed_numbers_and_fields_that_come_again_are_counted() {
        // Field 8 of an attribute, packed: a hundred numbers of two bytes.
        let packed: Vec<u8> = [8 << 3 | 2, 200, 1].into_iter().chain([0x80, 1].repeat(100)).collect();
        let nested = |number: u8, bytes: &[u8]| {
            let mut message = vec![number << 3 | 2];
            prost::encoding::encode_varint(bytes.len() as u64, &mut message);
            message.extend_from_slice(bytes);
            message
        };
        let attribute = nested(5, &packed);
        let error = Amounts::check(&nested(7, &nested(1, &attribute))).unwrap_err();
        assert!(matches!(error, OnnxError::TooMany { what: "integers of an attribute", .. }), "{error}");
        let graph = nested(7, &[]);
        assert!(matches!(Amounts::check(&[graph.clone(), graph].concat()), Err(OnnxError::TooMany { .. })));
    }

    #[test]
    fn what_is_cut_or_no_message_at_all_is_refused_or_harmless() {
        let whole = Model {
            graph: Some(with_attribute(Attribute { ints: vec![1, 2], ..Attribute::default() })),
            ..Model::default()
        };
        let bytes = whole.encode_to_vec();
        for len in 1..bytes.len() {
            assert!(Amounts::check(&bytes[..len]).is_err(), "{len}");
        }
        for bad in [
            &[0xff; 11][..],
            &[3 << 3 | 3],
            &[7 << 3 | 2, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x7f],
        ] {
            assert!(matches!(Amounts::check(bad), Err(OnnxError::Broken { .. })), "{bad:?}");
        }
    }
}
