//! What people do with files and terminals: pipes that close, disks that are full, names that are taken, runs that come back.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::thread::JoinHandle;

use rcwm_models::episode::Episode;
use rcwm_models::tasks::task_id;
use rcwm_models::wire::{Format, ObservationFlags, OwnedObservation, SimulatorLink};
use rcwm_testkit::{OwnLink, ask, observation, own_link, smallest_bundle};

/// Standard output whose reader is gone.
fn closed() -> Stdio {
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    writer.into()
}

/// Standard output on a disk without room.
fn full() -> Stdio {
    fs::OpenOptions::new().write(true).open("/dev/full").unwrap().into()
}

fn runtime(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rcwm-runtime"));
    command.args(arguments).stdin(Stdio::null());
    command
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// A robot on a link of its own, which plays an episode of some steps as soon as somebody answers.
struct Robot {
    link: OwnLink,
    thread: Option<JoinHandle<()>>,
}

impl Robot {
    fn playing(steps: u32, change: impl Fn(&mut OwnedObservation) + Send + 'static) -> Self {
        let link = own_link();
        let settings = link.0.clone();
        let play = move || {
            let peer = SimulatorLink::open(settings, &Format::metaworld()).unwrap();
            for step in 0..steps {
                let mut sent = observation(u64::from(step), step);
                sent.reward = 1.0;
                sent.flags |= if step + 1 == steps { ObservationFlags::LAST.0 } else { 0 };
                change(&mut sent);
                ask(&peer, &sent);
            }
            peer.close().unwrap();
        };
        Self { link, thread: Some(std::thread::spawn(play)) }
    }

    /// Runs the controller of this robot.
    fn run(mut self, arguments: &[&str], stdout: Stdio) -> Output {
        let mut command = runtime(&["run", "--timeout", "60", "--bundle"]);
        command.arg(smallest_bundle()).args(["--instance", &self.link.0.instance]).args(arguments);
        let output = command.env("RCWM_PREFIX", self.link.prefix()).stdout(stdout).output().unwrap();
        self.thread.take().unwrap().join().unwrap();
        output
    }
}

#[test]
fn a_closed_pipe_is_no_error_and_a_full_disk_is_one_line() {
    let bundle = smallest_bundle();
    for verb in ["inspect", "verify"] {
        let command = || runtime(&[verb, "--bundle", bundle.to_str().unwrap()]);
        let output = command().stdout(closed()).output().unwrap();
        assert!(output.status.success(), "{verb}: {}", text(&output));
        let output = command().stdout(full()).output().unwrap();
        assert_eq!(output.status.code(), Some(1), "{verb}");
        assert!(text(&output).contains("error: standard output: No space left"), "{verb}: {}", text(&output));
        let output = command().stdout(Stdio::null()).stderr(full()).output().unwrap();
        assert!(output.status.success(), "{verb}: what cannot be told on stderr is not told");
    }
}

#[test]
fn the_summary_that_nobody_reads_costs_no_result() {
    for stdout in [closed as fn() -> Stdio, full] {
        let folder = tempfile::tempdir().unwrap();
        let json = folder.path().join("not/yet/there/run.json");
        let output = Robot::playing(5, |_| ()).run(&["--json", json.to_str().unwrap()], stdout());
        assert!(!text(&output).contains("panicked"), "{}", text(&output));
        let report: serde_json::Value = serde_json::from_slice(&fs::read(&json).unwrap()).unwrap();
        assert_eq!(report["whole_episodes"], 1);
    }
}

#[test]
fn json_on_standard_output_is_nothing_but_json() {
    let output = runtime(&["inspect", "--json", "-", "--bundle"]).arg(smallest_bundle()).output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    serde_json::from_slice::<serde_json::Value>(&output.stdout).unwrap();
    assert!(text(&output).contains("robot"), "what is for people is on stderr");
}

#[test]
fn an_output_that_cannot_be_written_is_found_before_the_work_and_nothing_is_replaced_by_it() {
    let folder = tempfile::tempdir().unwrap();
    let precious = folder.path().join("run.rcwmlog");
    fs::write(&precious, b"rcwm-log and more").unwrap();
    let bundle = smallest_bundle();
    let refuse = |arguments: &[&str], said: &str| {
        let output = runtime(arguments).args(["--bundle", bundle.to_str().unwrap()]).output().unwrap();
        assert_eq!(output.status.code(), Some(1), "{arguments:?}: {}", text(&output));
        assert!(text(&output).contains(said), "{arguments:?}: {}", text(&output));
    };
    let (place, file) = (folder.path().to_str().unwrap(), precious.to_str().unwrap());
    refuse(&["verify", "--json", place], "not a plain file");
    refuse(&["verify", "--json", file], "something else than JSON");
    refuse(&["bench", "--plot", file], "something else than a PNG picture");
    refuse(&["run", "--instance", "a", "--json", "x.json", "--log", "x.json"], "name one file");
    assert_eq!(fs::read(&precious).unwrap(), b"rcwm-log and more");
}

#[test]
fn a_run_that_is_started_again_keeps_the_older_log_and_writes_the_next() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("logs/arm.rcwmlog");
    let arguments = ["--log", log.to_str().unwrap()];
    let robot = || Robot::playing(5, |_| ());
    assert!(robot().run(&arguments, Stdio::null()).status.success());
    let first = fs::read(&log).unwrap();
    let output = robot().run(&arguments, Stdio::null());
    assert!(output.status.success() && text(&output).contains("arm-2.rcwmlog"), "{}", text(&output));
    assert_eq!(fs::read(&log).unwrap(), first);
    assert!(log.with_file_name("arm-2.rcwmlog").is_file());
}

#[test]
fn a_run_that_nobody_came_to_leaves_no_log_in_the_next_ones_way() {
    let (link, folder) = (own_link(), tempfile::tempdir().unwrap());
    let log = folder.path().join("arm.rcwmlog");
    for _ in 0..2 {
        let mut command = runtime(&["run", "--instance", "nobody", "--timeout", "0.2", "--bundle"]);
        command.arg(smallest_bundle()).arg("--log").arg(&log).env("RCWM_PREFIX", link.prefix());
        let output = command.output().unwrap();
        assert_eq!(output.status.code(), Some(3), "{}", text(&output));
        assert!(!log.exists());
    }
}

#[test]
fn episodes_of_two_logs_lie_side_by_side_and_those_of_one_log_once() {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data");
    let log = |number: u8| folder.path().join(format!("{number}.rcwmlog"));
    for number in 1..=2 {
        let robot = Robot::playing(5, move |sent| sent.reward = f32::from(number));
        let output = robot.run(&["--log", log(number).to_str().unwrap()], Stdio::null());
        assert!(output.status.success(), "{}", text(&output));
    }
    let replay = |number: u8| {
        let mut command = runtime(&["replay", "--log"]);
        let output = command.arg(log(number)).arg("--episodes").arg(&data).output().unwrap();
        assert!(output.status.success(), "{}", text(&output));
    };
    for number in [1, 2, 1, 2] {
        replay(number);
    }
    let mut returns: Vec<f64> =
        files(&data.join("own")).iter().map(|file| Episode::read(file).unwrap().total_reward()).collect();
    returns.sort_by(f64::total_cmp);
    assert_eq!(returns, [5.0, 10.0]);
}

#[test]
fn a_folder_of_recordings_is_gone_on_with() {
    let folder = tempfile::tempdir().unwrap();
    let arguments = ["--record", folder.path().to_str().unwrap()];
    for _ in 0..2 {
        let output = Robot::playing(5, |_| ()).run(&arguments, Stdio::null());
        assert!(output.status.success(), "{}", text(&output));
    }
    let episodes: Vec<PathBuf> =
        files(folder.path()).into_iter().filter(|file| file.extension().unwrap() == "npz").collect();
    let names: Vec<_> = episodes.iter().map(|file| file.file_name().unwrap().to_str().unwrap()).collect();
    assert_eq!(names, ["episode-0000.npz", "episode-0001.npz"]);
}

#[test]
fn a_second_run_in_a_folder_or_file_that_is_in_use_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let _lock = rcwm_models::lock::Lock::take(folder.path()).unwrap();
    let link = own_link();
    let run = |option: &str, path: &Path| {
        let mut command = runtime(&["run", "--instance", "a", "--timeout", "0.2", "--bundle"]);
        command.arg(smallest_bundle()).arg(option).arg(path).env("RCWM_PREFIX", link.prefix());
        let output = command.output().unwrap();
        assert_eq!(output.status.code(), Some(1), "{option}: {}", text(&output));
        assert!(text(&output).contains("in use"), "{option}: {}", text(&output));
    };
    run("--record", folder.path());
    let telemetry = folder.path().join("arm.jsonl");
    fs::write(&telemetry, b"").unwrap();
    let _held = rcwm_models::lock::Lock::take(&telemetry).unwrap();
    run("--telemetry", &telemetry);
}

#[test]
fn a_robot_of_another_task_and_rate_is_remarked_and_in_the_json() {
    let folder = tempfile::tempdir().unwrap();
    let bundle = rcwm_testkit::with_manifest(|manifest| manifest.task = "hammer".into());
    let json = folder.path().join("run.json");
    let robot = Robot::playing(8, |sent| sent.task = task_id("reach").unwrap());
    let mut arguments = vec!["--json", json.to_str().unwrap()];
    arguments.extend(["--bundle", bundle.path().to_str().unwrap()]);
    let mut robot = robot;
    let mut command = runtime(&["run", "--timeout", "60", "--instance", &robot.link.0.instance]);
    let output = command.args(arguments).env("RCWM_PREFIX", robot.link.prefix()).output().unwrap();
    robot.thread.take().unwrap().join().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    let remark = "the task is reach, but the policy was trained for hammer";
    assert!(text(&output).contains(remark), "{}", text(&output));
    let report: serde_json::Value = serde_json::from_slice(&fs::read(&json).unwrap()).unwrap();
    assert_eq!(report["remarks"][0], remark);
}

#[test]
fn what_is_no_bundle_is_told_apart() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |path: &Path| {
        let output = runtime(&["inspect", "--bundle"]).arg(path).output().unwrap();
        assert_eq!(output.status.code(), Some(1));
        text(&output)
    };
    let file = smallest_bundle().join("manifest.toml");
    assert!(refused(&file).contains("is a file; expected the folder"), "{}", refused(&file));
    fs::create_dir_all(folder.path().join("checkpoints/last")).unwrap();
    fs::write(folder.path().join("checkpoints/last/checkpoint.toml"), b"").unwrap();
    let said = refused(folder.path());
    assert!(said.contains("is a checkpoint") && said.contains("rcwm-trainer export"), "{said}");
}

#[test]
fn a_bundle_of_links_is_read_as_the_files_it_leads_to() {
    let folder = tempfile::tempdir().unwrap();
    for file in files(&smallest_bundle()) {
        std::os::unix::fs::symlink(&file, folder.path().join(file.file_name().unwrap())).unwrap();
    }
    let output = runtime(&["verify", "--bundle"]).arg(folder.path()).output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let mut files: Vec<_> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}
