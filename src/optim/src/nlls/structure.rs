//! The symbolic part of the normal equations: which blocks share a factor, found once per problem.
//!
//! Free blocks are *eliminated* (points, solved for block by block) or *retained* (cameras, solved for
//! together in the reduced system). Eliminated blocks are cut into a fixed number of ranges, each
//! with its own small accumulator over just the retained blocks adjacent to it; accumulators are
//! added in the order of the ranges, so that the sums do not depend on the number of threads.

mod incidence;

use super::{
    LinearSolver,
    block_table::{BlockTable, pairs_of_groups},
    cholesky::BlockMatrix,
    problem::Problem,
};
use crate::engine::SolveError;
use incidence::Incidence;
use rayon::prelude::*;
use std::ops::Range;

/// No retained block, no slot, no block of a table.
pub(super) const NONE: u32 = u32::MAX;

/// One factor: its batch and its place in it.
pub(super) type FactorRef = (u32, u32);

/// A run of eliminated blocks and the part of the reduced system that they contribute to.
#[derive(Debug, Clone)]
pub(super) struct Chunk {
    /// Indices into [`Structure::eliminated`].
    pub(super) eliminated: Range<usize>,
    /// The retained blocks adjacent to its eliminated ones, ascending.
    pub(super) retained: Vec<u32>,
    /// Where each retained block begins in local vectors; one more entry than blocks.
    pub(super) starts: Vec<usize>,
    /// Where each local block begins; none once only the fused path goes on.
    table: Option<BlockTable>,
    /// Length of the local values.
    pub(super) len: usize,
    /// `(local, global, length)` of each block's values.
    pub(super) copies: Vec<(usize, usize, usize)>,
}

impl Chunk {
    /// Visits the pairs of local blocks `(row, column)`, `row >= column`, that an eliminated block
    /// joins, row by row.
    pub(super) fn for_each_pair(&self, mut visit: impl FnMut(usize, usize)) {
        if let Some(table) = &self.table {
            table.for_each(|row, column, _| visit(row, column));
        }
    }

    /// Tangent dimension of a local retained block.
    #[inline]
    pub(super) fn size(&self, local: u32) -> usize {
        self.starts[local as usize + 1] - self.starts[local as usize]
    }

    /// Where local block `(row, column)`, `row >= column`, begins in the chunk's values.
    #[inline]
    pub(super) fn at(&self, row: usize, column: usize) -> usize {
        self.table.as_ref().map_or(0, |table| table.get(row, column) as usize)
    }
}

/// The pattern of a problem.
#[derive(Debug, Clone)]
pub(super) struct Structure {
    /// The block behind each retained one.
    pub(super) retained: Vec<usize>,
    /// The index of each block among the retained ones, or [`NONE`].
    pub(super) retained_index: Vec<u32>,
    /// The blocks to eliminate, in the order in which they are.
    pub(super) eliminated: Vec<usize>,
    /// The index of each block among the eliminated ones, or [`NONE`].
    pub(super) eliminated_index: Vec<u32>,
    /// Sum of the squared tangent dimensions of the eliminated blocks before each.
    pub(super) squares: Vec<usize>,
    factor_ptr: Vec<usize>,
    factors: Vec<FactorRef>,
    adjacent_ptr: Vec<usize>,
    /// The retained blocks adjacent to each eliminated one, ascending, as indices into their chunk's list.
    adjacent: Vec<u32>,
    /// Factors without an eliminated block.
    pub(super) camera_only_factors: Vec<FactorRef>,
    /// No factor depends on more than one retained block.
    pub(super) single_retained: bool,
    pub(super) chunks: Vec<Chunk>,
}

/// Factors per chunk; the number of chunks is bounded because each has an accumulator.
const FACTORS_PER_CHUNK: usize = 8192;
const MAX_CHUNKS: usize = 8;

impl Structure {
    /// Finds the structure of `problem` and the pattern of its reduced matrix.
    pub(super) fn new(
        problem: &Problem,
        linear: LinearSolver,
    ) -> Result<(Structure, BlockMatrix), SolveError> {
        let eliminating = linear.eliminates();
        let blocks = &problem.blocks;
        let mut retained_index = vec![NONE; blocks.len()];
        let mut eliminated_index = vec![NONE; blocks.len()];
        let (mut retained, mut eliminated) = (Vec::new(), Vec::new());
        for (k, block) in blocks.iter().enumerate().filter(|(_, block)| !block.is_fixed()) {
            if eliminating && block.eliminate {
                // Its index among the eliminated ones, until they are sorted.
                eliminated_index[k] = eliminated.len() as u32;
                eliminated.push(k as u32);
            } else {
                retained_index[k] = retained.len() as u32;
                retained.push(k);
            }
        }
        if retained.is_empty() && eliminated.is_empty() {
            return Err(SolveError::Misuse("every block is fixed: nothing to solve for".into()));
        }
        let Incidence { owner, camera_only_factors, mut neighbourhood, single_retained } =
            Incidence::new(problem, &retained_index, &eliminated_index, &eliminated)?;
        neighbourhood.par_sort_unstable();
        let eliminated: Vec<usize> =
            neighbourhood.iter().map(|&(_, first)| eliminated[first as usize] as usize).collect();
        let mut sorted = vec![0u32; eliminated.len()];
        for (e, &(_, first)) in neighbourhood.iter().enumerate() {
            sorted[first as usize] = e as u32;
            eliminated_index[eliminated[e]] = e as u32;
        }
        let mut structure = Structure {
            retained,
            retained_index,
            squares: Vec::new(),
            eliminated,
            eliminated_index,
            factor_ptr: Vec::new(),
            factors: Vec::new(),
            adjacent_ptr: Vec::new(),
            adjacent: Vec::new(),
            camera_only_factors,
            single_retained,
            chunks: Vec::new(),
        };
        structure.list_factors(problem, &owner, &sorted);
        let dims: Vec<usize> = structure.retained.iter().map(|&k| blocks[k].dimension).collect();
        structure.connect(problem, Coupling::All);
        structure.refuse_unconstrained_blocks(problem)?;
        let matrix = structure.reduced_pattern(problem, &dims);
        Ok((structure, matrix))
    }

    /// Cuts the eliminated blocks into chunks with the pairs of retained blocks that `coupling` wants.
    fn connect(&mut self, problem: &Problem, coupling: Coupling) {
        let retained = self.retained.len();
        self.chunks = self
            .partition()
            .into_par_iter()
            .with_max_len(1)
            .map(|range| Chunk::new(self, problem, range, retained, coupling))
            .collect();
    }

    /// Forgets which retained blocks meet; returns the pattern of the diagonal blocks.
    pub(super) fn uncouple(&mut self, problem: &Problem) -> BlockMatrix {
        self.connect(problem, Coupling::None);
        let dims: Vec<usize> = self.retained.iter().map(|&k| problem.blocks[k].dimension).collect();
        self.reduced_pattern(problem, &dims)
    }

    /// Finds again which retained blocks meet.
    pub(super) fn couple(&mut self, problem: &Problem) {
        self.connect(problem, Coupling::All);
    }

    /// How many pairs of retained blocks the eliminated ones join, each as often as it is joined.
    pub(super) fn joined_pairs(&self) -> f64 {
        let ends = self.factor_ptr.windows(2).map(|ends| (ends[1] - ends[0]) as f64);
        ends.map(|n| 0.5 * n * (n + 1.0)).sum()
    }

    /// How many factors depend on an eliminated block.
    pub(super) fn factor_count(&self) -> usize {
        self.factors.len()
    }

    /// Fills in what only the stored path reads.
    pub(super) fn complete(&mut self, problem: &Problem, matrix: &BlockMatrix) {
        let squares = self.eliminated.iter().scan(0, |sum, &k| {
            *sum += problem.blocks[k].dimension.pow(2);
            Some(*sum)
        });
        self.squares = std::iter::once(0).chain(squares).collect();
        let mut local = vec![NONE; self.retained.len()];
        let (mut adjacent_ptr, mut adjacent, mut one) = (vec![0], Vec::new(), Vec::new());
        for chunk in &self.chunks {
            for (k, &place) in chunk.retained.iter().enumerate() {
                local[place as usize] = k as u32;
            }
            for e in chunk.eliminated.clone() {
                self.find_adjacent(problem, e, &mut one);
                adjacent.extend(one.iter().map(|&place| local[place as usize]));
                adjacent_ptr.push(adjacent.len());
            }
        }
        (self.adjacent_ptr, self.adjacent) = (adjacent_ptr, adjacent);
        for chunk in &mut self.chunks {
            chunk.connect(matrix);
        }
    }

    /// Frees what only the stored path reads.
    pub(super) fn forget_factors(&mut self) {
        self.factor_ptr = Vec::new();
        self.factors = Vec::new();
        for chunk in &mut self.chunks {
            chunk.table = None;
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

    /// The retained blocks adjacent to eliminated block `e`, as indices into its chunk's list.
    #[inline]
    pub(super) fn adjacent(&self, e: usize) -> &[u32] {
        &self.adjacent[self.adjacent_ptr[e]..self.adjacent_ptr[e + 1]]
    }

    /// Lists the factors of each eliminated block; `owner` as in [`Incidence`], `sorted` the indices
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

    /// The retained blocks that share a factor with eliminated block `e`, ascending.
    fn find_adjacent(&self, problem: &Problem, e: usize, out: &mut Vec<u32>) {
        out.clear();
        for &(b, f) in self.factors(e) {
            for block in problem.batches[b as usize].batch.blocks(f as usize) {
                let place = self.retained_index[block.index()];
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

    fn refuse_unconstrained_blocks(&self, problem: &Problem) -> Result<(), SolveError> {
        let mut busy = vec![false; self.retained.len()];
        for chunk in &self.chunks {
            chunk.retained.iter().for_each(|&k| busy[k as usize] = true);
        }
        for &(b, f) in &self.camera_only_factors {
            for block in problem.batches[b as usize].batch.blocks(f as usize) {
                if self.retained_index[block.index()] != NONE {
                    busy[self.retained_index[block.index()] as usize] = true;
                }
            }
        }
        let unconstrained_retained = busy.iter().position(|busy| !busy).map(|k| self.retained[k]);
        let unconstrained_point = (0..self.eliminated.len())
            .find(|&e| self.factors(e).is_empty())
            .map(|e| self.eliminated[e]);
        match unconstrained_retained.or(unconstrained_point) {
            None => Ok(()),
            Some(block) => Err(SolveError::Misuse(format!(
                "nothing is observed of {}, which is to be found: hold it or leave it out",
                problem.describe(Problem::id(block))
            ))),
        }
    }

    /// Ranges of eliminated blocks with about the same number of factors.
    fn partition(&self) -> Vec<Range<usize>> {
        let total = self.factors.len();
        let count = total.div_ceil(FACTORS_PER_CHUNK).clamp(1, MAX_CHUNKS);
        let (mut first, mut partition) = (0, Vec::new());
        for chunk in 0..count {
            let goal = total * (chunk + 1) / count;
            let mut end = self.factor_ptr.partition_point(|&at| at <= goal) - 1;
            if chunk + 1 == count {
                end = self.eliminated.len();
            }
            if end > first {
                partition.push(first..end);
                first = end;
            }
        }
        partition
    }

    fn reduced_pattern(&self, problem: &Problem, dims: &[usize]) -> BlockMatrix {
        let mut columns: Vec<Vec<u32>> = (0..dims.len()).map(|k| vec![k as u32]).collect();
        for chunk in &self.chunks {
            chunk.for_each_pair(|row, column| {
                if row != column {
                    columns[chunk.retained[column] as usize].push(chunk.retained[row]);
                }
            });
        }
        for &(b, f) in &self.camera_only_factors {
            let blocks = problem.batches[b as usize].batch.blocks(f as usize);
            for (k, first) in blocks.iter().enumerate() {
                for second in &blocks[..k] {
                    let pair =
                        [self.retained_index[first.index()], self.retained_index[second.index()]];
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
        BlockMatrix::pattern(dims, &columns)
    }
}

/// Which pairs of retained blocks have a place of their own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Coupling {
    /// All that an eliminated block joins.
    All,
    /// Each with itself.
    None,
}

impl Chunk {
    fn new(
        structure: &Structure,
        problem: &Problem,
        eliminated: Range<usize>,
        retained: usize,
        coupling: Coupling,
    ) -> Chunk {
        let (mut first, mut members, mut one) = (vec![0], Vec::new(), Vec::new());
        let mut local = vec![NONE; retained];
        for e in eliminated.clone() {
            structure.find_adjacent(problem, e, &mut one);
            one.iter().for_each(|&index| local[index as usize] = 0);
            members.extend_from_slice(&one);
            first.push(members.len());
        }
        let retained: Vec<u32> =
            (0..retained as u32).filter(|&index| local[index as usize] == 0).collect();
        for (k, &index) in retained.iter().enumerate() {
            local[index as usize] = k as u32;
        }
        members.iter_mut().for_each(|index| *index = local[*index as usize]);
        let dim = |index: u32| problem.blocks[structure.retained[index as usize]].dimension;
        let mut starts = vec![0];
        for &index in &retained {
            starts.push(starts[starts.len() - 1] + dim(index));
        }
        let rows = match coupling {
            Coupling::All => pairs_of_groups(retained.len(), &first, &members),
            Coupling::None => (0..retained.len() as u32).map(|k| vec![k]).collect(),
        };
        let mut len = 0;
        let table = BlockTable::new(rows.into_iter(), |row, column| {
            let at = len;
            len += dim(retained[row]) * dim(retained[column]);
            at as u32
        });
        Chunk { eliminated, retained, starts, table: Some(table), len, copies: Vec::new() }
    }

    /// Finds where its blocks are in `matrix`.
    fn connect(&mut self, matrix: &BlockMatrix) {
        let Some(table) = &self.table else { return };
        let (retained, copies) = (&self.retained, &mut self.copies);
        table.for_each(|row, column, local| {
            if let Some(slot) = matrix.slot(retained[row] as usize, retained[column] as usize) {
                let global = matrix.value_ptr[slot];
                copies.push((local as usize, global, matrix.value_ptr[slot + 1] - global));
            }
        });
    }
}
