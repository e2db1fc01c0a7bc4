//! Photos rectified onto the plane of a block.
//!
//! The lens and the pose (of each row, with a rolling shutter) are exact at the nodes of a lattice of `LATTICE` cells; between
//! them image positions are interpolated linearly, which is within a hundredth of a pixel. The matching looks at one channel ([`super::matched`]).

use super::{matched::PosedPhoto, sweep::Rectified};

/// Distance of the nodes at which lens and pose are exact, cells.
const LATTICE: usize = 8;

/// Cells of a block and the plane below them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BlockPlane {
    /// Centre of the first (north-western) cell, metres.
    pub corner_m: [f64; 2],
    /// Side of a cell, metres.
    pub cell_m: f64,
    /// Columns and rows.
    pub size: [usize; 2],
    /// Height of the plane at the corner, metres.
    pub height_m: f64,
    /// Rise of the plane per metre east and north.
    pub slope: [f64; 2],
}

impl BlockPlane {
    /// The place of a position in cells (column, row), metres.
    pub fn place_m(&self, [column, row]: [f64; 2]) -> [f64; 2] {
        [self.corner_m[0] + column * self.cell_m, self.corner_m[1] - row * self.cell_m]
    }

    /// The height of the plane at a place.
    pub fn at_m(&self, [x, y]: [f64; 2]) -> f64 {
        self.height_m
            + self.slope[0] * (x - self.corner_m[0])
            + self.slope[1] * (y - self.corner_m[1])
    }

    /// Other cells of the same grid and plane: the first column and row, and how many.
    pub fn window(&self, first: [isize; 2], size: [usize; 2]) -> BlockPlane {
        let corner_m = self.place_m(first.map(|n| n as f64));
        BlockPlane { corner_m, size, height_m: self.at_m(corner_m), ..*self }
    }

    /// A place in cells.
    pub fn cell(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [(x - self.corner_m[0]) / self.cell_m, (self.corner_m[1] - y) / self.cell_m]
    }
}

/// By how much green exceeds the larger of red and blue: water, sky-blue roofs and wet roads are no leaves.
pub fn greenness([red, green, blue]: [u8; 3]) -> i16 {
    i16::from(green) - i16::from(red.max(blue))
}

/// A photo on the plane of a block; 0 where it shows nothing. A cell is the mean of `samples` by `samples` values.
pub fn rectify(photo: PosedPhoto<'_>, block: &BlockPlane, samples: usize) -> Rectified {
    let samples = samples.max(1);
    let smaller = smaller(block, samples);
    let [width, height] = block.size;
    let mut values = vec![0; width * height];
    let mut line = vec![0u8; smaller.size[0]];
    let mut sums = vec![(0u32, 0u32); width];
    let count = (samples * samples) as u32;
    rows(photo, &smaller, |row, positions| {
        let values = &mut values[row / samples * width..][..width];
        if samples == 1 {
            return photo.photo.values(positions, values);
        }
        photo.photo.values(positions, &mut line);
        for ((sum, seen), line) in sums.iter_mut().zip(line.chunks_exact(samples)) {
            *sum += line.iter().map(|&value| u32::from(value)).sum::<u32>();
            *seen += line.iter().map(|&value| u32::from(value > 0)).sum::<u32>();
        }
        if (row + 1).is_multiple_of(samples) {
            for (value, (sum, seen)) in values.iter_mut().zip(&mut sums) {
                *value = if *seen == count { ((*sum + count / 2) / count) as u8 } else { 0 };
                (*sum, *seen) = (0, 0);
            }
        }
    });
    let centre_m = photo.view.centre_m();
    Rectified {
        values,
        width,
        height,
        origin: [0; 2],
        centre: block.cell([centre_m[0], centre_m[1]]),
        above_m: centre_m[2] - block.at_m([centre_m[0], centre_m[1]]),
    }
}

/// The colours of a photo on the plane of a block, likewise; black where it shows nothing.
pub fn colours(photo: PosedPhoto<'_>, block: &BlockPlane, samples: usize) -> Vec<[u8; 3]> {
    let samples = samples.max(1);
    let smaller = smaller(block, samples);
    let [width, height] = block.size;
    let mut colours = vec![[0; 3]; width * height];
    let mut line = vec![[0u8; 4]; smaller.size[0]];
    let mut sums = vec![[0u32; 3]; width];
    let count = (samples * samples) as u32;
    rows(photo, &smaller, |row, positions| {
        photo.photo.colours(positions, &mut line);
        for (sums, line) in sums.iter_mut().zip(line.chunks_exact(samples)) {
            for colour in line {
                (0..3).for_each(|c| sums[c] += u32::from(colour[c]));
            }
        }
        if (row + 1).is_multiple_of(samples) {
            let out = &mut colours[row / samples * width..][..width];
            for (out, sums) in out.iter_mut().zip(&mut sums) {
                *out = sums.map(|sum| ((sum + count / 2) / count) as u8);
                *sums = [0; 3];
            }
        }
    });
    colours
}

/// A block whose cells are so many times smaller.
fn smaller(block: &BlockPlane, samples: usize) -> BlockPlane {
    // The first of the smaller cells is as far from the middle of the first cell as the last of it.
    let cell_m = block.cell_m / samples as f64;
    let back_m = 0.5 * (block.cell_m - cell_m);
    let corner_m = [block.corner_m[0] - back_m, block.corner_m[1] + back_m];
    let size = block.size.map(|n| n * samples);
    BlockPlane { corner_m, cell_m, size, height_m: block.at_m(corner_m), slope: block.slope }
}

/// Calls `with` for every row of a block: its number, and where the photo shows its cells, pixels.
fn rows(photo: PosedPhoto<'_>, block: &BlockPlane, mut with: impl FnMut(usize, &[[f32; 2]])) {
    let [width, height] = block.size;
    let nodes = width.div_ceil(LATTICE) + 1;
    let at = |column: usize, row: usize| -> Option<[f64; 2]> {
        let [x, y] = block.place_m([column as f64, row as f64]);
        photo.view.seen_px([x, y, block.at_m([x, y])])
    };
    let line = |row: usize| -> Vec<Option<[f64; 2]>> {
        (0..nodes).map(|k| at(k * LATTICE, row * LATTICE)).collect()
    };
    let mut positions = vec![[0.0f32; 2]; width];
    let (mut above, mut below) = (line(0), line(1));
    for row in 0..height {
        let step = row % LATTICE;
        if step == 0 && row > 0 {
            above = std::mem::replace(&mut below, line(row / LATTICE + 1));
        }
        interpolate(&above, &below, step as f64 / LATTICE as f64, &mut positions);
        with(row, &positions);
    }
}

/// Image positions along a row between two rows of nodes; far outside of any photo where a node has none.
fn interpolate(
    above: &[Option<[f64; 2]>],
    below: &[Option<[f64; 2]>],
    share: f64,
    out: &mut [[f32; 2]],
) {
    const NOWHERE: [f32; 2] = [-1e6; 2];
    let node = |k: usize| -> Option<[f64; 2]> {
        let (a, b) = (above[k]?, below[k]?);
        Some([a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])])
    };
    let mut left = node(0);
    for (k, out) in out.chunks_mut(LATTICE).enumerate() {
        let right = node(k + 1);
        match (left, right) {
            (Some(a), Some(b)) => {
                let step = [0, 1].map(|c| (b[c] - a[c]) / LATTICE as f64);
                for (i, out) in out.iter_mut().enumerate() {
                    *out = [0, 1].map(|c| (a[c] + i as f64 * step[c]) as f32);
                }
            }
            _ => out.fill(NOWHERE),
        }
        left = right;
    }
}
