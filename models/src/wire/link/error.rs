//! Why a link fails.

use std::path::PathBuf;

use crate::interface::{InterfaceError, Mismatch};
use crate::wire::WIRE;

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
    /// There is no room for the link's messages.
    #[error(
        "shared memory is full: /dev/shm has {free_kib} KiB free, the link needs {needed_kib}; remove what fills it, or give the \
         container more (docker run --shm-size=256m; Kubernetes: an emptyDir with medium Memory at /dev/shm)"
    )]
    Memory { free_kib: u64, needed_kib: u64 },
    /// A folder of iceoryx2's keeps this user out.
    #[error(
        "shared memory: {path} belongs to user {owner}, and this user may not write there; run all programs as one user, or let \
         user {owner} (or root) open it: chmod 1777 {root} {root}/services {root}/nodes"
    )]
    FolderOfOtherUser {
        path: PathBuf,
        /// Number of its owner.
        owner: u32,
        /// The folder of all that iceoryx2 shares beside memory.
        root: PathBuf,
    },
    /// The link's files are another user's.
    #[error(
        "shared memory: {path} belongs to user {owner}; run all programs of a link as one user, or give this user's a prefix of \
         their own: RCWM_PREFIX=name (now {prefix:?})"
    )]
    FilesOfOtherUser {
        /// The first of them.
        path: PathBuf,
        /// Number of its owner.
        owner: u32,
        /// The prefix that both use.
        prefix: String,
    },
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
    /// A peer that is connected speaks another version of the wire.
    #[error(
        "{service}: the peer speaks another version of the wire (this program speaks {WIRE}); build simulator, runtime and trainer from \
         one version"
    )]
    OtherWire { service: String },
    /// A peer that is connected speaks for another interface.
    #[error(
        "{service}: a program that is still connected uses another interface; end it first, or choose another --instance"
    )]
    OtherInterface {
        /// The service's name.
        service: String,
    },
    /// The robot is not what the controller needs.
    #[error("instance {instance}: robot {robot} does not fit: {}", mismatches.iter().map(ToString::to_string).collect::<Vec<_>>().join("; "))]
    DoesNotFit {
        instance: String,
        /// Its name.
        robot: String,
        mismatches: Vec<Mismatch>,
    },
    /// What a robot says of itself is no interface.
    #[error("instance {instance}: the robot's {source}")]
    NoInterface { instance: String, source: InterfaceError },
    /// A message of another length than the interface gives it.
    #[error(
        "{service}: a message of {found} bytes, expected {expected}; the peer does not keep to the interface"
    )]
    MessageLength { service: &'static str, found: usize, expected: usize },
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

/// Wraps what iceoryx2 said about an operation on a link that had worked.
pub(super) fn traffic<E: std::fmt::Debug>(operation: &'static str) -> impl FnOnce(E) -> LinkError {
    move |error| LinkError::Traffic { operation, reason: format!("{error:?}") }
}
