//! The first surface of the ground and what grows on it, densely, from photos whose lenses and poses are known.
//!
//! The ground is cut into blocks of cells. Each has a plane (inclined as the ground is), and one photo, the nearest in
//! plan, is its reference: for each of its pixels `x` a height `h` above the plane is found that minimises
//!
//! ```text
//! E(h) = sum_x C_x(h_x) + sum_x Q_x(h_x) + sum_(x,y) [ P1 [|h_x - h_y| = 1] + P2(x, y) [|h_x - h_y| > 1] ]
//! ```
//!
//! | term | what it says | where |
//! |---|---|---|
//! | `C` | the reference and other photos look alike there | [`sweep`] |
//! | `Q` | what is not green is ground, what is green is not | [`prior`] |
//! | `P1`, `P2` | neighbours are at the same height unless the picture has an edge | [`aggregate`] |
//!
//! From the aggregated costs come a distribution over the layers, the most probable one, and a standard deviation ([`posterior`]).
//!
//! A pixel of the reference sees one surface only, so nothing is hidden in it; what others do not see is left to the best of them.
//! The pixels are then points in space, `X = p + (C - p) h/F`; each cell of the ground keeps the highest that falls on it, and in the
//! last pass takes the third lowest of the heights of itself and its eight neighbours ([`block`]). A parabola through the aggregated costs beside the best layer gives fractions of a layer.
//!
//! From coarse to fine ([`tile`], [`area`]): cells of eight times the side say where trees and houses are ([`relief`]), cells of twice the side
//! without `Q` give the ground under the canopy ([`terrain`]), which the second pass takes as known. Blocks are done on their own, by any number of threads, with the same result; where
//! they meet, heights pass over from one to the next ([`joins`]).
//!
//! Constants of this module and its files were chosen on synthetic fields at mid stage, 1.5 cm a cell; what they give is
//! printed by `cargo test --lib mapping::dense -- --nocapture`: share of cells that have a height, spread of bare soil, shares
//! of leaves and of the soil beside them within 5 cm of the truth, error of the ground.

pub mod aggregate;
pub mod area;
pub mod block;
pub mod cost_volume;
pub mod joins;
mod lattice;
pub mod matched;
pub mod posterior;
pub mod prior;
pub mod rectify;
pub mod relief;
pub mod sweep;
pub mod terrain;
pub mod tile;

pub use aggregate::Penalties;
pub use area::{Area, AreaGround, AreaOptions, Pass, TileStore};
pub use joins::{Margin, TileMargins};
pub use matched::{MatchedPhoto, PosedPhoto};
pub use posterior::PosteriorOptions;
pub use prior::Prior;
pub use relief::Relief;
pub use terrain::{GroundPlaces, Terrain};
pub use tile::{DenseTile, Tile, match_tile};

/// Layers of heights, usually.
pub const LAYERS: usize = 64;
/// The most layers of heights: trees, houses and cliffs.
pub const MAX_LAYERS: usize = 4 * LAYERS;

/// How a surface is matched.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DenseOptions {
    /// Distance of neighbouring layers of heights, metres.
    pub layer_m: f64,
    /// The lowest layer above the plane of a block, metres (below it where negative).
    pub lowest_m: f64,
    /// How many layers there are, from the lowest on; at most [`MAX_LAYERS`].
    pub layers: usize,
    /// A cell is the mean of so many by so many values of each photo, so that large cells do not alias.
    pub samples: usize,
    /// How many photos are compared with the reference.
    pub others: usize,
    /// Side of a block, cells; a power of two.
    pub block_cells: usize,
    /// Costs of steps in height.
    pub penalties: Penalties,
    /// What the colour of a pixel says of its height.
    pub prior: Prior,
    /// How heights are estimated from aggregated costs.
    pub posterior: PosteriorOptions,
}

impl Default for DenseOptions {
    fn default() -> DenseOptions {
        DenseOptions {
            layer_m: 0.015,
            lowest_m: -0.1,
            layers: LAYERS,
            samples: 1,
            others: 4,
            block_cells: 256,
            penalties: Penalties::default(),
            prior: Prior::default(),
            posterior: PosteriorOptions::default(),
        }
    }
}

impl DenseOptions {
    /// Distance and number of the layers over a span of heights: `least_m` apart or more, and at most so many. From one layer to the
    /// next as far away as a cell is wide, photos move by less than a cell.
    fn layers_over(span_m: f64, least_m: f64, most: usize) -> (f64, usize) {
        // A whole quotient may come out a hair greater.
        const ROUNDING: f64 = 1e-9;
        let layer_m = (span_m / (most - 1) as f64).max(least_m);
        (layer_m, (span_m / layer_m - ROUNDING).ceil() as usize + 1)
    }

    /// The highest layer above the plane of a block, metres.
    pub fn highest_m(&self) -> f64 {
        self.lowest_m + self.layer_m * (self.layers.max(1) - 1) as f64
    }
}

#[cfg(test)]
mod tests;
