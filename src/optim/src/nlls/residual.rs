//! Residuals written once, over any [`Scalar`]: the derivatives come from dual numbers.
//!
//! ```
//! use rowgram_optim::nlls::{Infeasible, Residual, Scalar, Vector};
//!
//! /// A tape measure from a known post to one whose position is wanted, metres.
//! struct Tape { from_m: [f64; 2], length_m: f64, sigma_m: f64 }
//!
//! impl Residual<1> for Tape {
//!     type Blocks = (Vector<2>,);
//!     fn evaluate<T: Scalar>(&self, (post,): ([T; 2],)) -> Result<[T; 1], Infeasible> {
//!         let length = (post[0] - self.from_m[0]).hypot(post[1] - self.from_m[1]);
//!         Ok([(length - self.length_m) / self.sigma_m])
//!     }
//! }
//! ```

use super::{
    dual::{Dual, Scalar},
    factor::{Batch, Infeasible, InfeasibleFactor, Jacobian, Values},
    manifold::direction_basis,
    problem::BlockId,
};
use crate::geometry::rotation;
use std::ops::Range;

/// Directions of derivatives in one evaluation; a residual of more is evaluated several times.
const DIRECTIONS: usize = 8;

/// What a residual sees of one block: its values as a type, with derivatives along the tangent.
pub trait Parameter {
    /// Numbers stored.
    const AMBIENT: usize;
    /// Tangent dimension.
    const TANGENT: usize;
    /// The block over `T`.
    type Of<T: Scalar>;

    /// The block at `values`; `increment(k)` is entry `k` of the tangent, 0 with its derivative.
    fn at<T: Scalar>(values: &[f64], increment: impl Fn(usize) -> T) -> Self::Of<T>;
}

/// `N` numbers ([`super::Euclidean`]), as `[T; N]`.
#[derive(Debug, Clone, Copy)]
pub struct Vector<const N: usize>;

impl<const N: usize> Parameter for Vector<N> {
    const AMBIENT: usize = N;
    const TANGENT: usize = N;
    type Of<T: Scalar> = [T; N];

    fn at<T: Scalar>(values: &[f64], increment: impl Fn(usize) -> T) -> [T; N] {
        std::array::from_fn(|k| increment(k) + values[k])
    }
}

/// A rotation over `T`, by the rows of its matrix.
#[derive(Debug, Clone, Copy)]
pub struct RotationMatrix<T>(pub [[T; 3]; 3]);

impl<T: Scalar> RotationMatrix<T> {
    /// `R x`.
    pub fn rotate(&self, x: [T; 3]) -> [T; 3] {
        self.0.map(|row| row[0] * x[0] + row[1] * x[1] + row[2] * x[2])
    }

    /// `R^T x`.
    pub fn rotate_back(&self, x: [T; 3]) -> [T; 3] {
        let r = &self.0;
        std::array::from_fn(|k| r[0][k] * x[0] + r[1][k] * x[1] + r[2][k] * x[2])
    }

    /// `R^T other`: the rotation between two.
    pub fn between(&self, other: &RotationMatrix<T>) -> RotationMatrix<T> {
        let columns: [[T; 3]; 3] = std::array::from_fn(|c| {
            self.rotate_back([other.0[0][c], other.0[1][c], other.0[2][c]])
        });
        RotationMatrix(std::array::from_fn(|r| std::array::from_fn(|c| columns[c][r])))
    }
}

/// The rotation of a quaternion, turned by a first-order increment: `(I + [w]) R`.
fn turned<T: Scalar>(q: &[f64], w: [T; 3]) -> RotationMatrix<T> {
    let r = rotation::matrix([q[0], q[1], q[2], q[3]]);
    let mut out = [[T::constant(0.0); 3]; 3];
    for c in 0..3 {
        let [x, y, z] = [r[0][c], r[1][c], r[2][c]];
        out[0][c] = w[1] * z - w[2] * y + x;
        out[1][c] = w[2] * x - w[0] * z + y;
        out[2][c] = w[0] * y - w[1] * x + z;
    }
    RotationMatrix(out)
}

/// A rotation ([`super::manifold::Rotation`]).
#[derive(Debug, Clone, Copy)]
pub struct RotationBlock;

impl Parameter for RotationBlock {
    const AMBIENT: usize = 4;
    const TANGENT: usize = 3;
    type Of<T: Scalar> = RotationMatrix<T>;

    fn at<T: Scalar>(values: &[f64], increment: impl Fn(usize) -> T) -> RotationMatrix<T> {
        turned(values, std::array::from_fn(increment))
    }
}

/// A rigid transformation over `T`: `y = R x + t`.
#[derive(Debug, Clone, Copy)]
pub struct RigidTransform<T> {
    /// `R`.
    pub rotation: RotationMatrix<T>,
    /// `t`.
    pub translation: [T; 3],
}

impl<T: Scalar> RigidTransform<T> {
    /// `R x + t`: from the world to the camera frame for `camera_from_world`.
    pub fn transform(&self, x: [T; 3]) -> [T; 3] {
        let turned = self.rotation.rotate(x);
        std::array::from_fn(|k| turned[k] + self.translation[k])
    }

    /// `R^T (y - t)`.
    pub fn transform_back(&self, y: [T; 3]) -> [T; 3] {
        self.rotation.rotate_back(std::array::from_fn(|k| y[k] - self.translation[k]))
    }
}

/// A rigid transformation ([`super::manifold::Pose`]).
#[derive(Debug, Clone, Copy)]
pub struct PoseBlock;

impl Parameter for PoseBlock {
    const AMBIENT: usize = 7;
    const TANGENT: usize = 6;
    type Of<T: Scalar> = RigidTransform<T>;

    fn at<T: Scalar>(values: &[f64], increment: impl Fn(usize) -> T) -> RigidTransform<T> {
        let w: [T; 3] = std::array::from_fn(&increment);
        let [x, y, z] = [values[4], values[5], values[6]];
        // t' = Exp(w) t + s.
        let moved = [
            w[1] * z - w[2] * y + increment(3) + x,
            w[2] * x - w[0] * z + increment(4) + y,
            w[0] * y - w[1] * x + increment(5) + z,
        ];
        RigidTransform { rotation: turned(values, w), translation: moved }
    }
}

/// A direction ([`super::manifold::UnitVector`]), as a unit `[T; 3]`.
#[derive(Debug, Clone, Copy)]
pub struct DirectionBlock;

impl Parameter for DirectionBlock {
    const AMBIENT: usize = 3;
    const TANGENT: usize = 2;
    type Of<T: Scalar> = [T; 3];

    fn at<T: Scalar>(values: &[f64], increment: impl Fn(usize) -> T) -> [T; 3] {
        let basis = direction_basis([values[0], values[1], values[2]]);
        let (a, b) = (increment(0), increment(1));
        std::array::from_fn(|k| a * basis[0][k] + b * basis[1][k] + values[k])
    }
}

/// The blocks of a residual: a tuple of one to four [`Parameter`]s.
pub trait Blocks {
    /// How many there are.
    const COUNT: usize;
    /// Sum of their tangent dimensions.
    const TANGENT: usize;
    /// The blocks over `T`.
    type Of<T: Scalar>;

    /// The blocks at `values`; `increment(k)` is entry `k` of all tangents side by side.
    fn at<T: Scalar>(values: &[&[f64]], increment: impl Fn(usize) -> T) -> Self::Of<T>;

    /// Numbers stored by each block.
    fn ambient() -> Vec<usize>;
}

macro_rules! tuple_of_blocks {
    ($count:literal: $($block:ident $index:tt),+) => {
        impl<$($block: Parameter),+> Blocks for ($($block,)+) {
            const COUNT: usize = $count;
            const TANGENT: usize = 0 $(+ $block::TANGENT)+;
            type Of<T: Scalar> = ($($block::Of<T>,)+);

            #[allow(unused_assignments, reason = "the last block has none behind it")]
            fn at<T: Scalar>(values: &[&[f64]], increment: impl Fn(usize) -> T) -> Self::Of<T> {
                let mut first = 0;
                ($({
                    let from = first;
                    first += $block::TANGENT;
                    $block::at(values[$index], |k| increment(from + k))
                },)+)
            }

            fn ambient() -> Vec<usize> {
                vec![$($block::AMBIENT),+]
            }
        }
    };
}

tuple_of_blocks!(1: A 0);
tuple_of_blocks!(2: A 0, B 1);
tuple_of_blocks!(3: A 0, B 1, C 2);
tuple_of_blocks!(4: A 0, B 1, C 2, D 3);

/// A residual of `ROWS` numbers, whitened (divided by its standard deviation).
///
/// Written once over [`Scalar`], it needs no derivatives. [`Residuals`] makes a batch of many.
pub trait Residual<const ROWS: usize>: Send + Sync {
    /// The blocks that it depends on.
    type Blocks: Blocks;

    /// The residual.
    ///
    /// # Errors
    /// [`Infeasible`] where it has no meaning.
    fn evaluate<T: Scalar>(
        &self,
        blocks: <Self::Blocks as Blocks>::Of<T>,
    ) -> Result<[T; ROWS], Infeasible>;

    /// Writes the Jacobian where it is derived by hand, and says whether it is; `jacobian` is zeroed.
    /// [`super::check::check_batch`] compares it with differences,
    /// [`Residuals::check_derivatives`] with dual numbers.
    fn jacobian(
        &self,
        _blocks: <Self::Blocks as Blocks>::Of<f64>,
        _jacobian: &mut Jacobian<'_>,
    ) -> bool {
        false
    }
}

/// A batch of residuals of one type, each with its blocks.
#[derive(Debug, Clone)]
pub struct Residuals<R, const ROWS: usize> {
    blocks: Vec<Vec<BlockId>>,
    residuals: Vec<R>,
}

impl<R: Residual<ROWS>, const ROWS: usize> Residuals<R, ROWS> {
    /// A batch of these residuals; the blocks of each in the order of [`Residual::Blocks`].
    pub fn new<const K: usize>(
        residuals: impl IntoIterator<Item = ([BlockId; K], R)>,
    ) -> Residuals<R, ROWS> {
        const { assert!(K == <R::Blocks as Blocks>::COUNT, "as many blocks as the residual has") }
        let pairs = residuals.into_iter().map(|(blocks, residual)| (blocks.to_vec(), residual));
        let (blocks, residuals) = pairs.unzip();
        Residuals { blocks, residuals }
    }

    /// The largest difference between a Jacobian derived by hand and that of dual numbers, relative
    /// to 1 or to the derivative, of residual `index` at the values of its blocks; 0 without one.
    ///
    /// # Errors
    /// [`Infeasible`] where the residual is.
    pub fn check_derivatives(&self, index: usize, values: &[&[f64]]) -> Result<f64, Infeasible> {
        let width = <R::Blocks as Blocks>::TANGENT;
        let (mut by_hand, mut dual) = (vec![0.0; ROWS * width], vec![0.0; ROWS * width]);
        let residual = &self.residuals[index];
        let blocks = <R::Blocks as Blocks>::at::<f64>(values, |_| 0.0);
        if !residual.jacobian(blocks, &mut Jacobian::new(&mut by_hand, width)) {
            return Ok(0.0);
        }
        differentiate(residual, values, &mut [0.0; ROWS], &mut dual)?;
        Ok(by_hand.iter().zip(&dual).fold(0.0, |worst: f64, (a, b)| {
            let error = (a - b).abs() / b.abs().max(1.0);
            if error > worst || error.is_nan() { error } else { worst }
        }))
    }
}

/// Value and Jacobian of one residual, by dual numbers.
fn differentiate<R: Residual<ROWS>, const ROWS: usize>(
    residual: &R,
    values: &[&[f64]],
    out: &mut [f64],
    jacobian: &mut [f64],
) -> Result<(), Infeasible> {
    let width = <R::Blocks as Blocks>::TANGENT;
    for first in (0..width).step_by(DIRECTIONS) {
        let count = DIRECTIONS.min(width - first);
        let seed = |k: usize| {
            if (first..first + count).contains(&k) {
                Dual::<DIRECTIONS>::variable(0.0, k - first)
            } else {
                Dual::constant(0.0)
            }
        };
        let found = residual.evaluate(<R::Blocks as Blocks>::at(values, seed))?;
        for (row, found) in found.iter().enumerate() {
            out[row] = found.value;
            jacobian[row * width + first..][..count].copy_from_slice(&found.derivatives[..count]);
        }
    }
    Ok(())
}

impl<R: Residual<ROWS>, const ROWS: usize> Batch for Residuals<R, ROWS> {
    fn len(&self) -> usize {
        self.residuals.len()
    }

    fn rows(&self) -> usize {
        ROWS
    }

    fn blocks(&self, factor: usize) -> &[BlockId] {
        &self.blocks[factor]
    }

    fn expected_sizes(&self) -> Option<(Vec<usize>, usize)> {
        Some((<R::Blocks as Blocks>::ambient(), <R::Blocks as Blocks>::TANGENT))
    }

    fn linearize(
        &self,
        range: Range<usize>,
        x: Values<'_>,
        residual: &mut [f64],
        mut jacobian: Option<&mut [f64]>,
        width: usize,
    ) -> Result<(), InfeasibleFactor> {
        for (k, factor) in range.enumerate() {
            let mut values: [&[f64]; 4] = [&[]; 4];
            for (value, &block) in values.iter_mut().zip(&self.blocks[factor]) {
                *value = x.block(block);
            }
            let values = &values[..<R::Blocks as Blocks>::COUNT];
            let one = &self.residuals[factor];
            let out = &mut residual[k * ROWS..(k + 1) * ROWS];
            let plain = |out: &mut [f64]| {
                let found = one.evaluate(<R::Blocks as Blocks>::at::<f64>(values, |_| 0.0))?;
                out.copy_from_slice(&found);
                Ok(())
            };
            let done = match jacobian.as_deref_mut() {
                None => plain(out),
                Some(all) => {
                    let entries = &mut all[k * ROWS * width..(k + 1) * ROWS * width];
                    let blocks = <R::Blocks as Blocks>::at::<f64>(values, |_| 0.0);
                    if one.jacobian(blocks, &mut Jacobian::new(entries, width)) {
                        plain(out)
                    } else {
                        differentiate(one, values, out, entries)
                    }
                }
            };
            done.map_err(|Infeasible| InfeasibleFactor(factor))?;
        }
        Ok(())
    }
}
