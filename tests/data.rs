//! Where the real data lies, for the tests that can use it.
//!
//! The data is not part of the project. A test that needs it says so and passes where it is
//! missing; `ROWGRAM_DATA` names another place.

#![allow(clippy::print_stderr, dead_code, reason = "tests speak on stderr")]

use std::path::PathBuf;

/// The path of `name` inside the data folder, or `None` with a printed reason.
pub(crate) fn path(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("ROWGRAM_DATA").map_or_else(
        || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        PathBuf::from,
    );
    let path = root.join(name);
    if path.exists() {
        Some(path)
    } else {
        eprintln!("skipped: {} is not here (set ROWGRAM_DATA to the data folder)", path.display());
        None
    }
}
