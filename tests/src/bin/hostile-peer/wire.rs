//! The peer's end of the link, bare: unlike [`rcwm_models::wire::SimulatorLink`] it publishes any number in any field.

use anyhow::{Context, anyhow};
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use rcwm_models::wire::{
    Action, ActionHeader, ActionValues, LinkSettings, ObservationHeader, OwnedObservation,
};

type Ipc = ipc::Service;

/// More than an observation of Meta-World's arm has.
const MESSAGE_BYTES_MAX: usize = 1 << 16;

/// Events of the link, by their numbers.
const PUBLISHED: usize = 0;
const CLOSED: usize = 2;

/// The bare ports of a robot.
pub(crate) struct Wire {
    publisher: Option<Publisher<Ipc, [u8], ObservationHeader>>,
    notifier: Notifier<Ipc>,
    actions: Subscriber<Ipc, [u8], ActionHeader>,
    events: Listener<Ipc>,
    observations: PortFactory<Ipc, [u8], ObservationHeader>,
    // Dropped last: the ports above belong to it.
    _node: Node<Ipc>,
}

/// Makes an error of iceoryx2 one of ours.
fn failed<E: std::fmt::Debug>(what: &'static str) -> impl FnOnce(E) -> anyhow::Error {
    move |error| anyhow!("{what}: {error:?}")
}

impl Wire {
    /// Joins services that the controller's link has made.
    pub(crate) fn join(settings: &LinkSettings) -> anyhow::Result<Self> {
        let mut config = Config::default();
        let prefix = settings.prefix.as_deref().context("a prefix of its own")?;
        config.global.prefix = FileName::new(prefix.as_bytes()).map_err(failed("the prefix"))?;
        let node = NodeBuilder::new()
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .config(&config)
            .create::<Ipc>()
            .map_err(failed("the peer's node"))?;
        let name = |topic: &str| -> anyhow::Result<ServiceName> {
            let name = format!("rcwm/{}/{topic}", settings.instance);
            name.as_str().try_into().map_err(failed("a service's name"))
        };
        let (observation, action) = (name("observation")?, name("action")?);
        let observations = node
            .service_builder(&observation)
            .publish_subscribe::<[u8]>()
            .user_header::<ObservationHeader>()
            .open()
            .map_err(failed("observations"))?;
        let answers = node
            .service_builder(&action)
            .publish_subscribe::<[u8]>()
            .user_header::<ActionHeader>()
            .open()
            .map_err(failed("actions"))?;
        let wake = node.service_builder(&observation).event().open().map_err(failed("events"))?;
        let woken = node.service_builder(&action).event().open().map_err(failed("events"))?;
        let mut wire = Self {
            publisher: None,
            notifier: wake.notifier_builder().create().map_err(failed("the notifier"))?,
            actions: answers.subscriber_builder().create().map_err(failed("the subscriber"))?,
            events: woken.listener_builder().create().map_err(failed("the listener"))?,
            observations,
            _node: node,
        };
        wire.restart()?;
        Ok(wire)
    }

    /// Becomes another publisher, as a simulator that was started again.
    pub(crate) fn restart(&mut self) -> anyhow::Result<()> {
        // The service takes one publisher at a time.
        self.publisher = None;
        let publisher =
            self.observations.publisher_builder().initial_max_slice_len(MESSAGE_BYTES_MAX).create();
        self.publisher = Some(publisher.map_err(failed("the publisher"))?);
        Ok(())
    }

    /// Who publishes, as the controller is told.
    pub(crate) fn publisher(&self) -> u128 {
        self.publisher.as_ref().map_or(0, |publisher| publisher.id().value())
    }

    /// Publishes as it is; without `wake` the controller finds it when it next looks.
    pub(crate) fn publish(&self, observation: &OwnedObservation, wake: bool) -> anyhow::Result<()> {
        let publisher = self.publisher.as_ref().context("a publisher")?;
        let payload = observation.view().payload();
        let sample = publisher.loan_slice_uninit(payload.len()).map_err(failed("loaning an observation"))?;
        let mut sample = sample.write_from_slice(payload);
        *sample.user_header_mut() = **observation;
        sample.send().map_err(failed("publishing an observation"))?;
        if wake {
            self.notify(PUBLISHED)?;
        }
        Ok(())
    }

    /// Sends an event, whatever it means.
    pub(crate) fn notify(&self, event: usize) -> anyhow::Result<()> {
        let sent = self.notifier.notify_with_custom_event_id(EventId::new(event));
        sent.map(drop).map_err(failed("waking the controller"))
    }

    /// Says that no observation will come.
    pub(crate) fn close(&self) -> anyhow::Result<()> {
        self.notify(CLOSED)
    }

    /// The newest action on the wire.
    pub(crate) fn action(&self) -> anyhow::Result<Option<Action>> {
        let sample = self.actions.receive().map_err(failed("receiving an action"))?;
        Ok(sample.map(|sample| {
            let ActionHeader { answers, published_ns, source, .. } = *sample.user_header();
            let number = |bytes: &[u8; 4]| f32::from_ne_bytes(*bytes);
            let action = sample.payload().as_chunks().0.iter().map(number).collect::<ActionValues>();
            Action { answers, published_ns, source, action }
        }))
    }

    /// Whether the controller has said since the last look that no action will come.
    pub(crate) fn is_told(&self) -> anyhow::Result<bool> {
        let mut told = false;
        self.events
            .try_wait(|event| told |= event.id.as_value() == CLOSED)
            .map_err(failed("taking the controller's events"))?;
        Ok(told)
    }
}
