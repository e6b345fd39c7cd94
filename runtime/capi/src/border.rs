//! What every call does with what crosses the border: pointers are checked, panics caught, handles used by one thread at a time.

use std::any::Any;
use std::cell::UnsafeCell;
use std::ffi::{CStr, c_char};
use std::mem::MaybeUninit;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU8, Ordering};

use crate::code::{Code, Failure, note};

/// Does the work of a call. Whatever happens in it becomes a code and a text.
pub(crate) fn border(work: impl FnOnce() -> Result<(), Failure>) -> Code {
    let Failure { code, text } = match catch_unwind(AssertUnwindSafe(work)) {
        Ok(Ok(())) => return Code::RcwmOk,
        Ok(Err(failure)) => failure,
        Err(panic) => Failure::new(Code::RcwmErrorPanic, what_it_says(panic.as_ref())),
    };
    note(&text);
    code
}

fn what_it_says(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("without a message");
    format!("a fault of librcwm, please report it: {text}")
}

/// What a handle holds, for one thread at a time; another that comes meanwhile is refused.
pub(crate) struct Guarded<T> {
    use_: AtomicU8,
    value: UnsafeCell<T>,
}

const FREE: u8 = 0;
const TAKEN: u8 = 1;
/// A call has panicked in the middle of its work.
const BROKEN: u8 = 2;

// SAFETY: `enter` lets one thread at a time at the value, and hands over what was written by acquire and release.
unsafe impl<T: Send> Sync for Guarded<T> {}

impl<T> Guarded<T> {
    pub(crate) fn new(value: T) -> Self {
        Self { use_: AtomicU8::new(FREE), value: UnsafeCell::new(value) }
    }

    pub(crate) fn enter<R>(&self, work: impl FnOnce(&mut T) -> Result<R, Failure>) -> Result<R, Failure> {
        match self.use_.compare_exchange(FREE, TAKEN, Ordering::Acquire, Ordering::Relaxed) {
            Ok(_) => {}
            Err(BROKEN) => {
                let text = "an earlier call has failed inside the library: close this handle";
                return Err(Failure::new(Code::RcwmErrorState, text));
            }
            Err(_) => return Err(in_use()),
        }
        let mut leave = Leave { use_: &self.use_, then: BROKEN };
        // SAFETY: nobody else is in here until `leave` is dropped.
        let result = work(unsafe { &mut *self.value.get() });
        leave.then = FREE;
        result
    }

    pub(crate) fn into_inner(self) -> T {
        self.value.into_inner()
    }

    /// Whether nobody is in a call, so that it may be freed.
    pub(crate) fn check_free(&self) -> Result<(), Failure> {
        if self.use_.load(Ordering::Acquire) == TAKEN { Err(in_use()) } else { Ok(()) }
    }
}

fn in_use() -> Failure {
    let text = "the handle is in use, by another thread or by the call whose callback this is; use it in one thread at a time";
    Failure::new(Code::RcwmErrorState, text)
}

struct Leave<'a> {
    use_: &'a AtomicU8,
    then: u8,
}

impl Drop for Leave<'_> {
    fn drop(&mut self) {
        self.use_.store(self.then, Ordering::Release);
    }
}

/// What a handle points to.
pub(crate) unsafe fn handle<'a, T>(handle: *const T, what: &str) -> Result<&'a T, Failure> {
    // SAFETY: the caller gives a handle that this library has opened and that is not closed yet, or null.
    unsafe { handle.as_ref() }.ok_or_else(|| Failure::argument(format!("{what} is null")))
}

/// A place for something that is given back.
pub(crate) unsafe fn place<'a, T>(place: *mut T, what: &str) -> Result<&'a mut MaybeUninit<T>, Failure> {
    if !place.is_aligned() {
        return Err(Failure::argument(format!("{what} is not aligned")));
    }
    // SAFETY: the caller gives a place of its own, or null.
    unsafe { place.cast::<MaybeUninit<T>>().as_mut() }
        .ok_or_else(|| Failure::argument(format!("{what} is null")))
}

pub(crate) unsafe fn text<'a>(text: *const c_char, what: &str) -> Result<&'a str, Failure> {
    if text.is_null() {
        return Err(Failure::argument(format!("{what} is null, expected a text")));
    }
    // SAFETY: the caller gives a text that ends with a zero.
    let text = unsafe { CStr::from_ptr(text) };
    text.to_str().map_err(|_| {
        Failure::argument(format!("{what} is {:?}, expected a text in UTF-8", text.to_string_lossy()))
    })
}

/// Null is an empty one.
pub(crate) unsafe fn slice<'a, T>(
    items: *const T,
    count: usize,
    what: impl Fn() -> String,
) -> Result<&'a [T], Failure> {
    check(items, count, what)?;
    // SAFETY: checked above; that so many items are there is the caller's to know.
    Ok(if count == 0 { &[] } else { unsafe { std::slice::from_raw_parts(items, count) } })
}

/// The same to be written to.
pub(crate) unsafe fn slice_mut<'a, T>(
    items: *mut T,
    count: usize,
    what: impl Fn() -> String,
) -> Result<&'a mut [T], Failure> {
    check(items, count, what)?;
    // SAFETY: checked above; that so many items are there, and nobody else uses them, is the caller's to know.
    Ok(if count == 0 { &mut [] } else { unsafe { std::slice::from_raw_parts_mut(items, count) } })
}

fn check<T>(items: *const T, count: usize, what: impl Fn() -> String) -> Result<(), Failure> {
    let wrong = |how: &str| Err(Failure::argument(format!("{} {how}", what())));
    if items.is_null() && count > 0 {
        return wrong(&format!("is null, expected {count} of them"));
    }
    if !items.is_aligned() {
        return wrong("is not aligned");
    }
    if count > isize::MAX as usize / size_of::<T>().max(1) {
        return wrong(&format!("has {count} items, more than memory"));
    }
    Ok(())
}

/// A struct of the header that may grow at its end: its first field is its size, as the program was compiled.
///
/// # Safety
/// `#[repr(C)]`, its first field is `size: usize`, and zeros are a value of it.
pub(crate) unsafe trait Growing: Copy {
    /// Its name in the header.
    const NAME: &'static str;
    /// Bytes that it had when it first had this size; later fields are optional.
    const BYTES_MIN: usize;
}

/// A struct that began with the fields up to `$last`.
macro_rules! growing {
    ($type:ident, $name:literal, $last:ident) => {
        // SAFETY: declared `repr(C)` with its size first (checked below), and of numbers and pointers only.
        unsafe impl $crate::border::Growing for $type {
            const NAME: &'static str = $name;
            const BYTES_MIN: usize = std::mem::offset_of!($type, $last) + 1;
        }
        const _: () = assert!(std::mem::offset_of!($type, size) == 0);
    };
}
pub(crate) use growing;

/// Larger than any of ours will ever be: a size beyond is memory that was never set.
const BYTES_MAX: usize = 1 << 16;

pub(crate) fn zeroed<T: Growing>() -> T {
    // SAFETY: zeros are a value, as `Growing` says.
    unsafe { std::mem::zeroed() }
}

unsafe fn size_of_theirs<T: Growing>(from: *const T) -> Result<usize, Failure> {
    if !from.is_aligned() {
        return Err(Failure::argument(format!("{} is not aligned", T::NAME)));
    }
    // SAFETY: not null and aligned; every struct of a caller has at least its size.
    let size = unsafe { from.cast::<usize>().read() };
    if !(T::BYTES_MIN..=BYTES_MAX).contains(&size) {
        let text =
            format!("{name}.size is {size}, expected sizeof({name}): {}", size_of::<T>(), name = T::NAME);
        return Err(Failure::argument(text));
    }
    Ok(size)
}

/// Reads options; null is the default of each. What a newer program asks for beyond what this library has must be zeros.
pub(crate) unsafe fn options<T: Growing>(from: *const T) -> Result<T, Failure> {
    let mut options = zeroed::<T>();
    if from.is_null() {
        return Ok(options);
    }
    // SAFETY: not null.
    let size = unsafe { size_of_theirs(from) }?;
    let (known, bytes) = (size.min(size_of::<T>()), from.cast::<u8>());
    // SAFETY: the caller's struct has `size` bytes, ours at least `known`.
    unsafe { std::ptr::copy_nonoverlapping(bytes, (&raw mut options).cast(), known) };
    // SAFETY: bytes of the caller's struct.
    let asks_more = (known..size).any(|at| unsafe { bytes.add(at).read() } != 0);
    if asks_more {
        let text = format!(
            "{} sets a field that this version ({}) does not have; install the library that the program was built with",
            T::NAME,
            env!("CARGO_PKG_VERSION")
        );
        return Err(Failure::argument(text));
    }
    Ok(options)
}

/// A caller's struct to be filled: as much of it as both know.
pub(crate) struct Fill<T> {
    to: *mut T,
    size: usize,
}

impl<T: Growing> Fill<T> {
    /// Looked at before anything is done, so that nothing is done for nothing.
    pub(crate) unsafe fn new(to: *mut T) -> Result<Self, Failure> {
        if to.is_null() {
            return Err(Failure::argument(format!("{} is null, expected a place for one", T::NAME)));
        }
        // SAFETY: not null.
        Ok(Self { to, size: unsafe { size_of_theirs(to) }? })
    }

    /// All but the size, which is the caller's; what only the caller knows is zeros.
    pub(crate) fn with(self, value: &T) {
        let (first, known) = (size_of::<usize>(), self.size.min(size_of::<T>()));
        let (to, from) = (self.to.cast::<u8>(), (&raw const *value).cast::<u8>());
        // SAFETY: both hold that many bytes; the caller's is no place of ours.
        unsafe { std::ptr::copy_nonoverlapping(from.add(first), to.add(first), known - first) };
        // SAFETY: the rest of the caller's struct.
        unsafe { to.add(known).write_bytes(0, self.size - known) };
    }
}

/// Threads that are started in here take no signal: those are the program's own.
pub(crate) fn without_signals<R>(work: impl FnOnce() -> R) -> R {
    let mut all = MaybeUninit::uninit();
    let mut before = MaybeUninit::uninit();
    // SAFETY: both are places for a set; faults of a thread itself stay as they are.
    unsafe {
        libc::sigfillset(all.as_mut_ptr());
        for own in [libc::SIGSEGV, libc::SIGBUS, libc::SIGFPE, libc::SIGILL, libc::SIGTRAP] {
            libc::sigdelset(all.as_mut_ptr(), own);
        }
    }
    // SAFETY: both are sets, the first filled above.
    let blocked = unsafe { libc::pthread_sigmask(libc::SIG_SETMASK, all.as_ptr(), before.as_mut_ptr()) } == 0;
    let result = catch_unwind(AssertUnwindSafe(work));
    if blocked {
        // SAFETY: the set that was there before.
        unsafe { libc::pthread_sigmask(libc::SIG_SETMASK, before.as_ptr(), std::ptr::null_mut()) };
    }
    result.unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}
