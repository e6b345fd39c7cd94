//! The posteriors of the branches: one after the other, or two side by side on two threads.
//!
//! The helper has the environment's, on memory of its own. If it is late, for whatever reason the machine has, the caller does not wait: it
//! runs the environment's itself on a spare and goes on with what that gives, which is the same to the last bit. A tick is then about as
//! long as on one thread, however long the helper is gone.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use rcwm_models::bundle::PartName;
use tract_onnx::prelude::{TValue, TVec, TractError, TractResult};

use super::super::PolicyError;
use super::super::stages::StageClock;
use super::pieces::{Piece, Values};
use crate::operators::SharedTeam;
use rcwm_kernels::team::{Job, TIMEOUT_MIN, try_lock};

/// The helper is late when the caller has waited for this part of the time that its own branch has taken.
const TIMEOUT_DIVISOR: u32 = 4;

/// An error, and the part it comes from.
pub(super) type RunError = (PartName, TractError);
type Results = TractResult<TVec<TValue>>;
/// What a branch has given, and the time that it took, in ns.
type Brought = (Results, u64);

pub(super) enum Branches {
    Alone(Vec<Piece>),
    Beside(Box<Beside>),
}

impl Branches {
    pub(super) fn new(pieces: Vec<Piece>, team: Option<&SharedTeam>) -> Result<Self, PolicyError> {
        let Some(team) = team else { return Ok(Self::Alone(pieces)) };
        Ok(match <[Piece; 2]>::try_from(pieces) {
            Ok([robot, environment]) => Self::Beside(Box::new(Beside::new(robot, environment, team)?)),
            Err(pieces) => Self::Alone(pieces),
        })
    }

    /// Encoded image to posteriors.
    pub(super) fn run(&mut self, values: &mut Values, clock: &mut StageClock) -> Result<(), RunError> {
        match self {
            Self::Alone(pieces) => {
                for piece in pieces {
                    piece.run(values).map_err(|error| (piece.part, error))?;
                    clock.ended(piece.part);
                }
                Ok(())
            }
            Self::Beside(beside) => beside.run(values, clock),
        }
    }

    /// The same; what has not run yet runs too.
    pub(super) fn warm_caches(
        &mut self,
        values: &mut Values,
        clock: &mut StageClock,
    ) -> Result<(), RunError> {
        if let Self::Beside(beside) = self
            && let Beside { spare, spare_is_new, .. } = &mut **beside
            && std::mem::take(spare_is_new)
        {
            // Its memory is there before it is needed.
            spare.run(values).map_err(|error| (spare.part, error))?;
        }
        self.run(values, clock)
    }
}

/// Both at once.
pub(super) struct Beside {
    team: SharedTeam,
    robot: Piece,
    slot: Arc<WorkerSlot>,
    spare: Piece,
    spare_is_new: bool,
    /// Number of the last task.
    task: u64,
}

/// What belongs to the helper while it is on an task, and to the caller otherwise.
struct WorkerSlot {
    work: Mutex<LaneWork>,
    /// Number of the last task that is done.
    done: AtomicU64,
}

struct LaneWork {
    environment: Piece,
    task: u64,
    inputs: Option<TVec<TValue>>,
    results: Option<Results>,
    spent_ns: u64,
}

impl Job for WorkerSlot {
    fn help(&self) {
        let mut work = self.work.lock().unwrap_or_else(PoisonError::into_inner);
        let start = Instant::now();
        // A helper that was stopped right here may find the next task, and be sent on it once more.
        let Some(inputs) = work.inputs.take() else { return };
        work.results = Some(work.environment.run_on(inputs));
        work.spent_ns = start.elapsed().as_nanos() as u64;
        let task = work.task;
        drop(work);
        self.done.store(task, Ordering::Release);
    }
}

impl WorkerSlot {
    fn is_done(&self, task: u64) -> bool {
        self.done.load(Ordering::Acquire) == task
    }

    /// None while the helper is at it.
    fn try_lock(&self) -> Option<MutexGuard<'_, LaneWork>> {
        try_lock(&self.work)
    }
}

impl Beside {
    fn new(robot: Piece, environment: Piece, team: &SharedTeam) -> Result<Self, PolicyError> {
        let spare = environment.try_clone().map_err(|error| super::run_error(environment.part, &error))?;
        let work = LaneWork { environment, task: 0, inputs: None, results: None, spent_ns: 0 };
        let slot = Arc::new(WorkerSlot { work: Mutex::new(work), done: AtomicU64::new(0) });
        Ok(Self { team: Arc::clone(team), robot, slot, spare, spare_is_new: true, task: 0 })
    }

    fn run(&mut self, values: &mut Values, clock: &mut StageClock) -> Result<(), RunError> {
        self.send(values);
        let start = Instant::now();
        self.robot.run(values).map_err(|error| (self.robot.part, error))?;
        clock.ended(self.robot.part);
        self.wait(TIMEOUT_MIN.max(start.elapsed() / TIMEOUT_DIVISOR));
        let (results, spent_ns) = match self.brought() {
            Some(brought) => brought,
            None => self.take_over(values, clock),
        };
        self.spare.keep(results.map_err(|error| (self.spare.part, error))?, values);
        clock.took(self.spare.part, spent_ns);
        clock.restart();
        Ok(())
    }

    /// Sends the helper, unless it has not come back from the last time.
    fn send(&mut self, values: &Values) {
        // What it may still bring from then has another number.
        self.task += 1;
        if let Some(mut work) = self.slot.try_lock() {
            work.task = self.task;
            work.inputs = Some(work.environment.inputs(values));
            work.results = None;
            drop(work);
            self.team.send(Arc::clone(&self.slot) as Arc<dyn Job>);
        }
    }

    fn wait(&self, timeout: Duration) {
        let start = Instant::now();
        while !self.slot.is_done(self.task) && start.elapsed() < timeout {
            std::hint::spin_loop();
        }
    }

    /// What the helper has brought; none if it is late.
    fn brought(&self) -> Option<Brought> {
        let mut work = self.slot.try_lock().filter(|work| work.task == self.task)?;
        if work.results.is_none() {
            // It has not begun, and need not.
            self.team.call_off();
            work.inputs = None;
        }
        Some((work.results.take()?, work.spent_ns))
    }

    /// The spare in the helper's stead, unless the helper comes back meanwhile.
    fn take_over(&mut self, values: &Values, clock: &mut StageClock) -> Brought {
        clock.helper_late = true;
        let start = Instant::now();
        loop {
            let (slot, task) = (&self.slot, self.task);
            let results = self.spare.run_unless(|| slot.is_done(task), self.spare.inputs(values));
            if let Some(results) = results.transpose() {
                return (results, start.elapsed().as_nanos() as u64);
            }
            if let Some(brought) = self.brought() {
                return brought;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use prost::Message;
    use rcwm_models::onnx::{Graph, Model, Node, OperatorSet, ValueInfo, data_type};

    use super::*;
    use crate::compile::{Fact, Segment};
    use rcwm_kernels::team::Team;

    const LEN: usize = 8;

    /// `output` = -`image`.
    fn negation(part: PartName, output: &str, values: &mut Values) -> Piece {
        let info = |name: &str| ValueInfo::tensor(name, data_type::FLOAT, &[1, LEN]);
        let node = Node {
            op_type: "Neg".into(),
            input: vec!["image".into()],
            output: vec![output.into()],
            name: output.into(),
            ..Node::default()
        };
        let graph = Graph {
            name: output.into(),
            node: vec![node],
            input: vec![info("image")],
            output: vec![info(output)],
            ..Graph::default()
        };
        let opset_import = vec![OperatorSet { domain: String::new(), version: 17 }];
        let model = Model { ir_version: 8, graph: Some(graph), opset_import, ..Model::default() };
        let fact = Fact { dtype: data_type::FLOAT, shape: vec![1, LEN] };
        let segment = Segment {
            part,
            late: true,
            inputs: vec![("image".into(), fact)],
            outputs: vec![(output.into(), None)],
            onnx: model.encode_to_vec(),
            operators: vec!["Neg".into()],
        };
        Piece::load(&segment, values, None).unwrap()
    }

    fn beside() -> (Beside, Values) {
        let mut values = Values::default();
        let robot = negation(PartName::Robot, "robot", &mut values);
        let environment = negation(PartName::Environment, "environment", &mut values);
        let team = Arc::new(Team::start(Duration::from_millis(1)).unwrap());
        (Beside::new(robot, environment, &team).unwrap(), values)
    }

    fn first((results, _): Brought) -> f32 {
        results.unwrap()[0].try_as_plain_ram().unwrap().as_slice::<f32>().unwrap()[0]
    }

    fn show(values: &mut Values, number: f32) {
        let image = values.find("image");
        values.fill(image, &[number; LEN]).unwrap();
    }

    /// The helper is sent with an image, and done with it.
    fn ask(beside: &mut Beside, values: &mut Values, number: f32) {
        show(values, number);
        beside.send(values);
        beside.wait(Duration::from_secs(60));
    }

    #[test]
    fn both_branches_see_each_image() {
        let (mut beside, mut values) = beside();
        for step in 0..500 {
            show(&mut values, step as f32);
            beside.run(&mut values, &mut StageClock::start()).unwrap();
            for output in ["robot", "environment"] {
                let mut found = [0.0; LEN];
                values.copy(values.find(output).unwrap(), &mut found).unwrap();
                assert_eq!(found, [-step as f32; LEN], "{output}");
            }
        }
    }

    #[test]
    fn what_a_helper_brings_from_an_earlier_image_is_not_taken() {
        let (mut beside, mut values) = beside();
        ask(&mut beside, &mut values, 1.0);
        let slot = Arc::clone(&beside.slot);
        // As if the helper were still at it when the next image comes, and done a moment later.
        let still_at_it = slot.work.lock().unwrap();
        show(&mut values, 2.0);
        beside.send(&values);
        drop(still_at_it);
        assert!(slot.work.lock().unwrap().results.is_some(), "the first image's");
        assert!(beside.brought().is_none());
        let mut clock = StageClock::start();
        assert_eq!(first(beside.take_over(&values, &mut clock)), -2.0);
        assert!(clock.helper_late);
        // And it goes on.
        ask(&mut beside, &mut values, 3.0);
        assert_eq!(first(beside.brought().unwrap()), -3.0);
    }

    #[test]
    fn the_spare_gives_way_to_a_helper_that_comes_back() {
        let (mut beside, mut values) = beside();
        ask(&mut beside, &mut values, 4.0);
        let inputs = beside.spare.inputs(&values);
        assert!(beside.spare.run_unless(|| true, inputs).unwrap().is_none());
        assert_eq!(first(beside.take_over(&values, &mut StageClock::start())), -4.0);
        // Given up half-way, it is as good as new.
        let inputs = beside.spare.inputs(&values);
        assert!(beside.spare.run_unless(|| false, inputs).unwrap().is_some());
    }
}
