//! The edges of a mask with their gradient, between the pixels.
//!
//! An edge element is the side that a plant pixel shares with background. Around its middle `p` the mask
//! `m` is smoothed with a Gaussian,
//!
//! ```text
//! S(p) = sum_q m(q) N(p - q; sigma^2),     grad S(p) = -sum_q m(q) (p - q) / sigma^2 N(p - q; sigma^2),
//! ```
//!
//! evaluated at `p` itself and not at pixel centres, so that leaves one pixel wide have two edges that
//! face each other. `G = angle(grad S)` points across the leaf, into it. For a straight edge of a leaf of
//! width `w` that lies `d` from `p`, `S(p) = 1/2 - Phi(-w/sigma) + |grad S| d + ...`, which gives the
//! position of the edge to a fraction of a pixel ([`Edge::offset`]).

use super::part::Local;
use statrs::function::erf::erf;
use std::f64::consts::FRAC_1_SQRT_2;

const REACH: usize = 5;
const TAPS: usize = 2 * REACH;

/// A side of a plant pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Side {
    Left,
    Right,
    Above,
    Below,
}

/// An edge element.
#[derive(Debug, Clone, Copy)]
pub(super) struct Edge {
    /// The plant pixel.
    pub(super) pixel: u32,
    /// Its side with background.
    pub(super) side: Side,
    /// Middle of the side, local pixels.
    pub(super) at: [f64; 2],
    /// Unit vector along the gradient, into the leaf.
    pub(super) normal: [f64; 2],
    /// Length of the gradient, per pixel.
    pub(super) slope: f64,
    /// The smoothed mask there.
    pub(super) level: f64,
}

/// The smoothing for leaves of a usual width, pixels: enough to take the steps of the pixels out of a wide leaf's edges,
/// and not so much that the two edges of a narrow one flow together.
pub(super) fn sigma_px(usual_px: f64) -> f64 {
    (0.35 + 0.15 * usual_px).clamp(0.8, 1.5)
}

impl Edge {
    /// Angle `G` of the gradient, radians.
    pub(super) fn angle(&self) -> f64 {
        self.normal[1].atan2(self.normal[0])
    }

    /// How far the edge of a leaf of width `width_px` lies from the middle of the side, pixels along the
    /// normal (positive: farther inside); at most one pixel.
    pub(super) fn offset(&self, width_px: f64, sigma_px: f64) -> f64 {
        let straight = 0.5 - below(-width_px.max(0.5) / sigma_px);
        ((straight - self.level) / self.slope.max(0.05)).clamp(-1.0, 1.0)
    }
}

/// The standard normal distribution's share below `x`.
fn below(x: f64) -> f64 {
    0.5 * (1.0 + erf(x * FRAC_1_SQRT_2))
}

/// Weights around the middle of a side: `TAPS` pixels across it, one less along it.
struct Kernel {
    level: [f64; TAPS * (TAPS - 1)],
    across: [f64; TAPS * (TAPS - 1)],
    along: [f64; TAPS * (TAPS - 1)],
}

impl Kernel {
    /// For a side between two pixels side by side; index `row * TAPS + column`.
    fn new(sigma_px: f64) -> Kernel {
        let mut kernel = Kernel {
            level: [0.0; TAPS * (TAPS - 1)],
            across: [0.0; TAPS * (TAPS - 1)],
            along: [0.0; TAPS * (TAPS - 1)],
        };
        let mut sum = 0.0;
        for row in 0..TAPS - 1 {
            for column in 0..TAPS {
                let x = column as f64 - REACH as f64 + 0.5;
                let y = row as f64 - (REACH - 1) as f64;
                let weight = (-(x * x + y * y) / (2.0 * sigma_px * sigma_px)).exp();
                let index = row * TAPS + column;
                kernel.level[index] = weight;
                kernel.across[index] = weight * x / (sigma_px * sigma_px);
                kernel.along[index] = weight * y / (sigma_px * sigma_px);
                sum += weight;
            }
        }
        for weights in [&mut kernel.level, &mut kernel.across, &mut kernel.along] {
            weights.iter_mut().for_each(|weight| *weight /= sum);
        }
        kernel
    }
}

/// All edge elements of a part, and for each pixel where its elements begin.
pub(super) struct Edges {
    pub(super) sigma_px: f64,
    pub(super) all: Vec<Edge>,
    /// For the plant pixel number `n`: its elements are `first[n]..first[n + 1]`.
    first: Vec<u32>,
}

impl Edges {
    pub(super) fn of(local: &Local, sigma_px: f64) -> Edges {
        let kernel = Kernel::new(sigma_px);
        let width = local.width;
        let mut edges =
            Edges { sigma_px, all: Vec::new(), first: Vec::with_capacity(local.pixels.len() + 1) };
        for &pixel in &local.pixels {
            edges.first.push(edges.all.len() as u32);
            let index = pixel as usize;
            let [u, v] = local.at(pixel);
            let sides = [
                (Side::Left, index - 1, [u - 0.5, v]),
                (Side::Right, index + 1, [u + 0.5, v]),
                (Side::Above, index - width, [u, v - 0.5]),
                (Side::Below, index + width, [u, v + 0.5]),
            ];
            for (side, other, at) in sides {
                if local.mask[other] == 0
                    && let Some(edge) = measure(local, &kernel, pixel, side, at)
                {
                    edges.all.push(edge);
                }
            }
        }
        edges.first.push(edges.all.len() as u32);
        edges
    }

    /// The element at a side of the plant pixel with this number.
    pub(super) fn find(&self, number: usize, side: Side) -> Option<&Edge> {
        let range = self.first[number] as usize..self.first[number + 1] as usize;
        self.all[range].iter().find(|edge| edge.side == side)
    }
}

/// Level and gradient at the middle of a side; `None` where the gradient vanishes.
fn measure(local: &Local, kernel: &Kernel, pixel: u32, side: Side, at: [f64; 2]) -> Option<Edge> {
    let width = local.width;
    let (mut level, mut across, mut along) = (0.0, 0.0, 0.0);
    let upright = matches!(side, Side::Left | Side::Right);
    // First pixel of the neighbourhood: REACH pixels before the side, across it.
    let (u, v) = (pixel as usize % width, pixel as usize / width);
    let (first_u, first_v) = match side {
        Side::Left => (u - REACH, v - (REACH - 1)),
        Side::Right => (u + 1 - REACH, v - (REACH - 1)),
        Side::Above => (u - (REACH - 1), v - REACH),
        Side::Below => (u - (REACH - 1), v + 1 - REACH),
    };
    for j in 0..TAPS - 1 {
        for i in 0..TAPS {
            let at = if upright {
                (first_v + j) * width + first_u + i
            } else {
                (first_v + i) * width + first_u + j
            };
            let m = f64::from(local.mask[at]);
            level += m * kernel.level[j * TAPS + i];
            across += m * kernel.across[j * TAPS + i];
            along += m * kernel.along[j * TAPS + i];
        }
    }
    let gradient = if upright { [across, along] } else { [along, across] };
    let slope = gradient[0].hypot(gradient[1]);
    let normal = [gradient[0] / slope, gradient[1] / slope];
    (slope > 1e-9).then_some(Edge { pixel, side, at, normal, slope, level })
}
