//! Settings from a file, and one by one from the command line.

use std::path::Path;

use serde::{Serialize, de::DeserializeOwned};

use super::{SettingsError, default_cameras, default_image_side};

/// Largest settings file accepted.
const SETTINGS_BYTES_MAX: u64 = 1 << 20;

/// Reads settings from a TOML file; unknown keys are refused.
pub fn read<T: DeserializeOwned>(path: &Path) -> Result<T, SettingsError> {
    let bytes = crate::files::read_capped(path, SETTINGS_BYTES_MAX)?;
    let text = String::from_utf8(bytes)
        .map_err(|_| SettingsError::Invalid(format!("{} is not UTF-8", path.display())))?;
    Ok(toml::from_str(&text)?)
}

/// Applies dotted overrides (`model.cnn_depth=16`) to settings. A key must exist already; the value is read as
/// TOML, and as a plain string where it is no TOML value (`task=reach`).
///
/// # Errors
/// [`SettingsError::OverrideForm`], [`SettingsError::UnknownKey`], or [`SettingsError::Toml`] for a wrong type.
pub fn with_overrides<T: Serialize + DeserializeOwned>(
    settings: &T,
    overrides: &[String],
) -> Result<T, SettingsError> {
    let mut root = toml::Table::try_from(settings)?;
    write_out_defaults(&mut root);
    for text in overrides {
        let (key, value) = text.split_once('=').ok_or_else(|| SettingsError::OverrideForm(text.clone()))?;
        let key = key.trim();
        match slot_of(&mut root, key) {
            Some(slot) => *slot = parse_value(value.trim(), slot),
            None => {
                return Err(SettingsError::UnknownKey { key: key.to_owned(), near: nearest_key(&root, key) });
            }
        }
    }
    Ok(root.try_into()?)
}

/// Adds the sizes of a model that its text leaves out where they are the default: they can be set all the same.
fn write_out_defaults(table: &mut toml::Table) {
    if table.contains_key("cnn_depth") {
        for (key, value) in
            [("image_side", default_image_side()), ("cameras", default_cameras()), ("state", 0)]
        {
            table.entry(key).or_insert(toml::Value::Integer(value as i64));
        }
    }
    table.iter_mut().filter_map(|(_, value)| value.as_table_mut()).for_each(write_out_defaults);
}

fn slot_of<'a>(root: &'a mut toml::Table, key: &str) -> Option<&'a mut toml::Value> {
    match key.split_once('.') {
        None => root.get_mut(key),
        Some((first, rest)) => slot_of(root.get_mut(first)?.as_table_mut()?, rest),
    }
}

fn parse_value(text: &str, old: &toml::Value) -> toml::Value {
    let parsed =
        toml::from_str::<toml::Table>(&format!("value = {text}")).ok().and_then(|mut t| t.remove("value"));
    match (parsed, old) {
        // `lr=1` is meant as 1.0 where the setting is a float.
        (Some(toml::Value::Integer(integer)), toml::Value::Float(_)) => toml::Value::Float(integer as f64),
        (Some(value), _) => value,
        (None, _) => toml::Value::String(text.to_owned()),
    }
}

fn nearest_key(root: &toml::Table, key: &str) -> Option<String> {
    let mut keys = Vec::new();
    collect_keys(root, "", &mut keys);
    // A bare name finds its dotted home (`cnn_depth` -> `model.cnn_depth`).
    let last = |dotted: &str| dotted.rsplit('.').next().unwrap_or(dotted).to_owned();
    if let Some(exact) = keys.iter().find(|candidate| last(candidate) == last(key)) {
        return Some(exact.clone());
    }
    let score = |candidate: &String| {
        strsim::jaro_winkler(candidate, key).max(strsim::jaro_winkler(&last(candidate), &last(key)))
    };
    keys.into_iter().filter(|candidate| score(candidate) > 0.8).max_by(|a, b| score(a).total_cmp(&score(b)))
}

fn collect_keys(table: &toml::Table, prefix: &str, keys: &mut Vec<String>) {
    for (name, value) in table {
        let dotted = if prefix.is_empty() { name.clone() } else { format!("{prefix}.{name}") };
        match value {
            toml::Value::Table(inner) => collect_keys(inner, &dotted, keys),
            _ => keys.push(dotted),
        }
    }
}
