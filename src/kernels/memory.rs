//! How the system's allocator treats large blocks.

/// Lets freed memory stay with the program. An update frees and takes the same large blocks over and over, and the system would map and
/// clear them anew each time. Knows glibc; elsewhere it does nothing.
pub fn keep_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: this only sets two numbers of the allocator.
    unsafe {
        libc::mallopt(libc::M_MMAP_MAX, 0);
        libc::mallopt(libc::M_TRIM_THRESHOLD, i32::MAX);
    }
}
