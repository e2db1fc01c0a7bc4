//! The chain rule through a `camera_from_world` pose, over [`Lane`]s.
//!
//! ```text
//! P = R X + t,   dP = w x P + s        by the increment (w, s) of the pose
//! j dP = w (P x j) + s j,   j dP/dX = j R
//! ```
//!
//! A prepared pose begins with the nine numbers of `R` by rows and the three of `t`. No closures here: one that is
//! not inlined would be compiled without the instruction set that the engine has chosen.

use rowgram_optim::lanes::Lane;

/// `row . x + start`.
#[inline(always)]
pub(super) fn affine<L: Lane>(row: [L; 3], x: &[L; 3], start: L) -> L {
    row[0].mul_add(x[0], row[1].mul_add(x[1], row[2].mul_add(x[2], start)))
}

/// `P` of the prepared pose `c`.
#[inline(always)]
pub(super) fn to_camera<L: Lane>(c: &[L], x: &[L; 3]) -> [L; 3] {
    [
        affine([c[0], c[1], c[2]], x, c[9]),
        affine([c[3], c[4], c[5]], x, c[10]),
        affine([c[6], c[7], c[8]], x, c[11]),
    ]
}

/// `a b - c d`.
#[inline(always)]
fn minor<L: Lane>(a: L, b: L, c: L, d: L) -> L {
    a.mul_add(b, -(c * d))
}

/// A row of the Jacobian by the pose increment, from the row `j` by the point in the camera frame.
#[inline(always)]
pub(super) fn by_increment<L: Lane>(p: &[L; 3], j: &[L; 3]) -> [L; 6] {
    [
        minor(p[1], j[2], p[2], j[1]),
        minor(p[2], j[0], p[0], j[2]),
        minor(p[0], j[1], p[1], j[0]),
        j[0],
        j[1],
        j[2],
    ]
}

/// A row of the Jacobian by the point in the world.
#[inline(always)]
pub(super) fn by_world<L: Lane>(c: &[L], j: &[L; 3]) -> [L; 3] {
    let zero = j[0].like(0.0);
    [
        affine([c[0], c[3], c[6]], j, zero),
        affine([c[1], c[4], c[7]], j, zero),
        affine([c[2], c[5], c[8]], j, zero),
    ]
}
