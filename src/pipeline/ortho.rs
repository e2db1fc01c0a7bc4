//! The orthomosaic.

use crate::options::Auto;

crate::options! {
    /// The orthomosaic: every cell takes its colour from the photo whose camera is closest.
    pub struct OrthoOptions in "ortho" {
        /// Height above the surface at which the map is drawn; auto is the height of the canopy at which photos agree best, so
        /// that plants are in their places whichever photo shows them. 0 has the ground in its place.
        pub canopy_height_m: Auto<f64> = Auto::Auto, limits between(-1000.0, 1000.0);
        /// Side of a pixel; the ground sampling distance of the photos where not set.
        pub gsd_m: Option<f64> = None, limits POSITIVE, example "0.015";
        /// Bring the colours of overlapping photos together.
        pub balance: bool = false;
        /// Distance from the seams up to which photos are blended; hard seams, as in the paper, where not set.
        pub feather_m: Option<f64> = None, limits POSITIVE, example "0.2";
    }
}
