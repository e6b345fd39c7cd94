//! Where everything lies in a message.

use std::ops::Range;

use super::Interface;

/// What every block begins at a multiple of, in bytes: a cache line.
const ALIGNMENT: usize = 64;

/// Bytes of a message that belong together.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Block {
    /// Of the message.
    pub bytes: Range<usize>,
}

/// The blocks of an observation, one after the other: all states as f32, the executed action as f32, each camera's picture, each mask.
/// A message that carries an action holds its numbers as f32 alone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layout {
    pub state: Block,
    pub executed: Block,
    /// In the order of the interface.
    pub cameras: Vec<Block>,
    /// In the order of the interface; none where a camera has no mask.
    pub masks: Vec<Option<Block>>,
    /// Of a whole observation.
    pub observation_bytes: usize,
    /// Of a whole action.
    pub action_bytes: usize,
}

impl Layout {
    #[must_use]
    pub fn of(interface: &Interface) -> Self {
        let mut end = 0usize;
        let mut block = |bytes: usize| {
            let from = end.next_multiple_of(ALIGNMENT);
            end = from + bytes;
            Block { bytes: from..end }
        };
        let action_bytes = 4 * interface.action_numbers();
        let state = block(4 * interface.state_numbers());
        let executed = block(action_bytes);
        let pixels = |shape: [usize; 3]| shape[0] * shape[1];
        let cameras = interface.camera.iter().map(|camera| block(3 * pixels(camera.shape))).collect();
        let masks =
            interface.camera.iter().map(|camera| camera.mask.map(|_| block(pixels(camera.shape)))).collect();
        let observation_bytes = end.next_multiple_of(ALIGNMENT);
        Self { state, executed, cameras, masks, observation_bytes, action_bytes }
    }
}

impl Interface {
    /// Which of all states' numbers are those of the state of this name.
    #[must_use]
    pub fn state_range(&self, name: &str) -> Option<Range<usize>> {
        let mut from = 0;
        for state in &self.state {
            let range = from..from + state.elements.len();
            if state.name == name {
                return Some(range);
            }
            from = range.end;
        }
        None
    }
}
