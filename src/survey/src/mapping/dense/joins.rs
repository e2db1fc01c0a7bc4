//! Where neighbouring blocks and tiles meet.
//!
//! Each is matched on its own, from its own photos, whose orientation is off by a little: side by side they would have steps. So each has
//! a margin of heights beyond its own cells, and where both show the same surface, heights pass over from one to the other:
//!
//! ```text
//! z = sum_k w_k z_k / sum_k w_k,   w_k = clamp(1/2 + d_k / (2 M), 0, 1)   along columns, times the same along rows
//! ```
//!
//! with `M` the width of the margin and `d_k` how far inside the cells of `k` the centre of a cell lies, both in cells. Heights that differ from the own one by more than a
//! tolerance are of another surface (a leaf above soil) and do not count.

use super::{DenseTile, Pass, TileStore, area::starts};

/// Width of the margin, cells: half of what blocks share with their neighbours, so that paths have begun before it.
pub const MARGIN: usize = 8;
/// Heights that are fewer layers apart than this are of one surface. A first choice, not measured.
const SAME_LAYERS: f64 = 2.0;

/// Heights of the cells around a block or tile, [`MARGIN`] cells wide, metres; NaN where not known.
#[derive(Debug, Clone, PartialEq)]
pub struct Margin {
    size: [usize; 2],
    heights_m: Vec<f32>,
}

impl Margin {
    /// Around so many columns and rows; nothing is known.
    pub fn unknown(size: [usize; 2]) -> Margin {
        let cells = 2 * MARGIN * (size[0] + size[1] + 2 * MARGIN);
        Margin { size, heights_m: vec![f32::NAN; cells] }
    }

    /// Around so many columns and rows, from [`Margin::heights_m`]; `None` where these are not as many as there are cells.
    pub fn from_heights(size: [usize; 2], heights_m: Vec<f32>) -> Option<Margin> {
        (heights_m.len() == Margin::unknown(size).heights_m.len())
            .then_some(Margin { size, heights_m })
    }

    /// Columns and rows inside.
    pub fn size(&self) -> [usize; 2] {
        self.size
    }

    /// The heights, row by row, without the cells inside.
    pub fn heights_m(&self) -> &[f32] {
        &self.heights_m
    }

    /// Columns and rows of all its cells, from the first cell inside.
    pub(super) fn places(size: [usize; 2]) -> impl Iterator<Item = [isize; 2]> {
        let [width, height] = size.map(|n| n as isize);
        let margin = MARGIN as isize;
        (-margin..height + margin).flat_map(move |v| {
            let is_beside = (0..height).contains(&v);
            let columns = -margin..width + margin;
            columns.filter(move |&u| !(is_beside && (0..width).contains(&u))).map(move |u| [u, v])
        })
    }

    /// Where the height of a cell is kept; `None` inside and beyond.
    fn index(&self, [u, v]: [isize; 2]) -> Option<usize> {
        let [width, height] = self.size;
        let (i, j) = ((u + MARGIN as isize) as usize, (v + MARGIN as isize) as usize);
        let row = width + 2 * MARGIN;
        if u < -(MARGIN as isize) || v < -(MARGIN as isize) || i >= row || j >= height + 2 * MARGIN
        {
            return None;
        }
        let above = MARGIN * row;
        if j < MARGIN {
            Some(j * row + i)
        } else if j >= height + MARGIN {
            Some(above + height * 2 * MARGIN + (j - height - MARGIN) * row + i)
        } else if i < MARGIN {
            Some(above + (j - MARGIN) * 2 * MARGIN + i)
        } else {
            (i >= width + MARGIN).then(|| above + (j - MARGIN) * 2 * MARGIN + i - width)
        }
    }

    /// The height of a cell.
    pub(super) fn at(&self, cell: [isize; 2]) -> Option<f32> {
        self.index(cell).map(|at| self.heights_m[at])
    }

    /// Sets the height of a cell of the margin.
    pub(super) fn set(&mut self, cell: [isize; 2], height_m: f32) {
        if let Some(at) = self.index(cell) {
            self.heights_m[at] = height_m;
        }
    }
}

/// A block or tile among others.
#[derive(Debug, Clone, Copy)]
pub(super) struct Part<'a> {
    /// Its first column and row.
    pub start: [usize; 2],
    /// What is around it.
    pub margin: &'a Margin,
}

impl Part<'_> {
    /// A cell of the grid, from the first one of this part.
    fn own(&self, [u, v]: [usize; 2]) -> [isize; 2] {
        [u as isize - self.start[0] as isize, v as isize - self.start[1] as isize]
    }

    fn weight(&self, cell: [isize; 2]) -> f32 {
        let along = |k: usize| {
            let (at, end) = (cell[k] as f32 + 0.5, self.margin.size[k] as f32);
            (0.5 + at.min(end - at) / (2 * MARGIN) as f32).clamp(0.0, 1.0)
        };
        along(0) * along(1)
    }

    /// Whether its margin has cells of another part.
    fn reaches(&self, other: &Part<'_>) -> bool {
        (0..2).all(|k| {
            let [end, other_end] = [self, other].map(|part| part.start[k] + part.margin.size[k]);
            other.start[k] < end + MARGIN && self.start[k] < other_end + MARGIN
        })
    }
}

/// How far apart heights of one surface are at most, metres.
pub(super) fn tolerance_m(layer_m: f64) -> f32 {
    (SAME_LAYERS * layer_m) as f32
}

/// Lets the heights of a part pass over into those of its neighbours; `at` says where the height of a cell of the grid is.
pub(super) fn join(
    part: &Part<'_>,
    others: &[Part<'_>],
    tolerance_m: f32,
    heights_m: &mut [f32],
    at: impl Fn([usize; 2]) -> usize,
) {
    let near: Vec<&Part<'_>> =
        others.iter().filter(|other| other.start != part.start && other.reaches(part)).collect();
    let [width, height] = part.margin.size;
    let inner = |n: usize| MARGIN..n.saturating_sub(MARGIN);
    for v in 0..height {
        for u in 0..width {
            if inner(width).contains(&u) && inner(height).contains(&v) {
                continue;
            }
            let cell = [part.start[0] + u, part.start[1] + v];
            let own_m = heights_m[at(cell)];
            let weight = part.weight([u as isize, v as isize]);
            let (mut sum, mut total) = (weight * own_m, weight);
            for other in &near {
                let theirs = other.own(cell);
                // Comparisons with NaN are false.
                let Some(z) = other.margin.at(theirs) else { continue };
                if (z - own_m).abs() <= tolerance_m {
                    let weight = other.weight(theirs);
                    (sum, total) = (sum + weight * z, total + weight);
                }
            }
            heights_m[at(cell)] = sum / total;
        }
    }
}

/// The margins of all tiles of the fine pass.
#[derive(Debug, Clone, PartialEq)]
pub struct TileMargins {
    margins: Vec<([usize; 2], Margin)>,
    tolerance_m: f32,
}

impl TileMargins {
    /// Of an area of so many columns and rows, matched with layers `layer_m` apart. Tiles that are not there have none.
    ///
    /// # Errors
    /// What the store says.
    pub fn read<E>(
        size: [usize; 2],
        tile_cells: usize,
        layer_m: f64,
        store: &mut dyn TileStore<E>,
    ) -> Result<TileMargins, E> {
        let mut margins = Vec::new();
        for (number, start) in starts(size, tile_cells).into_iter().enumerate() {
            let found = store.load(Pass::Fine, number)?;
            margins.extend(found.map(|tile| (start, tile.margin)));
        }
        Ok(TileMargins { margins, tolerance_m: tolerance_m(layer_m) })
    }

    /// Lets the heights of the tile that begins at a cell of the area pass over into those of its neighbours.
    pub fn join(&self, start: [usize; 2], tile: &mut DenseTile) {
        let others: Vec<Part<'_>> =
            self.margins.iter().map(|(start, margin)| Part { start: *start, margin }).collect();
        let part = Part { start, margin: &tile.margin };
        let width = tile.tile.size[0];
        join(&part, &others, self.tolerance_m, &mut tile.surface_m, |[u, v]| {
            (v - start[1]) * width + u - start[0]
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cell_around_has_a_place_of_its_own() {
        let size = [5, 3];
        let mut margin = Margin::unknown(size);
        for (k, cell) in Margin::places(size).enumerate() {
            margin.set(cell, k as f32);
        }
        let expected: Vec<f32> = (0..margin.heights_m.len()).map(|k| k as f32).collect();
        assert_eq!(margin.heights_m(), expected);
        assert_eq!(margin.at([0, 0]), None);
        assert_eq!(margin.at([4, 2]), None);
        assert_eq!(margin.at([-9, 0]), None);
        assert_eq!(margin.at([13, 0]), None);
        assert_eq!(margin.at([0, 11]), None);
    }

    #[test]
    fn heights_pass_over_where_they_are_of_one_surface() {
        // Two parts side by side, 6 cm apart; in row 5 one sees a leaf.
        let size = [20, 10];
        let around = |height_m: f32| {
            let mut margin = Margin::unknown(size);
            Margin::places(size).for_each(|cell| margin.set(cell, height_m));
            margin
        };
        let (left, right) = (around(0.0), around(0.06));
        let parts =
            [Part { start: [0, 0], margin: &left }, Part { start: [20, 0], margin: &right }];
        let mut heights = [[0.0f32, 0.06]; 10].map(|[a, b]| {
            let mut row = [b; 40];
            row[..20].fill(a);
            row
        });
        heights[5][..20].fill(0.5);
        let mut all = heights.as_flattened().to_vec();
        for part in &parts {
            join(part, &parts, 0.1, &mut all, |[u, v]| v * 40 + u);
        }
        let row = |v: usize| &all[v * 40..(v + 1) * 40];
        let steps = row(4).windows(2).map(|pair| pair[1] - pair[0]);
        assert!(steps.clone().all(|step| step >= 0.0));
        assert!(steps.fold(0.0, f32::max) < 0.06 / 15.0, "{:?}", row(4));
        assert_eq!((row(4)[11], row(4)[28]), (0.0, 0.06));
        assert!((row(4)[19] + row(4)[20] - 0.06).abs() < 1e-6);
        // A leaf stays as it is, and so does the soil beside it.
        assert_eq!(row(5)[..20], [0.5; 20]);
        let soil = row(5)[20..].iter().all(|&z| (z - row(4)[39]).abs() < 0.06);
        assert!(soil, "{:?}", row(5));
        // What is not known is not made known.
        let mut all = vec![f32::NAN; 400];
        join(&parts[0], &parts, 0.1, &mut all, |[u, v]| v * 40 + u);
        assert!(all.iter().all(|z| z.is_nan()));
    }
}
