//! One run of the real controller in a world of its own.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use anyhow::Context;
use rcwm_models::errors::one_line;
use rcwm_models::wire::{ControllerLink, Format, LinkSettings, SimulatorLink};
use rcwm_runtime::controller::{Controller, ControllerError, ControllerSettings, Ended, Fallback};
use rcwm_runtime::policy::Sampling;
use rcwm_runtime::swap::{SwapSettings, Swapper};
use rcwm_runtime::{EngineKind, EngineSettings, Policy};

use crate::asking::Asking;
use crate::bundles::{Bundles, Choice};
use crate::judge::{Judge, Sent, Violation};
use crate::scenario::{Deed, Scenario, Setup};
use crate::wire::Wire;
use crate::world::{Stage, Witness, World};

thread_local! {
    /// What a panic of the running controller said; none outside of a run.
    static PANIC: Cell<Option<String>> = const { Cell::new(None) };
}

/// Keeps what a panic of the controller says for the report.
pub(crate) fn keep_panics() {
    let default = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| match PANIC.take() {
        Some(_) => PANIC.set(Some(info.to_string().replace('\n', " "))),
        None => default(info),
    }));
}

/// What became of a run.
#[derive(Debug)]
pub(crate) struct Outcome {
    /// The first thing that must not happen, with the deed and the number of messages by then.
    pub(crate) violation: Option<(Violation, usize, u64)>,
    pub(crate) messages: u64,
    pub(crate) sent: Sent,
    pub(crate) swaps: u64,
    /// How the controller says that it ended.
    pub(crate) ended: Option<Ended>,
    /// Tells two runs apart.
    pub(crate) digest: u64,
}

/// Runs the deeds of a scenario that `keep` lets through.
pub(crate) fn run(
    seed: u64,
    scenario: &Scenario,
    keep: &dyn Fn(usize) -> bool,
    bundles: &Bundles,
    link: &LinkSettings,
    ignored: &[String],
) -> anyhow::Result<Outcome> {
    let steps: VecDeque<_> = scenario.steps.iter().cloned().enumerate().filter(|(at, _)| keep(*at)).collect();
    let mut setup = scenario.setup.clone();
    let (choice, policy) = policy(bundles, &setup)?;
    let known = choice.known().context("a bundle that runs")?;
    if known.is_absolute && setup.fallback == Fallback::Zero {
        // Refused: zeros are a pose.
        setup.fallback = Fallback::Hold;
    }
    if let Fallback::Given(action) = setup.fallback {
        // Refused: beyond the bundle's limits.
        setup.fallback = Fallback::Given(known.limits.clamp(action));
    }
    let setup = &setup;
    let swaps = steps.iter().any(|(_, step)| matches!(step.deed, Deed::Swap { .. }));
    let swapper = swaps.then(|| swapper(link, setup, &policy)).transpose()?;
    // The first two make the services as they must be.
    let controller_link = ControllerLink::open(link.clone(), |_| Vec::new())?;
    let robot = SimulatorLink::open(link.clone(), &Format::metaworld())?;
    controller_link.wait_robot(Duration::from_secs(10))?.context("the controller does not find its robot")?;
    drop(robot);
    let wire = Wire::join(link)?;
    let choices = bundles.all.iter().map(|choice| (choice.folder.clone(), choice.known())).collect();
    let asking = Asking::new(link.clone(), choices, known);
    let judge = Judge::new(setup.clone(), known, ignored.to_vec());
    let stop = Arc::<AtomicBool>::default();
    let world = World::new(wire, judge, asking, setup.clone(), steps, seed, Arc::clone(&stop));
    let world = Rc::new(RefCell::new(world));
    let stage = Stage { link: controller_link, world: Rc::clone(&world) };
    let mut witness = Witness(Rc::clone(&world));
    PANIC.set(Some(String::new()));
    // As `rcwm-runtime run` does it.
    let ran = catch_unwind(AssertUnwindSafe(|| {
        let mut controller = Controller::on(Box::new(stage), policy, settings(link, setup))?;
        if let Some(swapper) = swapper {
            controller.take_swaps(swapper);
        }
        let result = controller.run(&stop, &mut [&mut witness]);
        let ended = result.as_ref().map_or_else(Ended::from, |ended| *ended);
        let report = controller.report(EngineKind::Tract, ended);
        let closed = controller.close();
        Ok::<_, ControllerError>((result, report, closed))
    }));
    let panic = PANIC.take().unwrap_or_default();
    drop(witness);
    let mut world = Rc::into_inner(world).context("the controller is gone")?.into_inner();
    let told = world.is_told();
    let swaps = world.swaps();
    let mut ended = None;
    match &ran {
        Err(_) => {
            let untold = if told { "" } else { "; and the robot is not told" };
            world.judge.object("panic", || format!("{panic}{untold}"));
        }
        Ok(Err(error)) => anyhow::bail!("the controller does not start: {error}"),
        Ok(Ok((result, report, closed))) => {
            world.judge.check_counters(&report.counters, swaps);
            ended = Some(report.ended);
            match (result, closed) {
                (_, Err(error)) => world.judge.object("not told", || one_line(error)),
                _ if !told => world.judge.object("not told", || format!("the run has ended: {result:?}")),
                (Err(error @ ControllerError::Panicked(_)), _) => {
                    world.judge.object("panic", || one_line(error));
                }
                (Err(error), _) if !is_expected(error, setup) => {
                    world.judge.object("ended", || one_line(error));
                }
                _ => {}
            }
        }
    }
    let at = world.violated_at.unwrap_or((scenario.steps.len().saturating_sub(1), world.messages));
    let violation = world.judge.violation.clone().map(|violation| (violation, at.0, at.1));
    Ok(Outcome {
        violation,
        messages: world.messages,
        sent: world.judge.sent,
        swaps,
        ended,
        digest: world.judge.digest(),
    })
}

/// Ends that a peer may bring about.
fn is_expected(error: &ControllerError, setup: &Setup) -> bool {
    match error {
        ControllerError::Stopped { .. } => true,
        ControllerError::PeerLost { .. } => setup.silence_max.is_some(),
        _ => false,
    }
}

fn engine() -> EngineSettings {
    // The second thread gives the same bits, but its lateness is the machine's.
    EngineSettings::single_threaded(EngineKind::Tract)
}

fn sampling(setup: &Setup) -> Sampling {
    setup.sampling.map_or(Sampling::Mode, |seed| Sampling::Sample { seed })
}

fn policy<'a>(bundles: &'a Bundles, setup: &Setup) -> anyhow::Result<(&'a Choice, Policy)> {
    let (choice, bundle) = bundles.to_start(setup.bundle);
    match Policy::new(bundle, engine(), sampling(setup)) {
        Ok(policy) => Ok((choice, policy)),
        // Refused at loading is as good as refused at the door.
        Err(_) if !choice.is_sound => {
            let (choice, bundle) = bundles.to_start(0);
            Ok((choice, Policy::new(bundle, engine(), sampling(setup))?))
        }
        Err(error) => Err(error.into()),
    }
}

fn swapper(link: &LinkSettings, setup: &Setup, policy: &Policy) -> anyhow::Result<Swapper> {
    let interface = policy.manifest().interface.clone();
    let settings = SwapSettings {
        link: link.clone(),
        engine: engine(),
        sampling: sampling(setup),
        interface,
        surprise: setup.surprise,
    };
    Ok(Swapper::start(settings)?)
}

fn settings(link: &LinkSettings, setup: &Setup) -> ControllerSettings {
    ControllerSettings {
        episodes_max: setup.episodes_max,
        stay: setup.stay,
        silence_max: setup.silence_max,
        first_timeout: None::<Duration>,
        pacing: setup.pacing,
        ticks: setup.ticks,
        fallback: setup.fallback,
        surprise: setup.surprise,
        rate_max: setup.rate_max,
        ..ControllerSettings::new(link.clone())
    }
}
