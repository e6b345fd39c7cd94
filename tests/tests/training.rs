//! The trainer as a program: it collects from real simulators, and whoever kills it finds a run that loads.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::path::Path;
use std::time::{Duration, Instant};

use rcwm_models::episode::{Episode, EpisodeBuilder};
use rcwm_models::wire::{Format, ObservationFlags, OwnedObservation};
use rcwm_tests::{Domain, Running, eventually, output, read_json};

fn trainer(domain: &Domain, words: &[&str], out: &Path) -> std::process::Command {
    let mut command = domain.command("rcwm-trainer");
    command.env("RCWM_SIMULATOR", rcwm_tests::binary("rcwm-simulator"));
    command.args(words).arg("--out").arg(out);
    command
}

fn files_of(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten();
    let mut names: Vec<_> =
        entries.map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

const COLLECT: [&str; 12] = [
    "collect",
    "--task",
    "reach",
    "--mixed",
    "2",
    "--random",
    "1",
    "--masks",
    "1",
    "--steps-max",
    "12",
    "--seed=3",
];

#[test]
fn collected_episodes_are_whole_masked_where_asked_and_not_collected_twice() {
    let folder = tempfile::tempdir().unwrap();
    let (data, json) = (folder.path().join("data"), folder.path().join("report.json"));
    let domain = Domain::new();
    let mut command = trainer(&domain, &COLLECT, &data);
    command.arg("--json").arg(&json);
    Running::start(command).succeed();
    let names = files_of(&data.join("reach"));
    assert_eq!(names, ["mixed-seed3-00000.npz", "mixed-seed3-00001.npz", "random-seed3-00000.npz"]);
    let episodes: Vec<_> =
        names.iter().map(|name| Episode::read(&data.join("reach").join(name)).unwrap()).collect();
    for episode in &episodes {
        assert_eq!(episode.len(), 13);
        assert!(episode.is_first[0] && episode.is_last[12]);
        assert!(episode.image.iter().any(|pixel| *pixel > 100), "the picture is not black");
        assert!(episode.action.row(0).iter().all(|x| *x == 0.0));
    }
    assert!(episodes[0].image != episodes[1].image, "every episode has its own layout and actions");
    let masked: Vec<_> = episodes.iter().map(|episode| episode.robot_mask.is_some()).collect();
    assert_eq!(masked, [true, false, false]);
    let share = episodes[0].robot_mask.as_ref().unwrap().iter().filter(|pixel| **pixel).count();
    assert!((13 * 100..13 * 2000).contains(&share), "{share} pixels of robot in 13 masks");
    let report = read_json(&json);
    assert_eq!((report["episodes"].as_u64(), report["steps"].as_u64()), (Some(3), Some(36)), "{report}");

    std::fs::remove_file(data.join("reach").join(&names[1])).unwrap();
    let mut command = trainer(&domain, &COLLECT, &data);
    command.arg("--json").arg(&json);
    Running::start(command).succeed();
    let report = read_json(&json);
    assert_eq!((report["episodes"].as_u64(), report["episodes_present"].as_u64()), (Some(1), Some(2)));
    let again = Episode::read(&data.join("reach").join(&names[1])).unwrap();
    assert_eq!(again, episodes[1], "the same seed and number give the same episode");
    assert_eq!(domain.leftovers(), Vec::<String>::new());
}

#[test]
fn a_running_simulator_can_be_joined_and_recorded() {
    let folder = tempfile::tempdir().unwrap();
    let domain = Domain::new();
    let mut simulator = domain.command("rcwm-simulator");
    simulator.args(["serve", "--task", "hammer", "--instance", "arm", "--episodes", "2", "--steps-max", "6"]);
    let mut simulator = Running::start(simulator);
    let words = ["collect", "--join", "arm", "--episodes", "5"];
    let mut recorder = Running::start(trainer(&domain, &words, folder.path()));
    recorder.succeed();
    simulator.succeed();
    let names = files_of(&folder.path().join("hammer"));
    assert_eq!(names.len(), 2, "{names:?}: it had two episodes to give");
    let episode = Episode::read(&folder.path().join("hammer").join(&names[1])).unwrap();
    assert_eq!(episode.len(), 7);
    assert!(episode.action.iter().skip(4).any(|x| x.abs() > 0.1), "random actions were executed");
}

#[test]
fn episodes_get_a_second_look_of_the_same_moments_once() {
    let folder = tempfile::tempdir().unwrap();
    let (data, domain) = (folder.path().join("data"), Domain::new());
    let words = ["collect", "--task", "reach", "--pushed", "1", "--masks", "1", "--steps-max", "12"];
    Running::start(trainer(&domain, &words, &data)).succeed();
    let path = data.join("reach/pushed-seed0-00000.npz");
    let clean = Episode::read(&path).unwrap();
    let with_looks = || {
        let mut command = trainer(&domain, &words, &data);
        command.args(["--beside", "textures"]);
        Running::start(command).succeed();
        Episode::read(&path).unwrap()
    };
    let both = with_looks();
    let disturbed = both.disturbed.clone().unwrap();
    let same = disturbed.iter().zip(&both.image).filter(|(a, b)| a == b).count();
    assert!(same * 2 < both.image.len(), "{same} of {} values look the same", both.image.len());
    assert_eq!(Episode { disturbed: None, ..both.clone() }, clean, "what was there is untouched");
    let written = std::fs::metadata(&path).unwrap().modified().unwrap();
    assert_eq!(with_looks(), both);
    assert_eq!(std::fs::metadata(&path).unwrap().modified().unwrap(), written, "not collected again");

    // Somebody else's episode under that name has no second look.
    let other = Episode { reward: &clean.reward + 1.0, ..clean };
    other.write(&path).unwrap();
    let mut command = trainer(&domain, &words, &data);
    command.args(["--beside", "textures"]);
    let found = command.output().unwrap();
    let text = String::from_utf8_lossy(&found.stderr).into_owned();
    assert!(!found.status.success(), "{text}");
    assert!(text.contains("pushed-seed0-00000") && text.contains("empty folder"), "{text}");
    assert_eq!(Episode::read(&path).unwrap(), other);
}

#[test]
fn ctrl_c_stops_collecting_leaves_whole_episodes_and_no_simulator() {
    let folder = tempfile::tempdir().unwrap();
    let domain = Domain::new();
    let words = ["collect", "--task", "reach", "--random", "500", "--steps-max", "10", "--simulators", "1"];
    let mut collecting = Running::start(trainer(&domain, &words, folder.path()));
    let reach = folder.path().join("reach");
    eventually("an episode", || files_of(&reach).iter().any(|name| name.ends_with(".npz")));
    collecting.signal(rustix::process::Signal::INT);
    collecting.succeed();
    let names = files_of(&reach);
    assert!(names.iter().all(|name| name.ends_with(".npz")), "{names:?}");
    for name in names {
        assert_eq!(Episode::read(&reach.join(name)).unwrap().len(), 11);
    }
    assert_eq!(domain.leftovers(), Vec::<String>::new());
}

#[test]
fn a_simulator_that_fails_is_reported_with_its_last_words() {
    let folder = tempfile::tempdir().unwrap();
    let domain = Domain::new();
    let mut command = trainer(&domain, &COLLECT, folder.path());
    // A program that ends at once, with a reason.
    let failing = folder.path().join("failing");
    std::fs::write(&failing, "#!/bin/sh\necho the arm is on fire >&2\nexit 3\n").unwrap();
    std::fs::set_permissions(&failing, std::os::unix::fs::PermissionsExt::from_mode(0o755)).unwrap();
    command.env("RCWM_SIMULATOR", &failing);
    let refused = output(command);
    let line = String::from_utf8_lossy(&refused.stderr);
    assert!(!refused.status.success() && line.contains("the arm is on fire"), "{line}");
    assert_eq!(line.trim().lines().count(), 1, "{line}");
}

/// Some steps of noise, enough to draw sequences from.
fn write_data(folder: &Path) {
    let mut builder = EpisodeBuilder::new();
    for step in 0..16_u32 {
        let mut observation = OwnedObservation::zeroed(&Format::metaworld());
        observation.step = step;
        observation.flags = ObservationFlags::default()
            .with(ObservationFlags::FIRST, step == 0)
            .with(ObservationFlags::MASK_VALID, true)
            .0;
        for (index, pixel) in observation.edit().image(0).iter_mut().enumerate() {
            *pixel = (index * 7 + step as usize * 31) as u8;
        }
        builder.push(&observation.view()).unwrap();
    }
    std::fs::create_dir_all(folder.join("reach")).unwrap();
    builder.finish().unwrap().write(&folder.join("reach/noise.npz")).unwrap();
}

#[test]
fn a_run_killed_fifty_times_while_it_writes_checkpoints_always_loads() {
    let folder = tempfile::tempdir().unwrap();
    let (data, run) = (folder.path().join("data"), folder.path().join("run"));
    write_data(&data);
    let domain = Domain::new();
    let every =
        ["--set", "checkpoint_every=1", "--set", "film.length=0", "--set", "pretrain.updates=1000000"];
    let mut begin = trainer(&domain, &["pretrain", "--preset", "debug"], &run);
    begin.arg("--data").arg(&data).args(every);
    let mut training = Running::start(begin);
    let mut kills_while_writing = 0;
    let mut updates = 0;
    for round in 0..50 {
        // The first checkpoint of this round, so that every round gets further.
        eventually("a checkpoint", || updates_of(&run) > updates || !training.is_running());
        assert!(training.is_running(), "round {round}: {}", training.printed());
        // Then, at most, until a file is half written; the round's number moves the moment of death about.
        std::thread::sleep(Duration::from_micros(211 * round));
        let deadline = Instant::now() + Duration::from_millis(500);
        while !is_writing(&run) && Instant::now() < deadline {
            std::hint::spin_loop();
        }
        training.kill();
        kills_while_writing += u32::from(is_writing(&run));
        let now = updates_of(&run);
        assert!(now > updates, "round {round}: {now} updates after {updates}");
        updates = now;
        training = Running::start(trainer(&domain, &["pretrain", "--resume"], &run));
    }
    assert!(kills_while_writing >= 10, "only {kills_while_writing} of 50 fell into the writing of a file");
    eventually("a checkpoint", || updates_of(&run) > updates || !training.is_running());
    training.signal(rustix::process::Signal::INT);
    training.succeed();
    let checkpoint = run.join("checkpoints/last");
    assert!(
        !files_of(&checkpoint).iter().any(|name| name.starts_with(".writing-")),
        "{:?}",
        files_of(&checkpoint)
    );
    let mut export = trainer(&domain, &["export"], &folder.path().join("bundle"));
    export.arg("--checkpoint").arg(&checkpoint);
    Running::start(export).succeed();
}

/// Updates of the newest checkpoint; 0 before the first. It is replaced in one step, so that it can be read at any time.
fn updates_of(run: &Path) -> u64 {
    let text = std::fs::read_to_string(run.join("checkpoints/last/checkpoint.toml")).unwrap_or_default();
    let line = text.lines().find_map(|line| line.strip_prefix("updates = "));
    line.map_or(0, |number| number.trim().parse().unwrap())
}

fn is_writing(run: &Path) -> bool {
    files_of(&run.join("checkpoints/last")).iter().any(|name| name.starts_with(".writing-"))
}
