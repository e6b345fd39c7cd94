//! One direction of the link: a publish-subscribe service of headers and bytes, and the event service that wakes its receiver.

use std::cell::Cell;
use std::mem::MaybeUninit;
use std::os::fd::BorrowedFd;
use std::time::{Duration, Instant};

use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::service::attribute::{AttributeKey, AttributeValue};
use iceoryx2::service::builder::event::EventOpenOrCreateError;
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenOrCreateError;
use iceoryx2::service::port_factory::{event, publish_subscribe};
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::error::traffic;
use super::{Events, Ipc, LinkError, Wait};
use crate::wire::WIRE;

/// A message in shared memory; it stays valid while this is held.
pub(super) type Received<H> = Sample<Ipc, [u8], H>;
/// Room in shared memory for a message.
pub(super) type Loan<H> = SampleMut<Ipc, [u8], H>;

/// Recorders and other listeners beside the controller.
const SUBSCRIBERS_MAX: usize = 8;
const NODES_MAX: usize = 16;
const EVENT_ID_MAX: usize = 7;

pub(super) const EVENT_PUBLISHED: usize = 0;
pub(super) const EVENT_HELLO: usize = 1;
pub(super) const EVENT_CLOSED: usize = 2;
/// Somebody asks for the interface.
pub(super) const EVENT_ASKED: usize = 3;

/// What a message begins with; `()` for none.
pub(super) trait Header: ZeroCopySend + std::fmt::Debug + Default + 'static {}
impl<H: ZeroCopySend + std::fmt::Debug + Default + 'static> Header for H {}

/// What both ends of a service must agree on.
pub(super) struct Topic<'a> {
    pub(super) instance: &'a str,
    /// `observation`, `action` or `interface`.
    pub(super) name: &'a str,
    /// The interface by which messages are laid out; none where they are of no interface.
    pub(super) interface_hash: Option<&'a str>,
    /// Whether who comes later gets the last message.
    pub(super) history: bool,
}

/// Both services of one direction.
pub(super) struct Direction<H: Header> {
    name: String,
    data: publish_subscribe::PortFactory<Ipc, [u8], H>,
    event: event::PortFactory<Ipc>,
}

/// The event service of a direction, which is of no interface.
pub(super) fn open_event(
    node: &Node<Ipc>,
    instance: &str,
    topic: &str,
) -> Result<event::PortFactory<Ipc>, LinkError> {
    let (name, service) = service_name(instance, topic)?;
    node.service_builder(&service)
        .event()
        .max_notifiers(SUBSCRIBERS_MAX)
        .max_listeners(SUBSCRIBERS_MAX)
        .max_nodes(NODES_MAX)
        .event_id_max_value(EVENT_ID_MAX)
        .open_or_create()
        .map_err(|error: EventOpenOrCreateError| LinkError::Service {
            service: name,
            reason: format!("{error:?}"),
        })
}

pub(super) fn make_waker(event: &event::PortFactory<Ipc>) -> Result<Waker, LinkError> {
    let service = event.name().to_string();
    let created = event.notifier_builder().create();
    created.map(Waker).map_err(|error| LinkError::Service { service, reason: format!("{error:?}") })
}

fn service_name(instance: &str, topic: &str) -> Result<(String, ServiceName), LinkError> {
    let name = format!("rcwm/{instance}/{topic}");
    let service = name.as_str().try_into().map_err(|_| LinkError::InstanceName(instance.to_owned()))?;
    Ok((name, service))
}

impl<H: Header> Direction<H> {
    pub(super) fn open(node: &Node<Ipc>, topic: &Topic<'_>) -> Result<Self, LinkError> {
        let (name, service) = service_name(topic.instance, topic.name)?;
        let data = node
            .service_builder(&service)
            .publish_subscribe::<[u8]>()
            .user_header::<H>()
            .history_size(usize::from(topic.history))
            .subscriber_max_buffer_size(1)
            .subscriber_max_borrowed_samples(2)
            .enable_safe_overflow(true)
            .max_publishers(1)
            .max_subscribers(SUBSCRIBERS_MAX)
            .max_nodes(NODES_MAX)
            .open_or_create_with_attributes(&attributes(topic)?)
            .map_err(|error| Self::data_error(&name, error, topic.interface_hash))?;
        let event = open_event(node, topic.instance, topic.name)?;
        Ok(Self { name, data, event })
    }

    /// Whether a service of this name, if there is one, is of these messages: one of another version is an error.
    pub(super) fn check_version(node: &Node<Ipc>, instance: &str, topic: &str) -> Result<(), LinkError> {
        use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError::IncompatibleTypes;
        let (service, name) = service_name(instance, topic)?;
        let opened = node.service_builder(&name).publish_subscribe::<[u8]>().user_header::<H>().open();
        match opened {
            Err(IncompatibleTypes) => Err(Self::other_version(service)),
            // What else is wrong is said where it is to be used.
            _ => Ok(()),
        }
    }

    fn other_version(service: String) -> LinkError {
        // SAFETY: the name is a constant; the function is marked unsafe because peers trust it.
        let expected = unsafe { <H as ZeroCopySend>::type_name() };
        LinkError::OtherVersion { service, expected }
    }

    fn data_error(
        name: &str,
        error: PublishSubscribeOpenOrCreateError,
        interface_hash: Option<&str>,
    ) -> LinkError {
        use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError::{
            IncompatibleAttributes, IncompatibleTypes,
        };
        let service = name.to_owned();
        match error {
            PublishSubscribeOpenOrCreateError::PublishSubscribeOpenError(IncompatibleTypes) => {
                Self::other_version(service)
            }
            // Nothing but the version of the wire is said there.
            PublishSubscribeOpenOrCreateError::PublishSubscribeOpenError(IncompatibleAttributes)
                if interface_hash.is_none() =>
            {
                LinkError::OtherWire { service }
            }
            PublishSubscribeOpenOrCreateError::PublishSubscribeOpenError(IncompatibleAttributes) => {
                LinkError::OtherInterface { service }
            }
            other => LinkError::Service { service, reason: format!("{other:?}") },
        }
    }

    /// A sender of messages of at most so many bytes.
    pub(super) fn sender(&self, role: &'static str, bytes_max: usize) -> Result<Sender<H>, LinkError> {
        use iceoryx2::port::publisher::PublisherCreateError::ExceedsMaxSupportedPublishers;
        let publisher = self
            .data
            .publisher_builder()
            .max_loaned_samples(1)
            .initial_max_slice_len(bytes_max)
            .allocation_strategy(AllocationStrategy::Static)
            .create()
            .map_err(|error| match error {
                ExceedsMaxSupportedPublishers => LinkError::Taken { service: self.name.clone(), role },
                other => LinkError::Service { service: self.name.clone(), reason: format!("{other:?}") },
            })?;
        Ok(Sender { publisher, waker: make_waker(&self.event)? })
    }

    pub(super) fn receiver(&self) -> Result<Receiver<H>, LinkError> {
        let failed = |reason: String| LinkError::Service { service: self.name.clone(), reason };
        let subscriber =
            self.data.subscriber_builder().create().map_err(|error| failed(format!("{error:?}")))?;
        let listener =
            self.event.listener_builder().create().map_err(|error| failed(format!("{error:?}")))?;
        Ok(Receiver { subscriber, listener, pending: Cell::default() })
    }
}

fn attributes(topic: &Topic<'_>) -> Result<AttributeVerifier, LinkError> {
    let wrong = |error: String| LinkError::Service { service: topic.name.to_owned(), reason: error };
    let wire = WIRE.to_string();
    let named = [("rcwm.wire", Some(wire.as_str())), ("rcwm.interface", topic.interface_hash)];
    let mut all = AttributeVerifier::new();
    for (key, value) in named {
        let Some(value) = value else { continue };
        let key = AttributeKey::try_from(key).map_err(|error| wrong(format!("{error:?}")))?;
        let value = AttributeValue::try_from(value).map_err(|error| wrong(format!("{error:?}")))?;
        all = all.require(&key, &value).map_err(|error| wrong(format!("{error:?}")))?;
    }
    Ok(all)
}

pub(super) struct Sender<H: Header> {
    publisher: Publisher<Ipc, [u8], H>,
    waker: Waker,
}

impl<H: Header> Sender<H> {
    pub(super) fn notify(&self, event: usize) -> Result<(), LinkError> {
        self.waker.notify(event)
    }

    /// A place for a message of so many bytes, which are zeros.
    pub(super) fn loan(&self, bytes: usize) -> Result<Loan<H>, LinkError> {
        let mut sample = self.publisher.loan_slice_uninit(bytes).map_err(traffic("loaning a message"))?;
        sample.payload_mut().fill(MaybeUninit::new(0));
        *sample.user_header_mut() = H::default();
        // SAFETY: every byte and the header were written above.
        Ok(unsafe { sample.assume_init() })
    }

    /// Sends a message and wakes who waits for it.
    pub(super) fn send(&self, message: Loan<H>) -> Result<(), LinkError> {
        message.send().map_err(traffic("publishing a message"))?;
        self.notify(EVENT_PUBLISHED)
    }
}

/// Wakes whoever listens at the other end.
pub(super) struct Waker(Notifier<Ipc>);

impl Waker {
    pub(super) fn notify(&self, event: usize) -> Result<(), LinkError> {
        let sent = self.0.notify_with_custom_event_id(EventId::new(event));
        sent.map(drop).map_err(traffic("waking the peer"))
    }
}

pub(super) struct Receiver<H: Header> {
    subscriber: Subscriber<Ipc, [u8], H>,
    listener: Listener<Ipc>,
    /// Signals that came with a message and were not yet acted upon.
    pending: Cell<Events>,
}

impl<H: Header> Receiver<H> {
    pub(super) fn poll(&self) -> Result<Option<Received<H>>, LinkError> {
        self.subscriber.receive().map_err(traffic("receiving"))
    }

    /// Takes the signals seen so far, without blocking; an event service must be drained, or every later wait returns at
    /// once.
    pub(super) fn take_events(&self) -> Result<Events, LinkError> {
        self.note_events(|note| self.listener.try_wait(note))?;
        Ok(self.pending.take())
    }

    /// Whether somebody asks for the interface; other signals are kept for the next look.
    pub(super) fn take_asked(&self) -> Result<bool, LinkError> {
        self.note_events(|note| self.listener.try_wait(note))?;
        let events = self.pending.get();
        self.pending.set(Events { asked: false, ..events });
        Ok(events.asked)
    }

    /// Waits for a message. A message wins over signals that came with it: those are kept for the next call.
    pub(super) fn wait(
        &self,
        spin: Duration,
        timeout: Duration,
    ) -> Result<(Wait<Received<H>>, Events), LinkError> {
        let start = Instant::now();
        while start.elapsed() < spin.min(timeout) {
            if let Some(sample) = self.poll()? {
                return Ok((Wait::Message(sample), Events::default()));
            }
            std::hint::spin_loop();
        }
        loop {
            if let Some(sample) = self.poll()? {
                return Ok((Wait::Message(sample), Events::default()));
            }
            if self.pending.get().closed {
                return Ok((Wait::Closed, self.pending.take()));
            }
            let left = timeout.saturating_sub(start.elapsed());
            if left.is_zero() || self.pending.get().hello || self.pending.get().asked {
                return Ok((Wait::TimedOut, self.pending.take()));
            }
            if self.sleep(left)? == Woken::BySignal {
                // The program has a handler and wants to look at what it noted.
                return Ok((Wait::TimedOut, Events::default()));
            }
        }
    }

    /// Blocks until there are signals of the peer, or the time is up.
    ///
    /// Not by the listener's own timed wait: its time-out is that of a socket, which Linux counts in jiffies, and oversleeps by up to
    /// two of them (8 ms at 250 Hz). `ppoll` is exact to the timer slack (50 us).
    fn sleep(&self, timeout: Duration) -> Result<Woken, LinkError> {
        // SAFETY: the listener owns the descriptor, lives longer than this borrow, and nobody closes it here.
        let socket = unsafe { BorrowedFd::borrow_raw(self.listener.file_descriptor().native_handle()) };
        let timeout =
            Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: i64::from(timeout.subsec_nanos()) };
        match poll(&mut [PollFd::new(&socket, PollFlags::IN)], Some(&timeout)) {
            Ok(_) => self.note_events(|note| self.listener.try_wait(note)),
            Err(rustix::io::Errno::INTR) => Ok(Woken::BySignal),
            Err(error) => Err(traffic("waiting for the peer")(error)),
        }
    }

    fn note_events(
        &self,
        collect: impl FnOnce(&mut dyn FnMut(EventActivation)) -> Result<u64, ListenerWaitError>,
    ) -> Result<Woken, LinkError> {
        let mut events = self.pending.get();
        let result = collect(&mut |event| events.note(event.id));
        self.pending.set(events);
        match result {
            Ok(_) => Ok(Woken::InOrder),
            Err(ListenerWaitError::InterruptSignal) => Ok(Woken::BySignal),
            Err(error) => Err(traffic("waiting for the peer")(error)),
        }
    }
}

/// What ended a wait on the event service.
#[derive(PartialEq, Eq)]
enum Woken {
    /// An event, or the time was up.
    InOrder,
    /// A signal to the process (Ctrl-C).
    BySignal,
}

impl Events {
    fn note(&mut self, id: EventId) {
        match id.as_value() {
            EVENT_HELLO => self.hello = true,
            EVENT_CLOSED => self.closed = true,
            EVENT_ASKED => self.asked = true,
            _ => {}
        }
    }
}
