//! The ground: a slope, gentle relief and the furrows of the rows.
//!
//! ```text
//! Z(X, Y) = g . (X, Y) + relief(X, Y) + (furrow/2) cos(2 pi (t - t_0(s)) / D)
//! ```
//!
//! with `g` the slope, `(s, t)` the field's own axes, `D` the distance between rows and `t_0(s)` the middle
//! line of row 0, so that plants stand on the ridges. The relief is a uniform cubic B-spline over a
//! square lattice as wide as its wavelength, with normal coefficients scaled to the variance asked for:
//! smooth up to its second derivative and exact wherever it is asked. Metres, mapping frame, relative to
//! the height of the field's middle.

use crate::{
    check::{ConfigError, within},
    field::FieldConfig,
    streams::{Draw, Stage, stream},
};
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// The shape of the ground; flat by default.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TerrainConfig {
    /// How steeply the field climbs, metres per hundred metres.
    pub slope_percent: f64,
    /// Where it climbs to, degrees counter-clockwise from east.
    pub slope_direction_deg: f64,
    /// Standard deviation of the relief, metres.
    pub relief_m: f64,
    /// Distance between the nodes of the relief, about half the distance between its hills, metres.
    pub relief_wavelength_m: f64,
    /// Height of the ridges above the furrows, metres; the rows stand on the ridges.
    pub furrow_m: f64,
}

impl Default for TerrainConfig {
    fn default() -> TerrainConfig {
        TerrainConfig {
            slope_percent: 0.0,
            slope_direction_deg: 0.0,
            relief_m: 0.0,
            relief_wavelength_m: 12.0,
            furrow_m: 0.0,
        }
    }
}

impl TerrainConfig {
    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter that cannot be used: its name, its value and what was expected.
    pub fn check(&self) -> Result<(), ConfigError> {
        within("terrain.slope_percent", self.slope_percent, 0.0..=30.0)?;
        within("terrain.slope_direction_deg", self.slope_direction_deg, -360.0..=360.0)?;
        within("terrain.relief_wavelength_m", self.relief_wavelength_m, 2.0..=1000.0)?;
        within("terrain.relief_m", self.relief_m, 0.0..=0.05 * self.relief_wavelength_m)?;
        within("terrain.furrow_m", self.furrow_m, 0.0..=0.3)
    }
}

/// Nodes along each side of the table of relief coefficients; the table repeats beyond.
const TABLE: usize = 64;

/// The ground of one field.
#[derive(Debug, Clone, PartialEq)]
pub struct Terrain {
    slope: [f64; 2],
    relief: Vec<f64>,
    wavelength_m: f64,
    half_furrow_m: f64,
    field: Axes,
}

/// What the furrows need to know of the field.
#[derive(Debug, Clone, PartialEq)]
struct Axes {
    sin: f64,
    cos: f64,
    inter_row_m: f64,
    first_row_m: f64,
    curve_m: f64,
    half_length_m: f64,
}

impl Terrain {
    /// The ground of a field whose configuration has been checked.
    pub(crate) fn new(config: &FieldConfig) -> Terrain {
        let terrain = &config.terrain;
        let (sin, cos) = terrain.slope_direction_deg.to_radians().sin_cos();
        let climb = terrain.slope_percent / 100.0;
        let mut rng = stream(config.seed, Stage::Relief, 0);
        // A cubic B-spline of unit white coefficients has, averaged over the plane, the variance
        // (sum over taps of the integral of B^2)^2 = (151/315)^2.
        let scale = terrain.relief_m / (151.0 / 315.0);
        let relief = (0..TABLE * TABLE).map(|_| scale * rng.normal()).collect();
        let (heading_sin, heading_cos) = config.heading_rad().sin_cos();
        Terrain {
            slope: [climb * cos, climb * sin],
            relief: if terrain.relief_m > 0.0 { relief } else { Vec::new() },
            wavelength_m: terrain.relief_wavelength_m,
            half_furrow_m: 0.5 * terrain.furrow_m,
            field: Axes {
                sin: heading_sin,
                cos: heading_cos,
                inter_row_m: config.inter_row_m,
                first_row_m: -0.5 * (config.rows as f64 - 1.0) * config.inter_row_m,
                curve_m: config.curve_m,
                half_length_m: 0.5 * config.row_length_m,
            },
        }
    }

    /// Height of the ground, metres.
    pub fn height_m(&self, x_m: f64, y_m: f64) -> f64 {
        self.height_and_gradient(x_m, y_m).0
    }

    /// Height of the ground, metres, and how it rises towards X and Y, metres per metre.
    pub fn height_and_gradient(&self, x_m: f64, y_m: f64) -> (f64, [f64; 2]) {
        let mut height = self.slope[0] * x_m + self.slope[1] * y_m;
        let mut gradient = self.slope;
        if !self.relief.is_empty() {
            let (value, [dx, dy]) = self.relief(x_m / self.wavelength_m, y_m / self.wavelength_m);
            height += value;
            gradient[0] += dx / self.wavelength_m;
            gradient[1] += dy / self.wavelength_m;
        }
        if self.half_furrow_m > 0.0 {
            let axes = &self.field;
            let along = x_m * axes.cos + y_m * axes.sin;
            let across = x_m * axes.sin - y_m * axes.cos;
            let q = (along / axes.half_length_m).clamp(-1.0, 1.0);
            let line_m = axes.first_row_m + axes.curve_m * (1.0 - q * q);
            // Beyond the ends of the rows the line goes on straight across.
            let bend =
                if q.abs() < 1.0 { 2.0 * axes.curve_m * q / axes.half_length_m } else { 0.0 };
            let wave = TAU / axes.inter_row_m;
            let (sin, cos) = (wave * (across - line_m)).sin_cos();
            height += self.half_furrow_m * cos;
            let slope = -self.half_furrow_m * wave * sin;
            gradient[0] += slope * (axes.sin + bend * axes.cos);
            gradient[1] += slope * (-axes.cos + bend * axes.sin);
        }
        (height, gradient)
    }

    /// The steepest that slope, furrows and relief can be together, metres per metre; the relief's part is the largest
    /// of its gradients at its nodes and between them.
    pub fn steepest(&self) -> f64 {
        let mut relief = 0.0f64;
        if !self.relief.is_empty() {
            for i in 0..4 * TABLE * TABLE {
                let at = |k: usize| 0.5 * k as f64;
                let (_, [dx, dy]) = self.relief(at(i % (2 * TABLE)), at(i / (2 * TABLE)));
                relief = relief.max(f64::hypot(dx, dy));
            }
        }
        f64::hypot(self.slope[0], self.slope[1])
            + self.half_furrow_m * TAU / self.field.inter_row_m
            + relief / self.wavelength_m
    }

    fn relief(&self, x: f64, y: f64) -> (f64, [f64; 2]) {
        let ((i, bx, dx), (j, by, dy)) = (spline(x), spline(y));
        let (mut value, mut slope_x, mut slope_y) = (0.0, 0.0, 0.0);
        for row in 0..4 {
            let start = (j + row as i64).rem_euclid(TABLE as i64) as usize * TABLE;
            let (mut sum, mut sum_x) = (0.0, 0.0);
            for column in 0..4 {
                let node = (i + column as i64).rem_euclid(TABLE as i64) as usize;
                let coefficient = self.relief[start + node];
                sum += bx[column] * coefficient;
                sum_x += dx[column] * coefficient;
            }
            value += by[row] * sum;
            slope_x += by[row] * sum_x;
            slope_y += dy[row] * sum;
        }
        (value, [slope_x, slope_y])
    }

    /// Where a ray meets the ground: how many `direction`s it goes from `origin_m`, to a micrometre of
    /// height; `start` is a guess. `None` where the ray does not go down or never arrives.
    pub fn meet(&self, origin_m: [f64; 3], direction: [f64; 3], start: f64) -> Option<f64> {
        self.meet_within(origin_m, direction, start, 1e-5).map(|(reach, _)| reach)
    }

    /// As [`Terrain::meet`], until a step of Newton's method is shorter than `step_m` in height: what then is left is
    /// about half the ground's curvature times the step's square. Also the gradient of the ground there.
    pub(crate) fn meet_within(
        &self,
        origin_m: [f64; 3],
        direction: [f64; 3],
        start: f64,
        step_m: f64,
    ) -> Option<(f64, [f64; 2])> {
        if direction[2] >= 0.0 || !direction[2].is_finite() {
            return None;
        }
        let mut reach = start;
        for _ in 0..20 {
            let at = [0, 1].map(|i| origin_m[i] + reach * direction[i]);
            let (height, gradient) = self.height_and_gradient(at[0], at[1]);
            let above = origin_m[2] + reach * direction[2] - height;
            let sinking = direction[2] - gradient[0] * direction[0] - gradient[1] * direction[1];
            let step = if sinking < 0.0 { above / sinking } else { above / direction[2] };
            reach -= step;
            if step.abs() * -direction[2] < step_m {
                return (reach > 0.0).then_some((reach, gradient));
            }
        }
        None
    }
}

/// The first node, the four values and the four slopes of the uniform cubic B-spline at `x`.
fn spline(x: f64) -> (i64, [f64; 4], [f64; 4]) {
    let floor = x.floor();
    let t = x - floor;
    let s = 1.0 - t;
    let values = [
        s * s * s / 6.0,
        (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0,
        (3.0 * s * s * s - 6.0 * s * s + 4.0) / 6.0,
        t * t * t / 6.0,
    ];
    let slopes =
        [-0.5 * s * s, 0.5 * (3.0 * t * t - 4.0 * t), -0.5 * (3.0 * s * s - 4.0 * s), 0.5 * t * t];
    (floor as i64 - 1, values, slopes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rough() -> Terrain {
        Terrain::new(&FieldConfig {
            heading_deg: 25.0,
            curve_m: 0.2,
            terrain: TerrainConfig {
                slope_percent: 3.0,
                slope_direction_deg: 40.0,
                relief_m: 0.2,
                relief_wavelength_m: 8.0,
                furrow_m: 0.08,
            },
            ..FieldConfig::default()
        })
    }

    #[test]
    fn gradients_are_differences() {
        let terrain = rough();
        for i in 0..200 {
            let (x, y) = (0.05 * f64::from(i) - 4.0, 3.0 - 0.03 * f64::from(i));
            let (_, gradient) = terrain.height_and_gradient(x, y);
            let h = 1e-5;
            let dx = (terrain.height_m(x + h, y) - terrain.height_m(x - h, y)) / (2.0 * h);
            let dy = (terrain.height_m(x, y + h) - terrain.height_m(x, y - h)) / (2.0 * h);
            approx::assert_abs_diff_eq!(gradient[0], dx, epsilon = 1e-6);
            approx::assert_abs_diff_eq!(gradient[1], dy, epsilon = 1e-6);
        }
    }

    #[test]
    fn relief_has_the_variance_asked_for() {
        let terrain = Terrain::new(&FieldConfig {
            terrain: TerrainConfig { relief_m: 0.3, ..TerrainConfig::default() },
            ..FieldConfig::default()
        });
        let heights: Vec<f64> = (0..64 * 64 * 4)
            .map(|i| {
                let at = |k: i32| 6.0 * f64::from(k) + 1.3;
                terrain.height_m(at(i % 128), at(i / 128))
            })
            .collect();
        let mean = heights.iter().sum::<f64>() / heights.len() as f64;
        let variance = heights.iter().map(|h| (h - mean).powi(2)).sum::<f64>();
        let deviation = (variance / heights.len() as f64).sqrt();
        assert!((deviation / 0.3 - 1.0).abs() < 0.05, "{deviation}");
    }

    #[test]
    fn rays_end_on_the_ground() {
        let terrain = rough();
        for i in 0..100 {
            let origin = [f64::from(i % 10) - 5.0, f64::from(i / 10) - 5.0, 15.0];
            let direction = [1.2 * (f64::from(i) / 50.0 - 1.0), 0.7, -1.0];
            let reach = terrain.meet(origin, direction, 15.0).unwrap();
            let end: Vec<f64> = (0..3).map(|k| origin[k] + reach * direction[k]).collect();
            approx::assert_abs_diff_eq!(end[2], terrain.height_m(end[0], end[1]), epsilon = 2e-6);
        }
        assert_eq!(terrain.meet([0.0, 0.0, 15.0], [0.0, 0.0, 1.0], 1.0), None);
    }

    #[test]
    fn rows_stand_on_ridges() {
        let config = FieldConfig {
            heading_deg: 10.0,
            curve_m: 0.15,
            terrain: TerrainConfig { furrow_m: 0.1, ..TerrainConfig::default() },
            ..FieldConfig::default()
        };
        let terrain = Terrain::new(&config);
        for row in 0..config.rows {
            for along in [-2.4, -1.0, 0.0, 1.7] {
                let across = config.row_across(row, along);
                let [x, y] = config.ground(along, across);
                approx::assert_abs_diff_eq!(terrain.height_m(x, y), 0.05, epsilon = 1e-9);
                let [x, y] = config.ground(along, across + 0.5 * config.inter_row_m);
                approx::assert_abs_diff_eq!(terrain.height_m(x, y), -0.05, epsilon = 1e-9);
            }
        }
    }
}
