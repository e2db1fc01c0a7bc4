//! Solvers of argmin as contestants: they see a cost, its gradient and a Gauss-Newton Hessian.

use argmin::{
    core::{CostFunction, Error, Executor, Gradient, Hessian, Jacobian, Operator},
    solver::{
        conjugategradient::{NonlinearConjugateGradient, beta::PolakRibiere},
        gaussnewton::GaussNewton,
        gradientdescent::SteepestDescent,
        linesearch::MoreThuenteLineSearch,
        neldermead::NelderMead,
        quasinewton::LBFGS,
        trustregion::{Steihaug, TrustRegion},
    },
};
use argmin_math::{ArgminDot, ArgminInv, ArgminTranspose};
use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Pairs of steps that L-BFGS remembers.
const REMEMBERED: usize = 7;

/// Who solves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Contestant {
    /// Limited memory BFGS with the line search of More and Thuente.
    Lbfgs,
    /// Nonlinear conjugate gradients (Polak and Ribiere), the same line search.
    NonlinearCg,
    SteepestDescent,
    /// Trust region on the Gauss-Newton model by Steihaug's conjugate gradients.
    Steihaug,
}

/// `J^T J` as an operator: the rows of `J` without their zeros.
#[derive(Debug, Clone, Default)]
pub(super) struct GaussNewtonHessian(Arc<Rows>);

/// Rows of a Jacobian.
#[derive(Debug, Default)]
pub(super) struct Rows {
    /// Where each row ends.
    ends: Vec<usize>,
    columns: Vec<usize>,
    values: Vec<f64>,
}

impl Rows {
    /// Adds an entry to the row under way.
    pub(super) fn put(&mut self, column: usize, value: f64) {
        self.columns.push(column);
        self.values.push(value);
    }

    /// Ends the row under way.
    pub(super) fn end(&mut self) {
        self.ends.push(self.columns.len());
    }
}

impl GaussNewtonHessian {
    /// The rows of `J` with their zeros, over so many columns.
    pub(super) fn jacobian(&self, columns: usize) -> Dense {
        let rows = &self.0;
        let mut entries = DMatrix::zeros(rows.ends.len(), columns);
        let mut begin = 0;
        for (row, &end) in rows.ends.iter().enumerate() {
            for k in begin..end {
                entries[(row, rows.columns[k])] += rows.values[k];
            }
            begin = end;
        }
        Dense(entries)
    }
}

impl From<Rows> for GaussNewtonHessian {
    fn from(rows: Rows) -> GaussNewtonHessian {
        GaussNewtonHessian(Arc::new(rows))
    }
}

impl ArgminDot<Vec<f64>, Vec<f64>> for GaussNewtonHessian {
    fn dot(&self, x: &Vec<f64>) -> Vec<f64> {
        let rows = &self.0;
        let mut y = vec![0.0; x.len()];
        let mut begin = 0;
        for &end in &rows.ends {
            let entries = || rows.columns[begin..end].iter().zip(&rows.values[begin..end]);
            let product: f64 = entries().map(|(&column, value)| value * x[column]).sum();
            entries().for_each(|(&column, value)| y[column] += value * product);
            begin = end;
        }
        y
    }
}

/// A small dense Jacobian, for argmin's Gauss-Newton method, which inverts `J^T J`.
#[derive(Debug, Clone)]
pub(super) struct Dense(pub(super) DMatrix<f64>);

impl ArgminTranspose<Dense> for Dense {
    fn t(self) -> Dense {
        Dense(self.0.transpose())
    }
}

impl ArgminInv<Dense> for Dense {
    fn inv(&self) -> Result<Dense, Error> {
        let inverse = self.0.clone().try_inverse();
        inverse.map(Dense).ok_or_else(|| Error::msg("the normal matrix is singular"))
    }
}

impl ArgminDot<Dense, Dense> for Dense {
    fn dot(&self, other: &Dense) -> Dense {
        Dense(&self.0 * &other.0)
    }
}

impl ArgminDot<Vec<f64>, Vec<f64>> for Dense {
    fn dot(&self, other: &Vec<f64>) -> Vec<f64> {
        let product = &self.0 * nalgebra::DVector::from_column_slice(other);
        product.as_slice().to_vec()
    }
}

fn told(error: Error) -> String {
    error.to_string()
}

/// Runs a contestant; what it finds is what `problem` noted when it was asked. Conjugate gradients inside a step make so many
/// products at most.
pub(super) fn race<P>(
    contestant: Contestant,
    problem: P,
    start: Vec<f64>,
    max_iterations: u64,
    max_products: u64,
) -> Result<(), String>
where
    P: CostFunction<Param = Vec<f64>, Output = f64>
        + Gradient<Param = Vec<f64>, Gradient = Vec<f64>>
        + Hessian<Param = Vec<f64>, Hessian = GaussNewtonHessian>,
{
    let line = MoreThuenteLineSearch::new;
    match contestant {
        Contestant::Lbfgs => Executor::new(problem, LBFGS::new(line(), REMEMBERED))
            .configure(|state| state.param(start).max_iters(max_iterations))
            .run()
            .map(drop),
        Contestant::NonlinearCg => {
            let solver = NonlinearConjugateGradient::new(line(), PolakRibiere::new())
                .restart_iters(20)
                .restart_orthogonality(0.1);
            Executor::new(problem, solver)
                .configure(|state| state.param(start).max_iters(max_iterations))
                .run()
                .map(drop)
        }
        Contestant::SteepestDescent => Executor::new(problem, SteepestDescent::new(line()))
            .configure(|state| state.param(start).max_iters(max_iterations))
            .run()
            .map(drop),
        Contestant::Steihaug => {
            let inner: Steihaug<Vec<f64>, f64> = Steihaug::new().with_max_iters(max_products);
            let solver = TrustRegion::<_, f64>::new(inner)
                .with_max_radius(1e6)
                .map_err(|e| e.to_string())?;
            Executor::new(problem, solver)
                .configure(|state| state.param(start).max_iters(max_iterations))
                .run()
                .map(drop)
        }
    }
    .map_err(told)
}

/// Runs argmin's simplex method, its first simplex a tenth wide.
pub(super) fn nelder_mead<P>(problem: P, start: &[f64], max_iterations: u64) -> Result<(), String>
where
    P: CostFunction<Param = Vec<f64>, Output = f64>,
{
    let mut simplex = vec![start.to_vec()];
    for k in 0..start.len() {
        let mut vertex = start.to_vec();
        vertex[k] += 0.1 * vertex[k].abs().max(1.0);
        simplex.push(vertex);
    }
    let solver = NelderMead::new(simplex).with_sd_tolerance(1e-14).map_err(told)?;
    let run = Executor::new(problem, solver).configure(|state| state.max_iters(max_iterations));
    run.run().map(drop).map_err(told)
}

/// Runs argmin's Gauss-Newton method, undamped.
pub(super) fn gauss_newton<P>(
    problem: P,
    start: Vec<f64>,
    max_iterations: u64,
) -> Result<(), String>
where
    P: Operator<Param = Vec<f64>, Output = Vec<f64>> + Jacobian<Param = Vec<f64>, Jacobian = Dense>,
{
    let solver = GaussNewton::<f64>::new().with_tolerance(1e-14).map_err(told)?;
    Executor::new(problem, solver)
        .configure(|state| state.param(start).max_iters(max_iterations))
        .run()
        .map(drop)
        .map_err(told)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_operator_is_the_normal_matrix() {
        let j = DMatrix::from_row_slice(3, 2, &[1.0, 2.0, 0.0, -1.0, 3.0, 0.5]);
        let mut rows = Rows::default();
        for i in 0..3 {
            (0..2).filter(|&k| j[(i, k)] != 0.0).for_each(|k| rows.put(k, j[(i, k)]));
            rows.end();
        }
        let x = vec![0.7, -2.0];
        let expected = j.transpose() * &j * nalgebra::DVector::from_column_slice(&x);
        let hessian = GaussNewtonHessian::from(rows);
        assert_eq!(hessian.jacobian(2).0, j);
        let found = hessian.dot(&x);
        for k in 0..2 {
            assert!((found[k] - expected[k]).abs() < 1e-14, "{found:?} {expected}");
        }
    }
}
