//! Exact reference solutions of convex subproblems, by an interior-point method (Clarabel).
//!
//! With the assignment of pixels to plants held, the place of one plant is a second-order cone
//! programme:
//!
//! `min  w sum_n t_n + 1/2 x^T H x - g^T x   subject to  |z_n - x| <= t_n`,
//!
//! `x`, `z_n` offsets in pixels, `w = 1/sigma`, `H` and `g` the prior's. It shares no code with the
//! plant locator's own solver, which makes it an oracle in tests and a certificate for users:
//! the dual objective bounds the optimum from below.

use crate::engine::SolveError;
use clarabel::{
    algebra::CscMatrix,
    solver::{DefaultSettings, DefaultSolver, IPSolver, SolverStatus, SupportedConeT},
};

/// A sparse matrix of `rows` rows from the entries `(row, value)` of its columns, in any order.
fn sparse(rows: usize, columns: &mut [Vec<(usize, f64)>]) -> CscMatrix {
    let (mut starts, mut places, mut values) = (vec![0], Vec::new(), Vec::new());
    for column in columns.iter_mut() {
        column.sort_by_key(|entry| entry.0);
        places.extend(column.iter().map(|entry| entry.0));
        values.extend(column.iter().map(|entry| entry.1));
        starts.push(places.len());
    }
    CscMatrix::new(rows, columns.len(), starts, places, values)
}

/// The optimum of one plant's inner problem with bounds on both sides.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Certificate {
    /// The minimiser, an offset in pixels.
    pub offset_px: [f64; 2],
    /// The objective there: an upper bound on the optimum.
    pub primal: f64,
    /// The dual objective: a lower bound on the optimum.
    pub dual: f64,
}

impl Certificate {
    /// How far the optimum can lie below the primal objective.
    pub fn gap(&self) -> f64 {
        (self.primal - self.dual).abs()
    }
}

/// Solves the inner problem of one plant, with `H` as (uu, uv, vv) and `g`.
///
/// # Errors
/// [`SolveError::Misuse`] without any pixel or with a weight that is not positive;
/// [`SolveError::NotSolved`] where the interior-point method fails.
pub fn plant(
    u_px: &[f64],
    v_px: &[f64],
    weight: f64,
    hessian: [f64; 3],
    pull: [f64; 2],
) -> Result<Certificate, SolveError> {
    if u_px.is_empty() || u_px.len() != v_px.len() || weight.is_nan() || weight <= 0.0 {
        return Err(SolveError::Misuse("a certificate needs pixels and a positive weight".into()));
    }
    let count = u_px.len();
    // Variables: x_u, x_v, t_0, ..., t_{N-1}. Rows of cone n: (t_n, z_n - x), as s = b - A x.
    let objective = {
        let [uu, uv, vv] = hessian;
        let mut starts = vec![0, 1, 3];
        starts.resize(count + 3, 3);
        CscMatrix::new(count + 2, count + 2, starts, vec![0, 0, 1], vec![uu, uv, vv])
    };
    let mut linear = vec![-pull[0], -pull[1]];
    linear.resize(count + 2, weight);
    let mut columns: Vec<Vec<(usize, f64)>> =
        (1..=2).map(|axis| (0..count).map(|n| (3 * n + axis, 1.0)).collect()).collect();
    columns.extend((0..count).map(|n| vec![(3 * n, -1.0)]));
    let constraints = sparse(3 * count, &mut columns);
    let right: Vec<f64> = u_px.iter().zip(v_px).flat_map(|(&u, &v)| [0.0, u, v]).collect();
    let cones = vec![SupportedConeT::SecondOrderConeT(3); count];
    let settings = DefaultSettings {
        verbose: false,
        tol_gap_abs: 1e-13,
        tol_gap_rel: 1e-13,
        tol_feas: 1e-13,
        max_threads: 1,
        ..DefaultSettings::default()
    };
    let failed = |what: String| SolveError::NotSolved(format!("the certificate: {what}"));
    let mut solver =
        DefaultSolver::new(&objective, &linear, &constraints, &right, &cones, settings)
            .map_err(|error| failed(error.to_string()))?;
    solver.solve();
    let solution = &solver.solution;
    // Tolerances this tight are often just missed; the gap says how well it went.
    match solution.status {
        SolverStatus::Solved
        | SolverStatus::AlmostSolved
        | SolverStatus::InsufficientProgress
        | SolverStatus::NumericalError
            if solution.x.len() >= 2 && solution.x.iter().all(|x| x.is_finite()) =>
        {
            Ok(Certificate {
                offset_px: [solution.x[0], solution.x[1]],
                primal: solution.obj_val,
                dual: solution.obj_val_dual,
            })
        }
        status => Err(failed(status.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bad_input_is_refused() {
        let plant = |u: &[f64], v: &[f64], weight| plant(u, v, weight, [0.0; 3], [0.0; 2]);
        assert!(plant(&[], &[], 1.0).is_err());
        assert!(plant(&[0.0], &[0.0], 0.0).is_err());
        assert!(plant(&[0.0], &[0.0], f64::NAN).is_err());
    }
}
