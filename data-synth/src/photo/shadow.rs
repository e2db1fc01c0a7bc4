//! Cast shadows: the highest thing along each ray of the sun.
//!
//! A point `(X, Y, Z)` lies on the ray of the sun that meets height 0 at `(X, Y) - Z (s_x, s_y)/s_z`, with `s`
//! the direction to the sun. A square lattice of such rays, fixed in the mapping frame, keeps the height of the
//! highest triangle on each; what lies lower on the same ray is in its shadow.

use super::raster::{Bins, Place, Samples, TILE};
use crate::mesh::Mesh;
use rayon::prelude::*;

/// What lies this much below the highest thing on its ray is in the shadow, metres.
const BIAS_M: f32 = 0.012;

/// The shadows of one part of the field.
pub(super) struct Shadows {
    low: [f64; 2],
    cell_m: f64,
    slant: [f64; 2],
    width: usize,
    height: usize,
    columns: usize,
    /// Tiles that no triangle touches are left out.
    tiles: Vec<Option<Box<[f32]>>>,
}

impl Shadows {
    /// The shadows that `mesh` throws on what lies within `low_m..high_m` (X, Y), at heights between
    /// `heights_m`; lattice spacing `cell_m`.
    pub(super) fn new(
        mesh: &Mesh,
        sun: [f64; 3],
        low_m: [f64; 2],
        high_m: [f64; 2],
        heights_m: [f64; 2],
        cell_m: f64,
    ) -> Shadows {
        let slant = [sun[0] / sun[2], sun[1] / sun[2]];
        let shifts = |axis: usize| {
            let [a, b] = heights_m.map(|z| -z * slant[axis]);
            (a.min(b), a.max(b))
        };
        // Whole cells, so that the lattice is the same for every part.
        let low = [0, 1].map(|axis| ((low_m[axis] + shifts(axis).0) / cell_m).floor() * cell_m);
        let size = [0, 1].map(|axis| {
            ((high_m[axis] + shifts(axis).1 - low[axis]) / cell_m).ceil().max(1.0) as usize
        });
        let [width, height] = size;
        let places: Vec<Place> = mesh
            .vertices
            .par_iter()
            .map(|vertex| {
                let [x, y, z] = vertex.place_m.map(f64::from);
                let at = |value: f64, axis: usize| {
                    ((value - z * slant[axis] - low[axis]) / cell_m - 0.5) as f32
                };
                [at(x, 0), at(y, 1), z as f32]
            })
            .collect();
        let bins = Bins::new(&places, &mesh.triangles, width, height);
        let columns = width.div_ceil(TILE);
        let tiles = (0..columns * height.div_ceil(TILE))
            .into_par_iter()
            .map_init(Samples::<1>::new, |samples, tile| {
                let (column, row) = (tile % columns, tile / columns);
                let list = bins.tile(column, row);
                if list.is_empty() {
                    return None;
                }
                samples.clear();
                let corner = [column * TILE, row * TILE];
                samples.draw(list, &places, &mesh.triangles, corner, &[[0.0; 2]]);
                Some(samples.depth.clone().into_boxed_slice())
            })
            .collect();
        Shadows { low, cell_m, slant, width, height, columns, tiles }
    }

    /// Height of the highest thing on a ray of the lattice, metres.
    fn highest_m(&self, i: usize, j: usize) -> f32 {
        match &self.tiles[j / TILE * self.columns + i / TILE] {
            Some(tile) => tile[j % TILE * TILE + i % TILE],
            None => f32::NEG_INFINITY,
        }
    }

    /// How much of the sun reaches a point, 0 to 1.
    pub(super) fn sunlit(&self, [x, y, z]: [f32; 3]) -> f32 {
        let at = |value: f32, axis: usize| {
            let ray = f64::from(value) - f64::from(z) * self.slant[axis];
            ((ray - self.low[axis]) / self.cell_m - 0.5) as f32
        };
        let (a, b) = (at(x, 0), at(y, 1));
        let (i, j) = (a.floor(), b.floor());
        if i < 0.0 || j < 0.0 || i as usize + 1 >= self.width || j as usize + 1 >= self.height {
            return 1.0;
        }
        let (s, t) = (a - i, b - j);
        let (i, j) = (i as usize, j as usize);
        let free = |i, j| f32::from(u8::from(self.highest_m(i, j) <= z + BIAS_M));
        let upper = free(i, j) * (1.0 - s) + free(i + 1, j) * s;
        let lower = free(i, j + 1) * (1.0 - s) + free(i + 1, j + 1) * s;
        upper * (1.0 - t) + lower * t
    }
}
