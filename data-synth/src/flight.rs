//! The flight: strips to and fro over a field, and where the camera truly is at every moment.
//!
//! With `R` from the camera frame to the mapping frame and `C` the camera's centre, a point `X` has camera
//! coordinates `R^T (X - C)`. The image's y axis points along the flight. While a photo is read out, row `v`
//! of `h` is exposed at
//!
//! ```text
//! t(v) = t_0 + readout (v/(h - 1) - 1/2),   C(t) = C + (t - t_0) velocity,   R(t) = exp((t - t_0) turn) R
//! ```
//!
//! so that the exterior orientation of a photo is that of its middle row. Metres, seconds, radians; the
//! local frame of the field, whose axes are those of the mapping frame.

use crate::{
    block_camera::{Matrix, matrix, multiply, transpose_times},
    camera::Camera,
    check::ConfigError,
    field::Field,
    gimbal,
    streams::{Draw, Stage, stream},
};

pub use crate::flight_config::{FlightConfig, GimbalRecordConfig, GnssConfig};

/// Most photos of one flight.
pub const MAX_PHOTOS: usize = 20_000;

/// One photo's exterior orientation and all that goes with it: the truth, and what the receiver says.
#[derive(Debug, Clone, PartialEq)]
pub struct Shot {
    /// File name of the photo.
    pub name: String,
    /// Strip, from 0.
    pub strip: usize,
    /// Moment of the middle row, seconds after the first photo.
    pub time_s: f64,
    /// Camera centre, metres.
    pub centre_m: [f64; 3],
    /// Rotation from the camera frame to the mapping frame, by rows.
    pub rotation: [[f64; 3]; 3],
    /// Velocity, metres per second.
    pub velocity_m_s: [f64; 3],
    /// Rate of turn about the axes of the mapping frame, radians per second.
    pub turn_rad_s: [f64; 3],
    /// Time from the first to the last row, seconds.
    pub readout_s: f64,
    /// Time that each row is exposed, seconds.
    pub exposure_s: f64,
    /// Light beside that of the usual flight, a factor.
    pub light: f64,
    /// Sensitivity beside the usual one, a factor, where the camera changes and reports it.
    pub sensitivity: Option<f64>,
    /// Rows of the image.
    height_px: f64,
    /// Where the receiver says its antenna is, metres.
    pub gnss_m: [f64; 3],
    /// Standard deviation of each coordinate that the receiver states, metres.
    pub stated_sigma_m: Option<f64>,
    /// What the gimbal says: yaw, pitch and roll, degrees ([`crate::gimbal`]).
    pub gimbal_deg: Option<[f64; 3]>,
}

impl Shot {
    /// Centre and rotation `after_s` seconds after the middle row.
    pub fn pose(&self, after_s: f64) -> ([f64; 3], [[f64; 3]; 3]) {
        if after_s == 0.0 {
            return (self.centre_m, self.rotation);
        }
        let centre = [0, 1, 2].map(|i| self.centre_m[i] + after_s * self.velocity_m_s[i]);
        if self.turn_rad_s == [0.0; 3] {
            return (centre, self.rotation);
        }
        (centre, multiply(&matrix(self.turn_rad_s.map(|rate| rate * after_s)), &self.rotation))
    }

    /// When row `v_px` is exposed, seconds after the middle row.
    pub fn row_time_s(&self, v_px: f64) -> f64 {
        self.readout_s * (v_px / (self.height_px - 1.0) - 0.5)
    }

    /// Where a ray through a pixel begins, and its direction, in the mapping frame.
    pub fn ray(&self, camera: &Camera, u_px: f64, v_px: f64) -> ([f64; 3], [f64; 3]) {
        let (centre_m, rotation) = self.pose(self.row_time_s(v_px));
        (centre_m, times(&rotation, camera.direction(u_px, v_px)))
    }

    /// The pixel at which a point of the mapping frame appears, each row seen at its own moment; `None`
    /// where the camera does not see it.
    pub fn project(&self, camera: &Camera, point_m: [f64; 3]) -> Option<[f64; 2]> {
        self.project_within(camera, point_m, 0.0, 1e-9)
    }

    /// As [`Shot::project`] with all rows `shift_s` seconds later.
    pub fn project_at(&self, camera: &Camera, point_m: [f64; 3], shift_s: f64) -> Option<[f64; 2]> {
        self.project_within(camera, point_m, shift_s, 1e-9)
    }

    /// As [`Shot::project_at`], until the steps of both iterations are shorter than `step_px`.
    pub(crate) fn project_within(
        &self,
        camera: &Camera,
        point_m: [f64; 3],
        shift_s: f64,
        step_px: f64,
    ) -> Option<[f64; 2]> {
        let at = |after_s: f64| {
            let (centre_m, rotation) = self.pose(after_s);
            let away = [0, 1, 2].map(|i| point_m[i] - centre_m[i]);
            camera.project_within(transpose_times(&rotation, away), step_px)
        };
        let mut pixel = at(shift_s)?;
        if self.readout_s == 0.0 {
            return Some(pixel);
        }
        // The image moves by a small part of its height during the readout: this contracts fast.
        for _ in 0..30 {
            let next = at(shift_s + self.row_time_s(pixel[1]))?;
            let moved = (next[1] - pixel[1]).abs().max((next[0] - pixel[0]).abs());
            pixel = next;
            if moved < step_px {
                return Some(pixel);
            }
        }
        None
    }

    /// omega, phi, kappa with `R = R_x(omega) R_y(phi) R_z(kappa)`, radians.
    pub fn angles_rad(&self) -> [f64; 3] {
        let r = &self.rotation;
        [
            f64::atan2(-r[1][2], r[2][2]),
            r[0][2].clamp(-1.0, 1.0).asin(),
            f64::atan2(-r[0][1], r[0][0]),
        ]
    }
}

/// `m v`.
pub(crate) fn times(m: &Matrix, v: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| (0..3).map(|k| m[i][k] * v[k]).sum())
}

/// Flies over a field.
///
/// # Errors
/// As [`FlightConfig::check`]; a flight of no or too many photos; a camera below the ground or looking
/// along it.
pub fn fly(
    config: &FlightConfig,
    field: &Field,
    camera: &Camera,
) -> Result<Vec<Shot>, ConfigError> {
    config.check()?;
    let layout = Layout::new(config, field, camera)?;
    let seed = field.config.flight_seed();
    let mut drift = Drift::new(seed, 0, 0.9);
    let mut wander = [1, 2, 3].map(|axis| Drift::new(seed, axis, 0.97));
    let interval_s = if config.speed_m_s > 0.0 { layout.base_m / config.speed_m_s } else { 2.0 };
    let mut time_s = 0.0;
    let mut shots = Vec::with_capacity(layout.strips * layout.photos);
    for strip in 0..layout.strips {
        for step in 0..layout.photos {
            let mut rng = stream(seed, Stage::Shot, shots.len() as u64);
            let place = [rng.normal(), rng.normal()].map(|n| config.position_m * n);
            let tilt = [rng.normal(), rng.normal()].map(|n| config.gimbal_deg.to_radians() * n);
            let yaw = config.heading_deg.to_radians() * rng.normal();
            let rate = config.turn_rate_deg_s.to_radians();
            let turn_rad_s = [0; 3].map(|_| rate * rng.normal());
            let (position, toward) = layout.place(strip, step);
            let side = [-toward[1], toward[0]];
            let rise_m = config.height_drift_m * drift.next();
            let centre_m = [
                position[0] + place[0] * toward[0] + place[1] * side[0],
                position[1] + place[0] * toward[1] + place[1] * side[1],
                config.height_m + rise_m,
            ];
            let wind_rad = config.wind_direction_deg.to_radians();
            let (along, across) = (
                config.wind_m_s * (wind_rad.cos() * toward[0] + wind_rad.sin() * toward[1]),
                config.wind_m_s * (wind_rad.cos() * side[0] + wind_rad.sin() * side[1]),
            );
            // Heading into the wind so that wind and airspeed together go along the strip.
            let crab = f64::atan2(-across, (config.speed_m_s - along).max(1e-9));
            let heading = f64::atan2(toward[1], toward[0]) + crab + yaw;
            let kappa = heading - std::f64::consts::FRAC_PI_2;
            let gimbal = multiply(
                &matrix([0.0, 0.0, kappa]),
                &multiply(&matrix([tilt[0], 0.0, 0.0]), &matrix([0.0, tilt[1], 0.0])),
            );
            let rotation = match config.mount_tilt_deg.to_radians() {
                0.0 => gimbal,
                tilt_rad => multiply(&gimbal, &matrix([tilt_rad, 0.0, 0.0])),
            };
            let gimbal_deg = config.gimbal_record.as_ref().map(|record| {
                record_deg(record, &gimbal, &mut stream(seed, Stage::Gimbal, shots.len() as u64))
            });
            let mut gnss_m = times(&rotation, config.gnss.lever_arm_m);
            let mut noise = stream(seed, Stage::Gnss, shots.len() as u64);
            let (common, own) =
                (config.gnss.drift_share.sqrt(), (1.0 - config.gnss.drift_share).sqrt());
            let sigmas =
                [config.gnss.horizontal_m, config.gnss.horizontal_m, config.gnss.vertical_m];
            for axis in 0..3 {
                let error = common * wander[axis].next() + own * noise.normal();
                gnss_m[axis] += centre_m[axis] + sigmas[axis] * error;
            }
            shots.push(Shot {
                name: format!("IMG_{:04}.JPG", shots.len() + 1),
                strip,
                time_s,
                centre_m,
                rotation,
                velocity_m_s: [config.speed_m_s * toward[0], config.speed_m_s * toward[1], 0.0],
                turn_rad_s,
                readout_s: config.readout_seconds,
                exposure_s: config.exposure_seconds,
                light: 1.0,
                sensitivity: None,
                height_px: f64::from(camera.config().height_px),
                gnss_m,
                stated_sigma_m: config.gnss.stated_sigma_m,
                gimbal_deg,
            });
            time_s += interval_s;
        }
        time_s += config.turn_seconds;
    }
    check_view(&shots, field, camera)?;
    Ok(shots)
}

/// What a gimbal writes whose camera frame stands like this: with noise about the axes of the mapping frame, and a heading
/// that is off.
fn record_deg(record: &GimbalRecordConfig, gimbal: &Matrix, rng: &mut impl Draw) -> [f64; 3] {
    let level = [rng.normal(), rng.normal()].map(|n| (record.level_sigma_deg * n).to_radians());
    // Headings are clockwise, turns about the vertical are not.
    let heading_deg = record.heading_offset_deg + record.heading_sigma_deg * rng.normal();
    let noise = matrix([level[0], level[1], -heading_deg.to_radians()]);
    gimbal::angles_deg(&multiply(&noise, gimbal))
}

/// Lets the light change slowly over a flight, with a standard deviation `drift` of its logarithm, and the camera follow it in thirds
/// of a stop where `follow` says so.
pub(crate) fn light_up(shots: &mut [Shot], seed: u64, drift: f64, follow: bool) {
    // Neighbours of 20 photos have a correlation of 2/3.
    let mut change = Drift::new(seed, 4, 0.98);
    for shot in shots {
        let log = drift * change.next();
        shot.light = log.exp();
        if follow {
            let thirds = (-3.0 * log / std::f64::consts::LN_2).round();
            shot.sensitivity = Some((thirds / 3.0).exp2());
        }
    }
}

/// Every photo looks down on ground that a ray can reach from it.
fn check_view(shots: &[Shot], field: &Field, camera: &Camera) -> Result<(), ConfigError> {
    let (width, height) =
        (f64::from(camera.config().width_px), f64::from(camera.config().height_px));
    let steepest = field.terrain.steepest();
    for shot in shots {
        let below_m = shot.centre_m[2] - field.terrain.height_m(shot.centre_m[0], shot.centre_m[1]);
        if below_m < 1.0 {
            let expected =
                format!("a flight above the ground ({} is {below_m:.1} m above it)", shot.name);
            return Err(ConfigError::new("flight.height_m", shot.centre_m[2], expected));
        }
        for corner in
            [[-0.5, -0.5], [width - 0.5, -0.5], [-0.5, height - 0.5], [width - 0.5, height - 0.5]]
        {
            let (origin, direction) = shot.ray(camera, corner[0], corner[1]);
            let flat = f64::hypot(direction[0], direction[1]) / -direction[2];
            let grazing = direction[2] >= 0.0 || flat * steepest >= 1.0;
            if grazing || field.terrain.meet(origin, direction, below_m).is_none() {
                let expected = format!(
                    "a camera whose corners look down steeper than the ground rises ({}: {:.0} degrees from \
                     straight down)",
                    shot.name,
                    flat.atan().to_degrees()
                );
                return Err(ConfigError::new("camera.c_px", camera.config().c_px, expected));
            }
        }
    }
    Ok(())
}

/// A slow random process with mean 0 and variance 1.
struct Drift {
    value: f64,
    stay: f64,
    rng: rand_chacha::ChaCha8Rng,
}

impl Drift {
    fn new(seed: u64, item: u64, stay: f64) -> Drift {
        let mut rng = stream(seed, Stage::FlightDrift, item);
        Drift { value: rng.normal(), stay, rng }
    }

    fn next(&mut self) -> f64 {
        let now = self.value;
        self.value = self.stay * now + (1.0 - self.stay * self.stay).sqrt() * self.rng.normal();
        now
    }
}

/// Where the photos are planned.
struct Layout {
    strips: usize,
    photos: usize,
    base_m: f64,
    strip_m: f64,
    toward: [f64; 2],
    middle_m: [f64; 2],
}

impl Layout {
    fn new(config: &FlightConfig, field: &Field, camera: &Camera) -> Result<Layout, ConfigError> {
        let [half_across, half_along] = camera.half_footprint();
        let base_m = 2.0 * half_along * config.height_m * (1.0 - config.forward_overlap);
        let strip_m = 2.0 * half_across * config.height_m * (1.0 - config.side_overlap);
        let angle = field.config.heading_rad() + config.direction_deg.to_radians();
        let toward = [angle.cos(), angle.sin()];
        let side = [-toward[1], toward[0]];
        let half_m = 0.5 * field.config.row_length_m;
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for row in [0, field.config.rows - 1] {
            for along in [-half_m, 0.0, half_m] {
                let point = field.config.ground(along, field.config.row_across(row, along));
                for (axis, direction) in [toward, side].into_iter().enumerate() {
                    let value = point[0] * direction[0] + point[1] * direction[1];
                    low[axis] = low[axis].min(value);
                    high[axis] = high[axis].max(value);
                }
            }
        }
        let count = |given: usize, axis: usize, step_m: f64| {
            if given > 0 {
                return given;
            }
            let extent_m = (high[axis] - low[axis] + 2.0 * config.margin_m).max(0.0);
            (extent_m / step_m).ceil() as usize + 1
        };
        let (photos, strips) =
            (count(config.photos_per_strip, 0, base_m), count(config.strips, 1, strip_m));
        if photos * strips > MAX_PHOTOS {
            let expected =
                format!("at most {MAX_PHOTOS} photos (this flight has {})", photos * strips);
            return Err(ConfigError::new(
                "flight.forward_overlap",
                config.forward_overlap,
                expected,
            ));
        }
        let [along, across] = [0, 1].map(|axis| 0.5 * (low[axis] + high[axis]));
        let middle_m = [0, 1].map(|i| along * toward[i] + across * side[i]);
        Ok(Layout { strips, photos, base_m, strip_m, toward, middle_m })
    }

    /// The planned place of a photo and the direction of its strip.
    fn place(&self, strip: usize, step: usize) -> ([f64; 2], [f64; 2]) {
        let back = strip % 2 == 1;
        let along = (step as f64 - 0.5 * (self.photos as f64 - 1.0)) * self.base_m;
        let along = if back { -along } else { along };
        let across = (strip as f64 - 0.5 * (self.strips as f64 - 1.0)) * self.strip_m;
        let [tx, ty] = self.toward;
        let position = [
            self.middle_m[0] + along * tx - across * ty,
            self.middle_m[1] + along * ty + across * tx,
        ];
        (position, if back { [-tx, -ty] } else { [tx, ty] })
    }
}
