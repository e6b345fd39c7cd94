//! That the judge objects, and to what.

use std::time::Duration;

use rcwm_models::ACTION_LEN;
use rcwm_models::interface::Safe;
use rcwm_models::wire::{ACTION_NUMBERS_MAX, ActionSource, Format, OwnedObservation};
use rcwm_runtime::controller::{Fallback, SurpriseLimits, TickLimits};
use rcwm_runtime::pacing::PacingSettings;
use rcwm_runtime::policy::ActionLimits;

use super::due::LOOKS_MAX;
use super::*;

const PERIOD_NS: u64 = 1_000_000;
fn limits(low: f32, high: f32) -> ActionLimits {
    let all = |x: f32| [x; ACTION_LEN].into();
    ActionLimits {
        low: all(low),
        high: all(high),
        rate_max: all(f32::INFINITY),
        absolute: 0,
        half_range: all(1.0),
        safe: [Safe::Hold; ACTION_NUMBERS_MAX],
    }
}

fn setup() -> Setup {
    Setup {
        period_ns: PERIOD_NS,
        rate_max: None,
        fallback: Fallback::Hold,
        ticks: TickLimits { imagined_ticks_max: 1, fallback_ticks_max: 2 },
        pacing: PacingSettings::default(),
        surprise: SurpriseLimits::default(),
        stay: true,
        episodes_max: None,
        silence_max: None::<Duration>,
        bundle: 0,
        sampling: None,
        stalls: false,
        deaf: false,
    }
}

fn known(limits: ActionLimits) -> Known {
    Known { limits, is_sound: true, is_absolute: false }
}

fn judge(setup: Setup) -> Judge {
    Judge::new(setup, known(limits(-0.5, 0.5)), Vec::new())
}

/// When a message of this sequence is published.
fn at_ns(sequence: u64) -> u64 {
    sequence * PERIOD_NS
}

fn message(sequence: u64) -> OwnedObservation {
    let mut message = OwnedObservation::zeroed(&Format::metaworld());
    (message.sequence, message.period_ns) = (sequence, PERIOD_NS);
    (message.scheduled_ns, message.published_ns) = (at_ns(sequence), at_ns(sequence));
    message
}

fn hear(judge: &mut Judge, message: &OwnedObservation) {
    judge.received(Heard::new(1, &message.view(), at_ns(message.sequence)), false);
}

fn action(answers: u64, source: ActionSource, value: f32) -> Action {
    Action { answers, published_ns: 0, source: source as u32, action: [value; ACTION_LEN].into() }
}

fn send(judge: &mut Judge, action: Action, now_ns: u64) {
    judge.looked(now_ns);
    judge.sent(&action, None, now_ns);
}

/// Message 1 and its answer, then whatever follows.
fn after_one(setup: Setup, then: impl FnOnce(&mut Judge)) -> Option<&'static str> {
    let mut judge = judge(setup);
    hear(&mut judge, &message(1));
    send(&mut judge, action(1, ActionSource::Policy, 0.1), at_ns(1));
    assert!(judge.violation.is_none(), "{:?}", judge.violation);
    then(&mut judge);
    judge.violation.map(|violation| violation.kind)
}

fn answer_to_two(value: f32, change: impl FnOnce(&mut Setup, &mut OwnedObservation)) -> Option<&'static str> {
    let (mut setup, mut second) = (setup(), message(2));
    change(&mut setup, &mut second);
    after_one(setup, |judge| {
        hear(judge, &second);
        send(judge, action(2, ActionSource::Policy, value), at_ns(2));
    })
}

#[test]
fn a_good_answer_is_none_of_its_business() {
    assert_eq!(answer_to_two(0.4, |_, _| {}), None);
    assert_eq!(answer_to_two(0.4, |setup, _| setup.rate_max = Some(0.3)), None);
}

#[test]
fn numbers_that_are_none_or_out_of_limits_are_seen() {
    assert_eq!(answer_to_two(f32::NAN, |_, _| {}), Some("not finite"));
    assert_eq!(answer_to_two(0.6, |_, _| {}), Some("out of limits"));
    assert_eq!(answer_to_two(0.4, |setup, _| setup.rate_max = Some(0.1)), Some("rate"));
}

#[test]
fn the_new_limits_hold_from_a_swap_on_whatever_the_rate_limit_says() {
    let narrow = limits(0.3, 0.4);
    let after_swap = |value| {
        after_one(Setup { rate_max: Some(0.1), ..setup() }, |judge| {
            judge.runs_with(known(narrow));
            hear(judge, &message(2));
            send(judge, action(2, ActionSource::Policy, value), at_ns(2));
        })
    };
    assert_eq!(after_swap(0.15), Some("out of limits"));
    assert_eq!(after_swap(0.3), None);
}

#[test]
fn what_cannot_be_the_policy_s_is_not_marked_so() {
    assert_eq!(answer_to_two(0.1, |_, second| second.reward = f32::NAN), Some("marked"));
    assert_eq!(answer_to_two(0.1, |_, second| second.edit().executed()[0] = 3e38), Some("marked"));
    let fallback = after_one(setup(), |judge| {
        hear(judge, &message(2));
        send(judge, action(2, ActionSource::Fallback, 0.1), at_ns(2));
    });
    assert_eq!(fallback, Some("marked"));
}

#[test]
fn a_fallback_is_the_one_that_was_asked_for() {
    let held = |value| {
        after_one(setup(), |judge| {
            let mut second = message(2);
            second.reward = f32::NAN;
            second.edit().executed().fill(0.1);
            hear(judge, &second);
            send(judge, action(2, ActionSource::Fallback, value), at_ns(2));
        })
    };
    assert_eq!((held(0.1), held(0.0)), (None, Some("fallback")));
}

#[test]
fn a_fallback_that_was_given_is_sent_as_far_as_the_limits_allow_even_where_no_position_is_known() {
    let sent = |value| {
        let setup =
            Setup { fallback: Fallback::Given([0.9; ACTION_LEN].into()), rate_max: Some(0.1), ..setup() };
        let mut judge =
            Judge::new(setup, Known { is_absolute: true, ..known(limits(-0.5, 0.5)) }, Vec::new());
        let mut refused = message(1);
        refused.edit().executed().fill(3e38);
        hear(&mut judge, &refused);
        send(&mut judge, action(1, ActionSource::Fallback, value), at_ns(1));
        judge.violation.map(|violation| violation.kind)
    };
    assert_eq!((sent(0.5), sent(0.4)), (None, Some("fallback")));
}

#[test]
fn an_answer_to_anything_but_the_newest_message_is_stale() {
    let stale = after_one(setup(), |judge| {
        hear(judge, &message(3));
        send(judge, action(1, ActionSource::Policy, 0.1), at_ns(3));
    });
    assert_eq!(stale, Some("stale"));
    let overtaken = after_one(setup(), |judge| {
        hear(judge, &message(2));
        let newer = Heard::new(1, &message(4).view(), 0);
        judge.looked(at_ns(2));
        judge.looked(at_ns(4));
        judge.sent(&action(2, ActionSource::Policy, 0.1), Some(&newer), at_ns(4));
    });
    assert_eq!(overtaken, Some("overtaken"));
}

#[test]
fn what_comes_after_the_controller_has_looked_whether_it_is_overtaken_cannot_be_known() {
    let overtaken_by = |came_ns: u64| {
        after_one(setup(), |judge| {
            hear(judge, &message(2));
            judge.looked(at_ns(2));
            judge.looked(at_ns(3) + 1);
            judge.looks_at_link(at_ns(3) + 2, false);
            let newer = Heard::new(1, &message(4).view(), came_ns);
            judge.sent(&action(2, ActionSource::Policy, 0.1), Some(&newer), at_ns(3) + 9);
        })
    };
    assert_eq!(overtaken_by(at_ns(3) + 2), Some("overtaken"));
    assert_eq!(overtaken_by(at_ns(3) + 3), None);
}

#[test]
fn each_of_those_that_may_have_turned_stale_may_be_the_one_that_is_answered() {
    let answered = |sequence| {
        after_one(setup(), |judge| {
            let mut older = message(2);
            (older.scheduled_ns, older.published_ns) = (at_ns(5), at_ns(5));
            hear(judge, &message(4));
            hear(judge, &message(3));
            judge.received(Heard::new(1, &older.view(), at_ns(6) + 1), true);
            send(judge, action(sequence, ActionSource::Policy, 0.1), at_ns(6) + 2);
        })
    };
    assert_eq!((answered(2), answered(4)), (None, None));
    assert_eq!(answered(3), Some("marked"), "4 was there, and fresh");
}

#[test]
fn a_message_that_comes_again_is_answered_as_it_was_last() {
    let answered = |values: [f32; 2]| {
        after_one(Setup { rate_max: Some(0.1), ..setup() }, |judge| {
            send(judge, action(2, ActionSource::Imagined, 0.2), at_ns(3));
            let mut again = message(1);
            again.edit().executed().fill(0.4);
            for value in values {
                hear(judge, &again);
                send(judge, action(1, ActionSource::Policy, value), at_ns(3));
            }
        })
    };
    assert_eq!(answered([0.3, 0.3]), None, "as near to the first answer as it may be");
    assert_eq!(answered([0.3, 0.1]), Some("another answer"));
    assert_eq!(answered([0.25, 0.25]), Some("another answer"));
}

#[test]
fn a_silence_is_believed_only_where_it_is_not_known_what_was_due() {
    let fallbacks = |says_something_else: bool| {
        after_one(setup(), |judge| {
            let mut again = message(1);
            again.published_ns += u64::from(says_something_else);
            hear(judge, &again);
            send(judge, action(2, ActionSource::Imagined, 0.1), at_ns(3));
            send(judge, action(3, ActionSource::Fallback, 0.1), at_ns(4));
            send(judge, action(4, ActionSource::Fallback, 0.1), at_ns(5));
            let mut refused = message(5);
            refused.reward = f32::NAN;
            refused.edit().executed().fill(0.1);
            hear(judge, &refused);
            send(judge, action(5, ActionSource::Fallback, 0.1), at_ns(5));
        })
    };
    assert_eq!(fallbacks(false), Some("too many"));
    assert_eq!(fallbacks(true), None);
}

#[test]
fn a_new_beginning_is_believed_where_a_message_may_have_been_dropped_or_decided_on() {
    let refused = |sequence| {
        let mut refused = message(sequence);
        refused.reward = f32::NAN;
        refused.edit().executed().fill(0.1);
        refused
    };
    let fallbacks_until = |newest, polled| {
        after_one(setup(), |judge| {
            for sequence in [2, 3] {
                hear(judge, &refused(sequence));
                send(judge, action(sequence, ActionSource::Fallback, 0.1), at_ns(sequence));
            }
            // Stale by the time that number 7 comes.
            hear(judge, &message(4));
            judge.received(Heard::new(1, &refused(newest).view(), at_ns(newest)), polled);
            send(judge, action(newest, ActionSource::Fallback, 0.1), at_ns(newest));
        })
    };
    assert_eq!(fallbacks_until(5, false), Some("too many"));
    assert_eq!(fallbacks_until(5, true), None, "overtaken");
    assert_eq!(fallbacks_until(7, false), None, "stale");
}

#[test]
fn a_message_that_was_overtaken_is_what_is_gone_on_from_where_the_newer_one_is_dropped_or_refused() {
    let stand_in = |polled, sequence, now_ns| {
        after_one(setup(), |judge| {
            hear(judge, &message(2));
            let mut newer = message(5);
            newer.scheduled_ns = at_ns(2);
            judge.received(Heard::new(1, &newer.view(), at_ns(4)), polled);
            judge.looks_at_link(at_ns(4) + 1, false);
            send(judge, action(sequence, ActionSource::Imagined, 0.1), now_ns);
        })
    };
    assert_eq!(stand_in(true, 3, at_ns(4)), None);
    assert_eq!(stand_in(true, 4, at_ns(4)), Some("stand-in"), "too early");
    assert_eq!(stand_in(false, 3, at_ns(4)), Some("stand-in"), "2 waits for its answer");
    let held = |value| {
        after_one(Setup { rate_max: Some(0.1), ..setup() }, |judge| {
            let (mut overtaken, mut refused) = (message(2), message(3));
            overtaken.edit().executed().fill(0.4);
            refused.edit().executed().fill(3e38);
            hear(judge, &overtaken);
            judge.received(Heard::new(1, &refused.view(), at_ns(3)), true);
            send(judge, action(3, ActionSource::Fallback, value), at_ns(3));
        })
    };
    assert_eq!((held(0.4), held(0.25)), (None, Some("rate")));
}

#[test]
fn a_fallback_may_stand_in_for_a_message_that_has_turned_stale_and_its_answer_come_later() {
    let answered = |stale_at_ns, values: [f32; 2]| {
        after_one(setup(), |judge| {
            hear(judge, &message(4));
            judge.looks_at_link(stale_at_ns, false);
            send(judge, action(4, ActionSource::Fallback, 0.1), stale_at_ns);
            let mut again = message(4);
            (again.scheduled_ns, again.published_ns) = (at_ns(7), at_ns(7));
            for value in values {
                judge.received(Heard::new(1, &again.view(), at_ns(7)), false);
                send(judge, action(4, ActionSource::Policy, value), at_ns(7));
            }
        })
    };
    assert_eq!(answered(at_ns(7), [0.2, 0.2]), None);
    assert_eq!(answered(at_ns(7), [0.2, 0.3]), Some("another answer"));
    assert_eq!(answered(at_ns(5), [0.2, 0.2]), Some("marked"));
}

#[test]
fn a_message_that_is_not_answered_and_a_stand_in_that_does_not_come_are_seen() {
    let unanswered = after_one(setup(), |judge| {
        hear(judge, &message(2));
        judge.looks_at_link(at_ns(2), true);
    });
    assert_eq!(unanswered, Some("not answered"));
    let missing = after_one(setup(), |judge| {
        judge.looked(at_ns(3));
        (0..=LOOKS_MAX).for_each(|_| judge.looks_at_link(at_ns(3), false));
    });
    assert_eq!(missing, Some("no stand-in"));
}

#[test]
fn a_clock_that_is_ahead_puts_no_stand_in_off() {
    let mut ahead = message(1);
    (ahead.scheduled_ns, ahead.published_ns) = (u64::MAX, u64::MAX);
    let mut judge = judge(setup());
    hear(&mut judge, &ahead);
    send(&mut judge, action(1, ActionSource::Policy, 0.1), at_ns(1));
    judge.looked(at_ns(3));
    (0..=LOOKS_MAX).for_each(|_| judge.looks_at_link(at_ns(3), false));
    assert_eq!(judge.violation.map(|violation| violation.kind), Some("no stand-in"));
}

#[test]
fn stand_ins_come_in_time_marked_and_no_more_often_than_allowed() {
    let stand_in = |source, ticks: u64, now_ns| {
        after_one(setup(), |judge| {
            (2..=ticks)
                .for_each(|sequence| send(judge, action(sequence, source, 0.1), now_ns + at_ns(sequence)));
        })
    };
    assert_eq!(stand_in(ActionSource::Imagined, 2, PERIOD_NS), None);
    assert_eq!(stand_in(ActionSource::Imagined, 2, 0), Some("stand-in"));
    assert_eq!(stand_in(ActionSource::Policy, 2, PERIOD_NS), Some("marked"));
    assert_eq!(stand_in(ActionSource::Imagined, 3, PERIOD_NS), Some("too many"));
    assert_eq!(stand_in(ActionSource::Fallback, 4, PERIOD_NS), Some("too many"));
}

#[test]
fn counts_that_are_not_the_wire_s_are_seen() {
    let mut judge = judge(setup());
    hear(&mut judge, &message(1));
    send(&mut judge, action(1, ActionSource::Policy, 0.1), at_ns(1));
    let counters = Counters { observations: 1, answers: 1, ..Counters::default() };
    judge.check_counters(&counters, 0);
    assert!(judge.violation.is_none(), "{:?}", judge.violation);
    judge.check_counters(&Counters { answers: 2, ..counters }, 0);
    assert_eq!(judge.violation.map(|violation| violation.kind), Some("counters"));
}
