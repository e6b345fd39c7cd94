//! A log becomes an MCAP file of ROS 2's messages.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

mod crafted;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use rcwm_lab::mcap::{Compression, Exported, WallClock, export};
use rcwm_models::bundle::Bundle;
use rcwm_models::interface::Interface;
use rcwm_models::wire::{ActionSource, Format, ObservationFlags, OwnedObservation};
use rcwm_runtime::log::pack::ImagePacker;
use rcwm_runtime::log::{BundleIdentity, Header, LogReader, LoggedCall, LoggedOutcome, Record};
use rcwm_runtime::policy::{CallKind, Surprise};

/// What is added to the log's times.
const TO_UNIX_NS: i64 = 1_700_000_000_000_000_000;
const TICKS: u32 = 6;

fn header() -> Header {
    let bundle = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models/bundles/untrained");
    let bundle = Bundle::open(&bundle).unwrap();
    Header { monotonic_to_unix_ns: Some(TO_UNIX_NS), ..crafted::header(BundleIdentity::of(&bundle.manifest)) }
}

/// Meta-World's arm, but its joints in radians, and a camera whose name ROS would not take.
fn interface() -> Interface {
    let mut interface = Interface::metaworld();
    interface.state[0].unit = "rad".into();
    interface.camera[0].name = "wrist-cam".into();
    interface
}

/// Two episodes of three ticks each; in the second tick a frame is missing.
fn records(interface: Interface) -> Vec<Record> {
    let mut images: Vec<_> = interface.camera.iter().map(|_| ImagePacker::default()).collect();
    let mut records = vec![Record::Interface(interface.canonical())];
    let format = Format::of(interface);
    for number in 0..TICKS {
        let mut observation = OwnedObservation::zeroed(&format);
        observation.step = number % 3;
        (observation.sequence, observation.reward) = (u64::from(number), number as f32);
        observation.published_ns = 15;
        observation.captured_ns[0] = 12;
        observation.flags = ObservationFlags::default()
            .with(ObservationFlags::FIRST, number % 3 == 0)
            .with(ObservationFlags::MASK_VALID, true)
            .0;
        let mut edited = observation.edit();
        edited.state().iter_mut().enumerate().for_each(|(at, x)| *x = at as f32 + number as f32 / 10.0);
        if !format.interface().camera.is_empty() {
            edited.image(0).iter_mut().enumerate().for_each(|(at, x)| *x = (at as u32 + number) as u8);
        }
        let mut tick = crafted::tick(&mut images, &observation, [0.25; 4].into());
        let surprise = Some(Surprise::Rcwm { robot: 1.5, environment: number as f32 });
        let stage_ns = vec![2_000, 0, 0, 0, 0, 0, 3_000];
        let outcome =
            LoggedOutcome::Decided { action: [0.25; 4].into(), recomputed: false, surprise, stage_ns };
        tick.calls = vec![LoggedCall { kind: CallKind::Observe, action: None, outcome }];
        if number == 1 {
            (tick.observed, tick.answer.source) = (None, ActionSource::Imagined as u32);
            tick.dropped_before = 7;
        }
        records.push(Record::Tick(Box::new(tick)));
    }
    records
}

fn write(folder: &Path, header: &Header, mut records: Vec<Record>) -> PathBuf {
    let file = folder.join("run.rcwmlog");
    records.push(Record::End { ticks: u64::from(TICKS), dropped: 0 });
    crafted::write(&file, &crafted::payloads(header, &records));
    file
}

/// Every message by topic: when it was logged and published, and its bytes.
type Messages = BTreeMap<String, Vec<(u64, u64, Vec<u8>)>>;

/// Takes so many bytes from the front.
fn take<'a>(from: &mut &'a [u8], count: usize) -> &'a [u8] {
    let (taken, rest) = from.split_at(count);
    *from = rest;
    taken
}

fn number(from: &mut &[u8], bytes: usize) -> u64 {
    take(from, bytes).iter().rev().fold(0, |number, byte| number << 8 | u64::from(*byte))
}

fn string<'a>(from: &mut &'a [u8]) -> &'a str {
    let bytes = number(from, 4) as usize;
    std::str::from_utf8(take(from, bytes)).unwrap()
}

/// The blocks of an LZ4 frame.
fn unpack(mut frame: &[u8]) -> Vec<u8> {
    let mut all = Vec::new();
    take(&mut frame, 7);
    loop {
        match number(&mut frame, 4) as usize {
            0 => return all,
            raw if raw >> 31 == 1 => all.extend_from_slice(take(&mut frame, raw & 0x7fff_ffff)),
            bytes => {
                all.extend(lz4_flex::block::decompress(take(&mut frame, bytes), 4 << 20).unwrap());
            }
        }
    }
}

/// Reads records one after another; the readers of others are those of `tests/tests/mcap.rs`.
fn read(mut records: &[u8], topics: &mut BTreeMap<u64, String>, messages: &mut Messages) {
    while records.len() > 8 {
        let op = number(&mut records, 1);
        let bytes = number(&mut records, 8) as usize;
        let mut content = take(&mut records, bytes);
        let content = &mut content;
        match op {
            4 => {
                let (id, schema) = (number(content, 2), number(content, 2));
                let (topic, encoding) = (string(content), string(content));
                assert!(schema > 0 && encoding == "cdr", "{topic}");
                topics.insert(id, topic.to_owned());
            }
            5 => {
                let (channel, _sequence) = (number(content, 2), number(content, 4));
                let (log_ns, publish_ns) = (number(content, 8), number(content, 8));
                let of_topic = messages.entry(topics[&channel].clone()).or_default();
                of_topic.push((log_ns, publish_ns, content.to_vec()));
            }
            6 => {
                take(content, 28);
                let compression = string(content);
                number(content, 8);
                match compression {
                    "lz4" => read(&unpack(content), topics, messages),
                    _ => read(content, topics, messages),
                }
            }
            _ => {}
        }
    }
    assert!(records.is_empty() || records == MAGIC);
}

const MAGIC: &[u8] = b"\x89MCAP0\r\n";

fn messages(file: &Path) -> Messages {
    let bytes = std::fs::read(file).unwrap();
    let (mut topics, mut messages) = (BTreeMap::new(), Messages::new());
    read(bytes.strip_prefix(MAGIC).unwrap(), &mut topics, &mut messages);
    messages
}

fn exported(log: &Path, compression: Compression, episodes: Option<u64>) -> (Exported, Messages) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("out/a.mcap");
    let exported =
        export(&mut LogReader::open(log).unwrap(), &file, compression, episodes, &mut |_| true).unwrap();
    assert_eq!(exported.bytes, std::fs::metadata(&file).unwrap().len());
    let messages = messages(&file);
    let counts = messages.iter().map(|(topic, messages)| (topic.clone(), messages.len() as u64));
    let told = exported.topics.iter().map(|topic| (topic.topic.clone(), topic.messages));
    assert!(told.eq(counts), "{:?}", exported.topics);
    (exported, messages)
}

#[test]
fn every_tick_s_numbers_and_pictures_are_written_with_their_times() {
    let folder = tempfile::tempdir().unwrap();
    let log = write(folder.path(), &header(), records(interface()));
    for compression in [Compression::Lz4, Compression::None] {
        let (exported, messages) = exported(&log, compression, None);
        assert_eq!((exported.ticks, exported.episodes, exported.pictures), (6, 2, 5));
        assert_eq!((exported.wall_clock, exported.stopped), (WallClock::Logged, false));
        let unix = |ns: u64| TO_UNIX_NS as u64 + ns;
        // The picture of the last tick: logged when it was received, published when the robot published it.
        let (log_ns, publish_ns, image) = &messages["/rcwm/camera/wrist_cam"][4];
        assert_eq!((*log_ns, *publish_ns), (unix(20), unix(15)));
        let mut expected = vec![0, 1, 0, 0];
        // Taken when the camera says, seen in the frame of the camera's own name.
        expected.extend(1_700_000_000_u32.to_le_bytes());
        expected.extend(12_u32.to_le_bytes());
        expected.extend(10_u32.to_le_bytes());
        expected.extend(b"wrist-cam\0\0\0");
        expected.extend([64_u32, 64].map(u32::to_le_bytes).concat());
        expected.extend(5_u32.to_le_bytes());
        expected.extend(b"rgb8\0\0\0\0");
        expected.extend((64 * 3_u32).to_le_bytes());
        expected.extend((64 * 64 * 3_u32).to_le_bytes());
        expected.extend((0..64 * 64 * 3_u32).map(|at| (at + 5) as u8));
        assert_eq!(*image, expected);
        assert_eq!(messages["/rcwm/mask/wrist_cam"].len(), 5);
        // What was sent: as many as there were answers, published when they were.
        let sent = &messages["/rcwm/action/hand"];
        assert_eq!((sent.len(), sent[0].0, sent[0].1), (6, unix(30), unix(30)));
        let numbers = &sent[0].2[sent[0].2.len() - 32..];
        assert_eq!(numbers, [0.25_f64; 4].map(f64::to_le_bytes).concat());
        let modes: Vec<_> =
            messages["/rcwm/mode"].iter().map(|(.., text)| &text[8..text.len() - 1]).collect();
        assert_eq!((modes[0], modes[1]), (&b"tracking"[..], &b"imagining"[..]));
        assert_eq!(messages["/rcwm/latency_us/encoder"].len(), 6);
        assert!(!messages.contains_key("/rcwm/latency_us/robot"), "it took no time in the tick");
        assert_eq!(messages["/rcwm/events"].len(), 1, "seven ticks were dropped");
    }
}

#[test]
fn episodes_beyond_those_asked_for_are_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let log = write(folder.path(), &header(), records(interface()));
    let (exported, messages) = exported(&log, Compression::Lz4, Some(1));
    assert_eq!((exported.ticks, exported.episodes, exported.stopped), (3, 1, false));
    assert_eq!(messages["/rcwm/reward"].len(), 2);
}

#[test]
fn what_is_stopped_is_a_whole_file_of_what_came_before() {
    let folder = tempfile::tempdir().unwrap();
    let log = write(folder.path(), &header(), records(interface()));
    let (file, mut entries) = (folder.path().join("a.mcap"), 0);
    let mut go_on = |_| {
        entries += 1;
        entries < 2
    };
    let mut log = LogReader::open(&log).unwrap();
    let exported = export(&mut log, &file, Compression::Lz4, None, &mut go_on).unwrap();
    assert_eq!((exported.ticks, exported.stopped), (2, true));
    assert_eq!(messages(&file).values().map(Vec::len).sum::<usize>() as u64, exported.messages);
}

#[test]
fn a_log_without_a_clock_is_dated_by_the_second_it_was_begun_in() {
    let folder = tempfile::tempdir().unwrap();
    let header = Header { monotonic_to_unix_ns: None, started_unix_s: 1_600_000_000, ..header() };
    let log = write(folder.path(), &header, records(interface()));
    let (exported, messages) = exported(&log, Compression::Lz4, None);
    assert_eq!(exported.wall_clock, WallClock::Estimated);
    assert_eq!(messages["/rcwm/reward"][0].0, 1_600_000_000_000_000_000);
}

fn export_verb(log: &Path, out: &Path) -> std::process::Output {
    let mut command = Command::cargo_bin("rcwm-lab").unwrap();
    command.args(["export-mcap", "--log"]).arg(log).arg("--out").arg(out).output().unwrap()
}

#[test]
fn a_robot_without_cameras_is_exported_and_said_to_have_no_pictures() {
    let folder = tempfile::tempdir().unwrap();
    let mut blind = interface();
    blind.camera.clear();
    let log = write(folder.path(), &header(), records(blind));
    let told = export_verb(&log, &folder.path().join("a.mcap"));
    let said = String::from_utf8_lossy(&told.stdout);
    assert!(told.status.success() && said.contains("no pictures"), "{said}");
}

#[test]
fn a_log_that_was_cut_is_exported_up_to_the_cut() {
    let folder = tempfile::tempdir().unwrap();
    let (log, out) = (write(folder.path(), &header(), records(interface())), folder.path().join("a.mcap"));
    let whole = std::fs::read(&log).unwrap();
    std::fs::write(&log, &whole[..whole.len() - 40]).unwrap();
    let told = export_verb(&log, &out);
    let said = String::from_utf8_lossy(&told.stderr);
    assert_eq!(told.status.code(), Some(1));
    assert!(said.contains("damaged") && said.contains("exported"), "{said}");
    assert_eq!(messages(&out)["/rcwm/action/hand"].len(), 5, "the last tick was cut");
}

#[test]
fn nothing_is_written_over_and_what_is_no_log_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let (log, out) = (write(folder.path(), &header(), records(interface())), folder.path().join("a.mcap"));
    std::fs::write(&out, b"precious").unwrap();
    let told = export_verb(&log, &out);
    let said = String::from_utf8_lossy(&told.stderr);
    assert!(told.status.code() == Some(1) && said.contains("not written over"), "{said}");
    assert_eq!(std::fs::read(&out).unwrap(), b"precious");
    let told = export_verb(&out, &folder.path().join("b.mcap"));
    let said = String::from_utf8_lossy(&told.stderr);
    assert!(told.status.code() == Some(1) && said.contains("is no log"), "{said}");
    assert!(!folder.path().join("b.mcap").exists());
}
