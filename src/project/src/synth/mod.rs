//! Synthetic data with the whole truth, as files: a field from straight above, an orthomosaic of five bands of it, a flight over it, the measurements of a
//! block, a small project that has everything, and a season of flights.
//!
//! What exists and how it looks is `data-synth`'s; here it becomes the files that the other stages read.

mod block;
mod field;
mod flight;
mod map;
mod project;
mod season;

pub use block::{BlockOutcome, BlockPreset, BlockSource, write_block};
pub use field::{FieldOutcome, write_field};
pub use flight::{FlightOptions, FlightOutcome, write_flight};
pub use map::{MapOptions, MapOutcome, MapSamples, write_map};
pub use project::{BOARD_PHOTOS, SynthesisOutcome, synthesize};
pub use season::{SeasonSynthesis, write_season};

use data_synth::ConfigError;
use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use rowgram_base::error::Error;
use rowgram_optim::output::FileError;
use std::{io::Write, path::Path};

/// A configuration that cannot be made.
fn refused(error: ConfigError) -> Error {
    Error::Argument(error.to_string())
}

/// Reads a configuration such as `field.toml`; what is left out has its default.
///
/// # Errors
/// A file that cannot be read, or that is not such a configuration: in which line.
pub fn read_config<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, FileError> {
    let text = rowgram_files::read_text(path)?;
    toml::from_str(&text).map_err(|error| {
        let before = error.span().and_then(|span| text.get(..span.start));
        let line = before.map(|before| before.matches('\n').count() + 1);
        FileError::malformed(path, line, error.message())
    })
}

/// A configuration as the text of its file.
fn config_text(config: &impl serde::Serialize) -> Result<String, Error> {
    toml::to_string(config).map_err(|error| Error::Argument(error.to_string()))
}

fn encode_png(
    out: &mut dyn Write,
    pixels: &[u8],
    (width, height): (u32, u32),
    colour: ExtendedColorType,
) -> std::io::Result<()> {
    PngEncoder::new(out).write_image(pixels, width, height, colour).map_err(std::io::Error::other)
}
