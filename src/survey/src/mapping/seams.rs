//! How far each cell of a map is from the seam of its photo.
//!
//! ```text
//! s = min_j |d_j^2 - d_k^2| / 2 |C_j - C_k|_xy,     k the photo of the cell, j the others that show it
//! ```
//!
//! The fraction is linear in the cell's position, so that its least value over a block of cells is known beforehand: photos
//! are tried by that, until none that is left can be nearer than what all cells of the block have.

use super::{
    cells::{CELLS, CellBlock, Pixels, SIDE},
    select::{CellSources, PhotoSelector},
    view::Bounds,
};
use rayon::prelude::*;

impl PhotoSelector<'_> {
    /// Distance in plan from each cell of a window to the nearest seam of its photo with another that shows it too,
    /// metres; infinite where no other does, and where there is no photo. As `sources` says, row by row.
    pub fn seams_m(&self, sources: &CellSources) -> Vec<f32> {
        let window = sources.window;
        let among = self.within(window);
        let width = window.width;
        let mut out = vec![f32::INFINITY; window.pixels()];
        if out.is_empty() {
            return out;
        }
        // Blocks lie on the grid of those by which photos are chosen, whose heights they share.
        let head = ((SIDE - window.v % SIDE) % SIDE).min(window.height) * width;
        let strip = |scratch: &mut Scratch, first_row: usize, out: &mut [f32]| {
            let top = window.v + first_row;
            let rows = out.len() / width;
            let mut left = window.u - window.u % SIDE;
            while left < window.u + width {
                let columns = window.u.max(left)..(window.u + width).min(left + SIDE);
                scratch.source.fill(0);
                for row in 0..rows {
                    let from = (first_row + row) * width + columns.start - window.u;
                    let to = (top % SIDE + row) * SIDE + columns.start - left;
                    scratch.source[to..to + columns.len()]
                        .copy_from_slice(&sources.source[from..from + columns.len()]);
                }
                self.seams_of_block([left, top - top % SIDE], &among, scratch);
                for row in 0..rows {
                    let from = (top % SIDE + row) * SIDE + columns.start - left;
                    let to = row * width + columns.start - window.u;
                    let found = &scratch.nearest[from..from + columns.len()];
                    out[to..to + columns.len()]
                        .iter_mut()
                        .zip(found)
                        .for_each(|(out, away)| *out = *away as f32);
                }
                left += SIDE;
            }
        };
        let (first, rest) = out.split_at_mut(head);
        if !first.is_empty() {
            strip(&mut Scratch::new(), 0, first);
        }
        rest.par_chunks_mut(width * SIDE)
            .enumerate()
            .for_each_init(Scratch::new, |scratch, (n, out)| {
                strip(scratch, head / width + n * SIDE, out)
            });
        out
    }

    fn seams_of_block(&self, first: [usize; 2], among: &[u32], scratch: &mut Scratch) {
        let Scratch { cells, order, owners, source, shown, nearest } = scratch;
        nearest.fill(f64::INFINITY);
        owners.clear();
        for &source in source.iter().filter(|source| **source > 0) {
            if owners.last() != Some(&(source - 1)) && !owners.contains(&(source - 1)) {
                owners.push(source - 1);
            }
        }
        if owners.is_empty() {
            return;
        }
        cells.fill(first, &self.grid, self.surface, &self.to_surface);
        let middle = cells.bounds_m.map(|[low, high]| 0.5 * (low + high));
        let half = cells.bounds_m.map(|[low, high]| 0.5 * (high - low));
        let reaches = |reach: &Bounds| {
            (0..2)
                .all(|k| reach[k][0] <= cells.bounds_m[k][1] && reach[k][1] >= cells.bounds_m[k][0])
        };
        order.clear();
        for &k in among.iter().filter(|&&k| reaches(&self.reach[k as usize])) {
            let least = owners
                .iter()
                .filter(|&&own| own != k)
                .map(|&own| {
                    let [a, b] = [own, k].map(|n| self.views[n as usize].centre_m());
                    let apart = (a[0] - b[0]).hypot(a[1] - b[1]).max(1e-9);
                    let spread: f64 = (0..3).map(|i| (a[i] - b[i]).abs() * half[i]).sum();
                    self.to_seam_m(middle, own as usize, k as usize) - spread / apart
                })
                .fold(f64::INFINITY, f64::min);
            if least < f64::INFINITY {
                // Rounding must not leave a photo out.
                order.push((least - 1e-6, k));
            }
        }
        order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut farthest = f64::INFINITY;
        for &(least, k) in order.iter() {
            if least >= farthest {
                break;
            }
            let view = &self.views[k as usize];
            if cells.project(view, &self.frame(view), shown) == 0 {
                continue;
            }
            farthest = 0.0;
            for at in (0..CELLS).filter(|&at| source[at] > 0) {
                let own = source[at] - 1;
                if own != k && !shown[at][0].is_nan() {
                    let point = cells.point_m(at % SIDE, at / SIDE);
                    let away = self.to_seam_m(point, own as usize, k as usize);
                    let allowed = || {
                        self.cost(view, point).is_some()
                            && self.options.visibility_m.is_none_or(|tolerance_m| {
                                self.surface.is_visible(point, view.centre_m(), tolerance_m)
                            })
                    };
                    if away < nearest[at] && allowed() {
                        nearest[at] = away;
                    }
                }
                farthest = nearest[at].max(farthest);
            }
        }
    }
}

/// Working memory of a block.
struct Scratch {
    cells: CellBlock,
    order: Vec<(f64, u32)>,
    owners: Vec<u32>,
    source: Box<[u32; CELLS]>,
    shown: Box<Pixels>,
    nearest: Box<[f64; CELLS]>,
}

impl Scratch {
    fn new() -> Scratch {
        Scratch {
            cells: CellBlock::new(),
            order: Vec::new(),
            owners: Vec::new(),
            source: Box::new([0; CELLS]),
            shown: Box::new([[f32::NAN; 2]; CELLS]),
            nearest: Box::new([f64::INFINITY; CELLS]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::{Interior, Model},
        mapping::{Surface, View, select::SelectionOptions},
        scene::Pose,
    };
    use rowgram_optim::geometry::rotation;
    use rowgram_raster::{
        georeference::{Crs, Georeference},
        window::Window,
    };

    /// Eight photos in two strips over waves, from nearly one height.
    fn views() -> Vec<View> {
        let values = [900.0, 2.0, -1.0, 0.0, 2e-7, 3e-14, 0.0, 1e-6, -1e-6, 0.0];
        let interior = Interior::new(Model::Smac, [1000, 750], &values).unwrap();
        let motion = Some([0.002, -0.001, 0.001, 0.05, 0.1, 0.0]);
        (0..8)
            .map(|k| {
                let turn = rotation::exp([0.02 * f64::from(k % 3) - 0.02, 0.01, 0.3]);
                let along = 3.0 * f64::from(k % 4) - 4.5;
                let centre = [along, 5.0 * f64::from(k / 4) - 2.5, 12.0 + 0.2 * f64::from(k % 2)];
                View::new("p", interior, Pose::from_centre(turn, centre), motion)
            })
            .collect()
    }

    #[test]
    fn every_cell_has_the_way_to_the_nearest_seam() {
        let views = views();
        let place = Georeference::north_up([-20.0, 20.0], 0.5, Crs::LOCAL);
        let wave = |k: usize| ((k % 80) as f32 * 0.4).sin() * 0.4;
        let z = (0..80 * 80).map(wave).collect();
        let surface = Surface::new(place, [80, 80], z).unwrap();
        let grid = Georeference::north_up([-9.0, 8.0], 0.05, Crs::LOCAL);
        let whole = Window { u: 0, v: 0, width: 360, height: 320 };
        for options in [
            SelectionOptions::default(),
            SelectionOptions { border_px: 30.0, ..SelectionOptions::default() },
            SelectionOptions { max_angle_rad: Some(0.4), visibility_m: Some(0.01), border_px: 5.0 },
        ] {
            let selector = PhotoSelector::new(&views, &surface, grid, options);
            let sources = selector.sources(whole);
            let found = selector.seams_m(&sources);
            // Window by window it is the same.
            let part = Window { u: 45, v: 70, width: 100, height: 130 };
            let of_part = selector.seams_m(&selector.sources(part));
            for (at, away) in of_part.iter().enumerate() {
                let (u, v) = (part.u + at % part.width, part.v + at / part.width);
                assert!(*away == found[v * whole.width + u], "{u} {v}");
            }
            let all: Vec<u32> = (0..views.len() as u32).collect();
            let (mut compared, mut seen, mut off, mut shown) = (0, 0, 0, Vec::new());
            for at in (0..found.len()).step_by(7) {
                let Some(own) = (sources.source[at] as usize).checked_sub(1) else {
                    assert_eq!(found[at], f32::INFINITY);
                    continue;
                };
                let point = selector.point_m(at % whole.width, at / whole.width).unwrap();
                selector.candidates(point, &all, &mut shown);
                let others = shown.iter().map(|candidate| candidate.view);
                let nearest = others
                    .filter(|&k| k != own)
                    .map(|k| selector.to_seam_m(point, own, k))
                    .fold(f64::INFINITY, f64::min);
                compared += 1;
                seen += usize::from(nearest.is_finite());
                off += usize::from(
                    (f64::from(found[at]) - nearest).abs() > 1e-4 && {
                        f64::from(found[at]) != nearest
                    },
                );
            }
            assert!(seen > compared / 2 && compared > 10_000, "{seen} of {compared}");
            // A photo's border is where the lens says to a few thousandths of a pixel.
            assert!(off * 2_000 < compared, "{off} of {compared}");
        }
    }
}
