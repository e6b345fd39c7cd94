//! The policy as a library, without shared memory.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use rcwm_models::IMAGE_BYTES;
use rcwm_models::bundle::{Bundle, BundleKind};
use rcwm_models::wire::ActionValues;
use rcwm_runtime::policy::{Sampling, Surprise};
use rcwm_runtime::{EngineError, EngineSettings, Policy, PolicyError};
use rcwm_testkit::{image, smallest_bundle, with_nan_weight};

const EXECUTED: [f32; 4] = [0.1, -0.4, 0.2, -1.0];

fn executed_values() -> ActionValues {
    EXECUTED.into()
}

fn run(policy: &mut Policy, steps: u32) -> Vec<ActionValues> {
    (0..steps)
        .map(|step| policy.observe(&image(step), (step > 0).then(executed_values).as_ref()).unwrap().action)
        .collect()
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
    policy.observe(&image(0), None).unwrap();
    let start = policy.state().clone();
    policy.observe(&image(0), None).unwrap();
    assert_eq!(*policy.state(), start);
    policy.observe(&image(1), Some(&executed_values())).unwrap();
    let moved = policy.state().clone();
    policy.set_state(&start).unwrap();
    policy.observe(&image(1), Some(&[1.0; 4].into())).unwrap();
    assert_ne!(policy.state().branches[0].h, moved.branches[0].h);
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
fn what_is_invalid_is_refused_and_leaves_the_state_alone() {
    let mut policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    run(&mut policy, 3);
    let before = policy.state().clone();
    let short = policy.observe(&[0; IMAGE_BYTES - 1], Some(&executed_values()));
    assert!(matches!(short, Err(PolicyError::Observation(_))));
    let infinite = policy.observe(&image(3), Some(&[f32::INFINITY, 0.0, 0.0, 0.0].into()));
    assert!(matches!(infinite, Err(PolicyError::Observation(_))));
    assert_eq!(*policy.state(), before);
}

/// Its outputs would look sound: tract's sigmoid, tanh and SiLU turn NaN into a bound.
#[test]
fn weights_that_are_no_numbers_are_refused_before_they_run() {
    for part in BundleKind::Rcwm.parts().iter().copied() {
        let bundle = with_nan_weight(part);
        let refused = Policy::load(bundle.path(), EngineSettings::tract()).err();
        let Some(PolicyError::Engine(error @ EngineError::Weights { .. })) = refused else {
            panic!("{part}: {refused:?}");
        };
        assert!(error.to_string().contains(part.as_str()), "{error}");
    }
}

#[test]
fn work_done_ahead_changes_nothing_but_when_it_is_done() {
    let bundle = Bundle::open(&smallest_bundle()).unwrap();
    for sampling in [Sampling::Mode, Sampling::Sample { seed: 5 }] {
        let fresh = || Policy::new(&bundle, EngineSettings::tract(), sampling).unwrap();
        let expected = run(&mut fresh(), 8);
        let mut ahead = fresh();
        for (step, expected) in (0..).zip(&expected) {
            let executed = (step > 0).then(executed_values);
            let executed = executed.as_ref();
            ahead.work_ahead(executed).unwrap();
            let decision = ahead.observe(&image(step), executed).unwrap();
            assert_eq!((decision.action, decision.recomputed), (*expected, false));
        }
        let mut wrong = fresh();
        for (step, expected) in (0..).zip(&expected) {
            wrong.work_ahead((step > 0).then_some(&[-0.9; 4].into())).unwrap();
            let decision = wrong.observe(&image(step), (step > 0).then(executed_values).as_ref()).unwrap();
            assert_eq!((decision.action, decision.recomputed), (*expected, step > 0));
        }
    }
}

#[test]
fn an_imagined_frame_moves_the_state_and_has_no_surprise() {
    let mut policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    let seen = policy.observe(&image(0), None).unwrap();
    assert!(
        matches!(seen.surprise, Some(Surprise::Rcwm { robot, environment }) if robot > 0.0 && environment > 0.0)
    );
    let before = policy.state().clone();
    let imagined = policy.imagine(&executed_values()).unwrap();
    assert_eq!(imagined.surprise, None);
    assert_eq!(policy.state().branches[0].z, policy.buffers().branches[0].prior_z);
    assert_ne!(*policy.state(), before);
}
