//! What the peer does and how the controller is set up, decided by the seed alone.
//!
//! A message is drafted relative to what the peer did before (the next sequence, the action that it was sent), and filled in when it is
//! published. So what is left of a scenario after some of its deeds were dropped is a scenario again, which makes it easy to shorten.

use std::time::Duration;

use rand::seq::IndexedRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::wire::ActionValues;
use rcwm_runtime::controller::{Fallback, SurpriseLimits, TickLimits};
use rcwm_runtime::pacing::PacingSettings;

use crate::draft::{Behaviour, Draft};

const MS_NS: u64 = 1_000_000;
/// Periods of real time, in ns.
const PERIODS_NS: [u64; 5] = [200_000, MS_NS, 5 * MS_NS, 25 * MS_NS, 200 * MS_NS];

/// How the controller is set up.
#[derive(Debug, Clone)]
pub(crate) struct Setup {
    /// The control period of real time, in ns; 0 for lock-step.
    pub(crate) period_ns: u64,
    pub(crate) rate_max: Option<f32>,
    pub(crate) fallback: Fallback,
    pub(crate) ticks: TickLimits,
    pub(crate) pacing: PacingSettings,
    pub(crate) surprise: SurpriseLimits,
    pub(crate) stay: bool,
    pub(crate) episodes_max: Option<u64>,
    pub(crate) silence_max: Option<Duration>,
    /// Which of the bundles.
    pub(crate) bundle: usize,
    /// Samples with this seed, or takes the most probable.
    pub(crate) sampling: Option<u64>,
    /// The controller now and then takes periods for what should take microseconds.
    pub(crate) stalls: bool,
    /// The peer never takes the events that wake it.
    pub(crate) deaf: bool,
}

/// When a deed is done.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum When {
    /// As soon as the controller waits: it has answered what it is going to answer.
    Answered,
    /// So long after the deed before, in ns, whatever the controller does meanwhile.
    After(u64),
}

/// Something that the peer does.
#[derive(Debug, Clone)]
pub(crate) enum Deed {
    /// Publishes a message.
    Publish(Box<Draft>),
    /// Says that it closes.
    Close,
    /// Sends an event of another meaning.
    Notify(usize),
    /// Dies and is started again; where `counts_on`, with sequence and episode going on.
    Restart { counts_on: bool },
    /// Somebody asks for another bundle.
    Swap { bundle: usize, now: bool },
}

/// A deed and its time.
#[derive(Debug, Clone)]
pub(crate) struct Step {
    pub(crate) when: When,
    pub(crate) deed: Deed,
}

/// A run of the controller and all that its peer does.
#[derive(Debug, Clone)]
pub(crate) struct Scenario {
    pub(crate) setup: Setup,
    pub(crate) steps: Vec<Step>,
}

impl Scenario {
    /// The scenario of a seed, of so many messages, over so many bundles.
    pub(crate) fn of(seed: u64, messages: usize, bundles: usize) -> Self {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed);
        let setup = setup(rng, bundles);
        let mut steps = Vec::with_capacity(messages);
        // Few, as each takes as long as loading a bundle.
        let swaps_max = if rng.random_bool(0.4) { rng.random_range(1..=2) } else { 0 };
        let mut swap_at: Vec<usize> = (0..swaps_max).map(|_| rng.random_range(0..messages.max(1))).collect();
        let mut published = 0;
        while published < messages {
            let behaviour = Behaviour::any(rng);
            let len = rng.random_range(1..=120).min(messages - published);
            for at in 0..len {
                published += 1;
                if let Some(deed) = aside(rng) {
                    steps.push(Step { when: when(rng, &setup, behaviour, false), deed });
                }
                if let Some(place) = swap_at.iter().position(|at| *at < published) {
                    swap_at.swap_remove(place);
                    let deed = Deed::Swap { bundle: rng.random_range(0..bundles), now: rng.random_bool(0.6) };
                    steps.push(Step { when: When::Answered, deed });
                }
                let draft = Draft::of(rng, behaviour, setup.period_ns);
                let when = when(rng, &setup, behaviour, at == 0);
                steps.push(Step { when, deed: Deed::Publish(Box::new(draft)) });
            }
        }
        Self { setup, steps }
    }
}

fn setup(rng: &mut ChaCha8Rng, bundles: usize) -> Setup {
    let lockstep = rng.random_bool(0.5);
    let any = |rng: &mut ChaCha8Rng, of: &[Option<f32>]| of.choose(rng).copied().flatten();
    let fallback = match rng.random_range(0..5) {
        0 | 1 => Fallback::Hold,
        2 => Fallback::Zero,
        3 => Fallback::Interface,
        _ => Fallback::Given(ActionValues::from_fn(rcwm_models::ACTION_LEN, |_| rng.random_range(-1.0..1.0))),
    };
    let surprise = rng.random_bool(0.2);
    let nats = [None, Some(0.0), Some(0.5), Some(20.0)];
    Setup {
        period_ns: if lockstep { 0 } else { PERIODS_NS.choose(rng).copied().unwrap_or(MS_NS) },
        rate_max: any(rng, &[None, None, Some(0.0), Some(0.01), Some(0.1), Some(0.1), Some(0.5)]),
        fallback,
        ticks: TickLimits {
            imagined_ticks_max: [0, 1, 5, 5, 50].choose(rng).copied().unwrap_or(5),
            // Where the policy gives nothing valid for longer the run ends, and with it the scenario.
            fallback_ticks_max: [3, 200, 200, u32::MAX].choose(rng).copied().unwrap_or(200),
        },
        pacing: PacingSettings {
            spin: Duration::from_micros([0, 50, 500].choose(rng).copied().unwrap_or(50)),
            gets_ready: rng.random_bool(0.7),
            grace_periods: [0.0, 0.5, 0.5, 2.0].choose(rng).copied().unwrap_or(0.5),
            stale_periods: [1.0, 2.0, 2.0, 10.0].choose(rng).copied().unwrap_or(2.0),
        },
        surprise: SurpriseLimits {
            robot_max: surprise.then(|| any(rng, &nats)).flatten(),
            environment_max: surprise.then(|| any(rng, &nats)).flatten(),
            dynamics_max: None,
        },
        stay: rng.random_bool(0.9),
        episodes_max: rng.random_bool(0.05).then(|| rng.random_range(1..20)),
        silence_max: rng.random_bool(0.1).then(|| Duration::from_millis(rng.random_range(500..20_000))),
        bundle: rng.random_range(0..bundles.max(1)),
        sampling: rng.random_bool(0.7).then(|| rng.random()),
        stalls: rng.random_bool(0.5),
        deaf: rng.random_bool(0.1),
    }
}

/// What a peer does beside publishing, once in a while.
fn aside(rng: &mut ChaCha8Rng) -> Option<Deed> {
    match rng.random_range(0..2000) {
        0..4 => Some(Deed::Close),
        4..14 => Some(Deed::Notify(rng.random_range(0..8))),
        14..24 => Some(Deed::Restart { counts_on: rng.random_bool(0.5) }),
        _ => None,
    }
}

fn when(rng: &mut ChaCha8Rng, setup: &Setup, behaviour: Behaviour, begins: bool) -> When {
    let period_ns = if setup.period_ns == 0 { MS_NS } else { setup.period_ns };
    let part = |rng: &mut ChaCha8Rng, low: f64, high: f64| {
        When::After((period_ns as f64 * rng.random_range(low..high)) as u64)
    };
    match behaviour {
        // A stand-in is due meanwhile, as often as it may be.
        Behaviour::Silence => part(rng, 0.5, 80.0),
        Behaviour::Flood | Behaviour::Burst if rng.random_bool(0.9) => When::After(rng.random_range(0..3000)),
        _ if begins && rng.random_bool(0.2) => part(rng, 1.0, 400.0),
        _ if setup.period_ns == 0 => match rng.random_range(0..20) {
            0 => part(rng, 0.0, 0.1),
            1 => part(rng, 0.1, 3.0),
            _ => When::Answered,
        },
        Behaviour::Honest => part(rng, 0.98, 1.02),
        _ => match rng.random_range(0..20) {
            0 => part(rng, 0.0, 0.1),
            1 => part(rng, 1.0, 4.0),
            2 => When::Answered,
            _ => part(rng, 0.95, 1.05),
        },
    }
}
