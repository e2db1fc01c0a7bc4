//! A plan onto surveyed corners: from two to four observations of the affine numbers.
//!
//! ```text
//! min  1/2 sum_i |q(s_i, t_i) - q_i|^2 / sigma_c^2  +  a^2 + b^2 over 2 sigma_a^2  +  k^2 over 2 sigma_k^2
//! ```
//!
//! The design holds the stretches and the shear as far as the corners do not know better, which is what makes two corners
//! enough.

use super::{AFFINE, BEND, Placement, moved};
use rowgram_optim::{
    engine::SolveError,
    nlls::{
        self, Euclidean, Factors, GaussianPrior, Infeasible, LinearSolver, Loss, Options, Problem,
        Residual, Residuals, Scalar, Vector, covariance::Covariance,
    },
};

/// A corner of the plan that was surveyed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Corner {
    /// In the plan, metres.
    pub at: [f64; 2],
    /// On the map, metres.
    pub surveyed_m: [f64; 2],
}

/// Standard deviations of what is assumed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CornerSigmas {
    /// Of each coordinate of a corner, metres.
    pub corner_m: f64,
    /// Of both stretches.
    pub stretch: f64,
    /// Of the shear, radians.
    pub shear_rad: f64,
}

/// A plan on its corners.
#[derive(Debug, Clone, PartialEq)]
pub struct CornerFit {
    /// Where it lies.
    pub placement: Placement,
    /// Surveyed minus computed for each corner, along and across the rows, metres.
    pub residuals_m: Vec<[f64; 2]>,
    /// Covariance of the affine numbers, row-major.
    pub covariance: [[f64; AFFINE]; AFFINE],
}

struct AtCorner {
    at: [f64; 2],
    q: [f64; 2],
    sigma_m: f64,
}

impl Residual<2> for AtCorner {
    type Blocks = (Vector<AFFINE>,);

    fn evaluate<T: Scalar>(&self, (affine,): ([T; AFFINE],)) -> Result<[T; 2], Infeasible> {
        let q = moved(&affine, &[T::constant(0.0); BEND], 1.0, self.at);
        Ok([0, 1].map(|axis| (q[axis] - self.q[axis]) / self.sigma_m))
    }
}

/// Fits a plan to its corners; `start` is a placement near them.
///
/// # Errors
/// Corners that do not determine shift and rotation: fewer than two, or all in one place.
pub fn fit(
    start: &Placement,
    corners: &[Corner],
    sigmas: &CornerSigmas,
) -> Result<CornerFit, SolveError> {
    let mut problem = Problem::new();
    let affine = problem.block("placement", Euclidean(AFFINE), &start.affine)?;
    let factors = corners.iter().map(|corner| {
        let q = start.frame(corner.surveyed_m);
        ([affine], AtCorner { at: corner.at, q, sigma_m: sigmas.corner_m })
    });
    problem.add("corners", Loss::Trivial, Residuals::new(factors))?;
    // Stretches and shear are those of the design.
    let sigmas = [sigmas.stretch, sigmas.stretch, sigmas.shear_rad];
    let design = GaussianPrior::of_entries(&problem, affine, &[3, 4, 5], &[0.0; 3], &sigmas)?;
    problem.add("design", Loss::Trivial, Factors(vec![design]))?;
    let mut x = problem.start();
    let options = Options { linear: LinearSolver::Dense, ..Options::default() };
    nlls::solve(&problem, &mut x, &options, 100)?;
    let values = Covariance::new(&problem, &x, LinearSolver::Dense)?.block(affine);
    let mut covariance = [[0.0; AFFINE]; AFFINE];
    covariance.as_flattened_mut().copy_from_slice(&values);
    let mut placement = *start;
    placement.affine.copy_from_slice(&x[..AFFINE]);
    let residuals_m = corners
        .iter()
        .map(|corner| {
            let (found, computed) =
                (start.frame(corner.surveyed_m), start.frame(placement.map(corner.at)));
            [found[0] - computed[0], found[1] - computed[1]]
        })
        .collect();
    Ok(CornerFit { placement, residuals_m, covariance })
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;

    const SIGMAS: CornerSigmas = CornerSigmas { corner_m: 0.03, stretch: 0.01, shear_rad: 0.003 };

    fn field() -> (Placement, [[f64; 2]; 4]) {
        let mut truth = Placement::nominal([1000.0, 2000.0], 0.3, 20.0);
        truth.affine = [2.0, -1.0, 0.05, 0.004, -0.006, 0.001];
        (truth, [[-20.0, -15.0], [20.0, -15.0], [20.0, 15.0], [-20.0, 15.0]])
    }

    #[test]
    fn two_corners_hold_the_design_and_four_say_more() {
        let (truth, places) = field();
        let nominal = Placement { affine: [0.0; AFFINE], ..truth };
        let of = |count: usize| {
            let corners: Vec<Corner> = places[..count]
                .iter()
                .map(|&at| Corner { at, surveyed_m: truth.map(at) })
                .collect();
            fit(&nominal, &corners, &SIGMAS).unwrap()
        };
        let four = of(4);
        for (found, expected) in four.placement.affine.iter().zip(truth.affine) {
            // The priors pull by (sigma of the corners over the field)^2 of the stretch.
            assert_abs_diff_eq!(*found, expected, epsilon = 5e-4);
        }
        let two = of(2);
        // Along the side that was surveyed the stretch is known, across it is the design's.
        assert_abs_diff_eq!(two.placement.affine[3], 0.004, epsilon = 5e-4);
        assert_abs_diff_eq!(two.placement.affine[4], 0.0, epsilon = 1e-9);
        assert!(two.covariance[4][4].sqrt() > 0.009 && four.covariance[4][4].sqrt() < 0.002);
        assert!(fit(&nominal, &[], &SIGMAS).is_err(), "no corner");
        let one = Corner { at: places[0], surveyed_m: truth.map(places[0]) };
        assert!(fit(&nominal, &[one], &SIGMAS).is_err(), "the rotation is not determined");
    }
}
