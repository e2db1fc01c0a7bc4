//! Traits of plots.

crate::options! {
    /// Traits of plots. Without polygons and without both options below the whole field is one plot.
    pub struct PlotsOptions in "plots" {
        /// Number of rows of plants in a plot, where there are no polygons.
        pub rows_per_plot: Option<usize> = None, limits at_least(1.0), example "4";
        /// Least length of an alley between plots, where there are no polygons.
        pub alley_m: Option<f64> = None, limits POSITIVE, example "1.0";
    }
}
