//! The standard deviation of heights that comes from the orientation of the photos, by place.
//!
//! ```text
//! sigma_o(x, y) = q10 of sigma_z over the tie points around (x, y)
//! ```
//!
//! The height of a tie point is uncertain because its photos are, and because its images were measured. The best determined ones
//! of a place were measured so often, or from so far apart, that the second hardly counts. `docs/accuracy.md` compares what this and the
//! matching say together with the errors of synthetic flights; of heights above the ground it is no part. Without ground control it is
//! mostly what is unknown of the height of the whole map.

use super::dem::SurfacePoint;

/// Share of the tie points around a place whose standard deviations are smaller than what is taken. On the synthetic flights of seeds 1 to 3 of
/// `docs/accuracy.md` the errors of bare soil are 0.9, 1.2 and 1.8 times what is told with a tenth of all tie points, 0.7, 1.0 and 1.4 times with
/// a quarter.
const BEST: f64 = 0.1;
/// Tie points of a square on average, and around its middle at least: of fewer, a tenth is hardly a number. Not searched for.
const POINTS: usize = 30;
/// Squares in each direction, at most: orientation varies over photos, of which flights have fewer in a row. Not searched for.
const MAX_SQUARES: f64 = 256.0;

/// A lattice of standard deviations.
#[derive(Debug, Clone, PartialEq)]
pub struct OrientationSigma {
    /// Middle of the first square, metres.
    first_m: [f64; 2],
    /// Distance of the middles, metres.
    side_m: f64,
    /// Squares in `x` and `y`.
    size: [usize; 2],
    /// Of each square, row by row, metres.
    sigma_m: Vec<f64>,
}

impl OrientationSigma {
    /// From tie points; `None` where fewer than 30 have a standard deviation.
    pub fn of(points: &[SurfacePoint]) -> Option<OrientationSigma> {
        let known = || points.iter().filter(|point| point.sigma_z_m.is_finite());
        let count = known().count();
        if count < POINTS {
            return None;
        }
        let extreme = |k: usize, pick: fn(f64, f64) -> f64| {
            known().map(|point| point.position_m[k]).reduce(pick).unwrap_or(0.0)
        };
        let low = [extreme(0, f64::min), extreme(1, f64::min)];
        let extent = [0, 1].map(|k| extreme(k, f64::max) - low[k]);
        let longest = extent[0].max(extent[1]);
        let side_m = (extent[0] * extent[1] * POINTS as f64 / count as f64).sqrt();
        let side_m = side_m.max(longest / MAX_SQUARES).max(f64::MIN_POSITIVE);
        let size = extent.map(|extent| (extent / side_m) as usize + 1);
        let mut squares = vec![Vec::new(); size[0] * size[1]];
        for point in known() {
            let [column, row] = [0, 1].map(|k| ((point.position_m[k] - low[k]) / side_m) as usize);
            squares[row * size[0] + column].push(point.sigma_z_m);
        }
        let around = |at: usize| {
            let (column, row) = (at % size[0], at / size[0]);
            let mut found: Vec<f64> = Vec::new();
            let mut reach = 1;
            while found.len() < POINTS {
                let near = |k: usize, n: usize| k.saturating_sub(reach)..(k + reach + 1).min(n);
                found.clear();
                for row in near(row, size[1]) {
                    for column in near(column, size[0]) {
                        found.extend(&squares[row * size[0] + column]);
                    }
                }
                reach += 1;
            }
            let best = (BEST * found.len() as f64) as usize;
            *found.select_nth_unstable_by(best, f64::total_cmp).1
        };
        let sigma_m = (0..squares.len()).map(around).collect();
        let first_m = low.map(|low| low + 0.5 * side_m);
        Some(OrientationSigma { first_m, side_m, size, sigma_m })
    }

    /// At a place, metres: between the middles of squares bilinear, beyond the last ones as there.
    pub fn at_m(&self, place_m: [f64; 2]) -> f64 {
        let [x, y] = [0, 1].map(|k| {
            let last = (self.size[k] - 1) as f64;
            ((place_m[k] - self.first_m[k]) / self.side_m).clamp(0.0, last)
        });
        let at = |column: usize, row: usize| {
            let [column, row] = [column.min(self.size[0] - 1), row.min(self.size[1] - 1)];
            self.sigma_m[row * self.size[0] + column]
        };
        let (u, v) = (x as usize, y as usize);
        let (a, b) = (x - u as f64, y - v as f64);
        let along = |row: usize| at(u, row) + a * (at(u + 1, row) - at(u, row));
        along(v) + b * (along(v + 1) - along(v))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn the_best_tie_points_tell_what_orientation_leaves() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let truth = |x: f64| 0.01 + 0.0002 * x;
        let points: Vec<SurfacePoint> = (0..20_000)
            .map(|_| {
                let [x, y] = [100.0, 60.0].map(|extent| extent * rng.random::<f64>());
                // Nothing is seen in one corner.
                let x = if x < 30.0 && y < 20.0 { x + 50.0 } else { x };
                let measured = 0.03 * rng.random::<f64>();
                SurfacePoint { position_m: [x, y, 5.0], sigma_z_m: truth(x).hypot(measured) }
            })
            .collect();
        let sigma = OrientationSigma::of(&points).unwrap();
        for [x, y] in [[50.0, 30.0], [90.0, 50.0], [10.0, 50.0]] {
            let off = sigma.at_m([x, y]) / truth(x);
            assert!((0.97..1.1).contains(&off), "{x} {y}: {off}");
        }
        // Where nothing is seen, as beside; beyond the last points, as there.
        assert!(sigma.at_m([5.0, 5.0]) < 0.025);
        assert_eq!(sigma.at_m([1e6, 30.0]), sigma.at_m([2e6, 30.0]));
    }

    #[test]
    fn few_points_and_points_in_line() {
        let at =
            |x: f64, y: f64, sigma_z_m: f64| SurfacePoint { position_m: [x, y, 0.0], sigma_z_m };
        assert_eq!(OrientationSigma::of(&[]), None);
        let unknown: Vec<SurfacePoint> = (0..90).map(|k| at(f64::from(k), 2.0, f64::NAN)).collect();
        assert_eq!(OrientationSigma::of(&unknown), None);
        let line: Vec<SurfacePoint> = (0..90).map(|k| at(f64::from(k), 2.0, 0.02)).collect();
        assert_eq!(OrientationSigma::of(&line).unwrap().at_m([7.0, 9.0]), 0.02);
        let same = vec![at(3.0, 2.0, 0.02); 40];
        assert_eq!(OrientationSigma::of(&same).unwrap().at_m([7.0, 9.0]), 0.02);
    }
}
