//! A logged run is replayed bit for bit, whatever happened in it.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::path::Path;
use std::time::Duration;

use assert_cmd::Command;
use rcwm_lab::log::{Answers, ReplayReport, Replayer};
use rcwm_models::bundle::{Bundle, PartName};
use rcwm_models::episode::Episode;
use rcwm_models::wire::clock::monotonic_ns;
use rcwm_models::wire::{
    Action, ActionSource, ActionValues, ObservationFlags, OwnedObservation, SimulatorLink, Wait,
};
use rcwm_runtime::controller::{
    ControllerSettings, Counters, EpisodeResult, Episodes, Fallback, State, Tick, TickObserver, TickTimes,
};
use rcwm_runtime::log::{Entry, LogReader, LogSettings, LogSummary, LogWriter};
use rcwm_runtime::policy::{CallOutcome, Sampling};
use rcwm_runtime::record::{Finished, Recorder};
use rcwm_runtime::telemetry::Telemetry;
use rcwm_runtime::{EngineSettings, Policy};
use rcwm_testkit::{
    ask, dividing_by_zero, observation, own_link, smallest_bundle, start_logging, with_manifest,
};

/// Records that may wait for the writer.
const RECORDS: usize = Recorder::<LogWriter>::RECORDS;

/// Runs a controller with a log on observations that a peer publishes: `ticks` of them in episodes of 10, of which some are not
/// fit, and some say that another action was executed than was sent.
fn logged_run(bundle: &Path, file: &Path, sampling: Sampling, ticks: u64) -> LogSummary {
    let policy = Policy::new(&Bundle::open(bundle).unwrap(), EngineSettings::tract(), sampling).unwrap();
    logged_run_of(policy, file, sampling, RECORDS, 0, ticks)
}

fn logged_run_of(
    policy: Policy,
    file: &Path,
    sampling: Sampling,
    records: usize,
    period_ns: u64,
    ticks: u64,
) -> LogSummary {
    let link = own_link();
    let peer = link.peer();
    let settings = LogSettings::new("test", EngineSettings::tract(), sampling);
    let controller = start_logging(policy, &link, file, settings, records, |_| ());
    let mut last = ActionValues::zeros(4);
    for sequence in 0..ticks {
        let step = (sequence % 10) as u32;
        let mut sent = observation(sequence, step);
        (sent.episode, sent.period_ns) = (sequence / 10, period_ns);
        sent.flags |= if step == 9 { ObservationFlags::LAST.0 } else { 0 };
        sent.reward = if sequence % 23 == 17 { f32::NAN } else { 0.5 };
        if step > 0 && sequence % 3 != 0 {
            sent.edit().executed().copy_from_slice(&last);
        }
        last = ask(&peer, &sent).action;
    }
    peer.close().unwrap();
    controller.join().unwrap()
}

fn replay(file: &Path, bundle: &Path) -> ReplayReport {
    let mut log = LogReader::open(file).unwrap();
    let mut replayer = Replayer::new(log.header(), &[bundle.to_path_buf()], None).unwrap();
    replayer.run(&mut log, &mut |_| true).unwrap()
}

#[test]
fn a_run_is_replayed_bit_for_bit_with_the_mode_and_with_samples() {
    for sampling in [Sampling::Mode, Sampling::Sample { seed: 11 }] {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("run.rcwmlog");
        let summary = logged_run(&smallest_bundle(), &file, sampling, 60);
        assert_eq!((summary.ticks, summary.dropped), (60, 0));
        assert_eq!(summary.bytes, std::fs::metadata(&file).unwrap().len());
        let report = replay(&file, &smallest_bundle());
        assert_eq!(report.first_difference, None);
        assert_eq!((report.ticks, report.ticks_compared, report.log_finished), (60, 60, true));
        // The observations that hold NaN.
        assert_eq!(report.answers, Answers { policy: 58, imagined: 0, fallback: 2 });
    }
}

#[test]
fn imagined_rate_limited_fallback_and_late_ticks_are_replayed() {
    const PERIOD_NS: u64 = 40_000_000;
    let (link, folder) = (own_link(), tempfile::tempdir().unwrap());
    let peer = link.peer();
    let bundle = Bundle::open(&smallest_bundle()).unwrap();
    let sampling = Sampling::Sample { seed: 6 };
    let policy = Policy::new(&bundle, EngineSettings::tract(), sampling).unwrap();
    let (fallback, rate_max) = (Fallback::Given([0.5, -0.5, 0.0, 1.0].into()), Some(0.03));
    let settings =
        LogSettings { fallback, rate_max, ..LogSettings::new("test", EngineSettings::tract(), sampling) };
    let file = folder.path().join("run.rcwmlog");
    let limit = move |settings: &mut ControllerSettings| {
        (settings.fallback, settings.rate_max) = (fallback, rate_max);
        settings.ticks.imagined_ticks_max = 3;
    };
    let controller = start_logging(policy, &link, &file, settings, RECORDS, limit);
    let real_time = |sequence: u64, step: u32| {
        let mut sent = observation(sequence, step);
        (sent.period_ns, sent.scheduled_ns) = (PERIOD_NS, monotonic_ns());
        sent
    };
    ask_now(&peer, || real_time(0, 0));
    // Silence: some ticks are imagined.
    let imagined = wait_for(&peer, ActionSource::Imagined);
    // It comes after all.
    peer.publish_copy(&real_time(imagined.answers, 1)).unwrap();
    let fallback = wait_for(&peer, ActionSource::Fallback);
    let next = fallback.answers + 3;
    ask_now(&peer, || real_time(next, 2));
    peer.close().unwrap();
    controller.join().unwrap();
    let report = replay(&file, &smallest_bundle());
    assert_eq!(report.first_difference, None);
    let Answers { policy: observed, imagined, fallback } = report.answers;
    assert!(observed >= 2 && imagined >= 1 && fallback >= 1, "{:?}", report.answers);
    assert_eq!(report.ticks_compared, report.ticks);
}

/// Waits for an answer of this source.
fn wait_for(peer: &SimulatorLink, source: ActionSource) -> Action {
    loop {
        if let (Wait::Message(action), _) = peer.wait_action(Duration::from_secs(20)).unwrap()
            && action.source == source as u32
        {
            return action;
        }
    }
}

/// Publishes an observation that is due now until it is answered: one that was due long ago is stale.
fn ask_now(peer: &SimulatorLink, due_now: impl Fn() -> OwnedObservation) {
    for _ in 0..200 {
        let sent = due_now();
        peer.publish_copy(&sent).unwrap();
        let answer = peer.wait_action(Duration::from_millis(100)).unwrap();
        if matches!(answer, (Wait::Message(action), _) if action.answers == sent.sequence) {
            return;
        }
    }
    panic!("no answer");
}

#[test]
fn a_log_that_begins_in_the_middle_of_a_run_is_replayed_from_there() {
    let bundle = Bundle::open(&smallest_bundle()).unwrap();
    let sampling = Sampling::Sample { seed: 7 };
    let mut policy = Policy::new(&bundle, EngineSettings::tract(), sampling).unwrap();
    for step in 0..50 {
        policy.observe(&rcwm_testkit::image(step), (step > 0).then_some(&[0.2; 4].into())).unwrap();
    }
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("run.rcwmlog");
    logged_run_of(policy, &file, sampling, RECORDS, 0, 30);
    let report = replay(&file, &smallest_bundle());
    assert_eq!(report.first_difference, None);
    assert_eq!((report.ticks, report.ticks_compared), (30, 29));
}

#[test]
fn ticks_that_are_dropped_are_counted_and_the_replay_goes_on_after_them() {
    let bundle = Bundle::open(&smallest_bundle()).unwrap();
    let sampling = Sampling::Sample { seed: 7 };
    let policy = Policy::new(&bundle, EngineSettings::tract(), sampling).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("run.rcwmlog");
    // One buffer, and a period that nobody waits for: most ticks find it in use.
    let summary = logged_run_of(policy, &file, sampling, 1, u64::MAX, 300);
    assert_eq!(summary.ticks + summary.dropped, 300);
    let report = replay(&file, &smallest_bundle());
    assert_eq!(report.first_difference, None);
    assert_eq!(report.ticks, summary.ticks);
    assert!(
        report.ticks_dropped <= summary.dropped,
        "those after the last record have no record to be marked in"
    );
}

#[test]
fn ticks_on_which_the_policy_fails_are_replayed_as_failures() {
    let bundle = dividing_by_zero(PartName::Interaction);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("run.rcwmlog");
    logged_run(bundle.path(), &file, Sampling::Sample { seed: 2 }, 12);
    let report = replay(&file, bundle.path());
    assert_eq!(report.first_difference, None);
    assert_eq!(report.answers, Answers { policy: 0, imagined: 0, fallback: 12 });
    assert!(report.failures >= 12);
}

#[test]
fn another_seed_is_the_first_difference_that_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("run.rcwmlog");
    logged_run(&smallest_bundle(), &file, Sampling::Sample { seed: 1 }, 12);
    let mut log = LogReader::open(&file).unwrap();
    let mut header = log.header().clone();
    header.sampling = Sampling::Sample { seed: 2 };
    let mut replayer = Replayer::new(&header, &[smallest_bundle()], None).unwrap();
    let report = replayer.run(&mut log, &mut |_| true).unwrap();
    let first = report.first_difference.unwrap();
    assert_eq!((first.tick, first.what.as_str()), (0, "the action"));
    assert_eq!(report.ticks_differing, 12);
}

#[test]
fn what_was_logged_is_what_was_observed_and_sent() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("run.rcwmlog");
    logged_run(&smallest_bundle(), &file, Sampling::Mode, 25);
    let mut log = LogReader::open(&file).unwrap();
    let mut sequence = 0;
    while let Some(entry) = log.read().unwrap() {
        let Entry::Tick(tick) = entry else { panic!("no policy took over") };
        let expected = observation(sequence, (sequence % 10) as u32);
        let found = tick.observation.unwrap();
        assert_eq!((found.sequence, found.step), (sequence, expected.step));
        assert_eq!(found.view().image(0), expected.view().image(0));
        assert_eq!(found.reward.is_nan(), sequence % 23 == 17);
        assert_eq!(tick.record.answer.answers, sequence);
        assert!(tick.record.received_ns >= found.published_ns);
        assert!(tick.record.answer.published_ns > tick.record.received_ns);
        sequence += 1;
    }
    assert_eq!((sequence, log.finished()), (25, true));
}

#[test]
fn a_log_is_read_up_to_the_place_where_it_was_cut_or_changed() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("run.rcwmlog");
    logged_run(&smallest_bundle(), &file, Sampling::Mode, 12);
    let whole = std::fs::read(&file).unwrap();
    let damaged = folder.path().join("damaged.rcwmlog");
    // Ticks before the damage, and what is said; none where the file is no log.
    let read = |bytes: &[u8]| -> (u64, Option<String>) {
        std::fs::write(&damaged, bytes).unwrap();
        let mut log = match LogReader::open(&damaged) {
            Ok(log) => log,
            Err(error) => return (0, Some(error.to_string())),
        };
        loop {
            match log.read() {
                Ok(Some(_)) => {}
                Ok(None) => return (log.ticks(), None),
                Err(error) => return (log.ticks(), Some(error.to_string())),
            }
        }
    };
    assert_eq!(read(&whole), (12, None));
    let mut last = 0;
    for len in (0..whole.len()).step_by(997) {
        let (ticks, said) = read(&whole[..len]);
        assert!(ticks >= last && ticks < 13, "{ticks} ticks in {len} bytes");
        assert!(said.is_none_or(|said| said.contains("damaged") || said.contains("no log")));
        last = ticks;
    }
    assert!(last >= 10);
    for at in (20..whole.len()).step_by(1499) {
        let mut changed = whole.clone();
        changed[at] ^= 0x10;
        let (ticks, said) = read(&changed);
        assert!(ticks < 13 && said.is_some(), "a bit of byte {at} was changed unseen");
    }
}

#[test]
fn a_log_replays_with_its_own_bundle_only() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("run.rcwmlog");
    logged_run(&smallest_bundle(), &file, Sampling::Mode, 3);
    let narrow = with_manifest(|manifest| rcwm_testkit::limit(manifest, [-0.5; 4], [1.0; 4]));
    let mut command = Command::cargo_bin("rcwm-lab").unwrap();
    command.args(["replay", "--log"]).arg(&file).arg("--bundle").arg(narrow.path());
    let output = command.assert().code(1).get_output().clone();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("another bundle") && said.contains("action limits"), "{said}");
}

#[test]
fn a_log_is_never_written_over() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("run.rcwmlog");
    std::fs::write(&file, b"precious").unwrap();
    let policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    let settings = LogSettings::new("test", EngineSettings::tract(), Sampling::Mode);
    let refused = LogWriter::start(&file, &policy, settings).err().unwrap();
    assert!(refused.to_string().contains("exists already"), "{refused}");
    assert_eq!(std::fs::read(&file).unwrap(), b"precious");
}

#[test]
fn the_replay_verb_says_so_and_writes_episodes() {
    let folder = tempfile::tempdir().unwrap();
    let (file, json) = (folder.path().join("run.rcwmlog"), folder.path().join("replay.json"));
    // The last of the four episodes is cut, in the second a reward is no number.
    logged_run(&smallest_bundle(), &file, Sampling::Mode, 35);
    let data = folder.path().join("data");
    let mut command = Command::cargo_bin("rcwm-lab").unwrap();
    command.args(["replay", "--log"]).arg(&file).arg("--bundle").arg(smallest_bundle());
    command.arg("--episodes").arg(&data).arg("--json").arg(&json);
    let output = command.assert().success().get_output().clone();
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(said.contains("all 35 ticks are the same, bit for bit"), "{said}");
    let report: serde_json::Value = serde_json::from_slice(&std::fs::read(&json).unwrap()).unwrap();
    assert_eq!((&report["ticks_differing"], &report["episodes"]["left_out"]), (&0.into(), &1.into()));
    let files = report["episodes"]["files"].as_array().unwrap();
    let episodes: Vec<_> =
        files.iter().map(|file| Episode::read(file.as_str().unwrap().as_ref()).unwrap()).collect();
    assert_eq!(episodes.iter().map(Episode::len).collect::<Vec<_>>(), [10, 10, 5]);
    assert!(episodes[0].is_first[0] && episodes[0].is_last[9] && !episodes[2].is_last[4]);
    assert!(episodes[0].image.iter().eq((0..10).flat_map(rcwm_testkit::image).collect::<Vec<_>>().iter()));
}

#[test]
fn a_controller_that_goes_back_to_an_earlier_state_is_replayed() {
    let bundle = Bundle::open(&smallest_bundle()).unwrap();
    let mut policy = Policy::new(&bundle, EngineSettings::tract(), Sampling::Sample { seed: 3 }).unwrap();
    let mut log = CallLog::start(&policy);
    policy.observe(&rcwm_testkit::image(0), None).unwrap();
    log.tick(&policy, 0);
    // Imagined twice, then the first of both frames comes after all.
    let before = policy.state().clone();
    policy.work_ahead(Some(&[0.1; 4].into())).unwrap();
    policy.imagine(&[0.1; 4].into()).unwrap();
    policy.imagine(&[0.2; 4].into()).unwrap();
    policy.set_state(&before).unwrap();
    policy.observe(&rcwm_testkit::image(1), Some(&[0.3; 4].into())).unwrap();
    log.tick(&policy, 1);
    let report = log.replay();
    assert_eq!(report.first_difference, None);
    assert_eq!((report.calls, report.ticks_compared), (6, 2));
}

/// A log of a policy that a test asks itself.
struct CallLog {
    folder: tempfile::TempDir,
    recorder: Recorder<LogWriter>,
}

impl CallLog {
    fn start(policy: &Policy) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let settings = LogSettings::new("test", EngineSettings::tract(), Sampling::Sample { seed: 3 });
        let log = LogWriter::start(&folder.path().join("log"), policy, settings).unwrap();
        Self { folder, recorder: Recorder::start(policy, log).unwrap() }
    }

    fn tick(&mut self, policy: &Policy, step: u32) {
        let observation = observation(u64::from(step), step);
        let action = policy.calls_since(0).last().and_then(|call| match call.outcome {
            CallOutcome::Decided { action, .. } => Some(action),
            _ => None,
        });
        let source = ActionSource::Policy as u32;
        let answer = Action { answers: u64::from(step), published_ns: 2, source, action: action.unwrap() };
        let (telemetry, counters) = (Telemetry::new(), Counters::default());
        self.recorder.ticked(&Tick {
            observation: Some(&observation.view()),
            is_first: step == 0,
            rewound: false,
            decision: None,
            answer,
            overtaken: false,
            state: State::default(),
            times: TickTimes { scheduled_ns: 0, published_ns: 0, received_ns: 1, sent_ns: 2 },
            policy,
            telemetry: &telemetry,
            counters: &counters,
            episodes: &Episodes::default(),
            running: EpisodeResult::start(&observation),
        });
    }

    fn replay(self) -> ReplayReport {
        let Finished { sink, dropped } = self.recorder.finish().unwrap();
        let summary = sink.finish(dropped).unwrap();
        let report = replay(&summary.file, &smallest_bundle());
        drop(self.folder);
        report
    }
}
