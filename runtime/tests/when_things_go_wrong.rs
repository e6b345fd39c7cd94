//! The controller in real time and at its limits, against a real peer on a real link.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rcwm_models::bundle::PartName;
use rcwm_models::wire::{
    Action, ActionSource, ActionValues, ControllerLink, LinkError, ObservationFlags, ObservationSample,
    SimulatorLink, Wait,
};
use rcwm_runtime::controller::{
    Cause, Controller, ControllerError, ControllerSettings, Ended, Fallback, State, SurpriseLimits,
    TickLimits, Transport,
};
use rcwm_runtime::{EngineKind, EngineSettings, Policy};
use rcwm_testkit::{
    NEVER, PERIOD_NS, ask, dividing_by_zero, due_now, image, observation, own_link, smallest_bundle,
    start_controller_with,
};

/// The next action that fits, whatever else comes before it.
fn next(peer: &SimulatorLink, what: &str, fits: impl Fn(&Action) -> bool) -> Action {
    let start = std::time::Instant::now();
    while start.elapsed() < NEVER {
        if let (Wait::Message(action), _) = peer.wait_action(Duration::from_millis(100)).unwrap()
            && fits(&action)
        {
            return action;
        }
    }
    panic!("no {what}");
}

fn is(source: ActionSource) -> impl Fn(&Action) -> bool {
    move |action| action.source == source as u32
}

#[test]
fn missing_observations_are_imagined_then_fallen_back_from_then_borne_in_silence() {
    let link = own_link();
    let peer = link.peer();
    let ticks = TickLimits { imagined_ticks_max: 3, fallback_ticks_max: 2 };
    let controller = start_controller_with(&smallest_bundle(), &link, |settings| {
        (settings.ticks, settings.fallback) = (ticks, Fallback::Zero);
    });
    ask(&peer, &due_now(0));
    let seen = ask(&peer, &due_now(1));
    let imagined = next(&peer, "imagined action", is(ActionSource::Imagined));
    assert!(imagined.answers > seen.answers);
    let fallback = next(&peer, "fallback", is(ActionSource::Fallback));
    assert!(fallback.answers > imagined.answers && fallback.action == [0.0; 4]);
    // Silence: a few periods in which one more fallback may come, and nothing after it.
    std::thread::sleep(Duration::from_nanos(6 * PERIOD_NS));
    peer.poll_action().unwrap();
    let (quiet, _) = peer.wait_action(Duration::from_nanos(3 * PERIOD_NS)).unwrap();
    assert!(matches!(quiet, Wait::TimedOut), "{quiet:?}");
    // It is there again, from where it stood still.
    assert_eq!(ask(&peer, &due_now(2)).source, ActionSource::Policy as u32);
    peer.close().unwrap();
    let (ended, report) = controller.join().unwrap();
    assert_eq!(ended.unwrap(), Ended::SimulatorClosed);
    let counters = report.counters;
    assert_eq!((counters.peers_lost, counters.late_observations), (1, 1), "{counters:?}");
    assert_eq!((counters.imagined_answers, counters.fallback_answers), (3, 2), "{counters:?}");
}

#[test]
fn an_observation_that_comes_after_it_was_imagined_is_answered_as_if_it_had_been_in_time() {
    let link = own_link();
    let peer = link.peer();
    let controller = start_controller_with(&smallest_bundle(), &link, |settings| {
        settings.pacing.stale_periods = 1000.0;
        settings.ticks = TickLimits { imagined_ticks_max: 1000, fallback_ticks_max: 1000 };
    });
    let mut policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    rcwm_testkit::meet(&peer);
    for sequence in 0..6 {
        if sequence == 3 {
            next(&peer, "imagined 3", |action| action.answers == 3 && is(ActionSource::Imagined)(action));
        }
        if sequence == 4 {
            // Some ticks further than it is.
            next(&peer, "imagined 6", |action| action.answers >= 6 && is(ActionSource::Imagined)(action));
        }
        let mut sent = due_now(sequence);
        sent.scheduled_ns -= 1000;
        peer.publish_copy(&sent).unwrap();
        let answers = |action: &Action| action.answers == sequence && is(ActionSource::Policy)(action);
        let answer = next(&peer, "policy's answer", answers);
        let expected =
            policy.observe(&image(sequence as u32), (sequence > 0).then_some(&sent.view().executed_action()));
        assert_eq!(answer.action, expected.unwrap().action, "sequence {sequence}");
    }
    peer.close().unwrap();
    let counters = controller.join().unwrap().1.counters;
    assert!(counters.late_observations >= 2 && counters.stale_observations == 0, "{counters:?}");
}

#[test]
fn a_peer_that_has_lost_the_answer_gets_it_again_whatever_was_imagined_since() {
    let link = own_link();
    let peer = link.peer();
    let ticks = TickLimits { imagined_ticks_max: 2, fallback_ticks_max: 1 };
    let controller = start_controller_with(&smallest_bundle(), &link, |settings| settings.ticks = ticks);
    let mut policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    let first = ask(&peer, &due_now(0));
    assert_eq!(first.action, policy.observe(&image(0), None).unwrap().action);
    next(&peer, "fallback", is(ActionSource::Fallback));
    // The same twice in the link is no reason to go back, the peer that says so is.
    peer.publish_copy(&due_now(0)).unwrap();
    let mut again = due_now(0);
    again.flags |= ObservationFlags::REPEATED.0;
    let answer = ask(&peer, &again);
    assert_eq!((answer.action, answer.source), (first.action, ActionSource::Policy as u32));
    let sent = due_now(1);
    peer.publish_copy(&sent).unwrap();
    let answer =
        next(&peer, "policy's answer", |action| action.answers == 1 && is(ActionSource::Policy)(action));
    assert_eq!(
        answer.action,
        policy.observe(&image(1), Some(&sent.view().executed_action())).unwrap().action
    );
    peer.close().unwrap();
    controller.join().unwrap().0.unwrap();
}

#[test]
fn an_answer_that_the_robot_is_too_far_from_by_now_is_the_same_whenever_it_is_asked_for_again() {
    let link = own_link();
    let peer = link.peer();
    let controller = start_controller_with(&smallest_bundle(), &link, |settings| {
        (settings.rate_max, settings.fallback) = (Some(0.01), Fallback::Given([1.0; 4].into()));
        settings.ticks = TickLimits { imagined_ticks_max: 0, fallback_ticks_max: 1000 };
    });
    let first = ask(&peer, &due_now(0)).action;
    // Two fallbacks further than the first answer is.
    let executed = next(&peer, "fallback", |action| action.action[0] > first[0] + 0.015).action;
    let again = || {
        let mut again = due_now(0);
        again.edit().executed().copy_from_slice(&executed);
        again.flags |= ObservationFlags::REPEATED.0;
        ask(&peer, &again).action
    };
    let second = again();
    assert!(second[0] > first[0], "{second:?} is nearer to {executed:?} than {first:?}");
    assert_eq!((again(), again()), (second, second));
    peer.close().unwrap();
    controller.join().unwrap().0.unwrap();
}

/// A link on which the peer says once more where it stands, just before a stand-in would be sent, and does so a few times.
struct JustInTime {
    link: ControllerLink,
    peer: SimulatorLink,
    times: Cell<u64>,
    /// The controller has just looked and found nothing: when it looks again it has something to send.
    found_nothing: Cell<bool>,
    stop: Arc<AtomicBool>,
}

impl JustInTime {
    const TIMES: u64 = 3;
}

impl Transport for JustInTime {
    fn now_ns(&self) -> u64 {
        Transport::now_ns(&self.link)
    }

    fn wait(&self, spin: Duration, timeout: Duration) -> Result<Wait<ObservationSample>, LinkError> {
        self.found_nothing.set(false);
        Transport::wait(&self.link, spin, timeout)
    }

    fn poll(&self) -> Result<Option<ObservationSample>, LinkError> {
        if self.found_nothing.get() {
            let mut again = due_now(0);
            again.flags |= ObservationFlags::REPEATED.0;
            self.peer.publish_copy(&again)?;
            self.times.update(|times| times + 1);
            self.stop.store(self.times.get() > Self::TIMES, Ordering::Relaxed);
        }
        let found = Transport::poll(&self.link)?;
        self.found_nothing.set(found.is_none());
        Ok(found)
    }

    fn send(&self, action: &Action) -> Result<u64, LinkError> {
        Transport::send(&self.link, action)
    }

    fn hello(&self) -> Result<(), LinkError> {
        Transport::hello(&self.link)
    }

    fn clean_up_dead_peers(&self) {
        Transport::clean_up_dead_peers(&self.link);
    }

    fn say_closed(&self) -> Result<(), LinkError> {
        Transport::say_closed(&self.link)
    }
}

#[test]
fn a_peer_that_says_where_it_stands_before_a_stand_in_is_sent_is_gone_back_to_as_well() {
    let own = own_link();
    let stop = Arc::<AtomicBool>::default();
    let link = ControllerLink::open(own.0.clone(), |_| Vec::new()).unwrap();
    let (peer, found_nothing) = (own.peer(), Cell::new(false));
    link.wait_robot(NEVER).unwrap().unwrap();
    peer.publish_copy(&due_now(0)).unwrap();
    let stage = JustInTime { link, peer, times: Cell::new(0), found_nothing, stop: Arc::clone(&stop) };
    let policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    let settings = ControllerSettings::new(own.0.clone());
    let mut controller = Controller::on(Box::new(stage), policy, settings).unwrap();
    let ended = controller.run(&stop, &mut []).unwrap();
    let counters = controller.report(EngineKind::Tract, ended).counters;
    assert_eq!((counters.answers, counters.imagined_answers), (1 + JustInTime::TIMES, 0), "{counters:?}");
    assert_eq!(counters.late_observations, JustInTime::TIMES, "{counters:?}");
}

#[test]
fn an_observation_that_was_due_long_ago_is_dropped_and_counted() {
    let link = own_link();
    let peer = link.peer();
    let controller = start_controller_with(&smallest_bundle(), &link, |_| {});
    ask(&peer, &due_now(0));
    let mut old = due_now(1);
    old.scheduled_ns -= 3 * PERIOD_NS;
    peer.publish_copy(&old).unwrap();
    next(&peer, "imagined action", is(ActionSource::Imagined));
    let answer = ask(&peer, &due_now(9));
    assert_eq!(answer.source, ActionSource::Policy as u32);
    peer.close().unwrap();
    let counters = controller.join().unwrap().1.counters;
    assert_eq!((counters.stale_observations, counters.observations), (1, 3), "{counters:?}");
}

#[test]
fn in_lock_step_nothing_is_overdue() {
    let link = own_link();
    let peer = link.peer();
    let controller = start_controller_with(&smallest_bundle(), &link, |_| {});
    ask(&peer, &observation(0, 0));
    std::thread::sleep(Duration::from_millis(300));
    ask(&peer, &observation(1, 1));
    peer.close().unwrap();
    let counters = controller.join().unwrap().1.counters;
    assert_eq!((counters.imagined_answers, counters.fallback_answers), (0, 0));
}

#[test]
fn a_policy_that_is_invalid_for_too_long_stops_the_run_and_says_why() {
    let bundle = dividing_by_zero(PartName::Actor);
    let link = own_link();
    let peer = link.peer();
    let ticks = TickLimits { fallback_ticks_max: 3, ..TickLimits::default() };
    let controller = start_controller_with(bundle.path(), &link, |settings| settings.ticks = ticks);
    for sequence in 0..3 {
        assert_eq!(ask(&peer, &observation(sequence, sequence as u32)).source, ActionSource::Fallback as u32);
    }
    peer.publish_copy(&observation(3, 3)).unwrap();
    let (ended, report) = controller.join().unwrap();
    assert!(matches!(ended, Err(ControllerError::Stopped { cause: Cause::Output, ticks: 3 })), "{ended:?}");
    assert_eq!((report.ended, report.last_state), (Ended::Stopped, State::Stopped { cause: Cause::Output }));
    assert_eq!(report.counters.answers, 3);
}

#[test]
fn a_surprise_over_its_limit_is_answered_by_the_fallback_except_at_an_episode_s_first_image() {
    let none = SurpriseLimits::default();
    for (surprise, cause) in [
        (SurpriseLimits { robot_max: Some(0.0), ..none }, Cause::RobotSurprise),
        (SurpriseLimits { environment_max: Some(0.0), ..none }, Cause::EnvironmentSurprise),
    ] {
        let link = own_link();
        let peer = link.peer();
        let controller =
            start_controller_with(&smallest_bundle(), &link, |settings| settings.surprise = surprise);
        assert_eq!(ask(&peer, &observation(0, 0)).source, ActionSource::Policy as u32);
        for sequence in 1..5 {
            let answer = ask(&peer, &observation(sequence, sequence as u32));
            assert_eq!(answer.source, ActionSource::Fallback as u32);
        }
        peer.close().unwrap();
        let report = controller.join().unwrap().1;
        let robots = if cause == Cause::RobotSurprise { 4 } else { 0 };
        let counters = report.counters;
        assert_eq!((counters.robot_surprises, counters.environment_surprises), (robots, 4 - robots));
        assert_eq!(report.last_state, State::Fallback { ticks: 4, cause });
        assert!(report.surprise.is_some_and(|surprise| surprise.count == 4));
    }
}

#[test]
fn the_rate_limit_holds_between_any_two_actions_on_the_wire() {
    let link = own_link();
    let peer = link.peer();
    let controller = start_controller_with(&smallest_bundle(), &link, |settings| {
        (settings.rate_max, settings.fallback) = (Some(0.01), Fallback::Given([1.0, -1.0, 1.0, -1.0].into()));
    });
    let mut last = ActionValues::zeros(4);
    for sequence in 0..20 {
        let mut sent = observation(sequence, sequence as u32);
        sent.reward = if sequence % 5 == 4 { f32::NAN } else { 0.0 };
        sent.edit().executed().copy_from_slice(&last);
        let answer = ask(&peer, &sent).action;
        assert!(
            answer.iter().zip(last.iter()).all(|(a, b)| (a - b).abs() <= 0.01 + 1e-6),
            "{answer:?} after {last:?}"
        );
        last = answer;
    }
    peer.close().unwrap();
    assert!(controller.join().unwrap().1.counters.rate_limited >= 4);
}

#[test]
fn a_peer_that_is_silent_for_too_long_ends_the_run() {
    let link = own_link();
    let peer = link.peer();
    let controller = start_controller_with(&smallest_bundle(), &link, |settings| {
        settings.silence_max = Some(Duration::from_millis(300));
    });
    ask(&peer, &observation(0, 0));
    let (ended, report) = controller.join().unwrap();
    assert!(matches!(ended, Err(ControllerError::PeerLost { .. })), "{ended:?}");
    assert_eq!(report.ended, Ended::PeerLost);
}
