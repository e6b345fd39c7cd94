use serde::Serialize;
use serde_json::Value;

use crate::learning::LossValues;

/// The line of a checkpoint: mask-free losses on the held-out episodes, by the same batches and the same noise every time.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct HeldOutLosses {
    /// Updates made so far.
    pub update: u64,
    /// The losses before their factors.
    pub held_out: LossValues,
    /// Whether this is the best checkpoint so far.
    pub best: bool,
}

/// The numbers of a line under their names for TensorBoard, `losses/image`; the number of updates is their step, not one of them.
pub(super) fn scalars(line: &Value) -> Vec<(String, f64)> {
    let mut scalars = Vec::new();
    let fields = line.as_object().into_iter().flatten();
    fields.filter(|(name, _)| *name != "update").for_each(|(name, value)| gather(name, value, &mut scalars));
    scalars
}

fn gather(name: &str, value: &Value, scalars: &mut Vec<(String, f64)>) {
    match value {
        Value::Object(fields) => {
            fields.iter().for_each(|(field, value)| gather(&format!("{name}/{field}"), value, scalars));
        }
        value => scalars.extend(value.as_f64().map(|number| (name.to_owned(), number))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn numbers_at_any_depth_are_scalars_and_nothing_else_is() {
        let line =
            json!({"update": 7, "phase": "mask_free", "losses": {"image": 1.5, "mask": null}, "rate": 2});
        assert_eq!(scalars(&line), [("losses/image".to_owned(), 1.5), ("rate".to_owned(), 2.0)]);
    }
}
