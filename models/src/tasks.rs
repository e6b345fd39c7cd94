//! Meta-World's tasks by name. A task's number on the wire is its place in [`TASKS`].

/// All fifty tasks, in alphabetical order; the order is part of the wire contract.
pub const TASKS: [&str; 50] = [
    "assembly",
    "basketball",
    "bin-picking",
    "box-close",
    "button-press",
    "button-press-topdown",
    "button-press-topdown-wall",
    "button-press-wall",
    "coffee-button",
    "coffee-pull",
    "coffee-push",
    "dial-turn",
    "disassemble",
    "door-close",
    "door-lock",
    "door-open",
    "door-unlock",
    "drawer-close",
    "drawer-open",
    "faucet-close",
    "faucet-open",
    "hammer",
    "hand-insert",
    "handle-press",
    "handle-press-side",
    "handle-pull",
    "handle-pull-side",
    "lever-pull",
    "peg-insert-side",
    "peg-unplug-side",
    "pick-out-of-hole",
    "pick-place",
    "pick-place-wall",
    "plate-slide",
    "plate-slide-back",
    "plate-slide-back-side",
    "plate-slide-side",
    "push",
    "push-back",
    "push-wall",
    "reach",
    "reach-wall",
    "shelf-place",
    "soccer",
    "stick-pull",
    "stick-push",
    "sweep",
    "sweep-into",
    "window-close",
    "window-open",
];

/// The tasks the paper pre-trains on.
pub const UPSTREAM: [&str; 4] = ["button-press", "door-open", "window-open", "reach"];

/// The tasks the paper fine-tunes on.
pub const DOWNSTREAM: [&str; 8] = [
    "box-close",
    "coffee-pull",
    "peg-insert-side",
    "sweep-into",
    "coffee-push",
    "hammer",
    "peg-unplug-side",
    "stick-push",
];

/// Number of a peer that is none of Meta-World's tasks (your own robot).
pub const OWN_TASK: u32 = u32::MAX;

/// No task has this name.
#[derive(Debug, thiserror::Error)]
#[error("no task is called {found:?}; near names: {}; `rcwm-simulator tasks` lists all", near.join(", "))]
pub struct UnknownTask {
    /// What was asked for.
    pub found: String,
    /// The nearest names, best first.
    pub near: Vec<&'static str>,
}

/// The wire number of a task.
///
/// # Errors
/// [`UnknownTask`] with the nearest names.
pub fn task_id(name: &str) -> Result<u32, UnknownTask> {
    match TASKS.iter().position(|task| *task == name) {
        Some(index) => Ok(index as u32),
        None => Err(UnknownTask { found: name.to_owned(), near: near_names(name) }),
    }
}

/// The name of a wire number; `own` for a peer that is none of Meta-World's tasks.
#[must_use]
pub fn task_name(id: u32) -> &'static str {
    TASKS.get(id as usize).copied().unwrap_or("own")
}

fn near_names(name: &str) -> Vec<&'static str> {
    let mut scored: Vec<_> = TASKS.iter().map(|task| (strsim::jaro_winkler(task, name), *task)).collect();
    scored.sort_by(|a, b| b.0.total_cmp(&a.0));
    scored.into_iter().take(4).map(|(_, task)| task).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_task_has_its_own_number_and_back() {
        for task in TASKS {
            assert_eq!(task_name(task_id(task).unwrap()), task);
        }
        assert!(UPSTREAM.iter().chain(&DOWNSTREAM).all(|task| task_id(task).is_ok()));
        assert_eq!(task_name(OWN_TASK), "own");
    }

    #[test]
    fn an_unknown_task_names_the_near_ones() {
        let error = task_id("hamer").unwrap_err();
        assert_eq!(error.near[0], "hammer");
        assert!(task_id("door").unwrap_err().near.contains(&"door-open"));
    }
}
