use super::*;

const PERIOD_NS: u64 = 1_000_000;
const PUBLISHED_NS: u64 = 10_200_000;

fn settings() -> PacingSettings {
    PacingSettings { spin: Duration::from_nanos(100_000), ..PacingSettings::default() }
}

/// Sequence 7, scheduled at 10 ms, published 0.2 ms later, every ms.
fn observation() -> ObservationHeader {
    let mut observation = ObservationHeader::zeroed();
    (observation.sequence, observation.period_ns) = (7, PERIOD_NS);
    (observation.scheduled_ns, observation.published_ns) = (10_000_000, PUBLISHED_NS);
    observation
}

fn after(observation: &ObservationHeader) -> Pacing {
    let mut pacing = Pacing::new(settings());
    pacing.observed(observation, observation.published_ns);
    pacing
}

fn wait(spin_ns: u64, timeout_ns: u64) -> Plan {
    Plan::Wait { spin: Duration::from_nanos(spin_ns), timeout: Duration::from_nanos(timeout_ns) }
}

#[test]
fn it_blocks_then_polls_around_the_expected_time_then_blocks_until_the_grace_is_over() {
    let pacing = after(&observation());
    let expected_ns = PUBLISHED_NS + PERIOD_NS;
    assert_eq!(pacing.plan(PUBLISHED_NS), wait(0, 900_000));
    assert_eq!(pacing.plan(expected_ns - 100_000), Plan::GetReady);
    assert_eq!(pacing.plan(expected_ns), wait(100_000, 100_000), "too late to get ready");
    let pacing = ready(pacing, 0);
    assert_eq!(pacing.plan(expected_ns - 100_000), wait(200_000, 200_000));
    assert_eq!(pacing.plan(expected_ns + 99_999), wait(1, 1));
    assert_eq!(pacing.plan(expected_ns + 100_000), wait(0, 400_000));
    assert_eq!(pacing.plan(expected_ns + 500_000), Plan::Overdue);
}

fn ready(mut pacing: Pacing, took_ns: u64) -> Pacing {
    pacing.got_ready(Duration::from_nanos(took_ns));
    pacing
}

#[test]
fn it_gets_ready_once_a_tick_as_long_before_as_that_takes() {
    let mut pacing = ready(after(&observation()), 80_000);
    let polls_ns = PUBLISHED_NS + PERIOD_NS - 100_000;
    assert_eq!(pacing.plan(polls_ns - 100_000), wait(0, 100_000), "ready for this one already");
    pacing.observed(&observation(), PUBLISHED_NS);
    assert_eq!(pacing.plan(polls_ns - 100_001), wait(0, 1), "a quarter more than it took");
    assert_eq!(pacing.plan(polls_ns - 100_000), Plan::GetReady);
    let mut pacing = ready(pacing, 80_000);
    assert!(pacing.take_overdue(PUBLISHED_NS + PERIOD_NS * 3 / 2).is_some());
    assert_eq!(pacing.plan(polls_ns + PERIOD_NS - 1), Plan::GetReady, "the one that was missing is over");
}

#[test]
fn it_gets_ready_for_an_observation_that_comes_as_soon_as_others_came() {
    let mut pacing = ready(after(&observation()), 80_000);
    let mut late = observation();
    late.published_ns += 64_000;
    pacing.observed(&late, late.published_ns);
    let polls_ns = late.published_ns + PERIOD_NS - 100_000;
    // 64 us sooner than expected, of which a 32nd is forgotten.
    assert_eq!(pacing.plan(polls_ns - 100_000 - 62_001), wait(0, 1));
    assert_eq!(pacing.plan(polls_ns - 100_000 - 62_000), Plan::GetReady);
    for _ in 0..500 {
        pacing.observed(&late, late.published_ns);
    }
    assert_ne!(pacing.plan(polls_ns - 100_100), Plan::GetReady, "they come later now");
    late.published_ns += 100 * PERIOD_NS;
    pacing.observed(&late, late.published_ns);
    let polls_ns = late.published_ns + PERIOD_NS - 100_000;
    assert_eq!(pacing.plan(polls_ns - PERIOD_NS / 4 - 1), wait(0, 1), "never earlier than that");
}

#[test]
fn it_does_not_get_ready_where_that_is_not_wanted() {
    let mut pacing = Pacing::new(PacingSettings { gets_ready: false, ..settings() });
    pacing.observed(&observation(), PUBLISHED_NS);
    assert_eq!(pacing.plan(PUBLISHED_NS + PERIOD_NS - 100_000), wait(200_000, 200_000));
}

#[test]
fn getting_ready_never_takes_more_than_a_quarter_of_the_period_ahead_and_is_forgotten_in_time() {
    let mut pacing = ready(after(&observation()), 50 * PERIOD_NS);
    let polls_ns = PUBLISHED_NS + PERIOD_NS - 100_000;
    pacing.observed(&observation(), PUBLISHED_NS);
    assert_eq!(pacing.plan(polls_ns - PERIOD_NS / 4 - 1), wait(0, 1));
    for _ in 0..600 {
        pacing.got_ready(Duration::from_nanos(80_000));
    }
    pacing.observed(&observation(), PUBLISHED_NS);
    assert_eq!(pacing.plan(polls_ns - 100_001), wait(0, 1));
}

#[test]
fn a_missing_tick_is_given_once_with_its_own_schedule() {
    let mut pacing = after(&observation());
    let overdue_ns = PUBLISHED_NS + PERIOD_NS * 3 / 2;
    assert_eq!(pacing.take_overdue(overdue_ns - 1), None);
    let missing = Missing { sequence: 8, scheduled_ns: 11_000_000, skipped: 0 };
    assert_eq!(pacing.take_overdue(overdue_ns), Some(missing));
    assert_eq!(pacing.take_overdue(overdue_ns + PERIOD_NS - 1), None);
    assert_eq!(pacing.take_overdue(overdue_ns + PERIOD_NS).map(|missing| missing.sequence), Some(9));
}

#[test]
fn ticks_that_were_slept_through_are_counted_and_not_made_up_for() {
    let mut pacing = after(&observation());
    let late_ns = PUBLISHED_NS + 10 * PERIOD_NS;
    let missing = Missing { sequence: 16, scheduled_ns: 19_000_000, skipped: 8 };
    assert_eq!(pacing.take_overdue(late_ns), Some(missing));
    assert_eq!(pacing.take_overdue(late_ns), None);
    assert_ne!(pacing.plan(late_ns), Plan::Overdue);
}

#[test]
fn nothing_is_due_in_lock_step_after_a_last_one_and_at_rest() {
    let idle = Plan::Wait { spin: settings().spin, timeout: NOTHING_DUE };
    let mut lockstep = observation();
    lockstep.period_ns = 0;
    let mut last = observation();
    last.flags = ObservationFlags::LAST.0;
    let mut resting = after(&observation());
    resting.rest();
    for mut pacing in [after(&lockstep), after(&last), resting] {
        assert_eq!((pacing.plan(u64::MAX), pacing.take_overdue(u64::MAX)), (idle, None));
    }
}

#[test]
fn stale_is_what_was_scheduled_more_than_two_periods_before_it_came() {
    let pacing = Pacing::new(settings());
    let mut seen = observation();
    assert!(!pacing.is_stale(&seen, seen.scheduled_ns + 2 * PERIOD_NS));
    assert!(pacing.is_stale(&seen, seen.scheduled_ns + 2 * PERIOD_NS + 1));
    assert!(!pacing.is_stale(&seen, 0), "one from the future is not stale");
    seen.period_ns = 0;
    assert!(!pacing.is_stale(&seen, u64::MAX));
}

#[test]
fn nothing_was_scheduled_or_published_later_than_it_was_received() {
    let (received_ns, late_ns) = (PUBLISHED_NS + 50_000, PUBLISHED_NS + 3 * PERIOD_NS);
    let seen = |scheduled_ns, published_ns| ObservationHeader { scheduled_ns, published_ns, ..observation() };
    let stamps = |seen: ObservationHeader| {
        let Stamps { scheduled_ns, published_ns, ahead_ns } = Stamps::of(&seen, received_ns);
        (scheduled_ns, published_ns, ahead_ns)
    };
    assert_eq!(stamps(observation()), (10_000_000, PUBLISHED_NS, 0));
    // Published a little before it was due: no clock is ahead.
    assert_eq!(stamps(seen(received_ns + 1, PUBLISHED_NS)), (PUBLISHED_NS, PUBLISHED_NS, 0));
    let scheduled_ahead = seen(late_ns, PUBLISHED_NS);
    assert_eq!(stamps(scheduled_ahead), (PUBLISHED_NS, PUBLISHED_NS, late_ns - received_ns - PERIOD_NS));
    assert_eq!(stamps(seen(u64::MAX, u64::MAX)), (received_ns, received_ns, u64::MAX - received_ns));
    for ahead in [scheduled_ahead, seen(u64::MAX, u64::MAX), seen(0, u64::MAX)] {
        let mut pacing = Pacing::new(settings());
        pacing.observed(&ahead, received_ns);
        assert_eq!(pacing.plan(received_ns + PERIOD_NS * 3 / 2), Plan::Overdue, "{ahead:?}");
    }
}

#[test]
fn nothing_is_due_after_the_last_sequence() {
    let mut seen = observation();
    let idle = Plan::Wait { spin: settings().spin, timeout: NOTHING_DUE };
    for (sequence, left) in [(u64::MAX, 0), (u64::MAX - 2, 2)] {
        seen.sequence = sequence;
        let mut pacing = after(&seen);
        let given = (2..20).filter_map(|ticks| pacing.take_overdue(PUBLISHED_NS + ticks * PERIOD_NS));
        let given: Vec<u64> = given.map(|missing| missing.sequence).collect();
        assert_eq!(given, (1..=left).map(|tick| sequence + tick).collect::<Vec<_>>());
        assert_eq!(pacing.plan(u64::MAX), idle);
    }
}

#[test]
fn absurd_periods_neither_overflow_nor_run_wild() {
    let mut seen = observation();
    seen.period_ns = u64::MAX;
    assert_ne!(after(&seen).plan(u64::MAX - 1), Plan::Overdue);
    seen.period_ns = 1;
    let mut pacing = after(&seen);
    let mut ticks = 0;
    for now_ns in (PUBLISHED_NS..PUBLISHED_NS + PERIOD_NS).step_by(1000) {
        ticks += u64::from(pacing.take_overdue(now_ns).is_some());
    }
    assert!(ticks <= PERIOD_NS / PERIOD_NS_MIN, "{ticks}");
}
