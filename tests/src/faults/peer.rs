//! A robot on a fixed clock with recorded images, and with faults on its way out.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rcwm_models::IMAGE_BYTES;
use rcwm_models::bundle::Bundle;
use rcwm_models::wire::clock::monotonic_ns;
use rcwm_models::wire::{
    Action, ActionValues, Format, LinkError, LinkSettings, ObservationFlags, OwnedObservation, SimulatorLink,
    Wait,
};

use crate::shipped_bundle;

/// What happens to an observation on its way, every so many of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// Nothing.
    None,
    /// It never arrives.
    Dropped {
        /// One of so many.
        every: u64,
    },
    /// It arrives periods later, after those that followed it.
    Delayed {
        /// One of so many.
        every: u64,
        /// How much later.
        periods: u64,
    },
    /// It arrives twice.
    Doubled {
        /// One of so many.
        every: u64,
    },
}

impl Fault {
    fn hits(self, sequence: u64) -> bool {
        match self {
            Self::None => false,
            Self::Dropped { every } | Self::Delayed { every, .. } | Self::Doubled { every } => {
                sequence % every == every - 1
            }
        }
    }
}

/// What a peer has done.
#[derive(Debug, Clone, Default)]
pub struct Served {
    /// Sequences that the fault has hit.
    pub hit: Vec<u64>,
    /// Actions executed in place of one that did not come in time.
    pub held: u64,
}

/// Serves one long episode until `stop` is set or the fault has hit so many times, then closes.
pub fn serve(
    settings: LinkSettings,
    period: Duration,
    fault: Fault,
    hits_max: usize,
    stop: &AtomicBool,
) -> Result<Served, LinkError> {
    let mut peer = Peer {
        link: SimulatorLink::open(settings, &Format::metaworld())?,
        images: recorded_images(),
        period_ns: period.as_nanos() as u64,
        sequence: 0,
        executed: ActionValues::zeros(4),
        held: false,
        delayed: VecDeque::new(),
        served: Served::default(),
    };
    let stopped = || stop.load(Ordering::Relaxed);
    peer.meet_controller(&stopped)?;
    let mut due_ns = monotonic_ns() + peer.period_ns;
    while !stopped() && peer.served.hit.len() < hits_max.max(1) {
        sleep_until(due_ns);
        peer.execute()?;
        peer.tick(due_ns, fault)?;
        due_ns += peer.period_ns;
        // What was slept through is skipped, and the grid is kept.
        due_ns += monotonic_ns().saturating_sub(due_ns).div_ceil(peer.period_ns) * peer.period_ns;
    }
    // The last fault has its consequences too.
    for _ in 0..20 {
        sleep_until(due_ns);
        peer.execute()?;
        peer.tick(due_ns, Fault::None)?;
        due_ns += peer.period_ns;
    }
    peer.link.close()?;
    Ok(peer.served)
}

struct Peer {
    link: SimulatorLink,
    images: Vec<[u8; IMAGE_BYTES]>,
    period_ns: u64,
    sequence: u64,
    executed: ActionValues,
    held: bool,
    delayed: VecDeque<(u64, OwnedObservation)>,
    served: Served,
}

impl Peer {
    fn meet_controller(&mut self, stopped: &dyn Fn() -> bool) -> Result<(), LinkError> {
        let first = self.observation(monotonic_ns());
        self.publish(&first)?;
        while !stopped() {
            let (wait, events) = self.link.wait_action(Duration::from_millis(50))?;
            if let Wait::Message(action) = wait
                && self.is_answer(&action)
            {
                self.executed = action.action;
                break;
            }
            if events.hello {
                let mut again = self.observation(monotonic_ns());
                again.flags |= ObservationFlags::REPEATED.0;
                self.publish(&again)?;
            }
        }
        Ok(())
    }

    fn is_answer(&self, action: &Action) -> bool {
        action.answers == self.sequence && action.action.iter().all(|x| x.is_finite())
    }

    fn execute(&mut self) -> Result<(), LinkError> {
        self.link.poll_events()?;
        let action = self.link.poll_action()?.filter(|action| self.is_answer(action));
        self.held = action.is_none();
        self.served.held += u64::from(self.held);
        if let Some(action) = action {
            self.executed = action.action;
        }
        Ok(())
    }

    fn tick(&mut self, due_ns: u64, fault: Fault) -> Result<(), LinkError> {
        self.sequence += 1;
        let observation = self.observation(due_ns);
        let hit = fault.hits(self.sequence);
        if hit {
            self.served.hit.push(self.sequence);
        }
        match fault {
            Fault::Dropped { .. } if hit => {}
            Fault::Delayed { periods, .. } if hit => {
                self.delayed.push_back((self.sequence + periods, observation));
            }
            Fault::Doubled { .. } if hit => {
                self.publish(&observation)?;
                // Not within the same breath, where the newer takes the place of the older unseen.
                std::thread::sleep(Duration::from_nanos(self.period_ns / 4));
                self.publish(&observation)?;
            }
            _ => self.publish(&observation)?,
        }
        if self.delayed.front().is_some_and(|(when, _)| *when <= self.sequence)
            && let Some((_, late)) = self.delayed.pop_front()
        {
            std::thread::sleep(Duration::from_nanos(self.period_ns / 4));
            self.publish(&late)?;
        }
        Ok(())
    }

    fn observation(&self, due_ns: u64) -> OwnedObservation {
        let mut observation = OwnedObservation::zeroed(self.link.format());
        (observation.sequence, observation.step) = (self.sequence, self.sequence as u32);
        (observation.scheduled_ns, observation.period_ns) = (due_ns, self.period_ns);
        observation.edit().executed().copy_from_slice(&self.executed);
        observation.flags = ObservationFlags::default()
            .with(ObservationFlags::FIRST, self.sequence == 0)
            .with(ObservationFlags::ACTION_HELD, self.held)
            .0;
        observation.edit().image(0).copy_from_slice(&self.images[self.sequence as usize % self.images.len()]);
        observation
    }

    fn publish(&self, observation: &OwnedObservation) -> Result<(), LinkError> {
        self.link.publish_copy(observation)
    }
}

/// The images of the shipped bundle's golden values: from Meta-World.
pub(super) fn recorded_images() -> Vec<[u8; IMAGE_BYTES]> {
    let bundle = Bundle::open(&shipped_bundle()).expect("the shipped bundle is sound");
    let images = bundle.golden.u8("input/image").expect("golden values hold images");
    let bytes = images.as_slice().expect("in order");
    bytes.as_chunks::<IMAGE_BYTES>().0.to_vec()
}

fn sleep_until(time_ns: u64) {
    std::thread::sleep(Duration::from_nanos(time_ns.saturating_sub(monotonic_ns())));
}
