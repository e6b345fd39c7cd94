//! Experience in memory, and batches drawn from it.
//!
//! Nouns: a **task** is a named list of episodes in the order they came; a **sequence** is T steps that begin at any step of a
//! task, each equally likely, and run on into the next episode (the last one into the first); a **batch** is B sequences, the
//! tasks taking turns, so that each has an equal share. Batches are numbered: number and seed alone decide what is drawn, so a
//! run that is resumed at update n draws what it would have drawn.
//!
//! ```text
//! data/reach/000017.npz      Dreamer's arrays, see rcwm_models::episode; any file name
//! data/hammer/...            one folder a task; or the files right in data/
//! masks/reach/000017/00000.png, 00001.png, ...   optional: masks that a segmenter wrote, one a step: white, or the number of an object
//! ```

mod error;
mod folder;
mod held_out;
mod load;
mod masks;
mod prefetch;
mod shared;
mod store;

pub use error::ReplayError;
pub use folder::LoadError;
pub use load::Folder;
pub use prefetch::{Prefetch, PrefetchError};
pub use shared::SharedReplay;
pub(crate) use store::check_episode;
pub use store::{Placed, Replay, Starts, append_steps};
