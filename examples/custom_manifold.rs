//! A manifold of your own: headings, as points `(cos, sin)` of the unit circle.
//!
//! ```sh
//! cargo run --example custom_manifold
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram::{
    engine::SolveError,
    nlls::{
        BlockId, Factor, Factors, Infeasible, Jacobian, Loss, Manifold, Options, Problem,
        check::check_manifold, solve,
    },
};

#[derive(Debug, PartialEq)]
struct Circle;

impl Manifold for Circle {
    fn ambient(&self) -> usize {
        2
    }
    fn tangent(&self) -> usize {
        1
    }
    fn plus(&self, x: &[f64], d: &[f64], out: &mut [f64]) {
        let (sin, cos) = d[0].sin_cos();
        out.copy_from_slice(&[cos * x[0] - sin * x[1], sin * x[0] + cos * x[1]]);
    }
    fn minus(&self, y: &[f64], x: &[f64], out: &mut [f64]) {
        out[0] = (x[0] * y[1] - x[1] * y[0]).atan2(x[0] * y[0] + x[1] * y[1]);
    }
}

/// A measured heading, as a unit vector; derived by hand, because the block is our own.
struct Compass([BlockId; 1], [f64; 2]);

impl Factor for Compass {
    fn rows(&self) -> usize {
        2
    }
    fn blocks(&self) -> &[BlockId] {
        &self.0
    }
    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        jacobian: Option<&mut Jacobian<'_>>,
    ) -> Result<(), Infeasible> {
        (0..2).for_each(|k| residual[k] = x[0][k] - self.1[k]);
        if let Some(jacobian) = jacobian {
            (jacobian.row(0)[0], jacobian.row(1)[0]) = (-x[0][1], x[0][0]);
        }
        Ok(())
    }
}

pub(crate) fn main() -> Result<(), SolveError> {
    check_manifold(&Circle, &[0.6, 0.8], &[-0.8, 0.6], &[0.3], 1e-12)
        .map_err(SolveError::Misuse)?;
    let mut problem = Problem::new();
    let heading = problem.block("heading", Circle, &[0.0, 1.0])?;
    // On both sides of 180 degrees, where a mean of angles would be 0.
    let seen =
        [179.0f64, -179.0, 178.0].map(|deg| [deg.to_radians().cos(), deg.to_radians().sin()]);
    let factors = seen.map(|measured| Compass([heading], measured));
    problem.add("compass", Loss::Trivial, Factors(factors.into()))?;
    let mut x = problem.start();
    solve(&problem, &mut x, &Options::default(), 50)?;
    let found_deg = x[1].atan2(x[0]).to_degrees();
    println!("{found_deg:.3} degrees");
    assert!((found_deg - 179.333).abs() < 0.01);
    Ok(())
}
