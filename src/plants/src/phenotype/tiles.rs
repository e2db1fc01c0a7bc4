//! The locator for closed canopies, crop by crop.
//!
//! The paper cuts a field into regions because all pixels would take too long together. The locator
//! needs no crops; they remain for comparison, and for masks that are too large for the memory. Rows are
//! those of the whole mask. Each crop is a window with a halo around it, in which plants are located
//! with the spacing of that window alone; those outside the window proper are dropped. Away
//! from the seams the plants are those of the whole mask, as far as the spacings agree.
//!
//! Positions in pixels of the whole mask, centre of the top-left pixel at (0, 0).

use super::{
    locate::LocateError,
    row_model::{self, RowModelOptions},
    rows::{Detection, Row, Rows},
    stand::Stalk,
};
use crate::problems::plants::lines::Axes;
use rayon::prelude::*;
use rowgram_optim::engine::SolveError;
use rowgram_raster::Mask;

/// A window of a mask: first column, first row, columns, rows.
type Window = [usize; 4];

/// Finds plants crop by crop, as many as there seem to be: windows of `crop_px` with a halo of
/// `halo_px` on every side. By row, and along the row.
///
/// # Errors
/// As [`row_model::locate`], for the whole mask; a crop without rows or leaves has no plants.
/// [`SolveError::Misuse`] for crops of no size.
pub fn locate(
    mask: &Mask,
    detection: &Detection,
    options: &RowModelOptions,
    crop_px: usize,
    halo_px: usize,
) -> Result<Vec<Stalk>, LocateError> {
    if crop_px == 0 {
        return Err(SolveError::Misuse("a crop has to be at least one pixel wide".into()).into());
    }
    if mask.data.iter().all(|&pixel| pixel == 0) {
        return Err(LocateError::EmptyMask);
    }
    let rows = match detection {
        Detection::Found(rows) => rows,
        &Detection::NoRows { contrast, prominence } => {
            return Err(LocateError::NoRows { contrast, prominence });
        }
    };
    let columns = mask.width.div_ceil(crop_px);
    let found: Vec<Vec<Stalk>> = (0..columns * mask.height.div_ceil(crop_px))
        .into_par_iter()
        .map(|k| {
            let (left, top) = (k % columns * crop_px, k / columns * crop_px);
            let core = [left, top, crop_px.min(mask.width - left), crop_px.min(mask.height - top)];
            crop(mask, rows, options, core, halo_px)
        })
        .collect::<Result<_, LocateError>>()?;
    let mut plants: Vec<Stalk> = found.into_iter().flatten().collect();
    plants.sort_by(|a, b| a.row.cmp(&b.row).then(a.along_px.total_cmp(&b.along_px)));
    Ok(plants)
}

fn crop(
    mask: &Mask,
    rows: &Rows,
    options: &RowModelOptions,
    core: Window,
    halo_px: usize,
) -> Result<Vec<Stalk>, LocateError> {
    let (left, top) = (core[0].saturating_sub(halo_px), core[1].saturating_sub(halo_px));
    let right = (core[0] + core[2] + halo_px).min(mask.width);
    let below = (core[1] + core[3] + halo_px).min(mask.height);
    let part = Mask::from_fn(right - left, below - top, |u, v| mask.get(left + u, top + v));
    let shift = [left as f64, top as f64];
    let origin_px = [rows.axes.origin_px[0] - shift[0], rows.axes.origin_px[1] - shift[1]];
    let axes = Axes { origin_px, ..rows.axes };
    let size = [part.width as f64 - 1.0, part.height as f64 - 1.0];
    let inside: Vec<(usize, Row)> = rows
        .rows
        .iter()
        .enumerate()
        .filter_map(|(k, row)| Some((k, clip(row, &axes, size)?)))
        .collect();
    if inside.is_empty() || part.data.iter().all(|&pixel| pixel == 0) {
        return Ok(Vec::new());
    }
    let local = Rows { axes, rows: inside.iter().map(|(_, row)| *row).collect(), ..rows.clone() };
    // The rows of a crop are those of the whole.
    let options = RowModelOptions { isolated_plants: false, ..*options };
    let found = row_model::locate(&part, &Detection::Found(local), None, &options)?;
    let place = |plant: Stalk| {
        let [u, v] = plant.position_px;
        let position_px = [u + shift[0], v + shift[1]];
        Stalk { position_px, row: inside[plant.row].0, ..plant }
    };
    let kept = |plant: &Stalk| {
        let within = |axis: usize| {
            let place = plant.position_px[axis] + 0.5 - core[axis] as f64;
            // A plant just outside of the picture belongs to the crop at its edge.
            let last = [mask.width, mask.height][axis];
            (place >= 0.0 || core[axis] == 0)
                && (place < core[axis + 2] as f64 || core[axis] + core[axis + 2] == last)
        };
        within(0) && within(1)
    };
    Ok(found.plants.into_iter().map(place).filter(kept).collect())
}

/// The part of a row inside a window from (0, 0) to `size`.
fn clip(row: &Row, axes: &Axes, size: [f64; 2]) -> Option<Row> {
    let (sin, cos) = axes.heading_rad.sin_cos();
    let at = axes.image([0.0, row.across_px]);
    let (mut start_px, mut end_px) = (row.start_px, row.end_px);
    for (axis, slope) in [(0, cos), (1, sin)] {
        if slope.abs() < 1e-12 {
            if !(0.0..=size[axis]).contains(&at[axis]) {
                return None;
            }
            continue;
        }
        let (a, b) = (-at[axis] / slope, (size[axis] - at[axis]) / slope);
        start_px = start_px.max(a.min(b));
        end_px = end_px.min(a.max(b));
    }
    (end_px - start_px > 1.0).then_some(Row { start_px, end_px, ..*row })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_cut_at_the_window() {
        let axes = Axes { origin_px: [50.0, 20.0], heading_rad: 0.0 };
        let row = Row { across_px: 5.0, start_px: -90.0, end_px: 20.0, pixels: 7 };
        let part = clip(&row, &axes, [80.0, 40.0]).unwrap();
        assert_eq!((part.start_px, part.end_px), (-50.0, 20.0));
        assert!(clip(&row, &axes, [80.0, 24.0]).is_none());
        // At 45 degrees through the corner of a square window.
        let axes = Axes { origin_px: [0.0; 2], heading_rad: std::f64::consts::FRAC_PI_4 };
        let row = Row { across_px: 0.0, start_px: -100.0, end_px: 100.0, pixels: 7 };
        let part = clip(&row, &axes, [10.0, 10.0]).unwrap();
        approx::assert_abs_diff_eq!(part.start_px, 0.0, epsilon = 1e-9);
        approx::assert_abs_diff_eq!(part.end_px, 200_f64.sqrt(), epsilon = 1e-9);
    }
}
