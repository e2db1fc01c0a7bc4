//! Statistics of an adjustment: variance factor, redundancy numbers, standardised residuals, tests,
//! standard deviations and correlations.
//!
//! With whitened residuals `v` and Jacobian `J`, `C = (J^T J)^-1` is the covariance of the parameters for
//! a variance factor of 1 and `R = I - J C J^T` that of the residuals. The diagonal of `R` holds the
//! redundancy numbers, whose sum is the redundancy `r = n - u`; `sigma_0^2 = v^T v / r`. An observation
//! with block `R_i` and residual `v_i` is tested by `T = v_i^T R_i^-1 v_i`: against chi-square with as many
//! degrees of freedom as `R_i` has (Baarda; for one, `w = sqrt(T)`), or, divided by a variance factor,
//! against Pope's tau distribution.
//!
//! Pope's variance factor is that of the observation's kind, or `sigma_0^2` where that is larger. Tens of
//! thousands of tie points would else decide what a dozen control points may differ by, and where an
//! imperfect lens model leaves more in the control than its standard deviations say, all of it would be
//! rejected point by point instead of the one that is wrong.

use super::tested::LEAST_REDUNDANCY;
pub use super::tested::{GroupStatistics, ObservationRef, OutlierTest, TestedObservation};
use super::{
    accuracy::{ImageAccuracy, InteriorAccuracy, PointAccuracy, array3, image, interior},
    cluster_robust,
    inverse::SelectedInverse,
    problem::{AdjustmentProblem, Group, Settings, measurement},
    rank,
    rays::{prepared, rays},
    reprojection::PreparedImage,
};
use crate::scene::Reconstruction;
use nalgebra::{DMatrix, DVector, SymmetricEigen};
use rayon::prelude::*;
use rowgram_optim::{
    engine::SolveError,
    nlls::{BlockId, LinearSolver, covariance::Covariance},
};
use statrs::distribution::{ChiSquared, ContinuousCDF, FisherSnedecor};
use std::{collections::BTreeMap, sync::Arc};

/// Statistics of an adjustment.
#[derive(Debug, Clone)]
pub struct Statistics {
    /// Numbers observed, `n`.
    pub observations: usize,
    /// Free parameters, `u`.
    pub parameters: usize,
    /// `n - u`.
    pub redundancy: usize,
    /// The a-posteriori standard deviation of unit weight; 1 where nothing is redundant.
    pub sigma0: f64,
    /// Kind by kind.
    pub groups: Vec<GroupStatistics>,
    /// Every observation.
    pub tested: Vec<TestedObservation>,
    /// Every image, in the order of the reconstruction.
    pub images: Vec<ImageAccuracy>,
    /// Every tie point.
    pub points: Vec<PointAccuracy>,
    /// Every ground point that takes part.
    pub ground: Vec<Option<PointAccuracy>>,
    /// Every camera with a free parameter.
    pub interiors: Vec<InteriorAccuracy>,
    /// How many tie points tell as much as one independent one would: by how much neighbouring ones have the same errors.
    /// Covariances of images and points have it in them, tests do not.
    pub design_effect: f64,
    pub(super) inverse: Arc<SelectedInverse>,
    /// The same with tie points of that much larger variances.
    pub(super) clustered: Arc<SelectedInverse>,
}

impl Statistics {
    /// Evaluates the solution `x` of `adjustment`, which was made from `reconstruction` with `settings`.
    ///
    /// # Errors
    /// [`SolveError::RankDeficient`] says which parameters the observations cannot tell apart.
    pub fn new(
        reconstruction: &Reconstruction,
        adjustment: &AdjustmentProblem,
        settings: &Settings,
        x: &[f64],
    ) -> Result<Statistics, SolveError> {
        let mut covariance = Covariance::new(&adjustment.problem, x, LinearSolver::Schur)
            .map_err(|error| rank::explain(reconstruction, adjustment, x, error))?;
        let inverse = Arc::new(SelectedInverse::new(reconstruction, adjustment, &mut covariance)?);
        // As large as the problem itself.
        drop(covariance);
        let mut found = Statistics::with_inverse(reconstruction, adjustment, settings, x, inverse)?;
        let at = (reconstruction, adjustment, settings, x);
        let effect = cluster_robust::widen_by_clusters(
            at,
            &found.inverse,
            found.sigma0,
            &mut found.interiors,
        );
        if effect > LEAST_DESIGN_EFFECT {
            found.spread(reconstruction, adjustment, settings, effect)?;
        }
        Ok(found)
    }

    /// Covariances of images and points as if the variances of tie points were `effect` times as large.
    fn spread(
        &mut self,
        reconstruction: &Reconstruction,
        adjustment: &AdjustmentProblem,
        settings: &Settings,
        effect: f64,
    ) -> Result<(), SolveError> {
        let mut wider = settings.clone();
        wider.sigma_factors[Group::TiePoints as usize] *= effect.sqrt();
        let datum = adjustment.scale_datum();
        let adjustment = &AdjustmentProblem::with_scale_datum(reconstruction, &wider, datum)?;
        let x = &adjustment.problem.start();
        let mut covariance = Covariance::new(&adjustment.problem, x, LinearSolver::Schur)
            .map_err(|error| rank::explain(reconstruction, adjustment, x, error))?;
        let inverse = Arc::new(SelectedInverse::new(reconstruction, adjustment, &mut covariance)?);
        drop(covariance);
        let (_, points) = ties(reconstruction, adjustment, &wider, x, &inverse, false);
        let images = adjustment.images.iter().map(|&block| image(adjustment, x, &inverse, block));
        self.images = images.collect();
        self.points = points;
        self.ground = ground(adjustment, &inverse);
        self.design_effect = effect;
        self.clustered = inverse;
        Ok(())
    }

    /// The same with the covariances of another solution of the same images, lenses and ground
    /// points.
    pub(super) fn with_inverse(
        reconstruction: &Reconstruction,
        adjustment: &AdjustmentProblem,
        settings: &Settings,
        x: &[f64],
        inverse: Arc<SelectedInverse>,
    ) -> Result<Statistics, SolveError> {
        let (mut tested, points) = ties(reconstruction, adjustment, settings, x, &inverse, true);
        // Growing by one would double a vector that may hold a million.
        tested.reserve_exact(adjustment.batches.iter().map(|(_, _, of)| of.len()).sum());
        let mut groups: Vec<GroupStatistics> = Vec::new();
        if !tested.is_empty() {
            groups.push(sum(Group::TiePoints, &tested));
        }
        for (group, name, subjects) in &adjustment.batches {
            let found = others(adjustment, x, &inverse, name)?;
            let mut total =
                GroupStatistics { group: *group, observations: 0, redundancy: 0.0, squares: 0.0 };
            for ((residual, redundancy), &k) in found.into_iter().zip(subjects) {
                total.observations += residual.len();
                total.redundancy += redundancy.trace();
                total.squares += residual.norm_squared();
                let subject = match group {
                    Group::Marks => ObservationRef::Mark(k),
                    Group::Control => ObservationRef::Control(k),
                    Group::Positions => ObservationRef::Position(k),
                    Group::ScaleBars => ObservationRef::ScaleBar(k),
                    Group::TiePoints | Group::Interior | Group::Motion | Group::Orientations => {
                        continue;
                    }
                };
                tested.push(test(*group, subject, &residual, &redundancy));
            }
            match groups.iter_mut().find(|known| known.group == *group) {
                Some(known) => {
                    known.observations += total.observations;
                    known.redundancy += total.redundancy;
                    known.squares += total.squares;
                }
                None => groups.push(total),
            }
        }
        groups.sort_by_key(|group| group.group);
        let observations = adjustment.problem.residual_count();
        let parameters = adjustment.problem.parameter_count();
        let redundancy = observations.saturating_sub(parameters);
        let squares: f64 = groups.iter().map(|group| group.squares).sum();
        let sigma0 = if redundancy > 0 { (squares / redundancy as f64).sqrt() } else { 1.0 };
        Ok(Statistics {
            observations,
            parameters,
            redundancy,
            sigma0,
            groups,
            tested,
            images: adjustment
                .images
                .iter()
                .map(|&block| image(adjustment, x, &inverse, block))
                .collect(),
            points,
            ground: ground(adjustment, &inverse),
            interiors: (0..reconstruction.cameras.len())
                .filter_map(|camera| interior(reconstruction, adjustment, &inverse, camera))
                .collect(),
            design_effect: 1.0,
            clustered: inverse.clone(),
            inverse,
        })
    }

    /// The variance factor that Pope's test takes for a kind, and its redundancy: the largest of that
    /// of all observations, of the kind, and of everything on the ground for marks, control points
    /// and scale bars, because an error of a point shows in all of these.
    fn scale(&self, group: Group) -> (f64, f64) {
        const GROUND: [Group; 3] = [Group::Marks, Group::Control, Group::ScaleBars];
        let mut most = (self.sigma0 * self.sigma0, self.redundancy as f64);
        let ground: &[Group] = if GROUND.contains(&group) { &GROUND } else { &[] };
        for together in [&[group], ground] {
            let members = self.groups.iter().filter(|member| together.contains(&member.group));
            let (squares, redundancy) = members.fold((0.0, 0.0), |sum, member| {
                (sum.0 + member.squares, sum.1 + member.redundancy)
            });
            if redundancy >= LEAST_FOR_A_FACTOR && squares / redundancy > most.0 {
                most = (squares / redundancy, redundancy);
            }
        }
        most
    }

    /// What the test value of an observation of a kind with `freedom` degrees of freedom may be, at
    /// `significance`.
    pub fn critical(
        &self,
        testing: OutlierTest,
        group: Group,
        freedom: usize,
        significance: f64,
    ) -> f64 {
        let q = freedom as f64;
        match testing {
            OutlierTest::Baarda => {
                ChiSquared::new(q).map_or(f64::INFINITY, |chi| chi.inverse_cdf(1.0 - significance))
            }
            OutlierTest::Pope => {
                let (variance, r) = self.scale(group);
                // T over the variance factor holds its own residual: r q F / (r - q + q F).
                FisherSnedecor::new(q, r - q).map_or(f64::INFINITY, |f| {
                    let f = f.inverse_cdf(1.0 - significance);
                    variance * r * q * f / (r - q + q * f)
                })
            }
        }
    }

    /// The observations that the test rejects, the worst first: places in [`Statistics::tested`], each with its test value over the critical
    /// one. `significance` is the level at which an observation of a group is tested.
    pub fn rejected(
        &self,
        testing: OutlierTest,
        significance: impl Fn(Group) -> f64,
    ) -> Vec<(usize, f64)> {
        let mut criticals: BTreeMap<(Group, usize), f64> = BTreeMap::new();
        let tested = self.tested.iter().enumerate().filter(|(_, tested)| tested.freedom > 0);
        let mut found: Vec<(usize, f64)> = tested
            .map(|(place, tested)| {
                let (group, freedom) = (tested.group, usize::from(tested.freedom));
                let critical = criticals
                    .entry((group, freedom))
                    .or_insert_with(|| self.critical(testing, group, freedom, significance(group)));
                (place, tested.statistic / *critical)
            })
            .filter(|(_, excess)| *excess > 1.0)
            .collect();
        found.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        found
    }

    /// The two-sided interval in which `sigma0^2` lies with this confidence where the standard
    /// deviations given are right: the global test.
    pub fn variance_interval(&self, confidence: f64) -> Option<[f64; 2]> {
        let r = self.redundancy as f64;
        let chi = ChiSquared::new(r).ok()?;
        let tail = 0.5 * (1.0 - confidence);
        Some([chi.inverse_cdf(tail) / r, chi.inverse_cdf(1.0 - tail) / r])
    }
}

fn sum(group: Group, tested: &[TestedObservation]) -> GroupStatistics {
    let mut total = GroupStatistics { group, observations: 0, redundancy: 0.0, squares: 0.0 };
    for tested in tested {
        let rows = usize::from(tested.rows);
        total.observations += rows;
        for k in 0..rows {
            total.redundancy += tested.redundancy[k];
            total.squares += tested.residual[k].powi(2);
        }
    }
    total
}

/// Variances larger by less than this are not worth another inverse.
const LEAST_DESIGN_EFFECT: f64 = 1.1;

fn ground(adjustment: &AdjustmentProblem, inverse: &SelectedInverse) -> Vec<Option<PointAccuracy>> {
    let accuracy = |block| PointAccuracy { covariance_m2: array3(&inverse.among(&[(block, 3)])) };
    adjustment.ground.iter().map(|block| block.map(accuracy)).collect()
}

/// A kind with less redundancy than this has no variance factor of its own.
const LEAST_FOR_A_FACTOR: f64 = 8.0;

fn test(
    group: Group,
    subject: ObservationRef,
    v: &DVector<f64>,
    r: &DMatrix<f64>,
) -> TestedObservation {
    let rows = v.len().min(3);
    let mut tested = TestedObservation {
        group,
        subject,
        rows: rows as u8,
        freedom: 0,
        residual: [0.0; 3],
        redundancy: [0.0; 3],
        statistic: 0.0,
        error: [0.0; 3],
    };
    for k in 0..rows {
        tested.residual[k] = v[k];
        tested.redundancy[k] = r[(k, k)].clamp(0.0, 1.0);
    }
    let eigen = SymmetricEigen::new(r.clone());
    for (k, &value) in eigen.eigenvalues.iter().enumerate() {
        if value > LEAST_REDUNDANCY {
            let direction = eigen.eigenvectors.column(k);
            let along = direction.dot(v);
            tested.statistic += along * along / value;
            (0..rows).for_each(|i| tested.error[i] -= direction[i] * along / value);
            tested.freedom += 1;
        }
    }
    tested
}

/// Tie points whose matrices are in memory together.
const POINTS_TOGETHER: usize = 4096;

/// What is known of tie points, and, where asked for, of each of their measurements.
fn ties(
    reconstruction: &Reconstruction,
    adjustment: &AdjustmentProblem,
    settings: &Settings,
    x: &[f64],
    inverse: &SelectedInverse,
    with_tests: bool,
) -> (Vec<TestedObservation>, Vec<PointAccuracy>) {
    let mut tracks: Vec<Vec<usize>> = vec![Vec::new(); reconstruction.points.len()];
    for (k, o) in reconstruction.observations.iter().enumerate() {
        tracks[o.point as usize].push(k);
    }
    let sigma_px = reconstruction.tie_sigma_px * settings.factor(Group::TiePoints);
    let images: Vec<PreparedImage> = reconstruction
        .images
        .iter()
        .enumerate()
        .map(|(image, of)| prepared(adjustment, x, image, of.camera))
        .collect();
    let judge = |point: usize, track: &[usize]| {
        let measurements: Vec<_> = track
            .iter()
            .map(|&k| {
                let o = &reconstruction.observations[k];
                measurement(reconstruction, o.image, o.image_px, sigma_px)
            })
            .collect();
        let at = adjustment.problem.values(x, adjustment.points[point]);
        let of = |image: usize, _| images[image];
        let rays = rays(adjustment, of, [at[0], at[1], at[2]], &measurements);
        let unknown = || {
            let n = 2 * track.len();
            (DMatrix::from_element(3, 3, f64::NAN), DMatrix::identity(n, n))
        };
        let (covariance, hat) = rays.covariances(inverse).unwrap_or_else(unknown);
        let tested = track.iter().enumerate().filter(|_| with_tests).map(|(i, &k)| {
            let r = DMatrix::identity(2, 2) - hat.view((2 * i, 2 * i), (2, 2));
            let v = rays.residual.rows(2 * i, 2).into_owned();
            test(Group::TiePoints, ObservationRef::TieObservation(k), &v, &r)
        });
        let tested: Vec<TestedObservation> = tested.collect();
        (tested, PointAccuracy { covariance_m2: array3(&covariance) })
    };
    let count = if with_tests { reconstruction.observations.len() } else { 0 };
    let mut tested = Vec::with_capacity(count);
    let mut points = Vec::with_capacity(tracks.len());
    for (part, together) in tracks.chunks(POINTS_TOGETHER).enumerate() {
        let tracks = together.par_iter().enumerate();
        let found = tracks.map(|(k, track)| judge(POINTS_TOGETHER * part + k, track));
        for (of_track, point) in found.collect::<Vec<_>>() {
            tested.extend(of_track);
            points.push(point);
        }
    }
    (tested, points)
}

/// Residuals of a factor and their redundancy matrix.
type Judged = (DVector<f64>, DMatrix<f64>);

/// Residuals and redundancy matrices of the factors of a batch that touches no tie point.
fn others(
    adjustment: &AdjustmentProblem,
    x: &[f64],
    inverse: &SelectedInverse,
    name: &str,
) -> Result<Vec<Judged>, SolveError> {
    let found = adjustment.problem.linearized(x, name)?;
    Ok(found
        .into_iter()
        .map(|(blocks, residual, jacobian)| {
            let rows = residual.len();
            let columns: Vec<(BlockId, usize)> =
                blocks.iter().map(|&block| (block, adjustment.problem.dimension(block))).collect();
            let width = jacobian.len() / rows;
            let j = DMatrix::from_row_slice(rows, width, &jacobian);
            let among = inverse.among(&columns);
            let r = DMatrix::identity(rows, rows) - &j * among * j.transpose();
            (DVector::from_vec(residual), r)
        })
        .collect())
}
