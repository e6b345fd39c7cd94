use serde::{Deserialize, Serialize};

/// States of which the attention is looked at, at most: bounds the memory.
const STATES_MAX: usize = 5000;

/// How attention is spread over many states. Shares are of the attention and lie between 0 and 1: half the sum of absolute differences,
/// the part that would have to be moved to make two distributions the same.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AttentionSpread {
    /// States looked at.
    pub states: usize,
    /// Categoricals of the environment's z, which ask.
    pub queries: usize,
    /// Rows that answer.
    pub keys: usize,
    /// Weight of every row if all got the same.
    pub even: f64,
    /// Smallest single weight.
    pub smallest: f64,
    /// Largest single weight.
    pub largest: f64,
    /// Share that lies elsewhere than in the mean over the same state's queries: 0 if all queries ask alike.
    pub over_queries: f64,
    /// Share that lies elsewhere than in the mean over states of the same query: 0 if it never changes.
    pub over_states: f64,
    /// Share that lies elsewhere than if every row got the same: 0 if attention chooses nothing.
    pub from_even: f64,
}

/// Attention maps of states, by query, then key; only the first few thousand are kept.
#[derive(Debug, Clone, Default)]
pub struct AttentionMaps {
    maps: Vec<Vec<f32>>,
    queries: usize,
}

impl AttentionMaps {
    /// For maps of this many queries.
    #[must_use]
    pub const fn new(queries: usize) -> Self {
        Self { maps: Vec::new(), queries }
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.maps.is_empty()
    }

    /// Adds maps of as many keys as those that are there.
    pub fn extend(&mut self, maps: impl IntoIterator<Item = Vec<f32>>) {
        let room = STATES_MAX.saturating_sub(self.maps.len());
        self.maps.extend(maps.into_iter().take(room));
    }

    /// How they are spread; none where there are none.
    #[must_use]
    pub fn spread(&self) -> Option<AttentionSpread> {
        let (queries, states) = (self.queries, self.maps.len());
        let keys = self.maps.first()?.len().checked_div(queries).filter(|keys| *keys > 0)?;
        let mut mean_of_states = vec![0.0; queries * keys];
        for map in &self.maps {
            add(&mut mean_of_states, map, 1.0 / states as f64);
        }
        let even = vec![1.0 / keys as f64; keys];
        let (mut over_queries, mut over_states, mut from_even) = (0.0, 0.0, 0.0);
        for map in &self.maps {
            let mut mean_of_queries = vec![0.0; keys];
            for row in map.chunks_exact(keys) {
                add(&mut mean_of_queries, row, 1.0 / queries as f64);
            }
            for (row, mean_of_states) in map.chunks_exact(keys).zip(mean_of_states.chunks_exact(keys)) {
                over_queries += elsewhere(row, &mean_of_queries);
                over_states += elsewhere(row, mean_of_states);
                from_even += elsewhere(row, &even);
            }
        }
        let rows = (states * queries) as f64;
        let weights = || self.maps.iter().flatten().map(|weight| f64::from(*weight));
        Some(AttentionSpread {
            states,
            queries,
            keys,
            even: 1.0 / keys as f64,
            smallest: weights().fold(f64::INFINITY, f64::min),
            largest: weights().fold(0.0, f64::max),
            over_queries: over_queries / rows,
            over_states: over_states / rows,
            from_even: from_even / rows,
        })
    }
}

fn add(sum: &mut [f64], map: &[f32], times: f64) {
    for (sum, weight) in sum.iter_mut().zip(map) {
        *sum += f64::from(*weight) * times;
    }
}

/// The share of one distribution that lies elsewhere than in another.
fn elsewhere(row: &[f32], other: &[f64]) -> f64 {
    0.5 * row.iter().zip(other).map(|(a, b)| (f64::from(*a) - b).abs()).sum::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spread(maps: &[[f32; 6]]) -> AttentionSpread {
        let mut found = AttentionMaps::new(2);
        found.extend(maps.iter().map(|map| map.to_vec()));
        found.spread().unwrap()
    }

    fn near(found: f64, expected: f64) {
        assert!((found - expected).abs() < 1e-6, "{found} {expected}");
    }

    #[test]
    fn even_attention_is_spread_over_nothing() {
        let third = 1.0 / 3.0;
        let found = spread(&[[third; 6]; 4]);
        assert_eq!((found.states, found.queries, found.keys), (4, 2, 3));
        near(found.over_queries + found.over_states + found.from_even, 0.0);
        near(found.largest, found.even);
    }

    #[test]
    fn queries_that_ask_differently_and_states_that_do_are_told_apart() {
        // Each query looks at a row of its own, always.
        let queries = spread(&[[1.0, 0.0, 0.0, 0.0, 1.0, 0.0]; 3]);
        near(queries.over_queries, 0.5);
        near(queries.over_states, 0.0);
        near(queries.from_even, 2.0 / 3.0);
        // Both look at the same row, which changes.
        let states = spread(&[[1.0, 0.0, 0.0, 1.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0, 1.0, 0.0]]);
        near(states.over_queries, 0.0);
        near(states.over_states, 0.5);
        assert_eq!((states.smallest, states.largest), (0.0, 1.0));
        assert_eq!(AttentionMaps::default().spread(), None);
    }
}
