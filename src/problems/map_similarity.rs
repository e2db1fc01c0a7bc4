//! The map of one date in the frame of others: a similarity of the plane from places that both show.
//!
//! ```text
//! T(x) = c + t + (I + [a -b; b a]) (x - c)
//! min over (t, a, b)   1/2 sum_i rho( |T(x_i) - y_i|^2 / s^2 )
//! ```
//!
//! `x_i` and `y_i`: the same place on this map and in the frame of the others, metres; `c` the middle of the field; `rho` of Cauchy. The
//! scatter `s` of each coordinate comes from the median of the residuals. Neighbouring places share the deformation of their block,
//! so residuals are not independent: their means over cells of the field say how large what is common is, and standard deviations
//! are enlarged by the design effect, the variance of these means over that of independent residuals.
//!
//! Reference: the design effect of cluster samples, L. Kish, *Survey Sampling*, 1965, section 5.4.

use crate::nlls::{
    self, Euclidean, Infeasible, LinearSolver, Loss, Options, Problem, Residual, Residuals, Scalar,
    Vector, covariance::Covariance,
};
use serde::{Deserialize, Serialize};

/// A place on two maps, metres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MapTie {
    /// On the map that is moved.
    pub from_m: [f64; 2],
    /// In the frame of the others.
    pub to_m: [f64; 2],
}

/// A similarity of the plane, about a place near the field so that its numbers are small.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MapSimilarity {
    /// The place that only the shift moves, metres.
    pub centre_m: [f64; 2],
    /// Shift, metres.
    pub shift_m: [f64; 2],
    /// `a`: change of scale.
    pub scale: f64,
    /// `b`: rotation counter-clockwise, radians for small ones.
    pub rotation: f64,
}

impl MapSimilarity {
    /// The one that moves nothing.
    pub const IDENTITY: MapSimilarity =
        MapSimilarity { centre_m: [0.0; 2], shift_m: [0.0; 2], scale: 0.0, rotation: 0.0 };

    /// A place of the map in the frame of the others, metres.
    pub fn apply(&self, x_m: [f64; 2]) -> [f64; 2] {
        let [dx, dy] = [x_m[0] - self.centre_m[0], x_m[1] - self.centre_m[1]];
        let (a, b) = (self.scale, self.rotation);
        [x_m[0] + self.shift_m[0] + a * dx - b * dy, x_m[1] + self.shift_m[1] + b * dx + a * dy]
    }

    /// A place of the frame of the others on the map, metres.
    pub fn invert(&self, y_m: [f64; 2]) -> [f64; 2] {
        let [dx, dy] = [0, 1].map(|k| y_m[k] - self.centre_m[k] - self.shift_m[k]);
        let (a, b) = (1.0 + self.scale, self.rotation);
        let square = a * a + b * b;
        [
            self.centre_m[0] + (a * dx + b * dy) / square,
            self.centre_m[1] + (a * dy - b * dx) / square,
        ]
    }
}

/// A similarity with its accuracy.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MapFit {
    /// The similarity.
    pub similarity: MapSimilarity,
    /// Places that took part with at least half of their weight.
    pub ties: usize,
    /// Standard deviation of one coordinate of one place, metres.
    pub scatter_m: f64,
    /// Root mean square length of the mean residuals of cells of the field: what no similarity takes out, metres.
    pub deformation_m: f64,
    /// Standard deviation of the middle of the field, each axis, metres.
    pub middle_sigma_m: f64,
    /// Standard deviation at the place furthest from the middle, each axis, metres.
    pub edge_sigma_m: f64,
}

/// One place as a residual, in standard deviations; `a` and `b` are in metres at the reach of the field.
struct Place {
    from_m: [f64; 2],
    to_m: [f64; 2],
    reach_m: f64,
    sigma_m: f64,
}

impl Residual<2> for Place {
    type Blocks = (Vector<4>,);

    fn evaluate<T: Scalar>(&self, (p,): ([T; 4],)) -> Result<[T; 2], Infeasible> {
        let [dx, dy] = self.from_m.map(|d| d / self.reach_m);
        let off = [
            p[0] + p[2] * dx - p[3] * dy + (self.from_m[0] - self.to_m[0]),
            p[1] + p[3] * dx + p[2] * dy + (self.from_m[1] - self.to_m[1]),
        ];
        Ok(off.map(|o| o / self.sigma_m))
    }
}

/// 95 % of the efficiency of least squares on normal errors.
const CAUCHY_SCALE: f64 = 2.385;
/// Fewer places than this give no similarity worth having.
pub const LEAST_TIES: usize = 12;
/// Cells along the longer side of the field.
const CELLS: f64 = 6.0;
/// Fewest places of a cell whose mean counts.
const LEAST_IN_CELL: usize = 4;
const ROUNDS: usize = 4;
const STEPS: usize = 50;

/// Fits the similarity to places among which gross errors may be left; `None` where there are too few, or all at one place.
pub fn fit(ties: &[MapTie]) -> Option<MapFit> {
    if ties.len() < LEAST_TIES {
        return None;
    }
    let bound = |axis: usize| {
        let values = ties.iter().map(|tie| tie.from_m[axis]);
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)))
    };
    let bounds = [bound(0), bound(1)];
    let centre_m = bounds.map(|(low, high)| 0.5 * (low + high));
    let reach_m = bounds.iter().map(|(low, high)| 0.5 * (high - low)).fold(0.0, f64::hypot);
    if !(reach_m.is_finite() && reach_m > 0.0) {
        return None;
    }
    let local = |at: [f64; 2]| [at[0] - centre_m[0], at[1] - centre_m[1]];
    let median_shift =
        [0, 1].map(|k| median(ties.iter().map(|t| t.to_m[k] - t.from_m[k]).collect()));
    let mut found = [median_shift[0], median_shift[1], 0.0, 0.0];
    let mut sigma_m = spread(ties, &local, reach_m, &found);
    let mut last = None;
    for _ in 0..ROUNDS {
        let mut problem = Problem::new();
        let block = problem.block("similarity", Euclidean(4), &found).ok()?;
        let places = ties.iter().map(|tie| {
            let (from_m, to_m) = (local(tie.from_m), local(tie.to_m));
            ([block], Place { from_m, to_m, reach_m, sigma_m })
        });
        problem.add("places", Loss::Cauchy(CAUCHY_SCALE), Residuals::new(places)).ok()?;
        let mut x = problem.start();
        nlls::solve(&problem, &mut x, &Options::default(), STEPS as u64).ok()?;
        found = problem.values(&x, block).try_into().ok()?;
        let covariance = Covariance::new(&problem, &x, LinearSolver::Dense).ok()?.block(block);
        sigma_m = spread(ties, &local, reach_m, &found);
        last = Some(covariance);
    }
    let covariance = last?;
    let mut cells: std::collections::BTreeMap<[i64; 2], (f64, [f64; 2])> =
        std::collections::BTreeMap::new();
    let cell_m = 2.0 * reach_m / CELLS;
    let mut used = 0;
    for tie in ties {
        let off = residual(tie, &local, reach_m, &found);
        if off[0].hypot(off[1]) < CAUCHY_SCALE * sigma_m {
            used += 1;
            let cell = local(tie.from_m).map(|d| (d / cell_m).floor() as i64);
            let sums = cells.entry(cell).or_default();
            sums.0 += 1.0;
            sums.1 = [sums.1[0] + off[0], sums.1[1] + off[1]];
        }
    }
    let full = || cells.values().filter(|(n, _)| *n >= LEAST_IN_CELL as f64);
    let count = full().count() as f64;
    if count < 1.0 {
        return None;
    }
    let square = |(n, sum): &(f64, [f64; 2])| (sum[0] * sum[0] + sum[1] * sum[1]) / (n * n);
    let deformation_m = (full().map(square).sum::<f64>() / count).sqrt();
    // Independent residuals give means of this mean square; the rest is common to the cell.
    let independent = full().map(|(n, _)| 2.0 * sigma_m * sigma_m / n).sum::<f64>() / count;
    let design = (deformation_m * deformation_m / independent.max(1e-18)).max(1.0);
    let at = |dx: f64, dy: f64| {
        let g = [1.0, 0.0, dx, -dy];
        let c = &covariance;
        let sum: f64 =
            (0..4).map(|i| (0..4).map(|j| g[i] * c[4 * i + j] * g[j]).sum::<f64>()).sum();
        (sum * design).max(0.0).sqrt()
    };
    Some(MapFit {
        similarity: MapSimilarity {
            centre_m,
            shift_m: [found[0], found[1]],
            scale: found[2] / reach_m,
            rotation: found[3] / reach_m,
        },
        ties: used,
        scatter_m: sigma_m,
        deformation_m,
        middle_sigma_m: at(0.0, 0.0),
        edge_sigma_m: at(1.0, 0.0).max(at(0.0, 1.0)),
    })
}

fn residual(
    tie: &MapTie,
    local: &impl Fn([f64; 2]) -> [f64; 2],
    reach_m: f64,
    p: &[f64; 4],
) -> [f64; 2] {
    let (from_m, to_m) = (local(tie.from_m), local(tie.to_m));
    let place = Place { from_m, to_m, reach_m, sigma_m: 1.0 };
    place.evaluate((*p,)).unwrap_or([f64::NAN; 2])
}

/// Standard deviation of a coordinate from the median length: 1.1774 standard deviations in the plane.
fn spread(
    ties: &[MapTie],
    local: &impl Fn([f64; 2]) -> [f64; 2],
    reach_m: f64,
    p: &[f64; 4],
) -> f64 {
    let lengths = ties.iter().map(|tie| {
        let [x, y] = residual(tie, local, reach_m, p);
        x.hypot(y)
    });
    (median(lengths.collect()) / 1.1774).max(1e-6 * reach_m)
}

fn median(mut values: Vec<f64>) -> f64 {
    let middle = values.len() / 2;
    if values.is_empty() {
        return 0.0;
    }
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    const TRUTH: MapSimilarity = MapSimilarity {
        centre_m: [500_010.0, 4_480_020.0],
        shift_m: [0.42, -0.31],
        scale: 0.002,
        rotation: -0.004,
    };

    fn ties(seed: u64, count: usize, sigma_m: f64, wrong: f64) -> Vec<MapTie> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        (0..count)
            .map(|_| {
                let from_m = [
                    500_000.0 + 20.0 * rng.random::<f64>(),
                    4_480_000.0 + 40.0 * rng.random::<f64>(),
                ];
                let mut to_m = TRUTH.apply(from_m);
                let is_wrong = rng.random::<f64>() < wrong;
                let scale = if is_wrong { 0.5 } else { sigma_m };
                for value in &mut to_m {
                    let normal: f64 = rng.sample(StandardNormal);
                    *value += scale * normal;
                }
                MapTie { from_m, to_m }
            })
            .collect()
    }

    #[test]
    fn a_similarity_and_its_inverse_cancel() {
        let at = [500_003.0, 4_480_031.0];
        let back = TRUTH.invert(TRUTH.apply(at));
        assert!((back[0] - at[0]).abs() < 1e-9 && (back[1] - at[1]).abs() < 1e-9);
        assert_eq!(MapSimilarity::IDENTITY.apply(at), at);
    }

    #[test]
    fn gross_errors_do_not_count_and_the_accuracy_is_what_it_says() {
        let edge = [500_020.0, 4_480_000.0];
        let (mut squares, mut stated) = (0.0, 0.0);
        for seed in 0..40 {
            let fit = fit(&ties(seed, 300, 0.01, 0.2)).unwrap();
            assert!((0.009..0.017).contains(&fit.scatter_m), "{fit:?}");
            let (found, truth) = (fit.similarity.apply(edge), TRUTH.apply(edge));
            squares += 0.5 * ((found[0] - truth[0]).powi(2) + (found[1] - truth[1]).powi(2));
            stated += fit.edge_sigma_m.powi(2);
        }
        // 80 squares have a relative standard deviation of 16 %, so their root is within a quarter at three of them. What is
        // stated is on the safe side: gross errors widen the median by a fifth, and weights and cells add as much.
        let ratio = (squares / stated).sqrt();
        assert!((0.45..1.25).contains(&ratio), "{ratio}");
    }

    #[test]
    fn deformation_is_told_from_noise() {
        let mut bent = ties(1, 2000, 0.01, 0.0);
        for tie in &mut bent {
            let along = (tie.from_m[1] - 4_480_020.0) / 20.0;
            tie.to_m[0] += 0.03 * (along * along - 1.0 / 3.0);
        }
        let (straight, bent) = (fit(&ties(1, 2000, 0.01, 0.0)).unwrap(), fit(&bent).unwrap());
        assert!(
            straight.deformation_m < 0.004 && bent.deformation_m > 0.006,
            "{straight:?} {bent:?}"
        );
        assert!(bent.middle_sigma_m > 2.0 * straight.middle_sigma_m);
    }

    #[test]
    fn too_little_gives_nothing() {
        assert_eq!(fit(&ties(1, 5, 0.01, 0.0)), None);
        let one = MapTie { from_m: [1.0, 2.0], to_m: [2.0, 2.0] };
        assert_eq!(fit(&[one; 30]), None);
    }
}
