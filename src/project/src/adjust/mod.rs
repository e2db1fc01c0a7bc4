//! Bundle adjustment of blocks that are given as files, and the reports of adjustments: a summary for people, a report for
//! machines, tables, pictures, cameras.

mod block;
mod figures;
mod network;
mod options;
mod report;
mod tables;

pub use network::NetworkOutcome;
pub use options::{AdjustOptions, DatumChoice, NetworkOptions, SnoopingChoice, read_block};
#[cfg(feature = "report")]
pub(crate) use report::Ground;
pub use report::{Report, summary, write};

use crate::convert::Format;
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
    options::Options,
};
use rowgram_survey::{
    problems::adjustment::{Adjusted, Alignment, LeaveOneOut, Removed, Settings},
    scene::{Excluded, Reconstruction},
    sfm::adjust_block::AdjustedBlock,
};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// What is written beside the report, and what a run of a BAL file goes on from.
#[derive(Debug, Clone, Default)]
pub struct Outputs {
    /// The adjusted block.
    pub output: Option<PathBuf>,
    /// Of a BAL file: a line per iteration, CSV.
    pub trace: Option<PathBuf>,
    /// Of a BAL file: how the cost fell, SVG.
    pub figure: Option<PathBuf>,
    /// Of a BAL file: a checkpoint, and the iterations between two of them.
    pub checkpoint: Option<(PathBuf, u64)>,
    /// Of a BAL file: the checkpoint to go on from.
    pub resume: Option<PathBuf>,
    /// Whether files that exist are replaced.
    pub force: bool,
}

/// What came of the adjustment of a file.
#[derive(Debug, Serialize)]
#[serde(untagged)]
pub enum AdjustOutcome {
    /// Of a block with names: the report for a machine.
    Block(Box<Report>),
    /// Of a BAL file.
    Network(Box<NetworkOutcome>),
}

impl std::fmt::Display for AdjustOutcome {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            AdjustOutcome::Block(report) => f.write_str(&summary(report)),
            AdjustOutcome::Network(outcome) => outcome.fmt(f),
        }
    }
}

/// Adjusts the block of a file: a BAL file, a COLMAP folder, `bundle.out`, or a `reconstruction.json` of OpenSfM or
/// rowgram; [`read_block`] tells the file of a `block.toml`.
///
/// # Errors
/// Options of another kind of block, bad input, outputs that exist, a block that is not determined.
pub fn adjust(
    file: &Path,
    options: &AdjustOptions,
    outputs: &Outputs,
    monitor: &mut dyn Monitor,
) -> Result<AdjustOutcome, Error> {
    options.validate().map_err(Error::Argument)?;
    let is_network = file.is_file() && Format::of(file).is_none();
    if let Some(name) = options.foreign(is_network) {
        let (kind, why) = match is_network {
            true => ("a BAL file", "it has no names to join control to"),
            false => ("not a BAL file", "only those are solved with it"),
        };
        return Err(Error::Argument(format!("{name}: {} is {kind}; {why}", file.display())));
    }
    if is_network {
        let outcome = network::adjust_network(file, options, outputs, monitor)?;
        return Ok(AdjustOutcome::Network(Box::new(outcome)));
    }
    let of_networks = [
        ("a trace", outputs.trace.is_some()),
        ("a figure of the cost", outputs.figure.is_some()),
        ("a checkpoint", outputs.checkpoint.is_some() || outputs.resume.is_some()),
    ];
    if let Some((what, _)) = of_networks.into_iter().find(|(_, wanted)| *wanted) {
        let file = file.display();
        return Err(Error::Argument(format!("{file}: {what} is there for BAL files only")));
    }
    let adjustment = block::adjust_block(file, options, outputs, monitor)?;
    Ok(AdjustOutcome::Block(Box::new(Report::new(&adjustment))))
}

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
    /// The check points whose errors are summed up; all of them where not set.
    pub checks: Option<Vec<String>>,
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
            checks: Some(block.checks),
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
