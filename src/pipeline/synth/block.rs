//! Measurements of a nadir aerial block as BAL files.

use crate::{error::Error, io::output};
use data_synth::block::{Block, BlockConfig, write_bal};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// What a block holds.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct BlockOutcome {
    /// Number of images.
    pub images: usize,
    /// Number of ground points.
    pub points: usize,
    /// Number of measured image positions.
    pub observations: usize,
}

/// Writes the measurements with their start values to `path` and, where asked, with the true values to `truth`.
///
/// # Errors
/// A parameter that cannot be used, a file that exists unless `force`, the same file twice, and writing.
pub fn write_block(
    config: &BlockConfig,
    path: &Path,
    truth: Option<&Path>,
    force: bool,
) -> Result<BlockOutcome, Error> {
    config.check()?;
    output::check(path, force)?;
    if let Some(truth) = truth {
        output::check(truth, force)?;
        if truth == path {
            return Err(Error::Argument("--truth: expected another file than --output".into()));
        }
    }
    let block = Block::fly(config)?;
    output::write(path, force, |out| {
        write_bal(&block.cameras_start, &block.points_start, &block.observations, out)
    })?;
    if let Some(truth) = truth {
        output::write(truth, force, |out| {
            write_bal(&block.cameras_true, &block.points_true, &block.observations, out)
        })?;
    }
    Ok(BlockOutcome {
        images: block.cameras_true.len(),
        points: block.points_true.len(),
        observations: block.observations.len(),
    })
}
