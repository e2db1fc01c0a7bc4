//! The angles that a gimbal writes into photos: yaw clockwise from north, pitch up from the horizon, roll about the view.
//!
//! In north, east, down and for a body that looks along its first axis with its second to the right, `R = R_z(yaw) R_y(pitch)
//! R_x(roll)`, hence its first column, where it looks, is `(cos pitch cos yaw, cos pitch sin yaw, -sin pitch)`, and its last row
//! `(-sin pitch, cos pitch sin roll, cos pitch cos roll)`. Straight down, where only yaw and roll together are told, roll is 0.

use crate::block_camera::Matrix;

/// Below this cosine of the pitch yaw and roll cannot be told apart.
const STRAIGHT: f64 = 1e-9;

/// Yaw, pitch and roll, degrees, of a camera with this rotation from its frame (right, up along the picture, backwards) to
/// the mapping frame (east, north, up).
pub fn angles_deg(rotation: &Matrix) -> [f64; 3] {
    // Columns: the view is against the third, right is the first, down in the picture against the second.
    let [view, right, down] = [(2, -1.0), (0, 1.0), (1, -1.0)]
        .map(|(column, sign): (usize, f64)| rotation.map(|row| sign * row[column]));
    let level = view[0].hypot(view[1]);
    let pitch = view[2].atan2(level);
    let (yaw, roll) = if level < STRAIGHT {
        (f64::atan2(-right[1], right[0]), 0.0)
    } else {
        (f64::atan2(view[0], view[1]), f64::atan2(-right[2], -down[2]))
    };
    [yaw, pitch, roll].map(f64::to_degrees)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(found: [f64; 3], expected: [f64; 3]) {
        for k in 0..3 {
            assert!((found[k] - expected[k]).abs() < 1e-9, "{found:?}, not {expected:?}");
        }
    }

    #[test]
    fn cameras_that_look_north_east_and_down_have_the_angles_of_a_compass() {
        // Columns are right, up and backwards in east, north, up.
        near(angles_deg(&[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), [0.0, -90.0, 0.0]);
        // To the horizon in the north, and in the east.
        near(angles_deg(&[[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), [0.0, 0.0, 0.0]);
        near(angles_deg(&[[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), [90.0, 0.0, 0.0]);
        // Straight down with the upper edge in the east.
        near(angles_deg(&[[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), [90.0, -90.0, 0.0]);
        // To the north, the right side of the camera 30 degrees lower.
        let (s, c) = 30_f64.to_radians().sin_cos();
        near(angles_deg(&[[c, s, 0.0], [0.0, 0.0, -1.0], [-s, c, 0.0]]), [0.0, 0.0, 30.0]);
        // To the north, 45 degrees down.
        let h = 0.5_f64.sqrt();
        near(angles_deg(&[[1.0, 0.0, 0.0], [0.0, h, -h], [0.0, h, h]]), [0.0, -45.0, 0.0]);
    }
}
