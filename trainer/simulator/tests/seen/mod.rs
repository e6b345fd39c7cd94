//! An observation of Meta-World's arm, taken apart.

use std::ops::Deref;

use rcwm_models::wire::{Observation, ObservationHeader};

#[derive(Clone, Debug)]
pub struct Seen {
    header: ObservationHeader,
    #[allow(dead_code, reason = "not every test looks at all")]
    pub executed_action: [f32; 4],
    #[allow(dead_code, reason = "not every test looks at all")]
    pub proprioception: [f32; 18],
    pub image: Vec<u8>,
    #[allow(dead_code, reason = "not every test looks at all")]
    pub robot_mask: Vec<u8>,
}

impl Deref for Seen {
    type Target = ObservationHeader;
    fn deref(&self) -> &ObservationHeader {
        &self.header
    }
}

impl From<Observation<'_>> for Seen {
    fn from(observation: Observation<'_>) -> Self {
        Self {
            header: *observation,
            executed_action: observation.executed().try_into().unwrap(),
            proprioception: observation.state().try_into().unwrap(),
            image: observation.image(0).to_vec(),
            robot_mask: observation.mask(0).unwrap_or_default().to_vec(),
        }
    }
}
