//! The prior: plants lie near row lines, and in a grid near column lines too.
//!
//! In row-aligned axes, `along` the rows and `across` them, a row is a line
//! `across = offset + slope * along` and its plants scatter about it with variance `R`:
//!
//! `sum_p [ e_p^2 / (2 R) + 1/2 ln R ] + sum_rows slope^2 / (2 tau^2)`,
//! `e_p = across_p - offset - slope * along_p`,
//!
//! and likewise for columns with the axes exchanged. `R` is floored (a variance of zero would make
//! the density infinite), `tau` = 0.02 holds the line of a row with few plants to the heading.
//! The paper's `sigma_{p,i} -> infinity` leaves only the term across the rows.
//!
//! *Joint* form: lines, variances and memberships are variables of the one objective, and each
//! refit below is its exact minimiser. *Conditional* form (the paper's): the line and the variance
//! a plant is held to are those of the **other** plants of its row, from the last sweep.
//!
//! Lengths in pixels, angles in radians; the axes' origin is the middle of the mask.

use super::quadratic::Quadratic;
use serde::{Deserialize, Serialize};

/// Standard deviation of a line's slope against the heading.
const SLOPE_SIGMA: f64 = 0.02;

/// Axes aligned with the rows.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Axes {
    /// Origin, an image position in pixels.
    pub origin_px: [f64; 2],
    /// Direction of the rows, from the image's `u` axis towards its `v` axis.
    pub heading_rad: f64,
}

impl Axes {
    /// (along, across) of an image position.
    pub fn aligned(&self, at: [f64; 2]) -> [f64; 2] {
        let (s, c) = self.heading_rad.sin_cos();
        let (du, dv) = (at[0] - self.origin_px[0], at[1] - self.origin_px[1]);
        [c * du + s * dv, c * dv - s * du]
    }

    /// The image position of (along, across).
    pub fn image(&self, [along, across]: [f64; 2]) -> [f64; 2] {
        let (s, c) = self.heading_rad.sin_cos();
        [self.origin_px[0] + c * along - s * across, self.origin_px[1] + s * along + c * across]
    }
}

/// One row (or column) and the scatter of its plants.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Line {
    /// Where it crosses the axis, in pixels.
    pub offset_px: f64,
    /// Its slope against the axes.
    pub slope: f64,
    /// Variance of the plants about it, square pixels.
    pub variance_px2: f64,
}

impl Line {
    fn residual(&self, [along, across]: [f64; 2]) -> f64 {
        across - self.offset_px - self.slope * along
    }

    fn cost(&self, at: [f64; 2]) -> f64 {
        0.5 * (self.residual(at).powi(2) / self.variance_px2 + self.variance_px2.ln())
    }
}

/// Sums over the plants of one line, of (along, across) and their products.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
struct Moments {
    count: f64,
    along: f64,
    across: f64,
    along2: f64,
    product: f64,
    across2: f64,
}

impl Moments {
    fn add(&mut self, [a, b]: [f64; 2], sign: f64) {
        self.count += sign;
        self.along += sign * a;
        self.across += sign * b;
        self.along2 += sign * a * a;
        self.product += sign * a * b;
        self.across2 += sign * b * b;
    }

    /// The line that minimises the objective at this variance.
    fn fit(&self, variance_px2: f64) -> Line {
        let (a, b) = (self.along / self.count, self.across / self.count);
        let spread = (self.along2 - a * self.along).max(0.0);
        let slope = (self.product - a * self.across)
            / (spread + variance_px2 / (SLOPE_SIGMA * SLOPE_SIGMA));
        Line { offset_px: b - slope * a, slope, variance_px2 }
    }

    /// Mean squared residual about a line.
    fn scatter(&self, line: &Line) -> f64 {
        let (o, s) = (line.offset_px, line.slope);
        let sum = self.across2 - 2.0 * o * self.across - 2.0 * s * self.product
            + self.count * o * o
            + 2.0 * o * s * self.along
            + s * s * self.along2;
        (sum / self.count).max(0.0)
    }
}

/// Parallel lines and the membership of the plants: the rows, or the columns.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Family {
    /// The lines, by offset at the start.
    pub lines: Vec<Line>,
    /// Line of every plant.
    pub of: Vec<u32>,
    moments: Vec<Moments>,
    /// Columns run across the rows: their axes are exchanged.
    exchanged: bool,
    floor_px2: f64,
}

impl Family {
    /// Lines at these offsets, plants at the nearest one. Empty offsets mean no prior.
    pub(super) fn new(
        offsets_px: &[f64],
        exchanged: bool,
        variance_px2: f64,
        floor_px2: f64,
        plants: &[[f64; 2]],
        axes: &Axes,
    ) -> Family {
        let lines = offsets_px
            .iter()
            .map(|&offset_px| Line { offset_px, slope: 0.0, variance_px2 })
            .collect();
        let of = vec![0; plants.len()];
        let mut family = Family { lines, of, moments: Vec::new(), exchanged, floor_px2 };
        if !family.lines.is_empty() {
            family.refit_members(plants, axes);
            family.gather(plants, axes);
        }
        family
    }

    /// Whether the family fits a number of plants and has finite, usable numbers.
    pub(super) fn is_sound(&self, plants: usize) -> bool {
        let inside = |&line: &u32| (line as usize) < self.lines.len();
        self.lines.is_empty()
            || (self.of.len() == plants
                && self.of.iter().all(inside)
                && self.moments.len() == self.lines.len()
                && self.lines.iter().all(|line| {
                    let numbers = [line.offset_px, line.slope, line.variance_px2];
                    numbers.iter().all(|x| x.is_finite()) && line.variance_px2 > 0.0
                }))
    }

    fn place(&self, at: [f64; 2], axes: &Axes) -> [f64; 2] {
        let [along, across] = axes.aligned(at);
        if self.exchanged { [across, along] } else { [along, across] }
    }

    /// The line that holds `plant`, if any does.
    fn line_for(&self, plant: usize, place: [f64; 2], joint: bool) -> Option<Line> {
        let row = *self.of.get(plant)? as usize;
        let line = self.lines.get(row)?;
        if joint {
            return Some(*line);
        }
        let mut others = self.moments[row];
        others.add(place, -1.0);
        if others.count < 0.5 {
            return None;
        }
        let fitted = others.fit(line.variance_px2);
        let variance_px2 = others.scatter(&fitted).max(self.floor_px2);
        Some(Line { variance_px2, ..fitted })
    }

    /// Adds the prior of one plant as a function of its offset from where it is.
    pub(super) fn add_to(
        &self,
        quadratic: &mut Quadratic,
        plant: usize,
        at: [f64; 2],
        axes: &Axes,
        joint: bool,
    ) {
        let place = self.place(at, axes);
        let Some(line) = self.line_for(plant, place, joint) else { return };
        let (s, c) = axes.heading_rad.sin_cos();
        let (along, across) = ([c, s], [-s, c]);
        let (along, across) = if self.exchanged { (across, along) } else { (along, across) };
        let normal = [across[0] - line.slope * along[0], across[1] - line.slope * along[1]];
        quadratic.add(normal, -line.residual(place), line.variance_px2);
    }

    /// The prior's part of the objective.
    pub(super) fn cost(&self, plants: &[[f64; 2]], axes: &Axes, joint: bool) -> f64 {
        let held = plants.iter().enumerate().filter_map(|(plant, &at)| {
            let place = self.place(at, axes);
            self.line_for(plant, place, joint).map(|line| line.cost(place))
        });
        let slopes: f64 =
            self.lines.iter().map(|line| (line.slope / SLOPE_SIGMA).powi(2) / 2.0).sum();
        held.sum::<f64>() + slopes
    }

    /// Sums up the plants of every line; the refits of lines and variances read these sums.
    pub(super) fn gather(&mut self, plants: &[[f64; 2]], axes: &Axes) {
        let mut moments = vec![Moments::default(); self.lines.len()];
        for (&at, &line) in plants.iter().zip(&self.of) {
            if let Some(moments) = moments.get_mut(line as usize) {
                moments.add(self.place(at, axes), 1.0);
            }
        }
        self.moments = moments;
    }

    /// Gives every plant to the line under which it costs least.
    pub(super) fn refit_members(&mut self, plants: &[[f64; 2]], axes: &Axes) {
        for (plant, &at) in plants.iter().enumerate() {
            let place = self.place(at, axes);
            let costs = (0u32..).zip(&self.lines).map(|(k, line)| (line.cost(place), k));
            if let Some((_, line)) = costs.min_by(|a, b| a.0.total_cmp(&b.0)) {
                self.of[plant] = line;
            }
        }
    }

    /// Fits every line to its plants; one without any stays.
    pub(super) fn refit_lines(&mut self) {
        for (line, moments) in self.lines.iter_mut().zip(&self.moments) {
            if moments.count > 0.5 {
                *line = moments.fit(line.variance_px2);
            }
        }
    }

    /// Fits the variance of every line, above the floor.
    pub(super) fn refit_variances(&mut self) {
        for (line, moments) in self.lines.iter_mut().zip(&self.moments) {
            if moments.count > 0.5 {
                line.variance_px2 = moments.scatter(line).max(self.floor_px2);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn axes() -> Axes {
        Axes { origin_px: [50.0, 30.0], heading_rad: 0.4 }
    }

    #[test]
    fn axes_turn_there_and_back() {
        let at = [12.5, -3.0];
        let back = axes().image(axes().aligned(at));
        assert!((back[0] - at[0]).hypot(back[1] - at[1]) < 1e-12);
        let ahead = axes().image([10.0, 0.0]);
        approx::assert_relative_eq!((ahead[1] - 30.0).atan2(ahead[0] - 50.0), 0.4, epsilon = 1e-12);
    }

    /// Plants on two tilted lines, some scatter.
    fn plants() -> Vec<[f64; 2]> {
        (0..40)
            .map(|p| {
                let (row, along) = (f64::from(p % 2), f64::from(p) * 3.0 - 60.0);
                let scatter = f64::from(p * 7 % 5) / 4.0 - 0.5;
                axes().image([along, row * 25.0 + 0.01 * along + scatter])
            })
            .collect()
    }

    #[test]
    fn every_refit_decreases_the_objective() {
        let plants = plants();
        for exchanged in [false, true] {
            let mut family = Family::new(&[-4.0, 31.0], exchanged, 9.0, 0.04, &plants, &axes());
            let mut cost = family.cost(&plants, &axes(), true);
            for round in 0..6 {
                for step in 0..3 {
                    match step {
                        0 => {
                            family.refit_members(&plants, &axes());
                            family.gather(&plants, &axes());
                        }
                        1 => family.refit_lines(),
                        _ => family.refit_variances(),
                    }
                    let next = family.cost(&plants, &axes(), true);
                    assert!(next <= cost + 1e-9, "round {round} step {step}: {cost} -> {next}");
                    cost = next;
                }
            }
            if !exchanged {
                approx::assert_abs_diff_eq!(family.lines[0].offset_px, 0.0, epsilon = 0.2);
                approx::assert_abs_diff_eq!(family.lines[1].slope, 0.01, epsilon = 0.005);
                assert!(family.lines[0].variance_px2 < 0.3);
            }
        }
    }

    #[test]
    fn the_conditional_line_is_that_of_the_other_plants() {
        let plants = plants();
        let family = Family::new(&[0.0, 25.0], false, 1.0, 0.04, &plants, &axes());
        let place = family.place(plants[6], &axes());
        let held = family.line_for(6, place, false).unwrap();
        let mut others = Moments::default();
        for p in (0..40).filter(|&p| p != 6 && family.of[p] == family.of[6]) {
            others.add(family.place(plants[p], &axes()), 1.0);
        }
        let direct = others.fit(1.0);
        approx::assert_relative_eq!(held.offset_px, direct.offset_px, epsilon = 1e-9);
        approx::assert_relative_eq!(held.variance_px2, others.scatter(&direct), epsilon = 1e-9);
        let alone = Family::new(&[0.0], false, 1.0, 0.04, &plants[..1], &axes());
        assert!(alone.line_for(0, place, false).is_none());
        assert!(alone.line_for(0, place, true).is_some());
    }
}
