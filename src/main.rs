//! The `rowgram` program; everything it does is in [`rowgram::cli`].

fn main() -> std::process::ExitCode {
    give_back_freed_memory();
    rowgram::cli::main()
}

/// Has the allocator of glibc map all large memory by itself, so that it goes back to the system when it is freed. Without it the size from
/// which memory is mapped grows to that of the largest mapping ever freed; descriptors and photos then lie among what stays, and an
/// alignment of 252 photos ends with 480 instead of 250 MB. Half a megabyte is less than the descriptors of a photo.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn give_back_freed_memory() {
    const MAPPED_FROM_BYTES: std::ffi::c_int = 512 << 10;
    // SAFETY: sets a number of the allocator; no other thread is there yet.
    #[expect(unsafe_code, reason = "no crate has a safe call of this function")]
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, MAPPED_FROM_BYTES);
    }
}

#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
fn give_back_freed_memory() {}
