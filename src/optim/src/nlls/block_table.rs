//! Which blocks of a lower block triangle are there, and a number for each.
//!
//! A table over `n` rows takes `4 n^2` bytes where `n` is small, and memory in proportion to the blocks
//! that are there where it is not: a network of 10,000 cameras has some 10^8 pairs, few of them with a
//! point in common.

use super::structure::NONE;

/// Tables of up to this many rows are dense: 4 MB.
const MAX_DENSE_ROWS: usize = 1024;

/// Numbers of the blocks `(row, column)`, `row >= column`, of a block matrix.
#[derive(Debug, Clone)]
pub(super) struct BlockTable {
    /// Where the columns of each row begin; one more entry than rows.
    row_ptr: Vec<usize>,
    /// The columns of each row, ascending.
    columns: Vec<u32>,
    /// The number of each block.
    numbers: Vec<u32>,
    /// The numbers in a square table, [`NONE`] where there is no block; empty above
    /// [`MAX_DENSE_ROWS`].
    dense: Vec<u32>,
}

/// One row of a table.
#[derive(Debug, Clone, Copy)]
pub(super) struct TableRow<'a> {
    table: &'a BlockTable,
    row: usize,
    dense: Option<&'a [u32]>,
}

impl TableRow<'_> {
    /// The number of the block in `column`, or [`NONE`].
    #[inline(always)]
    pub(super) fn get(&self, column: usize) -> u32 {
        match self.dense {
            Some(dense) => dense[column],
            None => self.table.search(self.row, column),
        }
    }
}

impl BlockTable {
    /// A table of the blocks that `rows` lists (ascending columns, row by row); `number` gives the
    /// number of each, row by row.
    pub(super) fn new(
        rows: impl ExactSizeIterator<Item = Vec<u32>>,
        mut number: impl FnMut(usize, usize) -> u32,
    ) -> BlockTable {
        let n = rows.len();
        let (mut row_ptr, mut columns) = (vec![0], Vec::new());
        for row in rows {
            debug_assert!(row.is_sorted_by(|a, b| a < b));
            columns.extend_from_slice(&row);
            row_ptr.push(columns.len());
        }
        let mut numbers = Vec::with_capacity(columns.len());
        for row in 0..n {
            for &column in &columns[row_ptr[row]..row_ptr[row + 1]] {
                numbers.push(number(row, column as usize));
            }
        }
        let mut table = BlockTable { row_ptr, columns, numbers, dense: Vec::new() };
        if n <= MAX_DENSE_ROWS {
            let mut dense = vec![NONE; n * n];
            table.for_each(|row, column, number| dense[row * n + column] = number);
            table.dense = dense;
        }
        table
    }

    /// How many blocks there are.
    pub(super) fn len(&self) -> usize {
        self.columns.len()
    }

    /// The number of block `(row, column)`, or [`NONE`].
    #[inline(always)]
    pub(super) fn get(&self, row: usize, column: usize) -> u32 {
        if self.dense.is_empty() {
            self.search(row, column)
        } else {
            self.dense[row * (self.row_ptr.len() - 1) + column]
        }
    }

    /// The numbers of the blocks of one row, for several columns.
    #[inline(always)]
    pub(super) fn row(&self, row: usize) -> TableRow<'_> {
        let n = self.row_ptr.len() - 1;
        let dense = if self.dense.is_empty() { None } else { Some(&self.dense[row * n..][..n]) };
        TableRow { table: self, row, dense }
    }

    #[cold]
    #[inline(never)]
    fn search(&self, row: usize, column: usize) -> u32 {
        let range = self.row_ptr[row]..self.row_ptr[row + 1];
        let found = self.columns[range.clone()].binary_search(&(column as u32));
        found.map_or(NONE, |at| self.numbers[range.start + at])
    }

    /// Visits all blocks as `(row, column, number)`, row by row.
    pub(super) fn for_each(&self, mut visit: impl FnMut(usize, usize, u32)) {
        for row in 0..self.row_ptr.len() - 1 {
            for at in self.row_ptr[row]..self.row_ptr[row + 1] {
                visit(row, self.columns[at] as usize, self.numbers[at]);
            }
        }
    }
}

/// Row by row the columns up to the diagonal that share a group with the row, ascending; the groups
/// are `members[starts[g]..starts[g + 1]]`, ascending, of the numbers below `n`.
pub(super) fn pairs_of_groups(n: usize, starts: &[usize], members: &[u32]) -> Vec<Vec<u32>> {
    // The groups of each member.
    let mut group_ptr = vec![0usize; n + 1];
    members.iter().for_each(|&member| group_ptr[member as usize + 1] += 1);
    for k in 0..n {
        group_ptr[k + 1] += group_ptr[k];
    }
    let (mut next, mut groups) = (group_ptr.clone(), vec![0u32; members.len()]);
    for (group, ends) in starts.windows(2).enumerate() {
        for &member in &members[ends[0]..ends[1]] {
            groups[next[member as usize]] = group as u32;
            next[member as usize] += 1;
        }
    }
    let mut last_row = vec![NONE; n];
    (0..n)
        .map(|row| {
            let mut columns = Vec::new();
            for &group in &groups[group_ptr[row]..group_ptr[row + 1]] {
                let group = group as usize;
                for &column in &members[starts[group]..starts[group + 1]] {
                    if column as usize > row {
                        break;
                    }
                    if last_row[column as usize] != row as u32 {
                        last_row[column as usize] = row as u32;
                        columns.push(column);
                    }
                }
            }
            columns.sort_unstable();
            columns
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_become_pairs() {
        let found = pairs_of_groups(5, &[0, 2, 5, 6], &[1, 3, 0, 1, 4, 2]);
        let expected: [&[u32]; 5] = [&[0], &[0, 1], &[2], &[1, 3], &[0, 1, 4]];
        assert_eq!(found, expected);
    }

    #[test]
    fn a_large_table_needs_no_square_and_finds_the_same_blocks() {
        // Every camera with its 20 neighbours: what a dense table of 13,682 took 0.75 GB for.
        let neighbours = |row: u32| (row.saturating_sub(20)..=row).collect::<Vec<u32>>();
        for n in [600u32, 13_682] {
            let mut count = 0;
            let table = BlockTable::new((0..n).map(neighbours), |_, _| {
                count += 1;
                count - 1
            });
            assert_eq!(table.len(), count as usize);
            assert_eq!(table.dense.is_empty(), n as usize > MAX_DENSE_ROWS);
            let mut seen = 0;
            table.for_each(|row, column, number| {
                assert_eq!((table.get(row, column), number), (seen, seen));
                seen += 1;
            });
            assert_eq!(table.get(500, 400), NONE);
            assert_eq!(table.get(500, 480), (0..500).map(|r| r.min(20) + 1).sum::<u32>());
        }
    }
}
