//! Manifolds: the sets that parameter blocks live in, and how to move in them.
//!
//! `x (+) d` ([`Manifold::plus`]) moves the ambient values `x` by a tangent vector `d`; `y (-) x`
//! ([`Manifold::minus`]) is the tangent vector from `x` to `y`. Jacobians of factors are with respect
//! to `d` at `d = 0`. The set is open: a manifold of your own is one more type with this trait, and
//! [`super::check::check_manifold`] tests it.
//!
//! | manifold | ambient values | tangent | `x (+) d` |
//! |---|---|---|---|
//! | `Euclidean(n)` | `n` | `n` | `x + d` |
//! | `Rotation` | quaternion `w x y z` | 3 | `Exp(d) q` |
//! | `Pose` | `q`, then `t`: `y = R(q) x + t` | 6: `w`, then `s` | `q' = Exp(w) q`, `t' = Exp(w) t + s` |
//! | `PoseWithParameters(n)` | a pose, then `n` numbers | 6 + `n` | as both parts |
//! | `UnitVector` | unit 3-vector | 2 | along the great circle by `B(x) d` |
//! | `Similarity` | `q`, `t`, `s > 0`: `y = s R(q) x + t` | 7: `w`, `t`, `log s` | `Exp(w) q`, `t + d_t`, `s exp(d_s)` |
//!
//! The increment of a pose is taken in the target frame: for `camera_from_world` the camera turns
//! about its own centre by `w` (radians) and its frame then shifts by `s`.
//!
//! Invariants (Ceres' `manifold.h` lists the same), each a test for every manifold:
//! 1. `x (+) 0 = x`;
//! 2. `x (+) (y (-) x) = y`;
//! 3. `(x (+) d) (-) x = d` for `d` shorter than the injectivity radius.

use crate::geometry::{cross, dot, rotation};
use std::{any::Any, fmt::Debug};

/// The largest tangent dimension of one block.
pub const MAX_TANGENT: usize = 64;

/// The set in which the values of a parameter block lie.
pub trait Manifold: Any + Debug + Send + Sync {
    /// How many numbers a block stores.
    fn ambient(&self) -> usize;

    /// How many degrees of freedom a block has, at most [`MAX_TANGENT`].
    fn tangent(&self) -> usize;

    /// Writes `x (+) d` to `out`.
    fn plus(&self, x: &[f64], d: &[f64], out: &mut [f64]);

    /// Writes `y (-) x` to `out`: the tangent vector that takes `x` to `y`.
    fn minus(&self, y: &[f64], x: &[f64], out: &mut [f64]);

    /// What is wrong with `x` as values on this manifold, if anything. Length and finiteness are
    /// checked already.
    fn defect(&self, _x: &[f64]) -> Option<String> {
        None
    }

    /// The place of the number that entry `entry` of the tangent moves by just its own size, alone and whatever the other
    /// entries are, if there is one; a prior may be put on it.
    fn additive_value(&self, entry: usize) -> Option<usize> {
        self.is_euclidean().then_some(entry)
    }

    /// Whether `x (+) d = x + d`. The fused elimination moves only such blocks.
    fn is_euclidean(&self) -> bool {
        false
    }
}

/// What is wrong with `x` as values on `manifold`, if anything: their number, a value that is not
/// finite, or [`Manifold::defect`].
pub fn defect(manifold: &dyn Manifold, x: &[f64]) -> Option<String> {
    if x.len() != manifold.ambient() {
        return Some(format!(
            "{manifold:?} stores {} numbers, {} were given",
            manifold.ambient(),
            x.len()
        ));
    }
    match x.iter().position(|v| !v.is_finite()) {
        Some(position) => Some(format!("entry {position} is {}", x[position])),
        None => manifold.defect(x),
    }
}

/// Vectors of `n` numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Euclidean(pub usize);

/// Rotations, as unit quaternions `w x y z`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rotation;

/// Rigid transformations: a rotation, then a translation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pose;

/// A rigid transformation and `n` numbers that are always used together, such as a camera with
/// its own lens.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PoseWithParameters(pub usize);

/// Directions: points of the unit sphere.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UnitVector;

/// A rotation, a translation and a positive scale.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Similarity;

impl Manifold for Euclidean {
    fn ambient(&self) -> usize {
        self.0
    }

    fn tangent(&self) -> usize {
        self.0
    }

    fn plus(&self, x: &[f64], d: &[f64], out: &mut [f64]) {
        add(x, d, out);
    }

    fn minus(&self, y: &[f64], x: &[f64], out: &mut [f64]) {
        subtract(y, x, out);
    }

    fn is_euclidean(&self) -> bool {
        true
    }
}

impl Manifold for Rotation {
    fn ambient(&self) -> usize {
        4
    }

    fn tangent(&self) -> usize {
        3
    }

    fn plus(&self, x: &[f64], d: &[f64], out: &mut [f64]) {
        out.copy_from_slice(&turn(quaternion(x), vector(d)));
    }

    fn minus(&self, y: &[f64], x: &[f64], out: &mut [f64]) {
        out.copy_from_slice(&turned(quaternion(y), quaternion(x)));
    }

    fn defect(&self, x: &[f64]) -> Option<String> {
        not_unit(x)
    }
}

impl Manifold for Pose {
    fn ambient(&self) -> usize {
        7
    }

    fn tangent(&self) -> usize {
        6
    }

    fn plus(&self, x: &[f64], d: &[f64], out: &mut [f64]) {
        pose_plus(x, d, out);
    }

    fn minus(&self, y: &[f64], x: &[f64], out: &mut [f64]) {
        pose_minus(y, x, out);
    }

    fn defect(&self, x: &[f64]) -> Option<String> {
        not_unit(&x[..4])
    }
}

impl Manifold for PoseWithParameters {
    fn ambient(&self) -> usize {
        7 + self.0
    }

    fn tangent(&self) -> usize {
        6 + self.0
    }

    fn plus(&self, x: &[f64], d: &[f64], out: &mut [f64]) {
        pose_plus(&x[..7], &d[..6], &mut out[..7]);
        add(&x[7..], &d[6..], &mut out[7..]);
    }

    fn minus(&self, y: &[f64], x: &[f64], out: &mut [f64]) {
        pose_minus(&y[..7], &x[..7], &mut out[..6]);
        subtract(&y[7..], &x[7..], &mut out[6..]);
    }

    fn additive_value(&self, entry: usize) -> Option<usize> {
        (entry >= 6).then_some(entry + 1)
    }

    fn defect(&self, x: &[f64]) -> Option<String> {
        not_unit(&x[..4])
    }
}

impl Manifold for UnitVector {
    fn ambient(&self) -> usize {
        3
    }

    fn tangent(&self) -> usize {
        2
    }

    fn plus(&self, x: &[f64], d: &[f64], out: &mut [f64]) {
        let basis = direction_basis(vector(x));
        let along: [f64; 3] = std::array::from_fn(|k| basis[0][k] * d[0] + basis[1][k] * d[1]);
        let angle = dot(along, along).sqrt();
        // sin(a)/a tends to 1: no division for a step of nothing.
        let ratio = if angle < 1e-9 { 1.0 } else { angle.sin() / angle };
        let moved: [f64; 3] = std::array::from_fn(|k| angle.cos() * x[k] + ratio * along[k]);
        let norm = dot(moved, moved).sqrt();
        for k in 0..3 {
            out[k] = moved[k] / norm;
        }
    }

    fn minus(&self, y: &[f64], x: &[f64], out: &mut [f64]) {
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

    fn defect(&self, x: &[f64]) -> Option<String> {
        not_unit(x)
    }
}

impl Manifold for Similarity {
    fn ambient(&self) -> usize {
        8
    }

    fn tangent(&self) -> usize {
        7
    }

    fn plus(&self, x: &[f64], d: &[f64], out: &mut [f64]) {
        out[..4].copy_from_slice(&turn(quaternion(x), vector(d)));
        add(&x[4..7], &d[3..6], &mut out[4..7]);
        out[7] = x[7] * d[6].exp();
    }

    fn minus(&self, y: &[f64], x: &[f64], out: &mut [f64]) {
        out[..3].copy_from_slice(&turned(quaternion(y), quaternion(x)));
        subtract(&y[4..7], &x[4..7], &mut out[3..6]);
        out[6] = (y[7] / x[7]).ln();
    }

    fn additive_value(&self, entry: usize) -> Option<usize> {
        (3..6).contains(&entry).then_some(entry + 1)
    }

    fn defect(&self, x: &[f64]) -> Option<String> {
        let scale = || (x[7] <= 0.0).then(|| format!("scale {}, must be positive", x[7]));
        not_unit(&x[..4]).or_else(scale)
    }
}

fn not_unit(v: &[f64]) -> Option<String> {
    let norm = v.iter().map(|c| c * c).sum::<f64>().sqrt();
    ((norm - 1.0).abs() > 1e-9).then(|| format!("length {norm}, a unit vector was expected"))
}

/// Two orthonormal tangent directions at the unit vector `x`.
///
/// The coordinate axis furthest from `x` starts the basis, so it is stable everywhere; it jumps
/// where that axis changes, which `plus` and `minus` of [`UnitVector`] handle alike.
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
    use crate::nlls::check::check_manifold;
    use proptest::prelude::*;

    fn manifolds() -> [Box<dyn Manifold>; 7] {
        [
            Box::new(Euclidean(1)),
            Box::new(Euclidean(5)),
            Box::new(Rotation),
            Box::new(Pose),
            Box::new(PoseWithParameters(3)),
            Box::new(UnitVector),
            Box::new(Similarity),
        ]
    }

    /// A point of the manifold, made from arbitrary numbers.
    fn point(manifold: &dyn Manifold, seed: &[f64]) -> Vec<f64> {
        let mut x = seed[..manifold.ambient()].to_vec();
        let any: &dyn Any = manifold;
        if any.is::<UnitVector>() {
            let norm = x.iter().map(|v| v * v).sum::<f64>().sqrt();
            x.iter_mut().for_each(|v| *v /= norm);
        } else if !manifold.is_euclidean() {
            x[..4].copy_from_slice(&rotation::exp([seed[9], seed[10], seed[11]]));
            if any.is::<Similarity>() {
                x[7] = seed[7].exp();
            }
        }
        x
    }

    proptest! {
        #[test]
        fn plus_and_minus_are_inverse(
            a in prop::collection::vec(0.1..1.3f64, 12),
            b in prop::collection::vec(-1.3..-0.1f64, 12),
            d in prop::collection::vec(-0.8..0.8f64, 12),
            shrink in 0..12i32,
        ) {
            for manifold in manifolds() {
                let manifold = manifold.as_ref();
                let (x, y) = (point(manifold, &a), point(manifold, &b));
                let d: Vec<f64> =
                    d[..manifold.tangent()].iter().map(|v| v * 10f64.powi(-shrink)).collect();
                let found = check_manifold(manifold, &x, &y, &d, 1e-12);
                prop_assert!(found.is_ok(), "{found:?}");
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
        assert!(defect(&Rotation, &[2.0, 0.0, 0.0, 0.0]).unwrap().contains("unit"));
        assert!(defect(&Euclidean(2), &[1.0, f64::NAN]).unwrap().contains("entry 1"));
        assert!(defect(&Pose, &[1.0]).unwrap().contains("7 numbers"));
        assert!(defect(&Similarity, &[1., 0., 0., 0., 0., 0., 0., 0.]).unwrap().contains("scale"));
    }
}
