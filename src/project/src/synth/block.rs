//! Measurements of aerial blocks and photo collections as BAL files.

use super::refused;
use data_synth::{
    block::{Block, BlockConfig, write_bal},
    collection::{CollectionConfig, CollectionPreset},
};
use rowgram_base::error::Error;
use rowgram_optim::output;
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

/// What is measured.
#[derive(Debug, Clone, PartialEq)]
pub enum BlockSource {
    /// A nadir flight.
    Flight(BlockConfig),
    /// Photos of places or of a street.
    Collection(CollectionConfig),
}

/// A named size of a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BlockPreset {
    /// 1,723 images along a street: 156,502 points, 678,718 measurements.
    #[serde(rename = "ladybug-1723")]
    Ladybug1723,
    /// 257 photos of a square: 65,132 points, 225,911 measurements.
    #[serde(rename = "trafalgar-257")]
    Trafalgar257,
    /// 356 photos of a town: 226,730 points, 1,255,268 measurements.
    #[serde(rename = "dubrovnik-356")]
    Dubrovnik356,
    /// 1,778 photos of a city: 993,923 points, 5,001,946 measurements.
    #[serde(rename = "venice-1778")]
    Venice1778,
    /// A nadir flight of 5,000 images and a million points.
    #[serde(rename = "flight-5000")]
    Flight5000,
    /// A nadir flight of 15,000 images and three million points.
    #[serde(rename = "flight-15000")]
    Flight15000,
}

rowgram_base::choices!(BlockPreset: Ladybug1723, Trafalgar257, Dubrovnik356, Venice1778, Flight5000, Flight15000);

impl BlockSource {
    /// What a named size stands for.
    pub fn preset(preset: BlockPreset) -> BlockSource {
        let collection = |preset| BlockSource::Collection(CollectionConfig::preset(preset));
        let flight = |images| {
            BlockSource::Flight(BlockConfig {
                images,
                points: 200 * images,
                ..BlockConfig::default()
            })
        };
        match preset {
            BlockPreset::Ladybug1723 => collection(CollectionPreset::Ladybug1723),
            BlockPreset::Trafalgar257 => collection(CollectionPreset::Trafalgar257),
            BlockPreset::Dubrovnik356 => collection(CollectionPreset::Dubrovnik356),
            BlockPreset::Venice1778 => collection(CollectionPreset::Venice1778),
            BlockPreset::Flight5000 => flight(5_000),
            BlockPreset::Flight15000 => flight(15_000),
        }
    }

    fn check(&self) -> Result<(), Error> {
        match self {
            BlockSource::Flight(config) => config.check().map_err(refused)?,
            BlockSource::Collection(config) => config.check().map_err(refused)?,
        }
        Ok(())
    }

    fn measure(&self) -> Result<Block, Error> {
        Ok(match self {
            BlockSource::Flight(config) => Block::fly(config).map_err(refused)?,
            BlockSource::Collection(config) => config.photograph().map_err(refused)?,
        })
    }
}

/// Writes the measurements with their start values to `path` and, where asked, with the true values to `truth`.
///
/// # Errors
/// A parameter that cannot be used, a file that exists unless `force`, the same file twice, and writing.
pub fn write_block(
    source: &BlockSource,
    path: &Path,
    truth: Option<&Path>,
    force: bool,
) -> Result<BlockOutcome, Error> {
    source.check()?;
    output::check(path, force)?;
    if let Some(truth) = truth {
        output::check(truth, force)?;
        if truth == path {
            return Err(Error::Argument("--truth: expected another file than --output".into()));
        }
    }
    let block = source.measure()?;
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
