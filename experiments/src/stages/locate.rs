//! Plants from the mask of a synthetic field, by any variant of the locator.

use crate::stage::{Measured, Metric, Stage, Trace, metric};
use data_synth::{field::FieldConfig, scenario::Scenario};
use rowgram::robust::median;
use rowgram::{
    descent,
    phenotype::{
        locate::{Init, PlantFitOptions, Setup},
        row_model, rows,
    },
    problems::plants::{Model, PlantUpdate, Prior, index::PixelIndex},
    raster::Mask,
    score::Score,
};
use serde::{Deserialize, Serialize};

/// Where the descent starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Start {
    /// Leaf pixels far from each other.
    #[serde(rename = "kmeans++")]
    KmeansPlusPlus,
    /// Detected rows with regular spacing.
    Rows,
    /// Leaf pixels, all equally likely.
    Random,
    /// The true plants: what the model itself does to them.
    Truth,
}

/// Which locator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Method {
    /// Coordinate descent on the paper's likelihood with a prior.
    Descent,
    /// Votes along leaf axes and a random field along the rows.
    RowModel,
    /// The same without being told the number of plants.
    RowModelAuto,
}

/// What can be varied.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Parameters {
    /// The field and what corrupts it.
    scenario: Scenario,
    /// Which locator.
    method: Method,
    /// The model of the descent.
    model: Model,
    /// Pixels per plant that count as independent; 0 is the paper, all of them.
    tempering: f64,
    /// Distances are truncated here, metres; 0 is the paper, not at all.
    truncate_m: f64,
    /// The locator by votes.
    row_model: row_model::RowModelOptions,
    /// Floor of the scatter about a row, metres.
    floor_m: f64,
    /// Where the descent starts.
    start: Start,
    /// Plants asked for over plants there are.
    count_factor: f64,
    descent: descent::CoordinateDescentOptions,
    /// 0 leaves the start as it is.
    max_sweeps: u64,
    /// Whether the cost of every sweep is kept.
    trace: bool,
    /// Whether the positions found are kept.
    positions: bool,
}

impl Default for Parameters {
    fn default() -> Parameters {
        Parameters {
            scenario: Scenario::default(),
            method: Method::Descent,
            model: Model::default(),
            tempering: 0.0,
            truncate_m: 0.0,
            row_model: row_model::RowModelOptions::default(),
            floor_m: 0.01,
            start: Start::Rows,
            count_factor: 1.0,
            descent: descent::CoordinateDescentOptions::default(),
            max_sweeps: 300,
            trace: false,
            positions: false,
        }
    }
}

/// The stage.
pub(crate) struct Locate;

impl Stage for Locate {
    type Parameters = Parameters;
    const NAME: &'static str = "locate";
    const ABOUT: &'static str = "plants from the mask of a synthetic field";
    const METRICS: &'static [Metric] = &[
        metric("f1_5cm", "F1 of plants within 5 cm of a true one, one to one"),
        metric("f1_10cm", "F1 within 10 cm"),
        metric("precision_5cm", "share of the found plants within 5 cm of a true one"),
        metric("recall_5cm", "share of the true plants found within 5 cm"),
        metric("median_error_m", "median distance of the pairs within 10 cm"),
        metric("plants", "true plants"),
        metric("count_error", "found minus true plants, share of the true ones"),
        metric("pixels_per_plant", "leaf pixels for each true plant"),
        metric("sweeps", "sweeps made"),
        metric("cost_per_pixel", "final cost over the number of leaf pixels"),
        metric("sigma_m", "scale of the distances at the end"),
        metric("moved_m", "median distance of a true plant from the nearest found one"),
        metric("f1_quarter", "F1 within a quarter of the spacing in the rows"),
    ];
    const SEEDED: &'static [&'static str] =
        &["scenario.field.seed", "descent.seed", "model.floor_px"];

    fn check(p: &Parameters) -> Result<(), String> {
        p.scenario.check().map_err(|e| e.to_string())?;
        if !(p.floor_m > 0.0 && p.count_factor > 0.0 && p.count_factor <= 10.0) {
            return Err("floor_m has to be positive, count_factor between 0 and 10".to_owned());
        }
        if !(p.tempering >= 0.0 && p.truncate_m >= 0.0) {
            return Err("tempering and truncate_m have to be 0 or more".to_owned());
        }
        if p.start == Start::Truth && p.count_factor != 1.0 {
            return Err("start = truth goes with count_factor = 1".to_owned());
        }
        if p.start == Start::Truth && p.model.prior == Prior::Grid {
            return Err("start = truth has no columns; take prior = rows or none".to_owned());
        }
        Ok(())
    }

    fn run(p: &Parameters, seed: u64) -> Result<Measured, String> {
        let mut scenario = p.scenario.clone();
        scenario.field.seed = seed;
        let scene = scenario.build().map_err(|e| e.to_string())?;
        let gsd_m = scene.field.frame.gsd_m;
        let truth: Vec<[f64; 2]> = scene.field.plants.iter().map(|p| [p.u_px, p.v_px]).collect();
        let mask = scene.mask();
        let mask = Mask {
            width: mask.width() as usize,
            height: mask.height() as usize,
            data: mask.into_raw(),
        };
        let pixels = mask.count() as f64;
        let detection = rows::detect(&mask);
        let plants = ((truth.len() as f64 * p.count_factor).round() as usize).max(1);
        let mut measured = Measured::default();
        measured.put("plants", truth.len() as f64);
        measured.put("pixels_per_plant", pixels / truth.len().max(1) as f64);
        if p.method != Method::Descent {
            let count = (p.method == Method::RowModel).then_some(plants);
            let found = row_model::locate(&mask, &detection, count, &p.row_model);
            let found = found.map_err(|e| e.to_string())?;
            let places: Vec<[f64; 2]> = found.plants.iter().map(|s| s.position_px).collect();
            judge(&mut measured, &places, &truth, &scenario.field)?;
            if p.positions {
                measured.traces.push(positions(&places, &truth));
            }
            return Ok(measured);
        }
        let model = Model {
            floor_px: p.floor_m / gsd_m,
            tempering: (p.tempering > 0.0).then_some(p.tempering),
            truncate_px: (p.truncate_m > 0.0).then_some(p.truncate_m / gsd_m),
            ..p.model
        };
        let init = match p.start {
            Start::KmeansPlusPlus => Init::KmeansPlusPlus,
            Start::Rows => Init::Rows,
            Start::Random | Start::Truth => Init::Random,
        };
        let descent = descent::CoordinateDescentOptions { seed, ..p.descent };
        let options =
            PlantFitOptions { plants, model, init, seed, descent, max_sweeps: p.max_sweeps };
        let index = PixelIndex::from_mask(mask.width, &mask.data);
        let mut setup = Setup::new(index, &options, detection).map_err(|e| e.to_string())?;
        if p.start == Start::Truth {
            let found = setup.detection.rows().map_or(&[][..], |rows| &rows.rows);
            let across: Vec<f64> = found.iter().map(|row| row.across_px).collect();
            setup.field =
                setup.problem.field(truth.clone(), &across, &[]).map_err(|e| e.to_string())?;
        }
        let mut trace = Trace::new("sweeps", &["sweep", "cost_per_pixel", "moved_px"]);
        let outcome = descent::run(
            &setup.problem,
            &mut setup.field,
            options.descent,
            options.max_sweeps,
            |sweep, step| {
                trace.rows.push(vec![sweep as f64, step.cost / pixels, step.step_norm]);
            },
        )
        .map_err(|e| e.to_string())?;
        let located = setup.finish();
        let found: Vec<[f64; 2]> = located.plants.iter().map(|plant| plant.position_px).collect();
        judge(&mut measured, &found, &truth, &scenario.field)?;
        measured.put("sweeps", outcome.iterations as f64);
        measured.put("cost_per_pixel", outcome.final_cost / pixels);
        measured.put("sigma_m", located.sigma_px * gsd_m);
        if p.trace {
            measured.traces.push(trace);
        }
        if p.positions {
            measured.traces.push(positions(&found, &truth));
        }
        Ok(measured)
    }
}

fn judge(
    measured: &mut Measured,
    found: &[[f64; 2]],
    truth: &[[f64; 2]],
    field: &FieldConfig,
) -> Result<(), String> {
    let gsd_m = field.gsd_m;
    let radii_px = [0.05 / gsd_m, 0.10 / gsd_m];
    let quarter = Score::new(found, truth, &[0.25 * field.spacing_m / gsd_m]);
    measured.put_some("f1_quarter", quarter.map_err(|e| e.to_string())?.radii[0].f1);
    let score = Score::new(found, truth, &radii_px).map_err(|e| e.to_string())?;
    measured.put_some("f1_5cm", score.radii[0].f1);
    measured.put_some("f1_10cm", score.radii[1].f1);
    measured.put_some("precision_5cm", score.radii[0].precision);
    measured.put_some("recall_5cm", score.radii[0].recall);
    measured.put_some("median_error_m", score.median_error_px.map(|px| px * gsd_m));
    measured.put("count_error", score.count_error as f64 / truth.len().max(1) as f64);
    measured.put_some("moved_m", nearest(truth, found).map(|px| px * gsd_m));
    Ok(())
}

fn positions(found: &[[f64; 2]], truth: &[[f64; 2]]) -> Trace {
    let mut trace = Trace::new("positions", &["u_px", "v_px", "true"]);
    let all = found.iter().map(|at| (at, 0.0)).chain(truth.iter().map(|at| (at, 1.0)));
    trace.rows.extend(all.map(|(at, what)| vec![at[0], at[1], what]));
    trace
}

/// Median over the true plants of the distance to the nearest found one.
fn nearest(truth: &[[f64; 2]], found: &[[f64; 2]]) -> Option<f64> {
    median(truth.iter().map(|t| {
        let apart = found.iter().map(|f| (f[0] - t[0]).hypot(f[1] - t[1]));
        apart.fold(f64::INFINITY, f64::min)
    }))
}

/// Used by the map of the cost: how far a pixel counts.
pub(super) fn share(update: PlantUpdate, distance: f64) -> f64 {
    match update {
        PlantUpdate::Mean => distance * distance,
        PlantUpdate::Median => distance,
    }
}
