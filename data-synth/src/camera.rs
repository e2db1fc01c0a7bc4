//! The true camera: collinearity with the SMAC correction, in pixels.
//!
//! A point `(U, V, W)` of the camera frame (x right, y up, looking along -z) has the ideal position
//! `x = -c U/W`, `y = -c V/W`. A pixel `(u, v)` has image coordinates `x = u - u_0`, `y = v_0 - v` with
//! `(u_0, v_0)` the middle of the image; reduced to the principal point, `xb = x - xp`, `yb = y - yp`,
//! `r^2 = xb^2 + yb^2`, its ideal position is
//!
//! ```text
//! x = xb (1 + K0 + K1 (r^2 - R0^2) + K2 (r^4 - R0^4) + K3 (r^6 - R0^6)) + P1 (r^2 + 2 xb^2) + 2 P2 xb yb
//! y = yb (1 + ...) + 2 P1 xb yb + P2 (r^2 + 2 yb^2)
//! ```
//!
//! so that looking out of a pixel is a formula and projection solves it by Newton's method. Written on its
//! own from the definition (D. C. Brown, *Close-range camera calibration*, 1971), sharing nothing with
//! any estimator, so that an error in one cannot cancel itself in the other.

use crate::check::{ConfigError, within};
use serde::{Deserialize, Serialize};

/// The true camera. The default is a 12-megapixel wide-angle action camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CameraConfig {
    /// Maker, as EXIF has it.
    pub make: String,
    /// Model, as EXIF has it.
    pub model: String,
    /// Nominal focal length, as EXIF has it, millimetres.
    pub focal_mm: f64,
    /// Width of the image, pixels.
    pub width_px: u32,
    /// Height of the image (along the flight), pixels.
    pub height_px: u32,
    /// Principal distance, pixels.
    pub c_px: f64,
    /// Principal point to the right of the image's middle, pixels.
    pub xp_px: f64,
    /// Principal point above the image's middle, pixels.
    pub yp_px: f64,
    /// Radial coefficient of degree 1.
    #[serde(rename = "K0")]
    pub k0: f64,
    /// Radial coefficient of degree 3, px^-2.
    #[serde(rename = "K1")]
    pub k1: f64,
    /// Radial coefficient of degree 5, px^-4.
    #[serde(rename = "K2")]
    pub k2: f64,
    /// Radial coefficient of degree 7, px^-6.
    #[serde(rename = "K3")]
    pub k3: f64,
    /// Decentring coefficient, px^-1.
    #[serde(rename = "P1")]
    pub p1: f64,
    /// Decentring coefficient, px^-1.
    #[serde(rename = "P2")]
    pub p2: f64,
    /// Radius at which the radial correction is `K0`, pixels.
    #[serde(rename = "R0_px")]
    pub r0_px: f64,
}

impl Default for CameraConfig {
    fn default() -> CameraConfig {
        CameraConfig::wide(4000, 3000, 1750.0)
    }
}

impl CameraConfig {
    /// A wide-angle lens between equidistant and rectilinear, as action cameras have it.
    pub fn wide(width_px: u32, height_px: u32, c_px: f64) -> CameraConfig {
        let degree = |power: i32, value: f64| value / c_px.powi(power);
        CameraConfig {
            make: "Synthetic".to_owned(),
            model: "Wide action camera".to_owned(),
            focal_mm: 2.77,
            width_px,
            height_px,
            c_px,
            xp_px: 0.0031 * c_px,
            yp_px: -0.0024 * c_px,
            k0: 0.0,
            k1: degree(2, 0.26),
            k2: degree(4, 0.06),
            k3: degree(6, 0.02),
            p1: degree(1, 0.0006),
            p2: degree(1, -0.0004),
            r0_px: 0.0,
        }
    }

    /// A compact camera with a mild barrel distortion.
    pub fn compact(width_px: u32, height_px: u32, c_px: f64) -> CameraConfig {
        let degree = |power: i32, value: f64| value / c_px.powi(power);
        CameraConfig {
            make: "Synthetic".to_owned(),
            model: "Compact camera".to_owned(),
            focal_mm: 4.3,
            k1: degree(2, 0.035),
            k2: degree(4, -0.012),
            k3: 0.0,
            p1: degree(1, 0.0004),
            p2: degree(1, 0.0002),
            ..CameraConfig::wide(width_px, height_px, c_px)
        }
    }

    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter that cannot be used: its name, its value and what was expected.
    pub fn check(&self) -> Result<(), ConfigError> {
        within("camera.width_px", self.width_px, 64..=20_000)?;
        within("camera.height_px", self.height_px, 64..=20_000)?;
        let diagonal_px = f64::hypot(f64::from(self.width_px), f64::from(self.height_px));
        within("camera.focal_mm", self.focal_mm, 0.1..=2000.0)?;
        within("camera.c_px", self.c_px, 0.2 * diagonal_px..=100.0 * diagonal_px)?;
        within("camera.xp_px", self.xp_px, -0.1 * diagonal_px..=0.1 * diagonal_px)?;
        within("camera.yp_px", self.yp_px, -0.1 * diagonal_px..=0.1 * diagonal_px)?;
        within("camera.K0", self.k0, -0.5..=0.5)?;
        within("camera.R0_px", self.r0_px, 0.0..=diagonal_px)?;
        let reach = 0.5 * diagonal_px;
        for (name, value, power) in [
            ("camera.K1", self.k1, 2),
            ("camera.K2", self.k2, 4),
            ("camera.K3", self.k3, 6),
            ("camera.P1", self.p1, 1),
            ("camera.P2", self.p2, 1),
        ] {
            let most = 5.0 / reach.powi(power);
            within(name, value, -most..=most)?;
        }
        let camera = Camera::unchecked(self);
        if camera.steepest_to(camera.limit_px) <= 0.05 {
            let expected = "coefficients whose radial curve rises up to beyond the image corners";
            return Err(ConfigError::new("camera.K1", self.k1, expected));
        }
        Ok(())
    }
}

/// Entries of the table from which projection starts.
const TABLE: usize = 512;

/// A camera ready to look.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    config: CameraConfig,
    /// Middle of the image in pixels.
    middle_px: [f64; 2],
    /// Farthest that the model is used from the principal point: a little beyond the corners.
    limit_px: f64,
    /// Ideal radius at `limit_px`.
    ideal_limit_px: f64,
    /// Measured radius for evenly spaced ideal radii up to the limit.
    start_px: Vec<f64>,
}

impl Camera {
    /// A camera with these parameters.
    ///
    /// # Errors
    /// As [`CameraConfig::check`].
    pub fn new(config: &CameraConfig) -> Result<Camera, ConfigError> {
        config.check()?;
        let mut camera = Camera::unchecked(config);
        let step = camera.ideal_limit_px / (TABLE - 1) as f64;
        let mut low = 0.0;
        for entry in 0..TABLE {
            let wanted = entry as f64 * step;
            let (mut a, mut b) = (low, camera.limit_px);
            for _ in 0..60 {
                let middle = 0.5 * (a + b);
                if middle * camera.radial(middle * middle).0 < wanted {
                    a = middle
                } else {
                    b = middle
                }
            }
            low = a;
            camera.start_px.push(0.5 * (a + b));
        }
        Ok(camera)
    }

    fn unchecked(config: &CameraConfig) -> Camera {
        let half = [f64::from(config.width_px), f64::from(config.height_px)].map(|n| 0.5 * n);
        let corner = f64::hypot(half[0] + config.xp_px.abs(), half[1] + config.yp_px.abs());
        let limit_px = 1.06 * corner;
        let mut camera = Camera {
            config: config.clone(),
            middle_px: half.map(|n| n - 0.5),
            limit_px,
            ideal_limit_px: 0.0,
            start_px: Vec::with_capacity(TABLE),
        };
        camera.ideal_limit_px = limit_px * camera.radial(limit_px * limit_px).0;
        camera
    }

    /// What it was made from.
    pub fn config(&self) -> &CameraConfig {
        &self.config
    }

    /// The factor `1 + K0 + ...` at `r^2`, and its derivative by `r^2`.
    fn radial(&self, r2: f64) -> (f64, f64) {
        let CameraConfig { k0, k1, k2, k3, r0_px, .. } = self.config;
        let s2 = r0_px * r0_px;
        let factor = 1.0
            + k0
            + k1 * (r2 - s2)
            + k2 * (r2 * r2 - s2 * s2)
            + k3 * (r2 * r2 * r2 - s2 * s2 * s2);
        (factor, k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2))
    }

    /// The least slope of the radial curve up to a radius.
    fn steepest_to(&self, radius_px: f64) -> f64 {
        (0..=200)
            .map(|i| {
                let r2 = (radius_px * f64::from(i) / 200.0).powi(2);
                let (factor, slope) = self.radial(r2);
                factor + 2.0 * r2 * slope
            })
            .fold(f64::INFINITY, f64::min)
    }

    /// The ideal position of reduced coordinates and its derivative by them.
    fn ideal(&self, xb: f64, yb: f64) -> ([f64; 2], [[f64; 2]; 2]) {
        let CameraConfig { p1, p2, .. } = self.config;
        let r2 = xb * xb + yb * yb;
        let (factor, slope) = self.radial(r2);
        let value = [
            xb * factor + p1 * (r2 + 2.0 * xb * xb) + 2.0 * p2 * xb * yb,
            yb * factor + 2.0 * p1 * xb * yb + p2 * (r2 + 2.0 * yb * yb),
        ];
        let mixed = 2.0 * (slope * xb * yb + p1 * yb + p2 * xb);
        let jacobian = [
            [factor + 2.0 * slope * xb * xb + 6.0 * p1 * xb + 2.0 * p2 * yb, mixed],
            [mixed, factor + 2.0 * slope * yb * yb + 2.0 * p1 * xb + 6.0 * p2 * yb],
        ];
        (value, jacobian)
    }

    /// The direction that a pixel looks in, camera frame: `(x/c, y/c, -1)`.
    pub fn direction(&self, u_px: f64, v_px: f64) -> [f64; 3] {
        let xb = u_px - self.middle_px[0] - self.config.xp_px;
        let yb = self.middle_px[1] - v_px - self.config.yp_px;
        let ([x, y], _) = self.ideal(xb, yb);
        [x / self.config.c_px, y / self.config.c_px, -1.0]
    }

    /// The pixel at which a point of the camera frame appears; `None` where it is not in front of the
    /// camera, or farther out than the model reaches (a little beyond the corners of the image).
    pub fn project(&self, point: [f64; 3]) -> Option<[f64; 2]> {
        self.project_within(point, 1e-9)
    }

    /// As [`Camera::project`], until a step of Newton's method is shorter than `step_px`; what then is left
    /// is about the square of it.
    pub(crate) fn project_within(&self, point: [f64; 3], step_px: f64) -> Option<[f64; 2]> {
        let [u, v, w] = point;
        if w.partial_cmp(&0.0) != Some(std::cmp::Ordering::Less) {
            return None;
        }
        let wanted = [-self.config.c_px * u / w, -self.config.c_px * v / w];
        let radius = (wanted[0] * wanted[0] + wanted[1] * wanted[1]).sqrt();
        if radius.is_nan() || radius >= self.ideal_limit_px {
            return None;
        }
        let place = radius / self.ideal_limit_px * (TABLE - 1) as f64;
        let entry = (place as usize).min(TABLE - 2);
        let (a, b) = (self.start_px[entry], self.start_px[entry + 1]);
        let start = a + (place - entry as f64) * (b - a);
        let scale = if radius > 0.0 { start / radius } else { 0.0 };
        let [mut xb, mut yb] = wanted.map(|value| value * scale);
        for _ in 0..20 {
            let ([x, y], [[a, b], [_, d]]) = self.ideal(xb, yb);
            let (ex, ey) = (wanted[0] - x, wanted[1] - y);
            let determinant = a * d - b * b;
            let (dx, dy) = ((d * ex - b * ey) / determinant, (a * ey - b * ex) / determinant);
            xb += dx;
            yb += dy;
            if dx.abs().max(dy.abs()) < step_px {
                if xb * xb + yb * yb > self.limit_px * self.limit_px {
                    return None;
                }
                return Some([
                    xb + self.config.xp_px + self.middle_px[0],
                    self.middle_px[1] - yb - self.config.yp_px,
                ]);
            }
        }
        None
    }

    /// Whether a pixel position lies at least `margin_px` inside the image.
    pub fn inside(&self, [u_px, v_px]: [f64; 2], margin_px: f64) -> bool {
        let (low, width, height) =
            (margin_px - 0.5, f64::from(self.config.width_px), f64::from(self.config.height_px));
        u_px >= low
            && v_px >= low
            && u_px <= width - 0.5 - margin_px
            && v_px <= height - 0.5 - margin_px
    }

    /// Half of what the middle lines of the image see at unit distance: (across, along the flight).
    pub fn half_footprint(&self) -> [f64; 2] {
        let [u, v] = self.middle_px;
        let (right, left) = (self.direction(2.0 * u, v), self.direction(0.0, v));
        let (up, down) = (self.direction(u, 0.0), self.direction(u, 2.0 * v));
        [0.5 * (right[0] - left[0]), 0.5 * (up[1] - down[1])]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn projecting_where_a_pixel_looks_gives_the_pixel() {
        for config in [
            CameraConfig::wide(2288, 1716, 1000.0),
            CameraConfig::compact(2000, 1500, 1450.0),
            CameraConfig { r0_px: 500.0, k0: 0.02, ..CameraConfig::wide(800, 600, 400.0) },
        ] {
            let camera = Camera::new(&config).unwrap();
            for i in 0..=20 {
                for j in 0..=20 {
                    let u = f64::from(config.width_px) * f64::from(i) / 20.0 - 0.5;
                    let v = f64::from(config.height_px) * f64::from(j) / 20.0 - 0.5;
                    let direction = camera.direction(u, v).map(|part| 7.3 * part);
                    let [pu, pv] = camera.project(direction).unwrap();
                    approx::assert_abs_diff_eq!(pu, u, epsilon = 1e-9);
                    approx::assert_abs_diff_eq!(pv, v, epsilon = 1e-9);
                }
            }
        }
    }

    #[test]
    fn what_is_behind_or_far_outside_has_no_pixel() {
        let camera = Camera::new(&CameraConfig::default()).unwrap();
        assert_eq!(camera.project([0.1, 0.1, 1.0]), None);
        assert_eq!(camera.project([0.1, 0.1, 0.0]), None);
        assert_eq!(camera.project([f64::NAN, 0.1, -1.0]), None);
        assert_eq!(camera.project([50.0, 0.0, -1.0]), None);
        assert!(camera.project([0.0, 0.0, -1.0]).is_some());
    }

    #[test]
    fn a_curve_that_falls_is_refused() {
        let config = CameraConfig { k1: -4e-7, k2: 0.0, k3: 0.0, ..CameraConfig::default() };
        let error = Camera::new(&config).unwrap_err();
        assert_eq!(error.parameter, "camera.K1");
    }
}
