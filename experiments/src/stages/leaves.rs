//! Single leaves from slices across them, against the leaves of a synthetic field.
//!
//! A true leaf counts where at least half of it can be seen from above. It is found where the middle of a
//! found leaf is within 5 cm of its own middle, one to one.

use crate::stage::{Measured, Metric, Stage, Trace, metric};
use data_synth::{scenario::Scenario, visible::visible_fractions};
use rowgram::{
    phenotype::leaves::{Bridging, LeafOptions, Leaves, find},
    raster::Mask,
    score::matching,
};
use serde::{Deserialize, Serialize};

/// What can be varied.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Parameters {
    scenario: Scenario,
    /// How far the gradients of a slice may be from opposite, radians.
    t_a: f64,
    /// How far adjacent slices of a segment may differ, radians.
    t_b: f64,
    /// How far directions may differ across a gap, radians.
    t_c: f64,
    bridging: Bridging,
    curvature: bool,
    split: bool,
    /// The longest gap, in usual leaf widths.
    longest_gap: f64,
    min_pixels: usize,
    /// Whether pixels and axes of the leaves are kept.
    trace: bool,
}

impl Default for Parameters {
    fn default() -> Parameters {
        let mut scenario = Scenario::default();
        let field = &mut scenario.field;
        field.stage = data_synth::field::GrowthStage::Early;
        (field.rows, field.row_length_m, field.gsd_m) = (2, 3.0, 0.004);
        (field.margin_m, field.spacing_m) = (0.3, 0.25);
        let paper = LeafOptions::paper();
        Parameters {
            scenario,
            t_a: paper.edge_angle_rad,
            t_b: paper.slice_angle_rad,
            t_c: paper.gap_angle_rad,
            bridging: paper.bridging,
            curvature: paper.curvature,
            split: paper.split,
            longest_gap: paper.longest_gap_ratio,
            min_pixels: 10,
            trace: false,
        }
    }
}

/// The stage.
pub(crate) struct LeafSlices;

impl Stage for LeafSlices {
    type Parameters = Parameters;
    const NAME: &'static str = "leaves";
    const ABOUT: &'static str = "single leaves from slices across them";
    const METRICS: &'static [Metric] = &[
        metric("f1_5cm", "F1 of the middles of leaves at 5 cm"),
        metric("count_ratio", "found over visible true leaves"),
        metric("length_ratio", "median length of matched leaves, found over true"),
        metric("leaves", "visible true leaves"),
        metric("found", "leaves found"),
    ];
    const SEEDED: &'static [&'static str] = &["scenario.field.seed"];

    fn check(p: &Parameters) -> Result<(), String> {
        p.scenario.check().map_err(|e| e.to_string())?;
        let angles = [("t_a", p.t_a), ("t_b", p.t_b), ("t_c", p.t_c)];
        for (name, angle) in angles {
            if !(0.0..=std::f64::consts::PI).contains(&angle) {
                return Err(format!("{name} = {angle}: expected an angle from 0 to pi"));
            }
        }
        if p.longest_gap.is_nan() || p.longest_gap < 0.0 {
            return Err("longest_gap has to be 0 or more".to_owned());
        }
        Ok(())
    }

    fn run(p: &Parameters, seed: u64) -> Result<Measured, String> {
        let mut scenario = p.scenario.clone();
        scenario.field.seed = seed;
        let scene = scenario.build().map_err(|e| e.to_string())?;
        let picture = scene.mask();
        let mask = Mask {
            width: picture.width() as usize,
            height: picture.height() as usize,
            data: picture.into_raw(),
        };
        let options = LeafOptions {
            edge_angle_rad: p.t_a,
            slice_angle_rad: p.t_b,
            gap_angle_rad: p.t_c,
            bridging: p.bridging,
            curvature: p.curvature,
            split: p.split,
            longest_gap_ratio: p.longest_gap,
            min_pixels: p.min_pixels,
            ..LeafOptions::default()
        };
        let found = find(&mask, &options);
        let field = &scene.field;
        let seen = visible_fractions(field, &scene.weeds);
        let mut truth = Vec::new();
        let every =
            field.plants.iter().flat_map(|plant| plant.leaves.iter().map(move |l| (plant, l)));
        for ((plant, leaf), seen) in every.zip(seen) {
            let axis = field.leaf_axis_m(plant.z_m, leaf);
            let pixels = axis.map(|[x, y, _]| field.frame.pixel(x, y));
            if seen >= 0.5 {
                let length: f64 =
                    pixels.windows(2).map(|w| (w[1][0] - w[0][0]).hypot(w[1][1] - w[0][1])).sum();
                truth.push((pixels[pixels.len() / 2], length));
            }
        }
        let middles: Vec<[f64; 2]> = truth.iter().map(|(at, _)| *at).collect();
        let ours: Vec<[f64; 2]> = found.leaves.iter().map(|leaf| leaf.middle_px()).collect();
        let pairs = matching::within(&ours, &middles, 0.05 / field.frame.gsd_m);
        let mut ratios: Vec<f64> = pairs
            .iter()
            .map(|pair| found.leaves[pair.found].length_px / truth[pair.truth].1)
            .collect();
        ratios.sort_by(f64::total_cmp);
        let mut measured = Measured::default();
        let both = (ours.len() + truth.len()) as f64;
        measured.put("f1_5cm", 2.0 * pairs.len() as f64 / both);
        measured.put("count_ratio", ours.len() as f64 / truth.len() as f64);
        measured.put_some("length_ratio", ratios.get(ratios.len() / 2).copied());
        measured.put("leaves", truth.len() as f64);
        measured.put("found", ours.len() as f64);
        if p.trace {
            let segments = find(&mask, &LeafOptions { bridging: Bridging::None, ..options });
            measured.traces = traces(&found);
            measured.traces.push(pixels("segment_pixels", &segments));
            measured.traces.push(gradients(&mask));
        }
        Ok(measured)
    }
}

/// Pixels by leaf, and the slices.
fn traces(found: &Leaves) -> Vec<Trace> {
    let mut slices = Trace::new("slices", &["u_px", "v_px", "du_px", "dv_px"]);
    for leaf in &found.leaves {
        for (k, at) in leaf.axis_px.iter().enumerate() {
            let low = leaf.axis_px[k.saturating_sub(1)];
            let high = leaf.axis_px[(k + 1).min(leaf.axis_px.len() - 1)];
            let along = [high[0] - low[0], high[1] - low[1]];
            let length = along[0].hypot(along[1]);
            if length > 0.0 {
                let across = [-along[1] / length, along[0] / length];
                let wide = leaf.width_px[k];
                let foot = [at[0] - 0.5 * wide * across[0], at[1] - 0.5 * wide * across[1]];
                slices.rows.push(vec![foot[0], foot[1], wide * across[0], wide * across[1]]);
            }
        }
    }
    vec![pixels("leaf_pixels", found), slices]
}

/// Pixels by leaf; numbers repeat after seven.
fn pixels(name: &str, found: &Leaves) -> Trace {
    let mut pixels = Trace::new(name, &["u_px", "v_px", "colour"]);
    for (number, leaf) in found.leaves.iter().enumerate() {
        for run in &leaf.runs {
            for u in run.start..run.end {
                pixels.rows.push(vec![u as f64, run.v as f64, (number % 7) as f64]);
            }
        }
    }
    pixels
}

/// Directions of the gradient at the edge pixels of a mask, of unit length: differences of the means over
/// 3 x 3 pixels.
fn gradients(mask: &Mask) -> Trace {
    let mut trace = Trace::new("gradients", &["u_px", "v_px", "du", "dv"]);
    let leaf = |u: i64, v: i64| {
        let inside = (0..mask.width as i64).contains(&u) && (0..mask.height as i64).contains(&v);
        inside && mask.data[v as usize * mask.width + u as usize] != 0
    };
    let mean = |u: i64, v: i64| {
        let around = (-1..=1).flat_map(|j| (-1..=1).map(move |i| (i, j)));
        around.filter(|&(i, j)| leaf(u + i, v + j)).count() as f64 / 9.0
    };
    for v in 0..mask.height as i64 {
        for u in 0..mask.width as i64 {
            let beside = [(1, 0), (-1, 0), (0, 1), (0, -1)];
            if leaf(u, v) && beside.iter().any(|&(i, j)| !leaf(u + i, v + j)) {
                let (du, dv) = (mean(u + 1, v) - mean(u - 1, v), mean(u, v + 1) - mean(u, v - 1));
                let length = du.hypot(dv);
                if length > 0.0 {
                    trace.rows.push(vec![u as f64, v as f64, du / length, dv / length]);
                }
            }
        }
    }
    trace
}
