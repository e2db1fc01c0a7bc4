//! Tests analytic Jacobians against central differences; for users' factors as for ours.

use super::{
    factor::{Factor, Jacobian},
    space::Space,
};

/// The entry of a Jacobian that differs most from its central difference.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JacobianCheck {
    /// `|analytic - difference| / max(1, |difference|)`.
    pub error: f64,
    /// Row of the residual.
    pub row: usize,
    /// Which of the factor's blocks.
    pub block: usize,
    /// Entry of that block's tangent.
    pub entry: usize,
    /// The factor's own derivative.
    pub analytic: f64,
    /// The central difference.
    pub difference: f64,
}

/// Compares the Jacobian of `factor` at `x` (one slice per block, in `spaces`) with central
/// differences along each tangent, extrapolated once (error `O(h^4)`).
///
/// `None` where the factor is infeasible at `x` or a step away from it.
pub fn check_jacobian(
    factor: &dyn Factor,
    spaces: &[Space],
    x: &[&[f64]],
) -> Option<JacobianCheck> {
    let rows = factor.rows();
    let width: usize = spaces.iter().map(|space| space.tangent()).sum();
    let mut residual = vec![0.0; rows];
    let mut entries = vec![0.0; rows * width];
    factor.linearize(x, &mut residual, Some(&mut Jacobian::new(&mut entries, width))).ok()?;
    let mut worst: Option<JacobianCheck> = None;
    let mut column = 0;
    for (block, space) in spaces.iter().enumerate() {
        for entry in 0..space.tangent() {
            let along = |h: f64| -> Option<Vec<f64>> {
                let mut d = vec![0.0; space.tangent()];
                let mut moved = vec![0.0; space.ambient()];
                d[entry] = h;
                space.plus(x[block], &d, &mut moved);
                let mut values = x.to_vec();
                values[block] = &moved;
                let mut residual = vec![0.0; rows];
                factor.linearize(&values, &mut residual, None).ok()?;
                Some(residual)
            };
            let scale = x[block].iter().fold(1.0, |most: f64, v| v.abs().max(most));
            let h = 1e-4 * if matches!(space, Space::Euclidean(_)) { scale } else { 1.0 };
            let central = |h: f64| -> Option<Vec<f64>> {
                let (high, low) = (along(h)?, along(-h)?);
                Some(high.iter().zip(&low).map(|(a, b)| (a - b) / (2.0 * h)).collect())
            };
            let (wide, narrow) = (central(h)?, central(0.5 * h)?);
            for row in 0..rows {
                let difference = (4.0 * narrow[row] - wide[row]) / 3.0;
                let analytic = entries[row * width + column];
                let error = (analytic - difference).abs() / difference.abs().max(1.0);
                // A NaN must not look small.
                if worst.is_none_or(|w| !(error <= w.error)) {
                    worst = Some(JacobianCheck { error, row, block, entry, analytic, difference });
                }
            }
            column += 1;
        }
    }
    worst
}
