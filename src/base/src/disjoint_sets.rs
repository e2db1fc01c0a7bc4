//! Disjoint sets of the numbers from 0: which of them are joined, directly or by others (union-find).
//!
//! Unlike with union by rank a caller can rely on which member stands for a set, so that results have an order of their
//! own. Paths are halved on the way to the root: nearly constant time for any order of joining.
//!
//! Reference: R. Tarjan, J. van Leeuwen, "Worst-case analysis of set union algorithms", JACM 31, 1984.

/// Disjoint sets of `0..len`.
#[derive(Debug, Clone, Default)]
pub struct DisjointSets {
    parent: Vec<u32>,
}

impl DisjointSets {
    /// Sets of one member each.
    pub fn new(len: usize) -> DisjointSets {
        debug_assert!(u32::try_from(len).is_ok(), "members are counted in 32 bits");
        DisjointSets { parent: (0..len as u32).collect() }
    }

    /// Adds a set of one member.
    pub fn push(&mut self) {
        debug_assert!(self.parent.len() < u32::MAX as usize, "members are counted in 32 bits");
        self.parent.push(self.parent.len() as u32);
    }

    /// The member that stands for the set of `member`.
    pub fn root(&mut self, member: usize) -> usize {
        let mut member = member as u32;
        while self.parent[member as usize] != member {
            let above = self.parent[self.parent[member as usize] as usize];
            self.parent[member as usize] = above;
            member = above;
        }
        member as usize
    }

    /// Joins two sets. Where nothing but this joins them, the smallest member stands for a set.
    pub fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.root(a), self.root(b));
        self.parent[a.max(b)] = a.min(b) as u32;
    }

    /// Joins the set that `other` stands for to the one that `root` stands for, which it does further on.
    pub fn link(&mut self, root: usize, other: usize) {
        debug_assert!(
            self.root(root) == root && self.root(other) == other,
            "they stand for their sets"
        );
        self.parent[other] = root as u32;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_smallest_connected_member_stands_for_a_set(
            pairs in prop::collection::vec((0usize..40, 0usize..40), 0..60),
        ) {
            let mut sets = DisjointSets::new(39);
            sets.push();
            for &(a, b) in &pairs {
                sets.join(a, b);
            }
            // Labels spread until nothing changes.
            let mut least: Vec<usize> = (0..40).collect();
            for _ in 0..40 {
                for &(a, b) in &pairs {
                    let label = least[a].min(least[b]);
                    (least[a], least[b]) = (label, label);
                }
            }
            let roots: Vec<usize> = (0..40).map(|k| sets.root(k)).collect();
            prop_assert_eq!(roots, least);
        }
    }

    #[test]
    fn a_link_keeps_the_chosen_root() {
        let mut sets = DisjointSets::new(4);
        sets.link(3, 0);
        sets.link(3, 1);
        assert_eq!((0..4).map(|k| sets.root(k)).collect::<Vec<_>>(), [3, 3, 2, 3]);
    }
}
