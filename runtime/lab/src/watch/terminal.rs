//! The terminal: keys one by one, a screen of its own, and as it was when all is over, whatever ends it.

use std::io::{self, IsTerminal, Write};
use std::os::fd::AsFd;
use std::sync::{Mutex, Once, PoisonError};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::termios::{OptionalActions, Termios, tcgetattr, tcgetwinsize, tcsetattr};

use super::canvas::Canvas;

/// The other screen, no cursor; and back.
const ENTER: &str = "\x1b[?1049h\x1b[?25l\x1b[2J";
const LEAVE: &str = "\x1b[0m\x1b[?25h\x1b[?1049l";

/// How the terminal was; none while it is.
static WAS: Mutex<Option<Termios>> = Mutex::new(None);

/// Whether there is a terminal to draw on and to take keys from.
pub fn is_there() -> bool {
    io::stdout().is_terminal() && io::stdin().is_terminal()
}

/// The terminal, until it is dropped.
pub struct Terminal {
    shown: Option<Canvas>,
}

impl Terminal {
    /// # Errors
    /// Those of the terminal.
    pub fn enter() -> io::Result<Self> {
        static HOOK: Once = Once::new();
        HOOK.call_once(|| {
            let before = std::panic::take_hook();
            std::panic::set_hook(Box::new(move |panic| {
                // First, so that what is said of the panic can be read.
                restore();
                before(panic);
            }));
        });
        let was = tcgetattr(io::stdin().as_fd())?;
        let mut raw = was.clone();
        raw.make_raw();
        *WAS.lock().unwrap_or_else(PoisonError::into_inner) = Some(was);
        let this = Self { shown: None };
        tcsetattr(io::stdin().as_fd(), OptionalActions::Now, &raw)?;
        say(ENTER)?;
        Ok(this)
    }

    /// Columns and rows.
    pub fn size(&self) -> (usize, usize) {
        match tcgetwinsize(io::stdout().as_fd()) {
            Ok(size) if size.ws_col > 0 && size.ws_row > 0 => (size.ws_col.into(), size.ws_row.into()),
            // One that does not say.
            _ => (80, 24),
        }
    }

    /// # Errors
    /// Those of writing.
    pub fn show(&mut self, canvas: Canvas) -> io::Result<()> {
        say(&canvas.changes(self.shown.as_ref()))?;
        self.shown = Some(canvas);
        Ok(())
    }

    /// The keys that were pressed, none waited for.
    ///
    /// # Errors
    /// Those of reading; the terminal's end, too.
    pub fn keys(&mut self) -> io::Result<Vec<u8>> {
        let input = io::stdin();
        let now = Timespec { tv_sec: 0, tv_nsec: 0 };
        let waiting = poll(&mut [PollFd::new(&input.as_fd(), PollFlags::IN)], Some(&now));
        if !matches!(waiting, Ok(count) if count > 0) {
            return Ok(Vec::new());
        }
        let mut keys = vec![0; 64];
        match rustix::io::read(input.as_fd(), &mut keys[..])? {
            0 => Err(io::ErrorKind::UnexpectedEof.into()),
            count => {
                keys.truncate(count);
                Ok(keys)
            }
        }
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        restore();
    }
}

/// Makes the terminal what it was, once.
pub fn restore() {
    if let Some(was) = WAS.lock().unwrap_or_else(PoisonError::into_inner).take() {
        // There is nowhere to tell that it failed.
        let _ = say(LEAVE);
        let _ = tcsetattr(io::stdin().as_fd(), OptionalActions::Now, &was);
    }
}

fn say(text: &str) -> io::Result<()> {
    let mut out = io::stdout().lock();
    out.write_all(text.as_bytes())?;
    out.flush()
}
