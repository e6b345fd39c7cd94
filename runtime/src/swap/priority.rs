//! The server's thread gives way to everything else; what it makes for the controller does not.

use std::collections::BTreeSet;
use std::io;

use rustix::process::{Pid, getpriority_process, setpriority_process};

/// Gives the calling thread the lowest ordinary priority, whatever it inherited: a controller that runs under SCHED_FIFO hands
/// that on to the threads it starts. Gives what the system said where it refused.
///
/// Not SCHED_IDLE: this thread shares the allocator's locks with the one that ticks, and must not be stopped for long while it
/// holds one.
pub(super) fn lower() -> io::Result<()> {
    // 0 is the calling thread.
    set_policy(0, libc::SCHED_BATCH, libc::sched_param { sched_priority: 0 })?;
    // On Linux this is the calling thread's alone.
    Ok(setpriority_process(None, 19)?)
}

/// The threads of this process.
pub(super) fn threads() -> io::Result<BTreeSet<i32>> {
    let entries = std::fs::read_dir("/proc/self/task")?;
    let ids = entries.map(|entry| Ok(entry?.file_name().to_str().and_then(|name| name.parse().ok())));
    ids.filter_map(Result::transpose).collect()
}

/// Gives `to` the scheduling of `from`. Threads that an engine starts for a policy have inherited the server's priority, and must not
/// hold up the ticks they work for.
pub(super) fn give(from: i32, to: i32) -> io::Result<()> {
    let mut parameters = libc::sched_param { sched_priority: 0 };
    // SAFETY: plain numbers; nothing is written.
    let policy = unsafe { libc::sched_getscheduler(from) };
    // SAFETY: the place is valid for writing during the call.
    if policy < 0 || unsafe { libc::sched_getparam(from, &raw mut parameters) } != 0 {
        return Err(io::Error::last_os_error());
    }
    set_policy(to, policy, parameters)?;
    Ok(setpriority_process(Pid::from_raw(to), getpriority_process(Pid::from_raw(from))?)?)
}

fn set_policy(thread: i32, policy: i32, parameters: libc::sched_param) -> io::Result<()> {
    // SAFETY: the parameters are read during the call only.
    match unsafe { libc::sched_setscheduler(thread, policy, &raw const parameters) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::thread::gettid;

    #[test]
    fn the_thread_that_asks_gets_the_lowest_priority_and_no_other() {
        let of_thread = || getpriority_process(None).unwrap();
        let before = of_thread();
        let lowered = std::thread::spawn(move || {
            lower().unwrap();
            of_thread()
        });
        assert_eq!(lowered.join().unwrap(), 19);
        assert_eq!(of_thread(), before);
    }

    #[test]
    fn what_a_thread_starts_is_found_and_given_the_scheduling_of_another() {
        let asking = gettid().as_raw_nonzero().get();
        let before = threads().unwrap();
        assert!(before.contains(&asking));
        let (ready, started) = std::sync::mpsc::channel();
        let (stop, stopped) = std::sync::mpsc::channel::<()>();
        let server = std::thread::spawn(move || {
            lower().unwrap();
            let helper = std::thread::spawn(move || {
                ready.send(gettid()).unwrap();
                stopped.recv().unwrap_err();
            });
            helper.join().unwrap();
        });
        let helper = started.recv().unwrap();
        let priority = || getpriority_process(Some(helper)).unwrap();
        assert!(threads().unwrap().contains(&helper.as_raw_nonzero().get()));
        assert_eq!(priority(), 19);
        match give(asking, helper.as_raw_nonzero().get()) {
            Ok(()) => assert_eq!(priority(), getpriority_process(None).unwrap()),
            // Only who may raise a priority can do it.
            Err(error) => assert_eq!(error.kind(), io::ErrorKind::PermissionDenied),
        }
        drop(stop);
        server.join().unwrap();
    }
}
