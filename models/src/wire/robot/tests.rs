use std::sync::Arc;

use super::*;
use crate::wire::link::tests::{SOON, anything, arm, domain};
use crate::wire::{ControllerLink, Format, LinkSettings};

/// Two joints that are where they were last told to be, slower than told when they are `heavy`.
#[derive(Default)]
struct Joints {
    at: [f32; 2],
    heavy: bool,
    executed: Vec<ActionValues>,
    fails_at: Option<usize>,
    fails_from: Option<usize>,
    takes: Option<Duration>,
    panics_at: Option<usize>,
    measures: Option<f32>,
}

impl Robot for Joints {
    fn reset(&mut self, _: u64) -> Result<(), RobotError> {
        self.at = [0.5, -0.5];
        Ok(())
    }

    fn observe(&mut self, observation: &mut ObservationMut<'_>) -> Result<(), RobotError> {
        observation.reward = 1.0;
        observation.state().copy_from_slice(&self.at);
        if let Some(measured) = self.measures {
            observation.state()[0] = measured;
        }
        Ok(())
    }

    fn execute(&mut self, action: &ActionValues) -> Result<ActionValues, RobotError> {
        self.executed.push(*action);
        self.takes.into_iter().for_each(std::thread::sleep);
        let count = self.executed.len();
        if self.fails_at == Some(count) || self.fails_from.is_some_and(|from| count >= from) {
            return Err("the brakes are on".into());
        }
        assert_ne!(self.panics_at, Some(self.executed.len()), "a fault of the robot's program");
        let share = if self.heavy { 0.5 } else { 1.0 };
        let moved: ActionValues =
            self.at.iter().zip(action.iter()).map(|(at, to)| at + share * (to - at)).collect();
        self.at.copy_from_slice(&moved);
        Ok(moved)
    }
}

/// Serves `robot`, with a controller that answers by `answer`, which gives none to leave.
fn with_controller(
    robot: &mut Joints,
    name: &str,
    settings: ServeSettings,
    answer: impl Fn(u64, &[f32]) -> Option<Vec<f32>> + Sync,
) -> Result<Served, ServeError> {
    let (link_settings, _domain) = domain(name);
    let link = SimulatorLink::open(link_settings.clone(), &arm()).unwrap();
    std::thread::scope(|scope| {
        scope.spawn(|| answer_all(link_settings, &answer));
        serve(robot, link, &settings, &AtomicBool::new(false))
    })
}

fn answer_all(settings: LinkSettings, answer: impl Fn(u64, &[f32]) -> Option<Vec<f32>>) {
    let controller = ControllerLink::open(settings, anything).unwrap();
    while let Ok(Wait::Message(observation)) = controller.wait_observation(SOON) {
        let Some(action) = answer(observation.sequence, observation.view().executed()) else { return };
        let action = ActionValues::of(&action).unwrap();
        controller
            .send(&Action { answers: observation.sequence, published_ns: 0, source: 0, action })
            .unwrap();
    }
}

const LOCKSTEP: ServeSettings = ServeSettings { episodes: 2, steps: 3, realtime: false, timeout: SOON };

#[test]
fn whole_episodes_are_served_and_what_was_really_executed_is_told() {
    let mut robot = Joints { heavy: true, ..Joints::default() };
    let told = std::sync::Mutex::new(Vec::new());
    let served = with_controller(&mut robot, "serve", LOCKSTEP, |sequence, executed| {
        told.lock().unwrap().push((sequence, executed.to_vec()));
        Some(vec![executed[0] + 0.04, executed[1]])
    });
    let served = served.unwrap();
    assert_eq!((served.episodes, served.observations, served.answers), (2, 8, 8));
    assert_eq!((served.rests, served.refused, served.total_reward), (0, 0, 6.0));
    let told = told.into_inner().unwrap();
    // Its first observation says where it stands.
    assert_eq!(told[0], (0, vec![0.5, -0.5]));
    assert!((told[1].1[0] - 0.52).abs() < 1e-6, "half of what it was told: {told:?}");
    assert_eq!(told[4], (4, vec![0.5, -0.5]));
    // Three answers an episode, and after its last observation the safe action: where it stands.
    assert_eq!(robot.executed.len(), 8);
    assert!((robot.executed[3][0] - 0.56).abs() < 1e-6, "{:?}", robot.executed);
    assert_eq!(robot.executed[3], robot.executed[7]);
}

#[test]
fn a_controller_that_comes_late_in_real_time_is_shown_what_is_seen_now() {
    let (link_settings, _domain) = domain("late");
    let link = SimulatorLink::open(link_settings.clone(), &arm()).unwrap();
    let settings = ServeSettings { episodes: 1, steps: 3, realtime: true, ..LOCKSTEP };
    std::thread::scope(|scope| {
        scope.spawn(|| {
            // Ten of its periods: a real controller passes over what was due two periods ago.
            std::thread::sleep(Duration::from_millis(200));
            let controller = ControllerLink::open(link_settings, anything).unwrap();
            while let Ok(Wait::Message(seen)) = controller.wait_observation(SOON) {
                let (answers, action) = (seen.sequence, [0.5, -0.5].into());
                if monotonic_ns().saturating_sub(seen.scheduled_ns) < 40_000_000 {
                    controller.send(&Action { answers, published_ns: 0, source: 0, action }).unwrap();
                }
            }
        });
        let served = serve(&mut Joints::default(), link, &settings, &AtomicBool::new(false)).unwrap();
        assert_eq!((served.episodes, served.observations), (1, 4), "{served:?}");
    });
}

#[test]
fn a_robot_that_is_slower_than_its_period_leaves_its_controller_a_moment() {
    let mut robot = Joints { takes: Some(Duration::from_millis(23)), ..Joints::default() };
    let settings = ServeSettings { episodes: 1, steps: 10, realtime: true, ..LOCKSTEP };
    let served = with_controller(&mut robot, "slow", settings, |_, _| Some(vec![0.5, -0.5])).unwrap();
    assert!(served.missed_answers <= 2, "of 20 ms a period: {served:?}");
}

#[test]
fn what_ends_it_and_a_rest_that_fails_are_both_said() {
    let mut robot = Joints { fails_from: Some(2), ..Joints::default() };
    let failed = with_controller(&mut robot, "both", LOCKSTEP, |_, _| Some(vec![0.5, -0.5]));
    let said = failed.unwrap_err().to_string();
    assert_eq!(said.matches("the brakes are on").count(), 2, "{said}");
    assert!(said.contains("could not be brought to rest"), "{said}");
}

#[test]
fn an_answer_that_is_none_is_rest_and_one_that_is_too_fast_is_slowed_down() {
    let mut robot = Joints::default();
    let served = with_controller(&mut robot, "refuse", LOCKSTEP, |sequence, _| {
        Some(match sequence {
            0 => vec![2.0, -0.5],
            1 => vec![f32::NAN, 0.0],
            _ => vec![3.5, 0.0],
        })
    });
    let served = served.unwrap();
    assert_eq!(robot.executed[0], [0.55, -0.5], "by no more than rate_max");
    assert!(robot.executed[1..].iter().all(|executed| executed[0] <= 0.56), "{:?}", robot.executed);
    assert_eq!((served.slowed_down, served.refused, served.rests), (1, 5, 5));
}

#[test]
fn in_real_time_a_robot_that_is_left_rests_and_goes_on() {
    let mut robot = Joints::default();
    let settings = ServeSettings { episodes: 1, steps: 8, realtime: true, ..LOCKSTEP };
    let start = Instant::now();
    let served =
        with_controller(&mut robot, "left", settings, |sequence, _| (sequence < 3).then(|| vec![0.51, -0.5]));
    let served = served.unwrap();
    assert_eq!((served.episodes, served.observations), (1, 9));
    assert_eq!(served.answers + served.missed_answers, 9, "{served:?}");
    assert!(served.rests > 0 && served.controllers_left == 1, "{served:?}");
    // 9 observations of the interface's 20 ms; the first waits for the controller.
    assert!(start.elapsed() >= Duration::from_millis(8 * 20));
    assert_eq!(robot.executed.last().unwrap(), &[0.51, -0.5]);
}

#[test]
fn stopped_it_ends_however_many_episodes_there_were_to_be() {
    let (settings, _domain) = domain("stopped");
    let link = SimulatorLink::open(settings, &arm()).unwrap();
    let serving = ServeSettings { episodes: u64::MAX, ..LOCKSTEP };
    let served = serve(&mut Joints::default(), link, &serving, &AtomicBool::new(true)).unwrap();
    assert_eq!(served, Served::default());
}

#[test]
fn a_robot_that_fails_is_told_to_rest_and_its_words_are_kept() {
    let mut robot = Joints { fails_at: Some(2), ..Joints::default() };
    let failed = with_controller(&mut robot, "fails", LOCKSTEP, |_, _| Some(vec![0.5, -0.5]));
    let said = failed.unwrap_err().to_string();
    assert!(said.contains("episode 0") && said.contains("the brakes are on"), "{said}");
    assert_eq!(robot.executed.len(), 3, "and then the safe action");
}

#[test]
fn a_robot_whose_program_panics_rests_before_that_goes_on() {
    let mut robot = Joints { panics_at: Some(2), ..Joints::default() };
    let (settings, _domain) = domain("panics");
    let link = SimulatorLink::open(settings.clone(), &arm()).unwrap();
    std::thread::scope(|scope| {
        let controller = scope.spawn(|| answer_all(settings, |_, _| Some(vec![0.5, -0.5])));
        let served =
            catch_unwind(AssertUnwindSafe(|| serve(&mut robot, link, &LOCKSTEP, &AtomicBool::new(false))));
        assert!(served.is_err());
        controller.join().unwrap();
    });
    assert_eq!(robot.executed.len(), 3, "and then the safe action");
}

#[test]
fn what_cannot_be_is_an_error() {
    let mut robot = Joints { measures: Some(f32::NAN), ..Joints::default() };
    let failed = with_controller(&mut robot, "nan", LOCKSTEP, |_, _| None);
    assert!(matches!(failed, Err(ServeError::NotFinite { episode: 0, step: 0 })));
    let (settings, _domain) = domain("nobody");
    let link = SimulatorLink::open(settings, &Arc::<Format>::clone(&arm())).unwrap();
    let settings = ServeSettings { timeout: Duration::from_millis(50), ..LOCKSTEP };
    let failed = serve(&mut Joints::default(), link, &settings, &AtomicBool::new(false));
    assert!(matches!(failed, Err(ServeError::NoAnswer { .. })));
}
