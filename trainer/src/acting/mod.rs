//! The policy in simulators, while it learns: all of them in lock-step, one batched decision for one observation of each.
//!
//! | file | holds |
//! | --- | --- |
//! | `filter` | one step of the world model's posterior |
//! | `policy` | decisions for several simulators, each with a state of its own |
//! | `fleet` | the simulators: observations in, actions out, episodes put together |

mod filter;
mod fleet;
mod policy;

pub use filter::filter_step;
pub use fleet::{Fleet, FleetError, Gathered, Recorded};
pub use policy::{Decision, Policy, PolicyInput};

use rcwm_models::interface::Interface;
use rcwm_models::settings::{ModelSettings, SettingsError};

/// Whether a model of these sizes can act here: on one camera of 64 x 64, without a measured state, and, where simulators are `started`,
/// with the actions of Meta-World's arm.
///
/// # Errors
/// [`SettingsError::Invalid`] names the setting.
pub fn check_acting(model: &ModelSettings, started: bool) -> Result<(), SettingsError> {
    let arm = Interface::metaworld().action_numbers();
    let action = if started { arm } else { model.action };
    let needed =
        [("image_side", model.image_side, 64), ("cameras", model.cameras, 1), ("state", model.state, 0)];
    let mut sizes = needed.into_iter().chain([("action", model.action, action)]);
    match sizes.find(|(_, found, expected)| found != expected) {
        Some((name, found, expected)) => Err(SettingsError::Invalid(format!(
            "model.{name} = {found}, acting in simulators takes {expected}; learn from recorded data (pretrain, fewshot) and deploy \
             the bundle with rcwm-runtime"
        ))),
        None => Ok(()),
    }
}
