//! Instances of few parameters, posed from synthetic fields: one plant, one leaf.
//!
//! **Plant.** `w sum_n |z_n - x| + sum_k (n_k^T x - c_k)^2 / 2 s_k^2` over the place `x` of one plant, with
//! the leaf pixels `z_n` that are nearest to it. It is convex and not smooth at its pixels.
//!
//! **Leaf.** The ends of slices across a leaf, by side `e = +-1`, against a parabola as axis and half the
//! width `h`:
//!
//! ```text
//! r = e (q - d - k s^2 / 2) - h(s / L),    h(u) = (1 - u) (a + b u)
//! ```
//!
//! with `s` along and `q` across a direction `theta` from the collar; the parameters are
//! `d, theta, k, L, a, b`.

use super::{
    flat_problem::{Chart, Charted, Weighing},
    instances::{Draws, Instance, OnePlant, Ranges},
};
use data_synth::{
    field::GrowthStage,
    scenario::{Scenario, Scene},
};
use rowgram::{
    nlls::{BlockId, Euclidean, Factor, Factors, Infeasible, Jacobian, Loss, Problem},
    problems::plants::{Quadratic, index::PixelIndex},
};
use std::sync::Arc;

/// Fewest pixels that a plant may have.
const PIXELS: usize = 5;

/// A leaf pixel, drawn to the plant.
struct Pixel {
    blocks: [BlockId; 1],
    at: [f64; 2],
}

impl Factor for Pixel {
    fn rows(&self) -> usize {
        2
    }

    fn blocks(&self) -> &[BlockId] {
        &self.blocks
    }

    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        jacobian: Option<&mut Jacobian<'_>>,
    ) -> Result<(), Infeasible> {
        for k in 0..2 {
            residual[k] = x[0][k] - self.at[k];
        }
        if let Some(jacobian) = jacobian {
            jacobian.row(0).copy_from_slice(&[1.0, 0.0]);
            jacobian.row(1).copy_from_slice(&[0.0, 1.0]);
        }
        Ok(())
    }
}

/// A line that the plant is near, in standard deviations.
struct LinePrior {
    blocks: [BlockId; 1],
    normal: [f64; 2],
    offset: f64,
}

impl Factor for LinePrior {
    fn rows(&self) -> usize {
        1
    }

    fn blocks(&self) -> &[BlockId] {
        &self.blocks
    }

    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        jacobian: Option<&mut Jacobian<'_>>,
    ) -> Result<(), Infeasible> {
        residual[0] = self.normal[0] * x[0][0] + self.normal[1] * x[0][1] - self.offset;
        if let Some(jacobian) = jacobian {
            jacobian.row(0).copy_from_slice(&self.normal);
        }
        Ok(())
    }
}

fn scene(draws: &mut Draws, seed: u64, gsd_m: f64) -> Result<Scene, String> {
    let mut scenario = Scenario::default();
    let field = &mut scenario.field;
    (field.seed, field.gsd_m) = (seed, gsd_m);
    (field.rows, field.row_length_m, field.margin_m) = (2, 2.0, 0.4);
    field.spacing_m = draws.log_uniform([0.1, 0.3]);
    field.heading_deg = draws.uniform([-60.0, 60.0]);
    field.stage = [GrowthStage::Early, GrowthStage::Mid, GrowthStage::Late][draws.below(3)];
    scenario.build().map_err(|e| e.to_string())
}

/// The inner problem of one plant of a field.
pub(super) fn plant(ranges: &Ranges, draws: &mut Draws, seed: u64) -> Result<Instance, String> {
    let gsd_m = draws.log_uniform(ranges.plant_gsd_m);
    let scene = scene(draws, seed, gsd_m)?;
    let mask = scene.mask();
    let index = PixelIndex::from_mask(mask.width() as usize, mask.as_raw());
    let places: Vec<[f64; 2]> = scene.field.plants.iter().map(|p| [p.u_px, p.v_px]).collect();
    let mut mine: Vec<Vec<[f64; 2]>> = vec![Vec::new(); places.len()];
    for at in (0..index.len()).map(|pixel| index.position(pixel)) {
        let apart = |p: &[f64; 2]| (p[0] - at[0]).hypot(p[1] - at[1]);
        let nearest =
            (0..places.len()).min_by(|&a, &b| apart(&places[a]).total_cmp(&apart(&places[b])));
        if let Some(nearest) = nearest {
            mine[nearest].push(at);
        }
    }
    let able: Vec<usize> = (0..places.len()).filter(|&p| mine[p].len() >= PIXELS).collect();
    if able.is_empty() {
        return Err(format!("no plant has {PIXELS} pixels"));
    }
    let chosen = able[draws.below(able.len())];
    let away_px = 0.05 * draws.log_uniform(ranges.start_scale) / gsd_m;
    let start = places[chosen].map(|at| at + draws.normal(away_px));
    let (u_px, v_px): (Vec<f64>, Vec<f64>) =
        mine[chosen].iter().map(|at| (at[0] - start[0], at[1] - start[1])).unzip();
    let lengths = u_px.iter().zip(&v_px).map(|(u, v)| u.hypot(*v));
    let sigma_px = lengths.sum::<f64>() / u_px.len() as f64;
    let weight = draws.log_uniform([0.03, 1.0]) / sigma_px;
    let turn = scene.field.config.heading_rad();
    let along = [turn.cos(), -turn.sin()];
    let across = [turn.sin(), turn.cos()];
    let mut prior = Quadratic::default();
    let mut problem = Problem::new();
    let failed = |e: rowgram::engine::SolveError| e.to_string();
    let block = problem.block("plant", Euclidean(2), &[0.0, 0.0]).map_err(failed)?;
    let mut lines = Vec::new();
    for (normal, deviation_m) in [(along, draws.uniform([0.02, 0.1])), (across, 0.015)] {
        let deviation_px = deviation_m / gsd_m;
        let to_truth =
            normal[0] * (places[chosen][0] - start[0]) + normal[1] * (places[chosen][1] - start[1]);
        let offset = to_truth + draws.normal(deviation_px);
        prior.add(normal, offset, deviation_px * deviation_px);
        lines.push(LinePrior {
            blocks: [block],
            normal: normal.map(|n| n / deviation_px),
            offset: offset / deviation_px,
        });
    }
    let pixels = u_px.iter().zip(&v_px).map(|(&u, &v)| Pixel { blocks: [block], at: [u, v] });
    let length = Weighing::Length(weight);
    problem.add("pixels", length, Factors(pixels.collect())).map_err(failed)?;
    problem.add("prior", Loss::Trivial, Factors(lines)).map_err(failed)?;
    Ok(Instance {
        charted: Arc::new(Charted {
            problem,
            charts: vec![Chart::Plain(2)],
            batches: vec![("pixels", length), ("prior", Weighing::Robust(Loss::Trivial))],
        }),
        hints: vec![vec![places[chosen][0] - start[0], places[chosen][1] - start[1]]],
        eliminates: false,
        free_frame: false,
        plant: Some(OnePlant { u_px, v_px, weight, prior }),
    })
}

/// One end of a slice, from the collar.
struct SliceEnd {
    blocks: [BlockId; 1],
    at: [f64; 2],
    side: f64,
}

impl Factor for SliceEnd {
    fn rows(&self) -> usize {
        1
    }

    fn blocks(&self) -> &[BlockId] {
        &self.blocks
    }

    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        jacobian: Option<&mut Jacobian<'_>>,
    ) -> Result<(), Infeasible> {
        let &[d, theta, curvature, length, a, b] = x[0] else { return Err(Infeasible) };
        if length <= 0.0 {
            return Err(Infeasible);
        }
        let (sin, cos) = theta.sin_cos();
        let s = self.at[0] * cos + self.at[1] * sin;
        let q = self.at[1] * cos - self.at[0] * sin;
        let u = s / length;
        residual[0] = self.side * (q - d - 0.5 * curvature * s * s) - (1.0 - u) * (a + b * u);
        if let Some(jacobian) = jacobian {
            // dh/du
            let slope = b * (1.0 - u) - (a + b * u);
            jacobian.row(0).copy_from_slice(&[
                -self.side,
                self.side * (-s - curvature * s * q) - slope * q / length,
                -0.5 * self.side * s * s,
                slope * s / (length * length),
                -(1.0 - u),
                -u * (1.0 - u),
            ]);
        }
        Ok(())
    }
}

/// Slices across one leaf of a field, as they are measured in a photo.
pub(super) fn leaf(ranges: &Ranges, draws: &mut Draws, seed: u64) -> Result<Instance, String> {
    /// Standard deviation of the ends of slices on the edge of a mask.
    const EDGE_PX: f64 = 0.5;
    let gsd_m = draws.log_uniform([0.001, 0.006]);
    let scene = scene(draws, seed, gsd_m)?;
    let field = &scene.field;
    let leaves: Vec<_> = field
        .plants
        .iter()
        .flat_map(|plant| plant.leaves.iter().map(move |l| (plant, l)))
        .collect();
    if leaves.is_empty() {
        return Err("a field without leaves".to_owned());
    }
    let (plant, leaf) = leaves[draws.below(leaves.len())];
    let axis: Vec<[f64; 2]> = field
        .leaf_axis_m(plant.z_m, leaf)
        .iter()
        .map(|&[x, y, _]| field.frame.pixel(x, y))
        .collect();
    let half_px: Vec<f64> = leaf.half_width_m.iter().map(|m| m / field.frame.gsd_m).collect();
    let slices = draws.log_uniform(ranges.slices).round() as usize;
    let robust = [Loss::Huber(1.0), Loss::Cauchy(1.5), Loss::SoftL1(1.0)];
    let (gross, loss) = draws.loss(ranges, &robust);
    let (base, nodes) = (axis[0], axis.len() - 1);
    let mut problem = Problem::new();
    let failed = |e: rowgram::engine::SolveError| e.to_string();
    let chord = [axis[nodes][0] - base[0], axis[nodes][1] - base[1]];
    let (reach, direction) = (chord[0].hypot(chord[1]).max(4.0), chord[1].atan2(chord[0]));
    let scale = draws.log_uniform(ranges.start_scale);
    let theta = direction + draws.normal(0.15 * scale);
    let widest = half_px.iter().copied().fold(1.0, f64::max);
    let stretch = draws.normal(0.2 * scale).exp().clamp(0.5, 2.5);
    let start = [0.0, theta, 0.0, reach * stretch, 0.7 * widest, 0.0];
    let block = problem.block("leaf", Euclidean(6), &start).map_err(failed)?;
    let mut ends = Vec::with_capacity(2 * slices);
    for k in 0..slices {
        let place = (k as f64 + 0.5) / slices as f64 * nodes as f64;
        let (node, part) = (place as usize, place.fract());
        let between = |a: f64, b: f64| a + (b - a) * part;
        let [low, high] = [axis[node], axis[node + 1]];
        let step = [high[0] - low[0], high[1] - low[1]];
        let length = step[0].hypot(step[1]).max(1e-6);
        let across = [-step[1] / length, step[0] / length];
        let half = between(half_px[node], half_px[node + 1]);
        for side in [1.0, -1.0] {
            let mut out = half + draws.normal(EDGE_PX);
            // The slice runs on along a leaf that crosses.
            if draws.uniform([0.0, 1.0]) < gross {
                out += draws.uniform([4.0, 40.0]);
            }
            let at = std::array::from_fn(|i| {
                between(low[i], high[i]) + side * out * across[i] - base[i]
            });
            ends.push(SliceEnd { blocks: [block], at, side });
        }
    }
    problem.add("slices", loss, Factors(ends)).map_err(failed)?;
    let hints = [0.0, 0.03, -0.03]
        .map(|turn| vec![0.0, direction + turn, 0.0, 1.05 * reach, 0.7 * widest, 0.5 * widest]);
    Ok(Instance {
        charted: Arc::new(Charted {
            problem,
            charts: vec![Chart::Plain(6)],
            batches: vec![("slices", Weighing::Robust(loss))],
        }),
        hints: hints.to_vec(),
        eliminates: false,
        free_frame: false,
        plant: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stages::{flat_problem::check_gradient, instances::Family};

    #[test]
    fn gradients_are_differences_of_the_costs() {
        for (family, away) in [(Family::Plant, 0.3), (Family::Leaf, 0.02)] {
            for seed in 1..6 {
                let found = Instance::draw(family, &Ranges::default(), seed).unwrap();
                let charted = Arc::try_unwrap(found.charted).unwrap();
                check_gradient(charted, away, 1e-3);
            }
        }
    }
}
