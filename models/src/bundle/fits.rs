//! Whether a robot fits a bundle. Bundles of version 1 have no interface: images, one vector of action, one of state, and no names.

use super::Manifest;
use crate::interface::{Interface, Mismatch};

impl Manifest {
    /// Everything in which a robot differs from what this bundle needs. Names, kinds and units are not compared: the bundle has none.
    #[must_use]
    pub fn mismatches(&self, robot: &Interface) -> Vec<Mismatch> {
        let (model, control) = (&self.model, &self.control);
        let differs = Mismatch::between;
        let mut found = vec![Mismatch::of_rates(control.rate_hz, robot.rate_hz)];
        let needed = [model.image_side, model.image_side, 3].map(|side| side.to_string()).join(" x ");
        if robot.camera.len() == model.cameras {
            let sizes = robot.camera.iter();
            found.extend(
                sizes.map(|camera| {
                    differs(&format!("camera {}", camera.name), "size", &needed, &camera.size())
                }),
            );
        } else {
            let seen = if model.cameras == 1 { "one".to_owned() } else { model.cameras.to_string() };
            let text = format!("the policy sees {seen} of {needed}, the robot has {}", robot.camera.len());
            found.push(Some(Mismatch::new("cameras", text)));
        }
        let numbers = |count: usize| format!("{count} numbers");
        if model.state > 0 {
            found.push(differs("state", "elements", &numbers(model.state), &numbers(robot.state_numbers())));
        }
        let [action] = robot.action.as_slice() else {
            let (needed, count) = (model.action, robot.action.len());
            let text = format!("the policy commands one of {needed} numbers, the robot has {count}");
            found.push(Some(Mismatch::new("actions", text)));
            return found.into_iter().flatten().collect();
        };
        let place = format!("action {}", action.name);
        found.push(differs(&place, "mode", control.action_mode.name(), action.mode.name()));
        found.push(differs(&place, "elements", &numbers(model.action), &numbers(action.elements.len())));
        if action.elements.len() == model.action {
            let limits = control.action_low.iter().zip(&control.action_high);
            for ((element, (low, high)), at) in action.elements.iter().zip(limits).zip(0..) {
                let needed = format!("{} to {}", low + 0.0, high + 0.0);
                let has = format!("{} to {}", action.low[at] as f32 + 0.0, action.high[at] as f32 + 0.0);
                found.push(differs(&place, &format!("limits of {element}"), &needed, &has));
            }
        }
        found.into_iter().flatten().collect()
    }
}
