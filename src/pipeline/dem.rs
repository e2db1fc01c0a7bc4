//! The surface from the tie points of a reconstruction.

crate::options! {
    /// The surface, interpolated from the tie points by natural neighbours.
    pub struct DemOptions in "dem" {
        /// Side of a cell; half the median distance of neighbouring points where not set.
        pub cell_m: Option<f64> = None, limits POSITIVE, example "0.1";
        /// Points farther from the plane of their neighbours than this many usual distances are left out.
        pub outlier_ratio: f64 = 5.0, limits POSITIVE;
    }
}
