//! The policy as a library, without shared memory.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

mod support;

use rcwm_models::IMAGE_BYTES;
use rcwm_models::bundle::{Bundle, PartName};
use rcwm_runtime::policy::Sampling;
use rcwm_runtime::{EngineError, EngineSettings, Policy, PolicyError};
use support::{image, smallest_bundle, with_nan_weight};

const EXECUTED: [f32; 4] = [0.1, -0.4, 0.2, -1.0];

fn run(policy: &mut Policy, steps: u32) -> Vec<[f32; 4]> {
    (0..steps).map(|step| policy.observe(&image(step), &EXECUTED, step == 0).unwrap().action).collect()
}

#[test]
fn an_episode_starts_from_the_same_state_every_time() {
    let mut policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    let first = run(&mut policy, 12);
    assert_eq!(run(&mut policy, 12), first);
}

#[test]
fn the_executed_action_matters_except_at_the_first_of_an_episode() {
    let mut policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    policy.observe(&image(0), &EXECUTED, true).unwrap();
    let start = policy.state().clone();
    policy.observe(&image(0), &[1.0; 4], true).unwrap();
    assert_eq!(*policy.state(), start);
    policy.observe(&image(1), &EXECUTED, false).unwrap();
    let moved = policy.state().clone();
    policy.set_state(&start).unwrap();
    policy.observe(&image(1), &[1.0; 4], false).unwrap();
    assert_ne!(policy.state().robot.h, moved.robot.h);
}

#[test]
fn samples_repeat_with_their_seed_and_stay_within_the_limits() {
    let bundle = Bundle::open(&smallest_bundle()).unwrap();
    let sampled = |seed| {
        let mut policy = Policy::new(&bundle, EngineSettings::tract(), Sampling::Sample { seed }).unwrap();
        run(&mut policy, 12)
    };
    let actions = sampled(3);
    assert_eq!(sampled(3), actions);
    assert_ne!(sampled(4), actions);
    assert!(actions.iter().flatten().all(|value| (-1.0..=1.0).contains(value)));
}

#[test]
fn what_is_unfit_is_refused_and_leaves_the_state_alone() {
    let mut policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    run(&mut policy, 3);
    let before = policy.state().clone();
    let short = policy.observe(&[0; IMAGE_BYTES - 1], &EXECUTED, false);
    assert!(matches!(short, Err(PolicyError::Observation(_))));
    let infinite = policy.observe(&image(3), &[f32::INFINITY, 0.0, 0.0, 0.0], false);
    assert!(matches!(infinite, Err(PolicyError::Observation(_))));
    assert_eq!(*policy.state(), before);
}

/// Its outputs would look sound: tract's sigmoid, tanh and SiLU turn NaN into a bound.
#[test]
fn weights_that_are_no_numbers_are_refused_before_they_run() {
    for part in PartName::REQUIRED {
        let bundle = with_nan_weight(part);
        let refused = Policy::load(bundle.path(), EngineSettings::tract()).err();
        let Some(PolicyError::Engine(error @ EngineError::Weights { .. })) = refused else {
            panic!("{part}: {refused:?}");
        };
        assert!(error.to_string().contains(part.as_str()), "{error}");
    }
}
