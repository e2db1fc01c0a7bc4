//! Local density of leaf pixels.

crate::options! {
    /// Local density of leaf pixels.
    pub struct LeafDensityOptions in "leaf_density" {
        /// Side of the neighbourhood.
        pub window_px: usize = 41, limits ODD;
    }
}
