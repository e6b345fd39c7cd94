//! What Linux grants a thread that must be on time: a fixed priority before all ordinary threads, memory that stays, a core.
//!
//! Everything is asked for, then read back: what is reported is what holds, not what was asked for. None of it makes Linux a hard
//! real-time system; whether the kernel is a PREEMPT_RT one is reported beside it.

use std::io::Error;

use rustix::process::Pid;
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};
use serde::Serialize;

use rcwm_kernels::team::HELPER_NAME;

/// What to ask for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Request {
    /// SCHED_FIFO with this priority, 1 to 99, and locked memory.
    pub priority: Option<u8>,
    /// Keeps the thread on this core.
    pub cpu: Option<usize>,
}

/// One thing that was asked for.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Grant {
    pub what: String,
    /// Whether it holds, as read back from the system.
    pub granted: bool,
    /// What was read back, or why it was refused.
    pub detail: String,
}

/// Everything that was asked for, and the kernel it was asked of.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Granted {
    /// One entry for each thing that was asked for.
    pub grants: Vec<Grant>,
    /// Whether the kernel says that it is a PREEMPT_RT one.
    pub kernel_preempt_rt: bool,
    /// Share of the time for which the kernel stops real-time threads that never rest; none where it does not.
    pub throttled_share: Option<f64>,
}

impl Granted {
    /// Whether all that was asked for holds.
    #[must_use]
    pub fn all(&self) -> bool {
        self.grants.iter().all(|grant| grant.granted)
    }

    /// One line for each thing, and one for the kernel.
    pub fn lines(&self) -> impl Iterator<Item = String> {
        let grants = self.grants.iter().map(|Grant { what, granted, detail }| {
            format!("{what}: {}: {detail}", if *granted { "granted" } else { "refused" })
        });
        let kernel = match self.kernel_preempt_rt {
            true => "kernel: PREEMPT_RT",
            false => "kernel: not PREEMPT_RT, so that the longest delay is not bounded",
        };
        let throttled = self.throttled_share.map(|share| {
            format!(
                "kernel: stops real-time threads that never rest for {:.0} % of the time (sched_rt_runtime_us): let the loop \
                 spin for less than its period",
                100.0 * share
            )
        });
        grants.chain([kernel.to_owned()]).chain(throttled)
    }
}

/// Asks for it, for the calling thread (priority, core), the second threads of ticks (priority) and the process (memory); none where nothing is asked for.
#[must_use]
pub fn ask(request: Request) -> Option<Granted> {
    if request == Request::default() {
        return None;
    }
    let mut grants = Vec::new();
    if let Some(priority) = request.priority {
        grants.push(fixed_priority(priority, THIS_THREAD, "the loop's thread"));
        grants.extend(ask_for_helpers(request));
        grants.push(locked_memory());
    }
    if let Some(cpu) = request.cpu {
        grants.push(one_core(cpu));
    }
    let kernel = std::fs::read_to_string("/sys/kernel/realtime");
    let kernel_preempt_rt = kernel.is_ok_and(|text| text.trim() == "1");
    let throttled_share = request.priority.and_then(|_| throttled_share());
    Some(Granted { grants, kernel_preempt_rt, throttled_share })
}

/// Asks for the priority of the second threads alone, for some that began after [`ask`].
#[must_use]
pub fn ask_for_helpers(request: Request) -> Vec<Grant> {
    let all = |priority| {
        let ask = move |helper| fixed_priority(priority, helper, "the tick's second thread");
        helpers().into_iter().map(ask).collect()
    };
    request.priority.map(all).unwrap_or_default()
}

/// What the kernel keeps from real-time threads.
fn throttled_share() -> Option<f64> {
    let read = |name: &str| -> Option<f64> {
        std::fs::read_to_string(format!("/proc/sys/kernel/{name}")).ok()?.trim().parse().ok()
    };
    let (runtime, period) = (read("sched_rt_runtime_us")?, read("sched_rt_period_us")?);
    // -1 means all of it.
    (runtime >= 0.0 && runtime < period).then(|| 1.0 - runtime / period)
}

/// Makes the process keep the memory it has been given, where the C library is glibc; elsewhere it does nothing. glibc's allocator hands
/// the upper end of the heap back whenever 128 KiB of it are free, and gets it again from the kernel page by page: several page faults a
/// tick. At most 64 MiB are kept free so. It holds for the whole process and does no harm twice: for a program that runs ticks, first
/// thing in `main`.
pub fn keep_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    for (parameter, bytes) in [(libc::M_TRIM_THRESHOLD, KEPT_FREE), (libc::M_MMAP_THRESHOLD, MAPPED_ALONE)] {
        // SAFETY: it sets a number in the allocator, under its lock; a number that it refuses changes nothing.
        unsafe { libc::mallopt(parameter, bytes) };
    }
}

/// Free bytes at the heap's end that are kept.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const KEPT_FREE: libc::c_int = 64 << 20;
/// Blocks from this size on come from the kernel and go back to it, as the largest of a bundle while it is read.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const MAPPED_ALONE: libc::c_int = 16 << 20;

fn grant(what: String, result: Result<String, String>) -> Grant {
    let granted = result.is_ok();
    Grant { what, granted, detail: result.unwrap_or_else(|reason| reason) }
}

/// Number of the calling thread in the scheduler's calls.
const THIS_THREAD: i32 = 0;

/// Second threads of the ticks of this process.
fn helpers() -> Vec<i32> {
    let entries = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
    let is_helper = |entry: &std::fs::DirEntry| {
        std::fs::read_to_string(entry.path().join("comm")).is_ok_and(|name| name.trim_end() == HELPER_NAME)
    };
    entries.filter(is_helper).filter_map(|entry| entry.file_name().to_str()?.parse().ok()).collect()
}

fn fixed_priority(priority: u8, thread: i32, whose: &str) -> Grant {
    let what = format!("SCHED_FIFO priority {priority}");
    grant(
        what,
        set_fixed_priority(priority, thread).and_then(|()| read_fixed_priority(priority, thread, whose)),
    )
}

fn set_fixed_priority(priority: u8, thread: i32) -> Result<(), String> {
    let param = libc::sched_param { sched_priority: i32::from(priority) };
    // Threads that this one starts later are ordinary ones again.
    let policy = libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK;
    // SAFETY: `param` lives through the call.
    match unsafe { libc::sched_setscheduler(thread, policy, &raw const param) } {
        0 => Ok(()),
        _ => Err(format!("{}; run as root, give CAP_SYS_NICE, or raise `ulimit -r`", Error::last_os_error())),
    }
}

fn read_fixed_priority(expected: u8, thread: i32, whose: &str) -> Result<String, String> {
    let mut param = libc::sched_param { sched_priority: 0 };
    // SAFETY: it only asks.
    let policy = unsafe { libc::sched_getscheduler(thread) };
    // SAFETY: `param` lives through the call.
    let read = unsafe { libc::sched_getparam(thread, &raw mut param) };
    let found = param.sched_priority;
    if read == 0 && policy & !libc::SCHED_RESET_ON_FORK == libc::SCHED_FIFO && found == i32::from(expected) {
        Ok(format!("{whose} runs with SCHED_FIFO, priority {found}"))
    } else {
        Err(format!("the system says policy {policy}, priority {found}"))
    }
}

fn locked_memory() -> Grant {
    // SAFETY: locking pages changes no memory that a program can see.
    let result = match unsafe { libc::mlockall(libc::MCL_CURRENT | libc::MCL_FUTURE) } {
        0 => locked_kb().filter(|kb| *kb > 0).map_or_else(
            || Err("the system says that no memory is locked".to_owned()),
            |kb| Ok(format!("{:.1} MiB locked, and what will be allocated", kb as f64 / 1024.0)),
        ),
        _ => Err(format!("{}; run as root, give CAP_IPC_LOCK, or raise `ulimit -l`", Error::last_os_error())),
    };
    grant("locked memory".into(), result)
}

/// Memory that the system says is locked, in kB.
fn locked_kb() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmLck:"))?;
    line.trim().strip_suffix("kB")?.trim().parse().ok()
}

fn one_core(cpu: usize) -> Grant {
    let result = if cpu < CpuSet::MAX_CPU { keep_on(cpu) } else { Err("no such core".to_owned()) };
    grant(format!("core {cpu}"), result)
}

fn keep_on(cpu: usize) -> Result<String, String> {
    let this_thread: Option<Pid> = None;
    let mut wanted = CpuSet::new();
    wanted.set(cpu);
    sched_setaffinity(this_thread, &wanted)
        .map_err(|error| format!("{error}; is there such a core, and may this process use it?"))?;
    match sched_getaffinity(this_thread) {
        Ok(found) if found == wanted => Ok("the loop's thread stays on it".into()),
        Ok(found) => Err(format!("the system says {} cores", found.count())),
        Err(error) => Err(error.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// In a thread of its own: priority and core belong to threads.
    fn asked(request: Request) -> Option<Granted> {
        std::thread::spawn(move || ask(request)).join().unwrap()
    }

    /// Without it, some 200 page faults a round: the allocator hands memory back that is asked for again at once.
    #[test]
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    fn memory_that_is_freed_is_not_asked_of_the_kernel_again() {
        keep_memory();
        let round = || drop([(); 8].map(|()| std::hint::black_box(vec![1_u8; 100 << 10])));
        let faults = || {
            // SAFETY: a struct of integers that the call fills.
            let mut usage: libc::rusage = unsafe { std::mem::zeroed() };
            // SAFETY: `usage` lives through the call.
            unsafe { libc::getrusage(libc::RUSAGE_THREAD, &raw mut usage) };
            usage.ru_minflt
        };
        (0..10).for_each(|_| round());
        let before = faults();
        (0..100).for_each(|_| round());
        let found = faults() - before;
        assert!(found < 100, "{found} page faults in 100 rounds");
    }

    #[test]
    fn nothing_is_asked_for_unless_wanted() {
        assert_eq!(asked(Request::default()), None);
    }

    #[test]
    fn a_core_is_granted_where_there_is_one_and_refused_where_there_is_none() {
        let available = sched_getaffinity(None).unwrap();
        let cpu = (0..CpuSet::MAX_CPU).find(|cpu| available.is_set(*cpu)).unwrap();
        let granted = asked(Request { priority: None, cpu: Some(cpu) }).unwrap();
        assert!(granted.all() && granted.grants.len() == 1, "{granted:?}");
        for none in [CpuSet::MAX_CPU - 1, CpuSet::MAX_CPU, usize::MAX] {
            let refused = asked(Request { priority: None, cpu: Some(none) }).unwrap();
            assert!(!refused.all() && !refused.grants[0].detail.is_empty(), "{refused:?}");
        }
    }

    #[test]
    fn a_priority_that_does_not_exist_is_refused_with_a_reason() {
        let refused = grant("priority".into(), set_fixed_priority(200, THIS_THREAD).map(|()| String::new()));
        assert!(!refused.granted && refused.detail.contains("CAP_SYS_NICE"), "{refused:?}");
    }

    #[test]
    fn what_is_not_granted_is_said_line_by_line() {
        let grants = vec![
            Grant { what: "core 1".into(), granted: true, detail: "kept".into() },
            Grant { what: "SCHED_FIFO priority 50".into(), granted: false, detail: "not permitted".into() },
        ];
        let granted = Granted { grants, kernel_preempt_rt: false, throttled_share: Some(0.05) };
        let lines: Vec<_> = granted.lines().collect();
        assert_eq!(lines[0], "core 1: granted: kept");
        assert_eq!(lines[1], "SCHED_FIFO priority 50: refused: not permitted");
        assert!(
            lines[2].contains("not PREEMPT_RT")
                && lines[3].contains("for 5 %")
                && lines.len() == 4
                && !granted.all()
        );
    }
}
