//! Everything under one prefix of shared memory: joining it, and what dead peers leave in it.

use iceoryx2::node::NodeCreationFailure;
use iceoryx2::prelude::*;

use std::path::Path;

use super::{Ipc, LinkError, LinkSettings, memory};

/// Joins the domain as a node of its own and opens a link there, whose sender's messages are of so many bytes.
pub(super) fn join<T>(
    settings: &LinkSettings,
    message_bytes: usize,
    open: impl FnOnce(Node<Ipc>) -> Result<T, LinkError>,
) -> Result<T, LinkError> {
    let root = config(settings.prefix.as_deref())?.global.root_path().to_string();
    memory::open_folders(Path::new(&root));
    reserve_new(settings, message_bytes, || make_node(settings).and_then(open))
}

/// Makes ports, whose messages are of so many bytes, and takes the room in shared memory that they need for good.
pub(super) fn reserve_new<T>(
    settings: &LinkSettings,
    message_bytes: usize,
    open: impl FnOnce() -> Result<T, LinkError>,
) -> Result<T, LinkError> {
    let config = config(settings.prefix.as_deref())?;
    let (prefix, root) = (config.global.prefix.to_string(), config.global.root_path().to_string());
    memory::check_room(message_bytes)?;
    let before = memory::files(&prefix);
    let made = open().map_err(|error| match error {
        LinkError::Node(_) | LinkError::Service { .. } => {
            memory::other_user(Path::new(&root), &prefix).unwrap_or(error)
        }
        other => other,
    })?;
    memory::reserve(&prefix, &before)?;
    Ok(made)
}

/// Joins the domain as a node of its own.
pub(super) fn make_node(settings: &LinkSettings) -> Result<Node<Ipc>, LinkError> {
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
