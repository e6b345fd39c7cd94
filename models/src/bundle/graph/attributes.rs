//! A node's attributes: each read once, with its type, and none left over.

use crate::onnx::{Amounts, Attribute, Node, Tensor, attribute_type};

/// Attributes not yet read.
pub(super) struct Attributes<'a>(Vec<&'a Attribute>);

impl<'a> Attributes<'a> {
    pub(super) fn of(node: &'a Node) -> Result<Self, String> {
        let all: Vec<&Attribute> = node.attribute.iter().collect();
        // Each is compared with those before it: there are few.
        if all.len() > Amounts::NODE_ATTRIBUTES {
            return Err(format!(
                "{} attributes, at most {} are accepted",
                all.len(),
                Amounts::NODE_ATTRIBUTES
            ));
        }
        for (index, attribute) in all.iter().enumerate() {
            if all[..index].iter().any(|before| before.name == attribute.name) {
                return Err(format!("attribute {:?} is there twice", attribute.name));
            }
        }
        Ok(Self(all))
    }

    /// Numbers that may be there, and are then finite.
    pub(super) fn finite(&mut self, names: &[&str]) -> Result<(), String> {
        for name in names {
            if let Some(number) = self.float(name)?.filter(|number| !number.is_finite()) {
                return Err(format!("{name} is {number}"));
            }
        }
        Ok(())
    }

    fn take(&mut self, name: &str, kind: i32) -> Result<Option<&'a Attribute>, String> {
        let Some(index) = self.0.iter().position(|attribute| attribute.name == name) else { return Ok(None) };
        let attribute = self.0.swap_remove(index);
        if attribute.r#type != kind {
            return Err(format!("attribute {name:?} has type {}, expected {kind}", attribute.r#type));
        }
        Ok(Some(attribute))
    }

    pub(super) fn int(&mut self, name: &str) -> Result<Option<i64>, String> {
        Ok(self.take(name, attribute_type::INT)?.map(|attribute| attribute.i))
    }

    pub(super) fn ints(&mut self, name: &str) -> Result<Option<&'a [i64]>, String> {
        Ok(self.take(name, attribute_type::INTS)?.map(|attribute| attribute.ints.as_slice()))
    }

    pub(super) fn float(&mut self, name: &str) -> Result<Option<f32>, String> {
        Ok(self.take(name, attribute_type::FLOAT)?.map(|attribute| attribute.f))
    }

    pub(super) fn string(&mut self, name: &str) -> Result<Option<String>, String> {
        let found = self.take(name, attribute_type::STRING)?;
        Ok(found.map(|attribute| String::from_utf8_lossy(&attribute.s).into_owned()))
    }

    pub(super) fn tensor(&mut self, name: &str) -> Result<Option<&'a Tensor>, String> {
        Ok(self.take(name, attribute_type::TENSOR)?.and_then(|attribute| attribute.t.as_ref()))
    }

    /// A number that may be there, but only this one, which is also the default.
    pub(super) fn only_int(&mut self, name: &str, expected: i64) -> Result<(), String> {
        match self.int(name)? {
            Some(found) if found != expected => {
                Err(format!("attribute {name:?} is {found}, expected {expected}"))
            }
            _ => Ok(()),
        }
    }

    /// Whether a flag is set; absent is `absent`.
    pub(super) fn flag(&mut self, name: &str, absent: bool) -> Result<bool, String> {
        match self.int(name)? {
            None => Ok(absent),
            Some(0) => Ok(false),
            Some(1) => Ok(true),
            Some(other) => Err(format!("attribute {name:?} is {other}, expected 0 or 1")),
        }
    }

    /// One of `rank` axes, counted from the front; negative ones count from the back.
    pub(super) fn axis(&mut self, absent: i64, rank: usize) -> Result<usize, String> {
        let axis = self.int("axis")?.unwrap_or(absent);
        axis_of(axis, rank)
    }

    /// An attribute that may be there, but only with these numbers, which are also the default.
    pub(super) fn only(&mut self, name: &str, expected: &[i64]) -> Result<(), String> {
        match self.ints(name)? {
            Some(found) if found != expected => {
                Err(format!("attribute {name:?} is {found:?}, expected {expected:?}"))
            }
            _ => Ok(()),
        }
    }

    pub(super) fn all_read(&self) -> Result<(), String> {
        match self.0.first() {
            None => Ok(()),
            Some(left) => Err(format!("attribute {:?} is not one that is accepted here", left.name)),
        }
    }
}

pub(super) fn axis_of(axis: i64, rank: usize) -> Result<usize, String> {
    let from_front = if axis < 0 { axis.checked_add(rank as i64) } else { Some(axis) };
    let fits = from_front.and_then(|axis| usize::try_from(axis).ok()).filter(|axis| *axis < rank);
    fits.ok_or_else(|| format!("axis {axis} of a value with {rank} dimensions"))
}
