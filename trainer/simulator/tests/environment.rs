//! Meta-World itself: layouts, pictures, masks, disturbances.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use rcwm_models::tasks::TASKS;
use rcwm_models::wire::{Format, ObservationFlags, OwnedObservation};
use rcwm_models::{ACTION_LEN, IMAGE_SIDE};
use rcwm_simulator::SimulatorError;
use rcwm_simulator::environment::{
    Disturbance, Environment, EnvironmentSettings, Layouts, STEPS_MAX, installed_tasks,
};
use rcwm_simulator::policy::{Policy, Script};

fn settings(task: &str) -> EnvironmentSettings {
    let task = task.to_owned();
    EnvironmentSettings {
        task,
        layouts: Layouts::Learning,
        seed: 3,
        faithful: false,
        masks: true,
        disturb: Disturbance::None,
    }
}

mod seen;
use seen::Seen;

fn see(environment: &Environment) -> (Seen, bool) {
    let mut observation = OwnedObservation::zeroed(&Format::metaworld());
    let solved = environment.write_to(&mut observation.edit()).unwrap();
    assert!(observation.view().is_finite());
    observation.flags = ObservationFlags::MASK_VALID.0;
    (observation.view().into(), solved)
}

/// The first observation of an episode, and those after each of some seeded random actions.
fn watch(environment: &Environment, episode: u64, steps: u32) -> Vec<Seen> {
    environment.reset(episode).unwrap();
    let mut script = Script::new(Policy::Random, 9, episode);
    let mut seen = vec![see(environment).0];
    for _ in 0..steps {
        environment.step(script.decide(environment).unwrap().unwrap()).unwrap();
        seen.push(see(environment).0);
    }
    seen
}

fn numbers(observation: &Seen) -> (u32, [u32; 18]) {
    (observation.reward.to_bits(), observation.proprioception.map(f32::to_bits))
}

#[track_caller]
fn assert_same(a: &[Seen], b: &[Seen]) {
    assert_eq!(a.len(), b.len());
    for (step, (a, b)) in a.iter().zip(b).enumerate() {
        assert_eq!(numbers(a), numbers(b), "reward or proprioception differ at step {step}");
        let pixels = a.image.iter().zip(&b.image).filter(|(a, b)| a != b).count();
        let mask = a.robot_mask.iter().zip(&b.robot_mask).filter(|(a, b)| a != b).count();
        assert_eq!((pixels, mask), (0, 0), "colours and mask pixels that differ at step {step}");
    }
}

fn share(mask: impl Iterator<Item = bool>) -> f64 {
    let mask: Vec<bool> = mask.collect();
    mask.iter().filter(|set| **set).count() as f64 / mask.len() as f64
}

#[test]
fn the_tasks_on_the_wire_are_those_of_meta_world() {
    assert_eq!(installed_tasks().unwrap(), TASKS);
}

#[test]
fn an_unknown_task_is_refused_with_near_names() {
    let error = Environment::open(settings("hamer")).err().unwrap();
    assert!(matches!(error, SimulatorError::UnknownTask(_)));
    assert!(error.to_string().contains("hammer"), "{error}");
}

/// The goal of reach is a few pixels that no physics moves: between two pictures little may change but the robot.
#[test]
fn the_first_picture_shows_the_goal_where_it_stays() {
    let reach = Environment::open(settings("reach")).unwrap();
    for episode in 0..5 {
        reach.reset(episode).unwrap();
        let before = see(&reach).0;
        reach.step([0.0; ACTION_LEN]).unwrap();
        let after = see(&reach).0;
        let robot = |pixel: usize| before.robot_mask[pixel] > 0 || after.robot_mask[pixel] > 0;
        let picture = |seen: &Seen, pixel: usize| -> [u8; 3] {
            seen.image[3 * pixel..3 * (pixel + 1)].try_into().unwrap()
        };
        let changed = (0..IMAGE_SIDE * IMAGE_SIDE)
            .filter(|pixel| !robot(*pixel) && picture(&before, *pixel) != picture(&after, *pixel))
            .count();
        // The puck on the table may settle by a pixel.
        assert!(changed <= 1, "{changed} pixels beside the robot changed in episode {episode}");
    }
}

#[test]
fn an_episode_depends_on_its_number_and_not_on_the_ones_before() {
    let (one, other) = (Environment::open(settings("hammer")), Environment::open(settings("hammer")));
    let (one, other) = (one.unwrap(), other.unwrap());
    let first = watch(&one, 0, 10);
    let third = watch(&one, 2, 10);
    let alone = watch(&other, 2, 10);
    assert_same(&third, &alone);
    assert!(first[0].image != third[0].image, "two episodes have the same layout");
    assert_same(&watch(&one, 0, 10), &first);
}

#[test]
fn the_fast_picture_has_the_physics_of_the_faithful_one_and_nearly_its_mask() {
    let fast = Environment::open(settings("hammer")).unwrap();
    let faithful = Environment::open(EnvironmentSettings { faithful: true, ..settings("hammer") }).unwrap();
    let (fast, faithful) = (watch(&fast, 0, 30), watch(&faithful, 0, 30));
    for (a, b) in fast.iter().zip(&faithful) {
        assert_eq!(numbers(a), numbers(b));
    }
    let (fast, faithful) = (&fast[30], &faithful[30]);
    let pairs = || fast.robot_mask.iter().zip(&faithful.robot_mask);
    let both = share(pairs().map(|(a, b)| a & b == 255));
    let any = share(pairs().map(|(a, b)| a | b == 255));
    assert!(both / any > 0.97, "intersection over union {}", both / any);
    let difference: u64 =
        fast.image.iter().zip(&faithful.image).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
    let mean = difference as f64 / fast.image.len() as f64;
    assert!(mean > 0.0 && mean < 20.0, "mean difference of a colour {mean}");
}

#[test]
fn the_picture_is_upright_and_the_mask_covers_the_arm() {
    let environment = Environment::open(settings("reach")).unwrap();
    environment.reset(0).unwrap();
    let (observation, _) = see(&environment);
    let pixel = |x: usize, y: usize| -> [u8; 3] {
        std::array::from_fn(|channel| observation.image[3 * (y * IMAGE_SIDE + x) + channel])
    };
    let [red, green, blue] = pixel(2, 2).map(i32::from);
    assert!((red - blue).abs() < 20 && (green - blue).abs() < 20, "grey sky above, found {:?}", pixel(2, 2));
    let [red, _, blue] = pixel(12, 58).map(i32::from);
    assert!(red - blue > 15, "brown table below, found {:?}", pixel(12, 58));

    assert!(observation.robot_mask.iter().all(|value| matches!(value, 0 | 255)));
    let covered = share(observation.robot_mask.iter().map(|value| *value == 255));
    assert!((0.05..0.4).contains(&covered), "the mask covers {covered}");
    // The arm is red, nothing else in this layout is: every clearly red pixel above the table's middle belongs to it.
    for y in 0..20 {
        for x in 30..IMAGE_SIDE {
            let [red, green, _] = pixel(x, y).map(i32::from);
            let masked = observation.robot_mask[y * IMAGE_SIDE + x] == 255;
            assert!(masked || red - green < 60, "red pixel {x}, {y} is not in the mask");
            assert!(!masked || (x, y) != (2, 2));
        }
    }
}

#[test]
fn the_mask_is_empty_unless_asked_for() {
    let environment = Environment::open(EnvironmentSettings { masks: false, ..settings("reach") }).unwrap();
    assert!(watch(&environment, 0, 1)[1].robot_mask.iter().all(|value| *value == 0));
}

#[test]
fn the_expert_for_reach_arrives_where_three_centimetres_off_are_still_there() {
    let environment = Environment::open(EnvironmentSettings { masks: false, ..settings("reach") }).unwrap();
    for episode in 0..3 {
        environment.reset(episode).unwrap();
        let mut script = Script::new(Policy::Expert, 0, episode);
        for _ in 0..60 {
            environment.step(script.decide(&environment).unwrap().unwrap()).unwrap();
        }
        // A whole action is a centimetre, twice a decision; then the arm comes to rest.
        for sideways in [1.0, 0.5, 0.0, 0.0, 0.0] {
            environment.step([sideways, 0.0, 0.0, 0.0]).unwrap();
        }
        assert!(see(&environment).1, "episode {episode}: the fingers are more than 5 cm from the goal");
    }
}

#[test]
fn the_expert_solves_the_task_and_proprioception_stays_in_range() {
    let environment =
        Environment::open(EnvironmentSettings { masks: false, ..settings("button-press") }).unwrap();
    environment.reset(0).unwrap();
    let mut script = Script::new(Policy::Expert, 0, 0);
    let (mut ever, mut moved) = (false, false);
    for _ in 0..80 {
        environment.step(script.decide(&environment).unwrap().unwrap()).unwrap();
        let (observation, solved) = see(&environment);
        ever |= solved;
        let (positions, velocities) = observation.proprioception.split_at(9);
        assert!(positions.iter().all(|x| x.abs() < 1.1), "joint position out of range: {positions:?}");
        assert!(velocities.iter().all(|x| x.abs() < 30.0), "joint velocity out of range: {velocities:?}");
        moved |= velocities.iter().any(|x| x.abs() > 0.05);
        assert!(
            (0.0..=20.0).contains(&observation.reward),
            "two rewards of at most 10: {}",
            observation.reward
        );
    }
    assert!(ever && moved);
}

#[test]
fn an_episode_has_no_step_beyond_its_last() {
    let environment = Environment::open(EnvironmentSettings { masks: false, ..settings("reach") }).unwrap();
    environment.reset(0).unwrap();
    for _ in 0..STEPS_MAX {
        environment.step([0.0; ACTION_LEN]).unwrap();
    }
    assert!(matches!(environment.step([0.0; ACTION_LEN]), Err(SimulatorError::Python { .. })));
}

fn disturbed(disturb: Disturbance) -> Environment {
    Environment::open(EnvironmentSettings { disturb, ..settings("coffee-pull") }).unwrap()
}

/// Shares of the robot's pixels and of the others that are the same in both.
fn unchanged(a: &Seen, b: &Seen) -> (f64, f64) {
    let pixels = || a.image.chunks(3).zip(b.image.chunks(3)).zip(&a.robot_mask);
    let of = |value: u8| share(pixels().filter(|(_, mask)| **mask == value).map(|((a, b), _)| a == b));
    (of(255), of(0))
}

#[test]
fn disturbances_change_the_picture_but_neither_robot_nor_physics() {
    let plain = watch(&disturbed(Disturbance::None), 1, 3);
    for disturb in [Disturbance::Paper, Disturbance::Surfaces, Disturbance::Textures, Disturbance::Noise] {
        let environment = disturbed(disturb);
        let seen = watch(&environment, 1, 3);
        watch(&environment, 2, 1);
        assert_same(&watch(&environment, 1, 3), &seen);
        for (a, b) in plain.iter().zip(&seen) {
            assert_eq!(numbers(a), numbers(b));
            assert!(a.robot_mask == b.robot_mask);
            let (robot, rest) = unchanged(a, b);
            assert!(
                robot > 0.97 && rest < 0.9,
                "{disturb:?}: unchanged {robot} of the robot, {rest} of the rest"
            );
        }
    }
}

#[test]
fn the_papers_look_is_always_the_same_and_leaves_the_sky() {
    let environment = disturbed(Disturbance::Paper);
    let plain = disturbed(Disturbance::None);
    for episode in 0..2 {
        let (a, b) = (watch(&plain, episode, 1).remove(0), watch(&environment, episode, 1).remove(0));
        let pixel = |seen: &Seen, x: usize, y: usize| -> [u8; 3] {
            seen.image[3 * (y * IMAGE_SIDE + x)..][..3].try_into().unwrap()
        };
        assert_eq!(pixel(&a, 2, 2), pixel(&b, 2, 2), "the sky");
        let ([red, green, blue], [light, ..]) = (pixel(&b, 12, 58), pixel(&a, 12, 58));
        assert!(red > green && green > blue && red < light, "darker wood: {red} {green} {blue}, was {light}");
    }
}

#[test]
fn another_light_leaves_masks_and_physics_and_another_camera_the_physics() {
    let plain = watch(&disturbed(Disturbance::None), 1, 3);
    let light = watch(&disturbed(Disturbance::Light), 1, 3);
    let camera = watch(&disturbed(Disturbance::Camera), 1, 3);
    for ((a, light), camera) in plain.iter().zip(&light).zip(&camera) {
        assert_eq!(numbers(a), numbers(light));
        assert_eq!(numbers(a), numbers(camera));
        assert!(a.robot_mask == light.robot_mask);
        assert!(unchanged(a, light).0 < 0.5, "the robot is lit, too");
        let moved = share(a.robot_mask.iter().zip(&camera.robot_mask).map(|(a, b)| a != b));
        assert!((0.001..0.1).contains(&moved), "{moved} of the mask moved");
    }
}

#[test]
fn no_two_sets_of_layouts_share_one_whatever_the_seeds() {
    // Seeds and numbers whose 32-bit words are each other's.
    let seeds = [(0, 1), (1, 0), (1 << 32, 0), (0, 1 << 32), (2, 3 << 32), (3, 2)];
    let mut seen: Vec<(String, Vec<u8>)> = Vec::new();
    for layouts in [Layouts::Learning, Layouts::Choosing, Layouts::Reporting] {
        for (seed, episode) in seeds {
            let environment = Environment::open(EnvironmentSettings {
                layouts,
                seed,
                masks: false,
                ..settings("button-press")
            })
            .unwrap();
            environment.reset(episode).unwrap();
            let picture = see(&environment).0.image.to_vec();
            let name = format!("{layouts:?} {seed} {episode}");
            let same = seen.iter().find(|(_, other)| *other == picture);
            assert!(same.is_none(), "{name} is {:?}", same.map(|(name, _)| name));
            seen.push((name, picture));
        }
    }
}
