//! Logs that somebody has made, with checksums that fit: whatever they say, every tool gets through, or says what is wrong.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

mod crafted;

use std::path::{Path, PathBuf};

use crafted::{header, payloads, write};
use rand::seq::IndexedRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_lab::film::film;
use rcwm_lab::log::{LoggedLatencies, ReplayError, ReplayReport, Replayer, write_episodes};
use rcwm_lab::mcap::{Compression, export};
use rcwm_lab::plot::{Curve, plot};
use rcwm_models::bundle::Bundle;
use rcwm_models::interface::Interface;
use rcwm_models::wire::{ActionValues, Format, ObservationFlags, OwnedObservation};

use rcwm_runtime::EngineSettings;
use rcwm_runtime::controller::Fallback;
use rcwm_runtime::log::frames::{FrameReader, MAGIC, Next, PAYLOAD_BYTES_MAX, write_frame, write_start};
use rcwm_runtime::log::pack::ImagePacker;
use rcwm_runtime::log::{
    BundleIdentity, Header, LogError, LogReader, LoggedCall, LoggedOutcome, Record, TickRecord, WholeState,
};
use rcwm_runtime::policy::{BranchState, CallKind, Policy, STAGES, State};
use rcwm_runtime::telemetry::Stage;

fn bundle() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models/bundles/untrained")
}

fn state_of(policy: &Policy) -> (State, u128) {
    (policy.state().clone(), 0)
}

fn tick(images: &mut [ImagePacker], step: u32, state: Option<WholeState>) -> TickRecord {
    let mut observation = OwnedObservation::zeroed(&Format::metaworld());
    (observation.step, observation.sequence) = (step, u64::from(step));
    observation.flags = ObservationFlags::default()
        .with(ObservationFlags::FIRST, step == 0)
        .with(ObservationFlags::MASK_VALID, true)
        .0;
    observation.edit().image(0)[step as usize] = 200;
    let action = (step > 0).then_some([0.1; 4].into());
    let (outcome, stage_ns) = ([0.1; 4].into(), vec![1; STAGES.len()]);
    let decided = LoggedOutcome::Decided { action: outcome, recomputed: false, surprise: None, stage_ns };
    let calls = vec![
        LoggedCall { kind: CallKind::Observe, action, outcome: decided },
        LoggedCall {
            kind: CallKind::WorkAhead,
            action: Some([0.1; 4].into()),
            outcome: LoggedOutcome::Done(5),
        },
    ];
    let resumes = state.is_some();
    TickRecord { resumes, calls, state, ..crafted::tick(images, &observation, [0.1; 4].into()) }
}

/// Everything that the tools do with a log; the replay's report where it came so far.
fn use_log(path: &Path) -> Result<ReplayReport, ReplayError> {
    let mut log = LogReader::open(path)?;
    let latencies = LoggedLatencies::read(&mut log, &mut |_| true)?;
    assert!(!latencies.text().is_empty());
    let folder = tempfile::tempdir().unwrap();
    // Drawing takes long, and is worth it where times are out of all bounds.
    if let Some(period_us) = latencies.report.period_us.filter(|period_us| *period_us > 1e12) {
        let curve = Curve::of("tick", latencies.telemetry.histogram(Stage::Tick));
        let _ = plot(&folder.path().join("a.png"), "a", &[curve], Some(period_us));
        film(&mut LogReader::open(path)?, None, folder.path(), 2, &mut |_| true).unwrap();
    }
    latencies.telemetry.write_hgrm(folder.path()).unwrap();
    write_episodes(&mut LogReader::open(path)?, folder.path(), &mut |_| true)?;
    let file = folder.path().join("a.mcap");
    export(&mut LogReader::open(path)?, &file, Compression::Lz4, None, &mut |_| true).unwrap();
    let mut log = LogReader::open(path)?;
    let report = Replayer::new(log.header(), &[bundle()], None)?.run(&mut log, &mut |_| true)?;
    assert!(!report.text().is_empty());
    Ok(report)
}

fn interface() -> Record {
    Record::Interface(Format::metaworld().interface().canonical())
}

fn of_records(change: impl FnOnce(&mut Header, &mut Vec<TickRecord>)) -> Result<ReplayReport, ReplayError> {
    of_records_after(vec![interface()], change)
}

/// The same with other records before the ticks.
fn of_records_after(
    mut records: Vec<Record>,
    change: impl FnOnce(&mut Header, &mut Vec<TickRecord>),
) -> Result<ReplayReport, ReplayError> {
    let bundle = Bundle::open(&bundle()).unwrap();
    let mut header = header(BundleIdentity::of(&bundle.manifest));
    let mut images = [ImagePacker::default()];
    let mut ticks = (0..4).map(|step| tick(&mut images, step, None)).collect();
    change(&mut header, &mut ticks);
    records.extend(ticks.into_iter().map(|tick| Record::Tick(Box::new(tick))));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("crafted.rcwmlog");
    write(&path, &payloads(&header, &records));
    use_log(&path)
}

#[test]
fn a_checksum_of_other_letters_is_shown_whole_letters() {
    for sha256 in ["0123456789aü", "ü", "", "𝄞𝄞𝄞𝄞𝄞𝄞𝄞"] {
        let error = of_records(|header, _| header.bundle.sha256[0].1 = sha256.into()).unwrap_err();
        assert!(matches!(error, ReplayError::OtherBundle { .. }), "{error}");
    }
}

#[test]
fn counts_and_times_at_their_limits_are_borne() {
    let report = of_records(|_, ticks| {
        for tick in ticks {
            (tick.dropped_before, tick.scheduled_ns, tick.received_ns) = (u64::MAX, u64::MAX, 0);
            tick.answer.published_ns = u64::MAX;
            tick.answer.answers = u64::MAX;
            tick.calls[1].outcome = LoggedOutcome::Done(u64::MAX);
            if let LoggedOutcome::Decided { stage_ns, .. } = &mut tick.calls[0].outcome {
                *stage_ns = vec![u64::MAX; 100];
            }
            let observed = tick.observed.as_mut().unwrap();
            (observed.period_ns, observed.published_ns) = (u64::MAX, u64::MAX);
            (observed.step, observed.task, observed.flags) = (u32::MAX, u32::MAX, u32::MAX);
            (observed.sequence, observed.episode, observed.reward) = (u64::MAX, u64::MAX, f32::NAN);
        }
    });
    assert_eq!(report.unwrap().ticks_dropped, u64::MAX);
}

#[test]
fn a_state_of_classes_that_do_not_exist_is_a_difference() {
    let loaded = Policy::load(&bundle(), EngineSettings::tract()).unwrap();
    let spoilt = |z: Option<i64>, h: Option<f32>| {
        let (mut state, _) = state_of(&loaded);
        let BranchState { z: classes, h: values } = &mut state.branches[1];
        z.into_iter().for_each(|z| classes[0] = z);
        h.into_iter().for_each(|h| values[0] = h);
        WholeState::of(&state, u128::MAX)
    };
    let none = (None, None);
    for (z, h) in
        [(Some(1_000_000), None), (Some(-1), None), (Some(i64::MAX), None), (None, Some(f32::NAN)), none]
    {
        let report = of_records(|_, ticks| {
            (ticks[1].resumes, ticks[1].state) = (true, Some(spoilt(z, h)));
        });
        let first = report.unwrap().first_difference.map(|difference| (difference.tick, difference.what));
        // The first tick differs in any case: the log was never run.
        assert!(first.is_some(), "{z:?} {h:?}");
    }
}

#[test]
fn actions_that_are_no_numbers_do_not_reach_the_safety_filter() {
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let report = of_records(|_, ticks| {
            ticks[1].answer.action = [bad; 4].into();
            ticks[2].calls[0].action = Some([bad; 4].into());
            ticks[3].calls[1].action = Some([bad; 4].into());
            ticks[3].calls[0].kind = CallKind::Imagine;
        });
        assert!(report.unwrap().ticks_differing > 0);
    }
}

/// What is said of a log that is read up to a damage after `ticks` ticks.
fn damage_after(ticks: u64, report: Result<ReplayReport, ReplayError>) -> String {
    let report = report.unwrap();
    assert_eq!(report.ticks, ticks, "{:?}", report.log_damage);
    report.log_damage.unwrap()
}

#[test]
fn actions_of_another_count_of_numbers_than_the_bundle_s_are_named_and_end_the_log() {
    for count in [0, 3, 5, 64] {
        let other = || ActionValues::zeros(count);
        let changes: [&dyn Fn(&mut TickRecord); 3] =
            [&|tick| tick.answer.action = other(), &|tick| tick.calls[1].action = Some(other()), &|tick| {
                match &mut tick.calls[0].outcome {
                    LoggedOutcome::Decided { action, .. } => *action = other(),
                    _ => unreachable!(),
                }
            }];
        for change in changes {
            let said = damage_after(2, of_records(|_, ticks| change(&mut ticks[2])));
            assert!(said.contains(&format!("{count} numbers, expected 4")), "{said}");
            assert!(said.contains("log the run again"), "{said}");
        }
    }
    // Nothing was sent, and there was nothing to send.
    let report = of_records(|_, ticks| {
        (ticks[2].overtaken, ticks[2].answer.action) = (true, ActionValues::zeros(0));
    });
    assert_eq!(report.unwrap().log_damage, None);
}

#[test]
fn a_header_with_other_counts_of_numbers_than_the_bundle_s_actions_is_said() {
    let refused = |change: &dyn Fn(&mut Header)| {
        let error = of_records(|header, _| change(header)).unwrap_err();
        let ReplayError::Log(LogError::NotALog { reason, .. }) = error else { panic!("{error}") };
        reason
    };
    for count in [0, 3, 5] {
        let said = refused(&|header| header.fallback = Fallback::Given(ActionValues::zeros(count)));
        assert!(said.contains(&format!("fallback of {count} numbers, expected 4")), "{said}");
    }
    for (low, high) in [(4, 3), (0, 0), (65, 65)] {
        let said = refused(&|header| {
            let limits = &mut header.bundle.action_limits;
            (limits.low, limits.high) = (vec![-1.0; low], vec![1.0; high]);
        });
        assert!(said.contains(&format!("{low} lowest and {high} highest")), "{said}");
    }
    let said = refused(&|header| header.instance = "../../etc/passwd".into());
    assert!(said.contains("instance"), "{said}");
}

#[test]
fn an_interface_or_a_policy_of_another_count_of_action_numbers_ends_the_log() {
    let mut other = Interface::metaworld();
    let action = &mut other.action[0];
    action.elements.push("more".into());
    action.low.push(-1.0);
    action.high.push(1.0);
    let said = damage_after(0, of_records_after(vec![Record::Interface(other.canonical())], |_, _| ()));
    assert!(said.contains("5 numbers, expected 4"), "{said}");
    let mut identity = BundleIdentity::of(&Bundle::open(&bundle()).unwrap().manifest);
    identity.action_limits.low.pop();
    identity.action_limits.high.pop();
    let said = damage_after(0, of_records_after(vec![interface(), Record::Policy(identity)], |_, _| ()));
    assert!(said.contains("3 numbers, expected 4"), "{said}");
}

#[test]
fn interfaces_in_a_row_however_many_do_not_overflow_the_stack() {
    let report = of_records_after((0..20_000).map(|_| interface()).collect(), |_, _| ()).unwrap();
    assert_eq!((report.ticks, report.log_damage), (4, None));
}

#[test]
fn a_header_that_no_run_has_written_is_said() {
    for threads in [0, usize::MAX] {
        let error = of_records(|header, _| header.engine.threads = threads).unwrap_err();
        assert!(
            matches!(&error, ReplayError::Log(LogError::NotALog { reason, .. }) if reason.contains("threads")),
            "{error}"
        );
    }
    let error = of_records(|header, _| header.rate_max = Some(-1.0)).unwrap_err();
    assert!(
        matches!(&error, ReplayError::Log(LogError::NotALog { reason, .. }) if reason.contains("rate limit")),
        "{error}"
    );
}

#[test]
fn a_pipe_is_no_log_and_is_not_waited_for() {
    let folder = tempfile::tempdir().unwrap();
    let pipe = folder.path().join("pipe");
    let mode = rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR;
    rustix::fs::mknodat(rustix::fs::CWD, &pipe, rustix::fs::FileType::Fifo, mode, 0).unwrap();
    for path in [&pipe, folder.path(), Path::new("/dev/zero")] {
        assert!(matches!(LogReader::open(path), Err(LogError::NotALog { .. })), "{}", path.display());
    }
}

#[test]
fn bytes_changed_at_random_behind_checksums_that_fit_make_no_tool_panic() {
    let bundle = Bundle::open(&bundle()).unwrap();
    let mut images = [ImagePacker::default()];
    let loaded = Policy::load(&self::bundle(), EngineSettings::tract()).unwrap();
    let whole = |step| (step % 2 == 0).then(|| WholeState::of(loaded.state(), 7));
    let mut records: Vec<_> = std::iter::once(interface())
        .chain((0..4).map(|step| Record::Tick(Box::new(tick(&mut images, step, whole(step))))))
        .collect();
    records.insert(2, Record::Policy(BundleIdentity::of(&bundle.manifest)));
    records.push(Record::End { ticks: 4, dropped: 0 });
    let sound = payloads(&header(BundleIdentity::of(&bundle.manifest)), &records);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("crafted.rcwmlog");
    write(&path, &sound);
    use_log(&path).unwrap();
    let mut replayed = 0;
    for seed in 0..150 {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed);
        let mut changed = sound.clone();
        for _ in 0..rng.random_range(1..4) {
            let payload = rng.random_range(usize::from(seed % 4 != 0)..changed.len());
            let payload = &mut changed[payload];
            let at = rng.random_range(0..payload.len());
            let value = [0, 1, 0x7f, 0x80, 0xff].choose(rng).copied().unwrap_or(0);
            let end = (at + rng.random_range(1..12)).min(payload.len());
            payload[at..end].fill(value);
        }
        write(&path, &changed);
        replayed += u32::from(use_log(&path).is_ok());
    }
    assert!(replayed > 15, "{replayed} of 150 came as far as a replay");
}

#[test]
fn what_was_written_is_read_back_frame_by_frame() {
    let mut bytes = Vec::new();
    write_start(&mut bytes).unwrap();
    write_frame(&mut bytes, b"abc").unwrap();
    let mut frames = FrameReader::new(&bytes[MAGIC.len() + 4..], 0);
    assert!(matches!(frames.read().unwrap(), Next::Payload(b"abc")));
    assert!(matches!(frames.read().unwrap(), Next::End));
}

#[test]
fn a_frame_that_could_not_be_read_back_is_not_written() {
    let mut bytes = Vec::new();
    let largest = vec![0; PAYLOAD_BYTES_MAX];
    write_frame(&mut bytes, &largest).unwrap();
    assert!(matches!(FrameReader::new(&bytes[..], 0).read().unwrap(), Next::Payload(_)));
    bytes.clear();
    let said = write_frame(&mut bytes, &[largest, vec![0]].concat()).unwrap_err().to_string();
    assert!(bytes.is_empty() && said.contains(&format!("at most {PAYLOAD_BYTES_MAX}")), "{said}");
}
