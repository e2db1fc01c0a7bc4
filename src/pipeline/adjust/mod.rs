//! Reports of adjustments: a summary for people, a report for machines, tables, pictures, cameras.

mod figures;
mod report;
mod tables;

pub use report::{Report, summary};

use crate::{
    error::Error,
    io::output,
    monitor::Diagnostic,
    problems::adjustment::{Adjusted, Alignment, LeaveOneOut, Removed, Settings},
    scene::{Excluded, Reconstruction},
    sfm::adjust_block::AdjustedBlock,
};
use std::path::Path;

/// Everything that came of an adjustment.
#[derive(Debug)]
pub struct Adjustment {
    /// The adjusted block and its statistics.
    pub adjusted: Adjusted,
    /// How it was adjusted.
    pub settings: Settings,
    /// How the block came into the frame of what is known of it.
    pub alignment: Option<Alignment>,
    /// Observations that were removed.
    pub removed: Vec<Removed>,
    /// Rows of files that no image or point of the block belongs to.
    pub unmatched: Vec<Excluded>,
    /// Every control point as the block without it sees it, where that was asked for.
    pub left_out: Vec<LeaveOneOut>,
    /// Whether nothing is suspect any more.
    pub complete: bool,
}

impl Adjustment {
    /// That of a block of photos.
    pub(super) fn of_block(block: AdjustedBlock) -> Adjustment {
        Adjustment {
            adjusted: block.adjusted,
            settings: block.settings,
            alignment: block.alignment,
            removed: block.removed,
            unmatched: Vec::new(),
            left_out: Vec::new(),
            complete: block.complete,
        }
    }

    /// What took part, adjusted, with its accuracies and what was excluded.
    pub fn reconstruction(&self) -> Reconstruction {
        let adjusted = &self.adjusted;
        let mut scene = adjusted.reconstruction.clone();
        scene.accuracy = Some(adjusted.accuracy());
        scene.excluded.extend(self.unmatched.iter().cloned());
        scene.excluded.extend(adjusted.validated.excluded.iter().cloned());
        scene.excluded.extend(self.removed.iter().map(Removed::excluded));
        scene
    }

    /// Whether it has converged and nothing is suspect any more.
    pub fn converged(&self) -> bool {
        self.complete && self.adjusted.converged()
    }
}

/// What is said where it has not.
pub fn not_converged() -> Diagnostic {
    let message = "the adjustment did not converge, or suspect observations are left";
    Diagnostic::error("not-converged", "adjustment", message)
        .with_remedy("look at the report before using its results")
}

/// Writes the report of a stage: tables into `report/` of its folder, pictures into `figures/`.
///
/// # Errors
/// Where a folder cannot be made or a file cannot be written.
pub(super) fn write_report(folder: &Path, adjustment: &Adjustment) -> Result<(), Error> {
    report::write((&folder.join("report"), &folder.join("figures")), adjustment, true)
}

/// Writes the report into one folder.
///
/// # Errors
/// As [`output::write`].
pub fn write(folder: &Path, adjustment: &Adjustment, force: bool) -> Result<(), Error> {
    report::write((folder, folder), adjustment, force)
}

/// Writes text atomically.
fn write_text(path: &Path, text: &str, force: bool) -> Result<(), Error> {
    output::write(path, force, |out| out.write_all(text.as_bytes()))?;
    Ok(())
}
