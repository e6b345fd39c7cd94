//! What is said between the one who asks and the server: one request and some answers, each a line of JSON, over a Unix socket.
//!
//! The socket has a name but no file (Linux, abstract): nothing is left behind by a run that is killed, and its name is free at once.
//! A name belongs to whoever takes it first, so that each end looks who the other is: the server serves its own user and root only, and who
//! asks talks to a server of their own user or root's only (root to any). Containers meet where they share the network
//! namespace and `/dev/shm`.

use std::io::{self, BufRead, BufReader, Read, Write};
use std::net::Shutdown;
use std::os::fd::AsRawFd;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rcwm_models::files::sha256_hex;
use rcwm_models::wire::LinkSettings;
use serde::{Deserialize, Serialize};

use super::SwapError;

/// Version of this conversation.
pub(super) const VERSION: u32 = 1;
/// Longest line.
const LINE_BYTES_MAX: u64 = 64 << 10;
/// Longest name of a socket.
const NAME_BYTES_MAX: usize = 107;
/// How often the one who asks looks at its stop flag.
const LOOK: Duration = Duration::from_millis(100);
/// How long the one who leaves still hears what the server says about it.
const LAST_WORDS: Duration = Duration::from_secs(1);
/// And how long where the policy was laid out already, so that only the server knows whether it was taken.
const LAST_WORDS_LAID_OUT: Duration = Duration::from_secs(10);

/// When the new policy takes over.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum When {
    /// At the start of the next episode.
    Episode,
    /// After the tick that is running.
    Now,
}

/// What is asked of the server.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Request {
    pub(super) version: u32,
    pub(super) bundle: PathBuf,
    pub(super) when: When,
}

/// What the server says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "state", rename_all = "lowercase")]
pub enum Answer {
    /// It loads and verifies the bundle.
    Loading,
    /// The policy is ready and waits for its moment.
    Ready {
        /// Time it took to load, verify and warm up, in s.
        prepared_s: f64,
    },
    /// The policy runs.
    Taken {
        /// Task of the bundle.
        task: String,
        /// Preset of the bundle.
        preset: String,
        /// World-model updates behind it.
        updates: u64,
        /// Time from ready to taken, in s.
        waited_s: f64,
    },
    /// The bundle was not taken; the old policy runs on.
    Refused {
        /// Why, on one line.
        reason: String,
    },
    /// The one who asked has hung up before the moment came; the old policy runs on.
    Withdrawn,
}

impl Answer {
    /// Whether it is the last.
    #[must_use]
    pub fn is_final(&self) -> bool {
        matches!(self, Self::Taken { .. } | Self::Refused { .. } | Self::Withdrawn)
    }
}

/// The socket's name. Containers may share a network, whose sockets these are, and still have a shared memory each: the number of that
/// memory keeps runs apart that cannot meet.
pub(super) fn server_name(link: &LinkSettings) -> String {
    let (prefix, memory) = (link.prefix.as_deref().unwrap_or(""), rcwm_models::wire::shared_memory_number());
    let name = format!("rcwm-swap/{memory}/{prefix}/{}", link.instance);
    if name.len() <= NAME_BYTES_MAX { name } else { format!("rcwm-swap/{}", sha256_hex(name.as_bytes())) }
}

pub(super) fn address(name: &str) -> io::Result<SocketAddr> {
    SocketAddr::from_abstract_name(name)
}

/// Writes one line.
pub(super) fn say(mut stream: &UnixStream, message: &impl Serialize) -> io::Result<()> {
    let mut line = serde_json::to_vec(message)?;
    line.push(b'\n');
    stream.write_all(&line)
}

/// Reads one line; nothing is read after it.
pub(super) fn hear(stream: &UnixStream) -> io::Result<Request> {
    let mut line = String::new();
    BufReader::new(stream.take(LINE_BYTES_MAX)).read_line(&mut line)?;
    Ok(serde_json::from_str(&line)?)
}

/// Asks the run on an instance to take over a bundle, and waits until it has or has not.
///
/// `listen` is called with every answer. When `stop` is set or `timeout` is over before the bundle was taken, it is withdrawn: the server
/// takes no bundle of somebody who had left before it was ready, so that nobody waits for a server that is still loading.
///
/// # Errors
/// [`SwapError::NoServer`], [`SwapError::Stranger`] and [`SwapError::Conversation`]; a bundle that is refused is [`Answer::Refused`].
pub fn ask(
    link: &LinkSettings,
    bundle: &Path,
    when: When,
    timeout: Option<Duration>,
    stop: &AtomicBool,
    listen: &mut dyn FnMut(&Answer),
) -> Result<Answer, SwapError> {
    let no_server = |source| SwapError::NoServer { instance: link.instance.clone(), source };
    let stream =
        address(&server_name(link)).and_then(|at| UnixStream::connect_addr(&at)).map_err(no_server)?;
    let broken = |error: io::Error| SwapError::Conversation(format!("broke off: {error}"));
    let user = user_of_peer(&stream).map_err(broken)?;
    let own = rustix::process::geteuid().as_raw();
    if user != own && user != 0 && own != 0 {
        return Err(SwapError::Stranger { instance: link.instance.clone(), user });
    }
    // The run may lie elsewhere in the file system than the one who asks.
    let bundle = std::path::absolute(bundle).map_err(broken)?;
    say(&stream, &Request { version: VERSION, bundle, when }).map_err(broken)?;
    stream.set_read_timeout(Some(LOOK)).map_err(broken)?;
    let start = Instant::now();
    let (mut lines, mut line) = (BufReader::new(&stream), Vec::new());
    let (mut leaving, mut ready) = (None::<Instant>, false);
    loop {
        match lines.read_until(b'\n', &mut line) {
            Ok(0) => {
                let text = "has ended without an answer; whether it took the bundle is not known";
                return Err(SwapError::Conversation(text.into()));
            }
            Ok(_) if line.ends_with(b"\n") => {
                let not_understood = |error| SwapError::Conversation(format!("is not understood: {error}"));
                let answer: Answer = serde_json::from_slice(&line).map_err(not_understood)?;
                listen(&answer);
                ready |= matches!(answer, Answer::Ready { .. });
                if answer.is_final() {
                    return Ok(answer);
                }
                line.clear();
            }
            // The end of the stream inside a line shows at the next read.
            Ok(_) => {}
            Err(error) if is_timeout(&error) => {}
            Err(error) => return Err(broken(error)),
        }
        let over = timeout.is_some_and(|timeout| start.elapsed() >= timeout);
        if leaving.is_none() && (over || stop.load(Ordering::Relaxed)) {
            // The server sees that we leave, and still says how it ended.
            stream.shutdown(Shutdown::Write).map_err(broken)?;
            leaving = Some(Instant::now());
        }
        match leaving.map(|since| since.elapsed()) {
            Some(waited) if !ready && waited >= LAST_WORDS => return Ok(Answer::Withdrawn),
            Some(waited) if waited >= LAST_WORDS_LAID_OUT => {
                let text = "does not answer; whether it took the bundle is not known";
                return Err(SwapError::Conversation(text.into()));
            }
            _ => {}
        }
    }
}

/// The user of the process at the other end: of a server, the one that opened it.
pub(super) fn user_of_peer(stream: &UnixStream) -> io::Result<u32> {
    let mut peer = libc::ucred { pid: 0, uid: 0, gid: 0 };
    let mut len = size_of::<libc::ucred>() as libc::socklen_t;
    let (place, len_place) = ((&raw mut peer).cast(), &raw mut len);
    // SAFETY: the socket is open during the call, and the place is as long as `len` says.
    let result = unsafe {
        libc::getsockopt(stream.as_raw_fd(), libc::SOL_SOCKET, libc::SO_PEERCRED, place, len_place)
    };
    if result == 0 { Ok(peer.uid) } else { Err(io::Error::last_os_error()) }
}

pub(super) fn is_timeout(error: &io::Error) -> bool {
    use io::ErrorKind::{Interrupted, TimedOut, WouldBlock};
    matches!(error.kind(), Interrupted | TimedOut | WouldBlock)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longest_names_still_fit_a_socket_and_differ() {
        let link = |instance: &str| LinkSettings {
            instance: instance.repeat(64),
            prefix: Some("p".repeat(32)),
            ..LinkSettings::new("")
        };
        let (a, b) = (server_name(&link("a")), server_name(&link("b")));
        assert_ne!(a, b);
        address(&a).unwrap();
        let plain = LinkSettings { prefix: None, ..LinkSettings::new("arm") };
        let memory = rcwm_models::wire::shared_memory_number();
        assert_eq!(server_name(&plain), format!("rcwm-swap/{memory}//arm"), "told apart by shared memory");
    }
}
