//! The same calls once more.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::time::Instant;

use rcwm_models::bundle::Bundle;
use rcwm_models::wire::ActionSource;
use rcwm_models::wire::ActionValues;

use rcwm_runtime::EngineSettings;
use rcwm_runtime::controller::SafetyFilter;
use rcwm_runtime::log::{
    BundleIdentity, Entry, Header, LogError, LogReader, LoggedCall, LoggedOutcome, LoggedTick, TickRecord,
    WholeState, digest,
};
use rcwm_runtime::policy::{CallKind, CallOutcome, InputReader, Policy, State, Surprise};
use rcwm_runtime::telemetry::{Stage, Telemetry};

use super::ReplayError;
use super::report::{Difference, ReplayReport};

/// Makes the calls of a log again.
pub struct Replayer {
    engine: EngineSettings,
    bundles: Vec<(BundleIdentity, Bundle)>,
    /// Which of them runs.
    running: usize,
    policy: Policy,
    telemetry: Telemetry,
    report: ReplayReport,
    resumed: bool,
    filter: SafetyFilter,
    inputs: InputReader,
    /// What the safety filter let through last is in the log.
    last_sent_known: bool,
    /// What the policy decided last in this tick.
    decided: Option<ActionValues>,
    /// The last states, by their checksums: the controller may go back to one of them.
    states: VecDeque<(u32, State)>,
}

/// States that are remembered: more than are imagined in a row.
const STATES_MAX: usize = 1024;

impl Replayer {
    /// Loads the bundle that the log was made with; `bundles` are the folders it is looked for in, and those that took over.
    /// Without `engine` the log's own is used.
    ///
    /// # Errors
    /// [`ReplayError::OtherBundle`], [`ReplayError::Bundle`] or [`ReplayError::Policy`].
    pub fn new(
        header: &Header,
        bundles: &[PathBuf],
        engine: Option<EngineSettings>,
    ) -> Result<Self, ReplayError> {
        let engine = engine.unwrap_or(header.engine);
        let open = |folder: &PathBuf| -> Result<_, ReplayError> {
            let bundle = Bundle::open(folder)?;
            Ok((BundleIdentity::of(&bundle.manifest), bundle))
        };
        let bundles = bundles.iter().map(open).collect::<Result<Vec<_>, _>>()?;
        let (running, policy) = load(&bundles, &header.bundle, header, engine)?;
        let report = ReplayReport::new(header.clone(), engine);
        let states = VecDeque::with_capacity(STATES_MAX);
        Ok(Self {
            engine,
            bundles,
            running,
            filter: SafetyFilter::new(policy.limits(), header.rate_max),
            inputs: InputReader::of(policy.manifest()),
            policy,
            telemetry: Telemetry::new(),
            report,
            resumed: false,
            last_sent_known: true,
            decided: None,
            states,
        })
    }

    /// Replays the whole log; `go_on` is asked after every entry with the bytes read and in all.
    ///
    /// # Errors
    /// As [`Self::new`], or [`LogError::Io`]. A difference is no error, and neither is damage: they are in the report.
    pub fn run(
        &mut self,
        log: &mut LogReader,
        go_on: &mut dyn FnMut((u64, u64)) -> bool,
    ) -> Result<ReplayReport, ReplayError> {
        loop {
            match log.read() {
                Ok(Some(entry)) => self.entry(&entry)?,
                Ok(None) => break,
                Err(error @ LogError::Damaged { .. }) => {
                    self.report.log_damage = Some(error.to_string());
                    break;
                }
                Err(error) => return Err(error.into()),
            }
            if !go_on(log.progress_bytes()) {
                break;
            }
        }
        self.report.log_finished = log.finished();
        self.report.latency = self.telemetry.latencies();
        Ok(self.report.clone())
    }

    /// Replays one entry.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn entry(&mut self, entry: &Entry) -> Result<(), ReplayError> {
        match entry {
            Entry::Tick(tick) => self.tick(tick),
            Entry::Policy(identity) => self.exchange(identity)?,
        }
        Ok(())
    }

    /// The policy after the last entry.
    #[must_use]
    pub fn policy(&self) -> &Policy {
        &self.policy
    }

    /// The policy's bundle.
    #[must_use]
    pub fn bundle(&self) -> &Bundle {
        &self.bundles[self.running].1
    }

    /// What it is replayed on.
    #[must_use]
    pub fn engine(&self) -> EngineSettings {
        self.engine
    }

    /// What was measured.
    #[must_use]
    pub fn telemetry(&self) -> &Telemetry {
        &self.telemetry
    }

    fn exchange(&mut self, identity: &BundleIdentity) -> Result<(), ReplayError> {
        (self.running, self.policy) = load(&self.bundles, identity, &self.report.log, self.engine)?;
        self.states.clear();
        self.filter.take_limits(self.policy.limits());
        self.inputs = InputReader::of(self.policy.manifest());
        self.report.swaps += 1;
        Ok(())
    }

    fn tick(&mut self, tick: &LoggedTick) {
        let record = &tick.record;
        self.report.ticks += 1;
        self.report.ticks_dropped = self.report.ticks_dropped.saturating_add(record.dropped_before);
        self.report.answers.count(record.answer.source);
        if record.resumes {
            self.resume(tick);
            return;
        }
        self.report.ticks_compared += 1;
        let difference = self.calls(tick);
        let answer = self.answer(tick);
        let difference = difference.or_else(|| self.state(record)).or(answer);
        self.resumed = false;
        self.differs(tick, difference);
    }

    fn differs(&mut self, tick: &LoggedTick, difference: Option<[String; 3]>) {
        let Some([what, logged, replayed]) = difference else { return };
        self.report.ticks_differing += 1;
        let sequence = tick.record.answer.answers;
        let difference = Difference { tick: tick.index, sequence, what, logged, replayed };
        self.report.first_difference.get_or_insert(difference);
    }

    /// After dropped ticks the logged state is taken over.
    fn resume(&mut self, tick: &LoggedTick) {
        let restored = tick.record.state.as_ref().map(WholeState::restore);
        let taken = restored.is_some_and(|(state, noise_position)| {
            self.policy.set_noise_position(noise_position);
            self.policy.set_state(&state).is_ok()
        });
        (self.resumed, self.last_sent_known) = (true, false);
        self.states.clear();
        self.executed(tick);
        self.sent(&tick.record);
        if !taken {
            let what = "the state after dropped ticks".to_owned();
            self.differs(tick, Some([what, "missing, or of another size".into(), "the model's size".into()]));
        }
    }

    /// Makes the calls of a tick and gives the first difference.
    fn calls(&mut self, tick: &LoggedTick) -> Option<[String; 3]> {
        let mut first = None;
        self.decided = None;
        let start = Instant::now();
        let mut answered = false;
        for call in &tick.record.calls {
            let Some(replayed) = self.call(call, tick) else {
                let what = "what the policy was asked".to_owned();
                return Some([
                    what,
                    format!("{:?}", call.kind),
                    "the log does not hold what that needs".into(),
                ]);
            };
            answered |= matches!(call.kind, CallKind::Observe | CallKind::Imagine);
            if let LoggedOutcome::Decided { action, .. } = &replayed {
                self.decided = Some(*action);
            }
            let difference = self.compare(&call.outcome, &replayed);
            first = first.or(difference);
        }
        if answered {
            self.telemetry.record(Stage::Tick, start.elapsed().as_nanos() as u64);
        }
        first
    }

    /// Makes one call; none where the log does not hold what it needs.
    fn call(&mut self, call: &LoggedCall, tick: &LoggedTick) -> Option<LoggedOutcome> {
        let action = call.action.as_ref();
        self.remember();
        let made = self.policy.calls_made();
        match (call.kind, action, &tick.observation) {
            (CallKind::WorkAhead, ..) => drop(self.policy.work_ahead(action)),
            (CallKind::Imagine, Some(action), _) => drop(self.policy.imagine(action)),
            (CallKind::Observe, _, Some(observation)) => {
                let observation = observation.view();
                drop(self.policy.observe(self.inputs.read(&observation)?, action))
            }
            (CallKind::SetState, ..) => self.go_back(&call.outcome)?,
            (CallKind::Imagine, None, _) | (CallKind::Observe, _, None) => return None,
        }
        let outcome = self.policy.calls_since(made).next()?.outcome;
        self.report.calls += 1;
        match &outcome {
            CallOutcome::Decided { recomputed, stage_ns, .. } => {
                self.report.recomputed += u64::from(*recomputed);
                self.telemetry.record_policy(stage_ns);
            }
            CallOutcome::Done { time_ns } => self.telemetry.record(Stage::Ahead, *time_ns),
            _ => {}
        }
        Some(outcome.into())
    }

    fn remember(&mut self) {
        let state = self.policy.state();
        let checksum = state.checksum();
        if self.states.back().is_some_and(|(last, _)| *last == checksum) {
            return;
        }
        // The oldest makes room, and its memory is used again.
        let mut place = match self.states.len() {
            STATES_MAX => self.states.pop_front().unwrap_or_default(),
            _ => Default::default(),
        };
        place.0 = checksum;
        place.1.clone_from(state);
        self.states.push_back(place);
    }

    /// Goes back to the state that the log names; none where it is not known.
    fn go_back(&mut self, outcome: &LoggedOutcome) -> Option<()> {
        let LoggedOutcome::StateSet(wanted) = outcome else { return None };
        let (_, state) = self.states.iter().rev().find(|(checksum, _)| checksum == wanted)?;
        // The last observation may have been answered once more, which is no tick: then the rate limit counts from that answer.
        self.last_sent_known &= self.report.log.rate_max.is_none();
        self.policy.set_state(state).ok()
    }

    fn compare(&mut self, logged: &LoggedOutcome, replayed: &LoggedOutcome) -> Option<[String; 3]> {
        use LoggedOutcome::{Decided, Done, Failed};
        let (
            Decided { action, recomputed, surprise, .. },
            Decided { action: a, recomputed: r, surprise: s, .. },
        ) = (logged, replayed)
        else {
            self.report.failures += u64::from(matches!(logged, Failed(_)));
            let ahead = matches!((logged, replayed), (Done(_), Done(_)));
            return (!ahead && logged != replayed)
                .then(|| ["the policy's outcome".into(), said(logged), said(replayed)]);
        };
        for (logged, replayed) in action.iter().zip(a.iter()) {
            self.report.action_error_max = self.report.action_error_max.max((logged - replayed).abs());
        }
        let bits = |values: &[f32]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
        let surprise_bits = |surprise: &Option<Surprise>| surprise.map(Surprise::to_bits);
        if bits(action) != bits(a) {
            return Some(["the action".into(), format!("{action:?}"), format!("{a:?}")]);
        }
        if surprise_bits(surprise) != surprise_bits(s) {
            return Some(["the surprise".into(), format!("{surprise:?}"), format!("{s:?}")]);
        }
        // What was worked ahead before dropped ticks is not known.
        (recomputed != r && !self.resumed)
            .then(|| ["whether work ahead was done again".into(), recomputed.to_string(), r.to_string()])
    }

    /// What was sent: the policy's action, or the fallback, through the filter.
    fn answer(&mut self, tick: &LoggedTick) -> Option<[String; 3]> {
        let record = &tick.record;
        let (fallback, logged) = (self.report.log.fallback, record.answer.action);
        self.executed(tick);
        let of_policy = [ActionSource::Policy as u32, ActionSource::Imagined as u32];
        // What a policy without a world model holds where nothing came is its decision, too.
        let held = tick.observation.is_none() && self.decided.is_some();
        let action = if of_policy.contains(&record.answer.source) || held {
            self.decided
        } else {
            self.filter.fallback(fallback)
        };
        let replayed = if record.overtaken {
            // It was not sent: it has not passed the safety filter, or there was nothing to send.
            Some(action.unwrap_or_default())
        } else {
            action.and_then(|action| self.filter.pass(action)).map(|passed| passed.action)
        };
        let known = self.last_sent_known;
        self.sent(record);
        let same = replayed.is_some_and(|replayed| replayed.to_bits() == logged.to_bits());
        (known && !same).then(|| ["the action sent".into(), format!("{logged:?}"), format!("{replayed:?}")])
    }

    fn executed(&mut self, tick: &LoggedTick) {
        if let Some(observed) = &tick.observation {
            let is_first = tick.record.is_first;
            self.filter.observed(&observed.view(), is_first);
            self.last_sent_known |= is_first;
        }
    }

    fn sent(&mut self, record: &TickRecord) {
        // What is not finite was not sent, whatever the log says: it shows as a difference.
        if !record.overtaken && record.answer.action.iter().all(|x| x.is_finite()) {
            self.filter.sent(record.answer.action);
            self.last_sent_known = true;
        }
    }

    fn state(&self, record: &TickRecord) -> Option<[String; 3]> {
        let replayed = digest(self.policy.state());
        let hex = |bytes: [u8; 16]| format!("{:032x}", u128::from_be_bytes(bytes));
        (replayed != record.digest).then(|| ["the state's digest".into(), hex(record.digest), hex(replayed)])
    }
}

fn said(outcome: &LoggedOutcome) -> String {
    match outcome {
        LoggedOutcome::Done(_) => "work ahead was done".into(),
        LoggedOutcome::StateSet(checksum) => format!("went back to the state {checksum:08x}"),
        LoggedOutcome::Decided { action, .. } => format!("decided {action:?}"),
        LoggedOutcome::Failed(reason) => reason.clone(),
    }
}

/// The policy that is wanted, and which bundle it is of.
fn load(
    bundles: &[(BundleIdentity, Bundle)],
    wanted: &BundleIdentity,
    header: &Header,
    engine: EngineSettings,
) -> Result<(usize, Policy), ReplayError> {
    let Some(found) = bundles.iter().position(|(identity, _)| wanted.difference(identity).is_none()) else {
        let tried: Vec<_> = bundles.iter().map(|(_, bundle)| bundle.folder.display().to_string()).collect();
        let difference = bundles.iter().find_map(|(identity, _)| wanted.difference(identity));
        let difference = difference.unwrap_or_else(|| "no bundle was named".into());
        return Err(ReplayError::OtherBundle { tried: tried.join(", "), difference });
    };
    Ok((found, Policy::new(&bundles[found].1, engine, header.sampling)?))
}
