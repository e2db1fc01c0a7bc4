//! A problem of your own for the second engine: heights between two posts, each drawn to the mean of
//! its neighbours and to what was measured there.
//!
//! ```sh
//! cargo run -p rowgram-optim --example coordinate_descent
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram_optim::{
    descent::{ActiveSet, BlockCost, CoordinateDescentOptions, run},
    engine::SolveError,
};

/// `sum_k (x_k - measured_k)^2 + smooth sum_k (x_k+1 - x_k)^2`.
struct Chain {
    measured: Vec<f64>,
    smooth: f64,
}

impl BlockCost for Chain {
    type Iterate = Vec<f64>;
    fn len(&self) -> usize {
        self.measured.len()
    }
    fn prepare(&self, x: &mut Vec<f64>) -> Result<(), SolveError> {
        let fits = x.len() == self.measured.len();
        if fits { Ok(()) } else { Err(SolveError::Misuse("a height for each".into())) }
    }
    fn cost(&self, x: &Vec<f64>) -> f64 {
        let data: f64 = x.iter().zip(&self.measured).map(|(x, y)| (x - y).powi(2)).sum();
        data + self.smooth * x.windows(2).map(|w| (w[1] - w[0]).powi(2)).sum::<f64>()
    }
    fn monotone(&self) -> bool {
        true
    }
    fn update(&self, x: &mut Vec<f64>, k: usize, active: &mut ActiveSet) -> f64 {
        let neighbours: Vec<usize> =
            [k.wrapping_sub(1), k + 1].into_iter().filter(|&n| n < x.len()).collect();
        let pull: f64 = neighbours.iter().map(|&n| self.smooth * x[n]).sum();
        let best = (self.measured[k] + pull) / (1.0 + self.smooth * neighbours.len() as f64);
        let moved = (best - x[k]).abs();
        x[k] = best;
        if moved > 1e-9 {
            neighbours.into_iter().for_each(|n| active.mark(n));
        }
        moved
    }
    fn end_sweep(&self, _: &mut Vec<f64>, _: &mut ActiveSet) {}
}

pub(crate) fn main() -> Result<(), SolveError> {
    let problem = Chain { measured: vec![0.0, 1.2, 1.8, 3.3, 3.9, 5.0], smooth: 4.0 };
    let mut x = vec![0.0; 6];
    let options = CoordinateDescentOptions {
        movement_tolerance: 1e-9,
        cost_tolerance: 0.0,
        ..CoordinateDescentOptions::default()
    };
    let outcome = run(&problem, &mut x, options, 500, |_, _| ())?;
    println!("{x:.3?} after {} sweeps: {}", outcome.iterations, outcome.stop.explain());
    // At the optimum all data residuals add up to nothing.
    let sum: f64 = x.iter().zip(&problem.measured).map(|(x, y)| x - y).sum();
    assert!(sum.abs() < 1e-6);
    Ok(())
}
