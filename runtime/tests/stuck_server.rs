//! A server that does not get on, whatever a bundle or the machine makes it do: nobody waits for it. The server's thread alone is held, by
//! ptrace, as if it loaded for ever.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::process::{Child, Stdio};
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use rcwm_models::wire::Wait;
use rcwm_runtime::swap::{Answer, When, ask};
use rcwm_testkit::{OwnLink, observation, own_link, smallest_bundle};
use rustix::process::{Pid, Signal, kill_process};

/// Far longer than anything here takes.
const NEVER: Duration = Duration::from_secs(20);

fn start(link: &OwnLink) -> Child {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_rcwm-runtime"));
    command.env("RCWM_PREFIX", link.prefix()).args(["run", "--instance", "test", "--bundle"]);
    command.arg(smallest_bundle()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
}

/// The run's thread of this name, once it is there.
fn thread_of(run: &Child, wanted: &str) -> i32 {
    let start = Instant::now();
    while start.elapsed() < NEVER {
        for entry in std::fs::read_dir(format!("/proc/{}/task", run.id())).unwrap().flatten() {
            let name = std::fs::read_to_string(entry.path().join("comm")).unwrap_or_default();
            if name.trim_end() == wanted {
                return entry.file_name().to_str().unwrap().parse().unwrap();
            }
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    panic!("the run has no thread {wanted:?}");
}

/// Stops one thread of a child; false where the system does not let us.
fn hold(thread: i32) -> bool {
    let none = std::ptr::null_mut::<libc::c_void>();
    // SAFETY: the requests take no memory of ours, and the thread is a child's.
    let seized = unsafe {
        libc::ptrace(libc::PTRACE_SEIZE, thread, none, none) == 0
            && libc::ptrace(libc::PTRACE_INTERRUPT, thread, none, none) == 0
    };
    // SAFETY: no status is asked for.
    seized && unsafe { libc::waitpid(thread, std::ptr::null_mut(), libc::__WALL) } == thread
}

/// Waits until a thread that is held is no more: its process cannot end before that is seen.
fn is_gone(thread: i32) -> bool {
    let start = Instant::now();
    while start.elapsed() < NEVER {
        // SAFETY: no status is asked for.
        if unsafe { libc::waitpid(thread, std::ptr::null_mut(), libc::__WALL | libc::WNOHANG) } == thread {
            return true;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    false
}

#[test]
fn neither_who_asks_nor_the_end_of_the_run_waits_for_a_server_that_does_not_get_on() {
    let link = own_link();
    let peer = link.peer();
    let mut run = start(&link);
    rcwm_testkit::ask(&peer, &observation(0, 0));
    let server = thread_of(&run, "swap");
    if !hold(server) {
        eprintln!("left out: this system does not let a program hold a thread of its child");
        run.kill().unwrap();
        run.wait().unwrap();
        return;
    }
    let mut heard = Vec::new();
    let timeout = Some(Duration::from_millis(200));
    let stop = AtomicBool::new(false);
    let answer = ask(&link.0, &smallest_bundle(), When::Now, timeout, &stop, &mut |answer| {
        heard.push(answer.clone());
    });
    assert_eq!((answer.unwrap(), heard), (Answer::Withdrawn, vec![]));
    // The run itself goes on.
    rcwm_testkit::ask(&peer, &observation(1, 1));
    peer.poll_events().unwrap();
    kill_process(Pid::from_child(&run), Signal::TERM).unwrap();
    let mut told = false;
    let start = Instant::now();
    while !told && start.elapsed() < NEVER {
        let (wait, events) = peer.wait_action(Duration::from_millis(20)).unwrap();
        told = events.closed;
        // The last one may have been asked for twice, and then is answered twice.
        assert!(!matches!(&wait, Wait::Message(action) if action.answers != 1), "{wait:?}");
    }
    assert!(told, "the robot was not told");
    let gone = is_gone(server);
    if !gone {
        run.kill().unwrap();
    }
    assert!(gone, "the run has not ended");
    assert_eq!(run.wait().unwrap().code(), Some(0));
}
