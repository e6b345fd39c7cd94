//! `make learn` in small: a task from demonstrations to a deployed, scored policy with its card, and again from where it was.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::path::Path;
use std::process::Command;

use rcwm_models::episode::Episode;
use rcwm_tests::{Domain, Running, binary, read_json, root};

/// The script as `make learn` calls it: two demonstrations, one episode to be scored by.
fn learn(domain: &Domain, pretrained: &Path, out: &Path) -> Command {
    let mut command = Command::new(root().join("scripts/learn"));
    let target = binary("rcwm-trainer").ancestors().nth(2).unwrap().to_path_buf();
    command.arg("button-press").arg(pretrained).arg(out).args(["2", "1"]);
    command.env("CARGO_TARGET_DIR", target).env("RCWM_PREFIX", domain.prefix());
    command.stdin(std::process::Stdio::null());
    command
}

#[test]
fn a_task_is_learnt_deployed_and_scored_in_one_go() {
    let folder = tempfile::tempdir().unwrap();
    let (pretrained, out) = (folder.path().join("pretrained"), folder.path().join("out"));
    let domain = Domain::new();
    let mut init = domain.command("rcwm-trainer");
    init.args(["init", "--preset", "debug", "--out"]).arg(&pretrained);
    Running::start(init).succeed();

    Running::start(learn(&domain, &pretrained, &out)).succeed();
    let demonstrations = out.join("demonstrations/button-press");
    let mut pushed = 0;
    for entry in std::fs::read_dir(&demonstrations).unwrap() {
        let episode = Episode::read(&entry.unwrap().path()).unwrap();
        assert!(episode.len() > 100 && !episode.pushed[0]);
        pushed += episode.pushed.iter().filter(|pushed| **pushed).count();
    }
    assert!(pushed > 0, "nobody was pushed off course");
    let success = read_json(&out.join("success.json"));
    assert_eq!(success["tasks"][0]["episodes"], 1, "{success}");
    let card = std::fs::read_to_string(out.join("bundle/README.md")).unwrap();
    for part in ["# button-press", "| success, button-press |", "| demonstrations | 2, of ", "film.gif"] {
        assert!(card.contains(part), "{part:?} is not in {card}");
    }
    assert!(!card.contains(folder.path().to_str().unwrap()), "a path of this machine: {card}");
    assert!(std::fs::metadata(out.join("bundle/film.gif")).unwrap().len() > 1000);

    // The same again finds demonstrations and policy, and ends with the same numbers.
    let mut again = Running::start(learn(&domain, &pretrained, &out));
    again.succeed();
    assert!(again.printed().contains("0 episodes, 0 steps"), "{}", again.printed());
    let repeated = read_json(&out.join("success.json"));
    assert_eq!(repeated["tasks"][0]["returns"], success["tasks"][0]["returns"]);
    assert_eq!(domain.leftovers(), Vec::<String>::new());
}

#[test]
fn every_policy_that_ships_is_verified_and_has_a_card_and_a_film() {
    let mut policies = 0;
    for entry in std::fs::read_dir(root().join("models/bundles")).unwrap() {
        let bundle = entry.unwrap().path();
        if !bundle.is_dir() {
            continue;
        }
        let mut verify = Command::new(binary("rcwm-runtime"));
        verify.arg("verify").arg("--bundle").arg(&bundle);
        Running::start(verify).succeed();
        if !bundle.ends_with("untrained") {
            let card = std::fs::read_to_string(bundle.join("README.md")).unwrap();
            assert!(card.contains("; 95% ") && bundle.join("film.gif").is_file(), "{}", bundle.display());
            policies += 1;
        }
    }
    assert!(policies > 0);
    let mut verify = Command::new(binary("rcwm-runtime"));
    verify.arg("verify").arg("--bundle").arg(root().join("models/small/bundle"));
    Running::start(verify).succeed();
}
