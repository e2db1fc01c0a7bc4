//! The files of a layout.

use super::{Laid, LayoutOutcome, LayoutRequest};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::{
    csv_table::CsvWriter,
    gpkg,
    polygons::{self, Outline},
};
use rowgram_optim::output::{self, FileError};
use rowgram_plants::{phenotype::layout::refine::Refinement, problems::plot_layout::Placement};
use rowgram_raster::georeference::Crs;
use std::path::Path;

/// What is written; the shapefile's own files beside it are checked with it.
const NAMES: [&str; 6] =
    ["plots.geojson", "plots.gpkg", "plots.shp", "layout.csv", "layout.json", "figures/layout.png"];

/// Refuses what is there already.
///
/// # Errors
/// The first file that exists, unless `force`.
pub(super) fn check(folder: &Path, force: bool) -> Result<(), FileError> {
    for name in NAMES {
        let path = folder.join(name);
        if path.exists() {
            output::check(&path, force)?;
        }
    }
    Ok(())
}

/// Writes the files of a layout.
///
/// # Errors
/// Where one cannot be written.
pub(super) fn write(
    request: &LayoutRequest<'_>,
    laid: &Laid,
    refinement: Option<&Refinement>,
    (crs, metres): (Crs, f64),
    outcome: &LayoutOutcome,
    monitor: &mut dyn Monitor,
) -> Result<(), Error> {
    let (folder, force) = (request.output, request.force);
    output::make_folder(folder)?;
    let outlines: Vec<Outline> = laid
        .plan
        .plots
        .iter()
        .zip(&laid.attributes)
        .enumerate()
        .map(|(k, (plot, attributes))| {
            let shift = refinement.and_then(|of| of.fit.plot_shifts_m.get(k)).copied();
            let placement = shifted(&laid.placement, shift.unwrap_or_default());
            let rings = plot.on_map(&placement);
            let rings = rings
                .into_iter()
                .map(|ring| ring.into_iter().map(|at| at.map(|x| x / metres)).collect());
            Outline {
                name: plot.name.clone(),
                rings: rings.collect(),
                attributes: attributes.clone(),
            }
        })
        .collect();
    polygons::write(&folder.join("plots.geojson"), force, &outlines, Some(crs))?;
    let left_out = |monitor: &mut dyn Monitor, name: &str, why: &str| {
        monitor.diagnostic(&Diagnostic::info("output-left-out", name, why));
    };
    if gpkg::IS_AVAILABLE {
        polygons::write(&folder.join("plots.gpkg"), force, &outlines, Some(crs))?;
    } else {
        left_out(monitor, "plots.gpkg", "not written: this build of rowgram has no GeoPackages");
    }
    polygons::write(&folder.join("plots.shp"), force, &outlines, Some(crs))?;
    if polygons::projection(crs).is_none() {
        let why = "not written: shapefiles name UTM zones and WGS84 only; set the system by hand";
        left_out(monitor, "plots.prj", why);
    }
    output::write(&folder.join("layout.csv"), force, |out| {
        let mut csv = CsvWriter::new(out);
        csv.write_record([
            "plot",
            "range",
            "column",
            "sigma_along_m",
            "sigma_across_m",
            "plants",
            "row_pieces",
            "rows_across_m",
            "shift_along_m",
            "shift_across_m",
        ])?;
        for (plot, found) in laid.plan.plots.iter().zip(&outcome.plots) {
            let metres = |value: Option<f64>| value.map(|x| format!("{x:.4}")).unwrap_or_default();
            let place = |number: usize| match number {
                0 => String::new(),
                number => number.to_string(),
            };
            let evidence = found.evidence;
            csv.write_record([
                plot.name.clone(),
                place(plot.range),
                place(plot.column),
                metres(found.sigma_m.map(|sigma| sigma[0])),
                metres(found.sigma_m.map(|sigma| sigma[1])),
                evidence.map(|of| of.plants.to_string()).unwrap_or_default(),
                evidence.map(|of| of.pieces.to_string()).unwrap_or_default(),
                metres(evidence.map(|of| of.across_m)),
                metres(evidence.map(|of| of.shift_m[0])),
                metres(evidence.map(|of| of.shift_m[1])),
            ])?;
        }
        csv.flush()
    })?;
    Ok(output::write_json(&folder.join("layout.json"), force, outcome)?)
}

/// A placement moved along and across its rows, metres.
fn shifted(placement: &Placement, [along, across]: [f64; 2]) -> Placement {
    let (sin, cos) = placement.affine[2].sin_cos();
    let mut moved = *placement;
    moved.affine[0] += cos * along - sin * across;
    moved.affine[1] += sin * along + cos * across;
    moved
}
