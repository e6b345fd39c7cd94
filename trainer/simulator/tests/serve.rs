//! The serving loop with a controller in another thread, over real shared memory.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rcwm_models::ACTION_LEN;
use rcwm_models::wire::{
    Action, ActionSource, ControllerLink, Format, LinkSettings, ObservationFlags, ObserverLink,
    SimulatorLink, Wait,
};
use rcwm_simulator::environment::{Disturbance, Environment, EnvironmentSettings, Layouts};
use rcwm_simulator::policy::Policy;
use rcwm_simulator::report::Tally;
use rcwm_simulator::serve::{Pace, ServeSettings, serve};

/// A controller that gives up after so long has met a defect.
const TIMEOUT: Duration = Duration::from_secs(60);

fn link_settings(instance: &str) -> LinkSettings {
    let prefix = Some(format!("sim{}", std::process::id()));
    LinkSettings { prefix, ..LinkSettings::new(instance) }
}

fn serve_settings(instance: &str) -> ServeSettings {
    ServeSettings {
        instance: instance.to_owned(),
        first_episode: 0,
        episodes: Some(2),
        steps_max: 5,
        pace: Pace::LockStep,
        policy: Policy::Remote,
        silence_max: Some(TIMEOUT),
        snapshots: None,
    }
}

/// Serves reach on this thread while `controller` runs on another.
fn run<T: Send + 'static>(
    settings: &ServeSettings,
    stop: &AtomicBool,
    controller: impl FnOnce(LinkSettings) -> T + Send + 'static,
) -> (Tally, T) {
    let link = SimulatorLink::open(link_settings(&settings.instance), &Format::metaworld()).unwrap();
    let environment = Environment::open(EnvironmentSettings {
        task: "reach".to_owned(),
        layouts: Layouts::Learning,
        seed: 1,
        faithful: false,
        masks: false,
        disturb: Disturbance::None,
    })
    .unwrap();
    let instance = link_settings(&settings.instance);
    let controller: JoinHandle<T> = std::thread::spawn(move || controller(instance));
    let tally = serve(&environment, link, settings, stop, |_, _| {}).unwrap();
    (tally, controller.join().unwrap())
}

mod seen;
use seen::Seen;

fn action(answers: u64, action: [f32; ACTION_LEN]) -> Action {
    Action { answers, published_ns: 0, source: ActionSource::Policy as u32, action: action.into() }
}

fn next(link: &ControllerLink) -> Option<Box<Seen>> {
    let start = Instant::now();
    while start.elapsed() < TIMEOUT {
        match link.wait_observation(Duration::from_millis(100)).unwrap() {
            Wait::Message(observation) => return Some(Box::new(observation.view().into())),
            Wait::TimedOut => {}
            Wait::Closed => return None,
        }
    }
    panic!("no observation came");
}

/// Connects, and waits for the observation that the simulator repeats for a controller that said hello: after it, nothing is
/// repeated but for a silence.
fn meet(settings: LinkSettings) -> (ControllerLink, Box<Seen>) {
    let link = ControllerLink::open(settings, |_| Vec::new()).unwrap();
    let first =
        std::iter::repeat_with(|| next(&link).unwrap()).find(|o| o.is(ObservationFlags::REPEATED)).unwrap();
    (link, first)
}

/// Answers everything with `decide` until the simulator closes; returns what it saw for the first time.
fn answer_all(link: &ControllerLink, decide: impl Fn(&Seen) -> [f32; ACTION_LEN]) -> Vec<Seen> {
    let mut seen: Vec<Seen> = Vec::new();
    while let Some(observation) = next(link) {
        if seen.last().is_none_or(|last| last.sequence != observation.sequence) {
            seen.push(Seen::clone(&observation));
        }
        link.send(&action(observation.sequence, decide(&observation))).unwrap();
    }
    seen
}

fn decision(observation: &Seen) -> [f32; ACTION_LEN] {
    [observation.sequence as f32 / 20.0, -0.5, 3.0, 0.25]
}

#[test]
fn in_lock_step_each_observation_comes_once_with_the_clipped_action_that_answered_the_one_before() {
    let settings = serve_settings("exact");
    let (tally, seen) = run(&settings, &AtomicBool::new(false), |link| {
        answer_all(&ControllerLink::open(link, |_| Vec::new()).unwrap(), decision)
    });
    let places: Vec<_> = seen.iter().map(|o| (o.sequence, o.episode, o.step)).collect();
    let expected: Vec<_> = (0..2).flat_map(|e| (0..6).map(move |s| (6 * e + u64::from(s), e, s))).collect();
    assert_eq!(places, expected);
    for (before, after) in seen.iter().zip(&seen[1..]) {
        let expected =
            if after.step == 0 { [0.0; ACTION_LEN] } else { decision(before).map(|x| x.clamp(-1.0, 1.0)) };
        assert_eq!(after.executed_action, expected);
    }
    for observation in &seen {
        assert_eq!(observation.is(ObservationFlags::FIRST), observation.step == 0);
        assert_eq!(observation.is(ObservationFlags::LAST), observation.step == 5);
        assert!(!observation.is(ObservationFlags::ACTION_HELD) && observation.period_ns == 0);
    }
    assert_eq!((tally.steps, tally.observations, tally.held, tally.refused), (10, 12, 0, 0));
    assert_eq!(tally.episodes.len(), 2);
}

#[test]
fn an_action_that_is_not_finite_is_refused_and_the_last_one_is_held() {
    let settings = ServeSettings { episodes: Some(1), ..serve_settings("finite") };
    let (tally, seen) = run(&settings, &AtomicBool::new(false), |link| {
        answer_all(&ControllerLink::open(link, |_| Vec::new()).unwrap(), |observation| {
            match observation.step {
                0 | 2 => [f32::NAN, 0.0, 0.0, 0.0],
                4 => [0.0, 0.0, f32::INFINITY, 0.0],
                _ => [0.5; ACTION_LEN],
            }
        })
    });
    let executed: Vec<_> =
        seen.iter().map(|o| (o.executed_action[0], o.is(ObservationFlags::ACTION_HELD))).collect();
    assert_eq!(executed, [(0.0, false), (0.0, true), (0.5, false), (0.5, true), (0.5, false), (0.5, true)]);
    assert_eq!((tally.refused, tally.held), (3, 3));
}

#[test]
fn a_controller_that_vanishes_is_followed_by_the_next_one_without_a_lost_step() {
    let settings = serve_settings("next");
    let (tally, (seen, continued)) = run(&settings, &AtomicBool::new(false), |settings| {
        let (first, mut observation) = meet(settings.clone());
        for _ in 0..3 {
            first.send(&action(observation.sequence, decision(&observation))).unwrap();
            observation = next(&first).unwrap();
        }
        let unanswered = observation;
        // Gone without goodbye.
        drop(first);
        let seen = answer_all(&ControllerLink::open(settings, |_| Vec::new()).unwrap(), decision);
        let continued = seen[0].sequence == unanswered.sequence && seen[0].image == unanswered.image;
        (seen, continued)
    });
    assert!(continued, "the new controller must get the observation that was not answered");
    assert_eq!(seen.last().unwrap().sequence, 11);
    assert_eq!((tally.steps, tally.held), (10, 0));
    assert_eq!(tally.controllers_came, 2);
}

#[test]
fn an_answer_to_another_observation_is_dropped_and_counted() {
    let settings = ServeSettings { episodes: Some(1), ..serve_settings("stale") };
    let (tally, ()) = run(&settings, &AtomicBool::new(false), |settings| {
        let (link, first) = meet(settings);
        link.send(&action(first.sequence, [0.0; ACTION_LEN])).unwrap();
        let mut misled = false;
        while let Some(observation) = next(&link) {
            let mislead = observation.step == 2 && !misled;
            misled |= mislead;
            // The observation comes again after a silence, and is answered then.
            let answers = observation.sequence + if mislead { 7 } else { 0 };
            link.send(&action(answers, [0.0; ACTION_LEN])).unwrap();
        }
    });
    assert_eq!((tally.dropped, tally.steps), (1, 5));
    assert!(tally.repeated >= 2, "once for the hello, once after the silence");
}

#[test]
fn in_real_time_a_silent_controller_has_its_last_action_held() {
    let settings = ServeSettings {
        episodes: Some(1),
        steps_max: 8,
        pace: Pace::RealTime { period_ns: 100_000_000 },
        ..serve_settings("held")
    };
    let (tally, seen) = run(&settings, &AtomicBool::new(false), |settings| {
        let link = ControllerLink::open(settings, |_| Vec::new()).unwrap();
        let mut seen = Vec::new();
        while let Some(observation) = next(&link) {
            if observation.step < 3 {
                link.send(&action(observation.sequence, [0.5; ACTION_LEN])).unwrap();
            }
            seen.push(Seen::clone(&observation));
        }
        seen
    });
    let last = seen.last().unwrap();
    assert_eq!((last.step, last.executed_action), (8, [0.5; ACTION_LEN]));
    assert!(last.is(ObservationFlags::ACTION_HELD) && last.period_ns == 100_000_000);
    assert!(tally.held >= 5, "{} held", tally.held);
    assert_eq!(tally.steps, 8);
}

/// In real time, moves until step 2, then does `leave`; gives what was executed step by step until the episode's end.
fn moved_until_left(
    instance: &str,
    period_ns: u64,
    steps_max: u32,
    leave: impl FnOnce(ControllerLink) -> Option<ControllerLink> + Send + 'static,
) -> (Tally, Vec<Seen>) {
    let pace = Pace::RealTime { period_ns };
    let settings = ServeSettings { episodes: Some(1), steps_max, pace, ..serve_settings(instance) };
    run(&settings, &AtomicBool::new(false), move |settings| {
        let watcher = ObserverLink::open(settings.clone()).unwrap();
        let link = ControllerLink::open(settings, |_| Vec::new()).unwrap();
        let mut observation = next(&link).unwrap();
        while observation.step < 2 {
            link.send(&action(observation.sequence, [0.5, -0.5, 0.25, 0.75])).unwrap();
            observation = next(&link).unwrap();
        }
        link.send(&action(observation.sequence, [0.5, -0.5, 0.25, 0.75])).unwrap();
        let left = leave(link);
        let (start, mut seen) = (Instant::now(), Vec::new());
        while start.elapsed() < TIMEOUT {
            match watcher.wait_observation(Duration::from_millis(100)).unwrap() {
                Wait::Message(observation) => seen.push(observation.view().into()),
                Wait::TimedOut => {}
                Wait::Closed => break,
            }
        }
        drop(left);
        seen
    })
}

const AT_REST: [f32; ACTION_LEN] = [0.0, 0.0, 0.0, 0.75];

#[test]
fn in_real_time_the_robot_rests_once_its_controller_has_said_that_it_leaves() {
    let (tally, seen) = moved_until_left("left", 100_000_000, 8, |link| {
        // In time for the present step, so that its answer is executed.
        std::thread::sleep(Duration::from_millis(150));
        link.close().unwrap();
        None
    });
    let last = seen.last().unwrap();
    assert_eq!((last.step, last.executed_action), (8, AT_REST));
    assert!(last.is(ObservationFlags::ACTION_HELD));
    assert!(tally.rested >= 3 && tally.rested <= tally.held, "{} rested, {} held", tally.rested, tally.held);
    assert_eq!(tally.controllers_left, 1);
}

#[test]
fn in_real_time_the_robot_rests_when_its_controller_has_been_silent_for_a_second() {
    // Silent, but there: as one that is stopped, or was killed.
    let (tally, seen) = moved_until_left("silent", 100_000_000, 20, Some);
    let moving = seen.iter().filter(|o| o.is(ObservationFlags::ACTION_HELD) && o.executed_action != AT_REST);
    assert!(moving.count() >= 3, "held at first");
    assert_eq!(seen.last().unwrap().executed_action, AT_REST);
    assert!((1..tally.held).contains(&tally.rested), "{} rested, {} held", tally.rested, tally.held);
}

#[test]
fn a_scripted_policy_in_lock_step_waits_for_a_receipt_and_ignores_its_content() {
    let settings = ServeSettings { policy: Policy::Random, ..serve_settings("receipt") };
    let (_, seen) = run(&settings, &AtomicBool::new(false), |link| {
        answer_all(&ControllerLink::open(link, |_| Vec::new()).unwrap(), |_| [0.125; ACTION_LEN])
    });
    assert_eq!(seen.len(), 12);
    let mut executed = seen.iter().filter(|o| o.step > 0).map(|o| o.executed_action);
    assert!(executed.all(|action| action != [0.125; ACTION_LEN] && action != [0.0; ACTION_LEN]));
}

#[test]
fn a_stop_ends_the_run_and_tells_the_controller() {
    static STOP: AtomicBool = AtomicBool::new(false);
    let settings = ServeSettings { episodes: None, ..serve_settings("stop") };
    let (tally, seen) = run(&settings, &STOP, |link| {
        answer_all(&ControllerLink::open(link, |_| Vec::new()).unwrap(), |observation| {
            STOP.fetch_or(observation.sequence == 8, Ordering::Relaxed);
            [0.0; ACTION_LEN]
        })
    });
    assert!(seen.len() >= 9 && tally.episodes.len() == 1);
}
