//! The exterior orientation of an image.

use rowgram_optim::geometry::rotation;

/// `camera_from_world`: `P = R(q) X + t`, the camera frame being that of [`crate::camera::lens`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// The rotation as a unit quaternion.
    pub rotation: rotation::Quaternion,
    /// The translation, metres.
    pub translation: [f64; 3],
}

impl Pose {
    /// The pose of a camera with this rotation and projection centre.
    pub fn from_centre(rotation: rotation::Quaternion, centre_m: [f64; 3]) -> Pose {
        Pose { rotation, translation: rotation::rotate(rotation, centre_m).map(|v| -v) }
    }

    /// The projection centre in the world, metres.
    pub fn centre_m(&self) -> [f64; 3] {
        rotation::rotate(rotation::inverse(self.rotation), self.translation).map(|v| -v)
    }

    /// A point of the world in the camera frame.
    pub fn to_camera(&self, point_m: [f64; 3]) -> [f64; 3] {
        let turned = rotation::rotate(self.rotation, point_m);
        std::array::from_fn(|k| turned[k] + self.translation[k])
    }

    /// The pose after a turn (rotation vector, radians) and a shift (metres) of the camera frame.
    pub(crate) fn moved(&self, by: [f64; 6]) -> Pose {
        let turn = rotation::exp([by[0], by[1], by[2]]);
        let turned = rotation::rotate(turn, self.translation);
        Pose {
            rotation: rotation::normalize(rotation::multiply(turn, self.rotation)),
            translation: std::array::from_fn(|k| turned[k] + by[3 + k]),
        }
    }

    /// The angles of `R^T = Rx(omega) Ry(phi) Rz(kappa)`, the photogrammetric rotation matrix from the
    /// camera frame to the world, radians.
    pub fn omega_phi_kappa_rad(&self) -> [f64; 3] {
        let m = rotation::matrix(rotation::inverse(self.rotation));
        [(-m[1][2]).atan2(m[2][2]), m[0][2].clamp(-1.0, 1.0).asin(), (-m[0][1]).atan2(m[0][0])]
    }
}
