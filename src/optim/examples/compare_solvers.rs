//! Every method and linear solver on one problem, Rosenbrock's valley many times over, as a table and as a plot.
//!
//! ```sh
//! cargo run -p rowgram-optim --example compare_solvers > solvers.svg
//! ```
//!
//! The table goes to standard error, the plot (cost against iteration, SVG) to standard output.
#![allow(clippy::print_stdout, clippy::print_stderr, reason = "an example prints")]

use rowgram_optim::{
    engine::{SolveError, run},
    nlls::{
        Euclidean, Infeasible, LeastSquares, LinearSolver, Loss, Method, Options, Problem,
        Residual, Residuals, Scalar, Vector,
    },
};

/// `10 (y - x^2)` and `1 - x`.
struct Valley;

impl Residual<2> for Valley {
    type Blocks = (Vector<1>, Vector<1>);
    fn evaluate<T: Scalar>(&self, (x, y): ([T; 1], [T; 1])) -> Result<[T; 2], Infeasible> {
        Ok([(y[0] - x[0] * x[0]) * 10.0, -x[0] + 1.0])
    }
}

pub(crate) fn main() -> Result<(), SolveError> {
    let mut problem = Problem::new();
    let blocks = (0..40)
        .map(|k| problem.block("x", Euclidean(1), &[if k % 2 == 0 { -1.2 } else { 1.0 }]))
        .collect::<Result<Vec<_>, _>>()?;
    let valleys = blocks.chunks_exact(2).map(|pair| ([pair[0], pair[1]], Valley));
    problem.add("valleys", Loss::Trivial, Residuals::new(valleys))?;
    let (mut curves, mut legend) = (String::new(), String::new());
    let methods = [Method::LevenbergMarquardt, Method::Dogleg];
    let solvers = [LinearSolver::Dense, LinearSolver::Sparse, LinearSolver::IterativeSchur];
    eprintln!("{:36} {:>10} {:>12}  stopped because", "solver", "iterations", "final cost");
    for (k, (method, linear)) in
        methods.iter().flat_map(|&m| solvers.map(|solver| (m, solver))).enumerate()
    {
        let mut engine = LeastSquares::new(Options { method, linear, ..Options::default() });
        let (mut x, mut points) = (problem.start(), String::new());
        let end = run(&problem, &mut engine, &mut x, 500, |iteration, step| {
            let height = 300.0 - 12.0 * (step.cost.max(1e-12).log10() + 12.0);
            points += &format!("{:.1},{height:.1} ", 40.0 + 4.0 * iteration as f64);
        })?;
        let name = format!("{method:?}, {linear:?}");
        let (steps, cost) = (end.iterations, end.final_cost);
        eprintln!("{name:36} {steps:>10} {cost:>12.3e}  {}", end.stop.explain());
        let hue = 60 * k;
        curves += &format!(
            "<polyline points=\"{points}\" fill=\"none\" stroke=\"hsl({hue},70%,40%)\"/>\n"
        );
        let y = 20 + 16 * k;
        legend += &format!("<text x=\"400\" y=\"{y}\" fill=\"hsl({hue},70%,40%)\">{name}</text>\n");
        assert!(end.stop.converged() && x.iter().all(|v| (v - 1.0).abs() < 1e-3), "{name}");
    }
    println!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"660\" height=\"320\" font-size=\"12\">"
    );
    println!(
        "<text x=\"40\" y=\"315\">iterations (to 150); cost from 1e-12 up, logarithmic</text>"
    );
    println!("{curves}{legend}</svg>");
    Ok(())
}
