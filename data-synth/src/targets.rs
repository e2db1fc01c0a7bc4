//! Ground control: targets on the field, their survey, and the marks a person clicks in the photos.
//!
//! A target is a plate, level and a little above the ground, its middle the surveyed point: four squares, white and black in
//! turn, or another [`TargetPattern`]. No plant stands within the clearing around one, as a crew would see to.

use crate::{
    camera::Camera,
    check::{ConfigError, within},
    field::Field,
    flight::Shot,
    leaf::NODES,
    patterns::TargetPattern,
    streams::{Draw, Stage, pair, stream},
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// The targets of a field, their survey and the marks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TargetConfig {
    /// Number of ground control points.
    pub control: usize,
    /// Number of check points.
    pub check: usize,
    /// What is painted on them; coded ones have the codes from 0 on.
    pub pattern: TargetPattern,
    /// Size of a target as its pattern says, metres: the side of a chequered one.
    pub size_m: f64,
    /// Height of the plate above the ground, metres.
    pub above_m: f64,
    /// Radius around a target in which nothing grows, metres.
    pub clearing_m: f64,
    /// Standard deviation of the survey in easting and northing, each, metres.
    pub survey_horizontal_m: f64,
    /// Standard deviation of the survey in height, metres.
    pub survey_vertical_m: f64,
    /// Standard deviation of a mark in each image coordinate, pixels.
    pub mark_px: f64,
}

impl Default for TargetConfig {
    fn default() -> TargetConfig {
        TargetConfig {
            control: 18,
            check: 10,
            pattern: TargetPattern::Chequered,
            size_m: 0.5,
            above_m: 0.05,
            clearing_m: 0.45,
            survey_horizontal_m: 0.02,
            survey_vertical_m: 0.02,
            mark_px: 0.4,
        }
    }
}

impl TargetConfig {
    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter that cannot be used: its name, its value and what was expected.
    pub fn check(&self) -> Result<(), ConfigError> {
        within("targets.control", self.control, 0..=10_000)?;
        within("targets.check", self.check, 0..=10_000)?;
        if let Some(codes) = self.pattern.codes()
            && self.control + self.check > codes
        {
            let expected = format!("at most {codes} targets with check points, one for each code");
            return Err(ConfigError::new("targets.control", self.control as f64, expected));
        }
        within("targets.size_m", self.size_m, 0.01..=5.0)?;
        within("targets.above_m", self.above_m, 0.0..=3.0)?;
        within("targets.clearing_m", self.clearing_m, 0.0..=5.0)?;
        within("targets.survey_horizontal_m", self.survey_horizontal_m, 0.0..=1.0)?;
        within("targets.survey_vertical_m", self.survey_vertical_m, 0.0..=1.0)?;
        within("targets.mark_px", self.mark_px, 0.0..=20.0)
    }
}

/// What a target is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Takes part in the adjustment.
    Control,
    /// Is held back to judge it.
    Check,
}

impl Role {
    /// The word for it in files.
    pub fn word(self) -> &'static str {
        match self {
            Role::Control => "control",
            Role::Check => "check",
        }
    }
}

/// One target.
#[derive(Debug, Clone, PartialEq)]
pub struct Target {
    /// Name.
    pub label: String,
    /// What it is for.
    pub role: Role,
    /// Middle of the plate, metres: the truth.
    pub place_m: [f64; 3],
    /// What the survey says, metres.
    pub surveyed_m: [f64; 3],
    /// Direction of one of its edges, radians counter-clockwise from east.
    pub azimuth_rad: f64,
    /// Size, metres.
    pub size_m: f64,
    /// What is painted on it.
    pub pattern: TargetPattern,
    /// Number of its code, where it has one.
    pub code: usize,
}

/// A target seen in a photo.
#[derive(Debug, Clone, PartialEq)]
pub struct Mark {
    /// Photo, from 0.
    pub shot: usize,
    /// Target, from 0.
    pub target: usize,
    /// Where it truly appears, pixels.
    pub true_px: [f64; 2],
    /// Where it was clicked, pixels.
    pub marked_px: [f64; 2],
}

/// Sets out the targets and clears the plants around them.
///
/// Targets stand on a lattice about as dense everywhere, in the middle between two rows, control and check
/// points mixed evenly.
///
/// # Errors
/// As [`TargetConfig::check`].
pub fn set_out(config: &TargetConfig, field: &mut Field) -> Result<Vec<Target>, ConfigError> {
    config.check()?;
    let count = config.control + config.check;
    if count == 0 {
        return Ok(Vec::new());
    }
    let (length_m, width_m) =
        (field.config.row_length_m, (field.config.rows as f64 * field.config.inter_row_m));
    let lines = ((count as f64 * width_m / length_m).sqrt().round() as usize).clamp(1, count);
    let targets: Vec<Target> = (0..count)
        .map(|index| {
            // Line by line; a line has `count / lines` targets or one more.
            let line = index * lines / count;
            let first = (line * count).div_ceil(lines);
            let end = ((line + 1) * count).div_ceil(lines);
            let mut rng = stream(field.config.seed, Stage::Target, index as u64);
            let step = (index - first) as f64 + 0.5 + 0.5 * (rng.unit() - 0.5);
            let along_m = length_m * (step / (end - first) as f64 - 0.5);
            let row = ((line as f64 + 0.5) / lines as f64 * field.config.rows as f64) as usize;
            let row = row.min(field.config.rows - 1);
            let across_m = field.config.row_across(row, along_m) - 0.5 * field.config.inter_row_m;
            let [x_m, y_m] = field.config.ground(along_m, across_m);
            let place_m = [x_m, y_m, field.terrain.height_m(x_m, y_m) + config.above_m];
            let sigmas =
                [config.survey_horizontal_m, config.survey_horizontal_m, config.survey_vertical_m];
            let surveyed_m = [0, 1, 2].map(|i| place_m[i] + sigmas[i] * rng.normal());
            // Check points are spread evenly among all.
            let before = index * config.check / count;
            let check = (index + 1) * config.check / count > before;
            let azimuth_rad = rng.between(0.0, std::f64::consts::FRAC_PI_2);
            let (role, name, number) = if check {
                (Role::Check, "CHK", before + 1)
            } else {
                (Role::Control, "GCP", index - before + 1)
            };
            let label = format!("{name}{number:02}");
            let (size_m, pattern) = (config.size_m, config.pattern);
            Target { label, role, place_m, surveyed_m, azimuth_rad, size_m, pattern, code: index }
        })
        .collect();
    let cleared = |x_m: f64, y_m: f64| {
        targets.iter().any(|target| {
            f64::hypot(target.place_m[0] - x_m, target.place_m[1] - y_m) < config.clearing_m
        })
    };
    field.plants.retain(|plant| !cleared(plant.x_m, plant.y_m));
    Ok(targets)
}

/// The marks of all targets in all photos that see them: the middle at least as far inside the image as the
/// target's half side, and not hidden by a leaf.
pub fn mark(
    config: &TargetConfig,
    field: &Field,
    targets: &[Target],
    shots: &[Shot],
    camera: &Camera,
) -> Vec<Mark> {
    let near: Vec<Vec<[[f64; 3]; 4]>> =
        targets.par_iter().map(|target| quads_near(field, target)).collect();
    let marks = shots.par_iter().enumerate().flat_map_iter(|(shot, from)| {
        let near = &near;
        targets.iter().enumerate().filter_map(move |(target, what)| {
            let true_px = from.project(camera, what.place_m)?;
            let edge = [what.place_m[0] + 0.5 * what.size_m, what.place_m[1], what.place_m[2]];
            let edge = from.project(camera, edge)?;
            let margin_px = f64::hypot(edge[0] - true_px[0], edge[1] - true_px[1]);
            if !camera.inside(true_px, margin_px) {
                return None;
            }
            let (origin, _) = from.ray(camera, true_px[0], true_px[1]);
            if near[target].iter().any(|quad| hides(quad, origin, what.place_m)) {
                return None;
            }
            let mut rng = stream(field.config.flight_seed(), Stage::Mark, pair(shot, target));
            let marked_px = true_px.map(|value| value + config.mark_px * rng.normal());
            Some(Mark { shot, target, true_px, marked_px })
        })
    });
    marks.collect()
}

/// The pieces of all leaves that can hide a target.
fn quads_near(field: &Field, target: &Target) -> Vec<[[f64; 3]; 4]> {
    let mut quads = Vec::new();
    let place = target.place_m;
    for plant in &field.plants {
        if f64::hypot(plant.x_m - place[0], plant.y_m - place[1]) > 3.0 {
            continue;
        }
        for leaf in &plant.leaves {
            let (left, right) =
                crate::mesh::edges(&field.leaf_axis_m(plant.z_m, leaf), &leaf.half_width_m);
            for node in 0..NODES - 1 {
                quads.push([left[node], right[node], right[node + 1], left[node + 1]]);
            }
        }
    }
    quads
}

/// Whether the straight line between two points meets a quadrilateral, seen as two triangles.
fn hides(quad: &[[f64; 3]; 4], from: [f64; 3], to: [f64; 3]) -> bool {
    let minus = |a: [f64; 3], b: [f64; 3]| [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    let cross = |a: [f64; 3], b: [f64; 3]| {
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    };
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let ray = minus(to, from);
    [[quad[0], quad[1], quad[2]], [quad[0], quad[2], quad[3]]].into_iter().any(|[a, b, c]| {
        let (e, f) = (minus(b, a), minus(c, a));
        let p = cross(ray, f);
        let determinant = dot(e, p);
        if determinant == 0.0 {
            return false;
        }
        let s = minus(from, a);
        let u = dot(s, p) / determinant;
        let q = cross(s, e);
        let v = dot(ray, q) / determinant;
        let t = dot(f, q) / determinant;
        u >= 0.0 && v >= 0.0 && u + v <= 1.0 && (0.0..1.0).contains(&t)
    })
}
