//! What `rowgram locate` writes and says of a stand: plants, gaps and counts as tables, a picture, a
//! summary.

use crate::{
    error::Error,
    io::{FileError, output, points},
    phenotype::{
        locate::{Located, Plant},
        stand::{Canopy, NORMAL_95, Stalk},
    },
    raster::overlay,
};
use image::{Rgb, RgbImage};
use serde::Serialize;
use std::{fmt, path::Path};

/// The numbers of a stand, for people and machines. Intervals are of 95 %.
#[derive(Debug, Serialize)]
pub(super) struct StandSummary {
    plants_interval: [f64; 2],
    spacing_px: f64,
    spacing_interval_px: [f64; 2],
    spacing_m: Option<f64>,
    spacing_interval_m: Option<[f64; 2]>,
    row_spacing_interval_px: Option<[f64; 2]>,
    row_spacing_interval_m: Option<[f64; 2]>,
    /// Standard deviation of the spacing over the spacing.
    spacing_jitter: f64,
    share_missing: f64,
    share_doubles: f64,
    gaps: usize,
    mean_confidence: f64,
    plants_per_hectare: Option<f64>,
    plants_per_hectare_interval: Option<[f64; 2]>,
}

impl StandSummary {
    pub(super) fn new(canopy: &Canopy, gsd_m: Option<f64>) -> StandSummary {
        let interval =
            |middle: f64, sigma: f64| [middle - NORMAL_95 * sigma, middle + NORMAL_95 * sigma];
        let spacing_px = canopy.spacing.spacing;
        let spacing_interval_px = interval(spacing_px, canopy.spacing_sigma_px);
        let row_spacing_interval_px =
            canopy.row_spacing_px().map(|(px, sigma)| interval(px, sigma));
        let hectares = gsd_m.and_then(|gsd| Some(canopy.area_px2()? * gsd * gsd / 1e4));
        let count = canopy.plants.len() as f64;
        let confidence: f64 = canopy.plants.iter().map(|plant| plant.confidence).sum();
        StandSummary {
            plants_interval: canopy.count_interval,
            spacing_px,
            spacing_interval_px,
            spacing_m: gsd_m.map(|gsd| gsd * spacing_px),
            spacing_interval_m: gsd_m.map(|gsd| spacing_interval_px.map(|px| px * gsd)),
            row_spacing_interval_px,
            row_spacing_interval_m: row_spacing_interval_px
                .zip(gsd_m)
                .map(|(interval, gsd)| interval.map(|px| px * gsd)),
            spacing_jitter: canopy.spacing.jitter,
            share_missing: canopy.spacing.missing,
            share_doubles: canopy.spacing.doubles,
            gaps: canopy.missing.len(),
            mean_confidence: confidence / count.max(1.0),
            plants_per_hectare: hectares.map(|area| count / area),
            plants_per_hectare_interval: hectares
                .map(|area| canopy.count_interval.map(|count| count / area)),
        }
    }
}

impl fmt::Display for StandSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [low, high] = self.plants_interval;
        write!(f, "{low:.0} to {high:.0} plants by the leaves alone; ")?;
        match (self.spacing_m, self.spacing_interval_m) {
            (Some(m), Some([low, high])) => {
                write!(
                    f,
                    "spacing {:.1} cm ({:.1} to {:.1})",
                    100.0 * m,
                    100.0 * low,
                    100.0 * high
                )?;
            }
            _ => write!(f, "spacing {:.1} px", self.spacing_px)?,
        }
        write!(f, ", {} gaps", self.gaps)?;
        if let Some(density) = self.plants_per_hectare {
            write!(f, ", {density:.0} plants per hectare")?;
        }
        Ok(())
    }
}

/// Positions on the ground, where the size of a pixel is known.
fn metres(positions_px: &[[f64; 2]], gsd_m: Option<f64>) -> Vec<(&'static str, Vec<f64>)> {
    let axis = |axis: usize, gsd: f64| positions_px.iter().map(|at| at[axis] * gsd).collect();
    gsd_m.map_or(Vec::new(), |gsd| vec![("x_m", axis(0, gsd)), ("y_m", axis(1, gsd))])
}

fn write(
    path: &Path,
    force: bool,
    positions_px: &[[f64; 2]],
    columns: Vec<(&'static str, Vec<f64>)>,
    gsd_m: Option<f64>,
) -> Result<(), Error> {
    let mut columns = columns;
    let after_row = 1.min(columns.len());
    columns.splice(after_row..after_row, metres(positions_px, gsd_m));
    let columns: Vec<(&str, &[f64])> =
        columns.iter().map(|(name, values)| (*name, &values[..])).collect();
    Ok(points::write(path, force, positions_px, &columns)?)
}

/// The plants: place, row, confidence, standard deviations along and across the row.
pub(super) fn write_plants(
    path: &Path,
    force: bool,
    plants: &[Stalk],
    gsd_m: Option<f64>,
) -> Result<(), Error> {
    let positions: Vec<[f64; 2]> = plants.iter().map(|plant| plant.position_px).collect();
    let columns = vec![
        ("row", plants.iter().map(|plant| plant.row as f64).collect()),
        ("confidence", plants.iter().map(|plant| plant.confidence).collect()),
        ("sigma_along_px", plants.iter().map(|plant| plant.sigma_along_px).collect()),
        ("sigma_across_px", plants.iter().map(|plant| plant.sigma_across_px).collect()),
    ];
    write(path, force, &positions, columns, gsd_m)
}

/// The plants of a descent: place and row.
pub(super) fn write_located(
    path: &Path,
    force: bool,
    located: &Located,
    gsd_m: Option<f64>,
) -> Result<(), Error> {
    let positions: Vec<[f64; 2]> = located.plants.iter().map(|p| p.position_px).collect();
    let row = |plant: &Plant| plant.row.map_or(f64::NAN, |row| row as f64);
    let columns = vec![("row", located.plants.iter().map(row).collect())];
    write(path, force, &positions, columns, gsd_m)
}

/// The gaps: middle, row, length, how many plants are missing, the probability that any is.
pub(super) fn write_gaps(
    path: &Path,
    force: bool,
    canopy: &Canopy,
    gsd_m: Option<f64>,
) -> Result<(), Error> {
    let gaps = &canopy.missing;
    let positions: Vec<[f64; 2]> = gaps.iter().map(|gap| gap.position_px).collect();
    let columns = vec![
        ("row", gaps.iter().map(|gap| gap.row as f64).collect()),
        ("length_px", gaps.iter().map(|gap| gap.length_px).collect()),
        ("plants", gaps.iter().map(|gap| gap.plants as f64).collect()),
        ("probability", gaps.iter().map(|gap| gap.probability).collect()),
    ];
    write(path, force, &positions, columns, gsd_m)
}

/// The stand count of every row: plants, the expected number with its 95 % interval, the length.
pub(super) fn write_counts(
    path: &Path,
    force: bool,
    canopy: &Canopy,
    gsd_m: Option<f64>,
) -> Result<(), Error> {
    let mut found = vec![0_usize; canopy.rows.rows.len()];
    canopy.plants.iter().for_each(|plant| found[plant.row] += 1);
    output::write(path, force, |writer| {
        let mut csv = csv::Writer::from_writer(writer);
        let mut header = vec!["row", "plants", "expected", "low", "high", "length_px"];
        header.extend(gsd_m.map(|_| "length_m"));
        csv.write_record(header)?;
        for (row, line) in canopy.rows.rows.iter().enumerate() {
            let (expected, sigma) = (canopy.row_counts[row], canopy.row_count_sigmas[row]);
            let length_px = line.length_px();
            let numbers = [
                expected,
                (expected - NORMAL_95 * sigma).max(0.0),
                expected + NORMAL_95 * sigma,
                length_px,
            ];
            let mut record = vec![row.to_string(), found[row].to_string()];
            record.extend(numbers.map(|x| format!("{x:.2}")));
            record.extend(gsd_m.map(|gsd| format!("{:.3}", length_px * gsd)));
            csv.write_record(record)?;
        }
        csv.flush()
    })
    .map_err(|error: FileError| error.into())
}

/// Plants in red.
pub(super) fn draw_plants(
    picture: &mut RgbImage,
    positions_px: impl Iterator<Item = [f64; 2]>,
    radius_px: u32,
) {
    let positions: Vec<[f64; 2]> = positions_px.collect();
    overlay::draw_points(picture, &positions, Rgb([255, 40, 40]), radius_px);
}

/// The plants of a descent.
pub(super) fn draw_located(picture: &mut RgbImage, located: &Located) {
    let radius_px = (located.mean_distance_px / 3.0).clamp(2.0, 12.0) as u32;
    draw_plants(picture, located.plants.iter().map(|plant| plant.position_px), radius_px);
}

/// Plants in red, the doubtful ones in orange; yellow where plants are missing.
pub(super) fn draw(picture: &mut RgbImage, canopy: &Canopy) {
    let radius_px = (canopy.spacing.spacing / 4.0).clamp(2.0, 12.0) as u32;
    let (sure, doubtful): (Vec<Stalk>, Vec<Stalk>) =
        canopy.plants.iter().partition(|plant| plant.confidence >= 0.5);
    let gaps: Vec<[f64; 2]> = canopy.missing.iter().map(|gap| gap.position_px).collect();
    overlay::draw_points(picture, &gaps, Rgb([255, 230, 60]), radius_px);
    for (plants, colour) in [(sure, Rgb([255, 40, 40])), (doubtful, Rgb([255, 150, 0]))] {
        let positions: Vec<[f64; 2]> = plants.iter().map(|plant| plant.position_px).collect();
        overlay::draw_points(picture, &positions, colour, radius_px);
    }
}
