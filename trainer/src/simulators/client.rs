use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rcwm_models::IMAGE_SIDE;
use rcwm_models::interface::{ActionMode, Interface, Mismatch};
use rcwm_models::wire::{
    Action, ActionSource, ActionValues, ControllerLink, LinkError, LinkSettings, ObservationSample, Wait,
};

use super::{ProcessError, SimulatorProcess};

/// The longest single wait, so that a stop or a dead simulator is noticed.
const WAIT_SLICE: Duration = Duration::from_millis(100);

/// Why talking to a simulator failed.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The simulator's process.
    #[error(transparent)]
    Process(#[from] ProcessError),
}

/// The trainer's end of a link in lock-step: every observation once, however often it was published.
pub struct Client {
    link: ControllerLink,
    /// `None` where the simulator was running before.
    process: Option<SimulatorProcess>,
    /// The newest answer, sent again if it was lost.
    answer: Option<Action>,
}

/// Everything in which a robot is not what is needed.
pub type Mismatches = fn(&Interface) -> Vec<Mismatch>;

/// In what a robot is not one that the trainer can record: commands of which zeros are no motion, and that may change at once. Whatever
/// else it offers is recorded.
pub fn mismatches_to_record(robot: &Interface) -> Vec<Mismatch> {
    let mut found = Vec::new();
    for action in &robot.action {
        let place = format!("action {}", action.name);
        if action.mode == ActionMode::Absolute {
            let text = "it commands positions, and the trainer acts by displacements and velocities only";
            found.push(Mismatch::new(&place, text));
        }
        if action.rate_max.is_some() {
            found.push(Mismatch::new(&place, "it has a rate_max, which the trainer does not keep"));
        }
    }
    found
}

/// In what a robot is not one that the trainer can act on: it looks at the first camera, of its own size.
pub fn mismatches_to_act(robot: &Interface) -> Vec<Mismatch> {
    let mut found = mismatches_to_record(robot);
    let picture = [IMAGE_SIDE, IMAGE_SIDE, 3];
    match robot.camera.first() {
        None => found.push(Mismatch::new("camera", "there is none, and the trainer acts by what it sees")),
        Some(camera) if camera.shape != picture => {
            let [height, width, _] = camera.shape;
            let text = format!(
                "{height} x {width}, the trainer acts on {IMAGE_SIDE} x {IMAGE_SIDE}; resize on the robot's side"
            );
            found.push(Mismatch::new(&format!("camera {}", camera.name), text));
        }
        Some(_) => {}
    }
    found
}

impl Client {
    /// Connects to the simulator that was started.
    pub fn of(process: SimulatorProcess, mismatches: Mismatches) -> Result<Self, ClientError> {
        let link = ControllerLink::open(LinkSettings::new(process.instance()), mismatches)?;
        Ok(Self { link, process: Some(process), answer: None })
    }

    /// Connects to a simulator that runs, or will.
    pub fn join(instance: &str, mismatches: Mismatches) -> Result<Self, ClientError> {
        let link = ControllerLink::open(LinkSettings::new(instance), mismatches)?;
        Ok(Self { link, process: None, answer: None })
    }

    /// The next observation; `None` when the simulator is done or `stop` was set.
    ///
    /// # Errors
    /// See [`ClientError`]; a simulator that died is reported with its last words.
    pub fn next(&mut self, stop: &AtomicBool) -> Result<Option<ObservationSample>, ClientError> {
        while !stop.load(Ordering::Relaxed) {
            match self.link.wait_observation(WAIT_SLICE)? {
                Wait::Message(observation) => match self.answer {
                    Some(answer) if answer.answers == observation.sequence => {
                        self.link.send(&answer)?;
                    }
                    _ => return Ok(Some(observation)),
                },
                // It may have said goodbye before this end was connected.
                Wait::TimedOut if !self.is_running()? => return Ok(None),
                Wait::TimedOut => {}
                Wait::Closed => {
                    self.is_running()?;
                    return Ok(None);
                }
            }
        }
        Ok(None)
    }

    /// Nothing is known of a simulator that was joined: it counts as running.
    fn is_running(&mut self) -> Result<bool, ClientError> {
        Ok(self.process.as_mut().map_or(Ok(true), SimulatorProcess::is_running)?)
    }

    /// Answers the observation of this sequence.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn answer(&mut self, sequence: u64, action: ActionValues) -> Result<(), ClientError> {
        let source = ActionSource::Policy as u32;
        let answer = Action { answers: sequence, published_ns: 0, source, action };
        self.link.send(&answer)?;
        self.answer = Some(answer);
        Ok(())
    }
}
