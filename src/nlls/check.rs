//! Tests analytic Jacobians against central differences; for users' factors as for ours.

use super::{
    factor::{Factor, Jacobian},
    problem::Problem,
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
                if worst.is_none_or(|w| error > w.error || error.is_nan()) {
                    worst = Some(JacobianCheck { error, row, block, entry, analytic, difference });
                }
            }
            column += 1;
        }
    }
    worst
}

/// Compares the Jacobians of `factors` of the batch called `name` at `x` with central differences,
/// as [`check_jacobian`] does for one factor; the place of the worst is that in its factor.
///
/// `None` where there is no such batch or factor, or one is infeasible.
pub fn check_batch(
    problem: &Problem,
    x: &[f64],
    name: &str,
    factors: std::ops::Range<usize>,
) -> Option<JacobianCheck> {
    let named = problem.batches.iter().find(|named| named.name == name)?;
    let mut worst: Option<JacobianCheck> = None;
    for factor in factors {
        if factor >= named.batch.len() {
            return None;
        }
        let one = OfBatch { problem, named, factor, x };
        let blocks = named.batch.blocks(factor);
        let spaces: Vec<Space> = blocks.iter().map(|&block| problem.space(block)).collect();
        let values: Vec<&[f64]> = blocks.iter().map(|&block| problem.values(x, block)).collect();
        let check = check_jacobian(&one, &spaces, &values)?;
        if worst.is_none_or(|w| check.error > w.error || check.error.is_nan()) {
            worst = Some(check);
        }
    }
    worst
}

/// One factor of a batch as a factor of its own.
struct OfBatch<'a> {
    problem: &'a Problem,
    named: &'a super::problem::NamedBatch,
    factor: usize,
    x: &'a [f64],
}

impl Factor for OfBatch<'_> {
    fn rows(&self) -> usize {
        self.named.batch.rows()
    }

    fn blocks(&self) -> &[super::BlockId] {
        self.named.batch.blocks(self.factor)
    }

    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        jacobian: Option<&mut Jacobian<'_>>,
    ) -> Result<(), super::Infeasible> {
        let mut values = self.x.to_vec();
        for (&block, new) in self.blocks().iter().zip(x) {
            let at = self.problem.offsets[block.index()];
            values[at..at + new.len()].copy_from_slice(new);
        }
        self.named
            .batch
            .linearize(
                self.factor..self.factor + 1,
                self.problem.point(&values),
                residual,
                jacobian.map(Jacobian::entries),
                self.named.width,
            )
            .map_err(|_| super::Infeasible)
    }
}
