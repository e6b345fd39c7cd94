//! What programs say on standard output and standard error. A pipe that was closed (`| head`) or a full disk never ends a program:
//! `println!` would panic. What standard output has lost is told at the end, by [`finish`]. Names and texts come from other people's files:
//! what would command the terminal is shown instead.

use std::borrow::Cow;
use std::fmt::Arguments;
use std::io::{self, Write};
use std::sync::atomic::{AtomicBool, AtomicI32, Ordering};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Nobody reads standard output any more.
static CLOSED: AtomicBool = AtomicBool::new(false);
/// The first error of writing to standard output, as the system numbers it; 0 for none.
static LOST: AtomicI32 = AtomicI32::new(0);

/// Standard output is for a result that a program reads.
static KEPT: AtomicBool = AtomicBool::new(false);

/// Keeps standard output for [`print_result`]; what is for people goes to standard error from now on.
pub fn keep_for_result() {
    KEPT.store(true, Ordering::Relaxed);
}

/// Prints a result that a program reads to standard output.
///
/// # Errors
/// Those of writing, a closed pipe included.
pub fn print_result(bytes: &[u8]) -> io::Result<()> {
    let mut out = io::stdout().lock();
    out.write_all(bytes).and_then(|()| out.flush())
}

/// Prints to standard output, as `print!` does; for [`out!`](crate::out).
pub fn print(text: Arguments<'_>) {
    if KEPT.load(Ordering::Relaxed) {
        return print_error(text);
    }
    if CLOSED.load(Ordering::Relaxed) {
        return;
    }
    let mut out = io::stdout().lock();
    match out.write_all(shown(&text.to_string()).as_bytes()).and_then(|()| out.flush()) {
        Ok(()) => {}
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => CLOSED.store(true, Ordering::Relaxed),
        Err(error) => {
            let number = error.raw_os_error().unwrap_or(-1);
            // The first one counts.
            let _ = LOST.compare_exchange(0, number, Ordering::Relaxed, Ordering::Relaxed);
        }
    }
}

/// Prints to standard error, as `eprint!` does; for [`errln!`](crate::errln). There is nowhere to tell that it was lost.
pub fn print_error(text: Arguments<'_>) {
    // One write a line, so that lines of several programs do not mix.
    let _ = io::stderr().write_all(shown(&text.to_string()).as_bytes());
}

/// The text with every control character but line ends and tabs written out, such as `\u{1b}` for the one that begins a terminal's
/// commands.
#[must_use]
pub fn shown(text: &str) -> Cow<'_, str> {
    let commands = |c: char| c.is_control() && c != '\n' && c != '\t';
    if !text.contains(commands) {
        return Cow::Borrowed(text);
    }
    let show = |mut shown: String, c: char| {
        if commands(c) {
            shown.extend(c.escape_unicode())
        } else {
            shown.push(c)
        }
        shown
    };
    Cow::Owned(text.chars().fold(String::with_capacity(text.len() + 16), show))
}

/// Whether all that was printed has arrived, or nobody wanted it any more; to be asked at the end of a program.
///
/// # Errors
/// The first one of writing, but for a pipe that was closed.
pub fn finish() -> io::Result<()> {
    match LOST.load(Ordering::Relaxed) {
        0 => Ok(()),
        -1 => Err(io::Error::other("writing failed")),
        number => Err(io::Error::from_raw_os_error(number)),
    }
}

/// `print!` that never panics.
#[macro_export]
macro_rules! out {
    ($($text:tt)*) => { $crate::terminal::print(::std::format_args!($($text)*)) };
}

/// `println!` that never panics.
#[macro_export]
macro_rules! outln {
    () => { $crate::out!("\n") };
    ($($text:tt)*) => { $crate::terminal::print(::std::format_args!("{}\n", ::std::format_args!($($text)*))) };
}

/// `eprintln!` that never panics.
#[macro_export]
macro_rules! errln {
    ($($text:tt)*) => {
        $crate::terminal::print_error(::std::format_args!("{}\n", ::std::format_args!($($text)*)))
    };
}

/// Time between two lines of a program that works where no terminal shows a bar.
pub const LINE_EVERY: Duration = Duration::from_secs(10);

/// Says on standard error every so often how far a long work is, until it is dropped: for where no terminal shows a bar.
#[derive(Debug)]
pub struct Heartbeat {
    end: Option<Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Heartbeat {
    /// Says what `line` gives, if anything, each time that `every` has gone by.
    #[must_use]
    pub fn start(every: Duration, line: impl Fn() -> Option<String> + Send + 'static) -> Self {
        let (end, ended) = channel::<()>();
        let work = move || {
            while ended.recv_timeout(every) == Err(RecvTimeoutError::Timeout) {
                if let Some(line) = line() {
                    crate::errln!("{line}");
                }
            }
        };
        // Without a thread there is no line; the work goes on.
        let thread = std::thread::Builder::new().name("heartbeat".into()).spawn(work).ok();
        Self { end: Some(end), thread }
    }
}

impl Heartbeat {
    /// Says every [`LINE_EVERY`] how far a work is that is called `what` and whose parts are called `unit`, by what `read` gives: how much
    /// is done, of how much if that is known, and what else there is to say.
    #[must_use]
    pub fn of_work(
        what: &'static str,
        unit: &'static str,
        read: impl Fn() -> (u64, Option<u64>, String) + Send + 'static,
    ) -> Self {
        let (begin, (before, ..)) = (Instant::now(), read());
        Self::start(LINE_EVERY, move || {
            let (done, all, more) = read();
            let line = progress_line(what, (before, done, all), unit, begin.elapsed());
            Some(if more.is_empty() { line } else { format!("{line}; {more}") })
        })
    }
}

impl Drop for Heartbeat {
    fn drop(&mut self) {
        self.end = None;
        if let Some(thread) = self.thread.take() {
            // It has nothing to tell, also where it has panicked.
            let _ = thread.join();
        }
    }
}

/// `done` of `all` units of a work, of which `before` were done before, after so much time: how many, how fast, and how long it will
/// take still.
#[must_use]
pub fn progress_line(
    what: &str,
    (before, done, all): (u64, u64, Option<u64>),
    unit: &str,
    time: Duration,
) -> String {
    let made = done.saturating_sub(before);
    let per_s = made as f64 / time.as_secs_f64().max(1e-9);
    let begin = if what.is_empty() { String::new() } else { format!("{what}: ") };
    let rate = if per_s >= 1.0 || made == 0 {
        format!("{per_s:.1} a second")
    } else {
        format!("{:.1} s each", 1.0 / per_s)
    };
    match all {
        Some(all) if made > 0 => {
            let left_s = all.saturating_sub(done) as f64 / per_s;
            format!("{begin}{done} of {all} {unit}, {rate}, ETA {}", duration(left_s))
        }
        Some(all) => format!("{begin}{done} of {all} {unit} after {}", duration(time.as_secs_f64())),
        None => format!("{begin}{done} {unit}, {rate}"),
    }
}

/// Seconds as people say them: `42 s`, `3 min`, `5.2 h`.
fn duration(seconds: f64) -> String {
    match seconds {
        s if s < 120.0 => format!("{s:.0} s"),
        s if s < 7200.0 => format!("{:.0} min", s / 60.0),
        s => format!("{:.1} h", s / 3600.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_would_command_a_terminal_is_written_out() {
        let name = "a\tred \u{1b}[31mlog\r\u{9b}2J, ünï\n";
        assert_eq!(shown(name), "a\tred \\u{1b}[31mlog\\u{d}\\u{9b}2J, ünï\n");
    }

    #[test]
    fn a_line_of_progress_tells_how_far_how_fast_and_how_long() {
        let line = |done, all, s| progress_line("measuring", (0, done, all), "ticks", Duration::from_secs(s));
        assert_eq!(line(50, Some(200), 25), "measuring: 50 of 200 ticks, 2.0 a second, ETA 75 s");
        assert_eq!(line(5, Some(200), 50), "measuring: 5 of 200 ticks, 10.0 s each, ETA 32 min");
        assert_eq!(line(0, Some(200), 30), "measuring: 0 of 200 ticks after 30 s");
        assert_eq!(line(50, None, 25), "measuring: 50 ticks, 2.0 a second");
        let resumed = progress_line("", (100, 150, Some(200)), "updates", Duration::from_secs(25));
        assert_eq!(
            resumed, "150 of 200 updates, 2.0 a second, ETA 25 s",
            "only what was done now tells the pace"
        );
    }

    #[test]
    fn a_heartbeat_speaks_until_it_is_dropped() {
        let count = std::sync::Arc::new(std::sync::atomic::AtomicU64::new(0));
        let seen = std::sync::Arc::clone(&count);
        let heartbeat = Heartbeat::start(Duration::from_millis(1), move || {
            seen.fetch_add(1, Ordering::Relaxed);
            None
        });
        while count.load(Ordering::Relaxed) < 3 {
            std::thread::yield_now();
        }
        drop(heartbeat);
        let after = count.load(Ordering::Relaxed);
        std::thread::sleep(Duration::from_millis(20));
        assert_eq!(count.load(Ordering::Relaxed), after);
    }
}
