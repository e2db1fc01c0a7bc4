//! Standard deviations: a post measured with tapes from three known ones.
//!
//! ```sh
//! cargo run -p rowgram-optim --example covariance
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram_optim::{
    engine::SolveError,
    nlls::{
        Euclidean, Infeasible, LinearSolver, Loss, Options, Problem, Residual, Residuals, Scalar,
        Vector, covariance::Covariance, solve,
    },
};

struct Tape {
    from_m: [f64; 2],
    length_m: f64,
    sigma_m: f64,
}

impl Residual<1> for Tape {
    type Blocks = (Vector<2>,);
    fn evaluate<T: Scalar>(&self, (post,): ([T; 2],)) -> Result<[T; 1], Infeasible> {
        let length = (post[0] - self.from_m[0]).hypot(post[1] - self.from_m[1]);
        Ok([(length - self.length_m) / self.sigma_m])
    }
}

pub(crate) fn main() -> Result<(), SolveError> {
    let mut problem = Problem::new();
    let post = problem.block("post", Euclidean(2), &[1.0, 1.0])?;
    let measured = [([0.0, 0.0], 5.01), ([6.0, 0.0], 5.00), ([0.0, 8.0], 5.00)];
    let tapes =
        measured.map(|(from_m, length_m)| ([post], Tape { from_m, length_m, sigma_m: 0.01 }));
    problem.add("tapes", Loss::Trivial, Residuals::new(tapes))?;
    let mut x = problem.start();
    solve(&problem, &mut x, &Options::default(), 50)?;
    let c = Covariance::new(&problem, &x, LinearSolver::Dense)?.block(post);
    let [east, north] = [c[0].sqrt(), c[3].sqrt()];
    println!("{:.3} +- {east:.3} m east, {:.3} +- {north:.3} m north", x[0], x[1]);
    println!("correlation {:.2}", c[1] / (east * north));
    assert!((x[0] - 3.0).abs() < 0.02 && (x[1] - 4.0).abs() < 0.02 && east < 0.02);
    Ok(())
}
