//! One pair: a minimal solver in sampling, then refinement and removal of outliers.

use super::{
    Correspondence, RelativePose,
    coplanarity::{self, Band},
    five_point, pose_of_essential,
    sample::{Samples, Sampling, sample},
    sampson_squared, two_point,
};
use nalgebra::Matrix3;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// Which minimal solver.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Solver {
    /// Nadir photos from nearly the same height: two correspondences.
    TwoPoint,
    /// Any two photos: five.
    FivePoint,
    /// Whichever explains more of a pair.
    #[default]
    Auto,
}

rowgram_base::choices!(Solver: Auto, TwoPoint, FivePoint);

/// How a pair is oriented.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RelativePoseOptions {
    /// Which minimal solver.
    pub solver: Solver,
    /// Distance from co-planarity up to which a correspondence is an inlier, in the plane `z = -1`.
    pub tolerance: f64,
    /// Probability of a sample without outliers.
    pub confidence: f64,
    /// The most samples of each solver.
    pub max_samples: usize,
    /// A pair with fewer inliers is none.
    pub min_inliers: usize,
}

impl Default for RelativePoseOptions {
    fn default() -> RelativePoseOptions {
        RelativePoseOptions {
            solver: Solver::Auto,
            tolerance: 2e-3,
            confidence: 0.9999,
            max_samples: 3000,
            min_inliers: 15,
        }
    }
}

/// How much more a two-point hypothesis may be off, because photos are tilted a little.
const TWO_POINT_COARSE: f64 = 12.0;
/// The share of the x-parallax by which a correspondence may differ from the others while two
/// points are sampled: relief, slopes and the tilt that is not yet known.
const PARALLAX_SHARE: f64 = 0.15;
/// Robust standard deviations of the x-parallax of a two-point pair.
const BAND_SIGMAS: f64 = 6.0;
/// The share of the x-parallax that relief may take at least.
const RELIEF_SHARE: f64 = 0.25;

/// An oriented pair.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimated {
    /// The orientation.
    pub pose: RelativePose,
    /// Places of the correspondences that fit, ascending.
    pub inliers: Vec<u32>,
    /// Which solver found it; never [`Solver::Auto`].
    pub solver: Solver,
    /// Samples drawn by all solvers that were tried.
    pub samples: usize,
    /// Mean of `1 - d^2 / t^2` over the inliers times their number.
    pub score: f64,
}

/// What two points say, and what the flight's nearly constant height says of all the others: in the
/// normalised geometry of the pair they have nearly the same x-parallax. Matches that are rows and
/// plants off agree with many an epipolar geometry, but not in their parallaxes.
struct TwoPoint<'a> {
    correspondences: &'a [Correspondence],
    /// Distances beyond this are not looked at any closer.
    squared_reach: f64,
}

struct FivePoint<'a>(&'a [Correspondence]);

/// A two-point hypothesis.
#[derive(Clone)]
struct Level {
    pose: RelativePose,
    essential: Matrix3<f64>,
    /// The turns into the normalised geometry and the x-parallax there.
    parallax: Option<([Matrix3<f64>; 2], f64)>,
}

impl TwoPoint<'_> {
    fn parallax(&self, turns: &[Matrix3<f64>; 2], datum: usize) -> Option<f64> {
        let [a, b] = coplanarity::rectified(turns, &self.correspondences[datum])?;
        Some(a[0] - b[0])
    }

    /// A pose with the middle of the parallaxes of some data.
    fn level(&self, pose: RelativePose, data: impl Iterator<Item = usize>) -> Level {
        let parallax = coplanarity::rectification(&pose).and_then(|turns| {
            let mut all: Vec<f64> = data.filter_map(|k| self.parallax(&turns, k)).collect();
            all.sort_by(f64::total_cmp);
            let middle = 0.5 * (all.get(all.len() / 2)? + all.get((all.len() - 1) / 2)?);
            Some((turns, middle))
        });
        Level { pose, essential: pose.essential(), parallax }
    }
}

impl Samples for TwoPoint<'_> {
    type Model = Level;
    const SIZE: usize = 2;

    fn count(&self) -> usize {
        self.correspondences.len()
    }

    fn solve(&self, sample: &[usize], out: &mut Vec<Self::Model>) {
        let mut poses = Vec::with_capacity(2);
        let [a, b] = [sample[0], sample[1]].map(|k| &self.correspondences[k]);
        two_point::solve(a, b, &mut poses);
        out.extend(poses.into_iter().map(|pose| self.level(pose, sample.iter().copied())));
    }

    fn squared_distance(&self, model: &Self::Model, datum: usize) -> f64 {
        let squared = sampson_squared(&model.essential, &self.correspondences[datum]);
        if squared > self.squared_reach {
            return squared;
        }
        let Some((turns, middle)) = &model.parallax else { return squared };
        let fits = self
            .parallax(turns, datum)
            .is_some_and(|p| (p - middle).abs() <= PARALLAX_SHARE * middle.abs());
        if fits { squared } else { f64::INFINITY }
    }

    fn refine(&self, model: &Self::Model, squared_tolerance: f64) -> Option<Self::Model> {
        let near: Vec<usize> = (0..self.count())
            .filter(|&k| self.squared_distance(model, k) <= squared_tolerance)
            .collect();
        let inside: Vec<Correspondence> = near.iter().map(|&k| self.correspondences[k]).collect();
        let pose = coplanarity::refine(&model.pose, &inside, 4.0 * squared_tolerance, 3)?;
        Some(self.level(pose, near.into_iter()))
    }
}

impl Samples for FivePoint<'_> {
    type Model = (Option<RelativePose>, Matrix3<f64>);
    const SIZE: usize = 5;

    fn count(&self) -> usize {
        self.0.len()
    }

    fn solve(&self, sample: &[usize], out: &mut Vec<Self::Model>) {
        let mut matrices = Vec::with_capacity(10);
        five_point::solve(std::array::from_fn(|k| &self.0[sample[k]]), &mut matrices);
        out.extend(matrices.into_iter().map(|e| (None, e)));
    }

    fn squared_distance(&self, model: &Self::Model, datum: usize) -> f64 {
        sampson_squared(&model.1, &self.0[datum])
    }

    fn refine(&self, model: &Self::Model, squared_tolerance: f64) -> Option<Self::Model> {
        let start = match model.0 {
            Some(pose) => pose,
            None => {
                let near: Vec<u32> = (0..self.0.len() as u32)
                    .filter(|&k| {
                        sampson_squared(&model.1, &self.0[k as usize]) <= squared_tolerance
                    })
                    .collect();
                pose_of_essential(&model.1, self.0, &near)?
            }
        };
        let pose = coplanarity::refine(&start, self.0, squared_tolerance, 3)?;
        Some((Some(pose), pose.essential()))
    }
}

/// Orients a pair; `None` where fewer than the wanted number of correspondences agree on anything.
pub fn estimate(
    correspondences: &[Correspondence],
    options: &RelativePoseOptions,
    seed: u64,
) -> Option<Estimated> {
    let two = || two(correspondences, options, &mut ChaCha8Rng::seed_from_u64(seed));
    let five = || five(correspondences, options, &mut ChaCha8Rng::seed_from_u64(seed ^ 5));
    let found = match options.solver {
        Solver::TwoPoint => two(),
        Solver::FivePoint => five(),
        Solver::Auto => match two() {
            // Nearly all of what matched: nothing is left to explain better.
            Some(found) if found.score > 0.75 * correspondences.len() as f64 => Some(found),
            first => match (first, five()) {
                (Some(a), Some(mut b)) => {
                    b.samples += a.samples;
                    // What needs less to explain as much is the better explanation.
                    Some(if b.score > 1.1 * a.score { b } else { a })
                }
                (a, b) => a.or(b),
            },
        },
    };
    found.filter(|found| found.inliers.len() >= options.min_inliers)
}

fn two(
    correspondences: &[Correspondence],
    options: &RelativePoseOptions,
    rng: &mut ChaCha8Rng,
) -> Option<Estimated> {
    let sampling = Sampling {
        tolerance: options.tolerance,
        coarse: TWO_POINT_COARSE,
        confidence: options.confidence,
        least: 20,
        most: options.max_samples,
    };
    let data =
        TwoPoint { correspondences, squared_reach: (options.tolerance * TWO_POINT_COARSE).powi(2) };
    let found = sample(&data, &sampling, rng)?;
    let pose = in_front(found.model.pose, correspondences, &found.inliers);
    let band = Band { tolerance: options.tolerance, sigmas: BAND_SIGMAS, min_share: RELIEF_SHARE };
    finish(pose, correspondences, &band, Solver::TwoPoint, found.samples)
}

fn five(
    correspondences: &[Correspondence],
    options: &RelativePoseOptions,
    rng: &mut ChaCha8Rng,
) -> Option<Estimated> {
    let sampling = Sampling {
        tolerance: options.tolerance,
        coarse: 1.0,
        confidence: options.confidence,
        least: 20,
        most: options.max_samples,
    };
    let found = sample(&FivePoint(correspondences), &sampling, rng)?;
    let pose = match found.model.0 {
        Some(pose) => in_front(pose, correspondences, &found.inliers),
        None => pose_of_essential(&found.model.1, correspondences, &found.inliers)?,
    };
    let band =
        Band { tolerance: options.tolerance, sigmas: f64::INFINITY, min_share: f64::INFINITY };
    finish(pose, correspondences, &band, Solver::FivePoint, found.samples)
}

fn finish(
    pose: RelativePose,
    correspondences: &[Correspondence],
    band: &Band,
    solver: Solver,
    samples: usize,
) -> Option<Estimated> {
    let (pose, inliers) = coplanarity::settle(&pose, correspondences, band, 10)?;
    let e = pose.essential();
    let squared = band.tolerance * band.tolerance;
    let score = inliers
        .iter()
        .map(|&k| 1.0 - sampson_squared(&e, &correspondences[k as usize]) / squared)
        .sum();
    Some(Estimated { pose, inliers, solver, samples, score })
}

/// The baseline with the sign that puts most points in front of both cameras.
fn in_front(
    pose: RelativePose,
    correspondences: &[Correspondence],
    inliers: &[u32],
) -> RelativePose {
    let other = RelativePose { translation: -pose.translation, ..pose };
    let front = |pose: &RelativePose| {
        inliers.iter().filter(|&&k| pose.in_front(&correspondences[k as usize])).count()
    };
    if front(&other) > front(&pose) { other } else { pose }
}
