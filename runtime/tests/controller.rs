//! The controller against a real peer on a real link.

use rcwm_models::bundle::BundleKind;
use rcwm_models::wire::{ActionSource, ObservationFlags};
use rcwm_runtime::controller::{Ended, Fallback};
use rcwm_runtime::pacing::PacingSettings;
use rcwm_runtime::telemetry::Stage;
use rcwm_runtime::{EngineSettings, Policy};
use rcwm_testkit::{
    ask, dividing_by_zero, image, observation, own_link, smallest_bundle, start_controller,
    start_controller_with, with_manifest,
};

#[test]
fn every_observation_is_answered_with_what_the_policy_decides() {
    let link = own_link();
    let peer = link.peer();
    let controller = start_controller(&smallest_bundle(), &link, Fallback::Hold);
    let mut policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    for sequence in 0..40 {
        // Two episodes of 20.
        let step = sequence as u32 % 20;
        let mut sent = observation(sequence, step);
        sent.episode = sequence / 20;
        sent.flags |= if step == 19 { ObservationFlags::LAST.0 } else { 0 };
        let action = ask(&peer, &sent);
        let expected =
            policy.observe(&image(step), (step > 0).then_some(&sent.view().executed_action())).unwrap();
        assert_eq!(action.action, expected.action, "sequence {sequence}");
        assert_eq!(action.source, ActionSource::Policy as u32);
    }
    peer.close().unwrap();
    let report = controller.join().unwrap();
    assert_eq!((report.whole_episodes, report.ended), (2, Ended::SimulatorClosed));
    assert_eq!(report.counters.fallback_answers + report.counters.missed_observations, 0);
}

#[test]
fn a_repeated_observation_gets_the_same_answer_without_a_second_tick() {
    let link = own_link();
    let peer = link.peer();
    let controller = start_controller(&smallest_bundle(), &link, Fallback::Hold);
    ask(&peer, &observation(0, 0));
    let first = ask(&peer, &observation(1, 1));
    let mut again = observation(1, 1);
    again.flags |= ObservationFlags::REPEATED.0;
    for _ in 0..3 {
        assert_eq!(ask(&peer, &again).action, first.action);
    }
    peer.close().unwrap();
    let report = controller.join().unwrap();
    let ticks = report.latency.iter().find(|latency| latency.stage == Stage::Actor).unwrap().count;
    assert_eq!(ticks, 2);
    assert!(report.counters.repeated_observations >= 3);
    assert_eq!(report.counters.answers, 2 + report.counters.repeated_observations);
}

#[test]
fn a_stale_observation_is_dropped_and_a_gap_is_counted() {
    let link = own_link();
    let peer = link.peer();
    let controller = start_controller(&smallest_bundle(), &link, Fallback::Hold);
    ask(&peer, &observation(0, 0));
    ask(&peer, &observation(4, 4));
    let stale = observation(2, 2);
    peer.publish_copy(&stale).unwrap();
    // The next answer comes after the stale one was looked at, or replaced it unseen.
    std::thread::sleep(std::time::Duration::from_millis(200));
    ask(&peer, &observation(5, 5));
    peer.close().unwrap();
    let report = controller.join().unwrap();
    assert_eq!(report.counters.missed_observations, 3);
    assert_eq!(report.counters.stale_observations, 1);
    assert_eq!(report.counters.answers, 3 + report.counters.repeated_observations);
}

#[test]
fn an_output_that_is_not_finite_never_reaches_the_wire() {
    for part in BundleKind::Rcwm.parts().iter().copied() {
        let bundle = dividing_by_zero(part);
        let link = own_link();
        let peer = link.peer();
        let controller = start_controller(bundle.path(), &link, Fallback::Hold);
        for sequence in 0..3 {
            let sent = observation(sequence, sequence as u32);
            let action = ask(&peer, &sent);
            let held = (ActionSource::Fallback as u32, sent.view().executed_action());
            assert_eq!((action.source, action.action), held, "{part}");
        }
        peer.close().unwrap();
        let counters = controller.join().unwrap().counters;
        assert_eq!((counters.non_finite_outputs, counters.fallback_answers), (3, 3), "{part}");
    }
}

#[test]
fn an_observation_that_is_not_finite_is_refused_and_the_last_action_held() {
    for (fallback, held) in [(Fallback::Hold, true), (Fallback::Zero, false), (Fallback::Interface, false)] {
        let link = own_link();
        let peer = link.peer();
        let controller = start_controller(&smallest_bundle(), &link, fallback);
        let good = ask(&peer, &observation(0, 0));
        let mut bad = observation(1, 1);
        bad.edit().state()[3] = f32::NAN;
        let answer = ask(&peer, &bad);
        assert_eq!(answer.source, ActionSource::Fallback as u32);
        assert_eq!(answer.action, if held { good.action } else { [0.0; 4].into() });
        assert_eq!(ask(&peer, &observation(2, 2)).source, ActionSource::Policy as u32);
        peer.close().unwrap();
        assert_eq!(controller.join().unwrap().counters.refused_observations, 1);
    }
}

#[test]
fn the_bundle_s_action_limits_hold_for_every_source() {
    let narrow = with_manifest(|manifest| {
        rcwm_testkit::limit(manifest, [0.25, -0.001, -1.0, -1.0], [0.5, 0.001, -0.75, -0.9]);
    });
    let link = own_link();
    let peer = link.peer();
    let controller = start_controller(narrow.path(), &link, Fallback::Zero);
    for sequence in 0..5 {
        let mut sent = observation(sequence, sequence as u32);
        sent.reward = if sequence == 3 { f32::INFINITY } else { 0.0 };
        let action = ask(&peer, &sent).action;
        for (value, (low, high)) in
            action.iter().zip([(0.25, 0.5), (-0.001, 0.001), (-1.0, -0.75), (-1.0, -0.9)])
        {
            assert!((low..=high).contains(value), "sequence {sequence}: {action:?}");
        }
    }
    peer.close().unwrap();
    assert_eq!(controller.join().unwrap().counters.fallback_answers, 1);
}

#[test]
fn a_simulator_that_was_started_again_is_served_from_its_first_observation() {
    let link = own_link();
    let peer = link.peer();
    let controller = start_controller(&smallest_bundle(), &link, Fallback::Hold);
    let first = ask(&peer, &observation(0, 0));
    ask(&peer, &observation(1, 1));
    // Gone without a word.
    drop(peer);
    let peer = link.peer();
    assert_eq!(ask(&peer, &observation(0, 0)).action, first.action);
    peer.close().unwrap();
    let report = controller.join().unwrap();
    assert_eq!((report.counters.peer_restarts, report.counters.stale_observations), (1, 0));
    assert_eq!(report.episodes.len(), 2);
}

#[test]
fn a_late_answer_in_real_time_is_a_missed_deadline() {
    let link = own_link();
    let peer = link.peer();
    // Nothing is overdue or stale here.
    let pacing = PacingSettings { grace_periods: 1e12, stale_periods: 1e12, ..PacingSettings::default() };
    let controller = start_controller_with(&smallest_bundle(), &link, |settings| settings.pacing = pacing);
    // The first lasts a nanosecond: the answer is late even from when it was published. The second lasts 10 s and was due
    // 20 s ago: only the simulator is late. The third is due for ever.
    const LONG_NS: u64 = 10_000_000_000;
    let now = rcwm_models::wire::clock::monotonic_ns();
    for (sequence, (scheduled_ns, period_ns)) in
        [(now, 1), (now.saturating_sub(2 * LONG_NS), LONG_NS), (now, u64::MAX)].into_iter().enumerate()
    {
        let mut sent = observation(sequence as u64, sequence as u32);
        (sent.scheduled_ns, sent.period_ns) = (scheduled_ns, period_ns);
        ask(&peer, &sent);
    }
    peer.close().unwrap();
    let counters = controller.join().unwrap().1.counters;
    assert_eq!((counters.missed_deadlines, counters.missed_deadlines_published_late), (2, 1));
}

#[test]
fn work_ahead_is_done_once_a_tick_and_again_where_another_action_was_executed() {
    let link = own_link();
    let peer = link.peer();
    let controller = start_controller(&smallest_bundle(), &link, Fallback::Hold);
    let mut sent = observation(0, 0);
    for sequence in 1..=10 {
        let answer = ask(&peer, &sent);
        sent = observation(sequence, sequence as u32);
        // Every other time what was asked for is what was executed.
        if sequence % 2 == 0 {
            sent.edit().executed().copy_from_slice(&answer.action);
        }
    }
    ask(&peer, &sent);
    peer.close().unwrap();
    let report = controller.join().unwrap();
    let ahead = report.latency.iter().find(|latency| latency.stage == Stage::Ahead).unwrap().count;
    assert_eq!((ahead, report.counters.recomputed), (11, 5));
}
