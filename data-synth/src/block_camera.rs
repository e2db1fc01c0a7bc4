//! The forward camera of the block (see [`block`](crate::block)) and the text file that carries it.
//!
//! Written on its own from the definition, sharing nothing with any estimator, so that an error in
//! one cannot cancel itself in the other.

use crate::block::Observation;
use std::io::{self, Write};

/// A rotation matrix by rows.
pub(crate) type Matrix = [[f64; 3]; 3];

/// A camera ready to project.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ForwardCamera {
    /// Rotation from the mapping frame to the camera, by rows.
    pub rotation: [[f64; 3]; 3],
    translation_m: [f64; 3],
    lens: [f64; 3],
}

impl ForwardCamera {
    /// From the nine parameters: angle-axis, translation (metres), f (pixels), k1, k2.
    pub fn new(parameters: &[f64; 9]) -> ForwardCamera {
        let [r0, r1, r2, t0, t1, t2, f, k1, k2] = *parameters;
        ForwardCamera {
            rotation: matrix([r0, r1, r2]),
            translation_m: [t0, t1, t2],
            lens: [f, k1, k2],
        }
    }

    /// Where a point (metres, mapping frame) appears, pixels from the middle of the image, x right
    /// and y up; `None` where it is not in front of the camera.
    pub fn project(&self, point_m: [f64; 3]) -> Option<[f64; 2]> {
        let mut camera_m = self.translation_m;
        for (row, value) in self.rotation.iter().zip(&mut camera_m) {
            *value += row[0] * point_m[0] + row[1] * point_m[1] + row[2] * point_m[2];
        }
        if camera_m[2].partial_cmp(&0.0) != Some(std::cmp::Ordering::Less) {
            return None;
        }
        let p = [-camera_m[0] / camera_m[2], -camera_m[1] / camera_m[2]];
        let r2 = p[0] * p[0] + p[1] * p[1];
        let scale = self.lens[0] * (1.0 + self.lens[1] * r2 + self.lens[2] * r2 * r2);
        Some([scale * p[0], scale * p[1]])
    }

    /// The centre of the camera, `-R^T t`, metres.
    pub fn centre_m(&self) -> [f64; 3] {
        transpose_times(&self.rotation, self.translation_m).map(|value| -value)
    }

    /// The principal distance, pixels.
    pub fn focal_px(&self) -> f64 {
        self.lens[0]
    }
}

/// The rotation by `|v|` about `v` (Rodrigues).
pub(crate) fn matrix(v: [f64; 3]) -> Matrix {
    let angle = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
    // (sin a)/a and (1 - cos a)/a^2, the latter without cancellation.
    let (s, c) = if angle < 1e-8 {
        (1.0, 0.5)
    } else {
        let half = (0.5 * angle).sin() / (0.5 * angle);
        (angle.sin() / angle, 0.5 * half * half)
    };
    let [x, y, z] = v;
    [
        [1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y],
        [c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x],
        [c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)],
    ]
}

/// The vector `v` of a rotation, `|v| <= pi`, by way of the largest component of its quaternion.
pub(crate) fn angle_axis(m: &Matrix) -> [f64; 3] {
    let four = [
        1.0 + m[0][0] + m[1][1] + m[2][2],
        1.0 + m[0][0] - m[1][1] - m[2][2],
        1.0 - m[0][0] + m[1][1] - m[2][2],
        1.0 - m[0][0] - m[1][1] + m[2][2],
    ];
    let skew = [m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]];
    let sums = [m[2][1] + m[1][2], m[0][2] + m[2][0], m[1][0] + m[0][1]];
    let largest = (1..4).fold(0, |best, i| if four[i] > four[best] { i } else { best });
    let [w, x, y, z] = match largest {
        0 => [four[0], skew[0], skew[1], skew[2]],
        1 => [skew[0], four[1], sums[2], sums[1]],
        2 => [skew[1], sums[2], four[2], sums[0]],
        _ => [skew[2], sums[1], sums[0], four[3]],
    };
    // The quaternion up to a positive factor, turned to w >= 0.
    let sign = if w < 0.0 { -1.0 } else { 1.0 };
    let length = (x * x + y * y + z * z).sqrt();
    let scale = if length > 0.0 { sign * 2.0 * length.atan2(w.abs()) / length } else { 0.0 };
    [scale * x, scale * y, scale * z]
}

pub(crate) fn multiply(a: &Matrix, b: &Matrix) -> Matrix {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

/// `m^T v`.
pub(crate) fn transpose_times(m: &Matrix, v: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| (0..3).map(|k| m[k][i] * v[k]).sum())
}

/// Writes cameras, points and measurements as a BAL text file: a line with the three counts, one
/// line per measurement (camera, point, x, y), then every parameter on a line of its own, with 17
/// significant digits, so that reading it gives back the same numbers.
///
/// # Errors
/// What the writer says.
pub fn write_bal(
    cameras: &[[f64; 9]],
    points: &[[f64; 3]],
    observations: &[Observation],
    writer: &mut dyn Write,
) -> io::Result<()> {
    writeln!(writer, "{} {} {}", cameras.len(), points.len(), observations.len())?;
    for observation in observations {
        let Observation { camera, point, measured_px: [x, y], .. } = observation;
        writeln!(writer, "{camera} {point} {x:.16e} {y:.16e}")?;
    }
    for value in cameras.iter().flatten().chain(points.iter().flatten()) {
        writeln!(writer, "{value:.16e}")?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::streams::{Draw, Stage, stream};

    #[test]
    fn angle_axis_and_matrix_are_inverse_up_to_half_a_turn() {
        let mut rng = stream(1, Stage::BlockPose, 0);
        for angle in [0.0, 1e-12, 1e-6, 0.1, 1.0, 2.0, 3.0, 3.13, std::f64::consts::PI] {
            for _ in 0..50 {
                let axis = [0; 3].map(|_| rng.normal());
                let length = axis.iter().map(|a| a * a).sum::<f64>().sqrt();
                let v = axis.map(|a| a * angle / length);
                let m = matrix(v);
                let again = matrix(angle_axis(&m));
                let identity = multiply(&m, &std::array::from_fn(|i| [m[0][i], m[1][i], m[2][i]]));
                for i in 0..3 {
                    for j in 0..3 {
                        approx::assert_abs_diff_eq!(m[i][j], again[i][j], epsilon = 1e-14);
                        let unit = if i == j { 1.0 } else { 0.0 };
                        approx::assert_abs_diff_eq!(identity[i][j], unit, epsilon = 1e-14);
                    }
                }
            }
        }
    }

    #[test]
    fn a_quarter_turn_about_z_takes_x_to_y() {
        let m = matrix([0.0, 0.0, std::f64::consts::FRAC_PI_2]);
        let turned = m.map(|row| row[0]);
        for (value, expected) in turned.into_iter().zip([0.0, 1.0, 0.0]) {
            approx::assert_abs_diff_eq!(value, expected, epsilon = 1e-15);
        }
    }

    #[test]
    fn points_behind_are_not_projected() {
        let camera = ForwardCamera::new(&[0.0, 0.0, 0.0, 0.0, 0.0, -10.0, 100.0, 0.0, 0.0]);
        assert_eq!(camera.project([1.0, 2.0, 0.0]), Some([10.0, 20.0]));
        assert_eq!(camera.project([1.0, 2.0, 10.0]), None);
        assert_eq!(camera.project([1.0, 2.0, f64::NAN]), None);
    }
}
