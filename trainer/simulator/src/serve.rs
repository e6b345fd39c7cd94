//! The serving loop: publish an observation, get an action, execute it.
//!
//! A controller may come, go or die at any time: in lock-step the present observation is published again for the next one, in
//! real time the last action is held for a while, and not at all when the controller has said that it leaves: then the robot rests
//! until the next one answers.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rcwm_models::ACTION_LEN;
use rcwm_models::wire::clock::monotonic_ns;
use rcwm_models::wire::{Action, Events, Observation, ObservationFlags, ObservationMut, SimulatorLink, Wait};

use crate::environment::{Environment, STEPS_MAX};
use crate::policy::Script;
use crate::report::Tally;
use crate::schedule::{Schedule, sleep_until};
pub use crate::settings::{Pace, ServeSettings};
use crate::{SimulatorError, snapshot};

/// The longest single wait, so that a stop is noticed.
const WAIT_SLICE: Duration = Duration::from_millis(100);
/// After so much silence a lock-step observation is published again: its receiver may have died with it.
const SILENCE: Duration = Duration::from_secs(1);
/// In real time, the last action is held for so long without an answer; then the robot rests.
const HOLD_NS_MAX: u64 = 1_000_000_000;
/// Steps between two snapshots of the first episode.
const SNAPSHOT_STEPS: u32 = 50;

/// Where the run is: everything of an observation that the environment does not know.
#[derive(Debug, Clone, Copy, Default)]
struct Place {
    sequence: u64,
    episode: u64,
    step: u32,
    executed: [f32; ACTION_LEN],
    held: bool,
    pushed: bool,
    scheduled_ns: u64,
    /// When it was published for the first time.
    published_ns: u64,
}

/// What the loop needs to know about an observation that is on its way.
struct Published {
    reward: f32,
    solved: bool,
    published_ns: u64,
}

/// An answer to the present observation, fit to be executed; `None` when there was none.
type Answer = Option<[f32; ACTION_LEN]>;

/// The hand stays where it is, for actions are displacements; the gripper goes on with what it does.
fn at_rest([_, _, _, grip]: [f32; ACTION_LEN]) -> [f32; ACTION_LEN] {
    [0.0, 0.0, 0.0, grip]
}

/// Serves until the episodes are done or `stop` is set, then says goodbye to the controller.
///
/// `progress` is called with each new place: episode and step.
///
/// # Errors
/// See [`SimulatorError`]; the controller is told that the simulator closes in this case as well.
pub fn serve(
    environment: &Environment,
    link: SimulatorLink,
    settings: &ServeSettings,
    stop: &AtomicBool,
    progress: impl Fn(u64, u32),
) -> Result<Tally, SimulatorError> {
    let mut server = Server {
        environment,
        link: &link,
        settings,
        stop,
        tally: Tally::default(),
        place: Place::default(),
        abandoned: false,
        held_in_a_row: 0,
        met_controller: false,
        started: Instant::now(),
        progress: &progress,
    };
    let served = server.episodes();
    let mut tally = server.tally;
    tally.seconds = server.started.elapsed().as_secs_f64();
    let closed = link.close();
    served?;
    closed?;
    Ok(tally)
}

struct Server<'a> {
    environment: &'a Environment,
    link: &'a SimulatorLink,
    settings: &'a ServeSettings,
    stop: &'a AtomicBool,
    tally: Tally,
    place: Place,
    /// The controller has said that it leaves, and none has answered since.
    abandoned: bool,
    /// Steps without an answer in a row.
    held_in_a_row: u64,
    /// Whether any answer has come; the fixed clock does not start before.
    met_controller: bool,
    /// When the first answer came, or the loop began where none is waited for.
    started: Instant,
    progress: &'a dyn Fn(u64, u32),
}

impl Server<'_> {
    fn episodes(&mut self) -> Result<(), SimulatorError> {
        let first = self.settings.first_episode;
        let end = self.settings.episodes.map(|count| first.saturating_add(count));
        let mut episode = first;
        while end.is_none_or(|end| episode < end) && !self.stopped() {
            if !self.episode(episode)? {
                break;
            }
            episode += 1;
        }
        Ok(())
    }

    fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Runs one episode; `false` when it was stopped before its end.
    fn episode(&mut self, episode: u64) -> Result<bool, SimulatorError> {
        self.environment.reset(episode)?;
        let mut script = Script::new(self.settings.policy, self.environment.settings().seed, episode);
        self.place = Place { sequence: self.place.sequence, episode, ..Place::default() };
        let (mut sum, mut solved) = (0.0, false);
        let mut clock = self.clock(1);
        self.publish_new(monotonic_ns(), &mut sum, &mut solved)?;
        loop {
            let Some(answer) = self.answer(&mut clock)? else { return Ok(false) };
            if self.place.step == self.settings.steps_max.min(STEPS_MAX) {
                break;
            }
            let due_ns = clock.as_ref().map_or_else(monotonic_ns, Schedule::next_ns);
            let action =
                if self.settings.policy.is_scripted() { script.decide(self.environment)? } else { answer };
            self.place.pushed = script.pushed();
            self.execute(action)?;
            self.publish_new(due_ns, &mut sum, &mut solved)?;
            if let Some(clock) = &mut clock {
                self.tally.missed += clock.advance(monotonic_ns());
            }
        }
        self.tally.episodes.push((sum, solved));
        Ok(true)
    }

    /// In real time, a schedule whose first tick is so many periods from now.
    fn clock(&self, periods: u64) -> Option<Schedule> {
        match self.settings.pace {
            Pace::RealTime { period_ns } => {
                Some(Schedule::with_first_tick(monotonic_ns() + periods * period_ns, period_ns))
            }
            Pace::LockStep | Pace::Free => None,
        }
    }

    /// Executes an answer. Where there is none it holds the last action (zeros at the first step of an episode), or rests.
    fn execute(&mut self, action: Answer) -> Result<(), SimulatorError> {
        self.place.held = action.is_none();
        self.held_in_a_row = if self.place.held { self.held_in_a_row.saturating_add(1) } else { 0 };
        let rests = self.place.held && self.rests();
        let action = match action {
            Some(action) => action.map(|x| x.clamp(-1.0, 1.0)),
            None if rests => at_rest(self.place.executed),
            None => self.place.executed,
        };
        self.tally.rested += u64::from(rests);
        let start_ns = monotonic_ns();
        self.environment.step(action)?;
        self.tally.work.add_ns(monotonic_ns() - start_ns);
        self.tally.steps += 1;
        self.tally.held += u64::from(self.place.held);
        self.place.step += 1;
        self.place.executed = action;
        Ok(())
    }

    /// Whether a step without an answer is one at rest: nobody steers any more.
    fn rests(&self) -> bool {
        match self.settings.pace {
            Pace::RealTime { period_ns } => {
                self.abandoned || self.held_in_a_row.saturating_mul(period_ns) > HOLD_NS_MAX
            }
            Pace::LockStep | Pace::Free => false,
        }
    }

    fn publish_new(&mut self, due_ns: u64, sum: &mut f64, solved: &mut bool) -> Result<(), SimulatorError> {
        self.place.sequence = self.tally.observations;
        self.place.scheduled_ns = due_ns;
        let observation = self.publish(false)?;
        self.place.published_ns = observation.published_ns;
        self.tally.observations += 1;
        *sum += f64::from(observation.reward);
        *solved |= observation.solved;
        (self.progress)(self.place.episode, self.place.step);
        Ok(())
    }

    /// Publishes the present observation.
    fn publish(&self, repeated: bool) -> Result<Published, SimulatorError> {
        let mut slot = self.link.slot()?;
        let mut observation = slot.edit();
        let solved = self.environment.write_to(&mut observation)?;
        self.fill(&mut observation, solved, repeated);
        let observation = observation.view();
        if !observation.is_finite() {
            return Err(SimulatorError::Diverged {
                task: self.environment.settings().task.clone(),
                episode: self.place.episode,
                step: self.place.step,
            });
        }
        self.snapshot(&observation)?;
        let published = Published { reward: observation.reward, solved, published_ns: monotonic_ns() };
        self.link.send(slot)?;
        Ok(published)
    }

    fn fill(&self, observation: &mut ObservationMut<'_>, solved: bool, repeated: bool) {
        let Place { sequence, episode, step, executed, held, pushed, scheduled_ns, .. } = self.place;
        observation.sequence = sequence;
        observation.episode = episode;
        observation.step = step;
        observation.executed().copy_from_slice(&executed);
        observation.scheduled_ns = match self.settings.pace {
            Pace::RealTime { .. } if !repeated => scheduled_ns,
            _ => monotonic_ns(),
        };
        observation.period_ns = match self.settings.pace {
            Pace::RealTime { period_ns } => period_ns,
            Pace::LockStep | Pace::Free => 0,
        };
        observation.flags = ObservationFlags::default()
            .with(ObservationFlags::FIRST, step == 0)
            .with(ObservationFlags::LAST, step == self.settings.steps_max.min(STEPS_MAX))
            .with(ObservationFlags::SUCCESS, solved)
            .with(ObservationFlags::MASK_VALID, self.environment.settings().masks)
            .with(ObservationFlags::ACTION_HELD, held)
            .with(ObservationFlags::REPEATED, repeated)
            .with(ObservationFlags::PUSHED, pushed)
            .0;
    }

    fn snapshot(&self, observation: &Observation<'_>) -> Result<(), SimulatorError> {
        let Some(folder) = &self.settings.snapshots else { return Ok(()) };
        let first = observation.episode == self.settings.first_episode;
        if first && observation.step.is_multiple_of(SNAPSHOT_STEPS) {
            snapshot::write(folder, &self.environment.settings().task, observation)?;
        }
        Ok(())
    }

    /// The answer to the present observation, as the pace has it; `None` when stopped.
    fn answer(&mut self, clock: &mut Option<Schedule>) -> Result<Option<Answer>, SimulatorError> {
        match (self.settings.pace, clock) {
            (Pace::Free, _) => {
                let events = self.link.poll_events()?;
                self.note(events);
                Ok((!self.stopped()).then_some(None))
            }
            (Pace::RealTime { .. }, Some(clock))
                if self.met_controller || self.settings.policy.is_scripted() =>
            {
                self.tick(clock)
            }
            (_, clock) => {
                let answer = self.wait_for_answer()?;
                // Waiting for the first controller is no lateness: the clock starts with its answer.
                *clock = self.clock(0);
                Ok(answer)
            }
        }
    }

    /// Real time: sleeps to the tick, then takes what has come.
    fn tick(&mut self, clock: &Schedule) -> Result<Option<Answer>, SimulatorError> {
        let slice_ns = WAIT_SLICE.as_nanos() as u64;
        while monotonic_ns() < clock.next_ns() {
            if self.stopped() {
                return Ok(None);
            }
            sleep_until(clock.next_ns().min(monotonic_ns() + slice_ns));
        }
        let events = self.link.poll_events()?;
        self.note(events);
        self.abandoned |= events.closed;
        let answer = match self.link.poll_action()? {
            Some(action) if self.is_answer(&action) => {
                self.meet_controller(action.published_ns);
                // An answer that came with a goodbye was the last one.
                self.abandoned = events.closed;
                self.checked(&action)
            }
            _ => None,
        };
        Ok((!self.stopped()).then_some(answer))
    }

    /// Lock-step: waits for the answer, and publishes the observation again for a controller that is new or silent.
    fn wait_for_answer(&mut self) -> Result<Option<Answer>, SimulatorError> {
        let start = Instant::now();
        let mut published = start;
        while !self.stopped() {
            let (wait, events) = self.link.wait_action(WAIT_SLICE)?;
            self.note(events);
            if let Wait::Message(action) = wait
                && self.is_answer(&action)
            {
                self.meet_controller(monotonic_ns());
                return Ok(Some(self.checked(&action)));
            }
            let silent = published.elapsed() >= SILENCE;
            if silent {
                self.link.clean_up_dead_peers();
                self.check_silence(start)?;
            }
            if silent || events.hello {
                self.publish(true)?;
                self.tally.repeated += 1;
                published = Instant::now();
            }
        }
        Ok(None)
    }

    /// Notes the time of an answer, but for the first one: the simulator was there before its controller.
    fn meet_controller(&mut self, answered_ns: u64) {
        if self.met_controller {
            self.tally.answer.add_ns(answered_ns.saturating_sub(self.place.published_ns));
        } else {
            self.met_controller = true;
            self.started = Instant::now();
        }
    }

    fn check_silence(&self, start: Instant) -> Result<(), SimulatorError> {
        match self.settings.silence_max {
            Some(max) if start.elapsed() >= max => Err(SimulatorError::NoController {
                instance: self.settings.instance.clone(),
                seconds: max.as_secs(),
            }),
            _ => Ok(()),
        }
    }

    fn note(&mut self, events: Events) {
        self.tally.controllers_came += u64::from(events.hello);
        self.tally.controllers_left += u64::from(events.closed);
    }

    /// Whether an action answers the present observation; others are counted.
    fn is_answer(&mut self, action: &Action) -> bool {
        let answers = action.answers == self.place.sequence;
        self.tally.dropped += u64::from(!answers);
        answers
    }

    /// An action with a value that is not finite is no answer.
    fn checked(&mut self, action: &Action) -> Answer {
        let numbers = <[f32; ACTION_LEN]>::try_from(&*action.action).ok();
        let fit = numbers.filter(|numbers| numbers.iter().all(|x| x.is_finite()));
        self.tally.refused += u64::from(fit.is_none());
        fit
    }
}
