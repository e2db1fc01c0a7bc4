//! The cost of one plant's place while its neighbours are held: the paper's figure of seven plants.
//!
//! ```text
//! J(x) = sum_n min(d(Z_n, x), min_{q != p} d(Z_n, X_q)),   on every pixel x around plant p
//! ```
//!
//! with `d` the distance or its square, no prior. The figure flatters this cost: the other plants stand
//! at their true places, which nobody knows. `neighbours_off_m` moves them.

use super::locate::share;
use crate::{
    stage::{Measured, Metric, Stage, Trace, metric},
    streams::{Stream, stream},
};
use data_synth::scenario::Scenario;
use rand::RngExt;
use rowgram::problems::plants::PlantUpdate;
use serde::{Deserialize, Serialize};

/// What can be varied.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Parameters {
    scenario: Scenario,
    /// Squared distances (mean) or distances (median).
    update: PlantUpdate,
    /// Standard deviation of the held plants about their true places, each coordinate, metres.
    neighbours_off_m: f64,
    /// How far about the true place the cost is mapped, metres.
    reach_m: f64,
    /// Whether the map itself is kept.
    trace: bool,
}

impl Default for Parameters {
    fn default() -> Parameters {
        let mut scenario = Scenario::default();
        let field = &mut scenario.field;
        (field.rows, field.row_length_m, field.spacing_m) = (1, 1.4, 0.2);
        (field.missing_fraction, field.doubles_fraction, field.margin_m) = (0.0, 0.0, 0.4);
        Parameters {
            scenario,
            update: PlantUpdate::Mean,
            neighbours_off_m: 0.0,
            reach_m: 0.3,
            trace: false,
        }
    }
}

/// The stage.
pub(crate) struct CostMap;

impl Stage for CostMap {
    type Parameters = Parameters;
    const NAME: &'static str = "cost-map";
    const ABOUT: &'static str = "the cost of one plant's place while its neighbours are held";
    const METRICS: &'static [Metric] = &[
        metric("error_m", "distance of the place of least cost from the true one"),
        metric("minima", "local minima of the cost on the pixel grid"),
        metric("within_5cm", "1 where the least cost is within 5 cm of the truth"),
        metric("cost_at_truth", "cost at the true place over the least one"),
        metric("plants", "plants in the row"),
    ];
    const SEEDED: &'static [&'static str] = &["scenario.field.seed"];

    fn check(p: &Parameters) -> Result<(), String> {
        p.scenario.check().map_err(|e| e.to_string())?;
        if !(p.neighbours_off_m >= 0.0 && p.reach_m > 0.0 && p.reach_m < 5.0) {
            return Err("neighbours_off_m has to be 0 or more, reach_m between 0 and 5".to_owned());
        }
        Ok(())
    }

    fn run(p: &Parameters, seed: u64) -> Result<Measured, String> {
        let mut scenario = p.scenario.clone();
        scenario.field.seed = seed;
        let scene = scenario.build().map_err(|e| e.to_string())?;
        let gsd_m = scene.field.frame.gsd_m;
        let mask = scene.mask();
        let mut plants: Vec<[f64; 2]> =
            scene.field.plants.iter().map(|plant| [plant.u_px, plant.v_px]).collect();
        let free = plants.len() / 2;
        let truth = *plants.get(free).ok_or("the row has no plants")?;
        let mut rng = stream(seed, Stream::Start);
        let spread = p.neighbours_off_m / gsd_m;
        for (q, plant) in plants.iter_mut().enumerate() {
            // Two uniform numbers, turned normal (Box and Muller); drawn for every plant.
            let (a, b): (f64, f64) = (rng.random(), rng.random());
            let length = spread * (-2.0 * (1.0 - a).ln()).sqrt();
            let turn = std::f64::consts::TAU * b;
            if q != free {
                *plant = [plant[0] + length * turn.cos(), plant[1] + length * turn.sin()];
            }
        }
        let held = |at: [f64; 2]| {
            let others = plants.iter().enumerate().filter(|(q, _)| *q != free);
            others
                .map(|(_, x)| share(p.update, (x[0] - at[0]).hypot(x[1] - at[1])))
                .fold(f64::INFINITY, f64::min)
        };
        let pixels: Vec<([f64; 2], f64)> = mask
            .enumerate_pixels()
            .filter(|(_, _, pixel)| pixel.0[0] != 0)
            .map(|(u, v, _)| ([f64::from(u), f64::from(v)], [f64::from(u), f64::from(v)]))
            .map(|(at, place)| (at, held(place)))
            .collect();
        let cost = |x: [f64; 2]| -> f64 {
            let each = |(z, other): &([f64; 2], f64)| {
                share(p.update, (z[0] - x[0]).hypot(z[1] - x[1])).min(*other)
            };
            pixels.iter().map(each).sum()
        };
        let reach = (p.reach_m / gsd_m).ceil() as i64;
        let side = (2 * reach + 1) as usize;
        let centre = truth.map(f64::round);
        let place = |k: usize| {
            let offset = [(k % side) as i64 - reach, (k / side) as i64 - reach];
            [centre[0] + offset[0] as f64, centre[1] + offset[1] as f64]
        };
        let costs: Vec<f64> = (0..side * side).map(|k| cost(place(k))).collect();
        let best = (0..costs.len())
            .min_by(|&a, &b| costs[a].total_cmp(&costs[b]))
            .ok_or("there is nothing to map")?;
        let at = place(best);
        let error_m = (at[0] - truth[0]).hypot(at[1] - truth[1]) * gsd_m;
        let mut measured = Measured::default();
        measured.put("error_m", error_m);
        measured.put("minima", minima(&costs, side) as f64);
        measured.put("within_5cm", f64::from(error_m <= 0.05));
        measured.put("cost_at_truth", cost(truth) / costs[best]);
        measured.put("plants", plants.len() as f64);
        if p.trace {
            let mut map = Trace::new("cost", &["u_px", "v_px", "cost"]);
            map.rows = (0..costs.len())
                .map(|k| {
                    let [u, v] = place(k);
                    vec![u, v, costs[k] / costs[best]]
                })
                .collect();
            let mut dots = Trace::new("truth", &["u_px", "v_px"]);
            dots.rows.push(truth.to_vec());
            // Leaf pixels in a dark grey; what is not listed stays white.
            let mut shown = Trace::new("mask", &["u_px", "v_px", "grey"]);
            shown.rows = pixels.iter().map(|(at, _)| vec![at[0], at[1], 60.0]).collect();
            measured.traces.extend([map, dots, shown]);
        }
        Ok(measured)
    }
}

/// Places lower than all eight neighbours, the rim left out.
fn minima(costs: &[f64], side: usize) -> usize {
    let inner = 1..side.saturating_sub(1);
    let lowest = |u: usize, v: usize| {
        let here = costs[v * side + u];
        let around = [v - 1, v, v + 1].into_iter().flat_map(|y| [(u - 1, y), (u, y), (u + 1, y)]);
        around.filter(|&at| at != (u, v)).all(|(x, y)| costs[y * side + x] > here)
    };
    inner
        .clone()
        .flat_map(|v| inner.clone().map(move |u| (u, v)))
        .filter(|&(u, v)| lowest(u, v))
        .count()
}
