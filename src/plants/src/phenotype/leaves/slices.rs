//! Slices: stretches across a leaf, from edge to edge.
//!
//! From the edge element A one walks along its gradient, through plant pixels, to the side B where
//! the walk leaves the leaf. With the gradient angles `G_A` and `G_B`, A and B make a slice where
//!
//! ```text
//! |G_A - G_B + pi|  wrapped into [0, pi]   <  T_a,
//! theta_AB = (G_A + G_B)/2  mod pi,
//! ```
//!
//! and `theta_AB` is the direction of the leaf there. (The wrapped distance is what the paper's `mod 2 pi`
//! means: angles just below a full turn are small.)
//!
//! Reference: B. Epshtein, E. Ofek, Y. Wexler, "Detecting text in natural scenes with stroke width
//! transform", CVPR 2010; Ribera et al. 2016, section on leaves.

use super::{
    edges::{Edges, Side},
    part::Local,
};
use std::f64::consts::{PI, TAU};

/// A slice.
#[derive(Debug, Clone, Copy)]
pub(super) struct Slice {
    /// Distance of its two edges, pixels.
    pub(super) width: f64,
    /// Direction of the leaf, radians in [0, pi).
    pub(super) theta: f64,
    /// First pixel of its walk, as index into [`Slices::walked`].
    pub(super) first: u32,
    /// End of its walk.
    pub(super) end: u32,
}

/// The slices of a part, in the order of their edge elements A.
pub(super) struct Slices {
    pub(super) all: Vec<Slice>,
    /// The numbers of the plant pixels that the walks go through.
    pub(super) walked: Vec<u32>,
}

/// Distance of two angles on the full circle, in [0, pi].
pub(super) fn turn(a: f64, b: f64) -> f64 {
    let d = (a - b).rem_euclid(TAU);
    d.min(TAU - d)
}

/// Distance of two directions without sense (mod pi), in [0, pi/2].
pub(super) fn tilt(a: f64, b: f64) -> f64 {
    let d = (a - b).rem_euclid(PI);
    d.min(PI - d)
}

/// `number[pixel]`: the plant pixel's place in `local.pixels`.
pub(super) fn find(
    local: &Local,
    edges: &Edges,
    number: &[u32],
    t_a: f64,
    longest_px: f64,
) -> Slices {
    let mut slices = Slices { all: Vec::new(), walked: Vec::new() };
    for edge in &edges.all {
        let first = slices.walked.len();
        let Some((pixel, side, length)) =
            walk(local, edge.pixel, edge.at, edge.normal, longest_px, |pixel| {
                slices.walked.push(number[pixel as usize]);
            })
        else {
            slices.walked.truncate(first);
            continue;
        };
        let facing = edges
            .find(number[pixel as usize] as usize, side)
            .filter(|other| turn(edge.angle(), other.angle() + PI) < t_a);
        let Some(other) = facing else {
            slices.walked.truncate(first);
            continue;
        };
        // Both edges to a fraction of a pixel; what B moves counts as far as it is along the walk.
        let from = edge.offset(length, edges.sigma_px);
        let facing = -(other.normal[0] * edge.normal[0] + other.normal[1] * edge.normal[1]);
        let to = other.offset(length, edges.sigma_px) * facing;
        let width = (length - from - to).max(0.3);
        let theta = (0.5 * (edge.angle() + other.angle())).rem_euclid(PI);
        slices.all.push(Slice {
            width,
            // The remainder of a tiny negative number is rounded up to pi itself.
            theta: if theta < PI { theta } else { 0.0 },
            first: first as u32,
            end: slices.walked.len() as u32,
        });
    }
    slices
}

/// Walks from `at`, on the border of `pixel`, along `direction`, until it leaves the part: the last
/// pixel, its side, and the distance. `None` where the first step already leaves, or after `longest`.
fn walk(
    local: &Local,
    pixel: u32,
    at: [f64; 2],
    direction: [f64; 2],
    longest: f64,
    mut visit: impl FnMut(u32),
) -> Option<(u32, Side, f64)> {
    let (width, mut pixel) = (local.width as i64, i64::from(pixel));
    let [u, v] = local.at(pixel as u32);
    let step_u = if direction[0] > 0.0 { 1 } else { -1 };
    let step_v = if direction[1] > 0.0 { 1 } else { -1 };
    let until = |from: f64, centre: f64, direction: f64| {
        if direction.abs() < 1e-12 {
            f64::INFINITY
        } else {
            ((centre - from + 0.5f64.copysign(direction)) / direction).max(0.0)
        }
    };
    let (mut next_u, mut next_v) = (until(at[0], u, direction[0]), until(at[1], v, direction[1]));
    let (every_u, every_v) = (1.0 / direction[0].abs(), 1.0 / direction[1].abs());
    visit(pixel as u32);
    loop {
        let (length, next, side) = if next_u < next_v {
            (next_u, pixel + step_u, if step_u > 0 { Side::Right } else { Side::Left })
        } else {
            (next_v, pixel + step_v * width, if step_v > 0 { Side::Below } else { Side::Above })
        };
        if local.mask[next as usize] == 0 {
            return (length > 0.05).then_some((pixel as u32, side, length));
        }
        if length > longest {
            return None;
        }
        pixel = next;
        visit(pixel as u32);
        if next_u < next_v {
            next_u += every_u;
        } else {
            next_v += every_v;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_wrap() {
        assert!(turn(0.01, TAU - 0.01) < 0.021 && turn(0.0, PI) > 3.1);
        // 179 and 1 degrees differ by 2.
        assert!((tilt(179f64.to_radians(), 1f64.to_radians()).to_degrees() - 2.0).abs() < 1e-9);
        assert!(tilt(0.3, 0.3 + 5.0 * PI) < 1e-9);
    }
}
