//! A field from straight above: leaf mask, picture, true plants.

use super::refused;
use super::{config_text, encode_png};
use data_synth::{field::Field, scenario::Scenario};
use image::ExtendedColorType;
use rowgram_base::error::Error;
use rowgram_optim::output::{self, FileError};
use serde::{Deserialize, Serialize};
use std::{io::Write, path::Path};

/// What a field from straight above holds.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FieldOutcome {
    /// Number of plants.
    pub plants: usize,
    /// `[width, height]` of mask and picture, pixels.
    pub size_px: [u32; 2],
    /// Pixels of the mask that show leaf.
    pub leaf_pixels: usize,
}

/// The files of a field from straight above.
const FILES: [&str; 4] = ["mask.png", "picture.png", "plants.csv", "field.toml"];

/// Writes `mask.png` (255 leaf, 0 other), `picture.png`, `plants.csv` (`u_px,v_px,row,x_m,y_m`) and `field.toml` (every
/// parameter) into a folder, which is made if missing.
///
/// # Errors
/// A parameter that cannot be used, a file that exists unless `force`, and writing.
pub fn write_field(scenario: &Scenario, folder: &Path, force: bool) -> Result<FieldOutcome, Error> {
    scenario.check().map_err(refused)?;
    let config = config_text(scenario)?;
    std::fs::create_dir_all(folder).map_err(|source| FileError::write(folder, source))?;
    let [mask_path, picture_path, plants_path, config_path] = FILES.map(|name| folder.join(name));
    for path in [&mask_path, &picture_path, &plants_path, &config_path] {
        output::check(path, force)?;
    }
    let scene = scenario.build().map_err(refused)?;
    let (mask, picture) = scene.mask_and_picture();
    let size = mask.dimensions();
    output::write(&mask_path, force, |out| {
        encode_png(out, mask.as_raw(), size, ExtendedColorType::L8)
    })?;
    output::write(&picture_path, force, |out| {
        encode_png(out, picture.as_raw(), size, ExtendedColorType::Rgb8)
    })?;
    output::write(&plants_path, force, |out| write_plants(&scene.field, out))?;
    output::write(&config_path, force, |out| out.write_all(config.as_bytes()))?;
    Ok(FieldOutcome {
        plants: scene.field.plants.len(),
        size_px: [size.0, size.1],
        leaf_pixels: mask.iter().filter(|&&pixel| pixel != 0).count(),
    })
}

fn write_plants(field: &Field, out: &mut dyn Write) -> std::io::Result<()> {
    writeln!(out, "u_px,v_px,row,x_m,y_m")?;
    for plant in &field.plants {
        writeln!(
            out,
            "{:.4},{:.4},{},{:.5},{:.5}",
            plant.u_px, plant.v_px, plant.row, plant.x_m, plant.y_m
        )?;
    }
    Ok(())
}
