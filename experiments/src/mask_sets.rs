//! Real leaf masks that come without their photos: beans with a box per plant, sorghum with its rows and weeds.

use crate::{accuracy::files, plots::nearest_px};
use rowgram::{
    Error,
    io::{FileError, images, points},
    phenotype::{
        locator::{self, LocateOptions, Work},
        stand::Stand,
    },
    raster::Mask,
};
use serde::Deserialize;
use std::{
    fmt::Write as _,
    path::{Path, PathBuf},
};

/// Rows are right within this share of the distance between them.
const MAX_ROW_ERROR: f64 = 0.125;
/// Half the side of the square around a plant in which crop and weeds are compared, in pixels: half the width of a plant.
const HALF_SQUARE_PX: usize = 20;

/// A leaf mask and its plants.
pub(crate) struct MaskPlot {
    pub(crate) name: String,
    pub(crate) mask: Mask,
    pub(crate) truth: Vec<[f64; 2]>,
    pub(crate) radius_px: f64,
}

/// Every mask of a folder, `NAME.leaves.png`, and its name; nothing where there is no such folder.
fn masks(folder: &Path) -> Result<Vec<(String, PathBuf)>, FileError> {
    let all = if folder.exists() { files(folder)? } else { Vec::new() };
    let name = |path: &PathBuf| {
        Some(path.file_name()?.to_string_lossy().strip_suffix(".leaves.png")?.to_owned())
    };
    Ok(all.into_iter().filter_map(|path| Some((name(&path)?, path))).collect())
}

/// Plots of dry bean, whose leaves a mask shows apart.
pub(crate) fn beans(data: &Path) -> Result<Vec<MaskPlot>, Error> {
    let folder = data.join("fields/bean_plots_masks");
    let read = |(name, path): (String, PathBuf)| -> Result<MaskPlot, Error> {
        let truth = points::read(&folder.join(format!("{name}.boxes.csv")))?;
        let radius_px = nearest_px(&truth) / 4.0;
        Ok(MaskPlot { name, mask: mask_at(&path, |grey| grey > 0)?, truth, radius_px })
    };
    masks(&folder)?.into_iter().map(read).collect()
}

fn mask_at(path: &Path, is_leaf: impl Fn(u8) -> bool) -> Result<Mask, FileError> {
    let grey = images::read_grey(path)?;
    let data = grey.pixels().map(|pixel| u8::from(is_leaf(pixel.0[0]))).collect();
    Ok(Mask { width: grey.width() as usize, height: grey.height() as usize, data })
}

/// Rows and weeds of sorghum: a table.
pub(crate) fn sorghum_table(data: &Path) -> Result<String, Error> {
    let folder = data.join("fields/sorghum_uav_masks");
    let mut text = "## Rows and weeds of sorghum\n\nHand-drawn masks with weeds, without photos. Rows: of the true ones with a row within an eighth of \
         their distance in the middle of the picture. On weeds: share of the plants around which weeds have more leaf than the crop.\n\n\
         | picture | true rows | found | right | weeds, share of leaf | plants | on weeds | confidence |\n|---|---|---|---|---|---|---|---|\n"
        .to_owned();
    for (name, path) in masks(&folder)? {
        let rows_path = folder.join(format!("{name}.rows.csv"));
        if !rows_path.exists() {
            continue;
        }
        let mask = mask_at(&path, |grey| grey > 0)?;
        let classes = folder.join(format!("{name}.classes.png"));
        let (crop, weeds) =
            (mask_at(&classes, |grey| grey == 255)?, mask_at(&classes, |grey| grey == 128)?);
        let stand = match locator::prepare(&mask, None, None, &LocateOptions::default())?.work {
            Work::Stand(stand) => Some(stand),
            _ => None,
        };
        let middle = 0.5 * mask.height as f64;
        let truth = row_middles(&rows_path)?;
        let apart = truth.windows(2).map(|pair| pair[1] - pair[0]).fold(f64::INFINITY, f64::min);
        let found = stand.as_ref().map(|stand| rows_at(stand, middle)).unwrap_or_default();
        let is_right =
            |at: &&f64| found.iter().any(|found| (found - **at).abs() <= MAX_ROW_ERROR * apart);
        let plants = stand.as_ref().map_or(&[][..], |stand| &stand.plants);
        let on_weeds = plants
            .iter()
            .filter(|plant| near(&weeds, plant.position_px) > near(&crop, plant.position_px));
        let number = plants.len().max(1) as f64;
        // Writing to a string does not fail.
        let _ = writeln!(
            text,
            "| {name} | {} | {} | {} | {:.2} | {} | {:.3} | {:.3} |",
            truth.len(),
            found.len(),
            truth.iter().filter(is_right).count(),
            weeds.count() as f64 / mask.count().max(1) as f64,
            plants.len(),
            on_weeds.count() as f64 / number,
            plants.iter().map(|plant| plant.confidence).sum::<f64>() / number
        );
    }
    Ok(text)
}

/// A true row, from the top of the picture to its bottom.
#[derive(Deserialize)]
struct TrueRow {
    x_top: f64,
    x_bottom: f64,
}

/// Where true rows cross the middle of the picture.
fn row_middles(path: &Path) -> Result<Vec<f64>, FileError> {
    let wrong = |error: csv::Error| FileError::malformed(path, None, error.to_string());
    let mut table = csv::Reader::from_path(path).map_err(wrong)?;
    let middle = |row: Result<TrueRow, csv::Error>| row.map(|row| 0.5 * (row.x_top + row.x_bottom));
    table.deserialize().map(middle).collect::<Result<_, _>>().map_err(wrong)
}

/// Where the rows cross a line of the picture.
fn rows_at(stand: &Stand, v: f64) -> Vec<f64> {
    let axes = &stand.rows.axes;
    let (sin, cos) = axes.heading_rad.sin_cos();
    let rows = stand.rows.rows.iter();
    rows.map(|row| axes.origin_px[0] + (cos * (v - axes.origin_px[1]) - row.across_px) / sin)
        .collect()
}

/// Leaf pixels of a mask in the square around a place.
fn near(mask: &Mask, [u, v]: [f64; 2]) -> usize {
    let around = |at: f64, size: usize| {
        let at = at.max(0.0) as usize;
        at.saturating_sub(HALF_SQUARE_PX)..(at + HALF_SQUARE_PX + 1).min(size)
    };
    let of_row = |v: usize| around(u, mask.width).filter(|&u| mask.get(u, v)).count();
    around(v, mask.height).map(of_row).sum()
}
