//! The shortest scenario that still shows a violation.

use std::time::{Duration, Instant};

/// Longest time spent on one violation.
const TIME_MAX: Duration = Duration::from_secs(60);

/// Leaves deeds out of `kept`, halves first and then ever smaller pieces, as long as `still_shows` says so of the rest.
pub(crate) fn shorten(mut kept: Vec<usize>, mut still_shows: impl FnMut(&[usize]) -> bool) -> Vec<usize> {
    let start = Instant::now();
    let mut piece = kept.len().div_ceil(2);
    while piece > 0 {
        let mut from = 0;
        while from < kept.len() {
            if start.elapsed() > TIME_MAX {
                return kept;
            }
            let to = (from + piece).min(kept.len());
            let rest: Vec<usize> = kept[..from].iter().chain(&kept[to..]).copied().collect();
            if still_shows(&rest) {
                kept = rest;
            } else {
                from = to;
            }
        }
        piece = if piece == 1 { 0 } else { piece.div_ceil(2) };
    }
    kept
}

/// Numbers as `0-3,7,9-12`.
pub(crate) fn text_of(numbers: &[usize]) -> String {
    let mut parts: Vec<(usize, usize)> = Vec::new();
    for number in numbers {
        match parts.last_mut() {
            Some((_, last)) if *last + 1 == *number => *last = *number,
            _ => parts.push((*number, *number)),
        }
    }
    let part = |(first, last): &(usize, usize)| {
        if first == last { first.to_string() } else { format!("{first}-{last}") }
    };
    parts.iter().map(part).collect::<Vec<_>>().join(",")
}

/// The numbers of such a text.
pub(crate) fn numbers_of(text: &str) -> Result<Vec<usize>, String> {
    let wrong = |_| format!("{text:?}: expected numbers as in 0-3,7,9-12");
    let mut numbers = Vec::new();
    for part in text.split(',') {
        let (first, last) = part.split_once('-').unwrap_or((part, part));
        let (first, last): (usize, usize) = (first.parse().map_err(wrong)?, last.parse().map_err(wrong)?);
        numbers.extend(first..=last.min(first.saturating_add(10_000_000)));
    }
    Ok(numbers)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_needed_is_left_out() {
        let needed = [3, 40, 41, 99];
        let shows = |kept: &[usize]| needed.iter().all(|number| kept.contains(number));
        assert_eq!(shorten((0..100).collect(), shows), needed);
    }

    #[test]
    fn numbers_are_written_and_read_as_ranges() {
        let numbers = [0, 1, 2, 7, 9, 10];
        assert_eq!(text_of(&numbers), "0-2,7,9-10");
        assert_eq!(numbers_of("0-2,7,9-10").unwrap(), numbers);
        assert!(numbers_of("1-x").is_err());
    }
}
