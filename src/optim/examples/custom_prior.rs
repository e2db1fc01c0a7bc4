//! Priors: heights along a line that a few measurements know, held together by smoothness, one of them known beforehand.
//!
//! ```sh
//! cargo run -p rowgram-optim --example custom_prior
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram_optim::{
    engine::SolveError,
    nlls::{
        BlockId, Euclidean, Factors, GaussianPrior, Infeasible, Loss, Options, Problem, Residual,
        Residuals, Scalar, Vector, solve,
    },
};

/// A measured height, metres.
struct Measured {
    height_m: f64,
    sigma_m: f64,
}

impl Residual<1> for Measured {
    type Blocks = (Vector<1>,);
    fn evaluate<T: Scalar>(&self, (x,): ([T; 1],)) -> Result<[T; 1], Infeasible> {
        Ok([(x[0] - self.height_m) / self.sigma_m])
    }
}

/// A prior of your own: the second difference of three heights is zero.
struct Smooth {
    sigma_m: f64,
}

impl Residual<1> for Smooth {
    type Blocks = (Vector<1>, Vector<1>, Vector<1>);
    fn evaluate<T: Scalar>(
        &self,
        (a, b, c): ([T; 1], [T; 1], [T; 1]),
    ) -> Result<[T; 1], Infeasible> {
        Ok([(a[0] - b[0] * 2.0 + c[0]) / self.sigma_m])
    }
}

pub(crate) fn main() -> Result<(), SolveError> {
    let mut problem = Problem::new();
    let heights: Vec<BlockId> =
        (0..11).map(|_| problem.block("height", Euclidean(1), &[0.0])).collect::<Result<_, _>>()?;
    // The last measurement is wrong by metres: a robust loss keeps it from bending the line.
    let measured = [(0, 1.0), (3, 1.6), (6, 2.2), (8, 9.0)];
    let data = measured.map(|(k, height_m)| ([heights[k]], Measured { height_m, sigma_m: 0.02 }));
    problem.add("measured", Loss::Cauchy(1.0), Residuals::new(data))?;
    // A number that is known beforehand needs no residual of your own.
    let end = GaussianPrior::new(&problem, heights[10], &[3.0], &[0.02])?;
    problem.add("surveyed", Loss::Trivial, Factors(vec![end]))?;
    let smooth =
        heights.windows(3).map(|three| ([three[0], three[1], three[2]], Smooth { sigma_m: 0.01 }));
    problem.add("smooth", Loss::Trivial, Residuals::new(smooth))?;
    let mut x = problem.start();
    solve(&problem, &mut x, &Options::default(), 100)?;
    for (k, &height) in heights.iter().enumerate() {
        let value = problem.values(&x, height)[0];
        println!("{k:2}: {value:.3} m");
        assert!((value - (1.0 + 0.2 * k as f64)).abs() < 0.1);
    }
    Ok(())
}
