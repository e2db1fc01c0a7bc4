//! Coded targets: which code the cells of a square show.
//!
//! The cells that were read are compared with every code word in four rotations; the word that differs in the fewest cells
//! (Hamming distance) is taken where that is few enough for no other word to be as near.

use super::code_words::{APRILTAG_36H11, ARUCO_4X4_50};

/// A family of coded targets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Family {
    /// Cells along a side, without the black border.
    pub(super) cells: usize,
    words: &'static [u64],
    /// Cells that may be read wrongly.
    max_errors: u32,
}

/// Words differ in 11 cells: two wrong cells leave a margin of seven, which keeps what is no target from being read as one.
pub(super) const APRILTAG: Family = Family { cells: 6, words: &APRILTAG_36H11, max_errors: 2 };
/// Words differ in 4 cells and are 1 of 300 of all: every cell has to be right.
pub(super) const ARUCO: Family = Family { cells: 4, words: &ARUCO_4X4_50, max_errors: 0 };

/// A code that was read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Reading {
    /// Number of the code in its family.
    pub(super) code: usize,
    /// Quarter turns by which the word has to be turned to look like the cells.
    pub(super) turns: usize,
    /// Cells that differ.
    pub(super) errors: u32,
}

impl Family {
    /// Number of codes.
    pub(super) fn len(&self) -> usize {
        self.words.len()
    }

    /// Whether the cells of a code are white, row by row.
    pub(super) fn white(&self, code: usize) -> Vec<bool> {
        let count = self.cells * self.cells;
        let word = self.words.get(code).copied().unwrap_or(0);
        (0..count).map(|k| word >> (count - 1 - k) & 1 == 1).collect()
    }

    /// The code that cells show, row by row.
    pub(super) fn decode(&self, white: &[bool]) -> Option<Reading> {
        let mut word = white.iter().fold(0, |word, &cell| word << 1 | u64::from(cell));
        let mut best: Option<Reading> = None;
        for turns in 0..4 {
            for (code, &other) in self.words.iter().enumerate() {
                let errors = (word ^ other).count_ones();
                if errors <= self.max_errors && best.is_none_or(|best| errors < best.errors) {
                    best = Some(Reading { code, turns, errors });
                }
            }
            word = self.turned_back(word);
        }
        best
    }

    /// The word a quarter turn back: what was the right column, from its top, becomes the top row.
    fn turned_back(&self, word: u64) -> u64 {
        let n = self.cells;
        (0..n * n).fold(0, |turned, k| {
            let (row, column) = (k / n, k % n);
            let from = column * n + (n - 1 - row);
            turned << 1 | (word >> (n * n - 1 - from) & 1)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// The cells a quarter turn on: the top row becomes the right column.
    fn turned(cells: &[bool], n: usize) -> Vec<bool> {
        (0..n * n).map(|k| cells[(n - 1 - k % n) * n + k / n]).collect()
    }

    #[test]
    fn every_code_is_read_in_four_rotations_and_with_the_errors_that_are_allowed() {
        for family in [APRILTAG, ARUCO] {
            for code in 0..family.len() {
                let mut cells = family.white(code);
                for turns in 0..4 {
                    let found = family.decode(&cells).unwrap();
                    assert_eq!(found, Reading { code, turns, errors: 0 });
                    let mut spoiled = cells.clone();
                    for k in 0..family.max_errors as usize {
                        let at = (7 * code + 5 * k) % spoiled.len();
                        spoiled[at] = !spoiled[at];
                    }
                    assert_eq!(family.decode(&spoiled).unwrap().code, code);
                    cells = turned(&cells, family.cells);
                }
            }
        }
    }

    #[test]
    fn code_words_differ_in_as_many_cells_as_their_families_say() {
        for (family, expected) in [(APRILTAG, 11), (ARUCO, 4)] {
            let mut least = u32::MAX;
            for (k, &word) in family.words.iter().enumerate() {
                let mut turned = word;
                for turns in 0..4 {
                    let others = &family.words[..k + usize::from(turns > 0)];
                    let nearest = others.iter().map(|other| (turned ^ other).count_ones()).min();
                    least = least.min(nearest.unwrap_or(u32::MAX));
                    turned = family.turned_back(turned);
                }
            }
            assert_eq!(least, expected);
        }
    }

    #[test]
    fn random_cells_are_no_code() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        for (family, most) in [(APRILTAG, 2), (ARUCO, 60)] {
            let count = family.cells * family.cells;
            let read = (0..10_000).filter(|_| {
                let cells: Vec<bool> = (0..count).map(|_| rng.random_bool(0.5)).collect();
                family.decode(&cells).is_some()
            });
            // 200 of the 65,536 patterns of 4 x 4 cells are codes: what is read there has to fit the picture as well.
            let read = read.count();
            assert!(read <= most, "{read}");
        }
    }
}
