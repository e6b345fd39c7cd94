//! A message before it is filled in.

use rand::Rng;
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;
use rcwm_models::ACTION_LEN;
use rcwm_models::wire::{ActionValues, Format, ObservationFlags, OwnedObservation};

/// Integers at which programs break.
const HARD: [u64; 12] = [
    0,
    1,
    2,
    u32::MAX as u64,
    1 << 32,
    1 << 53,
    i64::MAX as u64,
    1 << 63,
    u64::MAX - 2,
    u64::MAX - 1,
    u64::MAX,
    1_000_000_007,
];
/// Numbers at which programs break.
const HARD_FLOATS: [f32; 12] = [
    f32::NAN,
    f32::INFINITY,
    f32::NEG_INFINITY,
    f32::MAX,
    f32::MIN,
    3e38,
    -1e30,
    f32::MIN_POSITIVE,
    1e-45,
    -0.0,
    1e7,
    -150.0,
];
/// The clock's time at the start, in ns: a machine that has run for hours.
pub(crate) const START_NS: u64 = 20_000_000_000_000;
/// A clock that is about to wrap does so after this much of the run, in ns.
const WRAPS_AFTER_NS: u64 = 2_000_000_000;
const MINUTE_NS: u64 = 60_000_000_000;
const YEAR_NS: u64 = 365 * 24 * 60 * MINUTE_NS;

/// What kind of peer it is for a while.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Behaviour {
    /// As a good one.
    Honest,
    /// Comes back to the middle of an episode.
    Joining,
    /// Says nothing for long.
    Silence,
    /// Old messages, as fast as they come.
    Flood,
    /// New messages, as fast as they come.
    Burst,
    /// Loses, doubles, swaps and replays messages.
    Disorder,
    /// Two episodes at once.
    Interleaved,
    /// A clock of its own.
    Clock(Clock),
    /// Numbers that are none, or absurd.
    Numbers,
    /// Anything anywhere.
    Garbage,
}

/// A clock that is not the machine's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Clock {
    /// The machine's.
    Right,
    /// Ahead by so many ns.
    Ahead(u64),
    /// Behind by so many ns.
    Behind(u64),
    /// Stands still.
    Constant(u64),
    /// Wraps in the course of the run.
    Wrapping,
    /// Behind and ahead in turn.
    Jumping(u64),
}

impl Clock {
    fn any(rng: &mut ChaCha8Rng, period_ns: u64) -> Self {
        let half_ns = period_ns / 2;
        let times = |count: u64| half_ns.saturating_mul(count);
        let by = [1, half_ns, times(3), times(6), 10 * MINUTE_NS, 50 * YEAR_NS, u64::MAX];
        let by = by.choose(rng).copied().unwrap_or(1);
        match rng.random_range(0..6) {
            0 | 1 => Self::Ahead(by),
            2 => Self::Behind(by),
            3 => Self::Constant(HARD.choose(rng).copied().unwrap_or(0)),
            4 => Self::Wrapping,
            _ => Self::Jumping(by),
        }
    }

    /// What it shows when the machine's shows `now_ns`.
    fn shows(self, now_ns: u64) -> u64 {
        match self {
            Self::Right => now_ns,
            Self::Ahead(by) => now_ns.saturating_add(by),
            Self::Behind(by) => now_ns.saturating_sub(by),
            Self::Constant(time) => time,
            Self::Wrapping => now_ns.wrapping_add(u64::MAX - START_NS - WRAPS_AFTER_NS),
            Self::Jumping(by) if (now_ns >> 20) & 1 == 0 => now_ns.saturating_add(by),
            Self::Jumping(by) => now_ns.saturating_sub(by),
        }
    }
}

impl Behaviour {
    pub(crate) fn any(rng: &mut ChaCha8Rng) -> Self {
        match rng.random_range(0..24) {
            0..7 => Self::Honest,
            7..9 => Self::Joining,
            9 | 10 => Self::Silence,
            11 | 12 => Self::Flood,
            13 => Self::Burst,
            14 | 15 => Self::Disorder,
            16 => Self::Interleaved,
            17..20 => Self::Clock(Clock::Right),
            20 | 21 => Self::Numbers,
            _ => Self::Garbage,
        }
    }
}

/// Where a sequence is counted from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Sequence {
    Next,
    Same,
    Back(u64),
    Ahead(u64),
    Absolute(u64),
}

/// The action that a message says was executed.
#[derive(Debug, Clone, Copy, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "there are few, and none is in a hurry")]
pub(crate) enum Executed {
    /// The last one on the wire.
    AsSent,
    /// This one.
    Given(ActionValues),
    /// The last one on the wire with one component replaced.
    Spoilt(usize, f32),
}

/// Everything that a message will say, relative to the peer.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Draft {
    sequence: Sequence,
    /// The sequence is that of the peer's counter from here on.
    counts: bool,
    /// Added to the episode, wrapping; the counter stays.
    episode_off: u64,
    /// Begins an episode.
    begins: bool,
    /// Flags that are turned over.
    flags: u32,
    step: Option<u32>,
    clock: Clock,
    /// The schedule shows the same; else only the time of publication is wrong.
    schedule_too: bool,
    period_ns: u64,
    executed: Executed,
    reward: f32,
    proprioception: Option<(usize, f32)>,
    task: Option<u32>,
    picture: u32,
    /// Wakes the controller.
    pub(crate) wakes: bool,
}

/// What the peer counts.
#[derive(Debug, Clone, Default)]
pub(crate) struct Counts {
    pub(crate) sequence: u64,
    pub(crate) episode: u64,
    pub(crate) step: u32,
    /// The last action on the wire.
    pub(crate) sent: ActionValues,
}

fn hard(rng: &mut ChaCha8Rng) -> u64 {
    if rng.random_bool(0.2) { rng.random() } else { HARD.choose(rng).copied().unwrap_or(0) }
}

fn hard_float(rng: &mut ChaCha8Rng) -> f32 {
    if rng.random_bool(0.2) {
        f32::from_bits(rng.random())
    } else {
        HARD_FLOATS.choose(rng).copied().unwrap_or(f32::NAN)
    }
}

impl Draft {
    fn honest(rng: &mut ChaCha8Rng, period_ns: u64) -> Self {
        let begins = rng.random_bool(0.03);
        let last = !begins && rng.random_bool(0.02);
        Self {
            sequence: Sequence::Next,
            counts: true,
            episode_off: 0,
            begins,
            flags: ObservationFlags::default().with(ObservationFlags::LAST, last).0,
            step: None,
            clock: Clock::Right,
            schedule_too: true,
            period_ns,
            executed: Executed::AsSent,
            reward: rng.random_range(-1.0..10.0),
            proprioception: None,
            task: None,
            picture: rng.random(),
            wakes: true,
        }
    }

    /// A message of a peer that behaves so.
    pub(crate) fn of(rng: &mut ChaCha8Rng, behaviour: Behaviour, period_ns: u64) -> Self {
        let mut draft = Self::honest(rng, period_ns);
        match behaviour {
            Behaviour::Honest | Behaviour::Silence | Behaviour::Burst => {}
            Behaviour::Joining => draft.join(rng),
            Behaviour::Flood => draft.flood(rng),
            Behaviour::Disorder => draft.disorder(rng),
            Behaviour::Interleaved => {
                draft.episode_off = rng.random_range(0..2);
                draft.begins = false;
            }
            Behaviour::Clock(_) => {
                draft.clock = Clock::any(rng, period_ns);
                draft.schedule_too = rng.random_bool(0.7);
            }
            Behaviour::Numbers => draft.numbers(rng),
            Behaviour::Garbage => {
                for _ in 0..rng.random_range(1..5) {
                    draft.garbage(rng);
                }
            }
        }
        draft
    }

    fn join(&mut self, rng: &mut ChaCha8Rng) {
        self.begins = false;
        if rng.random_bool(0.1) {
            self.episode_off = rng.random_range(0..100);
            self.executed =
                Executed::Given(ActionValues::from_fn(ACTION_LEN, |_| rng.random_range(-1.0..1.0)));
        }
    }

    fn flood(&mut self, rng: &mut ChaCha8Rng) {
        (self.counts, self.begins) = (false, false);
        match rng.random_range(0..3) {
            0 => self.sequence = Sequence::Back(rng.random_range(1..20)),
            1 => self.clock = Clock::Behind(self.period_ns.max(1).saturating_mul(20)),
            _ => {
                self.sequence = Sequence::Back(1);
                self.clock = Clock::Behind(u64::MAX);
            }
        }
    }

    fn disorder(&mut self, rng: &mut ChaCha8Rng) {
        match rng.random_range(0..8) {
            0 => self.sequence = Sequence::Same,
            1 => {
                self.sequence = Sequence::Same;
                self.flags ^= ObservationFlags::REPEATED.0;
            }
            2 => (self.sequence, self.counts) = (Sequence::Back(rng.random_range(1..50)), false),
            3 => self.sequence = Sequence::Ahead(rng.random_range(2..5)),
            4 => (self.sequence, self.counts) = (Sequence::Ahead(rng.random_range(1..5)), false),
            5 => self.wakes = false,
            _ => {}
        }
    }

    fn numbers(&mut self, rng: &mut ChaCha8Rng) {
        let number = hard_float(rng);
        match rng.random_range(0..6) {
            0 => self.reward = number,
            1 => self.proprioception = Some((rng.random_range(0..18), number)),
            2 => self.executed = Executed::Given(ActionValues::from_fn(ACTION_LEN, |_| hard_float(rng))),
            3 => self.executed = Executed::Spoilt(rng.random_range(0..ACTION_LEN), number),
            _ => {}
        }
    }

    fn garbage(&mut self, rng: &mut ChaCha8Rng) {
        match rng.random_range(0..10) {
            0 => {
                self.sequence = Sequence::Absolute(hard(rng));
                self.counts = rng.random_bool(0.3);
            }
            1 => self.episode_off = hard(rng),
            2 => self.step = Some(hard(rng) as u32),
            3 => self.flags = rng.random(),
            4 => self.flags ^= 1 << rng.random_range(0..9),
            5 => self.clock = Clock::any(rng, self.period_ns),
            6 => self.period_ns = [0, 1, 1_000_000, hard(rng)].choose(rng).copied().unwrap_or(0),
            7 => self.task = Some(hard(rng) as u32),
            8 => self.begins = !self.begins,
            _ => self.numbers(rng),
        }
    }

    /// Fills the message in, and counts on.
    pub(crate) fn fill(&self, counts: &mut Counts, now_ns: u64) -> OwnedObservation {
        let mut whole = OwnedObservation::zeroed(&Format::metaworld());
        let mut message = whole.edit();
        if self.begins {
            counts.episode = counts.episode.wrapping_add(1);
            counts.step = 0;
        }
        let sequence = counts.sequence;
        message.sequence = match self.sequence {
            Sequence::Next => sequence.wrapping_add(1),
            Sequence::Same => sequence,
            Sequence::Back(by) => sequence.saturating_sub(by),
            Sequence::Ahead(by) => sequence.saturating_add(by),
            Sequence::Absolute(sequence) => sequence,
        };
        if self.counts {
            counts.sequence = message.sequence;
        }
        message.episode = counts.episode.wrapping_add(self.episode_off);
        message.step = self.step.unwrap_or(counts.step);
        counts.step = counts.step.wrapping_add(1);
        message.flags = self.flags ^ (u32::from(self.begins) * ObservationFlags::FIRST.0);
        message.period_ns = self.period_ns;
        message.published_ns = self.clock.shows(now_ns);
        message.scheduled_ns = if self.schedule_too { message.published_ns } else { now_ns };
        message.task = self.task.unwrap_or(rcwm_models::tasks::OWN_TASK);
        message.reward = self.reward;
        let executed = match self.executed {
            Executed::AsSent if self.begins => [0.0; ACTION_LEN].into(),
            Executed::AsSent => counts.sent,
            Executed::Given(action) => action,
            Executed::Spoilt(at, value) => {
                let mut action = counts.sent;
                action[at] = value;
                action
            }
        };
        message.executed().copy_from_slice(&executed);
        if let Some((at, value)) = self.proprioception {
            message.state()[at] = value;
        }
        let mut word = self.picture | 1;
        for place in message.image(0).iter_mut() {
            word = word.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            *place = (word >> 24) as u8;
        }
        if let Some(mask) = message.mask(0) {
            mask.fill(self.picture as u8);
        }
        whole
    }
}
