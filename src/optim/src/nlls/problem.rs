//! A nonlinear least-squares problem: `min 1/2 sum_i rho_i(|r_i(x)|^2)` over blocks of parameters.

use super::{
    factor::{Batch, InfeasibleFactor, MAX_ARITY, Values, batch_cost, batch_residuals},
    loss::{BatchLoss, LossFunction},
    manifold::{self, MAX_TANGENT, Manifold},
    sight,
};
use crate::engine::SolveError;
use std::any::Any;

/// Names a parameter block of one [`Problem`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct BlockId(u32);

impl BlockId {
    /// Its place among the blocks of the problem, in the order in which they were made.
    #[inline]
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

/// What the engine knows of one block.
#[derive(Debug, Clone, Copy)]
pub(super) struct Block {
    /// Index of its manifold in [`Problem::manifolds`].
    manifold: u32,
    /// Tangent dimension.
    pub(super) dimension: usize,
    /// Where its tangent begins in vectors over all blocks.
    pub(super) tangent: usize,
    /// Bit `k` set: entry `k` of the tangent does not move.
    pub(super) frozen: u64,
    pub(super) eliminate: bool,
    group: u32,
    /// Index of where it is seen from in [`Problem::sights`], or [`NO_SIGHT`].
    sight: u32,
}

const NO_SIGHT: u32 = u32::MAX;

impl Block {
    pub(super) fn is_fixed(&self) -> bool {
        self.frozen == all_entries(self.dimension)
    }
}

fn all_entries(n: usize) -> u64 {
    if n == 64 { u64::MAX } else { (1 << n) - 1 }
}

pub(super) struct NamedBatch {
    pub(super) name: String,
    pub(super) loss: BatchLoss,
    pub(super) batch: Box<dyn Batch>,
    /// Sum of the tangent dimensions of the blocks of each factor.
    pub(super) width: usize,
    /// Tangent dimension of each block of each factor.
    pub(super) dims: Vec<usize>,
}

/// A problem under construction or being solved.
///
/// Blocks are made first, then factors are added in named batches. What is fixed and what is
/// eliminated may be changed until an engine starts on it.
#[derive(Default)]
pub struct Problem {
    pub(super) blocks: Vec<Block>,
    /// Where the values of each block begin; one more entry than blocks.
    pub(super) offsets: Vec<usize>,
    pub(super) batches: Vec<NamedBatch>,
    initial: Vec<f64>,
    /// Every manifold that a block lives on, once.
    manifolds: Vec<Box<dyn Manifold>>,
    groups: Vec<(String, usize)>,
    sights: Vec<[f64; 3]>,
}

impl std::fmt::Debug for Problem {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Problem")
            .field("blocks", &self.blocks.len())
            .field("batches", &self.batches.iter().map(|b| &b.name).collect::<Vec<_>>())
            .finish_non_exhaustive()
    }
}

impl Problem {
    /// A problem without blocks and factors.
    pub fn new() -> Problem {
        Problem { offsets: vec![0], ..Problem::default() }
    }

    /// Adds a block on `manifold` with its starting values. Blocks of one `kind` that are made one
    /// after the other are counted from 0 in messages: "camera 17".
    ///
    /// # Errors
    /// [`SolveError::Misuse`] where the values do not lie on the manifold.
    pub fn block<M: Manifold + PartialEq>(
        &mut self,
        kind: &str,
        manifold: M,
        values: &[f64],
    ) -> Result<BlockId, SolveError> {
        let index = self.blocks.len();
        if self.groups.last().is_none_or(|(name, _)| name != kind) {
            self.groups.push((kind.to_owned(), index));
        }
        let group = self.groups.len() - 1;
        let name = || format!("{kind} {}", index - self.groups[group].1);
        let dimension = manifold.tangent();
        if !(1..=MAX_TANGENT).contains(&dimension) {
            return Err(SolveError::Misuse(format!(
                "{}: a block must have 1 to {MAX_TANGENT} degrees of freedom, {manifold:?} has {dimension}",
                name()
            )));
        }
        if let Some(defect) = manifold::defect(&manifold, values) {
            return Err(SolveError::Misuse(format!("{}: {defect}", name())));
        }
        let too_many = || SolveError::Misuse("more blocks than can be counted".into());
        let id = u32::try_from(index).map_err(|_| too_many())?;
        let group = u32::try_from(group).map_err(|_| too_many())?;
        let known = self.manifolds.iter().position(|known| {
            let known: &dyn Any = known.as_ref();
            known.downcast_ref::<M>() == Some(&manifold)
        });
        let manifold = known.unwrap_or_else(|| {
            self.manifolds.push(Box::new(manifold));
            self.manifolds.len() - 1
        });
        let manifold = u32::try_from(manifold).map_err(|_| too_many())?;
        let tangent = self.tangent_len();
        self.blocks.push(Block {
            manifold,
            dimension,
            tangent,
            frozen: 0,
            eliminate: false,
            group,
            sight: NO_SIGHT,
        });
        self.initial.extend_from_slice(values);
        self.offsets.push(self.initial.len());
        Ok(BlockId(id))
    }

    /// Keeps a block at its starting values.
    pub fn fix(&mut self, block: BlockId) {
        let block = &mut self.blocks[block.index()];
        block.frozen = all_entries(block.dimension);
    }

    /// Keeps some entries of a block's tangent from moving.
    ///
    /// # Errors
    /// [`SolveError::Misuse`] for an entry that the block does not have.
    pub fn fix_entries(&mut self, block: BlockId, entries: &[usize]) -> Result<(), SolveError> {
        let dimension = self.blocks[block.index()].dimension;
        if let Some(entry) = entries.iter().find(|&&entry| entry >= dimension) {
            return Err(SolveError::Misuse(format!(
                "{} has no entry {entry}, only {dimension}",
                self.describe(block)
            )));
        }
        for entry in entries {
            self.blocks[block.index()].frozen |= 1 << entry;
        }
        Ok(())
    }

    /// Keeps every block that no factor depends on at its starting values, and returns which these are: an engine refuses
    /// to move what nothing determines.
    pub fn fix_unused(&mut self) -> Vec<BlockId> {
        let mut used = vec![false; self.blocks.len()];
        for batch in self.batches.iter().map(|named| &named.batch) {
            for block in (0..batch.len()).flat_map(|factor| batch.blocks(factor)) {
                used[block.index()] = true;
            }
        }
        let unused: Vec<BlockId> = (0..used.len()).filter(|&k| !used[k]).map(Problem::id).collect();
        unused.iter().for_each(|&block| self.fix(block));
        unused
    }

    /// Lets a block move again.
    pub fn free(&mut self, block: BlockId) {
        self.blocks[block.index()].frozen = 0;
    }

    /// Marks a block to be eliminated first by the Schur solver. No factor may join two of them.
    pub fn eliminate(&mut self, block: BlockId) {
        self.blocks[block.index()].eliminate = true;
    }

    /// Says that a block is a point that is seen from about `from`: steps then move it straight in inverse distance, and
    /// only as far away as is sensible.
    ///
    /// # Errors
    /// [`SolveError::Misuse`] where the block is not `Euclidean(3)`.
    pub fn seen_from(&mut self, block: BlockId, from: [f64; 3]) -> Result<(), SolveError> {
        if !self.manifold(block).is_euclidean() || self.blocks[block.index()].dimension != 3 {
            let name = self.describe(block);
            return Err(SolveError::Misuse(format!("{name} is no point of space to be seen")));
        }
        if let Some(axis) = from.iter().position(|v| !v.is_finite()) {
            let name = self.describe(block);
            return Err(SolveError::Misuse(format!("{name} is seen from {}", from[axis])));
        }
        let sight = u32::try_from(self.sights.len());
        self.blocks[block.index()].sight =
            sight.map_err(|_| SolveError::Misuse("more points than can be counted".into()))?;
        self.sights.push(from);
        Ok(())
    }

    /// Where a block is seen from, if that is known.
    pub(super) fn sight(&self, block: usize) -> Option<&[f64; 3]> {
        self.sights.get(self.blocks[block].sight as usize)
    }

    fn move_block(&self, block: &Block, x: &[f64], d: &[f64], out: &mut [f64]) {
        // A point with an entry that must not move can only go straight.
        let sight = self.sights.get(block.sight as usize).filter(|_| block.frozen == 0);
        match (sight, x, d) {
            (Some(from), &[a, b, c], &[e, f, g]) => {
                out.copy_from_slice(&sight::moved(from, &[a, b, c], &[e, f, g]));
            }
            _ => self.manifold_of(block).plus(x, d, out),
        }
    }

    /// Adds a batch of factors under a name that summaries will use.
    ///
    /// # Errors
    /// [`SolveError::Misuse`] where the batch is empty, its factors differ in shape, name a block
    /// twice or one that is not there, or the loss has no meaning.
    pub fn add(
        &mut self,
        name: &str,
        loss: impl LossFunction,
        batch: impl Batch + 'static,
    ) -> Result<(), SolveError> {
        let misuse =
            |message: String| Err(SolveError::Misuse(format!("batch {name:?}: {message}")));
        if batch.is_empty() {
            return misuse("it has no factors".into());
        }
        if batch.rows() == 0 {
            return misuse("its residuals have no rows".into());
        }
        if let Some(defect) = loss.defect() {
            return misuse(defect);
        }
        if self.batches.iter().any(|other| other.name == name) {
            return misuse("there is another batch of this name".into());
        }
        let (mut dims, expected) = (Vec::new(), batch.expected_sizes());
        for factor in 0..batch.len() {
            if batch.rows_of(factor) != batch.rows() {
                return misuse(format!(
                    "factor {factor} has {} rows, factor 0 has {}",
                    batch.rows_of(factor),
                    batch.rows()
                ));
            }
            let blocks = batch.blocks(factor);
            if let Some((ambient, tangent)) = &expected {
                let known = |block: &BlockId| block.index() < self.blocks.len();
                let found = blocks.iter().filter(|b| known(b)).map(|&b| self.manifold(b).ambient());
                let total: usize =
                    blocks.iter().filter(|b| known(b)).map(|&b| self.dimension(b)).sum();
                if !found.eq(ambient.iter().copied()) || total != *tangent {
                    return misuse(format!(
                        "factor {factor} expects blocks of {ambient:?} numbers with {tangent} degrees of freedom, its blocks have {total}"
                    ));
                }
            }
            if blocks.is_empty() || blocks.len() > MAX_ARITY {
                return misuse(format!(
                    "factor {factor} has {} blocks, 1 to {MAX_ARITY} are possible",
                    blocks.len()
                ));
            }
            if let Some(block) = blocks.iter().find(|block| block.index() >= self.blocks.len()) {
                return misuse(format!(
                    "factor {factor} names block {}, which is not there",
                    block.index()
                ));
            }
            for (k, block) in blocks.iter().enumerate() {
                if blocks[..k].contains(block) {
                    return misuse(format!(
                        "factor {factor} names {} twice",
                        self.describe(*block)
                    ));
                }
            }
            let these = blocks.iter().map(|block| self.blocks[block.index()].dimension);
            if factor == 0 {
                dims.extend(these);
            } else if !these.eq(dims.iter().copied()) {
                return misuse(format!(
                    "factor {factor} joins blocks of other dimensions than factor 0"
                ));
            }
        }
        let width = dims.iter().sum();
        self.batches.push(NamedBatch {
            name: name.to_owned(),
            loss: BatchLoss::new(loss),
            batch: Box::new(batch),
            width,
            dims,
        });
        Ok(())
    }

    /// The starting values of all blocks, one after the other: what an engine moves.
    pub fn start(&self) -> Vec<f64> {
        self.initial.clone()
    }

    /// How many blocks there are.
    pub fn block_count(&self) -> usize {
        self.blocks.len()
    }

    /// Sum of the residual lengths of all factors.
    pub fn residual_count(&self) -> usize {
        self.batches.iter().map(|b| b.batch.len() * b.batch.rows()).sum()
    }

    /// Degrees of freedom that may move.
    pub fn parameter_count(&self) -> usize {
        self.blocks.iter().map(|b| b.dimension - b.frozen.count_ones() as usize).sum()
    }

    /// The values of one block inside `x`.
    pub fn values<'a>(&self, x: &'a [f64], block: BlockId) -> &'a [f64] {
        &x[self.offsets[block.index()]..self.offsets[block.index() + 1]]
    }

    /// The manifold of one block.
    pub fn manifold(&self, block: BlockId) -> &dyn Manifold {
        self.manifold_of(&self.blocks[block.index()])
    }

    fn manifold_of(&self, block: &Block) -> &dyn Manifold {
        self.manifolds[block.manifold as usize].as_ref()
    }

    /// Degrees of freedom of one block, those that are fixed included.
    pub fn dimension(&self, block: BlockId) -> usize {
        self.blocks[block.index()].dimension
    }

    /// What a person would call a block: its kind and its number.
    pub fn describe(&self, block: BlockId) -> String {
        let (kind, first) = &self.groups[self.blocks[block.index()].group as usize];
        format!("{kind} {}", block.index() - first)
    }

    pub(super) fn all_values<'a>(&'a self, x: &'a [f64]) -> Values<'a> {
        Values { values: x, offsets: &self.offsets }
    }

    pub(super) fn id(index: usize) -> BlockId {
        BlockId(u32::try_from(index).unwrap_or(u32::MAX))
    }

    /// Length of tangent vectors over all blocks, fixed ones included.
    pub(super) fn tangent_len(&self) -> usize {
        self.blocks.last().map_or(0, |last| last.tangent + last.dimension)
    }

    /// Writes `x (+) d` for all blocks to `out`.
    pub(super) fn plus(&self, x: &[f64], d: &[f64], out: &mut [f64]) {
        for (block, ends) in self.blocks.iter().zip(self.offsets.windows(2)) {
            let range = ends[0]..ends[1];
            if block.is_fixed() {
                out[range.clone()].copy_from_slice(&x[range]);
            } else {
                let d = &d[block.tangent..block.tangent + block.dimension];
                self.move_block(block, &x[range.clone()], d, &mut out[range]);
            }
        }
    }

    /// As [`Problem::plus`] for the blocks whose tangents lie within `d` as far as it reaches, and
    /// for no eliminated ones; the rest of `out` is left as it is.
    pub(super) fn plus_within(&self, x: &[f64], d: &[f64], out: &mut [f64]) {
        for (block, ends) in self.blocks.iter().zip(self.offsets.windows(2)) {
            let range = ends[0]..ends[1];
            if block.is_fixed() {
                out[range.clone()].copy_from_slice(&x[range]);
            } else if !block.eliminate {
                let d = &d[block.tangent..block.tangent + block.dimension];
                self.move_block(block, &x[range.clone()], d, &mut out[range]);
            }
        }
    }

    /// The cost `1/2 sum rho(|r|^2)` of each batch, in the order in which they were added.
    ///
    /// # Errors
    /// [`SolveError::InfeasibleStart`] names the factor that cannot be evaluated.
    pub fn costs(&self, x: &[f64]) -> Result<Vec<f64>, SolveError> {
        let mut residual = Vec::new();
        self.batches
            .iter()
            .map(|b| {
                batch_cost(b.batch.as_ref(), &b.loss, self.all_values(x), &mut residual)
                    .map_err(|infeasible| self.infeasible(b, infeasible))
            })
            .collect()
    }

    /// The raw residuals of the batch called `name`, one factor after the other.
    ///
    /// # Errors
    /// [`SolveError::Misuse`] where there is no such batch, [`SolveError::InfeasibleStart`] where
    /// one cannot be evaluated.
    pub fn residuals(&self, x: &[f64], name: &str) -> Result<Vec<f64>, SolveError> {
        let batch = self
            .batches
            .iter()
            .find(|b| b.name == name)
            .ok_or_else(|| SolveError::Misuse(format!("there is no batch {name:?}")))?;
        batch_residuals(batch.batch.as_ref(), self.all_values(x))
            .map_err(|infeasible| self.infeasible(batch, infeasible))
    }

    pub(super) fn infeasible(&self, batch: &NamedBatch, factor: InfeasibleFactor) -> SolveError {
        SolveError::InfeasibleStart(format!(
            "{} is infeasible",
            self.describe_factor(batch, factor.0)
        ))
    }

    /// What a person would call a factor: its number, its batch and its blocks.
    pub(super) fn describe_factor(&self, batch: &NamedBatch, factor: usize) -> String {
        let blocks: Vec<String> =
            batch.batch.blocks(factor).iter().map(|&b| self.describe(b)).collect();
        format!("factor {factor} of {:?} ({})", batch.name, blocks.join(", "))
    }
}
