//! A few parameters without derivatives: argmin's own Nelder-Mead.

use argmin::{
    core::{CostFunction, Executor, State},
    solver::neldermead::NelderMead,
};

/// A cost as argmin asks for it.
struct Cost<F>(F);

impl<F: Fn(&[f64]) -> f64> CostFunction for Cost<F> {
    type Param = Vec<f64>;
    type Output = f64;

    fn cost(&self, x: &Vec<f64>) -> Result<f64, argmin::core::Error> {
        Ok((self.0)(x))
    }
}

/// The best point that the simplex method finds from `start`, with a first simplex that reaches `reach` along each axis,
/// in at most `iterations` iterations; `start` itself where the method cannot run.
pub(crate) fn minimise(
    cost: impl Fn(&[f64]) -> f64,
    start: &[f64],
    reach: &[f64],
    iterations: u64,
) -> Vec<f64> {
    let mut simplex = vec![start.to_vec()];
    for (axis, &reach) in reach.iter().enumerate().take(start.len()) {
        let mut corner = start.to_vec();
        corner[axis] += reach;
        simplex.push(corner);
    }
    let run = Executor::new(Cost(cost), NelderMead::new(simplex))
        .configure(|state| state.max_iters(iterations))
        .ctrlc(false)
        .run();
    run.ok().and_then(|end| end.state.get_best_param().cloned()).unwrap_or_else(|| start.to_vec())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bent_valley_is_followed_to_its_end() {
        let rosenbrock = |x: &[f64]| (1.0 - x[0]).powi(2) + 100.0 * (x[1] - x[0] * x[0]).powi(2);
        let found = minimise(rosenbrock, &[-1.2, 1.0], &[0.5, 0.5], 500);
        assert!(rosenbrock(&found) < 1e-8, "{found:?}");
    }
}
