//! Incidence of factors and blocks: which eliminated block each factor depends on, and between which retained ones it lies.

use super::{FactorRef, NONE};
use crate::{engine::SolveError, nlls::problem::Problem};

/// Which eliminated block each factor depends on.
pub(super) struct Incidence {
    /// Per factor, batch after batch, its eliminated block by its index before sorting, or [`NONE`].
    pub(super) owner: Vec<u32>,
    /// Factors of retained blocks alone.
    pub(super) camera_only_factors: Vec<FactorRef>,
    /// Per eliminated block the first and the last retained one adjacent to it, and its index before
    /// sorting. Blocks with the same adjacent retained ones follow each other, so that a chunk's sums
    /// stay in the cache and differ from the other chunks'.
    pub(super) neighbourhood: Vec<(u64, u32)>,
    /// No factor depends on more than one retained block.
    pub(super) single_retained: bool,
}

impl Incidence {
    /// Visits all factors.
    ///
    /// # Errors
    /// Where a factor joins two blocks that are to be eliminated.
    pub(super) fn new(
        problem: &Problem,
        retained_index: &[u32],
        eliminated_index: &[u32],
        eliminated: &[u32],
    ) -> Result<Incidence, SolveError> {
        let total = problem.batches.iter().map(|named| named.batch.len()).sum();
        let mut owner = Vec::with_capacity(total);
        let mut camera_only_factors = Vec::new();
        let mut ends = vec![(NONE, 0u32); eliminated.len()];
        let mut single_retained = true;
        for (b, named) in problem.batches.iter().enumerate() {
            for f in 0..named.batch.len() {
                let blocks = named.batch.blocks(f);
                let (mut found, mut low, mut high) = (NONE, NONE, 0);
                for block in blocks {
                    let e = eliminated_index[block.index()];
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
                    } else if retained_index[block.index()] != NONE {
                        low = low.min(retained_index[block.index()]);
                        high = high.max(retained_index[block.index()]);
                    }
                }
                single_retained &= low == NONE || low == high;
                owner.push(found);
                if found != NONE {
                    let end = &mut ends[found as usize];
                    *end = (end.0.min(low), end.1.max(high));
                } else if low != NONE {
                    camera_only_factors.push((b as u32, f as u32));
                }
            }
        }
        let neighbourhood = ends
            .into_iter()
            .enumerate()
            .map(|(e, (low, high))| (u64::from(low) << 32 | u64::from(high), e as u32))
            .collect();
        Ok(Incidence { owner, camera_only_factors, neighbourhood, single_retained })
    }
}
