//! `rowgram plots layout`: plots from corners and a design, or from polygons, moved onto the rows of a project.

use crate::cli::{
    options::Given,
    project::{open, present},
};
use rowgram_base::error::Error;
use rowgram_project::plots::layout::{
    LayoutOptions, LayoutOutcome, LayoutRequest, LayoutSource, layout,
};
use std::path::{Path, PathBuf};

/// Lay out the plots of a field, and move them onto the rows that were found
///
/// From a table of two to four surveyed corners (columns corner: first, along, across, opposite; easting_m, northing_m or
/// longitude_deg, latitude_deg) and the design of the field come the plots as plots.gpkg, plots.geojson and plots.shp,
/// before any photo is taken. "first" is the outer corner of the first plot, "along" lies from there along the rows,
/// "across" across them. With a PROJECT whose plants were located, shift, rotation, stretch and bend of the layout are
/// estimated from its rows and their ends, with standard deviations (layout.csv, layout.json) and a picture
/// (figures/layout.png). Polygons that are there (--refine) are moved the same way. A field map joins genotype, treatment and
/// block to the plots.
///
/// Example: rowgram plots layout field --corners corners.csv --row-spacing-m 0.76 -o plots
/// Example: rowgram plots layout field --corners corners.csv --field-map field_map.csv -o field
/// Example: rowgram plots layout field --refine field/drawn.geojson -o field
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    /// Folder of the project whose rows the layout is moved onto; also its [layout] options.
    project: Option<PathBuf>,
    /// Surveyed corners of the field (CSV).
    #[arg(long, value_name = "CSV", required_unless_present = "refine")]
    corners: Option<PathBuf>,
    /// Polygons to move (.geojson, .gpkg or .shp).
    #[arg(long, value_name = "FILE", conflicts_with = "corners", requires = "project")]
    refine: Option<PathBuf>,
    /// Entries of the plots (CSV): plot, and any other columns.
    #[arg(long, value_name = "CSV")]
    field_map: Option<PathBuf>,
    /// Coordinate reference system of the corners [default: that of the project, or the UTM zone of degrees].
    #[arg(long, value_name = "CRS", conflicts_with = "project")]
    crs: Option<String>,
    /// Folder to write into [default: PROJECT/rowgram/layout].
    #[arg(short, long, value_name = "DIR", required_unless_present = "project")]
    output: Option<PathBuf>,
    #[command(flatten)]
    options: Given<LayoutOptions>,
    /// Replace files that exist.
    #[arg(long)]
    force: bool,
    /// Print the outcome as one line of JSON.
    #[arg(long)]
    json: bool,
}

fn text(folder: &Path, outcome: &LayoutOutcome) -> String {
    let mut text = format!("{}: {} plots", folder.display(), outcome.plots.len());
    let sigma = |axis: usize| {
        let sigmas = outcome.plots.iter().filter_map(|plot| plot.sigma_m);
        sigmas.map(|sigma| sigma[axis]).fold(f64::NAN, f64::max)
    };
    if let Some(of) = &outcome.refined {
        text += &format!(
            ", moved by {:+.3} m along and {:+.3} m across the rows, {:+.3} degrees, stretched by {:+.2} % and {:+.2} % \
             ({} of {} rows)",
            of.shift_along_m.value,
            of.shift_across_m.value,
            of.rotation_deg.value,
            100.0 * of.stretch_along.value,
            100.0 * of.stretch_across.value,
            of.used_rows,
            of.found_rows
        );
    }
    if sigma(0).is_finite() {
        text +=
            &format!("; corners are known to {:.3} m along and {:.3} m across", sigma(0), sigma(1));
    }
    text
}

/// Runs the command.
///
/// # Errors
/// As [`layout`].
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let project = args.project.as_deref().map(|root| open(root, None)).transpose()?;
    let options = match &project {
        Some(project) => args.options.over(&project.config().layout)?,
        None => args.options.over_defaults()?,
    };
    let source = match (&args.corners, &args.refine) {
        (Some(corners), _) => LayoutSource::Corners(corners),
        (None, Some(polygons)) => LayoutSource::Polygons(polygons),
        (None, None) => {
            return Err(Error::Argument("expected --corners or --refine".to_owned()));
        }
    };
    let usual = project.as_ref().map(|project| project.results().join("layout"));
    let output = args.output.clone().or(usual).ok_or_else(|| {
        Error::Argument("without a project --output names the folder to write into".to_owned())
    })?;
    let request = LayoutRequest {
        source,
        field_map: args.field_map.as_deref(),
        crs: args.crs.as_deref(),
        project: project.as_ref(),
        output: &output,
        force: args.force,
    };
    present(
        args.json,
        |monitor| layout(&request, &options, monitor),
        |outcome| text(&output, outcome),
    )
}
