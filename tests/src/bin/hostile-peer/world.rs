//! The time of a run, and all that happens in it: the controller's waits and looks at its clock let it pass, and the peer does what is
//! due meanwhile. One thread has both sides, so that a seed gives the same run every time.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::wire::{Action, ActionValues, ControllerLink, LinkError, ObservationSample, Wait};
use rcwm_runtime::controller::{Tick, TickObserver, Transport};

use crate::asking::{Asking, Said};
use crate::draft::{Counts, START_NS};
use crate::judge::{Heard, Judge};
use crate::scenario::{Deed, Setup, Step, When};
use crate::wire::Wire;

/// Waits after the peer's last deed, for what the controller does alone.
const TAIL_WAITS: u32 = 400;
/// Looks at clock and link between two deeds after which the loop counts as hung.
const LOOKS_MAX: u64 = 1_000_000;
/// What is in the link is there at once; reached only where it never comes.
const NEVER: Duration = Duration::from_secs(10);
/// Long enough to take events that are there already.
const AT_ONCE: Duration = Duration::from_micros(30);

/// Events that are left in the link before they are taken: taking them sleeps for a moment of real time.
const EVENTS_MAX: u32 = 64;
/// Of so many times that the controller wants to clean up after dead peers, one is done.
const CLEANED_EVERY: u64 = 50;

/// What the controller's wait ended with.
enum Waited {
    /// A message, or the peer's closing, is there.
    Something,
    /// The peer has sent events without either.
    Events,
    Nothing,
}

pub(crate) struct World {
    wire: Wire,
    pub(crate) judge: Judge,
    asking: Asking,
    setup: Setup,
    counts: Counts,
    steps: VecDeque<(usize, Step)>,
    rng: ChaCha8Rng,
    now_ns: u64,
    /// When the peer did its last deed.
    last_ns: u64,
    /// The message in the link that was not taken.
    waiting: Option<Heard>,
    /// The peer has closed and the controller has not heard of it.
    closing: bool,
    events: u32,
    tail: u32,
    looks: u64,
    cleaned: u64,
    stop: Arc<AtomicBool>,
    pub(crate) messages: u64,
    /// The peer's last deed, as numbered in its scenario.
    step: usize,
    /// That of the first violation, and the message.
    pub(crate) violated_at: Option<(usize, u64)>,
}

impl World {
    pub(crate) fn new(
        wire: Wire,
        judge: Judge,
        asking: Asking,
        setup: Setup,
        steps: VecDeque<(usize, Step)>,
        seed: u64,
        stop: Arc<AtomicBool>,
    ) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x77);
        // Another controller had the robot before this one.
        let counts = Counts {
            sent: ActionValues::from_fn(rcwm_models::ACTION_LEN, |_| rng.random_range(-1.0..1.0)),
            ..Counts::default()
        };
        Self {
            wire,
            judge,
            asking,
            setup,
            counts,
            steps,
            rng,
            now_ns: START_NS,
            last_ns: START_NS,
            waiting: None,
            closing: false,
            events: 0,
            tail: 0,
            looks: 0,
            cleaned: 0,
            stop,
            messages: 0,
            step: 0,
            violated_at: None,
        }
    }

    /// After every look: the first violation ends the run.
    fn note(&mut self) {
        self.looks += 1;
        assert!(
            self.looks < LOOKS_MAX,
            "the loop has hung: {LOOKS_MAX} looks at clock and link between two deeds"
        );
        if self.judge.violation.is_some() && self.violated_at.is_none() {
            self.violated_at = Some((self.step, self.messages));
            self.stop.store(true, Ordering::Relaxed);
        }
    }

    /// How long the controller's work takes until its next look.
    fn work_ns(&mut self) -> u64 {
        let period_ns = self.setup.period_ns.max(100_000);
        match self.rng.random_range(0..400) {
            0 if self.setup.stalls => self.rng.random_range(0..4 * period_ns),
            1..30 => self.rng.random_range(0..period_ns / 10),
            _ => self.rng.random_range(100..3000),
        }
    }

    /// Lets time pass, with what the peer does meanwhile.
    fn pass(&mut self, until_ns: u64) {
        while let Some((_, Step { when: When::After(ns), .. })) = self.steps.front() {
            let at_ns = self.last_ns.saturating_add(*ns);
            if at_ns > until_ns {
                break;
            }
            self.now_ns = self.now_ns.max(at_ns);
            self.act();
        }
        self.now_ns = self.now_ns.max(until_ns);
    }

    /// The peer's next deed.
    fn act(&mut self) {
        let Some((number, step)) = self.steps.pop_front() else { return };
        (self.step, self.looks, self.last_ns) = (number, 0, self.now_ns);
        let done = match step.deed {
            Deed::Publish(draft) => {
                let message = draft.fill(&mut self.counts, self.now_ns);
                self.messages += 1;
                self.events += u32::from(draft.wakes);
                self.waiting = Some(Heard::new(self.wire.publisher(), &message.view(), self.now_ns));
                self.wire.publish(&message, draft.wakes)
            }
            Deed::Close => {
                self.closing = true;
                self.wire.close()
            }
            Deed::Notify(event) => {
                self.closing |= event == 2;
                self.events += EVENTS_MAX;
                self.wire.notify(event)
            }
            Deed::Restart { counts_on } => {
                if !counts_on {
                    self.counts = Counts { sent: self.counts.sent, ..Counts::default() };
                }
                self.waiting = None;
                self.wire.restart()
            }
            Deed::Swap { bundle, now } => {
                if let Some(known) = self.asking.ask(bundle, now) {
                    self.judge.may_run_with(known);
                }
                Ok(())
            }
        };
        done.expect("the peer's end of the link works");
    }

    fn clock(&mut self) -> u64 {
        if !self.asking.is_awaited() {
            let until_ns = self.now_ns + self.work_ns();
            self.pass(until_ns);
        }
        self.judge.looked(self.now_ns);
        self.note();
        self.now_ns
    }

    fn wait(&mut self, timeout: Duration) -> Waited {
        self.hear_of_swaps();
        if self.asking.is_awaited() {
            return Waited::Nothing;
        }
        self.judge.looks_at_link(self.now_ns, true);
        self.note();
        let until_ns = self.now_ns.saturating_add(u64::try_from(timeout.as_nanos()).unwrap_or(u64::MAX));
        loop {
            if self.waiting.is_some() || self.closing {
                return Waited::Something;
            }
            let at_ns = match self.steps.front() {
                Some((_, Step { when: When::Answered, .. })) => self.now_ns,
                Some((_, Step { when: When::After(ns), .. })) => self.last_ns.saturating_add(*ns),
                None => u64::MAX,
            };
            if at_ns > until_ns {
                self.now_ns = until_ns;
                break;
            }
            self.now_ns = self.now_ns.max(at_ns);
            self.act();
        }
        if self.steps.is_empty() {
            self.tail += 1;
            self.stop.fetch_or(self.tail > TAIL_WAITS, Ordering::Relaxed);
        }
        if self.events < EVENTS_MAX {
            return Waited::Nothing;
        }
        self.events = 0;
        Waited::Events
    }

    /// Something may have come of a swap that was asked for.
    fn hear_of_swaps(&mut self) {
        match self.asking.hear() {
            Said::Nothing => {}
            Said::Taken(known) | Said::Refused(known) => self.judge.runs_with(known),
        }
    }

    fn received(&mut self, sample: &ObservationSample, polled: bool) {
        self.waiting = None;
        self.judge.received(Heard::new(sample.origin(), &sample.view(), self.now_ns), polled);
    }

    fn sent(&mut self) {
        let action = self.wire.action().expect("the peer's end of the link works");
        let action = action.expect("what was sent is on the wire");
        self.judge.sent(&action, self.waiting.as_ref(), self.now_ns);
        self.counts.sent = action.action;
        if !self.setup.deaf {
            self.wire.is_told().expect("the peer's end of the link works");
        }
        self.note();
    }

    /// After the controller has ended: whether the robot was told.
    pub(crate) fn is_told(&self) -> bool {
        self.wire.is_told().expect("the peer's end of the link works")
    }

    /// Swaps that were taken.
    pub(crate) fn swaps(&mut self) -> u64 {
        self.hear_of_swaps();
        self.asking.taken()
    }
}

/// The controller's end of the link, in this world's time.
pub(crate) struct Stage {
    pub(crate) link: ControllerLink,
    pub(crate) world: Rc<RefCell<World>>,
}

impl Transport for Stage {
    fn now_ns(&self) -> u64 {
        self.world.borrow_mut().clock()
    }

    fn wait(&self, _spin: Duration, timeout: Duration) -> Result<Wait<ObservationSample>, LinkError> {
        let mut world = self.world.borrow_mut();
        let waited = match world.wait(timeout) {
            Waited::Nothing => return Ok(Wait::TimedOut),
            Waited::Events => self.link.wait_observation_polling(Duration::ZERO, AT_ONCE)?,
            Waited::Something => self.link.wait_observation_polling(Duration::ZERO, NEVER)?,
        };
        match &waited {
            Wait::Message(sample) => world.received(sample, false),
            Wait::Closed => {
                world.closing = false;
                world.judge.closed();
            }
            Wait::TimedOut => {}
        }
        Ok(waited)
    }

    fn poll(&self) -> Result<Option<ObservationSample>, LinkError> {
        let mut world = self.world.borrow_mut();
        let until_ns = world.now_ns + 200;
        world.pass(until_ns);
        let now_ns = world.now_ns;
        world.judge.looks_at_link(now_ns, false);
        let polled = self.link.poll_observation()?;
        if let Some(sample) = &polled {
            world.received(sample, true);
        }
        world.note();
        Ok(polled)
    }

    fn send(&self, action: &Action) -> Result<u64, LinkError> {
        self.link.send(action)?;
        let mut world = self.world.borrow_mut();
        world.sent();
        world.now_ns += 100;
        Ok(world.now_ns)
    }

    fn hello(&self) -> Result<(), LinkError> {
        self.link.hello()
    }

    fn clean_up_dead_peers(&self) {
        // Takes milliseconds of real time, and hours pass here.
        let mut world = self.world.borrow_mut();
        world.cleaned += 1;
        if world.cleaned % CLEANED_EVERY == 1 {
            self.link.clean_up_dead_peers();
        }
    }

    fn say_closed(&self) -> Result<(), LinkError> {
        self.link.say_closed()
    }
}

/// Sees what the policy decided, and which policy it was.
pub(crate) struct Witness(pub(crate) Rc<RefCell<World>>);

impl TickObserver for Witness {
    fn ticked(&mut self, tick: &Tick<'_>) {
        let world = &mut *self.0.borrow_mut();
        if !tick.overtaken {
            world.judge.decided(&tick.answer, tick.decision.map(|decision| decision.action));
        }
        if let Some(known) = world.asking.ticked(tick.policy.number()) {
            world.judge.runs_with(known);
        }
        world.note();
    }
}
