//! The lower envelope of heights on a grid, as a linear programme.
//!
//! ```text
//! min  sum_c w_c (q a_c + (1 - q) b_c) + lambda sum_e t_e
//! s.t. a_c - b_c = d_c - z_c,   a_c, b_c >= 0,   -t_e <= z_i - 2 z_j + z_k <= t_e
//! ```

use super::sparse;
use crate::engine::SolveError;
use clarabel::{
    algebra::CscMatrix,
    solver::{DefaultSettings, DefaultSolver, IPSolver, SolverStatus, SupportedConeT},
};

/// What is known of a cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Datum {
    /// The cell, row by row.
    pub cell: usize,
    /// Its height.
    pub value: f64,
    /// How much it counts.
    pub weight: f64,
}

/// The heights of all cells of a `[width, height]` grid.
///
/// # Errors
/// [`SolveError::Misuse`] without data, or with a quantile outside (0, 1); [`SolveError::NotSolved`] where
/// the interior-point method fails.
pub fn lower_envelope(
    [width, height]: [usize; 2],
    data: &[Datum],
    quantile: f64,
    lambda: f64,
) -> Result<Vec<f64>, SolveError> {
    let finite = |d: &Datum| d.value.is_finite() && d.weight.is_finite();
    if !data.iter().all(finite) {
        return Err(SolveError::Misuse(
            "the heights and weights of an envelope must be finite".into(),
        ));
    }
    if data.is_empty() || !(quantile > 0.0 && quantile < 1.0) || lambda.is_nan() || lambda <= 0.0 {
        return Err(SolveError::Misuse(format!(
            "an envelope needs data, a quantile in (0, 1) and a positive smoothness, got {} data, {quantile}, {lambda}",
            data.len()
        )));
    }
    let cells = width * height;
    let mean = data.iter().map(|d| d.value).sum::<f64>() / data.len() as f64;
    let mut triples: Vec<[usize; 3]> = Vec::new();
    for v in 0..height {
        for u in 0..width {
            let at = v * width + u;
            let (inside_u, inside_v) = (u > 0 && u + 1 < width, v > 0 && v + 1 < height);
            if inside_u {
                triples.push([at - 1, at, at + 1]);
            }
            if inside_v {
                triples.push([at - width, at, at + width]);
            }
            if inside_u && inside_v {
                triples.push([at - width - 1, at, at + width + 1]);
                triples.push([at - width + 1, at, at + width - 1]);
            }
        }
    }
    // Variables: z (cells), t (triples), r_c >= w_c rho (data): rho is the larger of two lines.
    let (edges, n) = (triples.len(), cells + triples.len() + data.len());
    let mut columns: Vec<Vec<(usize, f64)>> = vec![Vec::new(); n];
    let mut right = Vec::with_capacity(2 * (edges + data.len()));
    // Rows of s = b - A x >= 0.
    let mut row = 0;
    for (e, &[i, j, k]) in triples.iter().enumerate() {
        for sign in [1.0, -1.0] {
            columns[i].push((row, sign));
            columns[j].push((row, -2.0 * sign));
            columns[k].push((row, sign));
            columns[cells + e].push((row, -1.0));
            right.push(0.0);
            row += 1;
        }
    }
    for (c, datum) in data.iter().enumerate() {
        // r >= q (d - z) and r >= (1 - q) (z - d).
        for slope in [quantile, quantile - 1.0] {
            columns[datum.cell].push((row, -slope));
            columns[cells + edges + c].push((row, -1.0));
            right.push(-slope * (datum.value - mean));
            row += 1;
        }
    }
    let constraints = sparse(row, &mut columns);
    let objective = CscMatrix::new(n, n, vec![0; n + 1], Vec::new(), Vec::new());
    let mut linear = vec![0.0; cells];
    linear.resize(cells + edges, lambda);
    linear.extend(data.iter().map(|datum| datum.weight));
    let settings = DefaultSettings { verbose: false, max_threads: 1, ..DefaultSettings::default() };
    let cones = [SupportedConeT::NonnegativeConeT(row)];
    let failed = |what: String| SolveError::NotSolved(format!("the lower envelope: {what}"));
    let mut solver =
        DefaultSolver::new(&objective, &linear, &constraints, &right, &cones, settings)
            .map_err(|error| failed(error.to_string()))?;
    solver.solve();
    let solution = &solver.solution;
    match solution.status {
        SolverStatus::Solved | SolverStatus::AlmostSolved => {
            Ok(solution.x[..cells].iter().map(|z| z + mean).collect())
        }
        status => Err(failed(format!("the interior-point method ended as {status:?}"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plants_stand_above_the_slope_that_is_found() {
        let [width, height] = [14, 10];
        let slope = |cell: usize| 50.0 + 0.1 * (cell % width) as f64 - 0.2 * (cell / width) as f64;
        let data: Vec<Datum> = (0..width * height)
            .filter(|cell| cell % 11 != 3)
            .map(|cell| {
                let plant = if cell % 3 == 1 { 0.8 } else { 0.0 };
                Datum { cell, value: slope(cell) + plant, weight: 3.0 }
            })
            .collect();
        let found = lower_envelope([width, height], &data, 0.1, 2.0).unwrap();
        for (cell, z) in found.iter().enumerate() {
            // A plane is a solution without a break and the quantile's loss is exact at it.
            approx::assert_abs_diff_eq!(*z, slope(cell), epsilon = 1e-4);
        }
        assert!(lower_envelope([2, 2], &[], 0.1, 1.0).is_err());
    }

    #[test]
    fn failures_are_called_what_they_are() {
        let nowhere = Datum { cell: 0, value: f64::NAN, weight: 1.0 };
        let refused = lower_envelope([2, 2], &[nowhere], 0.1, 1.0);
        assert!(matches!(refused, Err(SolveError::Misuse(_))), "{refused:?}");
        let overflows = [1e200, -1e200].map(|value| Datum {
            cell: usize::from(value > 0.0),
            value,
            weight: 1e200,
        });
        let failed = lower_envelope([3, 1], &overflows, 0.1, 1e200);
        assert!(matches!(failed, Err(SolveError::NotSolved(_))), "{failed:?}");
    }
}
