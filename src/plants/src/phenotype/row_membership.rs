//! Which plants belong to the rows, and which grow between them: weeds, volunteers, crop that was spilled.
//!
//! The distance `d` of a plant from its nearest row, of rows that are `s` apart, is that of a crop plant with probability `w`, normal
//! with standard deviation `r`, or that of a plant that grows anywhere:
//!
//! `p(d) = w N(d; 0, r^2) + (1 - w) / s`, `|d| <= s / 2`
//!
//! Rows seen in a mask are drawn aside by weeds, those at the border most, because there they have neighbours on one side only. So the lines
//! are fitted with the rest: row `k` crosses the axis at `a + s k + e_k` and runs at the slope `h` against it, with normal priors about the
//! rows that were seen for `s`, `h` and `e_k`. `w`, `r` and the lines are found by expectation maximization (with the conditional
//! maximization of Meng and Rubin), so that a field without weeds has `w` near 1 and loses nothing. Rows that were missed at the border of a photo
//! are continued by whole distances. Where the mixture is no better than plants that grow anywhere, nothing is said.
//!
//! References: A. P. Dempster, N. M. Laird and D. B. Rubin, "Maximum likelihood from incomplete data via the EM algorithm", Journal of
//! the Royal Statistical Society B 39, 1977; X.-L. Meng and D. B. Rubin, "Maximum likelihood estimation via the ECM algorithm", Biometrika
//! 80, 1993.

use super::rows::Rows;
use nalgebra::{Matrix3, Vector3};
use std::f64::consts::TAU;

/// Rounds of expectation maximization, with the rows as they were seen and then with lines that move. With 100 to 200 crop plants and 0 to
/// 300 weeds, share and scatter change by less than 1e-4 after these where the lines do not move.
const ROUNDS: usize = 60;
/// The least standard deviation across a row, as a share of the distance between rows: 0.8 cm at the usual 0.76 m, what a planter
/// and the middle of a seedling's leaves reach together. It keeps the likelihood of plants exactly in line finite.
const MIN_SIGMA: f64 = 0.01;
/// The largest, as a share of the distance between rows: the middle between two rows is then 2.5 standard deviations away, and with more the
/// rows would run into each other.
const MAX_SIGMA: f64 = 0.2;
/// Standard deviation of the distance between rows about that of the rows seen, as a share: weeds as large as plants drew it by 3.5 %
/// (the test of weeds between the rows in `mass_stand`).
const SPACING_SIGMA: f64 = 0.05;
/// Standard deviation of the heading about that of the rows seen, in radians: about one degree. Not tuned.
const HEADING_SIGMA: f64 = 0.02;
/// Standard deviation of a row about its place among equal distances, as a share of the distance: the rows where two passes of a planter
/// meet are 2 to 4 cm off.
const ROW_SIGMA: f64 = 0.04;
/// The least gain in log likelihood over plants that grow anywhere. The rows were chosen among many before: of 10 to 1,000 plants anywhere,
/// the best of 210 distances and phases gains at most 9.2 in 200 draws (4 at the median; the test draws 20 of them).
const MIN_GAIN: f64 = 10.0;

/// The mixture of crop and weeds across the rows. Lengths are in distances between the rows that were seen.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct RowMembership {
    share: f64,
    sigma: f64,
    lines: Lines,
}

/// Row `k` crosses the axis at `origin + k spacing + aside[k - first]`.
#[derive(Debug, Clone, PartialEq)]
struct Lines {
    /// Distance between the rows that were seen, the unit of all lengths here.
    unit_px: f64,
    /// Where row 0 crosses the axis.
    origin: f64,
    /// Distance between rows.
    spacing: f64,
    /// Of the rows against the axes along which they were seen.
    slope: f64,
    /// Number of the first row with an offset of its own.
    first: i64,
    /// How far each row, from the first on, is from its place among equal distances.
    aside: Vec<f64>,
}

impl Lines {
    /// The rows seen, as equal distances; `None` without rows or with a single one.
    fn seen(rows: &Rows) -> Option<Lines> {
        let unit_px = rows.spacing_px.filter(|spacing| *spacing > 0.0)?;
        let mut numbered: Vec<(i64, f64)> = Vec::new();
        for row in &rows.rows {
            let at = row.across_px / unit_px;
            let k = numbered.last().map_or(0, |&(k, last)| k + ((at - last).round() as i64).max(1));
            numbered.push((k, at));
        }
        let count = numbered.len() as f64;
        let origin = numbered.iter().map(|&(k, at)| at - k as f64).sum::<f64>() / count;
        let last = numbered.last()?.0;
        let mut aside = vec![0.0; last as usize + 1];
        for (k, at) in numbered {
            aside[k as usize] = at - origin - k as f64;
        }
        Some(Lines { unit_px, origin, spacing: 1.0, slope: 0.0, first: 0, aside })
    }

    fn aside(&self, k: i64) -> f64 {
        let place = usize::try_from(k - self.first).ok();
        place.and_then(|place| self.aside.get(place)).copied().unwrap_or(0.0)
    }

    /// The distance of a place from row `k`, in distances between the rows seen.
    fn away(&self, [along, across]: [f64; 2], k: i64) -> f64 {
        across - self.slope * along - self.origin - k as f64 * self.spacing - self.aside(k)
    }

    /// The nearest row of a place and the distance from it.
    fn nearest(&self, place: [f64; 2]) -> (i64, f64) {
        let [along, across] = place;
        let near = ((across - self.slope * along - self.origin) / self.spacing).round() as i64;
        let mut found = (near, self.away(place, near));
        for k in [near - 1, near + 1] {
            let away = self.away(place, k);
            if away.abs() < found.1.abs() {
                found = (k, away);
            }
        }
        found
    }

    /// Moves the lines to plants, each with the probability that it belongs to its row.
    fn refit(&mut self, members: &[([f64; 2], i64, f64)], sigma: f64) {
        // Equal distances and one heading, with the rows' own offsets held.
        let priors =
            Vector3::new(0.0, SPACING_SIGMA.powi(-2), HEADING_SIGMA.powi(-2)) * sigma * sigma;
        let mut normal = Matrix3::from_diagonal(&priors);
        let mut right = Vector3::new(0.0, priors[1], 0.0);
        for &([along, across], k, weight) in members {
            let row = Vector3::new(1.0, k as f64, along);
            normal += weight * row * row.transpose();
            right += weight * (across - self.aside(k)) * row;
        }
        if let Some(cholesky) = normal.cholesky() {
            let found = cholesky.solve(&right);
            (self.origin, self.spacing, self.slope) = (found[0], found[1], found[2]);
        }
        // Each row's own offset, drawn to zero.
        let first = members.iter().map(|member| member.1).min().unwrap_or(0);
        let last = members.iter().map(|member| member.1).max().unwrap_or(-1);
        let mut sums = vec![(0.0, 0.0); (last - first + 1).max(0) as usize];
        for &([along, across], k, weight) in members {
            let level = across - self.slope * along - self.origin - k as f64 * self.spacing;
            let sum = &mut sums[(k - first) as usize];
            *sum = (sum.0 + weight, sum.1 + weight * level);
        }
        let ratio = (sigma / ROW_SIGMA).powi(2);
        self.first = first;
        self.aside = sums.into_iter().map(|(weight, sum)| sum / (weight + ratio)).collect();
    }
}

impl RowMembership {
    /// Fits the rows that were seen to plants, (along, across) by the axes of the rows; `None` where rows say nothing.
    pub(super) fn fit(rows: &Rows, places_px: &[[f64; 2]]) -> Option<RowMembership> {
        let lines = Lines::seen(rows)?;
        let places: Vec<[f64; 2]> =
            places_px.iter().map(|place| place.map(|at| at / lines.unit_px)).collect();
        let mut found = RowMembership { share: 0.7, sigma: 0.08, lines };
        // Lines that may move gain with any plants, so the rows as they were seen must have a gain.
        for _ in 0..ROUNDS {
            found.step(&places, false);
        }
        let distances = places.iter().map(|&place| found.lines.nearest(place).1);
        let gain: f64 = distances.map(|distance| found.density(distance).ln()).sum();
        if gain <= MIN_GAIN {
            return None;
        }
        for _ in 0..ROUNDS {
            found.step(&places, true);
        }
        Some(found)
    }

    /// One round of expectation maximization, with the lines or without.
    fn step(&mut self, places: &[[f64; 2]], lines_move: bool) {
        let members: Vec<([f64; 2], i64, f64)> = places
            .iter()
            .map(|&place| {
                let (k, away) = self.lines.nearest(place);
                (place, k, self.belongs(away))
            })
            .collect();
        if lines_move {
            self.lines.refit(&members, self.sigma);
        }
        let of_rows: f64 = members.iter().map(|member| member.2).sum();
        let squares =
            members.iter().map(|&(place, k, weight)| weight * self.lines.away(place, k).powi(2));
        self.sigma = (squares.sum::<f64>() / of_rows.max(1e-12)).sqrt().clamp(MIN_SIGMA, MAX_SIGMA);
        self.share = (of_rows / places.len() as f64).clamp(0.0, 1.0);
    }

    fn of_rows(&self, distance: f64) -> f64 {
        let z = distance / self.sigma;
        self.share * (-0.5 * z * z).exp() / (self.sigma * TAU.sqrt())
    }

    fn density(&self, distance: f64) -> f64 {
        (self.of_rows(distance) + 1.0 - self.share).max(f64::MIN_POSITIVE)
    }

    fn belongs(&self, distance: f64) -> f64 {
        self.of_rows(distance) / self.density(distance)
    }

    /// Probability that a plant at a place (along, across) belongs to its nearest row.
    pub(super) fn probability(&self, place_px: [f64; 2]) -> f64 {
        self.belongs(self.lines.nearest(place_px.map(|at| at / self.lines.unit_px)).1)
    }
}

#[cfg(test)]
mod tests {
    use super::super::rows::Row;
    use super::*;
    use crate::problems::plants::lines::Axes;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn rows_at(across_px: impl IntoIterator<Item = f64>, spacing_px: f64) -> Rows {
        let row = |across_px| Row { across_px, start_px: 0.0, end_px: 1000.0, pixels: 100 };
        Rows {
            axes: Axes { origin_px: [0.0; 2], heading_rad: 0.0 },
            rows: across_px.into_iter().map(row).collect(),
            spacing_px: Some(spacing_px),
            contrast: 1.0,
        }
    }

    /// `crop` plants of ten rows, 100 pixels apart, with a standard deviation of 4 pixels; and weeds anywhere.
    fn field(crop: usize, weeds: usize, seed: u64) -> Vec<[f64; 2]> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut found = Vec::new();
        for k in 0..crop {
            let normal = (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0;
            found.push([rng.random_range(0.0..1000.0), 100.0 * (k % 10) as f64 + 4.0 * normal]);
        }
        found.extend(
            (0..weeds).map(|_| [rng.random_range(0.0..1000.0), rng.random_range(-50.0..950.0)]),
        );
        found
    }

    #[test]
    fn share_and_scatter_are_found_and_rows_drawn_aside_return() {
        let seen = rows_at((0..10).map(|k| 100.0 * f64::from(k)), 100.0);
        // As weeds between the rows draw them: the outer ones by 9 pixels, the distance by 2.
        let drawn = (0..10).map(|k| match k {
            0 => 9.0,
            9 => 891.0,
            k => 100.0 * f64::from(k) + if k % 2 == 0 { 3.0 } else { -3.0 },
        });
        let drawn = rows_at(drawn, 98.0);
        // The two outer rows were missed.
        let short = rows_at((1..9).map(|k| 100.0 * f64::from(k)), 97.0);
        for rows in [seen, drawn, short] {
            for (crop, weeds) in [(200, 0), (200, 20), (150, 250)] {
                let places = field(crop, weeds, 1);
                let found = RowMembership::fit(&rows, &places).unwrap();
                let share = crop as f64 / (crop + weeds) as f64;
                assert!((found.share - share).abs() < 0.06, "{crop} {weeds}: {found:?}");
                let sigma = found.sigma * found.lines.unit_px;
                assert!((sigma - 4.0).abs() < 0.8, "{crop} {weeds}: {found:?}");
                // Few of the crop are taken for weeds: those beyond 2.6, 2.6 and 1.9 standard deviations.
                let lost = places[..crop].iter().filter(|at| found.probability(**at) < 0.5).count();
                let most = if weeds > crop { crop / 10 } else { crop / 40 };
                assert!(lost <= most, "{lost} of {crop}");
            }
        }
    }

    #[test]
    fn rows_where_passes_of_a_planter_meet_keep_their_own_place() {
        // Every fourth distance is 6 pixels longer.
        let across = |k: usize| 100.0 * k as f64 + 6.0 * (k / 4) as f64;
        let mut places = field(200, 40, 2);
        for (k, place) in places[..200].iter_mut().enumerate() {
            place[1] += across(k % 10) - 100.0 * (k % 10) as f64;
        }
        let found = RowMembership::fit(&rows_at((0..10).map(across), 100.0), &places).unwrap();
        let lost = places[..200].iter().filter(|at| found.probability(**at) < 0.5).count();
        assert!(lost <= 5 && (found.sigma - 0.04).abs() < 0.01, "{lost} {found:?}");
    }

    #[test]
    fn plants_anywhere_have_no_rows() {
        // Not even in the best of many lattices of rows.
        for seed in 0..20 {
            let places = field(0, 60, seed);
            for lattice in 0..210 {
                let spacing = 30.0 + 2.5 * f64::from(lattice / 10);
                let first = -50.0 + 0.1 * spacing * f64::from(lattice % 10);
                let rows = rows_at(
                    (0..(1000.0 / spacing) as usize).map(|k| first + k as f64 * spacing),
                    spacing,
                );
                assert_eq!(RowMembership::fit(&rows, &places), None, "{seed} {spacing} {first}");
            }
        }
        let rows = rows_at([0.0, 100.0], 100.0);
        assert_eq!(RowMembership::fit(&rows, &[]), None);
        assert_eq!(RowMembership::fit(&rows, &[[0.0, 1.0], [50.0, 101.0]]), None);
        let alone = Rows { spacing_px: None, ..rows_at([0.0], 100.0) };
        assert_eq!(RowMembership::fit(&alone, &field(200, 0, 1)), None);
    }
}
