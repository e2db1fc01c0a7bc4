//! Tests for factors, manifolds and losses of your own, the same as for the built-in ones: Jacobians
//! against central differences, and the invariants of manifolds and losses.

use super::{
    factor::{Factor, Jacobian},
    loss::LossFunction,
    manifold::{self, Manifold},
    problem::Problem,
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

/// Compares the Jacobian of `factor` at `x` (one slice per block, on `manifolds`) with central
/// differences along each tangent, extrapolated once (error `O(h^4)`).
///
/// `None` where the factor is infeasible at `x` or a step away from it.
pub fn check_jacobian(
    factor: &dyn Factor,
    manifolds: &[&dyn Manifold],
    x: &[&[f64]],
) -> Option<JacobianCheck> {
    let rows = factor.rows();
    let width: usize = manifolds.iter().map(|m| m.tangent()).sum();
    let mut residual = vec![0.0; rows];
    let mut entries = vec![0.0; rows * width];
    factor.linearize(x, &mut residual, Some(&mut Jacobian::new(&mut entries, width))).ok()?;
    let mut worst: Option<JacobianCheck> = None;
    let mut column = 0;
    for (block, manifold) in manifolds.iter().enumerate() {
        for entry in 0..manifold.tangent() {
            let along = |h: f64| -> Option<Vec<f64>> {
                let mut d = vec![0.0; manifold.tangent()];
                let mut moved = vec![0.0; manifold.ambient()];
                d[entry] = h;
                manifold.plus(x[block], &d, &mut moved);
                let mut values = x.to_vec();
                values[block] = &moved;
                let mut residual = vec![0.0; rows];
                factor.linearize(&values, &mut residual, None).ok()?;
                Some(residual)
            };
            let scale = x[block].iter().fold(1.0, |most: f64, v| v.abs().max(most));
            let h = 1e-4 * if manifold.is_euclidean() { scale } else { 1.0 };
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
        let manifolds: Vec<&dyn Manifold> =
            blocks.iter().map(|&block| problem.manifold(block)).collect();
        let values: Vec<&[f64]> = blocks.iter().map(|&block| problem.values(x, block)).collect();
        let check = check_jacobian(&one, &manifolds, &values)?;
        if worst.is_none_or(|w| check.error > w.error || check.error.is_nan()) {
            worst = Some(check);
        }
    }
    worst
}

/// Checks the invariants of a manifold at its points `x` and `y` and for the tangent vector `d`
/// (shorter than the injectivity radius at `x`), to `tolerance` in every number: `x (+) 0 = x`,
/// `x (+) (y (-) x) = y`, `(x (+) d) (-) x = d`, and that results lie on the manifold.
///
/// # Errors
/// Says which invariant is broken, and by how much.
pub fn check_manifold(
    manifold: &dyn Manifold,
    x: &[f64],
    y: &[f64],
    d: &[f64],
    tolerance: f64,
) -> Result<(), String> {
    let (ambient, tangent) = (manifold.ambient(), manifold.tangent());
    for (name, point) in [("x", x), ("y", y)] {
        if let Some(defect) = manifold::defect(manifold, point) {
            return Err(format!("{name} is not on {manifold:?}: {defect}"));
        }
    }
    let (mut moved, mut back) = (vec![0.0; ambient], vec![0.0; tangent]);
    let distance = |a: &[f64], b: &[f64]| {
        // A NaN must not look small.
        a.iter()
            .zip(b)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, |most: f64, v| if v > most || v.is_nan() { v } else { most })
    };
    let require = |law: &str, error: f64| {
        if error <= tolerance {
            Ok(())
        } else {
            Err(format!("{law} on {manifold:?}: off by {error:e}"))
        }
    };
    manifold.plus(x, &vec![0.0; tangent], &mut moved);
    require("x (+) 0 = x", distance(&moved, x))?;
    manifold.minus(y, x, &mut back);
    manifold.plus(x, &back, &mut moved);
    // Two sets of values may mean the same point, as q and -q do: the tangent between them tells.
    let mut between = vec![0.0; tangent];
    manifold.minus(&moved, y, &mut between);
    require("x (+) (y (-) x) = y", distance(&between, &vec![0.0; tangent]))?;
    manifold.plus(x, d, &mut moved);
    if let Some(defect) = manifold::defect(manifold, &moved) {
        return Err(format!("x (+) d is not on {manifold:?}: {defect}"));
    }
    manifold.minus(&moved, x, &mut back);
    require("(x (+) d) (-) x = d", distance(&back, d))
}

/// Checks the invariants of a loss at `s = |r|^2 > 0`: `rho(0) = 0`, `rho'(0) = 1`, `rho' >= 0`,
/// `rho'' <= 0`, `rho(s) <= s`, and both derivatives against central differences. `s` must not be
/// where `rho''` jumps.
///
/// # Errors
/// Says which invariant is broken.
pub fn check_loss(loss: &dyn LossFunction, s: f64) -> Result<(), String> {
    let zero = loss.evaluate(0.0);
    if zero.value.abs() > 1e-15 || (zero.first - 1.0).abs() > 1e-12 {
        return Err(format!(
            "{loss:?}: rho(0) = {}, rho'(0) = {}; expected 0 and 1",
            zero.value, zero.first
        ));
    }
    let h = 1e-5 * (1.0 + s).min(s);
    let (low, here, high) = (loss.evaluate(s - h), loss.evaluate(s), loss.evaluate(s + h));
    if !(here.first >= 0.0 && here.second <= 0.0 && here.value <= s * (1.0 + 1e-15)) {
        return Err(format!("{loss:?} at {s}: {here:?}; expected rho' >= 0, rho'' <= 0, rho <= s"));
    }
    let first = (high.value - low.value) / (2.0 * h);
    let second = (high.first - low.first) / (2.0 * h);
    let wrong = |a: f64, b: f64, tolerance: f64| (a - b).abs() > tolerance || (a - b).is_nan();
    if wrong(first, here.first, 1e-6) {
        return Err(format!("{loss:?} at {s}: rho' is {}, the difference {first}", here.first));
    }
    if wrong(second, here.second, 1e-6 / s.min(1.0)) {
        return Err(format!("{loss:?} at {s}: rho'' is {}, the difference {second}", here.second));
    }
    Ok(())
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
                self.problem.all_values(&values),
                residual,
                jacobian.map(Jacobian::entries),
                self.named.width,
            )
            .map_err(|_| super::Infeasible)
    }
}
