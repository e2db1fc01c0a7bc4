//! From overlapping drone photos of a crop field to plant traits, over two optimisation engines.
//!
//! # Frames, pixels, units
//! SI units; metres in the mapping frame (X east, Y north, Z up); radians inside. Image positions
//! are `u` right and `v` down in pixels, and **the centre of the top-left pixel is (0, 0)**; every
//! format with another convention is converted at its border.
//!
//! # The paper in a handful of equations
//! After J. Ribera, F. He, Y. Chen, A. F. Habib and E. J. Delp, "Estimating Phenotypic Traits From UAV
//! Based RGB Imagery", KDD 2016 workshop.
//!
//! - A bundle: `min 1/2 sum_ij rho(|u(R_i X_j + t_i) - u_ij|^2)`, collinearity in [`problems::bundle`],
//!   minimised by [`nlls`].
//! - Leaf or soil: `Y = 1` iff `t1 <= H <= t2` and (`t3 <= S` or `t4 <= V`), in [`raster::mask`].
//! - Plants: `min (1/sigma) sum_n min_p |Z_n - X_p| + sum_p 1/2 |X_p - mu_p|^2_{R^-1}`, in
//!   [`problems::plants`], by the sweeps of [`descent`].
//! - Plants where leaves of neighbours overlap: votes along leaf axes and the likeliest chain of
//!   plants along every row, in [`phenotype::row_model`], the default of `rowgram locate`.
//! - One plant with its pixels held is a second-order cone programme, certified by [`convex`].
//! - Found against true plants, one to one: [`score`].
//!
//! # Where it differs from the paper
//! - The distance to a plant is a `min` where the paper prints an argmin.
//! - The paper's closed form for a plant minimises squared distances; the default minimises the
//!   stated ones exactly.
//! - The paper's conditional priors have no joint density; the default is a joint form with latent
//!   rows, which every update decreases.
//! - The scale is the mean distance, as in the paper, or half of it, as a density in the plane asks.
//! - Axes are called along and across the rows, which need not follow the image.
//! - A field is not cropped into regions: an update reads only the pixels near its plant.

#[cfg(feature = "cli")]
pub mod cli;

pub use rowgram_base::{Error, Kind, choices, disjoint_sets, error, monitor, options};
pub use rowgram_files as io;
pub use rowgram_optim::{convex, descent, drive, engine, geometry, lanes, nlls, output, robust};
pub use rowgram_plants::{phenotype, score};
#[cfg(feature = "report")]
pub use rowgram_project::report;
pub use rowgram_project::{self as pipeline, BUILD};
pub use rowgram_raster::{self as raster, crs};
pub use rowgram_survey::{camera, features, mapping, scene, sfm, target};

/// Estimation problems: the equations of each, posed for the engines.
pub mod problems {
    pub use rowgram_plants::problems::*;
    pub use rowgram_survey::problems::*;
}

/// The programs in `docs/optimisation.md`, compiled and run as documentation tests.
#[cfg(doctest)]
#[doc = include_str!("../docs/optimisation.md")]
struct Extending;
