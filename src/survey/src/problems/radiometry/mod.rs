//! Radiometric block adjustment: exposure and white balance of photos, vignetting of cameras, light of flights.
//!
//! ```text
//! log x_pic = L_pc + g_ic + k_1 r^2 + k_2 r^4 + k_3 r^6 + a . s + d_1 (s_x^2 - s_y^2) + 2 d_2 s_x s_y
//! ```
//!
//! `x_pic` is the linear light (the sRGB curve undone, 1 at saturation) of ground point `p` in channel `c` of photo `i`, a mean
//! over a small window; `L_pc` the point's own light; `g_ic` the photo's log gain (exposure and white balance). `r` is the distance
//! from the principal point over half the diagonal of the photo, `k` the vignetting of its camera. `s` is the horizontal part (east,
//! north) of the pixel's ray at unit depth: what ground facing the sun sends to the camera changes with it, in first order by `a`,
//! and in second order differently along the sun and across it by `d`; the part of second order that is alike in all directions
//! cannot be told from vignetting and is there. `k`, `a`, `d` are the same in all channels, so no index of colours changes within a
//! photo. Channels enter by the orthonormal combinations `(r + g + b)/sqrt 3, (r - b)/sqrt 2, (r + b - 2 g)/sqrt 6`, whose errors are
//! nearly independent.
//!
//! Observations cannot tell a slope of `L` over the map from `a` with gains that follow the camera's place. Priors do, as far as light
//! and direction of view can be told apart at all: strips to and fro tell them apart along the strips, nothing does across them.
//!
//! ```text
//! g_i0 - sqrt(3) e_i - l_i ~ N(0, t_0^2),   l_i+1 - l_i ~ N(0, w^2),   g_i1, g_i2 ~ N(0, t_1^2), N(0, t_2^2)
//! ```
//!
//! with `e_i` the log exposure that the camera reports (0 without) and `l_i` the light, a random walk along the flight; `t`, `w` and the
//! standard deviations of the observations are estimated from the solution before. The gauge, a gain of all photos, is fixed by
//! `sum_i n_i g_i = 0`, `n_i` the number of observations of a photo: mean colours stay. The sum is carried photo by photo in blocks
//! of its own, so that the system stays sparse. Reference: M. Brown and D. G. Lowe, *Automatic panoramic image stitching using
//! invariant features*, 2007 (gains); D. B. Goldman, *Vignette and exposure calibration and compensation*, 2010 (even polynomial).

mod factors;
#[cfg(test)]
mod tests;

use factors::{Chain, Light, PhotoPrior, Walk, shape_priors};
use nalgebra::{Matrix2, Vector2};
use rowgram_optim::robust::sigma_of_errors;
use rowgram_optim::{
    engine::SolveError,
    nlls::{
        self, BlockId, Euclidean, Factors, LinearSolver, Loss, Options, Problem,
        covariance::Covariance,
    },
};

/// Coefficients of the vignetting: of `r^2`, `r^4`, `r^6`.
pub const RADIAL: usize = 3;
/// Coefficients of the direction of view: east, north, along less across, diagonal.
pub const DIRECTION: usize = 4;

/// A ground point in a photo.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// Index of the point.
    pub point: u32,
    /// Index of the photo.
    pub photo: u32,
    /// Natural logarithm of the linear light, red, green, blue.
    pub log_light: [f64; 3],
    /// `r^2`.
    pub radius2: f64,
    /// `s`: east and north.
    pub direction: [f64; 2],
}

/// A photo as far as light is concerned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Photo {
    /// Index of its camera.
    pub camera: usize,
    /// Where it was taken, east and north, in any unit.
    pub place: [f64; 2],
    /// Natural logarithm of the exposure that the camera reports (time, aperture and sensitivity), any zero; `None` where it
    /// reports none.
    pub log_exposure: Option<f64>,
}

/// Light in photos of one block.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RadiometricBlock {
    /// In the order in which they were taken.
    pub photos: Vec<Photo>,
    /// Number of cameras.
    pub cameras: usize,
    /// Number of points.
    pub points: usize,
    /// Observations, of each point those of two photos at least.
    pub observations: Vec<Observation>,
}

/// A value with its standard deviation, for several numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate<const N: usize> {
    /// The values.
    pub value: [f64; N],
    /// Their standard deviations.
    pub sigma: [f64; N],
}

/// What the adjustment finds.
#[derive(Debug, Clone, PartialEq)]
pub struct RadiometricSolution {
    /// Log gain of each photo: red, green, blue. Their mean, weighted by observations, is 0.
    pub log_gains: Vec<Estimate<3>>,
    /// Vignetting of each camera.
    pub vignetting: Vec<Estimate<RADIAL>>,
    /// Dependence on the direction of view, of each camera's flight.
    pub direction: Vec<Estimate<DIRECTION>>,
    /// Standard deviation of an observation: of the mean of the channels, and of the two differences.
    pub sigma: [f64; 3],
    /// Share of the observations whose residual is so large that the loss reduces its weight.
    pub downweighted: f64,
    /// Iterations of the engine, all rounds together.
    pub iterations: u64,
}

/// The three orthonormal combinations of channels.
const BASIS: [[f64; 3]; 3] = {
    const A: f64 = 0.577_350_269_189_625_8;
    const B: f64 = std::f64::consts::FRAC_1_SQRT_2;
    const C: f64 = 0.408_248_290_463_863;
    [[A, A, A], [B, 0.0, -B], [C, -2.0 * C, C]]
};
const SQRT_3: f64 = 1.732_050_807_568_877_2;

/// Standard deviations before anything is known: of observations, and of priors; log of light.
const START_SIGMA: [f64; 3] = [0.05, 0.02, 0.02];
const START: Spread = Spread { exposure: 0.1, chroma: [0.1; 2], walk: 0.03 };
/// No spread is estimated smaller: a thousandth of the light is less than a grey value.
const LEAST_SPREAD: f64 = 1e-3;
/// The light of a flight changes by a twentieth at least, as far as anybody knows: the least standard deviation of its logarithm from the
/// first photo to the last.
const LEAST_DRIFT: f64 = 0.05;
/// Standard deviations of the coefficients of vignetting (a lens loses a third of its light in the corners, some two thirds) and of
/// the direction of view (maize at 45 degrees towards the sun is 20 to 40 % darker than away from it).
const RADIAL_SIGMA: f64 = 0.5;
const DIRECTION_SIGMA: f64 = 0.1;
/// Huber's constant for the length of a residual of three numbers: a tenth of normal ones are longer.
const HUBER: f64 = 2.5;
/// Rounds: spreads of observations and priors are estimated after each but the last.
const ROUNDS: usize = 4;
const MAX_ITERATIONS: u64 = 50;

/// Spreads of the priors.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Spread {
    exposure: f64,
    chroma: [f64; 2],
    walk: f64,
}

/// The combinations of three channels.
fn combined(rgb: [f64; 3]) -> [f64; 3] {
    BASIS.map(|row| row[0] * rgb[0] + row[1] * rgb[1] + row[2] * rgb[2])
}

/// Channels from their combinations.
fn channels(of: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|c| (0..3).map(|k| BASIS[k][c] * of[k]).sum())
}

/// The terms of the vignetting.
pub fn radial_terms(radius2: f64) -> [f64; RADIAL] {
    [radius2, radius2 * radius2, radius2 * radius2 * radius2]
}

/// The terms of the direction of view.
pub fn direction_terms([x, y]: [f64; 2]) -> [f64; DIRECTION] {
    [x, y, x * x - y * y, 2.0 * x * y]
}

/// A problem with its blocks.
struct Posed {
    problem: Problem,
    photos: Vec<BlockId>,
    vignetting: Vec<BlockId>,
    direction: Vec<BlockId>,
}

impl RadiometricBlock {
    /// Estimates gains, vignetting and dependence on the direction of view.
    ///
    /// # Errors
    /// Where there is no observation, or the engine cannot solve the system.
    pub fn adjust(&self) -> Result<RadiometricSolution, SolveError> {
        if self.observations.is_empty() || self.photos.is_empty() {
            return Err(SolveError::Misuse("no two photos show the same ground".into()));
        }
        let exposures = self.exposures();
        let (mut sigma, mut spread) = (START_SIGMA, START);
        let mut start: Option<Vec<f64>> = None;
        let mut iterations = 0;
        for round in 0.. {
            let posed = self.pose(&exposures, sigma, spread)?;
            let mut x = start.take().unwrap_or_else(|| posed.problem.start());
            // Steps are exact where no weight changes.
            let options = Options { initial_damping: 1e-9, ..Options::default() };
            iterations += nlls::solve(&posed.problem, &mut x, &options, MAX_ITERATIONS)?.iterations;
            let residuals = posed.problem.residuals(&x, "light")?;
            if round + 1 == ROUNDS {
                return self.solution(&posed, &x, (sigma, &residuals), iterations);
            }
            sigma = self.spread_of_residuals(&residuals, sigma);
            let found = self.spread_of_photos(&posed, &x, &exposures);
            // Later rounds would take a drift across the strips for the direction of view, and then find no drift.
            let walk = if round == 0 { found.walk } else { spread.walk };
            spread = Spread { walk, ..found };
            start = Some(x);
        }
        Err(SolveError::Misuse("no round was made".into()))
    }

    /// Reported log exposures, less their mean over those that report one; 0 for the others.
    fn exposures(&self) -> Vec<f64> {
        let known: Vec<f64> = self.photos.iter().filter_map(|photo| photo.log_exposure).collect();
        let mean = known.iter().sum::<f64>() / known.len().max(1) as f64;
        self.photos.iter().map(|photo| photo.log_exposure.map_or(0.0, |e| e - mean)).collect()
    }

    fn pose(
        &self,
        exposures: &[f64],
        sigma: [f64; 3],
        spread: Spread,
    ) -> Result<Posed, SolveError> {
        let mut problem = Problem::new();
        let mut blocks = |kind: &str, count: usize, of: &dyn Fn(usize) -> Vec<f64>| {
            (0..count)
                .map(|k| {
                    let values = of(k);
                    problem.block(kind, Euclidean(values.len()), &values)
                })
                .collect::<Result<Vec<BlockId>, SolveError>>()
        };
        let n = self.photos.len();
        let photos = blocks("photo", n, &|k| vec![SQRT_3 * exposures[k], 0.0, 0.0, 0.0])?;
        let vignetting = blocks("vignetting", self.cameras, &|_| vec![0.0; RADIAL])?;
        let direction = blocks("direction of view", self.cameras, &|_| vec![0.0; DIRECTION])?;
        let sums = blocks("sum of gains", n + 1, &|_| vec![0.0; 3])?;
        // Each point begins with the light of its first observation.
        let mut first = vec![[0.0; 3]; self.points];
        for seen in self.observations.iter().rev() {
            first[seen.point as usize] = combined(seen.log_light);
        }
        let points = blocks("point", self.points, &|k| first[k].to_vec())?;
        points.iter().for_each(|&point| problem.eliminate(point));
        problem.fix(sums[0]);
        problem.fix(sums[n]);
        let mut count = vec![0.0; n];
        for seen in &self.observations {
            count[seen.photo as usize] += 1.0;
        }
        let mean = self.observations.len() as f64 / n as f64;
        let light = self.observations.iter().map(|seen| {
            let photo = seen.photo as usize;
            let camera = self.photos[photo].camera;
            Light {
                blocks: [
                    photos[photo],
                    vignetting[camera],
                    direction[camera],
                    points[seen.point as usize],
                ],
                value: combined(seen.log_light),
                radial: radial_terms(seen.radius2).map(|t| SQRT_3 * t),
                direction: direction_terms(seen.direction).map(|t| SQRT_3 * t),
                inverse_sigma: sigma.map(|s| 1.0 / s),
            }
        });
        problem.add("light", Loss::Huber(HUBER), Factors(light.collect()))?;
        let priors = (0..n).map(|k| PhotoPrior {
            blocks: [photos[k]],
            exposure: SQRT_3 * exposures[k],
            inverse_sigma: [spread.exposure, spread.chroma[0], spread.chroma[1]].map(|s| 1.0 / s),
        });
        problem.add("gains", Loss::Trivial, Factors(priors.collect()))?;
        // The light of flights of different cameras has nothing in common.
        let walks: Vec<Walk> = (0..self.cameras)
            .flat_map(|camera| {
                let of: Vec<usize> = (0..n).filter(|&k| self.photos[k].camera == camera).collect();
                of.windows(2)
                    .map(|pair| Walk {
                        blocks: [photos[pair[0]], photos[pair[1]]],
                        inverse_sigma: 1.0 / spread.walk,
                    })
                    .collect::<Vec<_>>()
            })
            .collect();
        if !walks.is_empty() {
            problem.add("light of the flight", Loss::Trivial, Factors(walks))?;
        }
        let lens = shape_priors(&problem, &vignetting, RADIAL_SIGMA)?;
        problem.add("vignetting", Loss::Trivial, lens)?;
        let view = shape_priors(&problem, &direction, DIRECTION_SIGMA)?;
        problem.add("direction of view", Loss::Trivial, view)?;
        let chain = (0..n)
            .map(|k| Chain { blocks: [photos[k], sums[k], sums[k + 1]], weight: count[k] / mean });
        problem.add("mean of gains", Loss::Trivial, Factors(chain.collect()))?;
        Ok(Posed { problem, photos, vignetting, direction })
    }

    /// Standard deviations of observations from their whitened residuals: 1.48 times the median of the absolute values, and the
    /// share of the unknowns back.
    fn spread_of_residuals(&self, residuals: &[f64], sigma: [f64; 3]) -> [f64; 3] {
        let unknowns = (self.points + self.photos.len()) as f64;
        let count = self.observations.len() as f64;
        let redundancy = ((count - unknowns) / count).max(0.1);
        std::array::from_fn(|k| {
            let whitened = residuals.iter().skip(k).step_by(3).copied();
            (sigma_of_errors(whitened).unwrap_or(0.0) * sigma[k] / redundancy.sqrt())
                .max(LEAST_SPREAD)
        })
    }

    /// Spreads of gains: a white part and a random walk, by the mean squares of differences of photos `m` apart, `m w^2 + 2 t^2`, for
    /// `m` of 1 and of a quarter of the flight: what is that slow stands out there from what is not. A slope of the gains over the map
    /// is what observations do not determine, and tells nothing of the spread: it is taken off first.
    fn spread_of_photos(&self, posed: &Posed, x: &[f64], exposures: &[f64]) -> Spread {
        let gain = |k: usize| posed.problem.values(x, posed.photos[k]);
        let (mut near, mut far, mut apart) = ([0.0, 0.0f64], [0.0, 0.0f64], 0.0);
        for camera in 0..self.cameras {
            let of: Vec<([f64; 2], f64)> = (0..self.photos.len())
                .filter(|&k| self.photos[k].camera == camera)
                .map(|k| (self.photos[k].place, gain(k)[0] - SQRT_3 * exposures[k]))
                .collect();
            let of = without_slope(&of);
            let quarter = of.len() / 4;
            if quarter < 2 {
                continue;
            }
            for (lag, [squares, n]) in [(1, &mut near), (quarter, &mut far)] {
                *squares += (lag..of.len()).map(|k| (of[k] - of[k - lag]).powi(2)).sum::<f64>();
                *n += (of.len() - lag) as f64;
                apart += if lag > 1 { lag as f64 * (of.len() - lag) as f64 } else { 0.0 };
            }
        }
        let root = |variance: f64| variance.max(LEAST_SPREAD * LEAST_SPREAD).sqrt();
        let chroma = |c: usize| {
            let all = (0..self.photos.len()).map(|k| gain(k)[c].powi(2));
            root(all.sum::<f64>() / self.photos.len() as f64)
        };
        // A few photos tell nothing of how light goes on.
        if far[1] == 0.0 {
            return Spread { chroma: [chroma(1), chroma(2)], ..START };
        }
        let (near, apart, far) = (near[0] / near[1], apart / far[1], far[0] / far[1]);
        let walk = ((far - near) / (apart - 1.0)).clamp(0.0, near);
        Spread {
            exposure: root(0.5 * (near - walk)),
            walk: root(walk).max(SQRT_3 * LEAST_DRIFT / (self.photos.len() as f64).sqrt()),
            chroma: [chroma(1), chroma(2)],
        }
    }

    fn solution(
        &self,
        posed: &Posed,
        x: &[f64],
        (sigma, residuals): ([f64; 3], &[f64]),
        iterations: u64,
    ) -> Result<RadiometricSolution, SolveError> {
        let Posed { problem, photos, vignetting, direction } = posed;
        let covariance = Covariance::new(problem, x, LinearSolver::Schur)?;
        let inverse = covariance.selected_inverse();
        let of = |block: BlockId| {
            inverse.cross(block, block).ok_or_else(|| {
                SolveError::RankDeficient(format!("{} has no covariance", problem.describe(block)))
            })
        };
        let log_gains = photos.iter().map(|&photo| {
            let (values, c) = (problem.values(x, photo), of(photo)?);
            let variance = |channel: usize| -> f64 {
                (0..9)
                    .map(|n| {
                        let (i, j) = (n / 3, n % 3);
                        BASIS[i][channel] * c[4 * i + j] * BASIS[j][channel]
                    })
                    .sum()
            };
            Ok(Estimate {
                value: channels([values[0], values[1], values[2]]),
                sigma: [0, 1, 2].map(|channel| variance(channel).max(0.0).sqrt()),
            })
        });
        let log_gains = log_gains.collect::<Result<Vec<_>, SolveError>>()?;
        let large = |r: &[f64]| r.iter().map(|v| v * v).sum::<f64>() > HUBER * HUBER;
        let downweighted = residuals.as_chunks::<3>().0.iter().filter(|r| large(&r[..])).count();
        Ok(RadiometricSolution {
            log_gains,
            vignetting: shape(problem, x, vignetting, &of)?,
            direction: shape(problem, x, direction, &of)?,
            sigma: [sigma[0] / SQRT_3, sigma[1], sigma[2]],
            downweighted: downweighted as f64 / self.observations.len() as f64,
            iterations,
        })
    }
}

/// Values less the plane that fits them best.
fn without_slope(of: &[([f64; 2], f64)]) -> Vec<f64> {
    let n = of.len().max(1) as f64;
    let mean = [0, 1].map(|k| of.iter().map(|(place, _)| place[k]).sum::<f64>() / n);
    let level = of.iter().map(|(_, value)| value).sum::<f64>() / n;
    let mut normal = Matrix2::zeros();
    let mut right = Vector2::zeros();
    for (place, value) in of {
        let row = Vector2::new(place[0] - mean[0], place[1] - mean[1]);
        normal += row * row.transpose();
        right += row * (value - level);
    }
    // On one line the slope across it is 0.
    let slope = normal.svd(true, true).solve(&right, 1e-6 * normal.trace()).unwrap_or_default();
    of.iter()
        .map(|(p, value)| value - level - slope[0] * (p[0] - mean[0]) - slope[1] * (p[1] - mean[1]))
        .collect()
}

/// Values and standard deviations of blocks of `N` coefficients.
fn shape<const N: usize>(
    problem: &Problem,
    x: &[f64],
    blocks: &[BlockId],
    covariance: &dyn Fn(BlockId) -> Result<Vec<f64>, SolveError>,
) -> Result<Vec<Estimate<N>>, SolveError> {
    let of = |&block: &BlockId| {
        let (values, c) = (problem.values(x, block), covariance(block)?);
        Ok(Estimate {
            value: std::array::from_fn(|k| values[k]),
            sigma: std::array::from_fn(|k| c[k * (N + 1)].max(0.0).sqrt()),
        })
    };
    blocks.iter().map(of).collect()
}
