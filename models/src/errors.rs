//! Errors as one line for people.

use std::error::Error;

/// A text of somebody else's on one line.
#[must_use]
pub fn on_one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// The error and its causes on one line, without causes that the text before them already tells.
#[must_use]
pub fn one_line(error: &(dyn Error + 'static)) -> String {
    let mut text = String::new();
    let mut next = Some(error);
    while let Some(error) = next {
        let cause = error.to_string().replace('\n', " ");
        if !text.contains(&cause) {
            text += if text.is_empty() { "" } else { ": " };
            text += &cause;
        }
        next = error.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("{text}")]
    struct Layer {
        text: &'static str,
        source: Option<Box<Layer>>,
    }

    #[test]
    fn a_cause_that_was_told_already_is_left_out() {
        let cause = |text, source: Option<Layer>| Layer { text, source: source.map(Box::new) };
        let error = cause("a.bin: disk full", Some(cause("disk full", Some(cause("quota\nreached", None)))));
        assert_eq!(one_line(&error), "a.bin: disk full: quota reached");
    }
}
