//! Two points or five: relative orientation of two photos among wrong matches.
//!
//! A pair over a field flown at 50 m (1000 px principal distance, 60 % overlap): 300 matches with noise of
//! half a pixel, of which a share is wrong. Wrong matches are anywhere in the second photo, or, with
//! `repetitive`, one to five rows or plants away from where they belong, as on a crop in rows. One thing
//! at a time departs from the assumption of two points: tilt of the second photo, its height.
//!
//! A pair is right where the rotation is within one degree and the baseline within three. Samples are
//! counted until the sampling ends by itself, at most 3000.

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rowgram::sfm::relative::{Correspondence, RelativePoseOptions, Solver, estimate};

use nalgebra::{Rotation3, Vector3};

const C_PX: f64 = 1000.0;
const HEIGHT_M: f64 = 50.0;
const MATCHES: usize = 300;
const NOISE_PX: f64 = 0.5;
/// Between rows and between plants, metres.
const SPACING_M: [f64; 2] = [0.76, 0.2];

/// One setting.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Setting {
    pub(crate) wrong_share: f64,
    pub(crate) tilt_deg: f64,
    pub(crate) height_share: f64,
    pub(crate) repetitive: bool,
}

fn normal(rng: &mut impl Rng) -> f64 {
    // Box and Muller.
    let (u, v): (f64, f64) = (rng.random_range(1e-12..1.0), rng.random_range(0.0..1.0));
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

/// A pair: correspondences, rotation and unit baseline.
fn pair(setting: &Setting, seed: u64) -> (Vec<Correspondence>, Rotation3<f64>, Vector3<f64>) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let direction = rng.random_range(0.0..std::f64::consts::TAU);
    let tilt = setting.tilt_deg.to_radians();
    let kappa = rng.random_range(-3.1..3.1);
    let turn = Rotation3::from_scaled_axis(Vector3::new(
        tilt * direction.cos(),
        tilt * direction.sin(),
        0.0,
    )) * Rotation3::from_axis_angle(&Vector3::z_axis(), kappa);
    let bearing = rng.random_range(0.0..std::f64::consts::TAU);
    let base_m = 0.4 * 0.75 * HEIGHT_M;
    let centre = Vector3::new(
        base_m * bearing.cos(),
        base_m * bearing.sin(),
        setting.height_share * HEIGHT_M,
    );
    let mut found = Vec::new();
    while found.len() < MATCHES {
        let at = Vector3::new(
            rng.random_range(-0.6..0.6) * HEIGHT_M,
            rng.random_range(-0.45..0.45) * HEIGHT_M,
            -HEIGHT_M + 0.4 * normal(&mut rng),
        );
        let wrong = rng.random_range(0.0..1.0) < setting.wrong_share;
        let mut seen = at;
        if wrong && setting.repetitive {
            let rows = f64::from(rng.random_range(1..=5)) * if rng.random() { 1.0 } else { -1.0 };
            let plants = f64::from(rng.random_range(-5..=5));
            seen += Vector3::new(rows * SPACING_M[0], plants * SPACING_M[1], 0.0);
        }
        let moved = turn * (seen - centre);
        let mut noisy = |v: f64| v + NOISE_PX / C_PX * normal(&mut rng);
        let first = [noisy(at.x / -at.z), noisy(at.y / -at.z)];
        let mut second = [noisy(moved.x / -moved.z), noisy(moved.y / -moved.z)];
        if wrong && !setting.repetitive {
            second = [rng.random_range(-0.6..0.6), rng.random_range(-0.45..0.45)];
        } else if second[0].abs() > 0.75 || second[1].abs() > 0.6 {
            continue;
        }
        found.push(Correspondence { first, second });
    }
    (found, turn, (-(turn * centre)).normalize())
}

/// Whether a solver gets a pair right, its inliers, its samples.
pub(crate) fn run(setting: &Setting, solver: Solver, seed: u64) -> (bool, usize, usize) {
    let (correspondences, turn, base) = pair(setting, seed);
    let options = RelativePoseOptions {
        solver,
        tolerance: 2.0 / C_PX,
        min_inliers: 8,
        ..RelativePoseOptions::default()
    };
    match estimate(&correspondences, &options, seed) {
        None => (false, 0, options.max_samples),
        Some(found) => {
            let left = found.pose.rotation * turn.inverse().into_inner();
            let angle = (0.5 * (left.trace() - 1.0)).clamp(-1.0, 1.0).acos();
            let apart = found.pose.translation.dot(&base).clamp(-1.0, 1.0).acos();
            let right = angle < 1f64.to_radians() && apart < 3f64.to_radians();
            (right, found.inliers.len(), found.samples)
        }
    }
}
