//! Measured orientations of cameras, as a gimbal or an inertial unit tells them.
//!
//! A gimbal tells yaw clockwise from north, pitch up from the horizon and roll about the view. With a body that looks along its
//! first axis, has its second to the right and its third down, and a world of north, east and down,
//!
//! ```text
//! x_ned = R_z(yaw) R_y(pitch) R_x(roll) x_body
//! ```
//!
//! so that yaw 0, pitch -90, roll 0 is a photo from straight above whose upper edge is in the north. Camera frames are those of
//! [`super::Pose`]: right, up along the picture, against the view; the mapping frame is east, north, up.

use rowgram_optim::geometry::rotation::{self, Quaternion};

/// The measured orientation of an image's camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraOrientation {
    /// Index of the image.
    pub image: u32,
    /// From the mapping frame to the camera frame.
    pub rotation: Quaternion,
    /// Standard deviations of turns about the axes of the mapping frame (east, north, up), radians.
    pub sigma_rad: [f64; 3],
}

/// The rotation from the mapping frame to the frame of a camera whose gimbal has these angles, yaw, pitch and roll in degrees.
pub fn gimbal_rotation([yaw, pitch, roll]: [f64; 3]) -> Quaternion {
    let [yaw, pitch, roll] = [yaw, pitch, roll].map(f64::to_radians);
    // East, north, up from north, east, down, and the body from the camera: half turns about the diagonal of two axes.
    let h = 0.5_f64.sqrt();
    let enu_from_ned = [0.0, h, h, 0.0];
    let body_from_camera = rotation::multiply(
        rotation::exp([0.0, std::f64::consts::FRAC_PI_2, 0.0]),
        [0.0, h, h, 0.0],
    );
    let ned_from_body = rotation::multiply(
        rotation::exp([0.0, 0.0, yaw]),
        rotation::multiply(rotation::exp([0.0, pitch, 0.0]), rotation::exp([roll, 0.0, 0.0])),
    );
    let mapping_from_camera =
        rotation::multiply(enu_from_ned, rotation::multiply(ned_from_body, body_from_camera));
    rotation::normalize(rotation::inverse(mapping_from_camera))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Right, up along the picture and the view of a camera in east, north, up.
    fn axes(angles_deg: [f64; 3]) -> [[f64; 3]; 3] {
        let back = rotation::inverse(gimbal_rotation(angles_deg));
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]
            .map(|axis| rotation::rotate(back, axis))
    }

    fn near(found: [[f64; 3]; 3], expected: [[f64; 3]; 3]) {
        for (found, expected) in found.iter().zip(&expected) {
            for k in 0..3 {
                assert!((found[k] - expected[k]).abs() < 1e-12, "{found:?}, not {expected:?}");
            }
        }
    }

    #[test]
    fn angles_of_a_gimbal_are_those_worked_out_by_hand() {
        let (east, north, up) = ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]);
        let minus = |v: [f64; 3]| v.map(|v| -v);
        // From straight above, the upper edge in the north, then in the east.
        near(axes([0.0, -90.0, 0.0]), [east, north, minus(up)]);
        near(axes([90.0, -90.0, 0.0]), [minus(north), east, minus(up)]);
        // A gimbal that has turned over says the same of a camera.
        near(axes([180.0, -90.0, 180.0]), axes([0.0, -90.0, 0.0]));
        // To the horizon in the north and in the west.
        near(axes([0.0, 0.0, 0.0]), [east, up, north]);
        near(axes([-90.0, 0.0, 0.0]), [north, up, minus(east)]);
        // Obliquely down to the east.
        let h = 0.5_f64.sqrt();
        near(axes([90.0, -45.0, 0.0]), [minus(north), [h, 0.0, h], [h, 0.0, -h]]);
        // To the north, the right side 30 degrees lower.
        let (s, c) = 30_f64.to_radians().sin_cos();
        near(axes([0.0, 0.0, 30.0]), [[c, 0.0, -s], [s, 0.0, c], north]);
    }
}
