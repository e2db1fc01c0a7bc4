//! Factors between one retained and one eliminated block, with sizes known at compile time.
//!
//! This is the shape that carries the load of bundle adjustment. A factor is written once over
//! [`Lane`]s; from that the engine has the scalar form that every solver can use, and a fused one
//! that linearises several observations per register, eliminates each point while its Jacobians
//! are in the cache and stores nothing per observation ([`super::fused`]).

use super::{
    factor::{Batch, InfeasibleFactor, Values},
    problem::BlockId,
    schur::{FusedElimination, FusionRequest},
};
use crate::lanes::Lane;
use std::{marker::PhantomData, ops::Range};

/// How many numbers something has, as a type: [`Dim`].
pub trait Size: Send + Sync + 'static {
    /// So many numbers.
    type Of<T: Copy>: Copy;
}

/// `N` numbers.
#[derive(Debug, Clone, Copy)]
pub struct Dim<const N: usize>;

impl<const N: usize> Size for Dim<N> {
    type Of<T: Copy> = [T; N];
}

/// An array of the numbers that a [`Size`] says.
pub type Of<N, T> = <N as Size>::Of<T>;

/// Residual and Jacobians of one factor, or of one per lane.
#[derive(Clone, Copy)]
pub struct LinearizedProjection<L: Copy, R: Size, K: Size, S: Size, P: Size> {
    /// The residual.
    pub residual: R::Of<L>,
    /// By the tangent of the retained block.
    pub jacobian_camera: R::Of<K::Of<L>>,
    /// By the tangent of the shared block.
    pub jacobian_shared: R::Of<S::Of<L>>,
    /// By the eliminated block.
    pub jacobian_point: R::Of<P::Of<L>>,
}

/// What [`ProjectionFactor::linearize`] gives.
pub type Linearized<F, L> = LinearizedProjection<
    L,
    <F as ProjectionFactor>::Residual,
    <F as ProjectionFactor>::Camera,
    <F as ProjectionFactor>::Shared,
    <F as ProjectionFactor>::Point,
>;

/// A factor of a retained block (a camera), perhaps a block shared by many of those (a lens), and an
/// eliminated Euclidean block (a point).
///
/// In an implementation `Of<Self::Point, L>` is written `[L; 3]` where `Point` is `Dim<3>`. A value
/// that is not finite says that the factor is infeasible there.
pub trait ProjectionFactor: Sized + Send + Sync + 'static {
    /// The residual.
    type Residual: Size;
    /// The tangent of the retained block.
    type Camera: Size;
    /// The tangent of the shared block; `Dim<0>` where nothing is shared.
    type Shared: Size;
    /// The eliminated block.
    type Point: Size;
    /// What is prepared of a retained block and its shared one.
    type Prepared: Size;
    /// The data of an observation.
    type Data: Size;

    /// What all observations of one retained block need of it, once per linearisation: a rotation
    /// matrix, say.
    fn prepare(retained: &[f64], shared: &[f64]) -> Of<Self::Prepared, f64>;

    /// The residual alone.
    fn residual<L: Lane>(
        prepared: &Of<Self::Prepared, L>,
        point: &Of<Self::Point, L>,
        data: &Of<Self::Data, L>,
    ) -> Of<Self::Residual, L> {
        Self::linearize(prepared, point, data).residual
    }

    /// The residual and its Jacobians.
    fn linearize<L: Lane>(
        prepared: &Of<Self::Prepared, L>,
        point: &Of<Self::Point, L>,
        data: &Of<Self::Data, L>,
    ) -> Linearized<Self, L>;

    /// Whether a point is where the retained block can see it. Only a factor with finite residuals elsewhere, behind a camera say, has to
    /// tell.
    fn is_in_front(_prepared: &Of<Self::Prepared, f64>, _point: &Of<Self::Point, f64>) -> bool {
        true
    }
}

/// A [`ProjectionFactor`] with its sizes as numbers, which is what kernels are written for: `R` rows, `K`, `S` and `P`
/// tangent dimensions, `Q` prepared numbers, `D` numbers of data.
pub(super) trait SizedFactor<
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
>:
    ProjectionFactor<
        Residual = Dim<R>,
        Camera = Dim<K>,
        Shared = Dim<S>,
        Point = Dim<P>,
        Prepared = Dim<Q>,
        Data = Dim<D>,
    >
{
}

impl<
    F,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
> SizedFactor<R, K, S, P, Q, D> for F
where
    F: ProjectionFactor<
            Residual = Dim<R>,
            Camera = Dim<K>,
            Shared = Dim<S>,
            Point = Dim<P>,
            Prepared = Dim<Q>,
            Data = Dim<D>,
        >,
{
}

/// Retained blocks that are held prepared while observations are gone through one by one.
const RECENT: usize = 32;

/// One observation: its blocks and its data.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement<const D: usize> {
    /// Retained, shared (left out where nothing is shared), eliminated.
    blocks: [BlockId; 3],
    /// The data.
    pub data: [f64; D],
}

impl<const D: usize> Measurement<D> {
    /// An observation of `point` by `retained`.
    pub fn new(retained: BlockId, point: BlockId, data: [f64; D]) -> Measurement<D> {
        Measurement { blocks: [retained, point, point], data }
    }

    /// An observation of `point` by `retained`, which shares `shared` with others.
    pub fn with_shared(
        retained: BlockId,
        shared: BlockId,
        point: BlockId,
        data: [f64; D],
    ) -> Measurement<D> {
        Measurement { blocks: [retained, shared, point], data }
    }
}

/// A batch of such factors.
#[derive(Debug, Clone)]
pub struct ProjectionBatch<F, const D: usize> {
    pub(super) pairs: Vec<Measurement<D>>,
    factor: PhantomData<F>,
}

impl<F: ProjectionFactor<Data = Dim<D>>, const D: usize> ProjectionBatch<F, D> {
    /// A batch over these observations.
    pub fn new(_: F, pairs: Vec<Measurement<D>>) -> Self {
        ProjectionBatch { pairs, factor: PhantomData }
    }
}

/// How many blocks a factor has, with so many tangent dimensions of the shared one.
const fn arity(shared: usize) -> usize {
    if shared == 0 { 2 } else { 3 }
}

impl<
    F,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
> Batch for ProjectionBatch<F, D>
where
    F: ProjectionFactor<
            Residual = Dim<R>,
            Camera = Dim<K>,
            Shared = Dim<S>,
            Point = Dim<P>,
            Prepared = Dim<Q>,
            Data = Dim<D>,
        >,
{
    fn len(&self) -> usize {
        self.pairs.len()
    }

    fn rows(&self) -> usize {
        R
    }

    fn blocks(&self, factor: usize) -> &[BlockId] {
        &self.pairs[factor].blocks[..arity(S)]
    }

    fn linearize(
        &self,
        range: Range<usize>,
        x: Values<'_>,
        residual: &mut [f64],
        mut jacobian: Option<&mut [f64]>,
        width: usize,
    ) -> Result<(), InfeasibleFactor> {
        let first = range.start;
        // Observations come point by point, so the same few retained blocks come again and again.
        let mut recent: [Option<([BlockId; 2], [f64; Q])>; RECENT] = [None; RECENT];
        for (k, pair) in self.pairs[range].iter().enumerate() {
            let of = [pair.blocks[0], pair.blocks[1]];
            let of = if S == 0 { [of[0]; 2] } else { of };
            let place = &mut recent[of[0].index() % RECENT];
            let prepared = match place {
                Some((known, prepared)) if *known == of => prepared,
                place => {
                    let shared = if S == 0 { &[][..] } else { x.block(of[1]) };
                    &mut place.insert((of, F::prepare(x.block(of[0]), shared))).1
                }
            };
            let prepared = &*prepared;
            let values = x.block(pair.blocks[arity(S) - 1]);
            let point: [f64; P] = std::array::from_fn(|i| values[i]);
            let out = &mut residual[k * R..(k + 1) * R];
            match jacobian.as_deref_mut() {
                None => out.copy_from_slice(&F::residual(prepared, &point, &pair.data)),
                Some(all) => {
                    let found = F::linearize(prepared, &point, &pair.data);
                    out.copy_from_slice(&found.residual);
                    for row in 0..R {
                        let to = &mut all[(k * R + row) * width..(k * R + row + 1) * width];
                        to[..K].copy_from_slice(&found.jacobian_camera[row]);
                        to[K..K + S].copy_from_slice(&found.jacobian_shared[row]);
                        to[K + S..].copy_from_slice(&found.jacobian_point[row]);
                    }
                }
            }
            if out.iter().any(|v| !v.is_finite()) {
                return Err(InfeasibleFactor(first + k));
            }
        }
        Ok(())
    }

    fn fuse(&self, request: FusionRequest<'_>) -> Result<FusedElimination, String> {
        FusedElimination::new::<F, R, K, S, P, Q, D>(&self.pairs, request)
    }
}

impl<const D: usize> Measurement<D> {
    #[inline(always)]
    pub(super) fn retained(&self) -> BlockId {
        self.blocks[0]
    }

    #[inline(always)]
    pub(super) fn shared(&self) -> BlockId {
        self.blocks[1]
    }
}
