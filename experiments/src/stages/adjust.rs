//! A flight's block adjusted with ground control, judged by its check points: tie points straight from
//! geometry, marks and surveys with their errors, start values near the truth.

use crate::{
    stage::{Measured, Metric, Stage, Trace, metric},
    streams::{Stream, stream},
};
use data_synth::{
    files,
    flight::Shot,
    targets::{self, Target},
    twin::{FlightPreset, Twin, TwinConfig},
};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rowgram::{
    camera::{Camera, Interior, Model},
    geometry::rotation,
    nlls::Loss,
    problems::{
        adjustment::{CheckPoint, Settings, adjust, rmse},
        lens_fit,
    },
    scene::{
        Axes, CameraPosition, GroundObservation, GroundPoint, Image, Observation, Pose,
        Reconstruction, Role, RollingShutter, TiePoint,
    },
};
use serde::{Deserialize, Serialize};

/// Which of the control points take part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Layout {
    /// Each as far as possible from those before it.
    Spread,
    /// The outermost.
    Edge,
    /// The innermost.
    Centre,
    /// Those nearest to the middle line along X.
    Line,
    /// Those nearest to one corner.
    Corner,
}

/// What the estimator is told.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Estimate {
    /// The lens model; models other than SMAC start at a fit to the true lens.
    lens: Model,
    /// Whether the interior orientation is adjusted.
    free_lens: bool,
    /// Whether the lens starts without distortion (SMAC only).
    nominal_lens: bool,
    /// How many control points take part, at most.
    pub(super) control: usize,
    /// Which of them.
    layout: Layout,
    /// Whether the receiver's positions take part.
    pub(super) gnss: bool,
    /// Whether the rolling shutter is modelled, where there is one.
    model_shutter: bool,
    /// Robust loss of tie points: `trivial`, `huber:1.5`, ...
    tie_loss: String,
    /// SMAC residuals in the domain of the corrected coordinates.
    corrected_domain: bool,
    /// Standard deviations of the start about the truth.
    start_rotation_deg: f64,
    start_centre_m: f64,
    start_point_m: f64,
    max_iterations: u64,
}

/// What can be varied.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Parameters {
    twin: TwinConfig,
    estimate: Estimate,
    /// Whether the residuals at check points and the cameras are kept.
    trace: bool,
}

impl Default for Estimate {
    fn default() -> Estimate {
        Estimate {
            lens: Model::Smac,
            free_lens: false,
            nominal_lens: false,
            control: 18,
            layout: Layout::Spread,
            gnss: false,
            model_shutter: true,
            tie_loss: Loss::Trivial.to_string(),
            corrected_domain: false,
            start_rotation_deg: 0.3,
            start_centre_m: 0.2,
            start_point_m: 0.2,
            max_iterations: 100,
        }
    }
}

impl Default for Parameters {
    fn default() -> Parameters {
        let mut twin = TwinConfig::preset(FlightPreset::Paper);
        (twin.field.rows, twin.field.row_length_m) = (40, 30.0);
        (twin.targets.control, twin.targets.check) = (18, 10);
        twin.tie_points.per_photo = 60;
        twin.tie_points.outlier_fraction = 0.0;
        Parameters { twin, estimate: Estimate::default(), trace: false }
    }
}

/// The stage.
pub(crate) struct Adjust;

impl Stage for Adjust {
    type Parameters = Parameters;
    const NAME: &'static str = "adjust";
    const ABOUT: &'static str =
        "a flight's block adjusted with ground control, judged by check points";
    const METRICS: &'static [Metric] = &[
        metric("check_x_m", "root mean square error of the check points, X"),
        metric("check_y_m", "the same, Y"),
        metric("check_z_m", "the same, Z"),
        metric("check_xyz_m", "the same, all three together"),
        metric("check_points", "check points judged"),
        metric("images", "images adjusted"),
        metric("observations", "observations adjusted"),
        metric("sigma0", "root of the a-posteriori variance factor"),
        metric("iterations", "trials made"),
        metric("converged", "1 where the engine came to an optimum"),
        metric("centre_m", "root mean square error of the camera centres, each coordinate"),
    ];
    const SEEDED: &'static [&'static str] = &["twin.field.seed"];

    fn check(p: &Parameters) -> Result<(), String> {
        check(&p.twin, &p.estimate)
    }

    fn run(p: &Parameters, seed: u64) -> Result<Measured, String> {
        let mut config = p.twin.clone();
        config.field.seed = seed;
        let twin = config.build().map_err(|e| e.to_string())?;
        let mut survey = survey(&twin, &p.estimate, seed)?;
        let adjusted = adjust(&mut survey, &settings(&p.estimate)?).map_err(|e| e.to_string())?;
        let checks = &adjusted.check_points;
        let mut measured = Measured::default();
        let mut squares = 0.0;
        for (axis, name) in ["check_x_m", "check_y_m", "check_z_m"].into_iter().enumerate() {
            let errors: Vec<f64> = checks.iter().map(|check| check.error_m[axis]).collect();
            if let Some(found) = rmse(&errors, 0.95) {
                measured.put(name, found.rmse_m);
                squares += found.rmse_m * found.rmse_m;
            }
        }
        if !checks.is_empty() {
            measured.put("check_xyz_m", squares.sqrt());
        }
        measured.put("check_points", checks.len() as f64);
        measured.put("images", adjusted.reconstruction.images.len() as f64);
        measured.put("observations", adjusted.statistics.observations as f64);
        measured.put("sigma0", adjusted.statistics.sigma0);
        measured.put("iterations", adjusted.summary.iterations as f64);
        measured.put("converged", f64::from(adjusted.converged()));
        measured.put("centre_m", centre_error_m(&survey, &twin));
        if p.trace {
            measured.traces.extend(traces(&survey, checks, &twin));
        }
        Ok(measured)
    }
}

/// Refuses what cannot be used, before any work.
pub(super) fn check(twin: &TwinConfig, e: &Estimate) -> Result<(), String> {
    twin.check().map_err(|e| e.to_string())?;
    e.tie_loss.parse::<Loss>()?;
    if twin.tie_points.per_photo == 0 {
        return Err("twin.tie_points.per_photo = 0: expected at least 1".to_owned());
    }
    if (e.corrected_domain || e.nominal_lens) && e.lens != Model::Smac {
        return Err("corrected_domain and nominal_lens go with the SMAC lens".to_owned());
    }
    if e.nominal_lens && !e.free_lens {
        return Err("a lens without distortion has to be free".to_owned());
    }
    if e.control == 0 && !e.gnss {
        return Err("estimate.control = 0 needs the receiver's positions".to_owned());
    }
    Ok(())
}

pub(super) fn settings(e: &Estimate) -> Result<Settings, String> {
    Ok(Settings {
        tie_loss: e.tie_loss.parse()?,
        corrected_domain: e.corrected_domain,
        max_iterations: e.max_iterations,
        ..Settings::default()
    })
}

/// The adjusted block of a flight.
pub(super) fn adjusted(twin: &Twin, e: &Estimate, seed: u64) -> Result<Reconstruction, String> {
    let mut survey = survey(twin, e, seed)?;
    adjust(&mut survey, &settings(e)?).map_err(|e| e.to_string())?;
    Ok(survey)
}

fn centre_error_m(survey: &Reconstruction, twin: &Twin) -> f64 {
    let mut squares = 0.0;
    for (image, shot) in survey.images.iter().zip(&twin.shots) {
        let centre = image.pose.centre_m();
        squares += (0..3).map(|k| (centre[k] - shot.centre_m[k]).powi(2)).sum::<f64>();
    }
    (squares / (3 * survey.images.len()) as f64).sqrt()
}

fn traces(survey: &Reconstruction, checks: &[CheckPoint], twin: &Twin) -> [Trace; 3] {
    let mut errors = Trace::new("check_points", &["x_m", "y_m", "dx_m", "dy_m", "dz_m"]);
    errors.rows = checks
        .iter()
        .map(|check| {
            let ([x, y, _], [dx, dy, dz]) = (check.position_m, check.error_m);
            vec![x, y, dx, dy, dz]
        })
        .collect();
    // Where a photo's upper edge points, seen from above.
    let mut cameras = Trace::new("cameras", &["x_m", "y_m", "z_m", "up_x", "up_y"]);
    cameras.rows = survey
        .images
        .iter()
        .map(|image| {
            let ([x, y, z], axes) = (image.pose.centre_m(), rotation::matrix(image.pose.rotation));
            vec![x, y, z, axes[1][0], axes[1][1]]
        })
        .collect();
    let mut cloud = Trace::new("cloud", &["x_m", "y_m", "z_m", "what"]);
    let place = |[x, y, z]: [f64; 3], what: f64| vec![x, y, z, what];
    cloud.rows = survey.points.iter().map(|point| place(point.position_m, 0.0)).collect();
    let centres = survey.images.iter().map(|image| place(image.pose.centre_m(), 1.0));
    cloud.rows.extend(centres);
    cloud.rows.extend(twin.targets.iter().map(|target| place(target.place_m, 2.0)));
    [errors, cameras, cloud]
}

/// The true lens by the twin's own description of it.
fn true_lens(twin: &Twin) -> Result<Camera, String> {
    let mut text = Vec::new();
    files::camera(twin, &mut text).map_err(|e| e.to_string())?;
    Camera::from_toml(&String::from_utf8_lossy(&text)).map_err(|e| e.to_string())
}

/// Parameters that an adjustment can tell apart: K0 is the principal distance once more, and a
/// rational polynomial needs no denominators here.
fn estimable(model: Model) -> Vec<&'static str> {
    let apart = ["K0", "aspect", "k4", "k5", "k6"];
    let keep_k4 = model == Model::Fisheye;
    model
        .parameters()
        .iter()
        .filter(|p| p.estimable && (!apart.contains(&p.name) || (keep_k4 && p.name == "k4")))
        .map(|parameter| parameter.name)
        .collect()
}

fn camera(twin: &Twin, e: &Estimate) -> Result<Camera, String> {
    let truth = true_lens(twin)?;
    let names = estimable(e.lens);
    let mut camera = if e.lens != Model::Smac {
        let fit = lens_fit::fit(&truth.interior, e.lens, &names).map_err(|e| e.to_string())?;
        Camera::new("fitted", fit.interior)
    } else if e.nominal_lens {
        let mut values = [0.0; 10];
        values[0] = truth.interior.principal_distance_px();
        let lens = Interior::new(Model::Smac, truth.interior.size_px(), &values);
        Camera::new("nominal", lens.map_err(|e| e.to_string())?)
    } else {
        truth
    };
    if e.free_lens {
        camera.set_free(&names).map_err(|e| e.to_string())?;
    }
    Ok(camera)
}

/// A normal number from two uniform ones (Box and Muller).
pub(super) fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let (a, b): (f64, f64) = (rng.random(), rng.random());
    (-2.0 * (1.0 - a).ln()).sqrt() * (std::f64::consts::TAU * b).cos()
}

/// The rotation of a matrix by rows, through the largest component of its quaternion.
fn quaternion(m: &[[f64; 3]; 3]) -> rotation::Quaternion {
    let trace = m[0][0] + m[1][1] + m[2][2];
    let four = [
        1.0 + trace,
        1.0 - trace + 2.0 * m[0][0],
        1.0 - trace + 2.0 * m[1][1],
        1.0 - trace + 2.0 * m[2][2],
    ];
    let largest = (1..4).fold(0, |best, i| if four[i] > four[best] { i } else { best });
    let skew = [m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]];
    let sums = [m[2][1] + m[1][2], m[0][2] + m[2][0], m[1][0] + m[0][1]];
    let q = match largest {
        0 => [four[0], skew[0], skew[1], skew[2]],
        1 => [skew[0], four[1], sums[2], sums[1]],
        2 => [skew[1], sums[2], four[2], sums[0]],
        _ => [skew[2], sums[1], sums[0], four[3]],
    };
    rotation::normalize(q)
}

fn image(number: usize, shot: &Shot, e: &Estimate, rng: &mut ChaCha8Rng) -> Image {
    // Rows of camera_from_world are the columns of the true rotation.
    let turned: [[f64; 3]; 3] =
        std::array::from_fn(|i| std::array::from_fn(|j| shot.rotation[j][i]));
    let small = [0; 3].map(|_| e.start_rotation_deg.to_radians() * normal(rng));
    let rotation =
        rotation::normalize(rotation::multiply(rotation::exp(small), quaternion(&turned)));
    let centre = shot.centre_m.map(|c| c + e.start_centre_m * normal(rng));
    Image {
        name: shot.name.clone(),
        id: number as u32 + 1,
        camera: 0,
        pose: Pose::from_centre(rotation, centre),
        motion: [0.0; 6],
        expected_motion: [0.0; 6],
    }
}

/// What is measured on a flight, with start values near the truth.
pub(super) fn survey(twin: &Twin, e: &Estimate, seed: u64) -> Result<Reconstruction, String> {
    let config = &twin.config;
    let mut rng = stream(seed, Stream::Start);
    let mut survey = Reconstruction {
        cameras: vec![camera(twin, e)?],
        tie_sigma_px: config.tie_points.sigma_px.max(0.01),
        lever_arm_m: config.flight.gnss.lever_arm_m,
        ..Reconstruction::default()
    };
    survey.images =
        twin.shots.iter().enumerate().map(|(k, shot)| image(k, shot, e, &mut rng)).collect();
    for (number, point) in twin.tie_points().into_iter().enumerate() {
        let position_m = point.place_m.map(|c| c + e.start_point_m * normal(&mut rng));
        survey.points.push(TiePoint { id: number as u64 + 1, position_m, colour: [0; 3] });
        survey.observations.extend(point.seen.iter().map(|seen| Observation {
            image: seen.shot as u32,
            point: number as u32,
            image_px: seen.measured_px,
        }));
    }
    ground(&mut survey, twin, e);
    if e.gnss {
        let gnss = &config.flight.gnss;
        let floor = |sigma: f64| sigma.max(1e-3);
        let sigma_m = [floor(gnss.horizontal_m), floor(gnss.horizontal_m), floor(gnss.vertical_m)];
        survey.positions = twin
            .shots
            .iter()
            .enumerate()
            .map(|(k, shot)| CameraPosition { image: k as u32, position_m: shot.gnss_m, sigma_m })
            .collect();
    }
    if config.flight.readout_seconds > 0.0 && e.model_shutter {
        survey.rolling_shutter = Some(RollingShutter {
            readout_s: config.flight.readout_seconds,
            sigma_velocity_m_s: 2.0 * config.flight.speed_m_s.max(0.5),
        });
    }
    Ok(survey)
}

/// Adds the control points that take part, all check points, and their marks.
fn ground(survey: &mut Reconstruction, twin: &Twin, e: &Estimate) {
    let config = &twin.config.targets;
    let chosen = choose(&twin.targets, e.control, e.layout);
    let floor = |sigma: f64| sigma.max(1e-4);
    let [plan, height] = [floor(config.survey_horizontal_m), floor(config.survey_vertical_m)];
    for (number, target) in twin.targets.iter().enumerate() {
        let check = target.role == targets::Role::Check;
        if !check && !chosen.contains(&number) {
            continue;
        }
        let ground = survey.ground.len() as u32;
        survey.ground.push(GroundPoint {
            name: target.label.clone(),
            // Check points are judged against the truth, which the survey of a real block is taken for.
            position_m: if check { target.place_m } else { target.surveyed_m },
            sigma_m: [plan, plan, height],
            role: if check { Role::Check } else { Role::Control },
            axes: Axes::Xyz,
        });
        let mine = twin.marks.iter().filter(|mark| mark.target == number);
        survey.marks.extend(mine.map(|mark| GroundObservation {
            image: mark.shot as u32,
            ground,
            image_px: mark.marked_px,
            sigma_px: floor(config.mark_px),
        }));
    }
}

/// The control points that take part.
fn choose(all: &[Target], count: usize, layout: Layout) -> Vec<usize> {
    let mut left: Vec<usize> =
        (0..all.len()).filter(|&k| all[k].role == targets::Role::Control).collect();
    let at = |k: usize| [all[k].place_m[0], all[k].place_m[1]];
    let apart = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
    let middle = |k: usize| apart(at(k), [0.0; 2]);
    match layout {
        Layout::Spread => {
            let mut chosen: Vec<usize> = Vec::new();
            while chosen.len() < count && !left.is_empty() {
                let far = |k: usize| {
                    let nearest = chosen.iter().map(|&c| apart(at(k), at(c)));
                    // The first is the outermost.
                    nearest.fold(f64::INFINITY, f64::min).min(1e6 + middle(k))
                };
                let best = (0..left.len())
                    .max_by(|&a, &b| far(left[a]).total_cmp(&far(left[b])))
                    .unwrap_or(0);
                chosen.push(left.remove(best));
            }
            return chosen;
        }
        Layout::Edge => left.sort_by(|&a, &b| middle(b).total_cmp(&middle(a))),
        Layout::Centre => left.sort_by(|&a, &b| middle(a).total_cmp(&middle(b))),
        Layout::Line => left.sort_by(|&a, &b| at(a)[1].abs().total_cmp(&at(b)[1].abs())),
        Layout::Corner => {
            let least = |k: usize| at(k)[0] + at(k)[1];
            left.sort_by(|&a, &b| least(a).total_cmp(&least(b)));
        }
    }
    left.truncate(count);
    left
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quaternions_come_back_from_matrices() {
        for v in [[0.1, 0.2, -0.3], [3.0, 0.5, 0.1], [0.0, 3.1, 0.2], [0.1, -0.2, 3.1]] {
            let q = rotation::exp(v);
            let again = quaternion(&rotation::matrix(q));
            let dot: f64 = q.iter().zip(again).map(|(a, b)| a * b).sum();
            assert!((dot.abs() - 1.0).abs() < 1e-14, "{v:?}");
        }
    }
}
