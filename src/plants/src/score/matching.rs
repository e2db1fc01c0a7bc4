//! The best one-to-one matching of two sets of points within a radius.
//!
//! Among the matchings whose pairs are at most `radius` apart, those with the most pairs are
//! wanted, and of these the one with the least sum of distances. With one set as rows `i`, the
//! other as columns `j`, and leaving a row without a partner at the price of one *level*, this is
//!
//! ```text
//! minimise  (rows without partner,  sum of d_ij over the pairs)   in lexicographic order,
//! ```
//!
//! a linear assignment over pairs (level, distance) as costs. It is solved by inserting one row after
//! the other: the shortest augmenting path from the row, in the reduced costs
//! `d_ij - u_i - v_j >= 0`, ends at a free column or at a row that gives up its partner; then the
//! potentials `u`, `v` are raised so that the reduced costs stay non-negative. As `v_j <= 0`,
//! the distance to a box of a k-d tree bounds all reduced costs into it, so the columns near a row
//! are drawn from the tree as Dijkstra's queue asks for them: no list of candidate pairs is made,
//! and the time does not depend on how many lie within the radius.
//!
//! Reference: R. Jonker, A. Volgenant, "A shortest augmenting path algorithm for dense and sparse
//! linear assignment problems", Computing 38, 1987.

use super::tree::Tree;
use std::{
    cmp::{Ordering, Reverse},
    collections::BinaryHeap,
    ops::{Add, Sub},
};

/// A found plant and the true plant that it stands for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MatchedPlants {
    /// Index of the found plant.
    pub found: usize,
    /// Index of the true plant.
    pub truth: usize,
    /// How far apart they are, in pixels.
    pub distance_px: f64,
}

/// The pairs of the best matching within `radius_px` (inclusive), in the order of the smaller set.
///
/// Points with a coordinate that is not finite have no partner.
pub fn within(found: &[[f64; 2]], truth: &[[f64; 2]], radius_px: f64) -> Vec<MatchedPlants> {
    // Fewer rows than columns: then few rows stay alone, and those cost the longest searches.
    let swapped = found.len() > truth.len();
    let (rows, columns) = if swapped { (truth, found) } else { (found, truth) };
    let mut assignment = Assignment::new(rows, columns, radius_px);
    for (row, position) in rows.iter().enumerate() {
        if position.iter().all(|x| x.is_finite()) {
            assignment.insert(row);
        }
    }
    let pairs = assignment.partner_of_row.iter().enumerate();
    pairs
        .filter_map(|(row, &column)| {
            let column = column?;
            let (found, truth) = if swapped { (column, row) } else { (row, column) };
            Some(MatchedPlants { found, truth, distance_px: distance(rows[row], columns[column]) })
        })
        .collect()
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    // Not `hypot`, which is several times slower and better only beyond 1e150.
    let (du, dv) = (a[0] - b[0], a[1] - b[1]);
    (du * du + dv * dv).sqrt()
}

/// Rows left alone, then distance; an ordered group, which is all that shortest paths need.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Cost {
    level: i32,
    distance: f64,
}

const ZERO: Cost = Cost { level: 0, distance: 0.0 };
const ALONE: Cost = Cost { level: 1, distance: 0.0 };

impl Add for Cost {
    type Output = Cost;
    fn add(self, other: Cost) -> Cost {
        Cost { level: self.level + other.level, distance: self.distance + other.distance }
    }
}

impl Sub for Cost {
    type Output = Cost;
    fn sub(self, other: Cost) -> Cost {
        Cost { level: self.level - other.level, distance: self.distance - other.distance }
    }
}

/// What a path from the new row may do next; of equal lengths, the earlier variant first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Reach {
    /// Come to a column.
    Column(usize),
    /// Leave its last row alone.
    Alone,
    /// Look into a box of the tree.
    Box(usize),
}

/// A continuation from `row` and the least length that a path through it has.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Event {
    length: Cost,
    reach: Reach,
    row: usize,
}

impl Eq for Event {}

impl Ord for Event {
    fn cmp(&self, other: &Event) -> Ordering {
        let (a, b) = (self.length, other.length);
        a.level
            .cmp(&b.level)
            .then(a.distance.total_cmp(&b.distance))
            .then(self.reach.cmp(&other.reach))
            .then(self.row.cmp(&other.row))
    }
}

impl PartialOrd for Event {
    fn partial_cmp(&self, other: &Event) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// The rows inserted so far, optimally matched, with the potentials that prove it.
struct Assignment<'a> {
    rows: &'a [[f64; 2]],
    columns: &'a [[f64; 2]],
    radius: f64,
    tree: Tree,
    partner_of_row: Vec<Option<usize>>,
    partner_of_column: Vec<Option<usize>>,
    row_potential: Vec<Cost>,
    column_potential: Vec<Cost>,
    // The search for one row:
    queue: BinaryHeap<Reverse<Event>>,
    /// Rows and columns that the search has settled, with the length of the way there; a row is
    /// settled with its partner.
    settled_rows: Vec<(usize, Cost)>,
    settled_columns: Vec<(usize, Cost)>,
    length_to_row: Vec<Cost>,
    row_before: Vec<usize>,
}

impl<'a> Assignment<'a> {
    fn new(rows: &'a [[f64; 2]], columns: &'a [[f64; 2]], radius: f64) -> Assignment<'a> {
        Assignment {
            rows,
            columns,
            radius,
            tree: Tree::new(columns),
            partner_of_row: vec![None; rows.len()],
            partner_of_column: vec![None; columns.len()],
            row_potential: vec![ZERO; rows.len()],
            column_potential: vec![ZERO; columns.len()],
            queue: BinaryHeap::new(),
            settled_rows: Vec::new(),
            settled_columns: Vec::new(),
            length_to_row: vec![ZERO; rows.len()],
            row_before: vec![0; columns.len()],
        }
    }

    /// Adds a row and makes the matching optimal again.
    fn insert(&mut self, row: usize) {
        let (mut column, length) = self.search(row);
        for &(settled, to) in &self.settled_columns {
            self.column_potential[settled] = self.column_potential[settled] + (to - length);
            self.tree.revive(settled);
        }
        for &(settled, to) in &self.settled_rows {
            self.row_potential[settled] = self.row_potential[settled] + (length - to);
        }
        // Back along the path, every row takes the column that it led to.
        while let Some(taken) = column {
            let by = self.row_before[taken];
            column = self.partner_of_row[by].replace(taken);
            self.partner_of_column[taken] = Some(by);
        }
    }

    /// The shortest augmenting path from `start`: the column that is free at its end, or becomes
    /// so because its row is left alone, and the path's length. `None` where `start` stays alone.
    fn search(&mut self, start: usize) -> (Option<usize>, Cost) {
        self.queue.clear();
        self.settled_rows.clear();
        self.settled_columns.clear();
        self.visit(start, ZERO);
        while let Some(Reverse(Event { length, reach, row })) = self.queue.pop() {
            match reach {
                Reach::Column(column) if self.tree.is_alive(column) => {
                    self.tree.kill(column);
                    self.settled_columns.push((column, length));
                    self.row_before[column] = row;
                    match self.partner_of_column[column] {
                        None => return (Some(column), length),
                        Some(partner) => self.visit(partner, length),
                    }
                }
                Reach::Column(_) => {}
                Reach::Alone => return (self.partner_of_row[row].take(), length),
                Reach::Box(index) => self.open(index, row),
            }
        }
        // Not reached: leaving `start` alone is always in the queue.
        (None, ALONE)
    }

    fn visit(&mut self, row: usize, length: Cost) {
        self.settled_rows.push((row, length));
        self.length_to_row[row] = length;
        let alone = length + (ALONE - self.row_potential[row]);
        self.queue.push(Reverse(Event { length: alone, reach: Reach::Alone, row }));
        self.offer_box(Tree::ROOT, row);
    }

    /// Puts a box into the queue, if it has a column for this search within the radius.
    fn offer_box(&mut self, index: usize, row: usize) {
        let Some(distance) = self.tree.distance(index, self.rows[row]) else { return };
        if distance <= self.radius {
            let length = self.length_by(row, distance);
            self.queue.push(Reverse(Event { length, reach: Reach::Box(index), row }));
        }
    }

    fn length_by(&self, row: usize, distance: f64) -> Cost {
        self.length_to_row[row] + (Cost { level: 0, distance } - self.row_potential[row])
    }

    fn open(&mut self, index: usize, row: usize) {
        if let Some(halves) = self.tree.halves(index) {
            halves.into_iter().for_each(|half| self.offer_box(half, row));
            return;
        }
        for &column in self.tree.points(index) {
            let distance = distance(self.rows[row], self.columns[column]);
            if distance <= self.radius && self.tree.is_alive(column) {
                let length = self.length_by(row, distance) - self.column_potential[column];
                let reach = Reach::Column(column);
                self.queue.push(Reverse(Event { length, reach, row }));
            }
        }
    }
}

#[cfg(test)]
mod tests;
