use std::collections::BTreeSet;

use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;

use super::*;

fn name() -> impl Strategy<Value = String> {
    "[a-z][a-z0-9_.-]{0,12}"
}

fn names(count: usize) -> impl Strategy<Value = Vec<String>> {
    proptest::collection::btree_set(name(), count)
        .prop_map(|names: BTreeSet<String>| names.into_iter().collect::<Vec<_>>())
        .prop_shuffle()
}

fn state() -> impl Strategy<Value = State> {
    let kind = "[a-z]{1,8}(/[a-z]{1,8}){0,2}".prop_map(|words| format!("state/{words}"));
    (name(), kind, (1..6usize).prop_flat_map(names), "[a-zA-Z0-9]{1,4}(/s)?")
        .prop_map(|(name, kind, elements, unit)| State { name, kind, elements, unit })
}

fn camera() -> impl Strategy<Value = Camera> {
    (name(), 1..200usize, 1..200usize, any::<bool>()).prop_map(|(name, rows, columns, mask)| Camera {
        name,
        shape: [rows, columns, 3],
        encoding: Encoding::Rgb8,
        mask: mask.then_some(Mask::Robot),
    })
}

fn limits() -> impl Strategy<Value = (f64, f64)> {
    (-1e6..1e6f64, 1e-3..1e6f64).prop_map(|(low, width)| (low, low + width))
}

fn action() -> impl Strategy<Value = Action> {
    let mode = prop_oneof![Just(ActionMode::Absolute), Just(ActionMode::Delta), Just(ActionMode::Velocity)];
    let parts = (1..6usize).prop_flat_map(|count| (names(count), vec((limits(), 0.0..1.0f64), count)));
    (name(), mode, parts, option::of(1e-6..1e3f64), any::<bool>()).prop_map(
        |(name, mode, (elements, numbers), rate_max, hold)| {
            let at =
                |((low, high), share): &((f64, f64), f64)| (low + share * (high - low)).clamp(*low, *high);
            Action {
                name,
                kind: "command/joint/position".to_owned(),
                mode,
                elements,
                unit: "rad".to_owned(),
                low: numbers.iter().map(|((low, _), _)| *low).collect(),
                high: numbers.iter().map(|((_, high), _)| *high).collect(),
                rate_max,
                fallback: if hold {
                    Fallback::Rule(FallbackRule::Hold)
                } else {
                    Fallback::Numbers(numbers.iter().map(at).collect())
                },
                measured: None,
            }
        },
    )
}

/// Interfaces that are valid: names that come twice are dropped.
fn interface() -> impl Strategy<Value = Interface> {
    (name(), 0.5..1000.0f64, vec(state(), 0..4), vec(camera(), 0..3), vec(action(), 1..4)).prop_map(
        |(name, rate_hz, mut state, mut camera, mut action)| {
            let mut known = BTreeSet::new();
            state.retain(|state| known.insert(state.name.clone()));
            camera.retain(|camera| known.insert(camera.name.clone()));
            let mut known = BTreeSet::new();
            action.retain(|action| known.insert(action.name.clone()));
            Interface { name, rate_hz, state, camera, action }
        },
    )
}

fn inputs(interface: &Interface) -> Vec<&str> {
    let states = interface.state.iter().map(|state| &*state.name);
    states.chain(interface.camera.iter().map(|camera| &*camera.name)).collect()
}

proptest! {
    #[test]
    fn the_canonical_text_is_read_as_the_same_interface(interface in interface()) {
        let text = interface.canonical();
        let read = Interface::parse(&text).unwrap();
        prop_assert_eq!(&read, &interface);
        prop_assert_eq!(read.canonical(), text);
    }

    #[test]
    fn spaces_comments_and_the_order_of_keys_do_not_change_the_hash(interface in interface()) {
        // Serde writes other spaces and another order than `canonical`.
        let text = toml::to_string_pretty(&File { interface: interface.clone(), _policy: None }).unwrap();
        let text = format!("# a robot\n\n{text}\n[policy]\ninputs = []\n");
        prop_assert_eq!(Interface::parse(&text).unwrap().hash(), interface.hash());
    }

    #[test]
    fn a_robot_fits_the_policy_that_was_made_for_it(interface in interface()) {
        prop_assert_eq!(mismatches(&interface, &inputs(&interface), &interface), vec![]);
    }

    #[test]
    fn whatever_is_another_hash_in_what_is_commanded_is_named(interface in interface(), other in interface()) {
        let mut robot = interface.clone();
        robot.action = other.action;
        let found = mismatches(&interface, &inputs(&interface), &robot);
        prop_assert_eq!(found.is_empty(), robot.hash() == interface.hash());
    }

    #[test]
    fn blocks_are_aligned_follow_each_other_and_hold_what_they_are_for(interface in interface()) {
        let layout = Layout::of(&interface);
        let masks = layout.masks.iter().flatten();
        let blocks: Vec<&Block> =
            [&layout.state, &layout.executed].into_iter().chain(&layout.cameras).chain(masks).collect();
        for pair in blocks.windows(2) {
            prop_assert!(pair[0].bytes.end <= pair[1].bytes.start && pair[1].bytes.start < pair[0].bytes.end + 64);
        }
        prop_assert!(blocks.iter().all(|block| block.bytes.start.is_multiple_of(64)));
        let end = blocks.last().map_or(0, |block| block.bytes.end);
        prop_assert_eq!(layout.observation_bytes, end.next_multiple_of(64));
        for (camera, block) in interface.camera.iter().zip(&layout.cameras) {
            prop_assert_eq!(block.bytes.len(), camera.shape.iter().product::<usize>());
        }
        let ranges: Vec<_> =
            interface.state.iter().map(|state| interface.state_range(&state.name).unwrap()).collect();
        prop_assert!(ranges.windows(2).all(|pair| pair[0].end == pair[1].start));
        prop_assert_eq!(4 * ranges.last().map_or(0, |range| range.end), layout.state.bytes.len());
    }

    #[test]
    fn an_action_of_any_finite_numbers_comes_out_within_the_limits(
        interface in interface(),
        numbers in vec(any::<f32>().prop_filter("finite", |x| x.is_finite()), 32),
    ) {
        let normaliser = Normaliser::of(&interface);
        let count = interface.action_numbers();
        let mut units = vec![0.0; count];
        normaliser.to_units(&numbers[..count], &mut units).unwrap();
        let limits = interface.action.iter().flat_map(|action| action.low.iter().zip(&action.high));
        for (x, (low, high)) in units.iter().zip(limits) {
            prop_assert!((*low as f32..=*high as f32).contains(x), "{} of {} to {}", x, low, high);
        }
        let mut back = vec![0.0; count];
        normaliser.from_units(&units, &mut back).unwrap();
        for ((x, found), (low, high)) in
            numbers.iter().zip(&back).zip(interface.action.iter().flat_map(|a| a.low.iter().zip(&a.high)))
        {
            // What a number in units can tell apart.
            let step = f64::from(f32::EPSILON) * (1.0 + low.abs().max(high.abs()) / (high - low)) * 4.0;
            prop_assert!((f64::from(*found) - f64::from(x.clamp(-1.0, 1.0))).abs() <= step);
        }
    }

    #[test]
    fn what_is_not_finite_is_refused_and_changes_nothing(interface in interface(), at in 0..100usize, which in 0..3usize) {
        let count = interface.action_numbers();
        let mut numbers = vec![0.5; count];
        numbers[at % count] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY][which];
        let normaliser = Normaliser::of(&interface);
        let mut out = vec![7.0; count];
        prop_assert_eq!(normaliser.to_units(&numbers, &mut out), Err(NotFinite { at: at % count }));
        prop_assert_eq!(normaliser.from_units(&numbers, &mut out), Err(NotFinite { at: at % count }));
        prop_assert!(out.iter().all(|x| *x == 7.0));
    }

    #[test]
    fn a_damaged_text_is_refused_or_read_and_nothing_else(interface in interface(), at in any::<prop::sample::Index>(), with in "\\PC{0,6}") {
        let mut text = interface.canonical();
        let mut from = at.index(text.len());
        while !text.is_char_boundary(from) {
            from -= 1;
        }
        text.insert_str(from, &with);
        if let Ok(read) = Interface::parse(&text) {
            prop_assert_eq!(Interface::parse(&read.canonical()), Ok(read));
        }
    }
}

const ARM: &str = include_str!("arm.toml");

/// What is measured is of the command's kind: where that changes, the fallback does not measure.
fn without_measured(text: String, changed: &str) -> String {
    match changed {
        "state/joint/position" => {
            text.replace("\"hold-measured\"", "\"hold\"").replace("measured = \"joint_pos\"\n", "")
        }
        _ => text,
    }
}

#[test]
fn every_change_of_what_is_said_changes_the_hash() {
    let arm = Interface::parse(ARM).unwrap();
    let changes: [(&str, &str); 12] = [
        ("rate_hz = 50.0", "rate_hz = 49.0"),
        ("\"joint_pos\"", "\"joints\""),
        ("state/joint/position", "state/joint/angle"),
        ("\"j1\", \"j2\"", "\"j2\", \"j1\""),
        ("[128, 96, 3]", "[96, 128, 3]"),
        ("mask = \"robot\"\n", ""),
        ("\"absolute\"", "\"velocity\""),
        ("unit = \"rad\"", "unit = \"deg\""),
        ("-2.9", "-2.8"),
        ("rate_max = 0.05", "rate_max = 0.06"),
        ("fallback = \"hold-measured\"", "fallback = \"hold\""),
        ("name = \"arm\"", "name = \"left\""),
    ];
    let mut hashes = BTreeSet::from([arm.hash()]);
    for (from, to) in changes {
        assert!(ARM.contains(from), "{from}");
        // A name that is used twice, and a mode that its fallback does not fit, are changed in both places.
        let text = ARM.replace(from, to);
        let text = if to.contains("velocity") { text.replace("\"hold-measured\"", "\"zero\"") } else { text };
        let text = without_measured(text, from);
        let changed = Interface::parse(&text).unwrap_or_else(|error| panic!("{from}: {error}"));
        assert!(hashes.insert(changed.hash()), "{from} -> {to}");
    }
}

#[test]
fn a_policy_and_a_robot_that_do_not_fit_are_told_why() {
    let policy = Interface::parse(ARM).unwrap();
    let table: [(&str, &str, &str); 14] = [
        (
            "rate_hz = 50.0",
            "rate_hz = 20.0",
            "rate: the policy decides 50 times a second, the robot asks 20 times",
        ),
        (
            "\"joint_pos\"",
            "\"joint_position\"",
            "state joint_pos: the robot has no such state; it has joint_position; is it joint_position?",
        ),
        (
            "state/joint/position",
            "state/joint/effort",
            "state joint_pos: kind: the policy needs state/joint/position, the robot has state/joint/effort",
        ),
        (
            "unit = \"rad\"",
            "unit = \"deg\"",
            "state joint_pos: unit: the policy needs rad, the robot has deg",
        ),
        (
            "\"j1\", \"j2\"",
            "\"j2\", \"j1\"",
            "state joint_pos: in another order: number 1 is j1 of the policy, j2 of the robot",
        ),
        ("\"j1\", \"j2\"", "\"j1\", \"elbow\"", "state joint_pos: the robot has no j2"),
        (
            "\"j1\", \"j2\"",
            "\"j1\", \"elbow\"",
            "state joint_pos: the robot has elbow too, which the policy does not know",
        ),
        ("\"front\"", "\"rear\"", "camera front: the robot has no such camera; it has rear"),
        (
            "[128, 96, 3]",
            "[64, 64, 3]",
            "camera front: size: the policy needs 128 x 96 x 3, the robot has 64 x 64 x 3",
        ),
        ("\"absolute\"", "\"delta\"", "action arm: mode: the policy needs absolute, the robot has delta"),
        (
            "high = [2.9, 1.7]",
            "high = [2.9, 1.5]",
            "action arm: limits of j2: the policy needs -1.7 to 1.7, the robot has -1.7 to 1.5",
        ),
        ("rate_max = 0.05\n", "", "action arm: rate_max: the policy needs 0.05, the robot has none"),
        (
            "\"hold-measured\"",
            "\"hold\"",
            "action arm: fallback: the policy needs \"hold-measured\", the robot has \"hold\"",
        ),
        (
            "name = \"arm\"",
            "name = \"left\"",
            "action left: the robot expects it, and the policy does not command it",
        ),
    ];
    for (from, to, expected) in table {
        let text = ARM.replace(from, to);
        let text = if to.contains("delta") { text.replace("\"hold-measured\"", "\"zero\"") } else { text };
        let text = without_measured(text, from);
        let robot = Interface::parse(&text).unwrap_or_else(|error| panic!("{from}: {error}"));
        let found: Vec<String> =
            mismatches(&policy, &["front", "joint_pos"], &robot).iter().map(ToString::to_string).collect();
        assert!(found.iter().any(|line| line == expected), "{expected}\nfound {found:#?}");
    }
}

#[test]
fn what_a_policy_does_not_read_may_differ() {
    let policy = Interface::parse(ARM).unwrap();
    let mut robot = policy.clone();
    robot.camera.clear();
    robot.state.push(State { name: "extra".to_owned(), ..robot.state[0].clone() });
    assert_eq!(mismatches(&policy, &["joint_pos"], &robot), vec![]);
    let two = |names: [&str; 2]| {
        let mut interface = policy.clone();
        let named = |name: &str| Action { name: name.to_owned(), ..policy.action[0].clone() };
        interface.action = names.map(named).to_vec();
        interface
    };
    let swapped = mismatches(&two(["left", "right"]), &["joint_pos"], &two(["right", "left"]));
    assert_eq!(
        swapped.iter().map(ToString::to_string).collect::<Vec<_>>(),
        ["actions: in another order: left, right of the policy, right, left of the robot"]
    );
    assert_eq!(
        mismatches(&policy, &["front"], &robot)[0].to_string(),
        "camera front: the robot has no such camera; it has none"
    );
    let unknown = mismatches(&policy, &["wrist"], &robot);
    assert_eq!(unknown[0].to_string(), "wrist: an input of the policy that its own interface does not have");
}

#[test]
fn what_no_robot_can_be_run_by_is_refused_by_its_place() {
    let table: [(&str, &str, &str); 26] = [
        ("rate_hz = 50.0", "rate_hz = 0.0", "arm7: rate_hz = 0; expected decisions a second"),
        ("rate_hz = 50.0", "rate_hz = nan", "rate_hz = NaN"),
        ("rate_hz = 50.0", "rate = 50.0", "unknown field `rate`"),
        ("[[interface.camera]]", "[[interfaces.camera]]", "unknown field `interfaces`"),
        ("name = \"arm7\"", "name = \"arm 7\"", "the name \"arm 7\"; expected 1 to 64 letters"),
        ("\"j1\", \"j2\"", "\"j1\", \"j1\"", "elements of state joint_pos: \"j1\" twice"),
        ("\"j1\", \"j2\"", "", "state joint_pos: 0 elements"),
        ("unit = \"rad\"", "unit = \"\"", "unit = \"\"; expected for example rad"),
        (
            "state/joint/position",
            "joint/position",
            "kind = \"joint/position\"; expected words after \"state/\"",
        ),
        ("command/joint/position", "command/discrete/button", "expected a continuous action"),
        ("[128, 96, 3]", "[128, 96, 1]", "camera front: shape = [128, 96, 1]; expected [rows, columns, 3]"),
        ("[128, 96, 3]", "[100000, 96, 3]", "with sides of 1 to 4096"),
        ("\"rgb8\"", "\"bgr8\"", "unknown variant `bgr8`"),
        ("\"front\"", "\"joint_pos\"", "states and cameras: \"joint_pos\" twice"),
        ("low = [-2.9, -1.7]", "low = [-2.9]", "action arm: 1 numbers in low; expected 2"),
        (
            "low = [-2.9, -1.7]",
            "low = [-2.9, 1.7]",
            "action arm: j2 from 1.7 to 1.7; expected low below high",
        ),
        ("high = [2.9, 1.7]", "high = [2.9, inf]", "high of j2 is inf; expected a finite number"),
        ("high = [2.9, 1.7]", "high = [2.9, 1e39]", "expected a finite number"),
        ("rate_max = 0.05", "rate_max = 0.0", "rate_max = 0; expected a change above 0"),
        (
            "fallback = \"hold-measured\"",
            "fallback = \"zero\"",
            "zeros are a place to drive to; expected hold",
        ),
        (
            "fallback = \"hold-measured\"",
            "fallback = [0.0, 2.0]",
            "fallback of j2 is 2; expected a number within its limits, -1.7 to 1.7",
        ),
        ("measured = \"joint_pos\"", "", "hold-measured\" without measured"),
        (
            "state/joint/position",
            "state/joint/torque",
            "measured joint_pos is a state/joint/torque; expected the same kind",
        ),
        ("\"hold-measured\"", "\"hold_measured\"", "expected fallback = \"hold\", \"hold-measured\""),
        ("rate_max = 0.05", "rate_max = 1e-60", "expected a change above 0"),
        (
            "measured = \"joint_pos\"",
            "measured = \"other\"",
            "measured = \"other\"; expected the name of a state",
        ),
    ];
    for (from, to, expected) in table {
        assert!(ARM.contains(from), "{from}");
        let error = Interface::parse(&ARM.replacen(from, to, 1)).expect_err(expected).to_string();
        assert!(error.contains(expected) && !error.contains('\n'), "{error}\nexpected {expected}");
    }
}

#[test]
fn metaworlds_interface_is_what_messages_of_version_1_carry() {
    let interface = Interface::metaworld();
    assert_eq!(interface.state_numbers(), crate::PROPRIOCEPTION_LEN);
    assert_eq!(interface.action_numbers(), crate::ACTION_LEN);
    let layout = Layout::of(&interface);
    assert_eq!(layout.cameras[0].bytes.len(), crate::IMAGE_BYTES);
    assert_eq!(layout.masks[0].as_ref().map(|block| block.bytes.len()), Some(crate::MASK_BYTES));
}
