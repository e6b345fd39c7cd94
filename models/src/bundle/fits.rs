//! Whether a robot fits a bundle. Bundles of version 1 have no interface: one picture of 64 x 64, four numbers, and no names.

use super::Control;
use crate::interface::{Interface, Mismatch};
use crate::{ACTION_LEN, IMAGE_CHANNELS, IMAGE_SIDE};

impl Control {
    /// Everything in which a robot differs from what this bundle needs. Names, kinds and units are not compared: the bundle has none.
    #[must_use]
    pub fn mismatches(&self, robot: &Interface) -> Vec<Mismatch> {
        let differs = Mismatch::between;
        let mut found = vec![Mismatch::of_rates(self.rate_hz, robot.rate_hz)];
        let needed = [IMAGE_SIDE, IMAGE_SIDE, IMAGE_CHANNELS].map(|side| side.to_string()).join(" x ");
        found.push(match robot.camera.as_slice() {
            [camera] => differs(&format!("camera {}", camera.name), "size", &needed, &camera.size()),
            cameras => {
                let text = format!("the policy sees one of {needed}, the robot has {}", cameras.len());
                Some(Mismatch::new("cameras", text))
            }
        });
        let [action] = robot.action.as_slice() else {
            let count = robot.action.len();
            let text = format!("the policy commands one of {ACTION_LEN} numbers, the robot has {count}");
            found.push(Some(Mismatch::new("actions", text)));
            return found.into_iter().flatten().collect();
        };
        let place = format!("action {}", action.name);
        found.push(differs(&place, "mode", self.action_mode.name(), action.mode.name()));
        let numbers = |count: usize| format!("{count} numbers");
        found.push(differs(&place, "elements", &numbers(ACTION_LEN), &numbers(action.elements.len())));
        if action.elements.len() == ACTION_LEN {
            for (at, element) in action.elements.iter().enumerate() {
                let needed = format!("{} to {}", self.action_low[at] + 0.0, self.action_high[at] + 0.0);
                let has = format!("{} to {}", action.low[at] as f32 + 0.0, action.high[at] as f32 + 0.0);
                found.push(differs(&place, &format!("limits of {element}"), &needed, &has));
            }
        }
        found.into_iter().flatten().collect()
    }
}
