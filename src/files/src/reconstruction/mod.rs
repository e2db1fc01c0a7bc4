//! Our own file of a reconstruction: everything, exactly.
//!
//! | file | content |
//! |---|---|
//! | `reconstruction.json` | reference frame, cameras, images, ground points, their image measurements, camera positions, scale bars, accuracies, what was excluded |
//! | `tie_points.csv` | `point,x_m,y_m,z_m,red,green,blue` and, after an adjustment, `sigma_x_m,sigma_y_m,sigma_z_m` |
//! | `tie_observations.csv` | `image,point,u_px,v_px` |
//!
//! Numbers have as many digits as it takes to read back the very same ones. Image positions are pixels with the centre of
//! the top-left pixel at (0, 0); a pose is `P = R(q) X + t` with the camera frame x right, y up, looking along -z, the
//! quaternion scalar first. Cameras are given by the names of their lens model's parameters, with what is known of them
//! beforehand (`standard_deviations` about `expected`); what an adjustment found is under `accuracy`.

mod document;
mod ties;

use super::{FileError, output};
use document::Document;
use rowgram_survey::scene::Reconstruction;
use std::{
    fs::File,
    io::Read,
    path::{Path, PathBuf},
};

/// Name of the file in a folder of results.
pub const NAME: &str = "reconstruction.json";
/// What `format` says in such a file.
const FORMAT: &str = "rowgram reconstruction";
/// Raised whenever the form changes.
const VERSION: u32 = 1;

/// Name of the table of tie points beside it.
pub const POINTS: &str = "tie_points.csv";
const OBSERVATIONS: &str = "tie_observations.csv";

/// The file that a path names: itself, or `reconstruction.json` in a folder.
fn file_of(path: &Path) -> PathBuf {
    if path.is_dir() { path.join(NAME) } else { path.to_owned() }
}

/// Whether a path is such a file, or a folder with one.
pub fn is_one(path: &Path) -> bool {
    let mut head = Vec::new();
    let read = File::open(file_of(path)).and_then(|file| file.take(400).read_to_end(&mut head));
    read.is_ok() && String::from_utf8_lossy(&head).contains(FORMAT)
}

/// Reads a reconstruction: `path` is its `reconstruction.json` or the folder that holds it.
///
/// # Errors
/// Names the file, the line, the key and what was expected; a table that does not have as many rows as
/// `reconstruction.json` says.
pub fn read(path: &Path) -> Result<Reconstruction, FileError> {
    let path = file_of(path);
    let text = crate::memory::read_text(&path)?;
    let document: Document = serde_json::from_str(&text)
        .map_err(|error| FileError::malformed(&path, error.line(), message(&text, &error)))?;
    let wrong = |why: String| FileError::malformed(&path, None, why);
    if document.format != FORMAT {
        return Err(wrong(format!("format is {:?}, expected {FORMAT:?}", document.format)));
    }
    if document.version != VERSION {
        return Err(wrong(format!(
            "version is {}, this program reads version {VERSION}; make the file again with rowgram align",
            document.version
        )));
    }
    let counts = (document.tie_point_count, document.tie_observation_count);
    let mut scene = document.scene().map_err(wrong)?;
    let beside = |name: &str| path.with_file_name(name);
    ties::read_points(&beside(POINTS), counts.0, &mut scene)?;
    ties::read_observations(&beside(OBSERVATIONS), counts.1, &mut scene)?;
    Ok(scene)
}

/// Writes a reconstruction: `path` is its `reconstruction.json` or the folder that is to hold it; the tables go beside.
///
/// # Errors
/// As [`output::write`]; numbers that are not finite, names or numbers that are there twice, indices of nothing.
pub fn write(path: &Path, scene: &Reconstruction, force: bool) -> Result<(), FileError> {
    let path = file_of(path);
    let beside = |name: &str| path.with_file_name(name);
    let (points, observations) = (beside(POINTS), beside(OBSERVATIONS));
    [&path, &points, &observations].into_iter().try_for_each(|file| output::check(file, force))?;
    let refused = |why: String| {
        FileError::write(&path, std::io::Error::new(std::io::ErrorKind::InvalidData, why))
    };
    ties::check(scene).map_err(refused)?;
    let text = Document::of(scene).and_then(|document| document.text()).map_err(refused)?;
    ties::write_points(&points, scene, force)?;
    ties::write_observations(&observations, scene, force)?;
    output::write(&path, force, |out| out.write_all(text.as_bytes()))
}

/// What serde says, without the place that is told apart, with the key at it.
fn message(text: &str, error: &serde_json::Error) -> String {
    let said = error.to_string();
    let what = said.rsplit_once(" at line ").map_or(said.as_str(), |(what, _)| what);
    let before: usize =
        text.split_inclusive('\n').take(error.line().saturating_sub(1)).map(str::len).sum();
    let at = (before + error.column()).min(text.len());
    // The last key before the place: a name in quotes with a colon after it.
    let key = text.get(..at).and_then(|read| {
        let (head, _) = read.rsplit_once("\":")?;
        head.rsplit_once('"').map(|(_, key)| key)
    });
    match key {
        Some(key) => format!("at {key:?}: {what}"),
        None => what.to_owned(),
    }
}

#[cfg(test)]
mod tests;
