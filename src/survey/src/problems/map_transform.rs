//! The map of one date in the frame of others: a similarity or an affine map of the plane, from places that both show.
//!
//! ```text
//! T(x) = c + t + (I + [a+p -b+q; b+q a-p]) (x - c)
//! min over (t, a, b, p, q)   1/2 sum_i rho( |T(x_i) - y_i|^2 / s^2 )
//! ```
//!
//! `x_i` and `y_i`: the same place on this map and in the frame of the others, metres; `c` the middle of the field; `rho` of Cauchy. The
//! scatter `s` of each coordinate comes from the median of the residuals. A block without control whose heights tilt stretches
//! one axis more than the other: `p` and `q` take part where they lower the cost by more than chance would, else they are
//! zero and `T` is a similarity. Neighbouring places share the deformation of their block,
//! so residuals are not independent: their means over cells of the field say how large what is common is, and standard deviations
//! are enlarged by the design effect, the variance of these means over that of independent residuals, which the test accounts for too.
//!
//! Reference: the design effect of cluster samples, L. Kish, *Survey Sampling*, 1965, section 5.4.

use rowgram_optim::nlls::{
    self, Euclidean, Infeasible, LinearSolver, Loss, Options, Problem, Residual, Residuals, Scalar,
    Vector, covariance::Covariance,
};
use rowgram_optim::robust::{median, sigma_of_distances};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// A place on two maps, metres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MapTie {
    /// On the map that is moved.
    pub from_m: [f64; 2],
    /// In the frame of the others.
    pub to_m: [f64; 2],
}

/// An affine map of the plane, about a place near the field so that its numbers are small.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MapTransform {
    /// The place that only the shift moves, metres.
    pub centre_m: [f64; 2],
    /// Shift, metres.
    pub shift_m: [f64; 2],
    /// `a`: change of scale.
    pub scale: f64,
    /// `b`: rotation counter-clockwise, radians for small ones.
    pub rotation: f64,
    /// `p`: how much longer the first axis becomes than by `a` alone, and the second one shorter; `q`: the same for the axes at 45
    /// degrees. Zero in a similarity.
    pub stretch: [f64; 2],
}

impl MapTransform {
    /// The one that moves nothing.
    pub const IDENTITY: MapTransform = MapTransform {
        centre_m: [0.0; 2],
        shift_m: [0.0; 2],
        scale: 0.0,
        rotation: 0.0,
        stretch: [0.0; 2],
    };

    /// What is added to the identity, row by row.
    fn linear(&self) -> [[f64; 2]; 2] {
        let (a, b, [p, q]) = (self.scale, self.rotation, self.stretch);
        [[a + p, q - b], [b + q, a - p]]
    }

    /// A place of the map in the frame of the others, metres.
    pub fn apply(&self, x_m: [f64; 2]) -> [f64; 2] {
        let [dx, dy] = [x_m[0] - self.centre_m[0], x_m[1] - self.centre_m[1]];
        let linear = self.linear();
        [0, 1].map(|k| x_m[k] + self.shift_m[k] + linear[k][0] * dx + linear[k][1] * dy)
    }

    /// A place of the frame of the others on the map, metres.
    pub fn invert(&self, y_m: [f64; 2]) -> [f64; 2] {
        let [dx, dy] = [0, 1].map(|k| y_m[k] - self.centre_m[k] - self.shift_m[k]);
        let [[a, b], [c, d]] = self.linear();
        let (a, d) = (1.0 + a, 1.0 + d);
        let det = a * d - b * c;
        [self.centre_m[0] + (d * dx - b * dy) / det, self.centre_m[1] + (a * dy - c * dx) / det]
    }
}

/// A transform with its accuracy.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MapFit {
    /// The transform.
    pub transform: MapTransform,
    /// Places that took part with at least half of their weight.
    pub ties: usize,
    /// Standard deviation of one coordinate of one place, metres.
    pub scatter_m: f64,
    /// Root mean square length of the mean residuals of cells of the field: what the transform does not take out, metres.
    pub deformation_m: f64,
    /// Standard deviation of the middle of the field, each axis, metres.
    pub middle_sigma_m: f64,
    /// Standard deviation at the place furthest from the middle, each axis, metres.
    pub edge_sigma_m: f64,
}

/// One place as a residual, in standard deviations; `a`, `b`, `p` and `q` are in metres at the reach of the field.
struct Place {
    from_m: [f64; 2],
    to_m: [f64; 2],
    reach_m: f64,
    sigma_m: f64,
}

impl Residual<2> for Place {
    type Blocks = (Vector<6>,);

    fn evaluate<T: Scalar>(&self, (p,): ([T; 6],)) -> Result<[T; 2], Infeasible> {
        let [dx, dy] = self.from_m.map(|d| d / self.reach_m);
        let off = [
            p[0] + (p[2] + p[4]) * dx + (p[5] - p[3]) * dy + (self.from_m[0] - self.to_m[0]),
            p[1] + (p[3] + p[5]) * dx + (p[2] - p[4]) * dy + (self.from_m[1] - self.to_m[1]),
        ];
        Ok(off.map(|o| o / self.sigma_m))
    }
}

/// 95 % of the efficiency of least squares on normal errors.
const CAUCHY_SCALE: f64 = 2.385;
/// Fewer places than this give no transform worth having.
pub const LEAST_TIES: usize = 12;
/// Cells along the longer side of the field.
const CELLS: f64 = 6.0;
/// Fewest places of a cell whose mean counts.
const LEAST_IN_CELL: usize = 4;
const ROUNDS: usize = 4;
const STEPS: usize = 50;

/// 99 % quantile of chi squared with two degrees of freedom: of maps that differ by a similarity one in a hundred is taken for stretched.
const STRETCH_TEST: f64 = 9.21;

/// Fits the transform to places among which gross errors may be left; `None` where there are too few, or all at one place.
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
    let field = Field { ties, centre_m, reach_m };
    let similarity = field.fitted(false)?;
    if ties.len() >= 2 * LEAST_TIES
        && let Some(affine) = field.fitted(true)
        && let Some(common) = affine.common(&field)
    {
        let cost = |fitted: &Fitted| field.cost(&fitted.parameters, affine.sigma_m);
        // The likelihood ratio: costs are half of sums of squares in standard deviations.
        if 2.0 * (cost(&similarity) - cost(&affine)) > STRETCH_TEST * common.design {
            return affine.accuracy(&field);
        }
    }
    similarity.accuracy(&field)
}

/// Places of a field.
struct Field<'a> {
    ties: &'a [MapTie],
    centre_m: [f64; 2],
    reach_m: f64,
}

/// What was found.
struct Fitted {
    parameters: [f64; 6],
    covariance: Vec<f64>,
    sigma_m: f64,
}

/// What neighbouring places have in common.
struct Common {
    ties: usize,
    deformation_m: f64,
    design: f64,
}

impl Field<'_> {
    fn local(&self, at: [f64; 2]) -> [f64; 2] {
        [at[0] - self.centre_m[0], at[1] - self.centre_m[1]]
    }

    fn place(&self, tie: &MapTie, sigma_m: f64) -> Place {
        let (from_m, to_m) = (self.local(tie.from_m), self.local(tie.to_m));
        Place { from_m, to_m, reach_m: self.reach_m, sigma_m }
    }

    /// With or without the stretch.
    fn fitted(&self, stretches: bool) -> Option<Fitted> {
        let shift = |k: usize| self.ties.iter().map(move |t| t.to_m[k] - t.from_m[k]);
        let middle = [0, 1].map(|k| median(shift(k)).unwrap_or(0.0));
        let mut parameters = [middle[0], middle[1], 0.0, 0.0, 0.0, 0.0];
        let mut sigma_m = self.spread(&parameters);
        let mut covariance = Vec::new();
        for _ in 0..ROUNDS {
            let mut problem = Problem::new();
            let block = problem.block("transform", Euclidean(6), &parameters).ok()?;
            if !stretches {
                problem.fix_entries(block, &[4, 5]).ok()?;
            }
            let places = self.ties.iter().map(|tie| ([block], self.place(tie, sigma_m)));
            problem.add("places", Loss::Cauchy(CAUCHY_SCALE), Residuals::new(places)).ok()?;
            let mut x = problem.start();
            nlls::solve(&problem, &mut x, &Options::default(), STEPS as u64).ok()?;
            parameters = problem.values(&x, block).try_into().ok()?;
            covariance = Covariance::new(&problem, &x, LinearSolver::Dense).ok()?.block(block);
            sigma_m = self.spread(&parameters);
        }
        Some(Fitted { parameters, covariance, sigma_m })
    }

    fn residual(&self, tie: &MapTie, p: &[f64; 6]) -> [f64; 2] {
        self.place(tie, 1.0).evaluate((*p,)).unwrap_or([f64::NAN; 2])
    }

    /// The cost at this scatter.
    fn cost(&self, p: &[f64; 6], sigma_m: f64) -> f64 {
        let loss = Loss::Cauchy(CAUCHY_SCALE);
        let costs = self.ties.iter().map(|tie| {
            let [x, y] = self.residual(tie, p);
            0.5 * loss.evaluate((x * x + y * y) / (sigma_m * sigma_m)).value
        });
        costs.sum()
    }

    /// Standard deviation of a coordinate from the median length: 1.1774 standard deviations in the plane.
    fn spread(&self, p: &[f64; 6]) -> f64 {
        let lengths = self.ties.iter().map(|tie| {
            let [x, y] = self.residual(tie, p);
            x.hypot(y)
        });
        sigma_of_distances(lengths).unwrap_or(0.0).max(1e-6 * self.reach_m)
    }
}

impl Fitted {
    /// `None` where no cell of the field has enough places.
    fn common(&self, field: &Field<'_>) -> Option<Common> {
        let mut cells: BTreeMap<[i64; 2], (f64, [f64; 2])> = BTreeMap::new();
        let cell_m = 2.0 * field.reach_m / CELLS;
        let mut ties = 0;
        for tie in field.ties {
            let off = field.residual(tie, &self.parameters);
            if off[0].hypot(off[1]) < CAUCHY_SCALE * self.sigma_m {
                ties += 1;
                let cell = field.local(tie.from_m).map(|d| (d / cell_m).floor() as i64);
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
        let variance = self.sigma_m * self.sigma_m;
        let independent = full().map(|(n, _)| 2.0 * variance / n).sum::<f64>() / count;
        let design = (deformation_m * deformation_m / independent.max(1e-18)).max(1.0);
        Some(Common { ties, deformation_m, design })
    }

    fn accuracy(&self, field: &Field<'_>) -> Option<MapFit> {
        let common = self.common(field)?;
        // Of a coordinate with this gradient by the parameters.
        let at = |gradient: [f64; 6]| {
            let c = &self.covariance;
            let row = |i: usize| (0..6).map(move |j| c[6 * i + j] * gradient[j]).sum::<f64>();
            let sum: f64 = (0..6).map(|i| gradient[i] * row(i)).sum();
            (sum * common.design).max(0.0).sqrt()
        };
        let place =
            |dx: f64, dy: f64| at([1.0, 0.0, dx, -dy, dx, dy]).max(at([0.0, 1.0, dy, dx, -dy, dx]));
        let [east, north, scale, rotation, p, q] = self.parameters;
        let share = |metres: f64| metres / field.reach_m;
        Some(MapFit {
            transform: MapTransform {
                centre_m: field.centre_m,
                shift_m: [east, north],
                scale: share(scale),
                rotation: share(rotation),
                stretch: [share(p), share(q)],
            },
            ties: common.ties,
            scatter_m: self.sigma_m,
            deformation_m: common.deformation_m,
            middle_sigma_m: place(0.0, 0.0),
            edge_sigma_m: place(1.0, 0.0).max(place(0.0, 1.0)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    const TRUTH: MapTransform = MapTransform {
        centre_m: [500_010.0, 4_480_020.0],
        shift_m: [0.42, -0.31],
        scale: 0.002,
        rotation: -0.004,
        stretch: [0.0; 2],
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
    fn a_transform_and_its_inverse_cancel() {
        let at = [500_003.0, 4_480_031.0];
        for transform in [TRUTH, MapTransform { stretch: [0.05, -0.02], ..TRUTH }] {
            let back = transform.invert(transform.apply(at));
            assert!((back[0] - at[0]).abs() < 1e-9 && (back[1] - at[1]).abs() < 1e-9);
        }
        assert_eq!(MapTransform::IDENTITY.apply(at), at);
    }

    #[test]
    fn gross_errors_do_not_count_and_the_accuracy_is_what_it_says() {
        let edge = [500_020.0, 4_480_000.0];
        let (mut squares, mut stated) = (0.0, 0.0);
        for seed in 0..40 {
            let fit = fit(&ties(seed, 300, 0.01, 0.2)).unwrap();
            assert!((0.009..0.017).contains(&fit.scatter_m), "{fit:?}");
            let (found, truth) = (fit.transform.apply(edge), TRUTH.apply(edge));
            squares += 0.5 * ((found[0] - truth[0]).powi(2) + (found[1] - truth[1]).powi(2));
            stated += fit.edge_sigma_m.powi(2);
        }
        // 80 squares have a relative standard deviation of 16 %, so their root is within a quarter at three of them. What is
        // stated is on the safe side: gross errors widen the median by a fifth, and weights and cells add as much.
        let ratio = (squares / stated).sqrt();
        assert!((0.45..1.25).contains(&ratio), "{ratio}");
    }

    #[test]
    fn a_stretch_is_found_where_there_is_one() {
        let mut found = 0;
        for seed in 0..40 {
            let fit = fit(&ties(seed, 300, 0.01, 0.2)).unwrap();
            found += usize::from(fit.transform.stretch != [0.0; 2]);
        }
        // One in a hundred by chance.
        assert!(found <= 3, "{found} of 40 similarities were taken for affine maps");
        let truth = MapTransform { stretch: [0.002, -0.001], ..TRUTH };
        let mut stretched = ties(1, 300, 0.01, 0.2);
        for tie in &mut stretched {
            let (was, is) = (TRUTH.apply(tie.from_m), truth.apply(tie.from_m));
            tie.to_m = [0, 1].map(|k| tie.to_m[k] + is[k] - was[k]);
        }
        let fit = fit(&stretched).unwrap();
        for corner in [[500_000.0, 4_480_000.0], [500_020.0, 4_480_040.0]] {
            let (found, truth) = (fit.transform.apply(corner), truth.apply(corner));
            let off = (found[0] - truth[0]).hypot(found[1] - truth[1]);
            assert!(off < 4.0 * fit.edge_sigma_m && off < 0.01, "{off} m: {fit:?}");
        }
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
