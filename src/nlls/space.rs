//! The spaces that parameter blocks live in, and the one way to move in them.
//!
//! `x (+) d` ([`Space::plus`]) moves the ambient values `x` by a tangent vector `d`; `y (-) x`
//! ([`Space::minus`]) is the tangent vector from `x` to `y`. Jacobians of factors are with respect
//! to `d` at `d = 0`.
//!
//! | space | ambient values | tangent | `x (+) d` |
//! |---|---|---|---|
//! | `Euclidean(n)` | `n` | `n` | `x + d` |
//! | `Rotation` | quaternion `w x y z` | 3 | `Exp(d) q` |
//! | `Pose` | `q`, then `t`: `y = R(q) x + t` | 6: `w`, then `s` | `q' = Exp(w) q`, `t' = Exp(w) t + s` |
//! | `PoseAnd(n)` | a pose, then `n` numbers | 6 + `n` | as both parts |
//! | `Direction` | unit 3-vector | 2 | along the great circle by `B(x) d` |
//! | `Similarity` | `q`, `t`, `s > 0`: `y = s R(q) x + t` | 7: `w`, `t`, `log s` | `Exp(w) q`, `t + d_t`, `s exp(d_s)` |
//!
//! The increment of a pose is taken in the target frame: for `camera_from_world` the camera turns
//! about its own centre by `w` (radians) and its frame then shifts by `s`.
//!
//! Invariants (Ceres' `manifold.h` lists the same), each a test for every space:
//! 1. `x (+) 0 = x`;
//! 2. `x (+) (y (-) x) = y`;
//! 3. `(x (+) d) (-) x = d` for `d` shorter than the injectivity radius.

use crate::geometry::{cross, dot, rotation};
use serde::{Deserialize, Serialize};

/// Where a parameter block lives.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Space {
    /// `n` numbers.
    Euclidean(usize),
    /// A rotation.
    Rotation,
    /// A rigid transformation.
    Pose,
    /// A rigid transformation and `n` numbers that are always wanted together, such as a camera
    /// with its own lens.
    PoseAnd(usize),
    /// A direction: a point of the unit sphere.
    Direction,
    /// A rotation, translation and scale.
    Similarity,
}

/// The largest tangent dimension of one block.
pub const MAX_TANGENT: usize = 64;

impl Space {
    /// How many numbers a block of this space stores.
    pub fn ambient(self) -> usize {
        match self {
            Space::Euclidean(n) => n,
            Space::Rotation => 4,
            Space::Pose => 7,
            Space::PoseAnd(n) => 7 + n,
            Space::Direction => 3,
            Space::Similarity => 8,
        }
    }

    /// How many degrees of freedom a block of this space has.
    pub fn tangent(self) -> usize {
        match self {
            Space::Euclidean(n) => n,
            Space::Rotation => 3,
            Space::Pose => 6,
            Space::PoseAnd(n) => 6 + n,
            Space::Direction => 2,
            Space::Similarity => 7,
        }
    }

    /// Writes `x (+) d` to `out`.
    pub fn plus(self, x: &[f64], d: &[f64], out: &mut [f64]) {
        debug_assert_eq!((x.len(), d.len()), (self.ambient(), self.tangent()));
        match self {
            Space::Euclidean(_) => add(x, d, out),
            Space::Rotation => out.copy_from_slice(&turn(quaternion(x), vector(d))),
            Space::Pose => pose_plus(x, d, out),
            Space::PoseAnd(_) => {
                pose_plus(&x[..7], &d[..6], &mut out[..7]);
                add(&x[7..], &d[6..], &mut out[7..]);
            }
            Space::Direction => {
                let basis = direction_basis(vector(x));
                let along: [f64; 3] =
                    std::array::from_fn(|k| basis[0][k] * d[0] + basis[1][k] * d[1]);
                let angle = dot(along, along).sqrt();
                // sin(a)/a tends to 1: no division for a step of nothing.
                let ratio = if angle < 1e-9 { 1.0 } else { angle.sin() / angle };
                let moved: [f64; 3] =
                    std::array::from_fn(|k| angle.cos() * x[k] + ratio * along[k]);
                let norm = dot(moved, moved).sqrt();
                for k in 0..3 {
                    out[k] = moved[k] / norm;
                }
            }
            Space::Similarity => {
                out[..4].copy_from_slice(&turn(quaternion(x), vector(d)));
                add(&x[4..7], &d[3..6], &mut out[4..7]);
                out[7] = x[7] * d[6].exp();
            }
        }
    }

    /// Writes `y (-) x` to `out`: the tangent vector that takes `x` to `y`.
    pub fn minus(self, y: &[f64], x: &[f64], out: &mut [f64]) {
        match self {
            Space::Euclidean(_) => subtract(y, x, out),
            Space::Rotation => out.copy_from_slice(&turned(quaternion(y), quaternion(x))),
            Space::Pose => pose_minus(y, x, out),
            Space::PoseAnd(_) => {
                pose_minus(&y[..7], &x[..7], &mut out[..6]);
                subtract(&y[7..], &x[7..], &mut out[6..]);
            }
            Space::Direction => {
                let (from, to) = (vector(x), vector(y));
                let axis = cross(from, to);
                let sine = dot(axis, axis).sqrt();
                let angle = sine.atan2(dot(from, to));
                let cosine = dot(from, to);
                let basis = direction_basis(from);
                // The part of y across x, scaled to the angle; at the antipode any direction will do.
                let across: [f64; 3] = std::array::from_fn(|k| to[k] - cosine * from[k]);
                let length = dot(across, across).sqrt();
                if length > 0.0 {
                    out[0] = angle / length * dot(basis[0], across);
                    out[1] = angle / length * dot(basis[1], across);
                } else {
                    out[0] = if cosine < 0.0 { std::f64::consts::PI } else { 0.0 };
                    out[1] = 0.0;
                }
            }
            Space::Similarity => {
                out[..3].copy_from_slice(&turned(quaternion(y), quaternion(x)));
                subtract(&y[4..7], &x[4..7], &mut out[3..6]);
                out[6] = (y[7] / x[7]).ln();
            }
        }
    }

    /// What is wrong with `x` as values of this space, if anything.
    pub fn defect(self, x: &[f64]) -> Option<String> {
        if x.len() != self.ambient() {
            return Some(format!(
                "{self:?} stores {} numbers, {} were given",
                self.ambient(),
                x.len()
            ));
        }
        if let Some(position) = x.iter().position(|v| !v.is_finite()) {
            return Some(format!("entry {position} is {}", x[position]));
        }
        let off_unit = |v: &[f64]| {
            let norm = v.iter().map(|c| c * c).sum::<f64>().sqrt();
            ((norm - 1.0).abs() > 1e-9)
                .then(|| format!("length {norm}, a unit vector was expected"))
        };
        match self {
            Space::Euclidean(_) => None,
            Space::Rotation | Space::Pose | Space::PoseAnd(_) => off_unit(&x[..4]),
            Space::Direction => off_unit(x),
            Space::Similarity => off_unit(&x[..4])
                .or_else(|| (x[7] <= 0.0).then(|| format!("scale {}, must be positive", x[7]))),
        }
    }
}

/// Two orthonormal tangent directions at the unit vector `x`.
///
/// The coordinate axis furthest from `x` starts the basis, so it is stable everywhere; it jumps
/// where that axis changes, which [`Space::plus`] and [`Space::minus`] see alike.
pub fn direction_basis(x: [f64; 3]) -> [[f64; 3]; 2] {
    let furthest = (0..3).min_by(|&a, &b| x[a].abs().total_cmp(&x[b].abs())).unwrap_or(0);
    let mut axis = [0.0; 3];
    axis[furthest] = 1.0;
    let first = cross(axis, x);
    let norm = dot(first, first).sqrt();
    let first = first.map(|v| v / norm);
    [first, cross(x, first)]
}

fn add(x: &[f64], d: &[f64], out: &mut [f64]) {
    for ((out, x), d) in out.iter_mut().zip(x).zip(d) {
        *out = x + d;
    }
}

fn subtract(y: &[f64], x: &[f64], out: &mut [f64]) {
    for ((out, y), x) in out.iter_mut().zip(y).zip(x) {
        *out = y - x;
    }
}

fn vector(x: &[f64]) -> [f64; 3] {
    [x[0], x[1], x[2]]
}

fn quaternion(x: &[f64]) -> rotation::Quaternion {
    [x[0], x[1], x[2], x[3]]
}

fn turn(q: rotation::Quaternion, w: [f64; 3]) -> rotation::Quaternion {
    if w == [0.0; 3] {
        return q;
    }
    rotation::normalize(rotation::multiply(rotation::exp(w), q))
}

fn turned(y: rotation::Quaternion, x: rotation::Quaternion) -> [f64; 3] {
    rotation::log(rotation::multiply(y, rotation::inverse(x)))
}

fn pose_plus(x: &[f64], d: &[f64], out: &mut [f64]) {
    let w = vector(d);
    let moved = rotation::rotate(rotation::exp(w), vector(&x[4..]));
    out[..4].copy_from_slice(&turn(quaternion(x), w));
    for k in 0..3 {
        out[4 + k] = moved[k] + d[3 + k];
    }
}

fn pose_minus(y: &[f64], x: &[f64], out: &mut [f64]) {
    let between = rotation::multiply(quaternion(y), rotation::inverse(quaternion(x)));
    out[..3].copy_from_slice(&rotation::log(between));
    let moved = rotation::rotate(between, vector(&x[4..]));
    for k in 0..3 {
        out[3 + k] = y[4 + k] - moved[k];
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SPACES: [Space; 7] = [
        Space::Euclidean(1),
        Space::Euclidean(5),
        Space::Rotation,
        Space::Pose,
        Space::PoseAnd(3),
        Space::Direction,
        Space::Similarity,
    ];

    /// A point of the space, made from arbitrary numbers.
    fn point(space: Space, seed: &[f64]) -> Vec<f64> {
        let mut x = seed[..space.ambient()].to_vec();
        match space {
            Space::Euclidean(_) => {}
            Space::Direction => {
                let norm = x.iter().map(|v| v * v).sum::<f64>().sqrt();
                x.iter_mut().for_each(|v| *v /= norm);
            }
            _ => {
                let q = rotation::exp([seed[9], seed[10], seed[11]]);
                x[..4].copy_from_slice(&q);
                if space == Space::Similarity {
                    x[7] = seed[7].exp();
                }
            }
        }
        x
    }

    fn close(a: &[f64], b: &[f64]) -> bool {
        a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12)
    }

    proptest! {
        #[test]
        fn plus_and_minus_are_inverse(
            a in prop::collection::vec(0.1..1.3f64, 12),
            b in prop::collection::vec(-1.3..-0.1f64, 12),
            d in prop::collection::vec(-0.8..0.8f64, 12),
            shrink in 0..12i32,
        ) {
            for space in SPACES {
                let (x, y) = (point(space, &a), point(space, &b));
                let n = space.tangent();
                let mut out = vec![0.0; space.ambient()];
                let mut back = vec![0.0; n];

                space.plus(&x, &vec![0.0; n], &mut out);
                prop_assert!(close(&out, &x), "x + 0 in {space:?}");

                space.minus(&y, &x, &mut back);
                space.plus(&x, &back, &mut out);
                let same = close(&out, &y)
                    // q and -q are the same rotation
                    || (close(&out[4..], &y[4..]) && close(&out[..4], &y[..4].iter().map(|v| -v).collect::<Vec<_>>()));
                prop_assert!(same, "x + (y - x) in {space:?}: {out:?} {y:?}");

                let d: Vec<f64> = d[..n].iter().map(|v| v * 10f64.powi(-shrink)).collect();
                space.plus(&x, &d, &mut out);
                space.minus(&out, &x, &mut back);
                prop_assert!(close(&back, &d), "(x + d) - x in {space:?}: {back:?} {d:?}");
                prop_assert!(space.defect(&out).is_none());
            }
        }

        #[test]
        fn a_direction_basis_is_orthonormal(x in [-1.0..1.0f64, -1.0..1.0, 0.01..1.0f64]) {
            let norm = dot(x, x).sqrt();
            let x = x.map(|v| v / norm);
            let [a, b] = direction_basis(x);
            for (value, expected) in
                [(dot(a, a), 1.0), (dot(b, b), 1.0), (dot(a, b), 0.0), (dot(a, x), 0.0), (dot(b, x), 0.0)]
            {
                prop_assert!((value - expected).abs() < 1e-14);
            }
        }
    }

    #[test]
    fn defects_are_named() {
        assert!(Space::Rotation.defect(&[2.0, 0.0, 0.0, 0.0]).unwrap().contains("unit"));
        assert!(Space::Euclidean(2).defect(&[1.0, f64::NAN]).unwrap().contains("entry 1"));
        assert!(Space::Pose.defect(&[1.0]).unwrap().contains("7 numbers"));
        assert!(
            Space::Similarity.defect(&[1., 0., 0., 0., 0., 0., 0., 0.]).unwrap().contains("scale")
        );
    }
}
