//! Camera positions from the directions of their baselines, all at once.
//!
//! ```text
//! min sum_e w_e |C_j - C_i - d_e b_e|   subject to  d_e >= 1,  C_0 = 0
//! ```
//!
//! a second-order cone programme: least unsquared deviations, which wrong directions do not pull along.
//! The bound on the lengths keeps all positions from being one. Reference: O. Oezyesil and A. Singer,
//! *Robust camera location estimation by convex programming*, CVPR 2015.

use super::sparse;
use crate::engine::SolveError;
use clarabel::{
    algebra::CscMatrix,
    solver::{DefaultSettings, DefaultSolver, IPSolver, SolverStatus, SupportedConeT},
};

/// A direction from one camera to another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Baseline {
    /// Indices of the cameras.
    pub ends: [usize; 2],
    /// The unit vector from the first to the second, in the world.
    pub direction: [f64; 3],
    /// How much it counts.
    pub weight: f64,
}

/// Positions of `count` cameras, the first at the origin, in units of about the shortest baseline.
///
/// # Errors
/// [`SolveError::Misuse`] for ends that are not there or without a baseline,
/// [`SolveError::NotSolved`] where the interior-point method fails.
pub fn positions(count: usize, baselines: &[Baseline]) -> Result<Vec<[f64; 3]>, SolveError> {
    let fits = |b: &Baseline| {
        b.ends.iter().all(|&k| k < count) && b.ends[0] != b.ends[1] && b.weight > 0.0
    };
    if count < 2 || baselines.is_empty() || !baselines.iter().all(fits) {
        return Err(SolveError::Misuse(
            "positions need cameras and baselines between two of them with positive weights".into(),
        ));
    }
    let edges = baselines.len();
    // Columns: 3 (count - 1) coordinates, then the lengths d, then the deviations t.
    // Rows: edges of d >= 1, then a cone (t, C_j - C_i - d b) of four for each edge; s = b - A x.
    let (of_d, of_t) = (3 * (count - 1), 3 * (count - 1) + edges);
    let columns = of_t + edges;
    let mut entries: Vec<Vec<(usize, f64)>> = vec![Vec::new(); columns];
    for (e, baseline) in baselines.iter().enumerate() {
        entries[of_d + e].push((e, -1.0));
        let first = edges + 4 * e;
        entries[of_t + e].push((first, -1.0));
        for axis in 0..3 {
            let row = first + 1 + axis;
            let [i, j] = baseline.ends;
            for (camera, sign) in [(i, 1.0), (j, -1.0)] {
                if camera > 0 {
                    entries[3 * (camera - 1) + axis].push((row, sign));
                }
            }
            entries[of_d + e].push((row, baseline.direction[axis]));
        }
    }
    let constraints = sparse(5 * edges, &mut entries);
    let mut right = vec![-1.0; edges];
    right.resize(5 * edges, 0.0);
    let mut cones = vec![SupportedConeT::NonnegativeConeT(edges)];
    cones.extend(std::iter::repeat_n(SupportedConeT::SecondOrderConeT(4), edges));
    let objective = CscMatrix::new(columns, columns, vec![0; columns + 1], vec![], vec![]);
    let mut linear = vec![0.0; of_t];
    linear.extend(baselines.iter().map(|b| b.weight));
    let settings = DefaultSettings { verbose: false, max_threads: 1, ..DefaultSettings::default() };
    let failed = |what: String| SolveError::NotSolved(format!("camera positions: {what}"));
    let mut solver =
        DefaultSolver::new(&objective, &linear, &constraints, &right, &cones, settings)
            .map_err(|error| failed(error.to_string()))?;
    solver.solve();
    let x = &solver.solution.x;
    match solver.solution.status {
        SolverStatus::Solved | SolverStatus::AlmostSolved if x.iter().all(|v| v.is_finite()) => {}
        status => return Err(failed(status.to_string())),
    }
    let of = |camera: usize| -> [f64; 3] {
        if camera == 0 {
            return [0.0; 3];
        }
        std::array::from_fn(|axis| x[3 * (camera - 1) + axis])
    };
    Ok((0..count).map(of).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_grid_of_cameras_comes_back_from_its_directions() {
        let truth: Vec<[f64; 3]> = (0..12)
            .map(|k| {
                let (i, j) = (f64::from(k % 4), f64::from(k / 4));
                [1.3 * i, 1.6 * j, 0.2 * (i * 2.0 + j).sin()]
            })
            .collect();
        let mut baselines = Vec::new();
        for i in 0..12 {
            for j in i + 1..12 {
                let d: [f64; 3] = std::array::from_fn(|k| truth[j][k] - truth[i][k]);
                let length = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
                if length < 2.5 {
                    let direction = d.map(|v| v / length);
                    baselines.push(Baseline { ends: [i, j], direction, weight: 1.0 });
                }
            }
        }
        // A wrong direction pulls nothing along.
        baselines[3].direction = [0.0, 0.0, 1.0];
        let found = positions(12, &baselines).unwrap();
        let norm = |of: &[[f64; 3]]| {
            of.iter()
                .map(|p| (0..3).map(|k| (p[k] - of[0][k]).powi(2)).sum::<f64>())
                .sum::<f64>()
                .sqrt()
        };
        let scale = norm(&truth) / norm(&found);
        for (a, b) in found.iter().zip(&truth) {
            for k in 0..3 {
                let error = (scale * (a[k] - found[0][k]) - (b[k] - truth[0][k])).abs();
                assert!(error < 1e-4, "{a:?} {b:?} {error}");
            }
        }
    }

    #[test]
    fn bad_input_is_refused() {
        assert!(positions(3, &[]).is_err());
        let loop_to_itself = Baseline { ends: [1, 1], direction: [1.0, 0.0, 0.0], weight: 1.0 };
        assert!(positions(3, &[loop_to_itself]).is_err());
    }
}
