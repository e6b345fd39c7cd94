/// Keeps what is freed for the next tensors, instead of giving it back to the system. An update makes and frees gigabytes of tensors
/// that are all alike from one update to the next; glibc maps and unmaps the larger ones each time, and the kernel clears every page
/// again (an update of the paper's size had 700 000 page faults, which took a quarter of the actor's backward pass).
///
/// The process then stays as large as it once was. Elsewhere than on glibc this does nothing.
///
/// Call it first in `main`, before any thread is started.
pub fn keep_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        /// Asked from the system at once.
        const TOP_PAD_BYTES: libc::c_int = 64 << 20;
        // -1 means never. Other threads' arenas hold no blocks beyond 64 MB, which are mapped after all; a single arena would hold them, but then
        // the threads wait for each other at every small tensor of the scan, which costs more.
        let options = [(libc::M_MMAP_MAX, 0), (libc::M_TRIM_THRESHOLD, -1), (libc::M_TOP_PAD, TOP_PAD_BYTES)];
        for (option, value) in options {
            // SAFETY: `mallopt` takes any numbers; what it does not know it refuses, and then nothing changes.
            unsafe { libc::mallopt(option, value) };
        }
    }
}

/// Gives what was freed and kept back to the system once.
pub fn return_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: `malloc_trim` touches free memory only, and takes the allocator's locks.
    unsafe {
        libc::malloc_trim(0)
    };
}
