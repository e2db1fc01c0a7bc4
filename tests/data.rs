//! Real data for the tests that can use it.
//!
//! The data is not part of the project. `ROWGRAM_DATA` names its folder. A test whose data is missing is listed as
//! skipped on stderr; with `ROWGRAM_TEST_DATA=required` it fails. Programs that tests drive are asked for by
//! `ROWGRAM_TEST_TOOLS=required`.

#![allow(dead_code, reason = "some test programs use only a part")]

use std::{io::Write, path::PathBuf};

/// The path of `name` inside the data folder; `None` where it is missing, which is reported.
pub(crate) fn path(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("ROWGRAM_DATA").map(PathBuf::from);
    if let Some(path) = root.as_ref().map(|root| root.join(name)).filter(|path| path.exists()) {
        return Some(path);
    }
    let required = std::env::var("ROWGRAM_TEST_DATA").is_ok_and(|value| value == "required");
    let place =
        root.map_or("ROWGRAM_DATA is not set".to_owned(), |root| root.display().to_string());
    assert!(!required, "{name} is missing from the data folder ({place}), and it is required");
    let thread = std::thread::current();
    let test = thread.name().unwrap_or("a test");
    // Straight to stderr: the test harness holds back what `eprintln!` of a test that passes says.
    let _ = writeln!(std::io::stderr(), "skipped: {test} needs {name} ({place})");
    None
}

/// Says that a test leaves something out because this program is not here; fails where `ROWGRAM_TEST_TOOLS=required`.
pub(crate) fn tool_is_missing(tool: &str) {
    let required = std::env::var("ROWGRAM_TEST_TOOLS").is_ok_and(|value| value == "required");
    assert!(!required, "{tool} is not installed, and it is required");
    let _ = writeln!(std::io::stderr(), "skipped: what needs {tool}, which is not installed");
}
