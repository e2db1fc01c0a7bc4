//! From calibration to plant: a flight's block adjusted with errors of lens, control and receiver, the leaf
//! mask of its orthomosaic, the locator, and the traits of a plot beside the true ones.
//!
//! Errors of traits have their sign: found minus true.

use super::{
    adjust::{self, Estimate},
    chain_map::{self, Contrast, Draws, Errors, FINE, Flown},
};
use crate::{
    stage::{Measured, Metric, Stage, metric},
    streams::{Stream, drawn},
};
use data_synth::{
    camera::CameraConfig,
    field::GrowthStage,
    twin::{FlightPreset, TwinConfig},
};
use rand::RngExt;
use rowgram::{
    phenotype::{
        row_model::{self, RowModelOptions},
        rows,
        stand::Stand,
    },
    problems::adjustment::rmse,
    raster::Mask,
    score::matching,
};
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// A found plant within this distance of where the map shows a true one may stand for it, metres.
const PAIR_M: f64 = 0.10;

/// What can be varied.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Parameters {
    /// The field, the flight, ground control.
    twin: TwinConfig,
    /// How the block is adjusted.
    estimate: Estimate,
    errors: Errors,
    draws: Draws,
    map: Contrast,
    row_model: RowModelOptions,
    /// Rows of the plot, in the middle of the field.
    plot_rows: usize,
    /// Length of the plot, in the middle of the rows, metres.
    plot_length_m: f64,
}

impl Default for Parameters {
    fn default() -> Parameters {
        let mut twin = TwinConfig::preset(FlightPreset::Small);
        (twin.field.rows, twin.field.row_length_m, twin.field.gsd_m) = (6, 6.0, 0.01);
        twin.field.stage = GrowthStage::Early;
        (twin.field.heading_deg, twin.field.margin_m) = (12.0, 0.6);
        (twin.field.curve_m, twin.field.tilt_m) = (0.0, 0.0);
        twin.field.plots = Default::default();
        twin.field.terrain = Default::default();
        twin.field.habit = Default::default();
        twin.corruption = Default::default();
        twin.camera = CameraConfig::compact(4000, 3000, 3000.0);
        (twin.flight.height_m, twin.flight.margin_m) = (15.0, 0.0);
        (twin.flight.forward_overlap, twin.flight.side_overlap) = (0.75, 0.6);
        twin.flight.gnss.drift_share = 0.7;
        (twin.targets.control, twin.targets.check) = (5, 4);
        (twin.targets.size_m, twin.targets.clearing_m) = (0.3, 0.0);
        (twin.tie_points.per_photo, twin.tie_points.outlier_fraction) = (60, 0.0);
        let mut estimate = Estimate::default();
        (estimate.control, estimate.gnss) = (5, true);
        Parameters {
            twin,
            estimate,
            errors: Errors::default(),
            draws: Draws::default(),
            map: Contrast::default(),
            row_model: RowModelOptions::default(),
            plot_rows: 4,
            plot_length_m: 4.5,
        }
    }
}

/// The stage.
pub(crate) struct Chain;

impl Stage for Chain {
    type Parameters = Parameters;
    const NAME: &'static str = "chain";
    const ABOUT: &'static str = "traits of a plot after all errors from calibration to leaf mask";
    const METRICS: &'static [Metric] = &[
        metric("plants_per_ha_error", "plants per hectare, error over the true number"),
        metric(
            "position_rms_m",
            "root mean square distance of found plants from their true places",
        ),
        metric("spacing_error", "mean distance of plants in a row, error over the true one"),
        metric("spacing_cv_error", "coefficient of variation of that distance, error"),
        metric("row_spacing_error", "distance between rows, error over the true one"),
        metric("cover_error", "leaf cover, error over the true one"),
        metric("leaf_area_error", "projected leaf area of a plant, error over the true one"),
        metric("check_plan_m", "root mean square error of the check points in plan"),
        metric("check_z_m", "the same in height"),
        metric("f1_10cm", "F1 of plants within 10 cm of where the map shows a true one"),
        metric("plants", "true plants of the plot"),
        metric("cover", "true leaf cover of the plot"),
        metric("photos", "photos of the flight"),
    ];
    const SEEDED: &'static [&'static str] = &["twin.field.seed"];

    fn check(p: &Parameters) -> Result<(), String> {
        adjust::check(&p.twin, &p.estimate)?;
        let e = &p.errors;
        let sizes = [e.lens_px, e.control_m, e.receiver_m, e.leaf_height_m];
        let map = [p.map.contrast_grey, p.map.noise_grey, p.map.blur_px];
        if !sizes.iter().chain(&map).all(|size| size.is_finite() && *size >= 0.0) {
            return Err("errors and map: expected numbers of 0 or more".to_owned());
        }
        let within = (0.0..0.5 * p.map.contrast_grey).contains(&e.threshold_grey.abs());
        if !within {
            return Err("errors.threshold_grey: expected less than half the contrast".to_owned());
        }
        if !(1..=p.twin.field.rows).contains(&p.plot_rows) {
            return Err("plot_rows: expected 1 to the number of rows".to_owned());
        }
        if !(p.plot_length_m > 0.0 && p.plot_length_m <= p.twin.field.row_length_m) {
            return Err("plot_length_m: expected a length within the rows".to_owned());
        }
        Ok(())
    }

    fn run(p: &Parameters, seed: u64) -> Result<Measured, String> {
        let mut config = p.twin.clone();
        let mut rng = drawn(seed, p.draws.field.into(), Stream::Field);
        config.field.seed = rng.random::<u64>() >> 1;
        config.field.gsd_m /= f64::from(FINE);
        let mut clock = Instant::now();
        let mut seconds = |part: &str, measured: &mut Measured| {
            measured.seconds.insert(part.to_owned(), clock.elapsed().as_secs_f64());
            clock = Instant::now();
        };
        let mut measured = Measured::default();
        let flown = chain_map::fly(&config, &p.estimate, &p.errors, &p.draws, seed)?;
        seconds("block", &mut measured);
        let [width, _] = chain_map::cells(&flown.twin.field().frame);
        let (shares, offset) = (flown.shares(), p.errors.threshold_grey);
        let mask = chain_map::threshold(&shares, width, &p.map, offset, seed, p.draws.field);
        seconds("map", &mut measured);
        let detection = rows::detect(&mask);
        let stand = row_model::locate(&mask, &detection, None, &p.row_model);
        let stand = stand.map_err(|e| e.to_string())?;
        seconds("plants", &mut measured);
        let plot = Plot::new(p, &flown);
        let (found, truth) = (plot.found(&stand, &mask), plot.truth());
        let ratio = |found: f64, truth: f64| found / truth - 1.0;
        measured.put("plants", truth.plants);
        measured.put("cover", truth.cover);
        // The same plot, the same area.
        measured.put("plants_per_ha_error", ratio(found.plants, truth.plants));
        measured.put("spacing_error", ratio(found.spacing, truth.spacing));
        measured.put("spacing_cv_error", found.spacing_cv - truth.spacing_cv);
        measured.put("cover_error", ratio(found.cover, truth.cover));
        let of_a_plant = |traits: &Traits| traits.cover / traits.plants;
        measured.put("leaf_area_error", ratio(of_a_plant(&found), of_a_plant(&truth)));
        if let Some((spacing_px, _)) = stand.row_spacing_px() {
            let spacing_m = spacing_px * p.twin.field.gsd_m;
            measured.put("row_spacing_error", ratio(spacing_m, p.twin.field.inter_row_m));
        }
        plot.positions(&stand, &mut measured);
        let squares = |axis: usize| {
            let errors: Vec<f64> = flown.checks.iter().map(|c| c.error_m[axis]).collect();
            rmse(&errors, 0.95).map(|found| found.rmse_m.powi(2))
        };
        if let (Some(x), Some(y), Some(z)) = (squares(0), squares(1), squares(2)) {
            measured.put("check_plan_m", (x + y).sqrt());
            measured.put("check_z_m", z.sqrt());
        }
        measured.put("photos", flown.twin.shots.len() as f64);
        seconds("traits", &mut measured);
        Ok(measured)
    }
}

/// The traits of a plot.
struct Traits {
    plants: f64,
    /// Mean distance of neighbours in a row, metres, and its coefficient of variation.
    spacing: f64,
    spacing_cv: f64,
    cover: f64,
}

/// A rectangle between rows, given by its surveyed corners: errors of the map move plants in and out.
struct Plot<'a> {
    flown: &'a Flown,
    along_m: f64,
    across_m: [f64; 2],
}

impl<'a> Plot<'a> {
    fn new(p: &Parameters, flown: &'a Flown) -> Plot<'a> {
        let config = &flown.twin.field().config;
        let first = (config.rows - p.plot_rows) / 2;
        let half = 0.5 * config.inter_row_m;
        let across_m = [
            config.row_across(first, 0.0) - half,
            config.row_across(first + p.plot_rows - 1, 0.0) + half,
        ];
        Plot { flown, along_m: 0.5 * p.plot_length_m, across_m }
    }

    /// Where along its row a place is, if it is in the plot.
    fn along(&self, [x_m, y_m]: [f64; 2]) -> Option<f64> {
        let [along, across] = self.flown.twin.field().config.along_across(x_m, y_m);
        let [low, high] = self.across_m;
        (along.abs() <= self.along_m && (low..high).contains(&across)).then_some(along)
    }

    fn found(&self, stand: &Stand, mask: &Mask) -> Traits {
        let frame = &self.flown.twin.field().frame;
        let leaf = |u: usize, v: usize| f64::from(u8::from(mask.data[v * mask.width + u] != 0));
        let place = |at: [f64; 2]| self.along(chain_map::place(frame, at));
        let plants = stand.plants.iter().filter_map(|s| Some((s.row, place(s.position_px)?)));
        traits(plants, self.cover([mask.width, mask.height], leaf))
    }

    fn truth(&self) -> Traits {
        let field = self.flown.twin.field();
        let [width, height] = chain_map::cells(&field.frame);
        let shares = self.flown.true_shares();
        let leaf = |u: usize, v: usize| f64::from(shares[v * width + u]);
        let place = |p: &data_synth::field::Plant| Some((p.row, self.along([p.x_m, p.y_m])?));
        traits(field.plants.iter().filter_map(place), self.cover([width, height], leaf))
    }

    /// Mean over the cells of the plot.
    fn cover(&self, [width, height]: [usize; 2], leaf: impl Fn(usize, usize) -> f64) -> f64 {
        let frame = &self.flown.twin.field().frame;
        let (mut sum, mut count) = (0.0, 0.0);
        for v in 0..height {
            for u in (0..width).filter(|&u| self.along(chain_map::cell(frame, u, v)).is_some()) {
                sum += leaf(u, v);
                count += 1.0;
            }
        }
        sum / count
    }

    /// Found plants and those true ones that the map shows at the same place.
    fn positions(&self, stand: &Stand, measured: &mut Measured) {
        let field = self.flown.twin.field();
        let frame = &field.frame;
        let (mut shown, mut true_m) = (Vec::new(), Vec::new());
        for plant in &field.plants {
            let place = [plant.x_m, plant.y_m];
            if let Some(at) = self.flown.shown([plant.x_m, plant.y_m, plant.z_m]) {
                shown.push(chain_map::position(frame, at));
                true_m.push(place);
            }
        }
        let found: Vec<[f64; 2]> = stand.plants.iter().map(|plant| plant.position_px).collect();
        let gsd_m = frame.gsd_m * f64::from(FINE);
        let pairs = matching::within(&found, &shown, PAIR_M / gsd_m);
        let squares: Vec<f64> = pairs
            .iter()
            .map(|pair| {
                let ([x, y], [tx, ty]) =
                    (chain_map::place(frame, found[pair.found]), true_m[pair.truth]);
                (x - tx).powi(2) + (y - ty).powi(2)
            })
            .collect();
        measured.put("position_rms_m", (squares.iter().sum::<f64>() / squares.len() as f64).sqrt());
        let both = (found.len() + shown.len()) as f64;
        measured.put("f1_10cm", 2.0 * pairs.len() as f64 / both);
    }
}

/// From the row and the place along it of every plant.
fn traits(plants: impl Iterator<Item = (usize, f64)>, cover: f64) -> Traits {
    let mut plants: Vec<(usize, f64)> = plants.collect();
    plants.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let gaps: Vec<f64> = plants
        .windows(2)
        .filter(|pair| pair[0].0 == pair[1].0)
        .map(|pair| pair[1].1 - pair[0].1)
        .collect();
    let count = gaps.len() as f64;
    let spacing = gaps.iter().sum::<f64>() / count;
    let squares: f64 = gaps.iter().map(|gap| (gap - spacing).powi(2)).sum();
    let spacing_cv = (squares / (count - 1.0)).sqrt() / spacing;
    Traits { plants: plants.len() as f64, spacing, spacing_cv, cover }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn small() -> Parameters {
        let mut p = Parameters::default();
        (p.twin.field.rows, p.twin.field.row_length_m) = (4, 4.0);
        (p.plot_rows, p.plot_length_m) = (2, 3.0);
        (p.twin.tie_points.per_photo, p.twin.targets.check) = (30, 3);
        p
    }

    #[test]
    fn without_errors_the_map_is_where_the_field_is() {
        let mut p = small();
        (p.errors.lens_px, p.errors.control_m, p.errors.receiver_m) = (0.0, 0.0, 0.01);
        (p.errors.leaf_height_m, p.map.noise_grey) = (0.0, 0.0);
        let exact = Chain::run(&p, 1).unwrap().values;
        assert!(exact["check_plan_m"] < 0.01, "{exact:?}");
        assert!(exact["cover_error"].abs() < 0.1, "{exact:?}");
        assert!(exact["position_rms_m"] < 0.05, "{exact:?}");
        p.errors.control_m = 0.2;
        let moved = Chain::run(&p, 1).unwrap().values;
        assert!(moved["position_rms_m"] > exact["position_rms_m"] + 0.01, "{moved:?}");
        p.errors.threshold_grey = 20.0;
        let less = Chain::run(&p, 1).unwrap().values;
        assert!(less["cover_error"] < moved["cover_error"] - 0.1, "{less:?}");
        assert_eq!(less["check_plan_m"], moved["check_plan_m"]);
    }

    #[test]
    fn another_draw_of_one_error_moves_no_other() {
        let p = small();
        let first = Chain::run(&p, 1).unwrap().values;
        let mut other = p.clone();
        other.draws.lens = 1;
        let lens = Chain::run(&other, 1).unwrap().values;
        assert_eq!((first["plants"], first["cover"]), (lens["plants"], lens["cover"]));
        assert_ne!(first["check_plan_m"], lens["check_plan_m"]);
        let mut other = p.clone();
        other.draws.field = 1;
        assert_ne!(first["cover"], Chain::run(&other, 1).unwrap().values["cover"]);
        assert_eq!(first, Chain::run(&p, 1).unwrap().values);
    }

    #[test]
    fn distances_are_those_within_a_row() {
        let plants = [(0, 0.0), (1, 0.1), (0, 0.2), (0, 0.6), (1, 0.3)];
        let found = traits(plants.into_iter(), 0.3);
        // Gaps of 0.2, 0.4 and 0.2.
        assert!((found.spacing - 0.8 / 3.0).abs() < 1e-12);
        assert!((found.spacing_cv - 0.115_470 / found.spacing).abs() < 1e-4);
        assert_eq!((found.plants, found.cover), (5.0, 0.3));
    }
}
