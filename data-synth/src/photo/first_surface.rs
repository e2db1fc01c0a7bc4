//! The first surface from straight above: what a true surface model of the field holds.
//!
//! Each cell has four samples. Where at least two of them lie on something (a leaf, stalk, stone or target),
//! its height is the mean of the highest points there, otherwise the mean of the ground's.

use super::{
    SAMPLES, Studio,
    raster::{Bins, NONE, Place, Samples, TILE},
};
use crate::mesh::Kind;
use rayon::prelude::*;

/// A grid over the field: north up, metres of the local frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceGrid {
    /// X of the centre of the top-left cell, metres.
    pub left_m: f64,
    /// Y of the centre of the top-left cell, metres.
    pub top_m: f64,
    /// Side of a cell, metres.
    pub cell_m: f64,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

/// What covers a cell seen from straight above.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cover {
    /// Bare ground, straw on it too.
    Ground,
    /// Leaf or stalk of a plant or weed.
    Plant,
    /// A stone or target.
    Other,
}

/// The first surface on a grid, row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct FirstSurface {
    /// Where its cells are.
    pub grid: SurfaceGrid,
    /// Height of the highest thing, metres.
    pub top_m: Vec<f32>,
    /// Height of the ground below it, metres.
    pub ground_m: Vec<f32>,
    /// What is seen.
    pub cover: Vec<Cover>,
}

impl Studio<'_> {
    /// The first surface on a grid.
    pub fn first_surface(&self, grid: SurfaceGrid) -> FirstSurface {
        let SurfaceGrid { left_m, top_m: north_m, cell_m, width, height } = grid;
        let size = [width, height].map(|n| n as f64 * cell_m);
        let (low, high) = ([left_m, north_m - size[1]], [left_m + size[0], north_m]);
        let mesh = self.world.gather(low, high, |_| true);
        let place = |p: [f32; 3]| -> Place {
            [
                ((f64::from(p[0]) - left_m) / cell_m) as f32,
                ((north_m - f64::from(p[1])) / cell_m) as f32,
                p[2],
            ]
        };
        let places: Vec<Place> = mesh.vertices.iter().map(|v| place(v.place_m)).collect();
        let bins = Bins::new(&places, &mesh.triangles, width, height);
        let mut top_m = vec![0.0; width * height];
        let mut ground_m = vec![0.0; width * height];
        let mut cover = vec![Cover::Ground; width * height];
        top_m
            .par_chunks_mut(width * TILE)
            .zip(ground_m.par_chunks_mut(width * TILE))
            .zip(cover.par_chunks_mut(width * TILE))
            .enumerate()
            .for_each_init(Samples::<4>::new, |samples, (band, ((top_m, ground_m), cover))| {
                for tile in 0..width.div_ceil(TILE) {
                    let corner = [tile * TILE, band * TILE];
                    samples.clear();
                    let list = bins.tile(tile, band);
                    samples.draw(list, &places, &mesh.triangles, corner, &SAMPLES);
                    for line in 0..top_m.len() / width {
                        for step in 0..TILE.min(width - corner[0]) {
                            let (column, row) = (corner[0] + step, corner[1] + line);
                            let at = line * width + column;
                            let x = left_m + column as f64 * cell_m;
                            let y = north_m - row as f64 * cell_m;
                            ground_m[at] = self.world.field.terrain.height_m(x, y) as f32;
                            let first = (line * TILE + step) * 4;
                            let (mut sum, mut hits, mut plants) = (0.0, 0, 0);
                            for sample in first..first + 4 {
                                let triangle = samples.nearest[sample];
                                if triangle == NONE {
                                    continue;
                                }
                                let thing = mesh.triangles[triangle as usize][3] as usize;
                                let kind = mesh.things[thing].kind;
                                if kind == Kind::Residue {
                                    continue;
                                }
                                sum += samples.depth[sample];
                                hits += 1;
                                plants += i32::from(!matches!(kind, Kind::Stone | Kind::Target));
                            }
                            let covered = hits >= 2;
                            top_m[at] = if covered { sum / hits as f32 } else { ground_m[at] };
                            cover[at] = match (covered, 2 * plants >= hits) {
                                (true, true) => Cover::Plant,
                                (true, false) => Cover::Other,
                                (false, _) => Cover::Ground,
                            };
                        }
                    }
                }
            });
        FirstSurface { grid, top_m, ground_m, cover }
    }
}
