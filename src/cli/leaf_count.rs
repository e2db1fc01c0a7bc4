//! `rowgram leaves count`: leaves from the area that they cover.

use super::{
    options::{Given, HsvOptions},
    stage::{Target, check_paths, given},
};
use rowgram_base::error::Error;
use rowgram_project::{
    Stage,
    leaf_count::{Areas, LeafCountOptions, LeafCountOutcome, count_leaves, leaf_count},
    leaf_mask::read_leaf_mask,
};
use std::path::PathBuf;

/// Count leaves from the area that they cover
///
/// Leaves are leaf pixels over leaf pixels per leaf (rho). Rho is given, or comes from regions in which leaves were counted
/// by hand (polygons with the property "leaves"). With three regions or more the interval of 95 % tells how well they agree;
/// else how unevenly the plot is covered.
///
/// Of a project, the leaf mask, regions and plots are taken. A single file is a mask (two values), or a photo or orthomosaic,
/// of which --hsv makes one; polygons are in the raster's CRS, or in pixels where it has none. In a photo in perspective
/// leaves far from the camera are smaller and the count is biased: use an orthomosaic.
///
/// Example: rowgram leaves count field
/// Example: rowgram leaves count ortho.tif --plots plots.geojson --output leaves.csv
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    #[command(flatten)]
    target: Target,
    #[command(flatten)]
    options: Given<LeafCountOptions>,
    #[command(flatten)]
    hsv: Given<HsvOptions>,
    /// Of a single file: regions with counted leaves (GeoJSON, GeoPackage or shapefile; polygons with the property "leaves").
    #[arg(long, value_name = "FILE")]
    regions: Option<PathBuf>,
    /// Of a single file: also count in each of these plots (GeoJSON, GeoPackage or shapefile).
    #[arg(long, value_name = "FILE")]
    plots: Option<PathBuf>,
}

fn text(outcome: &LeafCountOutcome) -> String {
    let mut text = format!("{:.2} leaf pixels per leaf", outcome.rho_px);
    for line in &outcome.counts {
        let count = &line.count;
        text += &format!("\n{}: {:.1} leaves", line.plot, count.leaves);
        if let Some(interval) = count.interval {
            text += &format!(" ({:.1} to {:.1})", interval.low, interval.high);
        }
    }
    text
}

/// Runs the command.
///
/// # Errors
/// As [`count_leaves`] and the stage.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let Args { target, options, hsv, regions, plots } = args;
    if target.is_project() {
        target.refuse_of_files(&[
            ("--regions", regions.is_some()),
            ("--plots", plots.is_some()),
            ("--hsv", hsv.has("hsv")),
        ])?;
        return target.perform(
            (Stage::LeafCount, leaf_count),
            options,
            |config| &config.leaf_count,
            text,
        );
    }
    if regions.is_some() && options.has("rho_px") {
        return Err(Error::Argument("--regions and --rho-px exclude each other".to_owned()));
    }
    let output = target.file()?;
    let inputs = given([Some(target.input()), regions.as_deref(), plots.as_deref()]);
    check_paths(&[output], &inputs, target.force)?;
    let (options, hsv) = (options.over_defaults()?, hsv.over_defaults()?.hsv);
    let areas = Areas { regions: regions.clone(), plots: plots.clone(), plot_key: None };
    let subject = target.input().display().to_string();
    target.present(
        |monitor| {
            let (source, leaf) = read_leaf_mask(target.input(), hsv, monitor)?;
            let place = source.georeference();
            let outcome = count_leaves(&leaf, place, &areas, &options, &subject, monitor)?;
            outcome.write(output, target.force)?;
            Ok(outcome)
        },
        text,
    )
}
