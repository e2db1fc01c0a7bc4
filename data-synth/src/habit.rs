//! How the plants of a field grow beyond their leaves' sizes: preferred directions, tillers, panicles,
//! dying leaves, colours.
//!
//! Everything here is drawn from a stream of its own, so that switching one on moves neither a stalk nor a leaf
//! that was there before.

use crate::check::{ConfigError, within};
use serde::{Deserialize, Serialize};

/// The habit of a field's plants; without any of it by default.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Habit {
    /// Share of the plants whose leaf plane follows the preferred direction (20 degrees of scatter)
    /// instead of any.
    pub azimuth_preference: f64,
    /// The preferred direction, degrees from the rows' direction; 90 is across the rows.
    pub preferred_azimuth_deg: f64,
    /// Probability that a plant has tillers; one that has any has one or two.
    pub tiller_fraction: f64,
    /// Probability that a stalk carries a panicle.
    pub panicle_fraction: f64,
    /// Probability that a leaf of the lowest third of its stalk is dying: yellow or brown.
    pub senescent_fraction: f64,
    /// How far leaf hues scatter, relative to the usual 4 degrees between plants and 3 within.
    pub hue_spread: f64,
}

impl Default for Habit {
    fn default() -> Habit {
        Habit {
            azimuth_preference: 0.0,
            preferred_azimuth_deg: 90.0,
            tiller_fraction: 0.0,
            panicle_fraction: 0.0,
            senescent_fraction: 0.0,
            hue_spread: 1.0,
        }
    }
}

impl Habit {
    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter that cannot be used: its name, its value and what was expected.
    pub fn check(&self) -> Result<(), ConfigError> {
        within("habit.azimuth_preference", self.azimuth_preference, 0.0..=1.0)?;
        within("habit.preferred_azimuth_deg", self.preferred_azimuth_deg, -360.0..=360.0)?;
        within("habit.tiller_fraction", self.tiller_fraction, 0.0..=1.0)?;
        within("habit.panicle_fraction", self.panicle_fraction, 0.0..=1.0)?;
        within("habit.senescent_fraction", self.senescent_fraction, 0.0..=1.0)?;
        within("habit.hue_spread", self.hue_spread, 0.0..=5.0)
    }
}

/// A stalk: from its base to its topmost collar.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stalk {
    /// From the base to the topmost collar (X, Y, Z), metres.
    pub top_m: [f64; 3],
    /// Radius at half its height, metres.
    pub radius_m: f64,
    /// Length of the panicle on top of it, metres; 0 where there is none.
    pub panicle_m: f64,
}

/// The grouping of the rows into plots; one plot by default.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PlotConfig {
    /// Rows of a plot; 0 puts all rows into one.
    pub rows: usize,
    /// Length of a plot along the rows, metres; 0 makes it as long as the rows.
    pub length_m: f64,
    /// Bare alley between the plots along the rows, metres.
    pub alley_m: f64,
}

impl PlotConfig {
    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter that cannot be used: its name, its value and what was expected.
    pub fn check(&self) -> Result<(), ConfigError> {
        within("plots.rows", self.rows, 0..=100_000)?;
        within("plots.alley_m", self.alley_m, 0.0..=100.0)?;
        if self.length_m != 0.0 {
            within("plots.length_m", self.length_m, 0.5..=10_000.0)?;
        } else if self.alley_m > 0.0 {
            let expected = "the length of a plot wherever there are alleys";
            return Err(ConfigError::new("plots.length_m", self.length_m, expected));
        }
        Ok(())
    }

    /// How many plots lie side by side (rows) and one after the other (along).
    pub fn count(&self, rows: usize, row_length_m: f64) -> [usize; 2] {
        let side = if self.rows == 0 { 1 } else { rows.div_ceil(self.rows) };
        let along = if self.length_m == 0.0 {
            1
        } else {
            let pitch_m = self.length_m + self.alley_m;
            (((row_length_m + self.alley_m) / pitch_m - 1e-9).ceil() as usize).max(1)
        };
        [side, along]
    }

    /// The part of a plot: its first and last row, and from where to where along the rows from their middle, metres.
    pub fn extent(&self, rows: usize, row_length_m: f64, plot: usize) -> ([usize; 2], [f64; 2]) {
        let [_, along] = self.count(rows, row_length_m);
        let (group, step) = (plot / along, plot % along);
        let of_plot = if self.rows == 0 { rows } else { self.rows };
        let length_m = if self.length_m == 0.0 { row_length_m } else { self.length_m };
        let start_m = step as f64 * (length_m + self.alley_m) - 0.5 * row_length_m;
        let last = ((group + 1) * of_plot).min(rows) - 1;
        ([group * of_plot, last], [start_m, (start_m + length_m).min(0.5 * row_length_m)])
    }

    /// The plot at `from_start_m` along `row`, numbered along the rows first; `None` on an alley.
    pub fn plot(
        &self,
        rows: usize,
        row_length_m: f64,
        row: usize,
        from_start_m: f64,
    ) -> Option<usize> {
        let [_, along] = self.count(rows, row_length_m);
        let side = row.checked_div(self.rows).unwrap_or(0);
        let step = if self.length_m == 0.0 {
            0
        } else {
            let pitch_m = self.length_m + self.alley_m;
            // Jitter carries plants a little beyond either end of a row.
            let step = (from_start_m / pitch_m).floor().clamp(0.0, along as f64 - 1.0);
            let within_m = from_start_m - step * pitch_m;
            if within_m > self.length_m && self.alley_m > 0.0 && (step as usize) + 1 < along {
                return None;
            }
            step as usize
        };
        Some(side * along + step)
    }
}
