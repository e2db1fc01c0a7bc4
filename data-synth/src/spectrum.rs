//! Reflectances of a field from straight above in five bands, with the truth of every plot and plant.
//!
//! A pixel shows a leaf or soil (the pixel rule of [`crate::render`]); what it reflects in band `b` is `light r_b`, where `light` is the
//! brightness of the same pixel of [`crate::picture`] over that of its kind in full sun, and
//!
//! ```text
//! leaf:  r = base_b + pale_b (1 - c),  c = c(plot) + N(0, 0.04) of the plant,  c(plot) from 0.3 to 1,
//! soil:  r = soil_b m,  in the near infrared also times n;  m, n of the plot, 0.75 to 1.25 and 0.9 to 1.15.
//! ```
//!
//! `c` is a health between pale and dark green: pale leaves reflect more red and less near infrared. The truth is of these numbers; what
//! a camera measures of them has noise. Numbers are of the order of published spectra of maize and loam, and made up.

use crate::{
    labels::{Labels, labels},
    picture,
    scenario::Scene,
    streams::{Draw, Stage, pair, stream},
};
use rayon::prelude::*;

/// The bands: blue, green, red, red edge, near infrared.
pub const BANDS: usize = 5;
const RED: usize = 2;
const RED_EDGE: usize = 3;
const NIR: usize = 4;
/// Of a leaf of full health, what is added where it has none, and of soil.
const LEAF: [f64; BANDS] = [0.03, 0.08, 0.03, 0.20, 0.50];
const PALE: [f64; BANDS] = [0.02, 0.05, 0.07, 0.12, -0.08];
const SOIL: [f64; BANDS] = [0.07, 0.11, 0.15, 0.18, 0.22];
/// Standard deviation of the noise of a measured reflectance.
const NOISE: f64 = 0.004;
/// What a dark pixel reflects at least.
const LEAST: f64 = 1e-3;
/// Brightness of leaf and soil in full sun in [`crate::picture`], 8 bits, by eye; how much of it a pixel has at least and at most.
const SUNLIT: [f64; 2] = [165.0, 142.0];
const LIGHT: [f64; 2] = [0.35, 1.4];
/// Health of weeds.
const WEED_HEALTH: f64 = 0.7;

/// The true reflectances of a field.
#[derive(Debug, Clone, PartialEq)]
pub struct Spectra {
    /// Number of columns.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
    /// Of each pixel, row by row.
    pub data: Vec<[f32; BANDS]>,
    /// Whether it shows a leaf.
    pub is_leaf: Vec<bool>,
    /// The plots.
    pub plots: Vec<PlotTruth>,
    /// Mean NDVI of the pixels that show each plant; none where nothing of it is seen.
    pub plants_ndvi: Vec<Option<f64>>,
    seed: u64,
}

/// What is true of a plot.
#[derive(Debug, Clone, PartialEq)]
pub struct PlotTruth {
    /// Its corners, pixels, in order around it.
    pub corners_px: [[f64; 2]; 4],
    /// Share of its pixels that show leaf.
    pub leaf_share: f64,
    /// Mean NDVI of its pixels, and of those that show leaf.
    pub ndvi: [f64; 2],
    /// Mean NDRE likewise.
    pub ndre: [f64; 2],
}

/// The part of a plot in the axes of the field, metres: from and to, along and across.
struct Extent {
    along_m: [f64; 2],
    across_m: [f64; 2],
}

fn normalized(pixel: &[f32; BANDS], band: usize) -> f64 {
    let [a, b] = [NIR, band].map(|k| f64::from(pixel[k]));
    (a - b) / (a + b)
}

/// The reflectances of a scene. Curved rows have straight plots.
pub fn spectra(scene: &Scene) -> Spectra {
    let field = &scene.field;
    let (config, frame) = (&field.config, &field.frame);
    let picture = picture::picture(field, &scene.weeds);
    let Labels { width, height, data: labels } = labels(field, &scene.weeds);
    let extents = extents(scene);
    let of_plot = |plot: usize| {
        let mut rng = stream(config.seed, Stage::PlotSpectrum, plot as u64);
        let health = rng.between(0.3, 1.0);
        (health, [rng.between(0.75, 1.25), rng.between(0.9, 1.15)])
    };
    // Ground between plots is like that of a plot of its own.
    let plots: Vec<(f64, [f64; 2])> = (0..=extents.len()).map(of_plot).collect();
    let mut plant_of_leaf = Vec::new();
    let mut health = Vec::new();
    for (number, plant) in field.plants.iter().enumerate() {
        let mut rng = stream(
            config.seed,
            Stage::PlantSpectrum,
            pair(plant.row, 2 * plant.site + usize::from(plant.second)),
        );
        let of_plot = plots.get(plant.plot).map_or(WEED_HEALTH, |plot| plot.0);
        health.push((of_plot + 0.04 * rng.normal()).clamp(0.0, 1.1));
        plant_of_leaf.extend(plant.leaves.iter().map(|_| number));
    }
    let plot_at = |u: usize, v: usize| {
        let [x, y] = frame.ground(u as f64, v as f64);
        let [along, across] = config.along_across(x, y);
        extents.iter().position(|of| {
            (of.along_m[0]..of.along_m[1]).contains(&along)
                && (of.across_m[0]..of.across_m[1]).contains(&across)
        })
    };
    let pixel = |k: usize| -> ([f32; BANDS], Option<usize>) {
        let plot = plot_at(k % width, k / width);
        let colour = picture.as_raw()[3 * k..3 * k + 3].iter().copied().max().unwrap_or(0);
        let is_leaf = labels[k] > 0;
        let sunlit = SUNLIT[usize::from(!is_leaf)];
        let light = (f64::from(colour) / sunlit).clamp(LIGHT[0], LIGHT[1]);
        let [moisture, slope] = plots[plot.unwrap_or(extents.len())].1;
        let reflectance = |band: usize| {
            let full = if is_leaf {
                let plant = plant_of_leaf.get(labels[k] as usize - 1);
                let pale = 1.0 - plant.map_or(WEED_HEALTH, |&plant| health[plant]);
                LEAF[band] + PALE[band] * pale
            } else {
                SOIL[band] * moisture * if band == NIR { slope } else { 1.0 }
            };
            (light * full).max(LEAST) as f32
        };
        (std::array::from_fn(reflectance), plot)
    };
    let (data, plot_of): (Vec<_>, Vec<_>) = (0..width * height).into_par_iter().map(pixel).unzip();
    // Sums of leaf share, NDVI and NDRE of all pixels and of leaf pixels.
    let mut sums = vec![[[0.0; 3]; 2]; extents.len()];
    let mut of_plants = vec![[0.0; 2]; field.plants.len()];
    for (k, pixel) in data.iter().enumerate() {
        let values = [1.0, normalized(pixel, RED), normalized(pixel, RED_EDGE)];
        let is_leaf = labels[k] > 0;
        if let Some(plot) = plot_of[k] {
            for sum in sums[plot].iter_mut().take(1 + usize::from(is_leaf)) {
                sum.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
            }
        }
        if let Some(&plant) = is_leaf.then(|| plant_of_leaf.get(labels[k] as usize - 1)).flatten() {
            of_plants[plant][0] += 1.0;
            of_plants[plant][1] += values[1];
        }
    }
    let plots = extents.iter().zip(sums).map(|(extent, [all, leaf])| PlotTruth {
        corners_px: corners(extent).map(|[along, across]| {
            let [x, y] = config.ground(along, across);
            frame.pixel(x, y)
        }),
        leaf_share: leaf[0] / all[0],
        ndvi: [all[1] / all[0], leaf[1] / leaf[0]],
        ndre: [all[2] / all[0], leaf[2] / leaf[0]],
    });
    let plants_ndvi = of_plants.iter().map(|[n, sum]| (*n > 0.0).then(|| sum / n)).collect();
    Spectra {
        width,
        height,
        plots: plots.collect(),
        plants_ndvi,
        is_leaf: labels.iter().map(|&label| label > 0).collect(),
        data,
        seed: config.seed,
    }
}

impl Spectra {
    /// What a camera measures: with noise in each band of each pixel.
    pub fn measured(&self) -> Vec<[f32; BANDS]> {
        let mut data = self.data.clone();
        data.par_chunks_mut(self.width.max(1)).enumerate().for_each(|(row, pixels)| {
            let mut rng = stream(self.seed, Stage::BandNoise, row as u64);
            for value in pixels.iter_mut().flatten() {
                *value = (f64::from(*value) + NOISE * rng.normal()).max(0.1 * LEAST) as f32;
            }
        });
        data
    }
}

/// The plots, numbered along the rows first.
fn extents(scene: &Scene) -> Vec<Extent> {
    let config = &scene.field.config;
    let [side, along] = config.plots.count(config.rows, config.row_length_m);
    let half_m = 0.5 * config.inter_row_m;
    let of = |plot: usize| {
        let ([first, last], along_m) = config.plots.extent(config.rows, config.row_length_m, plot);
        let across = |row: usize| config.row_across(row, -0.5 * config.row_length_m);
        let (a, b) = (across(first), across(last));
        Extent { along_m, across_m: [a.min(b) - half_m, a.max(b) + half_m] }
    };
    (0..side * along).map(of).collect()
}

fn corners(of: &Extent) -> [[f64; 2]; 4] {
    let ([a, b], [c, d]) = (of.along_m, of.across_m);
    [[a, c], [b, c], [b, d], [a, d]]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{field::GrowthStage, habit::PlotConfig, scenario::Scenario};

    #[test]
    fn plots_differ_and_noise_does_not_bias() {
        let mut scenario = Scenario::default();
        scenario.field.rows = 4;
        scenario.field.stage = GrowthStage::Mid;
        scenario.field.plots = PlotConfig { rows: 2, length_m: 2.0, alley_m: 1.0 };
        let scene = scenario.build().unwrap();
        let found = spectra(&scene);
        assert_eq!(found.plots.len(), 4);
        let leaves = found.is_leaf.iter().filter(|&&leaf| leaf).count();
        let mask = scene.mask();
        assert_eq!(leaves, mask.iter().filter(|&&pixel| pixel != 0).count());
        for plot in &found.plots {
            assert!((0.6..0.95).contains(&plot.ndvi[1]) && plot.ndvi[0] < plot.ndvi[1], "{plot:?}");
            assert!((0.05..0.95).contains(&plot.leaf_share), "{plot:?}");
        }
        let low = found.plots.iter().map(|plot| plot.ndvi[1]).fold(1.0, f64::min);
        let high = found.plots.iter().map(|plot| plot.ndvi[1]).fold(0.0, f64::max);
        assert!(high - low > 0.02, "{low} {high}");
        let mean = |data: &[[f32; BANDS]]| {
            data.iter().map(|pixel| normalized(pixel, RED)).sum::<f64>() / data.len() as f64
        };
        let bias = mean(&found.measured()) - mean(&found.data);
        assert!(bias.abs() < 0.003, "{bias}");
        assert_eq!(found, spectra(&scene));
    }
}
