//! A nadir aerial block for bundle adjustment, straight from geometry: no picture is rendered.
//!
//! Camera of the *Bundle Adjustment in the Large* files (Agarwal, Snavely, Seitz, Szeliski 2010),
//! nine parameters (angle-axis rotation 3, translation 3, f, k1, k2), looking along its -z with x to
//! the right and y up; for a point `X` of the mapping frame
//!
//! ```text
//! P = R X + t
//! p = -(Px, Py) / Pz
//! p' = f (1 + k1 |p|^2 + k2 |p|^4) p
//! ```
//!
//! in pixels from the middle of the image. Metres, X east, Y north, Z up, origin in the middle of
//! the block on mean ground. Images lie on parallel strips flown to and fro along X. A ground point
//! belongs to one image (each has its share, so that none sees nothing), and is measured in some of
//! the images that see it, at least two.

use crate::{
    check::{self, ConfigError, within},
    streams::{Draw, Stage, stream},
};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use crate::block_camera::{ForwardCamera, write_bal};
use crate::{
    block_camera::{Matrix, angle_axis, matrix, multiply, transpose_times},
    block_ground::{CameraIndex, Ground},
};

/// The parameters of a block.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BlockConfig {
    /// Decides everything random.
    pub seed: u64,
    /// Number of images.
    pub images: usize,
    /// Number of strips; 0 makes the block about square.
    pub strips: usize,
    /// Number of ground points.
    pub points: usize,
    /// Overlap of neighbouring images of a strip, fraction of the image's height.
    pub forward_overlap: f64,
    /// Overlap of neighbouring strips, fraction of the image's width.
    pub side_overlap: f64,
    /// Flying height above mean ground, metres.
    pub height_m: f64,
    /// Standard deviation of the camera centres in X, Y and Z, metres.
    pub position_noise_m: f64,
    /// Standard deviation of roll and pitch, and three times as much of yaw, degrees.
    pub gimbal_noise_deg: f64,
    /// Standard deviation of the rolling ground, metres.
    pub relief_m: f64,
    /// Standard deviation of single points about the rolling ground, metres.
    pub roughness_m: f64,
    /// Image width (along x, across the strips), pixels.
    pub image_width_px: f64,
    /// Image height (along y, along the strips), pixels.
    pub image_height_px: f64,
    /// Principal distance, pixels.
    pub focal_px: f64,
    /// First radial coefficient.
    pub k1: f64,
    /// Second radial coefficient.
    pub k2: f64,
    /// Standard deviation of the principal distance from image to image, as a fraction of it.
    pub focal_spread: f64,
    /// Mean number of images that a point is measured in, as far as that many see it.
    pub mean_track: f64,
    /// Standard deviation of each measured coordinate, pixels.
    pub sigma_px: f64,
    /// Probability that a measurement is gross.
    pub outlier_fraction: f64,
    /// Largest displacement of a gross measurement (the least is a fifth of it), pixels.
    pub outlier_px: f64,
    /// How far the start is from the truth.
    pub start: StartError,
}

/// How far a block's start values are from the truth: standard deviations.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StartError {
    /// Rotation about each axis, degrees.
    pub rotation_deg: f64,
    /// Camera centre in each coordinate, metres.
    pub centre_m: f64,
    /// Point in each coordinate, metres.
    pub point_m: f64,
    /// Whether the lenses start at the common principal distance without distortion instead of at
    /// the truth.
    pub nominal_lens: bool,
}

impl Default for StartError {
    fn default() -> StartError {
        StartError { rotation_deg: 0.3, centre_m: 0.5, point_m: 0.5, nominal_lens: true }
    }
}

impl Default for BlockConfig {
    fn default() -> BlockConfig {
        BlockConfig {
            seed: 1,
            images: 200,
            strips: 0,
            points: 40_000,
            forward_overlap: 0.75,
            side_overlap: 0.6,
            height_m: 100.0,
            position_noise_m: 1.0,
            gimbal_noise_deg: 1.5,
            relief_m: 3.0,
            roughness_m: 0.2,
            image_width_px: 6000.0,
            image_height_px: 4000.0,
            focal_px: 4386.0,
            k1: -0.03,
            k2: 0.01,
            focal_spread: 0.0005,
            mean_track: 4.2,
            sigma_px: 0.5,
            outlier_fraction: 0.0,
            outlier_px: 60.0,
            start: StartError::default(),
        }
    }
}

impl BlockConfig {
    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter that cannot be used: its name, its value and what was expected.
    pub fn check(&self) -> Result<(), ConfigError> {
        check::seed(self.seed)?;
        within("images", self.images, 2..=100_000)?;
        within("strips", self.strips, 0..=self.images)?;
        within("points", self.points, 1..=100_000_000)?;
        if self.points < 10 * self.images {
            let expected = format!("at least ten per image, {}", 10 * self.images);
            return Err(ConfigError::new("points", self.points, expected));
        }
        within("forward_overlap", self.forward_overlap, 0.2..=0.95)?;
        within("side_overlap", self.side_overlap, 0.0..=0.95)?;
        within("height_m", self.height_m, 1.0..=10_000.0)?;
        within("position_noise_m", self.position_noise_m, 0.0..=0.05 * self.height_m)?;
        within("gimbal_noise_deg", self.gimbal_noise_deg, 0.0..=5.0)?;
        within("relief_m", self.relief_m, 0.0..=0.1 * self.height_m)?;
        within("roughness_m", self.roughness_m, 0.0..=0.05 * self.height_m)?;
        within("image_width_px", self.image_width_px, 16.0..=100_000.0)?;
        within("image_height_px", self.image_height_px, 16.0..=100_000.0)?;
        let diagonal_px = f64::hypot(self.image_width_px, self.image_height_px);
        within("focal_px", self.focal_px, 0.3 * diagonal_px..=100.0 * diagonal_px)?;
        within("k1", self.k1, -1.0..=1.0)?;
        within("k2", self.k2, -1.0..=1.0)?;
        // The radial curve must rise up to beyond the corners, or two points share a pixel.
        let corner = 0.6 * diagonal_px / self.focal_px;
        let steps = (0..=100).map(|i| (corner * f64::from(i) / 100.0).powi(2));
        if steps.into_iter().any(|r2| 1.0 + r2 * (3.0 * self.k1 + r2 * 5.0 * self.k2) < 0.1) {
            let expected = "k1 and k2 whose radial curve rises up to the image corners";
            return Err(ConfigError::new("k1", self.k1, expected));
        }
        within("focal_spread", self.focal_spread, 0.0..=0.1)?;
        within("mean_track", self.mean_track, 2.0..=100.0)?;
        within("sigma_px", self.sigma_px, 0.0..=1000.0)?;
        within("outlier_fraction", self.outlier_fraction, 0.0..=1.0)?;
        within("outlier_px", self.outlier_px, 0.0..=100_000.0)?;
        within("start.rotation_deg", self.start.rotation_deg, 0.0..=10.0)?;
        within("start.centre_m", self.start.centre_m, 0.0..=0.2 * self.height_m)?;
        within("start.point_m", self.start.point_m, 0.0..=0.2 * self.height_m)
    }

    /// Half the ground that an image sees on flat ground, metres: (across, along) the strip.
    pub(crate) fn half_footprint_m(&self) -> [f64; 2] {
        let scale = 0.5 * self.height_m / self.focal_px;
        [self.image_width_px * scale, self.image_height_px * scale]
    }

    /// Number of strips, images per strip (the last strip may have fewer), and the distances
    /// between images and between strips, metres.
    fn layout(&self) -> (usize, usize, [f64; 2]) {
        let [half_width_m, half_height_m] = self.half_footprint_m();
        let base_m = 2.0 * half_height_m * (1.0 - self.forward_overlap);
        let strip_m = 2.0 * half_width_m * (1.0 - self.side_overlap);
        let square = (self.images as f64 * base_m / strip_m).sqrt().round().max(1.0) as usize;
        let strips = if self.strips == 0 { square.min(self.images) } else { self.strips };
        (strips, self.images.div_ceil(strips), [base_m, strip_m])
    }
}

/// One measured point in one image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// The image, from 0.
    pub camera: usize,
    /// The point, from 0.
    pub point: usize,
    /// Where it was measured, pixels from the middle of the image, x right and y up.
    pub measured_px: [f64; 2],
    /// Whether the measurement is gross.
    pub outlier: bool,
}

/// A block: truth, start values and measurements.
#[derive(Debug, Clone, PartialEq)]
pub struct Block {
    /// True cameras: angle-axis, translation, f, k1, k2.
    pub cameras_true: Vec<[f64; 9]>,
    /// True points, metres.
    pub points_true: Vec<[f64; 3]>,
    /// Cameras to start from.
    pub cameras_start: Vec<[f64; 9]>,
    /// Points to start from, metres.
    pub points_start: Vec<[f64; 3]>,
    /// Measurements by point, then by image.
    pub observations: Vec<Observation>,
}

impl Block {
    /// Flies a block.
    ///
    /// # Errors
    /// As [`BlockConfig::check`], and where the overlap is too small for every point to be seen by
    /// two images.
    pub fn fly(config: &BlockConfig) -> Result<Block, ConfigError> {
        config.check()?;
        let cameras_true = fly_strips(config);
        let cameras_start = cameras_true
            .iter()
            .enumerate()
            .map(|(image, camera)| start_camera(config, image, camera))
            .collect();
        let forward: Vec<ForwardCamera> = cameras_true.iter().map(ForwardCamera::new).collect();
        let index = CameraIndex::new(config, &forward);
        let ground = Ground::new(config);
        let tracks: Option<Vec<_>> = (0..config.points)
            .into_par_iter()
            .map(|point| place_point(config, point, &forward, &index, &ground))
            .collect();
        let Some(tracks) = tracks else {
            return Err(ConfigError::new(
                "forward_overlap",
                config.forward_overlap,
                "more overlap: not every image shares ground with another",
            ));
        };
        let points_true: Vec<[f64; 3]> = tracks.iter().map(|track| track.0).collect();
        let points_start = points_true
            .iter()
            .enumerate()
            .map(|(point, truth)| {
                let mut rng = stream(config.seed, Stage::BlockPointStart, point as u64);
                truth.map(|value| value + config.start.point_m * rng.normal())
            })
            .collect();
        let observations = tracks
            .into_par_iter()
            .enumerate()
            .flat_map_iter(|(point, (_, seen))| measure(config, point, seen))
            .collect();
        Ok(Block { cameras_true, points_true, cameras_start, points_start, observations })
    }
}

fn fly_strips(config: &BlockConfig) -> Vec<[f64; 9]> {
    let (strips, along, [base_m, strip_m]) = config.layout();
    (0..config.images)
        .map(|image| {
            let (strip, station) = (image / along, image % along);
            let mut rng = stream(config.seed, Stage::BlockPose, image as u64);
            let forth = strip % 2 == 0;
            let x_m = (station as f64 - 0.5 * (along as f64 - 1.0)) * base_m;
            let centre_m = [
                if forth { x_m } else { -x_m } + config.position_noise_m * rng.normal(),
                (strip as f64 - 0.5 * (strips as f64 - 1.0)) * strip_m
                    + config.position_noise_m * rng.normal(),
                config.height_m + config.position_noise_m * rng.normal(),
            ];
            // The image's y axis points where the aircraft flies, its z axis up.
            let yaw_rad = if forth { -1.0 } else { 1.0 } * std::f64::consts::FRAC_PI_2;
            let noise_rad = config.gimbal_noise_deg.to_radians();
            let (roll, pitch) = (noise_rad * rng.normal(), noise_rad * rng.normal());
            let heading = matrix([0.0, 0.0, -(yaw_rad + 3.0 * noise_rad * rng.normal())]);
            let rotation = multiply(&matrix([pitch, roll, 0.0]), &heading);
            let mut rng = stream(config.seed, Stage::BlockLens, image as u64);
            let focal_px = config.focal_px * (1.0 + config.focal_spread * rng.normal());
            camera(&rotation, centre_m, [focal_px, config.k1, config.k2])
        })
        .collect()
}

pub(crate) fn camera(rotation: &Matrix, centre_m: [f64; 3], lens: [f64; 3]) -> [f64; 9] {
    let r = angle_axis(rotation);
    let t = matrix(r).map(|row| -(0..3).map(|i| row[i] * centre_m[i]).sum::<f64>());
    [r[0], r[1], r[2], t[0], t[1], t[2], lens[0], lens[1], lens[2]]
}

fn start_camera(config: &BlockConfig, image: usize, truth: &[f64; 9]) -> [f64; 9] {
    let mut rng = stream(config.seed, Stage::BlockCameraStart, image as u64);
    let error_rad = config.start.rotation_deg.to_radians();
    let turn = [0; 3].map(|_| error_rad * rng.normal());
    let rotation = matrix([truth[0], truth[1], truth[2]]);
    let centre_m = ForwardCamera::new(truth).centre_m();
    let centre_m = centre_m.map(|value| value + config.start.centre_m * rng.normal());
    let lens = if config.start.nominal_lens {
        [config.focal_px, 0.0, 0.0]
    } else {
        [truth[6], truth[7], truth[8]]
    };
    camera(&multiply(&matrix(turn), &rotation), centre_m, lens)
}

/// Where a point lies and which images measure it, exactly.
type Track = ([f64; 3], Vec<(usize, [f64; 2])>);

/// A point of image `point mod images`, or `None` where no second image ever sees it.
fn place_point(
    config: &BlockConfig,
    point: usize,
    cameras: &[ForwardCamera],
    index: &CameraIndex,
    ground: &Ground,
) -> Option<Track> {
    let owner = point % cameras.len();
    let mut rng = stream(config.seed, Stage::BlockPoint, point as u64);
    let half_px = [0.5 * config.image_width_px, 0.5 * config.image_height_px];
    for _ in 0..1000 {
        let u_px = half_px[0] * rng.between(-0.98, 0.98);
        let v_px = half_px[1] * rng.between(-0.98, 0.98);
        let camera = &cameras[owner];
        let ray = [u_px / camera.focal_px(), v_px / camera.focal_px(), -1.0];
        let ray = transpose_times(&camera.rotation, ray);
        let centre_m = camera.centre_m();
        let range = -centre_m[2] / ray[2];
        let (x_m, y_m) = (centre_m[0] + range * ray[0], centre_m[1] + range * ray[1]);
        let z_m = ground.height_m(x_m, y_m) + config.roughness_m * rng.normal();
        let place_m = [x_m, y_m, z_m];
        let mut seen: Vec<(usize, [f64; 2])> = index
            .near(x_m, y_m)
            .filter_map(|camera| {
                let [u, v] = cameras[camera].project(place_m)?;
                (u.abs() <= half_px[0] && v.abs() <= half_px[1]).then_some((camera, [u, v]))
            })
            .collect();
        let Some(own) = seen.iter().position(|&(camera, _)| camera == owner) else { continue };
        if seen.len() < 2 {
            continue;
        }
        // The owner and others at random make up the track.
        seen.swap(0, own);
        let length = track_length(config, &mut rng).min(seen.len());
        for next in 1..length {
            let other = next + (rng.unit() * (seen.len() - next) as f64) as usize;
            seen.swap(next, other);
        }
        seen.truncate(length);
        seen.sort_by_key(|&(camera, _)| camera);
        return Some((place_m, seen));
    }
    None
}

/// 2 plus a geometric number, as matched features have it: most tracks short, some long.
fn track_length(config: &BlockConfig, rng: &mut ChaCha8Rng) -> usize {
    let extra = config.mean_track - 2.0;
    if extra <= 0.0 {
        return 2;
    }
    let stay = extra / (1.0 + extra);
    2 + ((1.0 - rng.unit()).ln() / stay.ln()) as usize
}

fn measure(
    config: &BlockConfig,
    point: usize,
    seen: Vec<(usize, [f64; 2])>,
) -> impl Iterator<Item = Observation> {
    let errors = (config.sigma_px, config.outlier_fraction, config.outlier_px);
    measure_with(config.seed, errors, point, seen)
}

/// Adds noise to the exact image positions of a point; `errors` as `sigma_px`, `outlier_fraction` and
/// `outlier_px` of [`BlockConfig`].
pub(crate) fn measure_with(
    seed: u64,
    (sigma_px, fraction, most_px): (f64, f64, f64),
    point: usize,
    seen: Vec<(usize, [f64; 2])>,
) -> impl Iterator<Item = Observation> {
    let mut noise = stream(seed, Stage::BlockNoise, point as u64);
    let mut gross = stream(seed, Stage::BlockOutlier, point as u64);
    seen.into_iter().map(move |(camera, [u, v])| {
        let mut measured_px = [u + sigma_px * noise.normal(), v + sigma_px * noise.normal()];
        let outlier = gross.unit() < fraction;
        let (direction_rad, far) =
            (gross.between(0.0, std::f64::consts::TAU), gross.between(0.2, 1.0));
        if outlier {
            measured_px[0] += most_px * far * direction_rad.cos();
            measured_px[1] += most_px * far * direction_rad.sin();
        }
        Observation { camera, point, measured_px, outlier }
    })
}
