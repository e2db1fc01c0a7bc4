//! Number of leaves from the area that they cover.

crate::options! {
    /// Number of leaves from the area that they cover.
    pub struct LeafCountOptions in "leaf_count" {
        /// Leaf pixels per leaf; from the regions counted by hand where not set. Without both, leaves are not counted by area.
        pub rho_px: Option<f64> = None, limits POSITIVE, example "120.0";
    }
}
