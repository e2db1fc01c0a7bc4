//! The symbolic part of the normal equations: who touches whom, found once per problem.
//!
//! Free blocks are *eliminated* (points, solved for block by block) or *kept* (cameras, solved for
//! together in the reduced system). Eliminated blocks are cut into a fixed number of ranges, each
//! with its own small accumulator over just the kept blocks that it touches; accumulators are
//! added in the order of the ranges, so that the sums do not depend on the number of threads.

use super::{
    Linear,
    cholesky::BlockMatrix,
    problem::{BlockId, Problem},
};
use crate::engine::SolveError;

/// Not a kept block, not a slot.
pub(super) const NONE: u32 = u32::MAX;

/// One factor: its batch and its place in it.
pub(super) type FactorRef = (u32, u32);

/// A run of eliminated blocks and the part of the reduced system that they add to.
#[derive(Debug, Clone)]
pub(super) struct Share {
    /// Places in [`Structure::eliminated`].
    pub(super) eliminated: std::ops::Range<usize>,
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
        let eliminating = linear == Linear::Schur;
        let blocks = &problem.blocks;
        let (mut place, mut point) = (vec![NONE; blocks.len()], vec![NONE; blocks.len()]);
        let (mut kept, mut eliminated) = (Vec::new(), Vec::new());
        for (k, block) in blocks.iter().enumerate().filter(|(_, block)| !block.is_fixed()) {
            if eliminating && block.eliminate {
                eliminated.push(k);
            } else {
                place[k] = kept.len() as u32;
                kept.push(k);
            }
        }
        if kept.is_empty() && eliminated.is_empty() {
            return Err(SolveError::Misuse("every block is fixed: nothing to solve for".into()));
        }
        sort_by_neighbourhood(problem, &place, &mut eliminated);
        for (e, &k) in eliminated.iter().enumerate() {
            point[k] = e as u32;
        }
        let mut structure = Structure {
            kept,
            place,
            squares: std::iter::once(0)
                .chain(eliminated.iter().scan(0, |sum, &k| {
                    *sum += blocks[k].space.tangent().pow(2);
                    Some(*sum)
                }))
                .collect(),
            eliminated,
            point,
            factor_ptr: Vec::new(),
            factors: Vec::new(),
            touch_ptr: Vec::new(),
            touch: Vec::new(),
            plain: Vec::new(),
            shares: Vec::new(),
        };
        structure.sort_factors(problem)?;
        let touched = structure.find_touched(problem);
        structure.refuse_idle_blocks(problem, &touched)?;
        let dims: Vec<usize> = structure.kept.iter().map(|&k| blocks[k].space.tangent()).collect();
        structure.cut_into_shares(&touched, &dims);
        let matrix = structure.reduced_pattern(problem, &dims);
        structure.connect_shares(&matrix);
        Ok((structure, matrix))
    }

    /// Frees what only the stored path reads.
    pub(super) fn forget_factors(&mut self) {
        self.factor_ptr = Vec::new();
        self.factors = Vec::new();
        self.touch_ptr = Vec::new();
        self.touch = Vec::new();
        for share in &mut self.shares {
            share.table = Vec::new();
            share.copies = Vec::new();
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

    /// Splits the factors into those of each eliminated block and the plain rest.
    fn sort_factors(&mut self, problem: &Problem) -> Result<(), SolveError> {
        let point_of = |blocks: &[BlockId]| -> Result<Option<u32>, (BlockId, BlockId)> {
            let mut found: Option<BlockId> = None;
            for &block in blocks {
                if self.point[block.index()] != NONE
                    && let Some(first) = found.replace(block)
                {
                    return Err((first, block));
                }
            }
            Ok(found.map(|block| self.point[block.index()]))
        };
        let mut counts = vec![0usize; self.eliminated.len() + 1];
        let mut plain = Vec::new();
        for (b, named) in problem.batches.iter().enumerate() {
            for f in 0..named.batch.len() {
                let blocks = named.batch.blocks(f);
                match point_of(blocks) {
                    Err((first, second)) => {
                        return Err(SolveError::Misuse(format!(
                            "factor {f} of {:?} joins {} and {}, which are both to be eliminated",
                            named.name,
                            problem.describe(first),
                            problem.describe(second)
                        )));
                    }
                    Ok(Some(e)) => counts[e as usize + 1] += 1,
                    Ok(None) => {
                        if blocks.iter().any(|block| self.place[block.index()] != NONE) {
                            plain.push((b as u32, f as u32));
                        }
                    }
                }
            }
        }
        for e in 1..counts.len() {
            counts[e] += counts[e - 1];
        }
        let mut next = counts.clone();
        let mut factors = vec![(0, 0); counts[counts.len() - 1]];
        for (b, named) in problem.batches.iter().enumerate() {
            for f in 0..named.batch.len() {
                if let Ok(Some(e)) = point_of(named.batch.blocks(f)) {
                    factors[next[e as usize]] = (b as u32, f as u32);
                    next[e as usize] += 1;
                }
            }
        }
        (self.factor_ptr, self.factors, self.plain) = (counts, factors, plain);
        Ok(())
    }

    /// Per eliminated block, the kept blocks it shares a factor with, ascending.
    fn find_touched(&self, problem: &Problem) -> Touched {
        let mut touched =
            Touched { first: vec![0], places: Vec::with_capacity(self.factors.len()) };
        let mut one: Vec<u32> = Vec::new();
        for e in 0..self.eliminated.len() {
            one.clear();
            for &(b, f) in self.factors(e) {
                for block in problem.batches[b as usize].batch.blocks(f as usize) {
                    let place = self.place[block.index()];
                    if place != NONE {
                        one.push(place);
                    }
                }
            }
            if !one.is_sorted_by(|a, b| a < b) {
                one.sort_unstable();
                one.dedup();
            }
            touched.places.extend_from_slice(&one);
            touched.first.push(touched.places.len());
        }
        touched
    }

    fn refuse_idle_blocks(&self, problem: &Problem, touched: &Touched) -> Result<(), SolveError> {
        let mut busy = vec![false; self.kept.len()];
        touched.places.iter().for_each(|&k| busy[k as usize] = true);
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

    fn cut_into_shares(&mut self, touched: &Touched, dims: &[usize]) {
        let total = self.factors.len();
        let shares = total.div_ceil(SHARE_FACTORS).clamp(1, MAX_SHARES);
        let mut first = 0;
        for share in 0..shares {
            let goal = total * (share + 1) / shares;
            let mut end = first;
            while end < self.eliminated.len() && self.factor_ptr[end + 1] <= goal {
                end += 1;
            }
            if share + 1 == shares {
                end = self.eliminated.len();
            }
            if end > first {
                self.shares.push(Share::new(first..end, touched, dims));
                first = end;
            }
        }
        let mut local = vec![NONE; dims.len()];
        for share in &self.shares {
            for (k, &place) in share.kept.iter().enumerate() {
                local[place as usize] = k as u32;
            }
            for e in share.eliminated.clone() {
                self.touch.extend(touched.of(e).iter().map(|&place| local[place as usize]));
            }
        }
        self.touch_ptr.clone_from(&touched.first);
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
        for column in &mut columns {
            column.sort_unstable();
            column.dedup();
        }
        BlockMatrix::new(dims, &columns)
    }

    fn connect_shares(&mut self, matrix: &BlockMatrix) {
        for share in &mut self.shares {
            let n = share.kept.len();
            for row in 0..n {
                for column in 0..=row {
                    let local = share.table[row * n + column];
                    let (r, c) = (share.kept[row] as usize, share.kept[column] as usize);
                    if local != NONE
                        && let Some(slot) = matrix.slot(r, c)
                    {
                        let global = matrix.value_ptr[slot];
                        share.copies.push((
                            local as usize,
                            global,
                            matrix.value_ptr[slot + 1] - global,
                        ));
                    }
                }
            }
        }
    }
}

/// Per eliminated block the places of the kept ones that it touches, one list after the other.
struct Touched {
    first: Vec<usize>,
    places: Vec<u32>,
}

impl Touched {
    fn of(&self, e: usize) -> &[u32] {
        &self.places[self.first[e]..self.first[e + 1]]
    }
}

/// Puts eliminated blocks that touch the same kept ones next to each other, so that a share's sums
/// stay in the cache and differ from the other shares'.
fn sort_by_neighbourhood(problem: &Problem, place: &[u32], eliminated: &mut [usize]) {
    let mut ends = vec![(NONE, 0); problem.blocks.len()];
    for named in &problem.batches {
        for f in 0..named.batch.len() {
            let blocks = named.batch.blocks(f);
            for block in blocks.iter().filter(|b| problem.blocks[b.index()].eliminate) {
                let end = &mut ends[block.index()];
                for other in blocks {
                    let place = place[other.index()];
                    if place != NONE {
                        *end = (end.0.min(place), end.1.max(place));
                    }
                }
            }
        }
    }
    eliminated.sort_unstable_by_key(|&k| (ends[k], k));
}

impl Share {
    fn new(eliminated: std::ops::Range<usize>, touched: &Touched, dims: &[usize]) -> Share {
        let mut seen = vec![false; dims.len()];
        let places =
            &touched.places[touched.first[eliminated.start]..touched.first[eliminated.end]];
        places.iter().for_each(|&place| seen[place as usize] = true);
        let kept: Vec<u32> = (0..dims.len() as u32).filter(|&place| seen[place as usize]).collect();
        let n = kept.len();
        let mut local = vec![NONE; dims.len()];
        for (k, &block) in kept.iter().enumerate() {
            local[block as usize] = k as u32;
        }
        let mut table = vec![NONE; n * n];
        for e in eliminated.clone() {
            let touched = touched.of(e);
            for (k, &row) in touched.iter().enumerate() {
                let line = &mut table[local[row as usize] as usize * n..];
                for &column in &touched[..=k] {
                    line[local[column as usize] as usize] = 0;
                }
            }
        }
        let mut starts = vec![0];
        for &block in &kept {
            starts.push(starts[starts.len() - 1] + dims[block as usize]);
        }
        let mut len = 0;
        for row in 0..n {
            for column in 0..=row {
                let entry = &mut table[row * n + column];
                if *entry != NONE {
                    *entry = len as u32;
                    len += dims[kept[row] as usize] * dims[kept[column] as usize];
                }
            }
        }
        Share { eliminated, kept, starts, table, len, copies: Vec::new() }
    }
}
