//! The plan that a design gives: ranges of plots one after the other along the rows, plots of a range side by side.
//!
//! Plot `c` of range `r` (from 0) has, seen from the corner of the first plot and along the rows,
//!
//! ```text
//! s in r (length + alley) + [0, length],   t' in c (width + gap) + [0, width],   t = +- t'
//! ```
//!
//! with its rows about its middle; plots lie to the right (`t = -t'`) or to the left of the rows' direction. Every place has
//! a number; a place without a plot keeps it.

use super::{Plan, PlannedPlot, PlannedRow};
use rowgram_base::error::Error;
use serde::{Deserialize, Serialize};

/// On which side of the first corner plots lie, looking along the rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Side {
    /// To the right.
    Right,
    /// To the left.
    Left,
}

rowgram_base::choices!(Side: Right, Left);

/// In which order places are numbered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Numbering {
    /// Across the rows: range after range.
    Across,
    /// Along the rows: plots at the same place of all ranges, then the next.
    Along,
    /// The number of the range, then two digits (or more, where a range has more plots): 101, 102, 201.
    ByRange,
}

rowgram_base::choices!(Numbering: Across, Along, ByRange);

/// A corner of the field, seen from the first plot and along the rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FieldCorner {
    /// The outer corner of the first plot.
    First,
    /// From there along the rows, past all ranges.
    Along,
    /// From the first one across the rows, past all plots of the first range.
    Across,
    /// The one opposite to the first.
    Opposite,
}

rowgram_base::choices!(FieldCorner: First, Along, Across, Opposite);

/// The design of a field.
#[derive(Debug, Clone, PartialEq)]
pub struct Design {
    /// Ranges, along the rows.
    pub ranges: usize,
    /// Plots of a range.
    pub plots_per_range: usize,
    /// Rows of a plot.
    pub rows_per_plot: usize,
    /// Distance between rows, metres.
    pub row_spacing_m: f64,
    /// Length of a plot along the rows, metres.
    pub plot_length_m: f64,
    /// Width of a plot across the rows, metres.
    pub plot_width_m: f64,
    /// Alley between ranges, metres.
    pub alley_m: f64,
    /// Gap between plots of a range, metres.
    pub plot_gap_m: f64,
    /// Where plots lie.
    pub plots_to: Side,
    /// The order of the numbers.
    pub numbering: Numbering,
    /// Whether every other line is numbered backwards.
    pub serpentine: bool,
    /// Number of the first plot (of the first range, with numbers by range).
    pub first_number: usize,
    /// Ranges without plots, from 1.
    pub missing_ranges: Vec<usize>,
    /// Names of places without a plot.
    pub missing_plots: Vec<String>,
}

/// Places of a plan, at most: a design with more is a slip of the keyboard.
const MAX_PLOTS: usize = 1_000_000;

impl Design {
    /// The plan, in metres from the middle of the field.
    ///
    /// # Errors
    /// A design that has no plots, rows that do not fit into a plot, a missing range or plot that it does not have.
    pub fn plan(&self) -> Result<Plan, Error> {
        self.check()?;
        let (half_s, half_t) = (0.5 * self.length_m(), 0.5 * self.width_m());
        let sign = match self.plots_to {
            Side::Right => -1.0,
            Side::Left => 1.0,
        };
        let mut plots = Vec::new();
        let mut missing: Vec<&str> = Vec::new();
        for place in 0..self.ranges * self.plots_per_range {
            let (range, column, name) = self.place(place);
            if self.missing_ranges.contains(&(range + 1)) {
                continue;
            }
            if let Some(is) = self.missing_plots.iter().find(|other| **other == name) {
                missing.push(is);
                continue;
            }
            let s0 = range as f64 * (self.plot_length_m + self.alley_m) - half_s;
            let s1 = s0 + self.plot_length_m;
            let t0 = column as f64 * (self.plot_width_m + self.plot_gap_m) - half_t;
            let t1 = t0 + self.plot_width_m;
            let middle = 0.5 * (t0 + t1);
            let row = |k: usize| {
                let beside =
                    (k as f64 - 0.5 * (self.rows_per_plot as f64 - 1.0)) * self.row_spacing_m;
                let t = sign * (middle + beside);
                PlannedRow { ends: [[s0, t], [s1, t]] }
            };
            plots.push(PlannedPlot {
                name,
                range: range + 1,
                column: column + 1,
                rings: vec![vec![
                    [s0, sign * t0],
                    [s1, sign * t0],
                    [s1, sign * t1],
                    [s0, sign * t1],
                ]],
                rows: (0..self.rows_per_plot).map(row).collect(),
            });
        }
        let unknown = self.missing_plots.iter().find(|name| !missing.contains(&name.as_str()));
        if let Some(name) = unknown {
            return refuse(format!("missing_plots: the design has no plot {name:?}"));
        }
        if plots.is_empty() {
            return refuse("missing_ranges and missing_plots leave no plot".to_owned());
        }
        Ok(Plan { plots, row_spacing_m: self.row_spacing_m })
    }

    /// A corner of the field in the plan.
    pub fn corner(&self, corner: FieldCorner) -> [f64; 2] {
        let (s, t) = (0.5 * self.length_m(), 0.5 * self.width_m());
        let t = if self.plots_to == Side::Right { -t } else { t };
        match corner {
            FieldCorner::First => [-s, -t],
            FieldCorner::Along => [s, -t],
            FieldCorner::Across => [-s, t],
            FieldCorner::Opposite => [s, t],
        }
    }

    /// Length of the field along the rows, metres.
    pub fn length_m(&self) -> f64 {
        self.ranges as f64 * (self.plot_length_m + self.alley_m) - self.alley_m
    }

    /// Width of the field across the rows, metres.
    pub fn width_m(&self) -> f64 {
        self.plots_per_range as f64 * (self.plot_width_m + self.plot_gap_m) - self.plot_gap_m
    }

    fn check(&self) -> Result<(), Error> {
        let rows_m = (self.rows_per_plot.max(1) - 1) as f64 * self.row_spacing_m;
        if rows_m >= self.plot_width_m {
            return refuse(format!(
                "{} rows of {} m take {rows_m:.3} m between the outer ones, a plot is {} m wide: check plot_width_m and row_spacing_m",
                self.rows_per_plot, self.row_spacing_m, self.plot_width_m
            ));
        }
        let places = self.ranges.checked_mul(self.plots_per_range);
        if places.is_none_or(|places| places == 0 || places > MAX_PLOTS) {
            return refuse(format!(
                "{} ranges of {} plots: expected at least one plot and at most {MAX_PLOTS}",
                self.ranges, self.plots_per_range
            ));
        }
        if let Some(range) = self.missing_ranges.iter().find(|&&r| r == 0 || r > self.ranges) {
            return refuse(format!(
                "missing_ranges: there is no range {range}, expected 1 to {}",
                self.ranges
            ));
        }
        Ok(())
    }

    /// Range and column of the place with this number, from 0, and its name.
    fn place(&self, place: usize) -> (usize, usize, String) {
        let width = match self.numbering {
            Numbering::Across | Numbering::ByRange => self.plots_per_range,
            Numbering::Along => self.ranges,
        };
        let (line, mut within) = (place / width, place % width);
        let counted = within;
        if self.serpentine && line % 2 == 1 {
            within = width - 1 - within;
        }
        let digits = 10usize.pow(self.plots_per_range.max(10).to_string().len() as u32);
        match self.numbering {
            Numbering::Across => (line, within, (self.first_number + place).to_string()),
            Numbering::Along => (within, line, (self.first_number + place).to_string()),
            Numbering::ByRange => {
                let number = (self.first_number + line) * digits + counted + 1;
                (line, within, number.to_string())
            }
        }
    }
}

fn refuse<T>(message: String) -> Result<T, Error> {
    Err(Error::Argument(message))
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// The plots of the small synthetic flight: 4 x 2 plots of five rows.
    pub(crate) fn small() -> Design {
        Design {
            ranges: 2,
            plots_per_range: 4,
            rows_per_plot: 5,
            row_spacing_m: 0.76,
            plot_length_m: 8.25,
            plot_width_m: 3.8,
            alley_m: 1.5,
            plot_gap_m: 0.0,
            plots_to: Side::Right,
            numbering: Numbering::Across,
            serpentine: false,
            first_number: 1,
            missing_ranges: vec![],
            missing_plots: vec![],
        }
    }

    fn names(design: &Design) -> Vec<(usize, usize, String)> {
        let plan = design.plan().unwrap();
        plan.plots.into_iter().map(|plot| (plot.range, plot.column, plot.name)).collect()
    }

    #[test]
    fn numbers_run_as_the_design_says() {
        let at = |design: &Design, range: usize, column: usize| {
            let found = names(design).into_iter().find(|of| (of.0, of.1) == (range, column));
            found.map(|of| of.2)
        };
        let mut design = small();
        assert_eq!(at(&design, 2, 1).unwrap(), "5");
        design.serpentine = true;
        assert_eq!(
            (at(&design, 2, 1).unwrap(), at(&design, 2, 4).unwrap()),
            ("8".into(), "5".into())
        );
        design.numbering = Numbering::Along;
        assert_eq!(
            (at(&design, 2, 1).unwrap(), at(&design, 2, 2).unwrap()),
            ("2".into(), "3".into())
        );
        design.numbering = Numbering::ByRange;
        assert_eq!(
            (at(&design, 1, 1).unwrap(), at(&design, 2, 4).unwrap()),
            ("101".into(), "201".into())
        );
        design.missing_plots = vec!["102".into()];
        design.missing_ranges = vec![2];
        assert_eq!(names(&design).len(), 3);
        assert_eq!(at(&design, 1, 2), None);
        design.missing_plots = vec!["999".into()];
        assert!(design.plan().unwrap_err().to_string().contains("no plot \"999\""));
        design.missing_ranges = vec![3];
        assert!(design.plan().unwrap_err().to_string().contains("no range 3"));
    }

    #[test]
    fn plots_have_their_size_and_their_rows() {
        let design = small();
        let plan = design.plan().unwrap();
        let [[s0, s1], [t0, t1]] = plan.extent();
        assert!((s1 - s0 - 18.0).abs() < 1e-12 && (t1 - t0 - 15.2).abs() < 1e-12);
        // The first plot is at the first corner; the others lie to the right.
        let corner = |corner| design.corner(corner);
        let [first, along, across] =
            [FieldCorner::First, FieldCorner::Along, FieldCorner::Across].map(corner);
        assert_eq!(plan.plots[0].rings[0][0], first);
        assert!(along[0] > first[0] && across[1] < first[1]);
        let rows: Vec<f64> = plan.plots[0].rows.iter().map(|row| row.across(0.0)).collect();
        assert!((rows[0] - (first[1] - 0.38)).abs() < 1e-12, "{rows:?}");
        assert!((rows[0] - rows[4] - 4.0 * 0.76).abs() < 1e-12, "{rows:?}");
        let narrow = Design { plot_width_m: 3.0, ..design };
        assert!(narrow.plan().unwrap_err().to_string().contains("plot_width_m"));
    }
}
