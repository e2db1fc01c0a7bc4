//! From a folder of photos to the traits of its plots, stage by stage.
//!
//! ```sh
//! cargo run --release --example photos_to_plants -- field
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram::pipeline::{
    Project, align::align, dem::dem, leaves::leaves, locate::locate, ortho::ortho, plots, segment,
};
use rowgram::{Error, monitor::Collector};
use std::path::Path;

/// Orients the photos, maps the field, finds leaves and plants, and measures the plots. Every stage is kept while nothing
/// that it came from changes; its files are in the folder `rowgram` of the project.
pub fn traits(folder: &Path) -> Result<plots::PlotsOutcome, Error> {
    let project = Project::open(folder)?;
    let (config, mut found) = (project.config(), Collector::default());
    let block = align(&project, &config.align, &mut found)?;
    println!("{} of {} photos oriented", block.registered, block.images);
    dem(&project, &config.dem, &mut found)?;
    let map = ortho(&project, &config.ortho, &mut found)?;
    println!("orthomosaic of {:.2} cm per pixel", 100.0 * map.mosaic.gsd_m);
    segment::segment(&project, &config.segment, &mut found)?;
    let plants = locate(&project, &config.locate, &mut found)?;
    println!("{} plants in {} rows", plants.plants, plants.rows);
    leaves(&project, &config.leaves, &mut found)?;
    let traits = plots::plots(&project, &config.plots, &mut found)?;
    found.diagnostics.iter().for_each(|found| println!("{}: {found}", found.severity.word()));
    Ok(traits)
}

fn main() -> Result<(), Error> {
    let folder = std::env::args().nth(1).unwrap_or_else(|| ".".to_owned());
    traits(Path::new(&folder))?.plots.iter().for_each(|plot| println!("{plot:?}"));
    Ok(())
}
