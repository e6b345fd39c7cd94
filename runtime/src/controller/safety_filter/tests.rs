use rcwm_models::bundle::{ActionMode, Bundle};
use rcwm_models::interface::{Fallback as InterfaceFallback, FallbackRule, Interface};
use rcwm_models::wire::{Format, OwnedObservation};

use super::*;

const LOW: [f32; 4] = [-1.0, -1.0, 0.2, -1.0];
const HIGH: [f32; 4] = [1.0, 0.5, 1.0, 1.0];

fn limits(absolute: bool) -> ActionLimits {
    ActionLimits { absolute: if absolute { 0b1111 } else { 0 }, ..ActionLimits::for_tests(LOW, HIGH) }
}

fn safety_filter(rate_max: Option<f32>) -> SafetyFilter {
    SafetyFilter::new(limits(false), rate_max)
}

fn send(filter: &mut SafetyFilter, action: [f32; 4]) -> Passed {
    let passed = filter.pass(action.into()).unwrap();
    filter.sent(passed.action);
    passed
}

fn executed(action: [f32; 4]) -> OwnedObservation {
    let mut observation = OwnedObservation::zeroed(&Format::metaworld());
    observation.edit().executed().copy_from_slice(&action);
    observation
}

fn first(action: [f32; 4]) -> OwnedObservation {
    let mut observation = executed(action);
    observation.flags = ObservationFlags::FIRST.0;
    observation
}

fn assert_near(passed: Option<Passed>, expected: [f32; 4]) {
    let found = passed.unwrap().action;
    assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{found:?}, not {expected:?}");
}

fn within_limits(action: ActionValues) -> bool {
    (0..4).all(|i| (LOW[i]..=HIGH[i]).contains(&action[i]))
}

#[test]
fn what_is_not_finite_becomes_what_was_executed_last() {
    for absolute in [false, true] {
        let mut filter = SafetyFilter::new(limits(absolute), None);
        filter.observed(&executed([0.4, -0.3, 0.5, 0.9]).view(), true);
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let passed = filter.pass([0.5, bad, 0.5, 0.5].into()).unwrap();
            assert_eq!((passed.action, passed.was_not_finite), ([0.4, -0.3, 0.5, 0.9].into(), true));
        }
        assert!(!filter.pass([9.0; 4].into()).unwrap().was_not_finite);
        send(&mut filter, [0.1, 0.2, 0.3, 0.4]);
        assert_eq!(filter.pass([f32::NAN; 4].into()).unwrap().action, [0.1, 0.2, 0.3, 0.4]);
    }
}

#[test]
fn before_anything_is_known_displacements_rest_and_positions_are_not_invented() {
    let filter = SafetyFilter::new(limits(false), Some(0.1));
    assert_eq!(filter.fallback(Fallback::Hold).unwrap(), [0.0; 4]);
    assert_eq!(filter.pass([f32::NAN; 4].into()).unwrap().action, [0.0, 0.0, 0.2, 0.0]);
    let mut filter = SafetyFilter::new(limits(true), Some(0.1));
    filter.observed(&first([0.0; 4]).view(), true);
    let nothing = filter.pass([f32::NAN; 4].into()).is_none();
    assert!(
        nothing && filter.fallback(Fallback::Hold).is_none() && filter.fallback(Fallback::Zero).is_none()
    );
    // Nothing tells how far the policy's position is from the robot's.
    assert_eq!(filter.pass([0.9, 0.4, 0.9, 0.9].into()).unwrap().action, [0.9, 0.4, 0.9, 0.9]);
}

#[test]
fn a_position_is_held_across_the_start_of_an_episode_and_a_motion_is_not() {
    for (absolute, held) in [(true, [0.7; 4]), (false, [0.0; 4])] {
        let mut filter = SafetyFilter::new(limits(absolute), None);
        filter.observed(&executed([0.7; 4]).view(), true);
        filter.observed(&first([0.0; 4]).view(), true);
        assert_eq!(filter.held(), Some(held.into()), "absolute {absolute}");
        assert_eq!(filter.fallback(Fallback::Zero), Some(held.into()), "absolute {absolute}");
        // A robot that says where it stands is believed.
        filter.observed(&first([0.3; 4]).view(), true);
        assert_eq!(filter.held(), Some([0.3; 4].into()), "absolute {absolute}");
    }
}

#[test]
fn a_robot_that_does_not_say_that_it_starts_is_not_taken_to_rest() {
    let mut filter = safety_filter(Some(0.1));
    filter.sent([0.4; 4].into());
    // Another episode or another publisher, whose first observation never came, with numbers that are none.
    filter.observed(&executed([f32::NAN; 4]).view(), true);
    assert_eq!(filter.fallback(Fallback::Hold), Some([0.4; 4].into()));
    assert_near(filter.pass([-1.0; 4].into()), [0.3; 4]);
    filter.observed(&first([0.0; 4]).view(), true);
    assert_eq!(filter.fallback(Fallback::Hold), Some([0.0; 4].into()));
}

#[test]
fn an_observation_that_is_refused_changes_what_is_held_only_where_nothing_is_known() {
    let mut refused = executed([0.6; 4]);
    refused.reward = f32::NAN;
    let mut filter = safety_filter(None);
    filter.observed(&refused.view(), true);
    assert_eq!(filter.held(), Some([0.6; 4].into()));
    filter.sent([0.1; 4].into());
    for bad in [0.8, 3e38, f32::NAN] {
        refused.edit().executed().fill(bad);
        filter.observed(&refused.view(), false);
        assert_eq!(filter.held(), Some([0.1; 4].into()), "{bad}");
    }
    filter.observed(&executed([3e38; 4]).view(), false);
    assert_eq!(filter.held(), Some([0.1; 4].into()));
}

#[test]
fn no_component_moves_faster_than_the_rate_limit_and_all_stay_within_the_limits() {
    let mut filter = safety_filter(Some(0.3));
    let mut last = ActionValues::zeros(4);
    for wanted in [[9.0; 4], [9.0; 4], [-9.0; 4], [f32::NAN; 4], [-9.0; 4], [0.1, 0.1, 0.3, 0.1]] {
        let action = send(&mut filter, wanted).action;
        let near = action.iter().zip(last.iter()).all(|(a, b)| (a - b).abs() <= 0.3 + 1e-6);
        assert!(near && within_limits(action), "{action:?} after {last:?}");
        last = action;
    }
}

#[test]
fn limits_come_last_even_where_another_policy_has_narrower_ones_than_what_was_sent() {
    let mut filter = safety_filter(Some(0.1));
    filter.sent([0.9, 0.5, 0.9, -0.9].into());
    filter.take_limits(ActionLimits { low: [-0.2; 4].into(), high: [0.2; 4].into(), ..limits(false) });
    assert_eq!(filter.pass([1.0, 1.0, 1.0, -1.0].into()).unwrap().action, [0.2, 0.2, 0.2, -0.2]);
    assert_eq!(filter.pass([f32::NAN; 4].into()).unwrap().action, [0.2, 0.2, 0.2, -0.2]);
}

#[test]
fn the_rate_limit_counts_from_what_was_executed_whoever_moved_the_robot() {
    let mut filter = safety_filter(Some(0.1));
    // Joined in the middle of an episode.
    filter.observed(&executed([0.9, -0.9, 0.9, 0.9]).view(), true);
    assert_near(filter.pass([-1.0; 4].into()), [0.8, -1.0, 0.8, 0.8]);
    send(&mut filter, [0.9, -0.9, 0.9, 0.9]);
    // What was sent was not executed.
    filter.observed(&executed([0.0, 0.0, 0.5, 0.0]).view(), false);
    assert_near(filter.pass([1.0; 4].into()), [0.1, 0.1, 0.6, 0.1]);
}

#[test]
fn an_action_that_is_executed_one_observation_later_is_not_left_by_more_than_the_limit_either() {
    let mut filter = safety_filter(Some(0.1));
    filter.observed(&first([0.0; 4]).view(), true);
    send(&mut filter, [1.0; 4]);
    filter.observed(&executed([0.0; 4]).view(), false);
    let back = filter.pass([-1.0; 4].into()).unwrap().action;
    assert!(back[0].abs() < 1e-6, "{back:?}, after 0.1 was sent");
}

#[test]
fn an_episode_starts_from_rest_and_what_was_not_sent_does_not_count() {
    let mut filter = safety_filter(Some(0.5));
    send(&mut filter, [1.0; 4]);
    assert_eq!(filter.pass([1.0; 4].into()).unwrap().action, [1.0, 0.5, 1.0, 1.0]);
    assert_eq!(filter.held(), Some([0.5; 4].into()));
    filter.observed(&first([0.0; 4]).view(), true);
    assert_eq!(filter.pass([1.0; 4].into()).unwrap().action, [0.5; 4]);
    assert!(!filter.pass([0.1, 0.1, 0.3, 0.1].into()).unwrap().rate_limited);
}

#[test]
fn fallbacks_are_named_or_given() {
    let mut filter = safety_filter(None);
    filter.sent([0.1, 0.2, 0.3, 0.4].into());
    let action = |text: &str| filter.fallback(text.parse().unwrap()).unwrap();
    assert_eq!(action("hold"), [0.1, 0.2, 0.3, 0.4]);
    assert_eq!(action("zero"), [0.0; 4]);
    assert_eq!(action("0, 0,0.5,-1"), [0.0, 0.0, 0.5, -1.0]);
    for bad in ["", "stop", "1,,3", "0,0,0,NaN", "0,0,0,inf"] {
        assert!(bad.parse::<Fallback>().is_err(), "{bad:?}");
    }
}

#[test]
fn a_rate_limit_of_the_interface_holds_beside_the_given_one() {
    let mut limits = limits(false);
    limits.rate_max = [0.1, 0.5, f32::INFINITY, f32::INFINITY].into();
    let mut filter = SafetyFilter::new(limits, Some(0.3));
    filter.observed(&executed([0.0, 0.0, 0.5, 0.0]).view(), true);
    assert_near(filter.pass([1.0; 4].into()), [0.1, 0.3, 0.8, 0.3]);
}

#[test]
fn where_a_hand_moves_and_a_gripper_is_placed_zero_holds_the_gripper() {
    let mut filter = SafetyFilter::new(ActionLimits { absolute: 0b1000, ..limits(false) }, None);
    assert!(filter.fallback(Fallback::Zero).is_none(), "no place of the gripper is known");
    filter.observed(&executed([0.5, 0.4, 0.3, 0.7]).view(), true);
    assert_eq!(filter.fallback(Fallback::Zero).unwrap(), [0.0, 0.0, 0.0, 0.7]);
}

/// An arm of two joints in radians that is measured, beside a gripper that is not.
fn arm() -> (ActionLimits, std::sync::Arc<Format>) {
    let mut interface = Interface::parse(include_str!("../../../../models/src/interface/arm.toml")).unwrap();
    interface.action[0].low[1] = -3.0;
    interface.action[0].high[1] = -0.1;
    let mut gripper = interface.action[0].clone();
    (gripper.name, gripper.mode, gripper.unit) = ("gripper".into(), ActionMode::Velocity, "m/s".into());
    (gripper.elements, gripper.low, gripper.high) = (vec!["width".into()], vec![-0.1], vec![0.1]);
    (gripper.measured, gripper.rate_max, gripper.fallback) =
        (None, None, InterfaceFallback::Rule(FallbackRule::Zero));
    interface.action.push(gripper);
    let mut manifest = Bundle::open(&rcwm_models_bundle()).unwrap().manifest;
    manifest.interface = interface.clone();
    (ActionLimits::of(&manifest), Format::of(interface))
}

fn rcwm_models_bundle() -> std::path::PathBuf {
    std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/bundles/untrained")
}

#[test]
fn the_interface_says_what_is_safe_and_a_measured_arm_starts_from_where_it_stands() {
    let (limits, format) = arm();
    let mut filter = SafetyFilter::new(limits, None);
    assert!(filter.fallback(Fallback::Interface).is_none(), "nothing was measured yet");
    let mut first = OwnedObservation::zeroed(&format);
    first.flags = ObservationFlags::FIRST.0;
    first.edit().state().copy_from_slice(&[0.5, -1.5]);
    assert!(
        first.view().is_valid(),
        "zeros, which the second joint cannot be at, say that nothing was executed"
    );
    filter.observed(&first.view(), true);
    assert_eq!(filter.held().unwrap(), [0.5, -1.5, 0.0]);
    // By no more than rate_max from where it stands.
    assert_eq!(filter.pass([2.0, -3.0, 0.1].into()).unwrap().action, [0.55, -1.55, 0.1]);
    filter.sent([0.55, -1.55, 0.1].into());
    let mut next = OwnedObservation::zeroed(&format);
    next.edit().executed().copy_from_slice(&[0.55, -1.55, 0.1]);
    next.edit().state().copy_from_slice(&[0.52, -1.52]);
    filter.observed(&next.view(), false);
    assert_eq!(filter.fallback(Fallback::Interface).unwrap(), [0.52, -1.52, 0.0]);
    assert_eq!(filter.fallback(Fallback::Hold).unwrap(), [0.55, -1.55, 0.1]);
    // The next episode: the gripper's motion has ended, and the arm is where it is measured.
    filter.observed(&first.view(), true);
    assert_eq!(filter.held().unwrap(), [0.5, -1.5, 0.0]);
}

#[test]
fn the_given_rate_limit_is_a_share_of_each_range() {
    let (mut limits, format) = arm();
    limits.rate_max = [f32::INFINITY; 3].into();
    let mut filter = SafetyFilter::new(limits, Some(0.5));
    let mut first = OwnedObservation::zeroed(&format);
    first.edit().executed().copy_from_slice(&[0.0, -1.5, 0.0]);
    filter.observed(&first.view(), true);
    let passed = filter.pass([2.9, -0.1, 0.1].into()).unwrap().action;
    assert!(passed.iter().zip([1.45, -0.775, 0.05]).all(|(a, b)| (a - b).abs() < 1e-6), "{passed:?}");
}
