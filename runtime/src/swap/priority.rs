//! The desk's thread gives way to everything else.

/// Gives the calling thread the lowest ordinary priority, whatever it inherited: a controller that runs under SCHED_FIFO hands
/// that on to the threads it starts. Gives what the system said where it refused.
///
/// Not SCHED_IDLE: this thread shares the allocator's locks with the one that ticks, and must not be stopped for long while it
/// holds one.
pub(super) fn lower() -> std::io::Result<()> {
    let parameters = libc::sched_param { sched_priority: 0 };
    // SAFETY: 0 is the calling thread; the parameters are read during the call only.
    if unsafe { libc::sched_setscheduler(0, libc::SCHED_BATCH, &parameters) } != 0 {
        return Err(std::io::Error::last_os_error());
    }
    // On Linux this is the calling thread's alone.
    Ok(rustix::process::setpriority_process(None, 19)?)
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_thread_that_asks_gets_the_lowest_priority_and_no_other() {
        let of_thread = || rustix::process::getpriority_process(None).unwrap();
        let before = of_thread();
        let lowered = std::thread::spawn(move || {
            super::lower().unwrap();
            of_thread()
        });
        assert_eq!(lowered.join().unwrap(), 19);
        assert_eq!(of_thread(), before);
    }
}
