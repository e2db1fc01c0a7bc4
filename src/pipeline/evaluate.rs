//! Comparison with ground truth.

crate::options! {
    /// Comparison with ground truth.
    pub struct EvaluateOptions in "evaluate" {
        /// Distances up to which a found plant is a true one.
        pub radii_m: Vec<f64> = vec![0.05, 0.1], limits POSITIVE;
    }
}
