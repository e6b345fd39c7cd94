//! The parent's view of a child: asked, watched, killed, started again.

use std::io::{BufRead, BufReader, Read, Write};
use std::process::{ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration;

use anyhow::Context;

use crate::Arguments;
use crate::worker::Outcome;

/// How a case ended, seen from outside.
pub(crate) enum Ended {
    /// The child answered.
    Answered(Outcome),
    /// The child died; its last words.
    Died(String),
    /// The child did not answer in time and was killed.
    Hung,
}

/// A running child.
pub(crate) struct Child {
    process: std::process::Child,
    seeds: ChildStdin,
    answers: Receiver<String>,
    /// Collects what it prints to stderr; ends with it.
    words: std::thread::JoinHandle<String>,
}

impl Child {
    pub(crate) fn start(arguments: &Arguments) -> anyhow::Result<Self> {
        let mut command = Command::new(std::env::current_exe().context("own program")?);
        command.args(["--worker", "--memory-mib", &arguments.memory_mib.to_string(), "--bundle"]);
        command.arg(&arguments.bundle);
        if let Some(folder) = &arguments.keep {
            command.arg("--keep").arg(folder);
        }
        command
            .env("RUST_BACKTRACE", "0")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        let mut process = command.spawn().context("starting a child")?;
        let pipe = "all three were asked to be pipes";
        let seeds = process.stdin.take().expect(pipe);
        let (stdout, stderr) = (process.stdout.take().expect(pipe), process.stderr.take().expect(pipe));
        let (sender, answers) = channel();
        std::thread::spawn(move || {
            for line in BufReader::new(stdout).lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        let words = std::thread::spawn(move || last_words(stderr));
        Ok(Self { process, seeds, answers, words })
    }

    /// Has a case worked on; a child that does not survive it is replaced.
    pub(crate) fn work_on(&mut self, seed: u64, arguments: &Arguments) -> anyhow::Result<Ended> {
        // A child that died before it was asked shows below as one that does not answer.
        let _ = writeln!(self.seeds, "{seed}").and_then(|()| self.seeds.flush());
        let timeout = Duration::from_secs_f64(arguments.wall_s_max);
        match self.answers.recv_timeout(timeout) {
            Ok(line) => Ok(Ended::Answered(serde_json::from_str(&line).context(line)?)),
            Err(reason) => {
                let gone = std::mem::replace(self, Self::start(arguments)?);
                let words = gone.end()?;
                Ok(if reason == RecvTimeoutError::Timeout { Ended::Hung } else { Ended::Died(words) })
            }
        }
    }

    /// Kills it where it still runs; gives its last words.
    fn end(mut self) -> anyhow::Result<String> {
        // It may be gone already.
        let _ = self.process.kill();
        let status = self.process.wait().context("waiting for a child")?;
        drop(self.seeds);
        let words = self.words.join().unwrap_or_default();
        Ok(format!("{status}: {words}"))
    }
}

/// The end of what is printed, on one line.
fn last_words(mut stderr: impl Read) -> String {
    const KEPT: usize = 2000;
    let (mut kept, mut buffer) = (Vec::new(), [0; 4096]);
    while let Ok(len @ 1..) = stderr.read(&mut buffer) {
        kept.extend_from_slice(&buffer[..len]);
        let surplus = kept.len().saturating_sub(KEPT);
        kept.drain(..surplus);
    }
    String::from_utf8_lossy(&kept).split_whitespace().collect::<Vec<_>>().join(" ")
}
