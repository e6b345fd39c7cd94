//! What reaches a robot, and that it is told when nothing more will, whatever its peer or the program itself does.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use rcwm_models::bundle::{ActionMode, Bundle};
use rcwm_models::wire::{ActionSource, ActionValues, ControllerLink, OwnedObservation, SimulatorLink, Wait};
use rcwm_runtime::controller::{
    Controller, ControllerError, ControllerSettings, Ended, Fallback, Tick, TickLimits, TickObserver,
};
use rcwm_runtime::policy::{Sampling, SurpriseLimits};
use rcwm_runtime::swap::{self, Answer, SwapSettings, Swapper, When};
use rcwm_runtime::{EngineKind, EngineSettings, Policy};
use rcwm_testkit::{
    NEVER, PERIOD_NS, ask, due_now, observation, own_link, smallest_bundle, start_changed,
    start_controller_with, with_manifest,
};

/// Publishes an observation of a fixed clock until it is answered, anew each time: one that a slow machine has made stale is not.
fn ask_now(peer: &SimulatorLink, sequence: u64, change: impl Fn(&mut OwnedObservation)) {
    let start = Instant::now();
    while start.elapsed() < NEVER {
        let mut now = due_now(sequence);
        change(&mut now);
        peer.publish_copy(&now).unwrap();
        if let (Wait::Message(action), _) = peer.wait_action(Duration::from_millis(100)).unwrap()
            && action.answers == sequence
        {
            return;
        }
    }
    panic!("observation {sequence} was not answered");
}

fn executed(sequence: u64, action: impl Into<ActionValues>) -> OwnedObservation {
    let mut observation = observation(sequence, sequence as u32);
    observation.edit().executed().copy_from_slice(&action.into());
    observation
}

/// Waits until the controller has said that it closes.
fn hears_closed(peer: &SimulatorLink) -> bool {
    let start = Instant::now();
    while start.elapsed() < NEVER {
        if peer.wait_action(Duration::from_millis(50)).unwrap().1.closed {
            return true;
        }
    }
    false
}

/// A bundle whose actions are absolute positions.
fn absolute() -> tempfile::TempDir {
    with_manifest(|manifest| rcwm_testkit::set_mode(manifest, ActionMode::Absolute))
}

struct Panicking;

impl TickObserver for Panicking {
    fn ticked(&mut self, tick: &Tick<'_>) {
        assert!(tick.answer.answers < 2, "on purpose, at the third tick");
    }
}

#[test]
fn a_panic_in_the_loop_tells_the_robot_and_is_an_error_that_says_where() {
    let link = own_link();
    let peer = link.peer();
    let policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    let controller = start_changed(
        policy,
        &link,
        |_| {},
        |controller| {
            let ended = controller.run(&AtomicBool::new(false), &mut [&mut Panicking]);
            // The link is open still: what the peer hears is no consequence of its end.
            std::thread::sleep(Duration::from_millis(300));
            ended
        },
    );
    for sequence in 0..3 {
        ask(&peer, &observation(sequence, sequence as u32));
    }
    assert!(hears_closed(&peer));
    let error = controller.join().unwrap().unwrap_err();
    let said = error.to_string();
    assert!(matches!(error, ControllerError::Panicked(_)), "{said}");
    assert!(said.contains("on purpose") && said.contains("safety.rs:"), "{said}");
    assert_eq!(Ended::from(&error), Ended::Failed);
}

#[test]
fn a_controller_that_ends_before_its_loop_begins_tells_the_robot_too() {
    let link = own_link();
    let peer = link.peer();
    let policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    let own = ControllerLink::open(link.0.clone(), |_| Vec::new()).unwrap();
    peer.poll_events().unwrap();
    assert!(own.wait_robot(Duration::from_secs(5)).unwrap().is_some());
    drop(Controller::on(Box::new(own), policy, ControllerSettings::new(link.0.clone())).unwrap());
    assert!(hears_closed(&peer));
}

#[test]
fn a_sequence_of_any_size_is_counted_without_an_overflow() {
    let link = own_link();
    let peer = link.peer();
    // However slow the machine is, nothing here is stale.
    let controller =
        start_controller_with(&smallest_bundle(), &link, |settings| settings.pacing.stale_periods = 1e6);
    let late = |sequence: u64| {
        let mut late = due_now(sequence);
        late.scheduled_ns -= PERIOD_NS * 3 / 2;
        late
    };
    ask(&peer, &late(0));
    let mut last = late(u64::MAX);
    (last.step, last.flags) = (1, 0);
    let answer = ask(&peer, &last);
    assert_eq!(answer.source, ActionSource::Policy as u32);
    // Nothing can follow it but another publisher.
    drop(peer);
    let peer = link.peer();
    ask(&peer, &late(3));
    ask(&peer, &late(u64::MAX - 1));
    peer.close().unwrap();
    let (ended, report) = controller.join().unwrap();
    ended.unwrap();
    assert_eq!(report.counters.missed_observations, u64::MAX, "{:?}", report.counters);
}

#[test]
fn stale_observations_in_any_number_do_not_keep_a_stand_in_from_being_sent() {
    let link = own_link();
    let peer = link.peer();
    let ticks = TickLimits { imagined_ticks_max: 3, fallback_ticks_max: 2 };
    let controller = start_controller_with(&smallest_bundle(), &link, |settings| settings.ticks = ticks);
    ask_now(&peer, 0, |_| {});
    ask_now(&peer, 5, |_| {});
    let (start, mut by_turns, mut fell_back) = (Instant::now(), false, false);
    while start.elapsed() < NEVER && !fell_back {
        // By turns one of an older number, and one that was due too long ago.
        by_turns = !by_turns;
        let mut stale = due_now(if by_turns { 1 } else { 6 });
        stale.scheduled_ns -= if by_turns { 0 } else { 10 * PERIOD_NS };
        peer.publish_copy(&stale).unwrap();
        if let (Wait::Message(action), _) = peer.wait_action(Duration::from_micros(300)).unwrap() {
            fell_back = action.source == ActionSource::Fallback as u32;
        }
    }
    peer.close().unwrap();
    let counters = controller.join().unwrap().1.counters;
    assert!(fell_back && counters.imagined_answers >= 3, "{counters:?}");
    assert!(counters.overtaken_answers == 0 && counters.stale_observations > 0, "{counters:?}");
}

#[test]
fn a_clock_that_is_ahead_keeps_nothing_from_being_imagined_and_is_counted() {
    const AHEAD_NS: u64 = 600_000_000_000;
    let link = own_link();
    let peer = link.peer();
    let controller = start_controller_with(&smallest_bundle(), &link, |_| {});
    for sequence in 0..2 {
        ask_now(&peer, sequence, |seen| seen.scheduled_ns += AHEAD_NS);
    }
    let start = Instant::now();
    let imagined = loop {
        assert!(start.elapsed() < NEVER, "nothing was imagined");
        if let (Wait::Message(action), _) = peer.wait_action(Duration::from_millis(100)).unwrap()
            && action.source == ActionSource::Imagined as u32
        {
            break action;
        }
    };
    assert!(imagined.answers >= 2, "{imagined:?}");
    peer.close().unwrap();
    let report = controller.join().unwrap().1;
    assert!(report.counters.clock_ahead >= 2, "{:?}", report.counters);
    assert!(report.summary().contains("clock is ahead"), "{}", report.summary());
}

#[test]
fn an_executed_action_out_of_range_is_refused_like_one_that_is_not_finite() {
    for bad in [3e38, -1.5, f32::INFINITY, f32::NAN] {
        let link = own_link();
        let peer = link.peer();
        let controller = start_controller_with(&smallest_bundle(), &link, |settings| {
            settings.fallback = Fallback::Hold;
        });
        let good = ask(&peer, &observation(0, 0));
        let answer = ask(&peer, &executed(1, [0.1, bad, 0.1, 0.1]));
        assert_eq!((answer.source, answer.action), (ActionSource::Fallback as u32, good.action), "{bad}");
        peer.close().unwrap();
        assert_eq!(controller.join().unwrap().1.counters.refused_observations, 1, "{bad}");
    }
}

#[test]
fn a_controller_that_joins_an_episode_moves_from_what_was_executed() {
    const EXECUTED: [f32; 4] = [0.9, -0.9, 0.9, -0.9];
    let link = own_link();
    let peer = link.peer();
    let controller =
        start_controller_with(&smallest_bundle(), &link, |settings| settings.rate_max = Some(0.05));
    let answer = ask(&peer, &executed(41, EXECUTED)).action;
    assert!(answer.iter().zip(EXECUTED).all(|(a, b)| (a - b).abs() <= 0.05 + 1e-6), "{answer:?}");
    // And from what was executed in place of what was sent, from then on.
    let elsewhere = [0.0, 0.4, -0.4, 0.0];
    let answer = ask(&peer, &executed(42, elsewhere)).action;
    assert!(answer.iter().zip(elsewhere).all(|(a, b)| (a - b).abs() <= 0.05 + 1e-6), "{answer:?}");
    peer.close().unwrap();
    controller.join().unwrap().0.unwrap();
}

#[test]
fn what_was_executed_is_held_where_the_policy_has_nothing_fit_to_send() {
    // A surprise over its limit at every tick but the first: the observation is sound, the policy is not asked.
    for mode in [ActionMode::Delta, ActionMode::Velocity, ActionMode::Absolute] {
        let bundle = with_manifest(|manifest| rcwm_testkit::set_mode(manifest, mode));
        let link = own_link();
        let peer = link.peer_of(bundle.path());
        let controller = start_controller_with(bundle.path(), &link, |settings| {
            settings.surprise.robot_max = Some(0.0);
            settings.fallback = Fallback::Hold;
        });
        ask(&peer, &observation(0, 0));
        for (sequence, action) in [(1, [0.7, -0.6, 0.5, 0.4]), (2, [0.2, 0.2, -0.2, 1.0])] {
            let answer = ask(&peer, &executed(sequence, action));
            assert_eq!(
                (answer.source, answer.action),
                (ActionSource::Fallback as u32, action.into()),
                "{mode:?}"
            );
        }
        peer.close().unwrap();
        controller.join().unwrap().0.unwrap();
    }
}

#[test]
fn a_position_is_held_across_episodes_and_never_replaced_by_zeros() {
    const HELD: [f32; 4] = [0.8, -0.7, 0.6, 0.5];
    let (link, bundle) = (own_link(), absolute());
    let peer = link.peer_of(bundle.path());
    let controller = start_controller_with(bundle.path(), &link, |_| {});
    let mut refused = executed(0, [0.0; 4]);
    refused.reward = f32::NAN;
    // Nothing is known yet: nothing is sent, and the robot stays where it is.
    let start = Instant::now();
    while start.elapsed() < Duration::from_millis(600) {
        peer.publish_copy(&refused).unwrap();
        let (wait, _) = peer.wait_action(Duration::from_millis(50)).unwrap();
        assert!(!matches!(wait, Wait::Message(_)), "{wait:?}");
    }
    ask(&peer, &executed(1, HELD));
    let mut refused = executed(2, HELD);
    refused.edit().state()[0] = f32::NAN;
    let held = ask(&peer, &refused).action;
    // The next episode begins with an observation that cannot be used, and zeros for an action that there was not.
    let mut first = executed(3, [0.0; 4]);
    (first.episode, first.step, first.flags) = (1, 0, rcwm_models::wire::ObservationFlags::FIRST.0);
    first.reward = f32::INFINITY;
    let answer = ask(&peer, &first);
    assert_eq!((answer.source, answer.action), (ActionSource::Fallback as u32, held));
    assert_ne!(held, [0.0; 4]);
    peer.close().unwrap();
    let report = controller.join().unwrap().1;
    assert!(report.counters.withheld_answers >= 1, "{:?}", report.counters);
    assert!(report.summary().contains("withheld"), "{}", report.summary());
}

#[test]
fn zeros_as_a_fallback_are_refused_for_positions_with_a_line_that_says_what_to_do() {
    let (link, bundle) = (own_link(), absolute());
    let policy = Policy::load(bundle.path(), EngineSettings::tract()).unwrap();
    let settings = ControllerSettings { fallback: Fallback::Zero, ..ControllerSettings::new(link.0.clone()) };
    let error = Controller::open(policy, settings).err().unwrap();
    assert!(matches!(error, ControllerError::ZeroIsAPose) && error.to_string().contains("hold"), "{error}");
    // Nor is a pose that the robot may not take, which its limits would make another one of.
    let policy = Policy::load(bundle.path(), EngineSettings::tract()).unwrap();
    let fallback = Fallback::Given([0.0, 1.5, 0.0, 0.0].into());
    let settings = ControllerSettings { fallback, ..ControllerSettings::new(link.0.clone()) };
    let error = Controller::open(policy, settings).err().unwrap().to_string();
    assert!(error.contains("number 2 is 1.5") && error.contains("-1 to 1"), "{error}");
}

#[test]
fn limits_of_a_policy_beyond_those_of_its_robot_are_refused() {
    for (low, high) in [(-100.0, 100.0), (-1.0, 1.5), (-1.01, 0.0), (f32::NEG_INFINITY, 0.0), (0.5, 0.5)] {
        let wide = with_manifest(|manifest| {
            rcwm_testkit::limit(manifest, [-1.0, -1.0, low, -1.0], [1.0, 1.0, high, 1.0]);
        });
        let error = Bundle::open(wide.path()).err().unwrap().to_string();
        assert!(error.contains("policy.limits") && error.contains("-1 to 1"), "{low} to {high}: {error}");
    }
}

#[test]
fn limits_are_last_right_after_a_swap_under_a_rate_limit() {
    const NARROW: f32 = 0.2;
    let narrow = with_manifest(|manifest| {
        rcwm_testkit::limit(manifest, [-NARROW; 4], [NARROW; 4]);
    });
    let link = own_link();
    let peer = link.peer();
    let policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    let (engine, interface) = (EngineSettings::tract(), policy.manifest().interface.clone());
    let server = SwapSettings {
        link: link.0.clone(),
        engine,
        sampling: Sampling::Mode,
        interface,
        surprise: SurpriseLimits::default(),
    };
    let limit = |settings: &mut ControllerSettings| settings.rate_max = Some(0.05);
    let controller = start_changed(policy, &link, limit, move |controller| {
        controller.take_swaps(Swapper::start(server).unwrap());
        let ended = controller.run(&AtomicBool::new(false), &mut []).unwrap();
        controller.report(EngineKind::Tract, ended)
    });
    let last = ask(&peer, &executed(0, [0.9, -0.9, 0.9, -0.9])).action;
    assert!(last.iter().all(|value| value.abs() > NARROW), "{last:?}");
    let (link_settings, folder) = (link.0.clone(), narrow.path().to_path_buf());
    let no_stop = AtomicBool::new(false);
    let answer = swap::ask(&link_settings, &folder, When::Now, None, &no_stop, &mut |_| {}).unwrap();
    assert!(matches!(answer, Answer::Taken { .. }), "{answer:?}");
    let mut next = last;
    for sequence in 1..6 {
        let mut sent = executed(sequence, next);
        // The fallback's actions are under the same limits.
        sent.reward = if sequence % 2 == 0 { f32::NAN } else { 0.0 };
        next = ask(&peer, &sent).action;
        assert!(next.iter().all(|value| value.abs() <= NARROW), "{sequence}: {next:?}");
    }
    peer.close().unwrap();
    assert_eq!(controller.join().unwrap().counters.swaps, 1);
}
