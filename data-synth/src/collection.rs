//! Photo collections for bundle adjustment: many cameras to a point, uneven tracks, clusters of cameras.
//!
//! The camera and the file are those of [`block`](crate::block). [`Layout::Places`] is what travellers bring home:
//! walls joined to a network of places, few of which most photos show, from all distances and with lenses of all
//! lengths. [`Layout::Street`] is a vehicle with four cameras on a closed road, part of which it drives twice. How many
//! images measure a point has a heavy tail,
//!
//! ```text
//! P(n or more) = (2/n)^a,   n = 2 .. the images that see it
//! ```
//!
//! with the exponent `a` that gives the number of measurements asked for, to the unit. Images are measured from the
//! nearest directions and scales first, as matching does it. The start has drifted from place to place by
//! similarities, on top of independent errors.

use crate::{
    block::{Block, Observation, measure_with},
    check::{self, ConfigError, within},
    collection_scene::{Scene, Wall},
    collection_start::{drifts, start_camera},
    streams::{Draw, Stage, stream},
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Where the photos are taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Layout {
    /// Places that many people photograph.
    Places,
    /// A road that a vehicle drives along.
    Street,
}

/// The parameters of a collection.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CollectionConfig {
    /// Decides everything random.
    pub seed: u64,
    /// Where the photos are taken.
    pub layout: Layout,
    /// Number of images.
    pub images: usize,
    /// Number of points.
    pub points: usize,
    /// Number of measurements.
    pub observations: usize,
    /// Number of places; not of a street.
    pub places: usize,
    /// Share of the photos of a place that show the place that it is joined to as well.
    pub joining_fraction: f64,
    /// Median principal distance, pixels.
    pub focal_px: f64,
    /// Standard deviation of its logarithm.
    pub focal_spread: f64,
    /// Standard deviation of each measured coordinate, pixels.
    pub sigma_px: f64,
    /// Probability that a measurement is gross.
    pub outlier_fraction: f64,
    /// Largest displacement of a gross measurement (the least is a fifth of it), pixels.
    pub outlier_px: f64,
    /// How far the start is from the truth.
    pub start: CollectionStart,
}

/// How far a collection's start is from the truth: standard deviations.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CollectionStart {
    /// Rotation of a place against the one it is joined to, about each axis, degrees.
    pub drift_deg: f64,
    /// Scale likewise, as a fraction.
    pub drift_scale: f64,
    /// Shift likewise, in each coordinate, metres.
    pub drift_m: f64,
    /// Rotation of a camera about each axis, degrees.
    pub rotation_deg: f64,
    /// Camera centre in each coordinate, metres.
    pub centre_m: f64,
    /// Point in each coordinate, metres.
    pub point_m: f64,
    /// Principal distance, as a fraction. Distortion starts at none.
    pub focal: f64,
}

impl Default for CollectionStart {
    fn default() -> CollectionStart {
        CollectionStart {
            drift_deg: 0.1,
            drift_scale: 0.002,
            drift_m: 0.03,
            rotation_deg: 0.1,
            centre_m: 0.05,
            point_m: 0.1,
            focal: 0.01,
        }
    }
}

/// Sizes of problems that the literature compares solvers on (Agarwal, Snavely, Seitz, Szeliski 2010).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CollectionPreset {
    /// 1,723 images along a street, 156,502 points.
    Ladybug1723,
    /// 257 images of a square, 65,132 points.
    Trafalgar257,
    /// 356 images of a town, 226,730 points.
    Dubrovnik356,
    /// 1,778 images of a city, 993,923 points.
    Venice1778,
}

impl CollectionConfig {
    /// A collection of the size of a known one.
    pub fn preset(preset: CollectionPreset) -> CollectionConfig {
        let (layout, images, points, observations, places) = match preset {
            CollectionPreset::Ladybug1723 => (Layout::Street, 1723, 156_502, 678_718, 0),
            CollectionPreset::Trafalgar257 => (Layout::Places, 257, 65_132, 225_911, 8),
            CollectionPreset::Dubrovnik356 => (Layout::Places, 356, 226_730, 1_255_268, 14),
            CollectionPreset::Venice1778 => (Layout::Places, 1778, 993_923, 5_001_946, 40),
        };
        let street = layout == Layout::Street;
        CollectionConfig {
            seed: 1,
            layout,
            images,
            points,
            observations,
            places,
            joining_fraction: 0.15,
            focal_px: if street { 700.0 } else { 2000.0 },
            focal_spread: if street { 0.002 } else { 0.25 },
            sigma_px: 0.5,
            outlier_fraction: 0.0,
            outlier_px: 60.0,
            start: CollectionStart::default(),
        }
    }

    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter that cannot be used: its name, its value and what was expected.
    pub fn check(&self) -> Result<(), ConfigError> {
        check::seed(self.seed)?;
        within("images", self.images, 12..=100_000)?;
        within("points", self.points, 10 * self.images..=100_000_000)?;
        within("observations", self.observations, 2 * self.points..=1_000_000_000)?;
        if self.layout == Layout::Places {
            within("places", self.places, 1..=self.images / 12)?;
        }
        within("joining_fraction", self.joining_fraction, 0.0..=1.0)?;
        within("focal_px", self.focal_px, 400.0..=20_000.0)?;
        within("focal_spread", self.focal_spread, 0.0..=0.5)?;
        within("sigma_px", self.sigma_px, 0.0..=1000.0)?;
        within("outlier_fraction", self.outlier_fraction, 0.0..=1.0)?;
        within("outlier_px", self.outlier_px, 0.0..=100_000.0)?;
        within("start.drift_deg", self.start.drift_deg, 0.0..=10.0)?;
        within("start.drift_scale", self.start.drift_scale, 0.0..=0.1)?;
        within("start.drift_m", self.start.drift_m, 0.0..=10.0)?;
        within("start.rotation_deg", self.start.rotation_deg, 0.0..=10.0)?;
        within("start.centre_m", self.start.centre_m, 0.0..=5.0)?;
        within("start.point_m", self.start.point_m, 0.0..=5.0)?;
        within("start.focal", self.start.focal, 0.0..=0.2)
    }

    /// Takes the photos and measures them.
    ///
    /// # Errors
    /// As [`CollectionConfig::check`], and where the images see the points less often than `observations` asks for.
    pub fn photograph(&self) -> Result<Block, ConfigError> {
        self.check()?;
        let scene = Scene::new(self);
        let placed: Option<Vec<Placed>> =
            (0..self.points).into_par_iter().map(|point| place(self, &scene, point)).collect();
        let Some(placed) = placed else {
            let expected = "another seed: an image shares no part of a wall with another";
            return Err(ConfigError::new("seed", self.seed, expected));
        };
        let lengths = track_lengths(self, &placed)?;
        let errors = (self.sigma_px, self.outlier_fraction, self.outlier_px);
        let observations: Vec<Observation> = placed
            .par_iter()
            .enumerate()
            .flat_map_iter(|(point, placed)| {
                let mut seen: Vec<(usize, [f64; 2])> = placed.seen[..lengths[point]]
                    .iter()
                    .filter_map(|&view| {
                        let view = view as usize;
                        Some((view, scene.views[view].forward.project(placed.place_m)?))
                    })
                    .collect();
                seen.sort_by_key(|&(view, _)| view);
                measure_with(self.seed, errors, point, seen)
            })
            .collect();
        let drifts = drifts(self, &scene.walls);
        let cameras_true: Vec<[f64; 9]> = scene.views.iter().map(|view| view.camera).collect();
        let cameras_start = scene
            .views
            .iter()
            .enumerate()
            .map(|(k, view)| start_camera(self, k, &view.forward, &drifts[view.walls[0]]))
            .collect();
        let points_start = placed
            .iter()
            .enumerate()
            .map(|(point, placed)| {
                let mut rng = stream(self.seed, Stage::BlockPointStart, point as u64);
                let at = drifts[placed.wall].apply(placed.place_m);
                at.map(|value| value + self.start.point_m * rng.normal())
            })
            .collect();
        let points_true = placed.iter().map(|placed| placed.place_m).collect();
        Ok(Block { cameras_true, points_true, cameras_start, points_start, observations })
    }
}

/// A point and the views that see it, its owner first, then those that match it best.
#[derive(Debug)]
struct Placed {
    place_m: [f64; 3],
    wall: usize,
    seen: Vec<u32>,
}

/// Relief of the walls: standard deviation and most, metres.
const RELIEF_M: (f64, f64) = (1.2, 3.5);
/// The steepest ray that a wall is seen under, cosine to its normal.
const MIN_COSINE: f64 = 0.2;
/// Most views of which a point's order is kept.
const MAX_VIEWS: usize = 1000;

/// A point that view `point mod images` sees; `None` where no second view ever does.
fn place(config: &CollectionConfig, scene: &Scene, point: usize) -> Option<Placed> {
    let owner = point % scene.views.len();
    let view = &scene.views[owner];
    let mut rng = stream(config.seed, Stage::CollectionPoint, point as u64);
    for _ in 0..2000 {
        let wall_at = *view.walls.get((rng.unit().powi(2) * view.walls.len() as f64) as usize)?;
        let wall = &scene.walls[wall_at];
        let s_m = wall.half_width_m * rng.between(-1.0, 1.0);
        let z_m = wall.height_m * rng.unit();
        let out_m = (RELIEF_M.0 * rng.normal()).clamp(-RELIEF_M.1, RELIEF_M.1);
        let place_m = wall.at(s_m, z_m, out_m);
        let Some(own) = sight(scene, owner, wall, place_m) else { continue };
        let mut seen: Vec<(f64, u32)> = scene.viewers[wall_at]
            .iter()
            .filter(|&&other| other as usize != owner)
            .filter_map(|&other| {
                let found = sight(scene, other as usize, wall, place_m)?;
                let cosine: f64 = (0..3).map(|k| own.1[k] * found.1[k]).sum();
                let scale = (own.0 / found.0).ln().abs();
                Some((cosine.clamp(-1.0, 1.0).acos() / 0.35 + scale + rng.unit(), other))
            })
            .collect();
        if seen.is_empty() {
            continue;
        }
        seen.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        seen.truncate(MAX_VIEWS - 1);
        let seen = std::iter::once(owner as u32).chain(seen.into_iter().map(|s| s.1)).collect();
        return Some(Placed { place_m, wall: wall_at, seen });
    }
    None
}

/// The scale (pixels per metre) and the direction from the point at which a view sees it, if it does.
fn sight(scene: &Scene, view: usize, wall: &Wall, place_m: [f64; 3]) -> Option<(f64, [f64; 3])> {
    let view = &scene.views[view];
    let [u, v] = view.forward.project(place_m)?;
    if u.abs() > view.half_px[0] || v.abs() > view.half_px[1] {
        return None;
    }
    let centre_m = view.forward.centre_m();
    let ray = [0, 1, 2].map(|k| centre_m[k] - place_m[k]);
    // Beyond the corners the radial curve may turn back into the image.
    let depth: f64 = (0..3).map(|k| view.forward.rotation[2][k] * ray[k]).sum();
    let square: f64 = ray.iter().map(|v| v * v).sum::<f64>() / (depth * depth) - 1.0;
    let corner = view.half_px[0].hypot(view.half_px[1]) / view.forward.focal_px();
    if square > (1.1 * corner).powi(2) {
        return None;
    }
    let length_m = ray.iter().map(|v| v * v).sum::<f64>().sqrt();
    let direction = ray.map(|v| v / length_m);
    let n = wall.normal();
    (n[0] * direction[0] + n[1] * direction[1] > MIN_COSINE)
        .then_some((view.forward.focal_px() / length_m, direction))
}

/// How many views measure each point: a power law that gives the total.
fn track_lengths(config: &CollectionConfig, placed: &[Placed]) -> Result<Vec<usize>, ConfigError> {
    let ranks: Vec<f64> = (0..placed.len())
        .into_par_iter()
        .map(|point| 1.0 - stream(config.seed, Stage::CollectionTrack, point as u64).unit())
        .collect();
    let lengths = |exponent: f64| -> Vec<usize> {
        ranks
            .par_iter()
            .zip(placed)
            .map(|(rank, placed)| {
                ((2.0 * rank.powf(-1.0 / exponent)) as usize).clamp(2, placed.seen.len())
            })
            .collect()
    };
    let total = |lengths: &[usize]| lengths.iter().sum::<usize>();
    let (mut long, mut short) = (0.05, 100.0);
    let most = total(&lengths(long));
    if most < config.observations {
        let expected = format!("at most {most}: the points are seen no more often");
        return Err(ConfigError::new("observations", config.observations, expected));
    }
    for _ in 0..60 {
        let middle = 0.5 * (long + short);
        if total(&lengths(middle)) >= config.observations { long = middle } else { short = middle }
    }
    let mut found = lengths(long);
    // Ranks are random, so which of the points of this length give one up is as well.
    let mut excess = total(&found) - config.observations;
    for length in found.iter_mut().rev() {
        if excess > 0 && *length > 2 {
            *length -= 1;
            excess -= 1;
        }
    }
    if excess > 0 {
        return Err(ConfigError::new("observations", config.observations, "more: two per point"));
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::block::ForwardCamera;

    fn small(layout: Layout) -> CollectionConfig {
        CollectionConfig {
            layout,
            images: 60,
            points: 6000,
            observations: 24_690,
            places: 4,
            sigma_px: 0.0,
            ..CollectionConfig::preset(CollectionPreset::Trafalgar257)
        }
    }

    #[test]
    fn numbers_are_those_asked_for_and_tracks_have_a_tail() {
        for layout in [Layout::Places, Layout::Street] {
            // With few images, some seeds leave one of them alone, which is an error that asks for another.
            let with = |seed| CollectionConfig { seed, ..small(layout) }.photograph().ok();
            let block = (1..40).find_map(with).unwrap();
            let counts =
                [block.cameras_true.len(), block.points_true.len(), block.observations.len()];
            assert_eq!(counts, [60, 6000, 24_690]);
            let (mut lengths, mut per_image) = (vec![0; 6000], vec![0; 60]);
            for pair in block.observations.windows(2) {
                let (a, b) = (pair[0], pair[1]);
                assert!((a.point, a.camera) < (b.point, b.camera), "{layout:?}");
            }
            for observation in &block.observations {
                lengths[observation.point] += 1;
                per_image[observation.camera] += 1;
            }
            lengths.sort_unstable();
            assert!(lengths[0] >= 2 && per_image.iter().all(|&n| n >= 3), "{layout:?}");
            // Along a street few of so few images see a point; around a place some are seen by a third of all.
            let longest = if layout == Layout::Street { 10 } else { 20 };
            assert!(
                lengths[3000] <= 4 && lengths[5999] >= longest,
                "{layout:?}: {}",
                lengths[5999]
            );
            // Without noise the true values measure exactly what was measured.
            let cameras: Vec<_> = block.cameras_true.iter().map(ForwardCamera::new).collect();
            for observation in &block.observations {
                let found =
                    cameras[observation.camera].project(block.points_true[observation.point]);
                assert_eq!(found, Some(observation.measured_px));
            }
        }
    }

    #[test]
    fn a_seed_means_the_same_for_any_number_of_threads() {
        let config = small(Layout::Places);
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| config.photograph().unwrap())
        };
        let first = with(1);
        assert_eq!(first, with(3));
        let other = CollectionConfig { seed: 2, ..config.clone() }.photograph().unwrap();
        assert_ne!(first.observations, other.observations);
    }

    #[test]
    fn presets_can_be_used_and_impossible_numbers_are_refused() {
        for preset in [
            CollectionPreset::Ladybug1723,
            CollectionPreset::Trafalgar257,
            CollectionPreset::Dubrovnik356,
            CollectionPreset::Venice1778,
        ] {
            CollectionConfig::preset(preset).check().unwrap();
        }
        let config = small(Layout::Places);
        let many = CollectionConfig { observations: 300_000, ..config.clone() };
        let error = many.photograph().unwrap_err();
        assert!(error.parameter == "observations" && error.expected.contains("at most"), "{error}");
        let few = CollectionConfig { observations: 5999, ..config.clone() };
        assert_eq!(few.photograph().unwrap_err().parameter, "observations");
        let crowded = CollectionConfig { places: 11, ..config };
        assert_eq!(crowded.photograph().unwrap_err().parameter, "places");
    }
}
