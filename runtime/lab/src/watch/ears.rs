//! The link as an observer has it, whoever comes and goes.

use std::time::{Duration, Instant};

use rcwm_models::wire::{ActionObserverLink, LinkError, LinkSettings, ObservationSample, ObserverLink, Wait};

use super::meter::Meter;

/// After so long without an observation the robot is asked whether it is there. A link that is held open would keep a robot of another
/// interface from coming.
const SILENCE: Duration = Duration::from_secs(3);
/// A robot that does not answer for so long is gone.
const GONE: Duration = Duration::from_secs(1);

/// Listens in on an instance.
pub struct Ears {
    settings: LinkSettings,
    links: Option<(ObserverLink, ActionObserverLink)>,
    /// The robot has said its interface.
    found: bool,
    /// When it was heard last, or began to be looked for.
    heard: Instant,
    last: Option<ObservationSample>,
    /// What went wrong with the link last, while it is.
    trouble: Option<String>,
}

impl Ears {
    /// Joins an instance, whose robot may come later.
    ///
    /// # Errors
    /// See [`LinkError`].
    pub fn open(instance: &str) -> Result<Self, LinkError> {
        // Nobody waits for it: it need not poll.
        let settings = LinkSettings { spin: Duration::ZERO, ..LinkSettings::new(instance) };
        let links = Some(join(&settings)?);
        Ok(Self { settings, links, found: false, heard: Instant::now(), last: None, trouble: None })
    }

    /// The last observation.
    pub fn last(&self) -> Option<&ObservationSample> {
        self.last.as_ref()
    }

    pub fn trouble(&self) -> Option<&str> {
        self.trouble.as_deref()
    }

    /// Waits for what comes next and shows it to the meter.
    pub fn listen(&mut self, timeout: Duration, meter: &mut Meter) {
        match self.listen_to_links(timeout, meter) {
            Ok(()) => {}
            Err(error) => {
                self.leave();
                self.trouble = Some(error.to_string());
                std::thread::sleep(timeout);
            }
        }
        if !self.found && self.heard.elapsed() > GONE {
            meter.robot_left();
        }
    }

    fn listen_to_links(&mut self, timeout: Duration, meter: &mut Meter) -> Result<(), LinkError> {
        let (observations, actions) = match self.links.take() {
            Some(links) => self.links.insert(links),
            None => self.links.insert(join(&self.settings)?),
        };
        if !self.found {
            let Some(format) = observations.wait_robot(timeout)? else { return Ok(()) };
            (self.found, self.heard, self.trouble) = (true, Instant::now(), None);
            meter.robot_came(&format);
        }
        let heard = observations.wait_observation(timeout)?;
        // What answers the observation before this one is there by now.
        while let Some(action) = actions.poll_action()? {
            meter.answered(action);
        }
        match heard {
            Wait::Message(observation) => {
                meter.observed(&observation.view());
                (self.heard, self.last) = (Instant::now(), Some(observation));
            }
            Wait::TimedOut if self.heard.elapsed() < SILENCE => {}
            Wait::TimedOut | Wait::Closed => self.leave(),
        }
        Ok(())
    }

    /// Holds nothing of the robot any more, and looks for it anew.
    fn leave(&mut self) {
        // The sample first: it belongs to the link.
        self.last = None;
        (self.links, self.found, self.heard) = (None, false, Instant::now());
    }
}

fn join(settings: &LinkSettings) -> Result<(ObserverLink, ActionObserverLink), LinkError> {
    Ok((ObserverLink::open(settings.clone())?, ActionObserverLink::open(settings)?))
}
