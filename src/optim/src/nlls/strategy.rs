//! Which way the reduced system is solved: what a step costs each way, estimated from the structure alone.
//!
//! ```text
//! formed:      c_pair sum_points n (n + 1) / 2  +  c_factor (multiply-adds of Cholesky along the order found)
//! not formed:  c_keep (observations)  +  c_product (products) (observations)
//! ```
//!
//! with `n` the observations of a point. How many products conjugate gradients will need is not known beforehand;
//! [`PRODUCTS`] are taken for granted.

use super::{
    LinearSolver,
    cholesky::{BlockMatrix, Cholesky, Order},
    conjugate::ConjugateGradients,
    schur_solver::SchurSolver,
    structure::Structure,
    summary::{LinearKind, LinearPath},
};

/// What has been chosen, and why.
#[derive(Debug)]
pub(super) struct Strategy {
    way: Way,
    why: String,
}

#[derive(Debug)]
enum Way {
    Direct(Order),
    Iterative,
    Implicit,
}

/// Nanoseconds of processor time, nine parameters per camera, AVX-512, on a machine that others used as well (only ratios
/// matter): `rowgram adjust` on `synth bundle --preset dubrovnik-356` and `ladybug-1723`, with `--solver schur` and
/// `--solver iterative-schur`.
const PAIR_NS: f64 = 30.0;
const MULTIPLY_ADD_NS: f64 = 0.2;
const KEEP_NS: f64 = 60.0;
const PRODUCT_NS: f64 = 35.0;
/// Products of one step: `trafalgar-257` takes 7 and 62 in the first two, then 140 to 300.
const PRODUCTS: f64 = 150.0;
/// The reduced system has to have at least this many unknowns before anything but a factorisation is thought of.
const MIN_DIMENSION: usize = 1000;

impl Strategy {
    pub(super) fn is_implicit(&self) -> bool {
        matches!(self.way, Way::Implicit)
    }

    /// The solver for `matrix`, and what to say of it.
    pub(super) fn solver(self, matrix: &BlockMatrix, tolerance: f64) -> (SchurSolver, LinearPath) {
        let iteration = |matrix| ConjugateGradients::new(matrix, tolerance);
        let (solver, kind) = match self.way {
            Way::Direct(order) => {
                let dense = order.is_dense();
                let kind =
                    if dense { LinearKind::DenseCholesky } else { LinearKind::SparseCholesky };
                (SchurSolver::Direct(Cholesky::new(matrix, order)), kind)
            }
            Way::Iterative => {
                (SchurSolver::Iterative(iteration(matrix)), LinearKind::ConjugateGradients)
            }
            Way::Implicit => {
                (SchurSolver::Implicit(iteration(matrix)), LinearKind::ImplicitConjugateGradients)
            }
        };
        (solver, LinearPath { kind, why: self.why })
    }
}

/// Chooses for the reduced system with the pattern of `matrix`; `fuse` where points may be eliminated without being
/// stored.
pub(super) fn choose(
    structure: &Structure,
    matrix: &BlockMatrix,
    linear: LinearSolver,
    fuse: bool,
) -> Strategy {
    let refused = if !fuse {
        Some("Jacobians are stored")
    } else if !structure.single_retained {
        Some("factors depend on several retained blocks")
    } else if !structure.camera_only_factors.is_empty() {
        Some("factors depend on retained blocks alone")
    } else {
        None
    };
    match (linear, refused) {
        (LinearSolver::IterativeSchur, None) => {
            Strategy { way: Way::Implicit, why: "asked for".into() }
        }
        (LinearSolver::Auto, None) if matrix.dimension() >= MIN_DIMENSION => {
            let order = Cholesky::order(matrix, false);
            let formed = PAIR_NS * structure.joined_pairs() + MULTIPLY_ADD_NS * order.work();
            let observations = structure.factor_count() as f64;
            let implicit = (KEEP_NS + PRODUCT_NS * PRODUCTS) * observations;
            let why = format!(
                "a step is estimated at {:.2} s with a factor of {:.0} MB, at {:.2} s with {PRODUCTS} products",
                1e-9 * formed,
                8e-6 * order.factor_len() as f64,
                1e-9 * implicit
            );
            let way = if implicit < formed { Way::Implicit } else { Way::Direct(order) };
            Strategy { way, why }
        }
        _ => explicit(matrix, linear, refused.unwrap_or("there are few unknowns")),
    }
}

/// The choice where the matrix is formed; `why` it has to be.
pub(super) fn explicit(matrix: &BlockMatrix, linear: LinearSolver, why: &str) -> Strategy {
    match linear {
        LinearSolver::IterativeSchur => {
            Strategy { way: Way::Iterative, why: format!("asked for; {why}") }
        }
        LinearSolver::Auto => {
            Strategy { way: Way::Direct(Cholesky::order(matrix, false)), why: why.into() }
        }
        LinearSolver::Dense | LinearSolver::Sparse | LinearSolver::Schur => {
            let order = Cholesky::order(matrix, linear == LinearSolver::Dense);
            Strategy { way: Way::Direct(order), why: "asked for".into() }
        }
    }
}
