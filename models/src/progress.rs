//! How far a long work is: a bar on a terminal, a line every so often where there is none.

use std::ops::Deref;

use indicatif::ProgressBar;

use crate::terminal::{Heartbeat, shown};

/// A bar; where no terminal shows it, a line every so often says how far the work is.
#[derive(Debug)]
pub struct Bar {
    bar: ProgressBar,
    _lines: Option<Heartbeat>,
}

impl Bar {
    /// Of a work that is called `what`, whose parts are called `unit`. The bar's message, where it has one, ends the line.
    #[must_use]
    pub fn new(bar: ProgressBar, what: &'static str, unit: &'static str) -> Self {
        let lines = bar.is_hidden().then(|| {
            let bar = bar.clone();
            let length = |bar: &ProgressBar| bar.length().filter(|all| *all > 0);
            Heartbeat::of_work(what, unit, move || (bar.position(), length(&bar), bar.message()))
        });
        Self { bar, _lines: lines }
    }

    /// What is done at the moment; names in it come from other people's files.
    pub fn set_message(&self, text: impl AsRef<str>) {
        self.bar.set_message(shown(text.as_ref()).into_owned());
    }

    /// A line above the bar, or on its own.
    pub fn say(&self, line: &str) {
        say(&self.bar, line);
    }
}

impl Deref for Bar {
    type Target = ProgressBar;
    fn deref(&self) -> &ProgressBar {
        &self.bar
    }
}

/// A line above a bar, or on its own where no terminal shows the bar.
pub fn say(bar: &ProgressBar, line: &str) {
    if bar.is_hidden() {
        crate::errln!("{line}");
    } else {
        bar.println(shown(line));
    }
}
