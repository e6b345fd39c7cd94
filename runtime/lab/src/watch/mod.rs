//! A robot and its controller while they run, as an observer of the link sees them. Nobody waits for it.
//!
//! | file | holds |
//! | --- | --- |
//! | `ears` | the link, whoever comes and goes |
//! | `meter` | what is counted and timed |
//! | `canvas`, `terminal` | a grid of letters, and the terminal that shows it |
//! | `picture`, `screen` | what is drawn |

mod canvas;
mod ears;
mod meter;
mod picture;
mod screen;
pub mod terminal;

use std::io::{self, Write};
use std::time::{Duration, Instant};

use anyhow::Context;

pub use meter::{Counts, Percentiles, Snapshot};
pub use picture::Colours;

use canvas::Canvas;
use ears::Ears;
use meter::Meter;
use screen::Shown;
use terminal::Terminal;

/// Time between two pictures, and between two lines.
const PICTURE_EVERY: Duration = Duration::from_millis(100);
const LINE_EVERY: Duration = Duration::from_secs(1);
/// What Ctrl-C is to a terminal that passes every key on.
const CTRL_C: u8 = 3;

/// Draws until `go_on` says no, or somebody presses q.
///
/// # Errors
/// Those of the link and of the terminal.
pub fn watch_on_screen(instance: &str, colours: Colours, go_on: impl Fn() -> bool) -> anyhow::Result<()> {
    let mut ears = Ears::open(instance)?;
    let (mut meter, mut camera, mut paused) = (Meter::default(), 0, false);
    let mut terminal = Terminal::enter().context("the terminal")?;
    while go_on() {
        let keys = terminal.keys().context("the terminal")?;
        for key in &keys {
            match *key {
                b'q' | CTRL_C => return Ok(()),
                b'p' => paused = !paused,
                b'c' => camera += 1,
                _ => {}
            }
        }
        // A pressed key is answered, also where all else stands still.
        if !paused || !keys.is_empty() {
            let (columns, rows) = terminal.size();
            let mut canvas = Canvas::new(columns, rows);
            let shown = Shown {
                snapshot: &meter.snapshot(instance),
                meter: &meter,
                observation: ears.last().map(|observation| observation.view()),
                camera,
                colours,
                paused,
                trouble: ears.trouble(),
            };
            screen::draw(&mut canvas, &shown);
            terminal.show(canvas).context("the terminal")?;
        }
        listen(&mut ears, &mut meter, PICTURE_EVERY, &go_on);
    }
    Ok(())
}

/// Writes a line every second until `go_on` says no, or nobody reads them any more.
///
/// # Errors
/// Those of the link and of writing.
pub fn watch_in_lines(
    instance: &str,
    to: &mut impl Write,
    line: impl Fn(&Snapshot) -> String,
    go_on: impl Fn() -> bool,
) -> anyhow::Result<()> {
    let mut ears = Ears::open(instance)?;
    let mut meter = Meter::default();
    while go_on() {
        listen(&mut ears, &mut meter, LINE_EVERY, &go_on);
        let line = line(&meter.snapshot(instance));
        match to.write_all(line.as_bytes()).and_then(|()| to.flush()) {
            Ok(()) => {}
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => return Ok(()),
            Err(error) => return Err(error).context("writing"),
        }
    }
    Ok(())
}

/// Listens for so long.
fn listen(ears: &mut Ears, meter: &mut Meter, time: Duration, go_on: &impl Fn() -> bool) {
    let start = Instant::now();
    while go_on() {
        let left = time.saturating_sub(start.elapsed());
        if left.is_zero() {
            break;
        }
        ears.listen(left.min(PICTURE_EVERY), meter);
    }
}

impl Snapshot {
    /// A line for people.
    #[must_use]
    pub fn line(&self) -> String {
        let Self { instance, robot, rate_hz, mode, latency_us, counts, episode, step, .. } = self;
        let Some(robot) = robot else { return format!("{instance}: waiting for a robot\n") };
        let rate = rate_hz.map_or_else(|| "-".to_owned(), |rate_hz| format!("{rate_hz:.1}"));
        let mut text = format!(
            "{instance}: {robot}, {}, {rate} Hz, deadlines missed {} of {}, imagined {}, fallback {}",
            mode.unwrap_or("no controller answers"),
            counts.deadlines_missed,
            counts.observations,
            counts.imagined,
            counts.fallback
        );
        if let Some(Percentiles { p50, p99, max }) = latency_us {
            text += &format!(", to action p50 {p50:.0} us p99 {p99:.0} us max {max:.0} us");
        }
        if let (Some(episode), Some(step)) = (episode, step) {
            text += &format!(", episode {episode} step {step}");
        }
        text + "\n"
    }
}
