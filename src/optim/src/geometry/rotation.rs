//! Rotations as unit quaternions `q = [w, x, y, z]`, written to act on column vectors: `R(q) v`.
//!
//! `exp` takes a rotation vector `w` (axis times angle, radians) to the quaternion of `Exp([w]x)`,
//! `log` takes it back with an angle in `[0, pi]`. Reference: J. Sola, *Quaternion kinematics for
//! the error-state Kalman filter*, 2017, sections 1 and 2.

/// A unit quaternion `[w, x, y, z]`.
pub type Quaternion = [f64; 4];

/// The identity rotation.
pub const IDENTITY: Quaternion = [1.0, 0.0, 0.0, 0.0];

/// The rotation by the vector `w`, in radians.
pub fn exp(w: [f64; 3]) -> Quaternion {
    let angle_squared = super::dot(w, w);
    // sin(a/2)/a, by its series where the quotient would lose digits.
    let (cosine, ratio) = if angle_squared < 1e-8 {
        (1.0 - angle_squared / 8.0, 0.5 - angle_squared / 48.0)
    } else {
        let angle = angle_squared.sqrt();
        ((0.5 * angle).cos(), (0.5 * angle).sin() / angle)
    };
    [cosine, ratio * w[0], ratio * w[1], ratio * w[2]]
}

/// The rotation vector of `q`, in radians, with an angle in `[0, pi]`.
pub fn log(q: Quaternion) -> [f64; 3] {
    let q = if q[0] < 0.0 { [-q[0], -q[1], -q[2], -q[3]] } else { q };
    let sine = (q[1] * q[1] + q[2] * q[2] + q[3] * q[3]).sqrt();
    let ratio = if sine < 1e-9 {
        2.0 / q[0] - 2.0 * sine * sine / (3.0 * q[0].powi(3))
    } else {
        2.0 * sine.atan2(q[0]) / sine
    };
    [ratio * q[1], ratio * q[2], ratio * q[3]]
}

/// The product `a b`: first `b`, then `a`.
pub fn multiply(a: Quaternion, b: Quaternion) -> Quaternion {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

/// The inverse rotation.
pub fn inverse(q: Quaternion) -> Quaternion {
    [q[0], -q[1], -q[2], -q[3]]
}

/// `q` scaled to unit length.
pub fn normalize(q: Quaternion) -> Quaternion {
    let norm = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]).sqrt();
    [q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm]
}

/// The rotation matrix of `q`, as rows.
#[inline]
pub fn matrix(q: Quaternion) -> [[f64; 3]; 3] {
    let [w, x, y, z] = q;
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// `R(q) v`.
#[inline]
pub fn rotate(q: Quaternion, v: [f64; 3]) -> [f64; 3] {
    let r = matrix(q);
    [super::dot(r[0], v), super::dot(r[1], v), super::dot(r[2], v)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn vector() -> impl Strategy<Value = [f64; 3]> {
        [-1.8..1.8f64, -1.8..1.8f64, -1.8..1.8f64]
    }

    proptest! {
        #[test]
        fn log_inverts_exp(w in vector(), shrink in 0..14i32) {
            let w = w.map(|v| v * 10f64.powi(-shrink));
            let back = log(exp(w));
            for k in 0..3 {
                prop_assert!((back[k] - w[k]).abs() <= 1e-15 + 1e-13 * w[k].abs());
            }
        }

        #[test]
        fn a_product_rotates_one_after_the_other(a in vector(), b in vector(), v in vector()) {
            let (a, b) = (exp(a), exp(b));
            let once = rotate(multiply(a, b), v);
            let twice = rotate(a, rotate(b, v));
            let back = rotate(inverse(a), twice);
            for k in 0..3 {
                prop_assert!((once[k] - twice[k]).abs() < 1e-14);
                prop_assert!((back[k] - rotate(b, v)[k]).abs() < 1e-14);
            }
        }
    }

    #[test]
    fn a_quarter_turn_about_z_takes_x_to_y() {
        let v = rotate(exp([0.0, 0.0, std::f64::consts::FRAC_PI_2]), [1.0, 0.0, 0.0]);
        assert!((v[0]).abs() < 1e-15 && (v[1] - 1.0).abs() < 1e-15 && v[2] == 0.0);
    }

    #[test]
    fn log_holds_at_a_half_turn() {
        let w = log([0.0, 0.0, 1.0, 0.0]);
        assert!((w[1] - std::f64::consts::PI).abs() < 1e-15);
    }
}
