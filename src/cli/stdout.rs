//! What a verb says on stdout: one line of JSON for a machine, or text for a person.

use crate::error::Error;
use serde::Serialize;
use std::io::{ErrorKind, Write};

/// Prints one line of JSON.
///
/// # Errors
/// Where stdout cannot be written.
pub(super) fn json(value: &impl Serialize) -> Result<(), Error> {
    let line = serde_json::to_string(value);
    line.map_err(|error| failed(error.into())).and_then(|line| text(&line))
}

/// Prints text and ends the line.
///
/// A reader that has heard enough and closed the pipe is no failure.
///
/// # Errors
/// Where stdout cannot be written.
pub(super) fn text(value: &impl std::fmt::Display) -> Result<(), Error> {
    let mut out = std::io::stdout().lock();
    match writeln!(out, "{value}").and_then(|()| out.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(failed(error)),
        _ => Ok(()),
    }
}

fn failed(source: std::io::Error) -> Error {
    crate::io::FileError::write("stdout".as_ref(), source).into()
}
