//! `camera.toml`: a camera's description ([`crate::camera::Camera`]).

use super::{FileError, output};
use crate::camera::Camera;
use std::path::Path;

/// Reads a camera.
///
/// # Errors
/// Where the file cannot be read or is no such description; names the key.
pub fn read(path: &Path) -> Result<Camera, FileError> {
    let text = std::fs::read_to_string(path).map_err(|e| FileError::read(path, e))?;
    Camera::from_toml(&text).map_err(|e| FileError::malformed(path, None, e.to_string()))
}

/// Writes a camera.
///
/// # Errors
/// As [`output::write`].
pub fn write(path: &Path, camera: &Camera, force: bool) -> Result<(), FileError> {
    output::write(path, force, |out| out.write_all(camera.to_toml().as_bytes()))
}
