//! Why a link fails.

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

/// Wraps what iceoryx2 said about an operation on a link that had worked.
pub(super) fn traffic<E: std::fmt::Debug>(operation: &'static str) -> impl FnOnce(E) -> LinkError {
    move |error| LinkError::Traffic { operation, reason: format!("{error:?}") }
}
