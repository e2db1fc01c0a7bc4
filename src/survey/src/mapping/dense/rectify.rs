//! Photos rectified onto the plane of a block.
//!
//! The lens and the pose (of each row, with a rolling shutter) are exact at the nodes of a lattice of `LATTICE` cells; between
//! them image positions are interpolated linearly, which is within a hundredth of a pixel. The matching looks at one channel,
//!
//! ```text
//! m = 1/2 grey + w max(0, G - R)
//! ```
//!
//! in which leaves stand out from soil of the same brightness.

use super::sweep::Rectified;
use crate::mapping::{View, photo::DecodedPhoto, undistort::Interpolation};

/// Distance of the nodes at which lens and pose are exact, cells.
const LATTICE: usize = 8;
/// Weight of the green part of the channel that is matched.
pub(super) const GREEN_WEIGHT: f32 = 1.5;

/// A photo in memory with its lens and pose.
#[derive(Debug, Clone, Copy)]
pub struct PosedPhoto<'a> {
    /// Lens and pose, in the frame of the ground grid.
    pub view: &'a View,
    /// Its pixels.
    pub photo: &'a DecodedPhoto,
}

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

    /// A place in cells.
    pub fn cell(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [(x - self.corner_m[0]) / self.cell_m, (self.corner_m[1] - y) / self.cell_m]
    }
}

/// By how much green exceeds the larger of red and blue: water, sky-blue roofs and wet roads are no leaves.
pub fn greenness([red, green, blue]: [u8; 3]) -> i16 {
    i16::from(green) - i16::from(red.max(blue))
}

/// A photo on the plane of a block with `margin` more cells on each side, and its colours; black where it shows nothing. A cell is the
/// mean of `samples` by `samples` values.
pub fn rectify(
    photo: PosedPhoto<'_>,
    block: &BlockPlane,
    (margin, samples): (usize, usize),
    interpolation: Interpolation,
) -> (Rectified, Vec<[u8; 3]>) {
    if samples < 2 {
        return sampled(photo, block, margin, interpolation);
    }
    // The first of the smaller cells is as far from the middle of the first cell as the last of it.
    let cell_m = block.cell_m / samples as f64;
    let back_m = 0.5 * (block.cell_m - cell_m);
    let corner_m = [block.corner_m[0] - back_m, block.corner_m[1] + back_m];
    let size = block.size.map(|n| n * samples);
    let height_m = block.at_m(corner_m);
    let smaller = BlockPlane { corner_m, cell_m, size, height_m, slope: block.slope };
    let (found, colours) = sampled(photo, &smaller, margin * samples, interpolation);
    let [width, height] = block.size.map(|n| n + 2 * margin);
    let mut values = vec![0; width * height];
    let mut colour = vec![[0; 3]; width * height];
    let count = (samples * samples) as u32;
    for (at, (value, colour)) in values.iter_mut().zip(&mut colour).enumerate() {
        let [u, v] = [at % width * samples, at / width * samples];
        let (mut sum, mut sums, mut seen) = (0, [0; 3], 0);
        for row in v..v + samples {
            for at in row * found.width + u..row * found.width + u + samples {
                sum += u32::from(found.values[at]);
                (0..3).for_each(|c| sums[c] += u32::from(colours[at][c]));
                seen += u32::from(found.values[at] > 0);
            }
        }
        if seen == count {
            *value = ((sum + count / 2) / count) as u8;
            *colour = sums.map(|sum| ((sum + count / 2) / count) as u8);
        }
    }
    let centre_m = photo.view.centre_m();
    let centre = block.cell([centre_m[0], centre_m[1]]);
    (Rectified { values, width, height, origin: [-(margin as f64); 2], centre, ..found }, colour)
}

/// The same with one value for a cell.
fn sampled(
    photo: PosedPhoto<'_>,
    block: &BlockPlane,
    margin: usize,
    interpolation: Interpolation,
) -> (Rectified, Vec<[u8; 3]>) {
    let [width, height] = block.size.map(|n| n + 2 * margin);
    let nodes = width.div_ceil(LATTICE) + 1;
    let at = |column: usize, row: usize| -> Option<[f64; 2]> {
        let cell = [column as f64 - margin as f64, row as f64 - margin as f64];
        let [x, y] = block.place_m(cell);
        photo.view.seen_px([x, y, block.at_m([x, y])])
    };
    let line = |row: usize| -> Vec<Option<[f64; 2]>> {
        (0..nodes).map(|k| at(k * LATTICE, row * LATTICE)).collect()
    };
    let mut values = vec![0; width * height];
    let mut colour = vec![[0; 3]; width * height];
    let mut positions = vec![[0.0f32; 2]; width];
    let mut colours = vec![[0u8; 4]; width];
    let (mut above, mut below) = (line(0), line(1));
    for row in 0..height {
        let step = row % LATTICE;
        if step == 0 && row > 0 {
            above = std::mem::replace(&mut below, line(row / LATTICE + 1));
        }
        interpolate(&above, &below, step as f64 / LATTICE as f64, &mut positions);
        let [columns, rows] = photo.photo.size_px();
        photo.photo.colours(&positions, interpolation, None, &mut colours);
        let values = &mut values[row * width..][..width];
        let colour = &mut colour[row * width..][..width];
        for k in 0..width {
            let [u, v] = positions[k];
            let seen = u >= -0.5
                && v >= -0.5
                && u <= columns as f32 - 0.5
                && v <= rows as f32 - 0.5
                && colours[k][3] == 255;
            if seen {
                let [r, g, b] = [0, 1, 2].map(|c| f32::from(colours[k][c]));
                let grey = 0.299 * r + 0.587 * g + 0.114 * b;
                let mixed = 0.5 * grey + GREEN_WEIGHT * (g - r).max(0.0);
                values[k] = mixed.round().clamp(1.0, 255.0) as u8;
                colour[k] = [0, 1, 2].map(|c| colours[k][c]);
            }
        }
    }
    let centre_m = photo.view.centre_m();
    let rectified = Rectified {
        values,
        width,
        height,
        origin: [-(margin as f64); 2],
        centre: block.cell([centre_m[0], centre_m[1]]),
        above_m: centre_m[2] - block.at_m([centre_m[0], centre_m[1]]),
    };
    (rectified, colour)
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
