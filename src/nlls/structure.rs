//! The symbolic part of the normal equations: who touches whom, found once per problem.
//!
//! Free blocks are *eliminated* (points, solved for block by block) or *kept* (cameras, solved for
//! together in the reduced system). Eliminated blocks are cut into a fixed number of ranges, each
//! with its own small accumulator over just the kept blocks that it touches; accumulators are
//! added in the order of the ranges, so that the sums do not depend on the number of threads.

use super::{Linear, cholesky::BlockMatrix, problem::Problem};
use crate::engine::SolveError;
use rayon::prelude::*;
use std::ops::Range;

/// Not a kept block, not a slot.
pub(super) const NONE: u32 = u32::MAX;

/// One factor: its batch and its place in it.
pub(super) type FactorRef = (u32, u32);

/// A run of eliminated blocks and the part of the reduced system that they add to.
#[derive(Debug, Clone)]
pub(super) struct Share {
    /// Places in [`Structure::eliminated`].
    pub(super) eliminated: Range<usize>,
    /// The kept blocks that it touches, ascending.
    pub(super) kept: Vec<u32>,
    /// Where each kept block begins in local vectors; one more entry than blocks.
    pub(super) starts: Vec<usize>,
    /// `kept x kept`: where local block `(row, column)`, `row >= column`, begins, or [`NONE`].
    table: Vec<u32>,
    /// Length of the local values.
    pub(super) len: usize,
    /// `(local, global, length)` of each block's values.
    pub(super) copies: Vec<(usize, usize, usize)>,
}

impl Share {
    /// Whether local block `(row, column)`, `row >= column`, is touched.
    pub(super) fn has(&self, row: usize, column: usize) -> bool {
        self.table[row * self.kept.len() + column] != NONE
    }

    #[inline]
    pub(super) fn at(&self, row: usize, column: usize) -> usize {
        self.table[row * self.kept.len() + column] as usize
    }
}

/// The pattern of a problem.
#[derive(Debug, Clone)]
pub(super) struct Structure {
    /// The block behind each kept one.
    pub(super) kept: Vec<usize>,
    /// The place of each block among the kept ones, or [`NONE`].
    pub(super) place: Vec<u32>,
    /// The blocks to eliminate, in the order in which they are.
    pub(super) eliminated: Vec<usize>,
    /// The place of each block among the eliminated ones, or [`NONE`].
    pub(super) point: Vec<u32>,
    /// Sum of the squared tangent dimensions of the eliminated blocks before each.
    pub(super) squares: Vec<usize>,
    factor_ptr: Vec<usize>,
    factors: Vec<FactorRef>,
    touch_ptr: Vec<usize>,
    /// Kept blocks touched by each eliminated one, ascending, as places in their share's list.
    touch: Vec<u32>,
    /// Factors without an eliminated block.
    pub(super) plain: Vec<FactorRef>,
    pub(super) shares: Vec<Share>,
}

/// Factors per share; the number of shares is bounded because each has an accumulator.
const SHARE_FACTORS: usize = 8192;
const MAX_SHARES: usize = 8;

impl Structure {
    /// Finds the structure of `problem` and its empty reduced matrix.
    pub(super) fn new(
        problem: &Problem,
        linear: Linear,
    ) -> Result<(Structure, BlockMatrix), SolveError> {
        let eliminating = matches!(linear, Linear::Schur | Linear::IterativeSchur);
        let blocks = &problem.blocks;
        let (mut place, mut point) = (vec![NONE; blocks.len()], vec![NONE; blocks.len()]);
        let (mut kept, mut eliminated) = (Vec::new(), Vec::new());
        for (k, block) in blocks.iter().enumerate().filter(|(_, block)| !block.is_fixed()) {
            if eliminating && block.eliminate {
                // Its place among the eliminated ones, until they are sorted.
                point[k] = eliminated.len() as u32;
                eliminated.push(k as u32);
            } else {
                place[k] = kept.len() as u32;
                kept.push(k);
            }
        }
        if kept.is_empty() && eliminated.is_empty() {
            return Err(SolveError::Misuse("every block is fixed: nothing to solve for".into()));
        }
        let Census { owner, plain, mut neighbourhood } =
            Census::take(problem, &place, &point, &eliminated)?;
        neighbourhood.par_sort_unstable();
        let eliminated: Vec<usize> =
            neighbourhood.iter().map(|&(_, first)| eliminated[first as usize] as usize).collect();
        let mut sorted = vec![0u32; eliminated.len()];
        for (e, &(_, first)) in neighbourhood.iter().enumerate() {
            sorted[first as usize] = e as u32;
            point[eliminated[e]] = e as u32;
        }
        let mut structure = Structure {
            kept,
            place,
            squares: Vec::new(),
            eliminated,
            point,
            factor_ptr: Vec::new(),
            factors: Vec::new(),
            touch_ptr: Vec::new(),
            touch: Vec::new(),
            plain,
            shares: Vec::new(),
        };
        structure.list_factors(problem, &owner, &sorted);
        let dims: Vec<usize> = structure.kept.iter().map(|&k| blocks[k].space.tangent()).collect();
        structure.shares = structure
            .cuts()
            .into_par_iter()
            .with_max_len(1)
            .map(|range| Share::new(&structure, problem, range, dims.len()))
            .collect();
        structure.refuse_idle_blocks(problem)?;
        let matrix = structure.reduced_pattern(problem, &dims);
        Ok((structure, matrix))
    }

    /// Fills in what only the stored path reads.
    pub(super) fn complete(&mut self, problem: &Problem, matrix: &BlockMatrix) {
        let squares = self.eliminated.iter().scan(0, |sum, &k| {
            *sum += problem.blocks[k].space.tangent().pow(2);
            Some(*sum)
        });
        self.squares = std::iter::once(0).chain(squares).collect();
        let mut local = vec![NONE; self.kept.len()];
        let (mut touch_ptr, mut touch, mut one) = (vec![0], Vec::new(), Vec::new());
        for share in &self.shares {
            for (k, &place) in share.kept.iter().enumerate() {
                local[place as usize] = k as u32;
            }
            for e in share.eliminated.clone() {
                self.touched(problem, e, &mut one);
                touch.extend(one.iter().map(|&place| local[place as usize]));
                touch_ptr.push(touch.len());
            }
        }
        (self.touch_ptr, self.touch) = (touch_ptr, touch);
        for share in &mut self.shares {
            share.connect(matrix);
        }
    }

    /// Frees what only the stored path reads.
    pub(super) fn forget_factors(&mut self) {
        self.factor_ptr = Vec::new();
        self.factors = Vec::new();
        for share in &mut self.shares {
            share.table = Vec::new();
        }
    }

    /// The factors of eliminated block `e`.
    #[inline]
    pub(super) fn factors(&self, e: usize) -> &[FactorRef] {
        match self.factor_ptr.get(e..e + 2) {
            Some(ends) => &self.factors[ends[0]..ends[1]],
            None => &[],
        }
    }

    /// The kept blocks touched by eliminated block `e`, as places in its share's list.
    #[inline]
    pub(super) fn touch(&self, e: usize) -> &[u32] {
        &self.touch[self.touch_ptr[e]..self.touch_ptr[e + 1]]
    }

    /// Lists the factors of each eliminated block; `owner` as in [`Census`], `sorted` the places
    /// that its numbers stand for.
    fn list_factors(&mut self, problem: &Problem, owner: &[u32], sorted: &[u32]) {
        let mut ends = vec![0usize; self.eliminated.len() + 1];
        for &first in owner.iter().filter(|&&first| first != NONE) {
            ends[sorted[first as usize] as usize + 1] += 1;
        }
        for e in 1..ends.len() {
            ends[e] += ends[e - 1];
        }
        let mut next = ends.clone();
        let mut factors = vec![(0, 0); ends[ends.len() - 1]];
        let mut owner = owner.iter();
        for (b, named) in problem.batches.iter().enumerate() {
            for (f, &first) in owner.by_ref().take(named.batch.len()).enumerate() {
                if first != NONE {
                    let next = &mut next[sorted[first as usize] as usize];
                    factors[*next] = (b as u32, f as u32);
                    *next += 1;
                }
            }
        }
        (self.factor_ptr, self.factors) = (ends, factors);
    }

    /// The kept blocks that eliminated block `e` shares a factor with, ascending.
    fn touched(&self, problem: &Problem, e: usize, out: &mut Vec<u32>) {
        out.clear();
        for &(b, f) in self.factors(e) {
            for block in problem.batches[b as usize].batch.blocks(f as usize) {
                let place = self.place[block.index()];
                if place != NONE {
                    out.push(place);
                }
            }
        }
        if !out.is_sorted_by(|a, b| a < b) {
            out.sort_unstable();
            out.dedup();
        }
    }

    fn refuse_idle_blocks(&self, problem: &Problem) -> Result<(), SolveError> {
        let mut busy = vec![false; self.kept.len()];
        for share in &self.shares {
            share.kept.iter().for_each(|&k| busy[k as usize] = true);
        }
        for &(b, f) in &self.plain {
            for block in problem.batches[b as usize].batch.blocks(f as usize) {
                if self.place[block.index()] != NONE {
                    busy[self.place[block.index()] as usize] = true;
                }
            }
        }
        let idle_kept = busy.iter().position(|busy| !busy).map(|k| self.kept[k]);
        let idle_point = (0..self.eliminated.len())
            .find(|&e| self.factors(e).is_empty())
            .map(|e| self.eliminated[e]);
        match idle_kept.or(idle_point) {
            None => Ok(()),
            Some(block) => Err(SolveError::Misuse(format!(
                "{} is free but no factor depends on it; fix it or leave it out",
                problem.describe(Problem::id(block))
            ))),
        }
    }

    /// Ranges of eliminated blocks with about the same number of factors.
    fn cuts(&self) -> Vec<Range<usize>> {
        let total = self.factors.len();
        let count = total.div_ceil(SHARE_FACTORS).clamp(1, MAX_SHARES);
        let (mut first, mut cuts) = (0, Vec::new());
        for share in 0..count {
            let goal = total * (share + 1) / count;
            let mut end = self.factor_ptr.partition_point(|&at| at <= goal) - 1;
            if share + 1 == count {
                end = self.eliminated.len();
            }
            if end > first {
                cuts.push(first..end);
                first = end;
            }
        }
        cuts
    }

    fn reduced_pattern(&self, problem: &Problem, dims: &[usize]) -> BlockMatrix {
        let mut columns: Vec<Vec<u32>> = (0..dims.len()).map(|k| vec![k as u32]).collect();
        for share in &self.shares {
            let n = share.kept.len();
            for row in 0..n {
                for column in 0..row {
                    if share.table[row * n + column] != NONE {
                        columns[share.kept[column] as usize].push(share.kept[row]);
                    }
                }
            }
        }
        for &(b, f) in &self.plain {
            let blocks = problem.batches[b as usize].batch.blocks(f as usize);
            for (k, first) in blocks.iter().enumerate() {
                for second in &blocks[..k] {
                    let pair = [self.place[first.index()], self.place[second.index()]];
                    if !pair.contains(&NONE) {
                        columns[pair[0].min(pair[1]) as usize].push(pair[0].max(pair[1]));
                    }
                }
            }
        }
        columns.par_iter_mut().for_each(|column| {
            column.sort_unstable();
            column.dedup();
        });
        BlockMatrix::new(dims, &columns)
    }
}

/// What one walk over all factors finds.
struct Census {
    /// Per factor, batch after batch, its eliminated block by its place before sorting, or [`NONE`].
    owner: Vec<u32>,
    /// Factors of kept blocks alone.
    plain: Vec<FactorRef>,
    /// Per eliminated block the first and the last kept one that it touches, and its place before
    /// sorting. Blocks that touch the same kept ones go next to each other, so that a share's sums
    /// stay in the cache and differ from the other shares'.
    neighbourhood: Vec<(u64, u32)>,
}

impl Census {
    fn take(
        problem: &Problem,
        place: &[u32],
        point: &[u32],
        eliminated: &[u32],
    ) -> Result<Census, SolveError> {
        let total = problem.batches.iter().map(|named| named.batch.len()).sum();
        let mut owner = Vec::with_capacity(total);
        let mut plain = Vec::new();
        let mut ends = vec![(NONE, 0u32); eliminated.len()];
        for (b, named) in problem.batches.iter().enumerate() {
            for f in 0..named.batch.len() {
                let blocks = named.batch.blocks(f);
                let (mut found, mut low, mut high) = (NONE, NONE, 0);
                for block in blocks {
                    let e = point[block.index()];
                    if e != NONE {
                        if found != NONE {
                            let first = Problem::id(eliminated[found as usize] as usize);
                            return Err(SolveError::Misuse(format!(
                                "factor {f} of {:?} joins {} and {}, which are both to be eliminated",
                                named.name,
                                problem.describe(first),
                                problem.describe(*block)
                            )));
                        }
                        found = e;
                    } else if place[block.index()] != NONE {
                        low = low.min(place[block.index()]);
                        high = high.max(place[block.index()]);
                    }
                }
                owner.push(found);
                if found != NONE {
                    let end = &mut ends[found as usize];
                    *end = (end.0.min(low), end.1.max(high));
                } else if low != NONE {
                    plain.push((b as u32, f as u32));
                }
            }
        }
        let neighbourhood = ends
            .into_iter()
            .enumerate()
            .map(|(e, (low, high))| (u64::from(low) << 32 | u64::from(high), e as u32))
            .collect();
        Ok(Census { owner, plain, neighbourhood })
    }
}

impl Share {
    fn new(
        structure: &Structure,
        problem: &Problem,
        eliminated: Range<usize>,
        kept: usize,
    ) -> Share {
        let (mut first, mut places, mut one) = (vec![0], Vec::new(), Vec::new());
        let mut local = vec![NONE; kept];
        for e in eliminated.clone() {
            structure.touched(problem, e, &mut one);
            one.iter().for_each(|&place| local[place as usize] = 0);
            places.extend_from_slice(&one);
            first.push(places.len());
        }
        let kept: Vec<u32> = (0..kept as u32).filter(|&place| local[place as usize] == 0).collect();
        for (k, &place) in kept.iter().enumerate() {
            local[place as usize] = k as u32;
        }
        places.iter_mut().for_each(|place| *place = local[*place as usize]);
        let n = kept.len();
        let mut table = vec![NONE; n * n];
        for ends in first.windows(2) {
            let touched = &places[ends[0]..ends[1]];
            for (k, &row) in touched.iter().enumerate() {
                let line = &mut table[row as usize * n..(row as usize + 1) * n];
                for &column in &touched[..=k] {
                    line[column as usize] = 0;
                }
            }
        }
        let dim = |place: u32| problem.blocks[structure.kept[place as usize]].space.tangent();
        let mut starts = vec![0];
        for &place in &kept {
            starts.push(starts[starts.len() - 1] + dim(place));
        }
        let mut len = 0;
        for row in 0..n {
            for column in 0..=row {
                let entry = &mut table[row * n + column];
                if *entry != NONE {
                    *entry = len as u32;
                    len += dim(kept[row]) * dim(kept[column]);
                }
            }
        }
        Share { eliminated, kept, starts, table, len, copies: Vec::new() }
    }

    /// Finds the places of its blocks in `matrix`.
    fn connect(&mut self, matrix: &BlockMatrix) {
        let n = self.kept.len();
        for row in 0..n {
            for column in 0..=row {
                let local = self.table[row * n + column];
                let (r, c) = (self.kept[row] as usize, self.kept[column] as usize);
                if local != NONE
                    && let Some(slot) = matrix.slot(r, c)
                {
                    let global = matrix.value_ptr[slot];
                    let length = matrix.value_ptr[slot + 1] - global;
                    self.copies.push((local as usize, global, length));
                }
            }
        }
    }
}
