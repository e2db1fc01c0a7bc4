//! The rows that plants told by their mass stand in: those of the leaf mask, those of the plants, or the line through all of them.

use super::{
    mass_stand::band_px,
    plant_mass::Plant,
    principal_axis::{main_axis_rad, middle},
    rows::{self, Detection, Row, Rows},
};
use crate::problems::plants::lines::Axes;
use rowgram_raster::Mask;

/// Half the width of the band of a lone row, in sizes of a plant.
pub(super) const LONE_ROW_HALF_WIDTH: f64 = 1.5;
/// Radius of the disc that stands for a plant when rows are looked for, of that of a disc with the plant's mass.
const DISC_RADIUS_SHARE: f64 = 0.6;
/// Plants that say something of rows, at least.
const MIN_PLANTS: usize = 6;
/// Share of the plants along a lone row, at least.
const MIN_SHARE_ALONG: f64 = 0.8;
/// Plants per row, at least.
const MIN_PLANTS_PER_ROW: usize = 3;
/// The least share of the plants that rows hold beyond chance.
const MIN_SHARE_HELD: f64 = 0.15;

/// The rows of the leaf mask or those of the plants, whichever hold more; none where chance would hold as many.
pub(super) fn rows_of(mask: &Mask, plants: &[Plant], plant_px: f64, detection: &Detection) -> Rows {
    let middle = [0.5 * (mask.width as f64 - 1.0), 0.5 * (mask.height as f64 - 1.0)];
    let axes = Axes { origin_px: middle, heading_rad: 0.0 };
    let none = Rows { axes, rows: Vec::new(), spacing_px: None, contrast: 0.0 };
    if plants.len() < MIN_PLANTS {
        return none;
    }
    let discs = discs(mask, plants, DISC_RADIUS_SHARE * (plant_px / std::f64::consts::PI).sqrt());
    let again = rows::detect(&discs);
    let worth = |rows: &Rows| held_beyond_chance(rows, mask, plants, plant_px);
    let lone = lone_row(plants, axes, plant_px);
    let found = [detection.rows(), again.rows(), lone.as_ref()].into_iter().flatten();
    // A line through two plants is no row.
    let filled = found.filter(|rows| plants.len() >= MIN_PLANTS_PER_ROW * rows.rows.len());
    let best = filled.max_by(|a, b| worth(a).total_cmp(&worth(b)));
    best.filter(|rows| worth(rows) > MIN_SHARE_HELD).map_or(none, Rows::clone)
}

/// The line through all plants, where most of them stand along it: one row alone repeats nothing across itself.
fn lone_row(plants: &[Plant], axes: Axes, plant_px: f64) -> Option<Rows> {
    let places = plants.iter().map(|plant| [plant.u_px, plant.v_px]);
    let axes = Axes { heading_rad: main_axis_rad([places.clone()]), ..axes };
    let across_px = axes.aligned(middle(places))[1];
    let places = plants.iter().map(|plant| axes.aligned([plant.u_px, plant.v_px]));
    let along: Vec<f64> = places
        .filter(|[_, across]| (across - across_px).abs() <= LONE_ROW_HALF_WIDTH * plant_px.sqrt())
        .map(|[along, _]| along)
        .collect();
    let start_px = along.iter().copied().fold(f64::INFINITY, f64::min);
    let end_px = along.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let pixels = plants.iter().map(|plant| plant.mass_px).sum::<f64>() as usize;
    let row = Row { across_px, start_px, end_px, pixels };
    (along.len() as f64 >= MIN_SHARE_ALONG * plants.len() as f64).then(|| Rows {
        axes,
        rows: vec![row],
        spacing_px: None,
        contrast: 0.0,
    })
}

/// Share of the plants within the bands of the rows, less what would be there if plants stood anywhere in the picture.
fn held_beyond_chance(rows: &Rows, mask: &Mask, plants: &[Plant], plant_px: f64) -> f64 {
    let band = band_px(rows, plant_px);
    let across: Vec<f64> =
        plants.iter().map(|plant| rows.axes.aligned([plant.u_px, plant.v_px])[1]).collect();
    let (right, below) = (mask.width as f64 - 1.0, mask.height as f64 - 1.0);
    let corners = [[0.0, 0.0], [right, 0.0], [0.0, below], [right, below]];
    let corners = corners.map(|corner| rows.axes.aligned(corner)[1]);
    let low = corners.into_iter().fold(f64::INFINITY, f64::min);
    let high = corners.into_iter().fold(f64::NEG_INFINITY, f64::max);
    let held = across
        .iter()
        .filter(|&&across| rows.nearest(across).is_some_and(|(_, away)| away <= band))
        .count();
    let bands = 2.0 * band * rows.rows.len() as f64;
    held as f64 / plants.len() as f64 - (bands / (high - low).max(1.0)).min(1.0)
}

/// A mask of discs in the places of plants.
fn discs(mask: &Mask, plants: &[Plant], radius: f64) -> Mask {
    let mut discs = Mask::empty(mask.width, mask.height);
    let radius = radius.max(1.0);
    for plant in plants {
        let span = |at: f64, size: usize| {
            let from = (at - radius).ceil().max(0.0) as usize;
            from..((at + radius) as usize + 1).min(size)
        };
        for v in span(plant.v_px, mask.height) {
            for u in span(plant.u_px, mask.width) {
                if (u as f64 - plant.u_px).hypot(v as f64 - plant.v_px) <= radius {
                    discs.data[v * mask.width + u] = 1;
                }
            }
        }
    }
    discs
}
