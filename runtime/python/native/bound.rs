//! What only the thread may touch that made it: the ends of a link count their references without locks.

use std::mem::ManuallyDrop;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, ThreadId};

use pyo3::prelude::*;

use crate::errors::error;

/// A value that is reached and dropped on the thread that made it alone. Where another thread drops it, it goes into the bin.
pub(crate) struct ThreadBound<T> {
    thread: ThreadId,
    value: ManuallyDrop<T>,
    bin: Bin<T>,
}

// SAFETY: the value is reached by `get`, on its own thread, and dropped there; `peek` is its caller's.
unsafe impl<T> Send for ThreadBound<T> {}
// SAFETY: as above.
unsafe impl<T> Sync for ThreadBound<T> {}

impl<T> ThreadBound<T> {
    pub(crate) fn new(value: T, bin: &Bin<T>) -> Self {
        Self { thread: thread::current().id(), value: ManuallyDrop::new(value), bin: bin.clone() }
    }

    /// Raises `WrongThread`.
    pub(crate) fn get(&self, py: Python<'_>) -> PyResult<&T> {
        if thread::current().id() == self.thread {
            return Ok(&self.value);
        }
        Err(error(
            py,
            "WrongThread",
            "an end of a link belongs to the thread that opened it; open and use it on one thread",
        ))
    }

    /// The value, on any thread.
    ///
    /// # Safety
    /// What is done with it must be sound on any thread, while its own uses it.
    pub(crate) unsafe fn peek(&self) -> &T {
        &self.value
    }
}

impl<T> Drop for ThreadBound<T> {
    fn drop(&mut self) {
        // SAFETY: it is not used after this.
        let value = unsafe { ManuallyDrop::take(&mut self.value) };
        if thread::current().id() == self.thread {
            drop(value);
        } else {
            self.bin.0.lock().unwrap_or_else(PoisonError::into_inner).push(Foreign(ManuallyDrop::new(value)));
        }
    }
}

/// What other threads have dropped, until its own thread empties it. All of one bin is of one thread.
pub(crate) struct Bin<T>(Arc<Mutex<Vec<Foreign<T>>>>);

/// A value that whoever holds it does not touch. Never dropped by itself: who is left may be on another thread.
struct Foreign<T>(ManuallyDrop<T>);

// SAFETY: it is touched by `Bin::empty` alone.
unsafe impl<T> Send for Foreign<T> {}

impl<T> Clone for Bin<T> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<T> Bin<T> {
    pub(crate) fn new() -> Self {
        Self(Arc::new(Mutex::new(Vec::new())))
    }

    /// Drops what is in it.
    ///
    /// # Safety
    /// To be called on the thread that made the values.
    pub(crate) unsafe fn empty(&self) {
        let found = std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner));
        found.into_iter().for_each(|Foreign(value)| drop(ManuallyDrop::into_inner(value)));
    }
}
