//! Which triangle is nearest at each sample of a tile: edge functions over bounding boxes.
//!
//! Triangles are visited in ascending order and a later one wins only where it is strictly nearer, so the
//! result does not depend on how tiles are given to threads.

/// Side of a tile, pixels.
pub(super) const TILE: usize = 64;
/// No triangle.
pub(super) const NONE: u32 = u32::MAX;

/// A point on the raster: column, row, and a depth of which the larger is nearer. Not a number where a
/// corner cannot be seen.
pub(super) type Place = [f32; 3];

/// Which triangles touch which tile.
pub(super) struct Bins {
    columns: usize,
    starts: Vec<u32>,
    triangles: Vec<u32>,
}

impl Bins {
    pub(super) fn new(
        places: &[Place],
        triangles: &[[u32; 4]],
        width: usize,
        height: usize,
    ) -> Bins {
        let (columns, rows) = (width.div_ceil(TILE), height.div_ceil(TILE));
        let span = |triangle: &[u32; 4]| -> Option<[usize; 4]> {
            let corners = [0, 1, 2].map(|k| places[triangle[k] as usize]);
            let mut range = [0; 4];
            for axis in 0..2 {
                let values = corners.map(|corner| corner[axis]);
                if values.iter().any(|value| value.is_nan()) {
                    return None;
                }
                let low = values[0].min(values[1]).min(values[2]) - 1.0;
                let high = values[0].max(values[1]).max(values[2]) + 1.0;
                let size = if axis == 0 { width } else { height };
                if high < 0.0 || low >= size as f32 {
                    return None;
                }
                range[axis] = low.max(0.0) as usize / TILE;
                range[2 + axis] = (high as usize).min(size - 1) / TILE;
            }
            Some(range)
        };
        let mut starts = vec![0u32; columns * rows + 1];
        for triangle in triangles {
            if let Some([i0, j0, i1, j1]) = span(triangle) {
                for j in j0..=j1 {
                    for i in i0..=i1 {
                        starts[j * columns + i + 1] += 1;
                    }
                }
            }
        }
        for tile in 1..starts.len() {
            starts[tile] += starts[tile - 1];
        }
        let mut next = starts.clone();
        let mut sorted = vec![0; starts[starts.len() - 1] as usize];
        for (number, triangle) in triangles.iter().enumerate() {
            if let Some([i0, j0, i1, j1]) = span(triangle) {
                for j in j0..=j1 {
                    for i in i0..=i1 {
                        let place = &mut next[j * columns + i];
                        sorted[*place as usize] = number as u32;
                        *place += 1;
                    }
                }
            }
        }
        Bins { columns, starts, triangles: sorted }
    }

    /// The triangles that touch the tile at (`column`, `row`) of tiles, ascending.
    pub(super) fn tile(&self, column: usize, row: usize) -> &[u32] {
        let tile = row * self.columns + column;
        &self.triangles[self.starts[tile] as usize..self.starts[tile + 1] as usize]
    }
}

/// The nearest triangle and its depth at each sample of a tile; a pixel's samples follow each other.
pub(super) struct Samples<const N: usize> {
    pub(super) nearest: Vec<u32>,
    pub(super) depth: Vec<f32>,
}

impl<const N: usize> Samples<N> {
    pub(super) fn new() -> Samples<N> {
        Samples {
            nearest: vec![NONE; TILE * TILE * N],
            depth: vec![f32::NEG_INFINITY; TILE * TILE * N],
        }
    }

    pub(super) fn clear(&mut self) {
        self.nearest.fill(NONE);
        self.depth.fill(f32::NEG_INFINITY);
    }

    /// Draws triangles over the tile whose first pixel is (`left`, `top`), with samples at `offsets` from
    /// the pixels' centres.
    pub(super) fn draw(
        &mut self,
        list: &[u32],
        places: &[Place],
        triangles: &[[u32; 4]],
        [left, top]: [usize; 2],
        offsets: &[[f32; 2]; N],
    ) {
        let reach = offsets.iter().flatten().fold(0.0f32, |most, offset| most.max(offset.abs()));
        for &number in list {
            let triangle = &triangles[number as usize];
            let [a, b, c] = [0, 1, 2].map(|k| {
                let [u, v, w] = places[triangle[k] as usize];
                [u - left as f32, v - top as f32, w]
            });
            let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
            if area == 0.0 || area.is_nan() {
                continue;
            }
            let inverse = 1.0 / area;
            let (low_u, high_u) = (a[0].min(b[0]).min(c[0]), a[0].max(b[0]).max(c[0]));
            let (low_v, high_v) = (a[1].min(b[1]).min(c[1]), a[1].max(b[1]).max(c[1]));
            let last = (TILE - 1) as f32;
            if high_u < -reach || high_v < -reach || low_u > last + reach || low_v > last + reach {
                continue;
            }
            let first_u = (low_u - reach).ceil().max(0.0) as usize;
            let end_u = (high_u + reach).floor().min(last) as usize;
            let first_v = (low_v - reach).ceil().max(0.0) as usize;
            let end_v = (high_v + reach).floor().min(last) as usize;
            // Barycentric weights of b and c are linear in the position.
            let (bu, bv) = ((c[1] - a[1]) * inverse, -(c[0] - a[0]) * inverse);
            let (cu, cv) = (-(b[1] - a[1]) * inverse, (b[0] - a[0]) * inverse);
            let (db, dc) = (b[2] - a[2], c[2] - a[2]);
            for v in first_v..=end_v {
                for u in first_u..=end_u {
                    let start = (v * TILE + u) * N;
                    for (sample, offset) in offsets.iter().enumerate() {
                        let (pu, pv) = (u as f32 + offset[0] - a[0], v as f32 + offset[1] - a[1]);
                        let (wb, wc) = (pu * bu + pv * bv, pu * cu + pv * cv);
                        if wb < 0.0 || wc < 0.0 || wb + wc > 1.0 {
                            continue;
                        }
                        let depth = a[2] + wb * db + wc * dc;
                        if depth > self.depth[start + sample] {
                            self.depth[start + sample] = depth;
                            self.nearest[start + sample] = number;
                        }
                    }
                }
            }
        }
    }
}

/// Barycentric weights of a position in a triangle.
pub(super) fn weights(corners: [Place; 3], u: f32, v: f32) -> [f32; 3] {
    let [a, b, c] = corners;
    let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
    let (pu, pv) = (u - a[0], v - a[1]);
    let wb = (pu * (c[1] - a[1]) - pv * (c[0] - a[0])) / area;
    let wc = (pv * (b[0] - a[0]) - pu * (b[1] - a[1])) / area;
    [1.0 - wb - wc, wb, wc]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearer_triangle_wins_and_areas_are_right() {
        let places: Vec<Place> = vec![
            [2.0, 2.0, 1.0],
            [42.0, 2.0, 1.0],
            [2.0, 42.0, 1.0],
            [2.0, 2.0, 2.0],
            [12.0, 2.0, 2.0],
            [2.0, 12.0, 2.0],
        ];
        let triangles = [[0, 1, 2, 0], [3, 4, 5, 1]];
        let bins = Bins::new(&places, &triangles, 64, 64);
        assert_eq!(bins.tile(0, 0), [0, 1]);
        let mut samples = Samples::<4>::new();
        let offsets = [[-0.125, -0.375], [0.375, -0.125], [-0.375, 0.125], [0.125, 0.375]];
        samples.draw(bins.tile(0, 0), &places, &triangles, [0, 0], &offsets);
        let count =
            |which: u32| samples.nearest.iter().filter(|&&n| n == which).count() as f64 / 4.0;
        assert!((count(1) - 50.0).abs() < 1.5, "{}", count(1));
        assert!((count(0) - 750.0).abs() < 3.0, "{}", count(0));
    }

    #[test]
    fn corners_that_cannot_be_seen_drop_their_triangle() {
        let places = vec![[f32::NAN, 2.0, 1.0], [42.0, 2.0, 1.0], [2.0, 42.0, 1.0]];
        let bins = Bins::new(&places, &[[0, 1, 2, 0]], 64, 64);
        assert!(bins.tile(0, 0).is_empty());
    }
}
