//! The shared-memory link: services, their settings, and both ends.
//!
//! The observation's publisher is the simulator's end, the action's publisher the controller's. A second simulator or a second
//! controller on one instance is refused; recorders may listen in on observations. Waiting spins for a configurable while
//! (about 1 us to notice), then blocks on the event service (about 100 us).

use std::time::{Duration, Instant};

use iceoryx2::node::NodeCreationFailure;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample;
use iceoryx2::service::builder::event::EventOpenOrCreateError;
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenOrCreateError;
use iceoryx2::service::port_factory::{event, publish_subscribe};

use super::{Action, Observation};

type Ipc = ipc::Service;
type Received<T> = Sample<Ipc, T, ()>;

/// Recorders and other listeners beside the controller.
const SUBSCRIBERS_MAX: usize = 8;
const NODES_MAX: usize = 16;
const EVENT_ID_MAX: usize = 7;

const EVENT_PUBLISHED: usize = 0;
const EVENT_HELLO: usize = 1;
const EVENT_CLOSED: usize = 2;

/// An observation received in shared memory; it stays valid while this is held.
pub type ObservationSample = Received<Observation>;

/// Which link, and how to wait on it.
#[derive(Debug, Clone)]
pub struct LinkSettings {
    /// Names the pair of services; letters, digits, `-`, `_` and `.`.
    pub instance: String,
    /// Prefix of all files in shared memory: peers meet only under the same one. Tests that run side by side use their own.
    pub prefix: Option<String>,
    /// How long a wait polls before it blocks.
    pub spin: Duration,
}

impl LinkSettings {
    /// The link of `instance` with 50 us of spinning; the prefix comes from the variable `RCWM_PREFIX`, if set.
    #[must_use]
    pub fn new(instance: &str) -> Self {
        let prefix = std::env::var("RCWM_PREFIX").ok().filter(|prefix| !prefix.is_empty());
        Self { instance: instance.to_owned(), prefix, spin: Duration::from_micros(50) }
    }
}

/// Why a link could not be made or used.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The instance's name has characters that the services cannot carry.
    #[error("instance {0:?}: expected 1 to 64 letters, digits, '-', '_' or '.'")]
    InstanceName(String),
    /// The prefix has characters that file names cannot carry.
    #[error("RCWM_PREFIX {0:?}: expected 1 to 32 letters, digits, '-' or '_'")]
    Prefix(String),
    /// Shared memory is not usable.
    #[error("shared memory: {0}; check that /dev/shm and /tmp/iceoryx2 can be written by this user")]
    Node(String),
    /// A peer of another version owns the service.
    #[error(
        "{service}: the peer speaks another version of the message (this program speaks {expected}); \
         build simulator, runtime and trainer from one version"
    )]
    OtherVersion {
        /// The service's name.
        service: String,
        /// The type name this program speaks.
        expected: &'static str,
    },
    /// The place is taken.
    #[error("{service}: another {role} is already connected; stop it or choose another --instance")]
    Taken {
        /// The service's name.
        service: String,
        /// `simulator` or `controller`.
        role: &'static str,
    },
    /// The service exists in a form that does not fit, or could not be made.
    #[error("{service}: {reason}")]
    Service {
        /// The service's name.
        service: String,
        /// What iceoryx2 said.
        reason: String,
    },
    /// Sending or receiving failed on a link that had worked.
    #[error("{operation} failed on the shared-memory link: {reason}")]
    Traffic {
        /// What was attempted.
        operation: &'static str,
        /// What iceoryx2 said.
        reason: String,
    },
}

fn traffic<E: std::fmt::Debug>(operation: &'static str) -> impl FnOnce(E) -> LinkError {
    move |error| LinkError::Traffic { operation, reason: format!("{error:?}") }
}

/// What a wait ended with.
#[derive(Debug)]
pub enum Wait<T> {
    /// A message.
    Message(T),
    /// The time was up.
    TimedOut,
    /// The peer said that it closes.
    Closed,
}

/// Signals seen since the last look.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Events {
    /// A controller has connected and asks for the current observation.
    pub hello: bool,
    /// The peer said that it closes.
    pub closed: bool,
}

/// Both services of one direction.
struct Direction<T: ZeroCopySend + std::fmt::Debug + 'static> {
    name: String,
    data: publish_subscribe::PortFactory<Ipc, T, ()>,
    event: event::PortFactory<Ipc>,
}

impl<T: ZeroCopySend + std::fmt::Debug + 'static> Direction<T> {
    fn open(node: &Node<Ipc>, instance: &str, topic: &str) -> Result<Self, LinkError> {
        let name = format!("rcwm/{instance}/{topic}");
        let service: ServiceName =
            name.as_str().try_into().map_err(|_| LinkError::InstanceName(instance.to_owned()))?;
        let data = node
            .service_builder(&service)
            .publish_subscribe::<T>()
            .history_size(0)
            .subscriber_max_buffer_size(1)
            .subscriber_max_borrowed_samples(2)
            .enable_safe_overflow(true)
            .max_publishers(1)
            .max_subscribers(SUBSCRIBERS_MAX)
            .max_nodes(NODES_MAX)
            .open_or_create()
            .map_err(|error| Self::data_error(&name, error))?;
        let event = node
            .service_builder(&service)
            .event()
            .max_notifiers(SUBSCRIBERS_MAX)
            .max_listeners(SUBSCRIBERS_MAX)
            .max_nodes(NODES_MAX)
            .event_id_max_value(EVENT_ID_MAX)
            .open_or_create()
            .map_err(|error: EventOpenOrCreateError| LinkError::Service {
                service: name.clone(),
                reason: format!("{error:?}"),
            })?;
        Ok(Self { name, data, event })
    }

    fn data_error(name: &str, error: PublishSubscribeOpenOrCreateError) -> LinkError {
        use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError::IncompatibleTypes;
        match error {
            PublishSubscribeOpenOrCreateError::PublishSubscribeOpenError(IncompatibleTypes) => {
                // SAFETY: the name is a constant; the function is marked unsafe because peers trust it.
                let expected = unsafe { <T as ZeroCopySend>::type_name() };
                LinkError::OtherVersion { service: name.to_owned(), expected }
            }
            other => LinkError::Service { service: name.to_owned(), reason: format!("{other:?}") },
        }
    }

    fn sender(&self, role: &'static str) -> Result<Sender<T>, LinkError> {
        use iceoryx2::port::publisher::PublisherCreateError::ExceedsMaxSupportedPublishers;
        let publisher =
            self.data.publisher_builder().max_loaned_samples(1).create().map_err(|error| match error {
                ExceedsMaxSupportedPublishers => LinkError::Taken { service: self.name.clone(), role },
                other => LinkError::Service { service: self.name.clone(), reason: format!("{other:?}") },
            })?;
        let notifier = self.event.notifier_builder().create().map_err(|error| LinkError::Service {
            service: self.name.clone(),
            reason: format!("{error:?}"),
        })?;
        Ok(Sender { publisher, notifier })
    }

    fn receiver(&self) -> Result<Receiver<T>, LinkError> {
        let failed = |reason: String| LinkError::Service { service: self.name.clone(), reason };
        let subscriber =
            self.data.subscriber_builder().create().map_err(|error| failed(format!("{error:?}")))?;
        let listener =
            self.event.listener_builder().create().map_err(|error| failed(format!("{error:?}")))?;
        Ok(Receiver { subscriber, listener })
    }
}

struct Sender<T: ZeroCopySend + std::fmt::Debug + 'static> {
    publisher: Publisher<Ipc, T, ()>,
    notifier: Notifier<Ipc>,
}

impl<T: ZeroCopySend + std::fmt::Debug + 'static> Sender<T> {
    fn notify(&self, event: usize) -> Result<(), LinkError> {
        self.notifier
            .notify_with_custom_event_id(EventId::new(event))
            .map(drop)
            .map_err(traffic("waking the peer"))
    }
}

struct Receiver<T: ZeroCopySend + std::fmt::Debug + 'static> {
    subscriber: Subscriber<Ipc, T, ()>,
    listener: Listener<Ipc>,
}

impl<T: ZeroCopySend + std::fmt::Debug + 'static> Receiver<T> {
    fn poll(&self) -> Result<Option<Received<T>>, LinkError> {
        self.subscriber.receive().map_err(traffic("receiving"))
    }

    /// Collects waiting events without blocking; an event service must be drained, or every later wait returns at once.
    fn drain(&self) -> Result<Events, LinkError> {
        let mut events = Events::default();
        self.listener.try_wait(|event| events.note(event.id)).map_err(traffic("reading events"))?;
        Ok(events)
    }

    fn wait(&self, spin: Duration, timeout: Duration) -> Result<(Wait<Received<T>>, Events), LinkError> {
        let start = Instant::now();
        while start.elapsed() < spin.min(timeout) {
            if let Some(sample) = self.poll()? {
                return Ok((Wait::Message(sample), Events::default()));
            }
            std::hint::spin_loop();
        }
        let mut events = Events::default();
        loop {
            // A message wins over the signals that came with it: they are acted upon afterwards.
            if let Some(sample) = self.poll()? {
                return Ok((Wait::Message(sample), events));
            }
            if events.closed {
                return Ok((Wait::Closed, events));
            }
            let left = timeout.saturating_sub(start.elapsed());
            if left.is_zero() || events.hello {
                return Ok((Wait::TimedOut, events));
            }
            self.listener
                .timed_wait(|event| events.note(event.id), left)
                .map_err(traffic("waiting for the peer"))?;
        }
    }
}

impl Events {
    fn note(&mut self, id: EventId) {
        match id.as_value() {
            EVENT_HELLO => self.hello = true,
            EVENT_CLOSED => self.closed = true,
            _ => {}
        }
    }
}

fn make_node(settings: &LinkSettings) -> Result<Node<Ipc>, LinkError> {
    let name_ok = |text: &str, len: usize, extra: &str| {
        (1..=len).contains(&text.len())
            && text.chars().all(|c| c.is_ascii_alphanumeric() || extra.contains(c))
            && !text.starts_with('.')
    };
    if !name_ok(&settings.instance, 64, "-_.") {
        return Err(LinkError::InstanceName(settings.instance.clone()));
    }
    // iceoryx2 reports expected conditions (a peer that died) as warnings; ours say what matters.
    set_log_level_from_env_or(LogLevel::Error);
    let node = NodeBuilder::new()
        // Ctrl-C belongs to the program.
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .config(&config(settings.prefix.as_deref())?)
        .create::<Ipc>()
        .map_err(|error: NodeCreationFailure| LinkError::Node(format!("{error:?}")))?;
    Ok(node)
}

fn config(prefix: Option<&str>) -> Result<Config, LinkError> {
    let mut config = Config::default();
    if let Some(prefix) = prefix {
        let fits =
            prefix.len() <= 32 && prefix.chars().all(|c| c.is_ascii_alphanumeric() || "-_".contains(c));
        let name = FileName::new(prefix.as_bytes()).ok().filter(|_| fits);
        config.global.prefix = name.ok_or_else(|| LinkError::Prefix(prefix.to_owned()))?;
    }
    Ok(config)
}

/// The simulator's end (or a robot's): publishes observations, receives actions.
pub struct SimulatorLink {
    settings: LinkSettings,
    observations: Sender<Observation>,
    actions: Receiver<Action>,
    // Dropped last: the ports above belong to it.
    node: Node<Ipc>,
}

/// A free place in shared memory for the next observation.
pub struct ObservationSlot {
    sample: iceoryx2::sample_mut::SampleMut<Ipc, Observation, ()>,
}

impl std::ops::Deref for ObservationSlot {
    type Target = Observation;
    fn deref(&self) -> &Observation {
        self.sample.payload()
    }
}

impl std::ops::DerefMut for ObservationSlot {
    fn deref_mut(&mut self) -> &mut Observation {
        self.sample.payload_mut()
    }
}

impl SimulatorLink {
    /// Opens or creates the services of an instance, as their simulator.
    ///
    /// # Errors
    /// See [`LinkError`]; a second simulator gets [`LinkError::Taken`].
    pub fn open(settings: LinkSettings) -> Result<Self, LinkError> {
        let node = make_node(&settings)?;
        let observation = Direction::<Observation>::open(&node, &settings.instance, "observation")?;
        let action = Direction::<Action>::open(&node, &settings.instance, "action")?;
        let actions = action.receiver()?;
        let observations = observation.sender("simulator")?;
        Ok(Self { settings, observations, actions, node })
    }

    /// Publishes one observation and wakes the controller. `published_ns` is set here.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn publish(&self, fill: impl FnOnce(&mut Observation)) -> Result<(), LinkError> {
        let mut slot = self.slot()?;
        fill(&mut slot);
        self.send(slot)
    }

    /// A zeroed place in shared memory, to be filled and sent.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn slot(&self) -> Result<ObservationSlot, LinkError> {
        let sample = self.observations.publisher.loan_uninit().map_err(traffic("loaning an observation"))?;
        Ok(ObservationSlot { sample: sample.write_payload(Observation::zeroed()) })
    }

    /// Sends a filled place and wakes the controller. `published_ns` is set here.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn send(&self, mut slot: ObservationSlot) -> Result<(), LinkError> {
        slot.published_ns = super::clock::monotonic_ns();
        slot.sample.send().map_err(traffic("publishing an observation"))?;
        self.observations.notify(EVENT_PUBLISHED)
    }

    /// Waits for the next action of any sequence.
    ///
    /// Ends early with [`Wait::TimedOut`] and `hello` set when a controller has connected: publish the current
    /// observation again, it has not seen it.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn wait_action(&self, timeout: Duration) -> Result<(Wait<Action>, Events), LinkError> {
        let (wait, events) = self.actions.wait(self.settings.spin, timeout)?;
        let wait = match wait {
            Wait::Message(sample) => Wait::Message(*sample.payload()),
            Wait::TimedOut => Wait::TimedOut,
            // A controller may come and go; only its absence matters here.
            Wait::Closed => Wait::TimedOut,
        };
        Ok((wait, events))
    }

    /// The newest action, if one is waiting; never blocks.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn poll_action(&self) -> Result<Option<Action>, LinkError> {
        Ok(self.actions.poll()?.map(|sample| *sample.payload()))
    }

    /// Signals since the last look; never blocks.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn poll_events(&self) -> Result<Events, LinkError> {
        self.actions.drain()
    }

    /// Frees what peers that were killed have left in shared memory.
    pub fn clean_up_dead_peers(&self) {
        self.node.try_cleanup_dead_nodes();
    }

    /// Tells the controller that no further observation will come.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn close(self) -> Result<(), LinkError> {
        self.observations.notify(EVENT_CLOSED)
    }
}

/// The controller's end: receives observations, publishes actions.
pub struct ControllerLink {
    settings: LinkSettings,
    observations: Receiver<Observation>,
    actions: Sender<Action>,
    // Dropped last: the ports above belong to it.
    node: Node<Ipc>,
}

impl ControllerLink {
    /// Opens or creates the services of an instance, as their controller, and asks the simulator for its current
    /// observation.
    ///
    /// # Errors
    /// See [`LinkError`]; a second controller gets [`LinkError::Taken`].
    pub fn open(settings: LinkSettings) -> Result<Self, LinkError> {
        let node = make_node(&settings)?;
        let observation = Direction::<Observation>::open(&node, &settings.instance, "observation")?;
        let action = Direction::<Action>::open(&node, &settings.instance, "action")?;
        let observations = observation.receiver()?;
        let actions = action.sender("controller")?;
        let link = Self { settings, observations, actions, node };
        link.hello()?;
        Ok(link)
    }

    /// Asks the simulator to publish its current observation again.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn hello(&self) -> Result<(), LinkError> {
        self.actions.notify(EVENT_HELLO)
    }

    /// Waits for the next observation; [`Wait::Closed`] when the simulator has said that none will come.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn wait_observation(&self, timeout: Duration) -> Result<Wait<ObservationSample>, LinkError> {
        Ok(self.observations.wait(self.settings.spin, timeout)?.0)
    }

    /// The newest observation, if one is waiting; never blocks.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn poll_observation(&self) -> Result<Option<ObservationSample>, LinkError> {
        self.observations.poll()
    }

    /// Publishes an action and wakes the simulator. `published_ns` is set here and returned.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn send(&self, mut action: Action) -> Result<u64, LinkError> {
        action.published_ns = super::clock::monotonic_ns();
        let sample = self.actions.publisher.loan_uninit().map_err(traffic("loaning an action"))?;
        sample.write_payload(action).send().map_err(traffic("publishing an action"))?;
        self.actions.notify(EVENT_PUBLISHED)?;
        Ok(action.published_ns)
    }

    /// Frees what peers that were killed have left in shared memory.
    pub fn clean_up_dead_peers(&self) {
        self.node.try_cleanup_dead_nodes();
    }

    /// Tells the simulator that no further action will come.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn close(self) -> Result<(), LinkError> {
        self.actions.notify(EVENT_CLOSED)
    }
}

/// Files of this prefix that are left in shared memory, after dead peers were cleaned up. Empty when no peer is alive.
///
/// iceoryx2's node counter (16 bytes a prefix, shared by all programs, kept by design) is not counted; see
/// [`forget_prefix`].
///
/// # Errors
/// [`LinkError::Node`] when shared memory cannot be read.
pub fn list_leftovers(prefix: &str) -> Result<Vec<String>, LinkError> {
    let config = config(Some(prefix))?;
    Node::<Ipc>::list(&config, |state| {
        if let NodeState::Dead(dead) = state {
            // What cannot be removed shows up in the list below.
            let _ = dead.try_remove_stale_resources();
        }
        CallbackProgression::Continue
    })
    .map_err(|error| LinkError::Node(format!("{error:?}")))?;
    Ok(files_of(prefix).filter(|path| !path.ends_with(NODE_COUNTER_SUFFIX)).collect())
}

/// Removes iceoryx2's node counter of a prefix that no process uses any more: a test's own, for example.
pub fn forget_prefix(prefix: &str) {
    for counter in files_of(prefix).filter(|path| path.ends_with(NODE_COUNTER_SUFFIX)) {
        // Somebody else may have removed it: it is gone either way.
        let _ = std::fs::remove_file(counter);
    }
}

const NODE_COUNTER_SUFFIX: &str = ".global_mgmt";

fn files_of(prefix: &str) -> impl Iterator<Item = String> + '_ {
    ["/dev/shm", "/tmp/iceoryx2", "/tmp/iceoryx2/services", "/tmp/iceoryx2/nodes"]
        .into_iter()
        .filter_map(|folder| std::fs::read_dir(folder).ok())
        .flat_map(|entries| entries.flatten())
        .filter(move |entry| entry.file_name().to_string_lossy().starts_with(prefix))
        .map(|entry| entry.path().display().to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Settings under a prefix of their own, which is forgotten at the end.
    struct Domain(LinkSettings);

    impl Drop for Domain {
        fn drop(&mut self) {
            forget_prefix(self.0.prefix.as_deref().unwrap());
        }
    }

    fn domain(name: &str) -> (LinkSettings, Domain) {
        let prefix = Some(format!("rcwm_unit_{}_{name}_", std::process::id()));
        let settings = LinkSettings { instance: name.to_owned(), prefix, spin: Duration::ZERO };
        (settings.clone(), Domain(settings))
    }

    const SOON: Duration = Duration::from_secs(5);

    #[test]
    fn an_observation_goes_over_and_its_answer_comes_back() {
        let (settings, _domain) = domain("both_ways");
        let simulator = SimulatorLink::open(settings.clone()).unwrap();
        let controller = ControllerLink::open(settings.clone()).unwrap();
        assert!(simulator.poll_events().unwrap().hello, "a new controller announces itself");
        simulator.publish(|observation| observation.sequence = 7).unwrap();
        let Wait::Message(observation) = controller.wait_observation(SOON).unwrap() else {
            panic!("no observation")
        };
        assert_eq!(observation.sequence, 7);
        assert!(observation.published_ns > 0);
        let action = Action { answers: 7, published_ns: 0, source: 0, reserved: 0, action: [0.5; 4] };
        controller.send(action).unwrap();
        let (Wait::Message(answer), _) = simulator.wait_action(SOON).unwrap() else { panic!("no action") };
        assert_eq!((answer.answers, answer.action), (7, [0.5; 4]));
        simulator.close().unwrap();
        assert!(matches!(controller.wait_observation(SOON).unwrap(), Wait::Closed));
        drop((observation, controller));
        assert_eq!(list_leftovers(&settings.prefix.unwrap()).unwrap(), Vec::<String>::new());
    }

    #[test]
    fn only_the_newest_observation_is_kept() {
        let (settings, _domain) = domain("newest");
        let simulator = SimulatorLink::open(settings.clone()).unwrap();
        let controller = ControllerLink::open(settings).unwrap();
        for sequence in 0..5 {
            simulator.publish(|observation| observation.sequence = sequence).unwrap();
        }
        let Wait::Message(observation) = controller.wait_observation(SOON).unwrap() else {
            panic!("no observation")
        };
        assert_eq!(observation.sequence, 4);
        assert!(matches!(controller.wait_observation(Duration::from_millis(20)).unwrap(), Wait::TimedOut));
    }

    #[test]
    fn a_second_simulator_and_a_second_controller_are_refused() {
        let (settings, _domain) = domain("second");
        let _simulator = SimulatorLink::open(settings.clone()).unwrap();
        let _controller = ControllerLink::open(settings.clone()).unwrap();
        let error = SimulatorLink::open(settings.clone()).err().unwrap();
        assert!(matches!(error, LinkError::Taken { role: "simulator", .. }), "{error}");
        let error = ControllerLink::open(settings).err().unwrap();
        assert!(matches!(error, LinkError::Taken { role: "controller", .. }), "{error}");
    }

    #[test]
    fn a_peer_of_another_version_is_refused() {
        #[derive(Debug, Clone, Copy, ZeroCopySend)]
        #[type_name("rcwm.Observation.v0")]
        #[repr(C)]
        struct OldObservation {
            sequence: u64,
        }
        let (settings, _domain) = domain("version");
        let node = make_node(&settings).unwrap();
        let _old = Direction::<OldObservation>::open(&node, &settings.instance, "observation").unwrap();
        let error = ControllerLink::open(settings).err().unwrap();
        assert!(error.to_string().contains("rcwm.Observation.v1"), "{error}");
    }

    #[test]
    fn names_that_shared_memory_cannot_carry_are_refused() {
        let (settings, _domain) = domain("names");
        for instance in ["", "a/b", "..", "with space"] {
            let settings = LinkSettings { instance: instance.into(), ..settings.clone() };
            assert!(matches!(SimulatorLink::open(settings), Err(LinkError::InstanceName(_))), "{instance:?}");
        }
        let settings = LinkSettings { prefix: Some("a/b".into()), ..settings };
        assert!(matches!(SimulatorLink::open(settings), Err(LinkError::Prefix(_))));
    }
}
