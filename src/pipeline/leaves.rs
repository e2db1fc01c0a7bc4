//! Single leaves.

crate::options! {
    /// Single leaves, joined from slices across them (stroke width transform).
    pub struct LeavesOptions in "leaves" {
        /// Leaves of fewer pixels are left out.
        pub min_pixels: usize = 1;
    }
}
