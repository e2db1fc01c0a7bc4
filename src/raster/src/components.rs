//! Connected components of a mask: small ones removed, small holes filled.
//!
//! Plant pixels are connected through all 8 neighbours, so that thin leaves hold together; what is
//! not plant is connected through the 4 that share an edge, so that a closed line of plant pixels
//! has an inside. A *hole* is a component of non-plant pixels that does not touch the border.
//!
//! The components are found over runs (stretches of equal pixels in one row) joined by union-find:
//! time grows with the pixels, memory with the runs.
//!
//! Reference: L. He et al., "The connected-component labeling problem", Pattern Recognition 70, 2017.

use super::{Mask, window::Window};
use rowgram_base::disjoint_sets::DisjointSets;
use std::ops::Range;

/// What a cleaning step changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Changed {
    /// Number of components (or holes).
    pub components: usize,
    /// Number of their pixels.
    pub pixels: usize,
}

/// Removes the components of plant pixels that have fewer than `min_pixels` pixels.
pub fn remove_small(mask: &mut Mask, min_pixels: usize) -> Changed {
    if min_pixels <= 1 {
        return Changed::default();
    }
    let runs = Runs::of(mask, true);
    let keep = |component: &Component| component.pixels >= min_pixels;
    runs.paint(mask, 0, |component| !keep(component))
}

/// Fills the holes that have at most `max_pixels` pixels.
pub fn fill_holes(mask: &mut Mask, max_pixels: usize) -> Changed {
    if max_pixels == 0 {
        return Changed::default();
    }
    let runs = Runs::of(mask, false);
    runs.paint(mask, 1, |component| component.pixels <= max_pixels && !component.at_border)
}

/// Number of components of plant pixels.
pub fn count(mask: &Mask) -> usize {
    let mut counter = Counter::default();
    counter.add(&mask.data, mask.width);
    counter.count()
}

/// Counts the components of plant pixels of a mask that comes row by row; memory holds one row.
#[derive(Debug, Clone, Default)]
pub struct Counter {
    count: usize,
    /// Columns `start..end` of the runs of the last row, and which component each belongs to, by number of this row.
    above: Vec<(usize, usize, usize)>,
}

impl Counter {
    /// Adds rows of `width` pixels each, from the top.
    pub fn add(&mut self, rows: &[u8], width: usize) {
        for row in rows.chunks_exact(width.max(1)) {
            self.add_row(row);
        }
    }

    fn add_row(&mut self, row: &[u8]) {
        let known = self.above.iter().map(|run| run.2 + 1).max().unwrap_or(0);
        let mut sets = DisjointSets::new(known);
        let mut below: Vec<(usize, usize, usize)> = Vec::new();
        let (mut u, mut first) = (0, 0);
        while let Some(start) = row[u..].iter().position(|&pixel| pixel != 0).map(|n| u + n) {
            let length = row[start..].iter().position(|&pixel| pixel == 0);
            u = length.map_or(row.len(), |length| start + length);
            let own = known + below.len();
            sets.push();
            below.push((start, u, own));
            self.count += 1;
            // Runs that meet at a corner are connected, too.
            while self.above.get(first).is_some_and(|&(_, end, _)| end < start) {
                first += 1;
            }
            for &(_, _, other) in self.above[first..].iter().take_while(|&&(from, ..)| from <= u) {
                if sets.root(own) != sets.root(other) {
                    sets.join(own, other);
                    self.count -= 1;
                }
            }
        }
        // Numbers that are as few as the runs.
        let mut number = vec![usize::MAX; known + below.len()];
        let mut used = 0;
        for run in &mut below {
            let root = sets.root(run.2);
            if number[root] == usize::MAX {
                number[root] = used;
                used += 1;
            }
            run.2 = number[root];
        }
        self.above = below;
    }

    /// The components so far.
    pub fn count(&self) -> usize {
        self.count
    }
}

/// Pixels side by side: columns `start..end` of row `v`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Run {
    /// The row.
    pub v: u32,
    /// The first column.
    pub start: u32,
    /// The column behind the last one.
    pub end: u32,
}

impl Run {
    /// Its pixels in a picture of so many columns, row by row.
    pub fn pixels(&self, width: usize) -> Range<usize> {
        let row = self.v as usize * width;
        row + self.start as usize..row + self.end as usize
    }

    /// Number of its pixels.
    pub fn len(&self) -> usize {
        (self.end - self.start) as usize
    }

    /// Whether it has none.
    pub fn is_empty(&self) -> bool {
        self.end <= self.start
    }

    /// The middles of its pixels.
    pub fn places(&self) -> impl Iterator<Item = [f64; 2]> + Clone + use<> {
        let v = f64::from(self.v);
        (self.start..self.end).map(move |u| [f64::from(u), v])
    }
}

/// A component of plant pixels.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Part {
    /// Its pixels, row by row.
    pub runs: Vec<Run>,
    /// Their number.
    pub pixels: usize,
    /// The smallest window that holds them.
    pub window: Window,
}

/// The components of plant pixels, by their first pixels.
pub fn parts(mask: &Mask) -> Vec<Part> {
    let Runs { runs, mut sets } = Runs::of(mask, true);
    // The component of each run, and their numbers of runs.
    let (mut part_of, mut numbers) = (vec![0_u32; runs.len()], Vec::new());
    for index in 0..runs.len() {
        // The first of its runs stands for a component.
        let root = sets.root(index);
        if root == index {
            part_of[index] = numbers.len() as u32;
            numbers.push(0);
        }
        part_of[index] = part_of[root];
        numbers[part_of[index] as usize] += 1;
    }
    drop(sets);
    let part = |runs| Part { runs: Vec::with_capacity(runs), pixels: 0, window: Window::default() };
    let mut parts: Vec<Part> = numbers.into_iter().map(part).collect();
    for (run, part) in runs.into_iter().zip(part_of) {
        let part = &mut parts[part as usize];
        // Rows come from the top.
        let v = part.runs.first().map_or(run.v, |first| first.v) as usize;
        let (mut columns, rows) = (run.start as usize..run.end as usize, v..run.v as usize + 1);
        if !part.runs.is_empty() {
            let before = part.window.columns();
            columns = columns.start.min(before.start)..columns.end.max(before.end);
        }
        part.window = Window { u: columns.start, v, width: columns.len(), height: rows.len() };
        part.pixels += run.len();
        part.runs.push(run);
    }
    parts
}

/// All runs of one kind of pixel, and which of them are connected.
struct Runs {
    runs: Vec<Run>,
    sets: DisjointSets,
}

#[derive(Clone, Copy, Default)]
struct Component {
    pixels: usize,
    at_border: bool,
}

impl Runs {
    fn of(mask: &Mask, plant: bool) -> Runs {
        let mut all = Runs { runs: Vec::new(), sets: DisjointSets::default() };
        // Plant runs that meet only at a corner are connected, others are not.
        let reach = u32::from(plant);
        let mut above = 0..0;
        for v in 0..mask.height {
            let first = all.runs.len();
            all.add_row(mask, v, plant);
            all.join(above, first..all.runs.len(), reach);
            above = first..all.runs.len();
        }
        all
    }

    fn add_row(&mut self, mask: &Mask, v: usize, plant: bool) {
        let row = mask.row(v);
        let wanted = |pixel: &u8| (*pixel != 0) == plant;
        let mut u = 0;
        while let Some(start) = row[u..].iter().position(wanted).map(|n| u + n) {
            let length = row[start..].iter().position(|pixel| !wanted(pixel));
            u = length.map_or(row.len(), |length| start + length);
            self.sets.push();
            self.runs.push(Run { v: v as u32, start: start as u32, end: u as u32 });
        }
    }

    /// Joins the runs of a row with those of the row above.
    fn join(&mut self, above: Range<usize>, below: Range<usize>, reach: u32) {
        let (mut a, mut b) = (above.start, below.start);
        while a < above.end && b < below.end {
            let (upper, lower) = (self.runs[a], self.runs[b]);
            if upper.start < lower.end + reach && lower.start < upper.end + reach {
                self.sets.join(a, b);
            }
            if upper.end < lower.end {
                a += 1;
            } else {
                b += 1;
            }
        }
    }

    /// Sets all pixels of the components that are `chosen` to `value`.
    fn paint(mut self, mask: &mut Mask, value: u8, chosen: impl Fn(&Component) -> bool) -> Changed {
        let mut components = vec![Component::default(); self.runs.len()];
        for run in 0..self.runs.len() {
            let root = self.sets.root(run);
            let of = self.runs[run];
            let at_border = of.v == 0
                || of.v as usize + 1 == mask.height
                || of.start == 0
                || of.end as usize == mask.width;
            components[root].pixels += of.len();
            components[root].at_border |= at_border;
        }
        let mut changed = Changed::default();
        for run in 0..self.runs.len() {
            let root = self.sets.root(run);
            if chosen(&components[root]) {
                mask.data[self.runs[run].pixels(mask.width)].fill(value);
                changed.pixels += self.runs[run].len();
                changed.components += usize::from(run == root);
            }
        }
        changed
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn mask(picture: &[&str]) -> Mask {
        let pixel = |u: usize, v: usize| picture[v].as_bytes()[u] == b'#';
        Mask::from_fn(picture[0].len(), picture.len(), pixel)
    }

    #[test]
    fn corners_connect_plants_but_not_holes() {
        let mut diagonal = mask(&["#..", ".#.", "..#"]);
        assert_eq!(count(&diagonal), 1);
        assert_eq!(remove_small(&mut diagonal, 3), Changed::default());
        assert_eq!(remove_small(&mut diagonal, 4), Changed { components: 1, pixels: 3 });
        assert_eq!(diagonal.count(), 0);
        let mut ring = mask(&[".#..", "#.#.", ".#.."]);
        assert_eq!(fill_holes(&mut ring, 1), Changed { components: 1, pixels: 1 });
        assert_eq!(ring, mask(&[".#..", "###.", ".#.."]));
    }

    #[test]
    fn a_component_of_many_arms_is_one() {
        let picture = mask(&["#.#.#.#", "#.#.#.#", "###.###", "...#..."]);
        assert_eq!(count(&picture), 1);
        assert_eq!(count(&mask(&["#.#", ".#.", "#.#"])), 1);
        assert_eq!(count(&mask(&["##.##", ".....", "##.##"])), 4);
        assert_eq!(count(&Mask::empty(0, 0)), 0);
        assert_eq!(count(&mask(&["#..#"])), 2, "rows do not run into each other");
        assert_eq!(count(&mask(&["..#", "...", "#.."])), 2);
    }

    #[test]
    fn background_at_the_border_is_no_hole() {
        let mut open = mask(&["##.", "#.#", "###"]);
        assert_eq!(fill_holes(&mut open, 100), Changed { components: 1, pixels: 1 });
        assert!(open.get(1, 1) && !open.get(2, 0));
        let mut large = mask(&["####", "#..#", "####"]);
        assert_eq!(fill_holes(&mut large, 1), Changed::default());
    }

    /// Sizes of the components by flood fill, and whether they touch the border.
    fn flood(mask: &Mask, plant: bool) -> Vec<(usize, bool, usize)> {
        let (width, height) = (mask.width as i64, mask.height as i64);
        let mut label = vec![usize::MAX; mask.data.len()];
        let mut found: Vec<(usize, bool)> = Vec::new();
        for seed in 0..mask.data.len() {
            if (mask.data[seed] != 0) != plant || label[seed] != usize::MAX {
                continue;
            }
            found.push((0, false));
            let (index, mut stack) = (found.len() - 1, vec![seed]);
            label[seed] = index;
            while let Some(pixel) = stack.pop() {
                let (u, v) = (pixel as i64 % width, pixel as i64 / width);
                found[index].0 += 1;
                found[index].1 |= u == 0 || v == 0 || u == width - 1 || v == height - 1;
                for (du, dv) in (-1..=1).flat_map(|du| (-1..=1).map(move |dv| (du, dv))) {
                    let (x, y) = (u + du, v + dv);
                    let allowed = plant || du == 0 || dv == 0;
                    if !allowed || x < 0 || y < 0 || x >= width || y >= height {
                        continue;
                    }
                    let next = (y * width + x) as usize;
                    if (mask.data[next] != 0) == plant && label[next] == usize::MAX {
                        label[next] = index;
                        stack.push(next);
                    }
                }
            }
        }
        label
            .iter()
            .map(|&l| found.get(l).map_or((0, false, l), |&(n, border)| (n, border, l)))
            .collect()
    }

    proptest! {
        #[test]
        fn equal_to_flood_fill(
            width in 1usize..20, bits in proptest::collection::vec(0u8..5, 1..300), limit in 0usize..12
        ) {
            let height = bits.len() / width;
            let original = Mask::from_fn(width, height, |u, v| bits[v * width + u] < 2);
            let (plants, holes) = (flood(&original, true), flood(&original, false));
            let mut labels: Vec<_> =
                plants.iter().map(|p| p.2).filter(|&l| l != usize::MAX).collect();
            labels.sort_unstable();
            labels.dedup();
            prop_assert_eq!(count(&original), labels.len());
            let parts = parts(&original);
            prop_assert_eq!(parts.len(), labels.len());
            for part in parts {
                let pixels: Vec<usize> =
                    part.runs.iter().flat_map(|run| run.pixels(width)).collect();
                let label = plants[pixels[0]].2;
                let of_label = (0..plants.len()).filter(|&at| plants[at].2 == label);
                prop_assert_eq!(of_label.collect::<Vec<_>>(), pixels.clone());
                prop_assert_eq!(part.pixels, pixels.len());
                let bounds = |of: fn(usize, usize) -> usize| {
                    let all = || pixels.iter().map(|&at| of(at, width));
                    all().min().zip(all().max()).map(|(low, high)| low..high + 1)
                };
                prop_assert_eq!(Some(part.window.columns()), bounds(|at, width| at % width));
                prop_assert_eq!(Some(part.window.row_range()), bounds(|at, width| at / width));
            }
            let mut removed = original.clone();
            remove_small(&mut removed, limit);
            let mut filled = original.clone();
            fill_holes(&mut filled, limit);
            for i in 0..width * height {
                let plant = original.data[i] != 0;
                prop_assert_eq!(removed.data[i] != 0, plant && plants[i].0 >= limit);
                let hole = !plant && !holes[i].1 && holes[i].0 <= limit;
                prop_assert_eq!(filled.data[i] != 0, plant || hole);
            }
        }
    }
}
