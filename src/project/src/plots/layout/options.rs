//! The design of a field and what is assumed of its layout, as options.

use rowgram_base::error::Error;
use rowgram_plants::{
    phenotype::layout::{
        design::{Design, Numbering, Side},
        refine::Assumptions,
    },
    problems::plot_layout::corners::CornerSigmas,
};

rowgram_base::options! {
    /// Plot layout (rowgram plots layout): the design of the field, and the uncertainty of its position before it is fitted to the rows. A corner file needs ranges, plots_per_range, rows_per_plot, row_spacing_m and plot_length_m.
    pub struct LayoutOptions in "layout",
        main [ranges, plots_per_range, rows_per_plot, row_spacing_m, plot_length_m]
    {
        /// Number of ranges: plots one after the other along the rows.
        pub ranges: Option<usize> = None, limits at_least(1.0), example "12";
        /// Number of plots of a range, side by side.
        pub plots_per_range: Option<usize> = None, limits at_least(1.0), example "20";
        /// Rows of plants in a plot. Of polygons: as many as fit at the distance of the rows that were found, where not set.
        pub rows_per_plot: Option<usize> = None, limits at_least(1.0), example "4";
        /// Distance between neighbouring rows.
        pub row_spacing_m: Option<f64> = None, limits POSITIVE, example "0.76";
        /// Length of a plot along its rows.
        pub plot_length_m: Option<f64> = None, limits POSITIVE, example "8.0";
        /// Width of a plot across its rows; rows times their distance where not set.
        pub plot_width_m: Option<f64> = None, limits POSITIVE, example "3.04";
        /// Alley between ranges.
        pub alley_m: f64 = 0.0, limits NON_NEGATIVE;
        /// Gap between neighbouring plots of a range.
        pub plot_gap_m: f64 = 0.0, limits NON_NEGATIVE;
        /// Where the plots of a range follow the first one, looking from the first corner along the rows.
        pub plots_to: Side = Side::Right;
        /// Order of the numbers: across the rows range by range, along the rows, or the number of the range and two digits
        /// (101, 102, 201).
        pub numbering: Numbering = Numbering::Across;
        /// Number every other line backwards.
        pub serpentine: bool = false;
        /// Number of the first plot; of the first range with numbering by-range.
        pub first_number: usize = 1;
        /// Ranges without plots, counted from 1. Their places keep their numbers.
        pub missing_ranges: Vec<usize> = Vec::new();
        /// Numbers of places without a plot.
        pub missing_plots: Vec<String> = Vec::new();
        /// Standard deviation of each coordinate of a surveyed corner.
        pub corner_sigma_m: f64 = 0.05, limits POSITIVE;
        /// Standard deviation of the shift of the whole layout against the orthomosaic.
        pub position_sigma_m: f64 = 0.5, limits POSITIVE;
        /// Standard deviation of its rotation.
        pub rotation_sigma_deg: f64 = 1.0, limits POSITIVE;
        /// Standard deviation of its stretches along and across the rows.
        pub stretch_sigma: f64 = 0.01, limits POSITIVE;
        /// Standard deviation of the angle between rows and ranges against a right angle.
        pub shear_sigma_deg: f64 = 0.2, limits POSITIVE;
        /// Standard deviation of each of the three coefficients of row curvature.
        pub bend_sigma_m: f64 = 0.1, limits POSITIVE;
        /// Standard deviation of the shift of a plot by itself; plots move together where not set.
        pub plot_shift_sigma_m: Option<f64> = None, limits POSITIVE, example "0.1";
        /// Length of the pieces in which rows are compared.
        pub segment_m: f64 = 2.0, limits POSITIVE;
    }
}

impl LayoutOptions {
    /// The design.
    ///
    /// # Errors
    /// Which of the options that it needs are not set.
    pub fn design(&self) -> Result<Design, Error> {
        let needed = [
            ("ranges", self.ranges.is_some()),
            ("plots_per_range", self.plots_per_range.is_some()),
            ("rows_per_plot", self.rows_per_plot.is_some()),
            ("row_spacing_m", self.row_spacing_m.is_some()),
            ("plot_length_m", self.plot_length_m.is_some()),
        ];
        let (
            Some(ranges),
            Some(plots_per_range),
            Some(rows_per_plot),
            Some(row_spacing_m),
            Some(plot_length_m),
        ) = (
            self.ranges,
            self.plots_per_range,
            self.rows_per_plot,
            self.row_spacing_m,
            self.plot_length_m,
        )
        else {
            let missing: Vec<&str> =
                needed.iter().filter(|(_, set)| !set).map(|(name, _)| *name).collect();
            return Err(Error::Argument(format!(
                "[layout] {}: not set; corners need the design of the field",
                missing.join(", ")
            )));
        };
        Ok(Design {
            ranges,
            plots_per_range,
            rows_per_plot,
            row_spacing_m,
            plot_length_m,
            plot_width_m: self.plot_width_m.unwrap_or(rows_per_plot as f64 * row_spacing_m),
            alley_m: self.alley_m,
            plot_gap_m: self.plot_gap_m,
            plots_to: self.plots_to,
            numbering: self.numbering,
            serpentine: self.serpentine,
            first_number: self.first_number,
            missing_ranges: self.missing_ranges.clone(),
            missing_plots: self.missing_plots.clone(),
        })
    }

    /// What is assumed of corners.
    pub fn corner_sigmas(&self) -> CornerSigmas {
        CornerSigmas {
            corner_m: self.corner_sigma_m,
            stretch: self.stretch_sigma,
            shear_rad: self.shear_sigma_deg.to_radians(),
        }
    }

    /// What is assumed of the layout as a whole.
    pub fn assumptions(&self) -> Assumptions {
        Assumptions {
            position_m: self.position_sigma_m,
            rotation_rad: self.rotation_sigma_deg.to_radians(),
            stretch: self.stretch_sigma,
            shear_rad: self.shear_sigma_deg.to_radians(),
            bend_m: self.bend_sigma_m,
            plot_shift_m: self.plot_shift_sigma_m,
            segment_m: self.segment_m,
        }
    }
}
