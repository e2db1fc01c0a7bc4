//! Seams along the paths where two photos differ least, which in a field is between rows and beside leaves.
//!
//! By default a seam is where two photos show a cell equally well; about that line there is a band in which either of them is good enough.
//! The band is cut in two where it costs least. With squares of a few cells as the nodes of a graph, the inner sides of the band as
//! seeds, and edges that weigh
//!
//! ```text
//! w(p, q) = max(d_p, d_q),    d = mean |I_a - I_b| + LEAF_WEIGHT max(0, 2 G - R - B)
//! ```
//!
//! a maximum spanning forest that grows from the seeds keeps together what weighs most: the border of its trees is the cut whose
//! heaviest edge is lightest, and so on for the next heaviest. Where weights are alike squares stay on their side of the default seam. A square
//! is only ever given to one of the two photos that show it best, so that the way to the camera is never much longer.
//!
//! Reference: C. Couprie, L. Grady, L. Najman, H. Talbot, "Power watershed: a unifying graph-based optimization framework", IEEE TPAMI
//! 33(7), 2011 (cuts by maximum spanning forests are the limit of minimum cuts).

use super::{
    assignment::Squares,
    colour_correction::ColourCorrection,
    photo::DecodedPhoto,
    photo_cache::PhotoCache,
    select::{Candidate, PhotoSelector},
};
use rayon::prelude::*;
use rowgram_raster::window::Window;
use std::{cmp::Reverse, collections::BinaryHeap};

/// Side of a square, cells: less than the gap between two plants, so that a seam finds it (12 cm at 1.5 cm a pixel).
// This and the next but one are first choices that were looked at on four twin flights and a real one (docs/accuracy.md), not tuned.
const SIDE: usize = 8;
/// The most squares of a map, which are larger where there would be more: some 60 bytes each, 0.25 GB.
const MOST_SQUARES: f64 = 4e6;
/// The band reaches from the default seam to this share of the distance between the two cameras.
const BAND: f64 = 0.2;
/// What excess green weighs beside a difference of two photos, both in grey values: a leaf of 100 as a difference of 50.
const LEAF_WEIGHT: f64 = 0.5;
/// Places in the band are compared as whole numbers, so many from its border to the default seam.
const INSIDE_STEPS: f32 = 1e6;
/// Squares of a row whose photos are listed together; of no influence on results.
const TOGETHER: usize = 64;

/// A square of the band.
#[derive(Debug, Clone, Copy)]
struct Band {
    /// The two photos that show it best, the better one first, and their pixels.
    photos: [u32; 2],
    at_px: [[f32; 2]; 2],
    /// How far from the default seam, of the width of the band.
    off_line: f32,
}

/// A square as a node of the forest.
#[derive(Debug, Clone, Copy)]
enum Node {
    /// No photo shows it.
    Empty,
    /// Only one photo is good enough.
    Seed(u32),
    /// It is cut; the place of the square in the band.
    Open(u32),
}

/// Squares with the photos that are assigned to them so that seams go where photos differ least, for a map of `[width, height]` cells.
///
/// # Errors
/// Photos that cannot be read.
pub fn least_difference<E: Send>(
    selector: &PhotoSelector<'_>,
    [width, height]: [usize; 2],
    corrections: Option<&[ColourCorrection]>,
    photos: &mut PhotoCache<'_, E>,
) -> Result<Squares, E> {
    let cells = width as f64 * height as f64;
    let side = SIDE.max((cells / MOST_SQUARES).sqrt().ceil() as usize);
    let size = [width.div_ceil(side), height.div_ceil(side)];
    let (nodes, band) = nodes(selector, side, size, [width, height]);
    let weights = weights(&band, side, corrections, photos)?;
    let labels = grow(&nodes, &band, &weights, size[0]);
    Ok(Squares { side, columns: size[0], photos: labels })
}

/// The squares, row by row.
fn nodes(
    selector: &PhotoSelector<'_>,
    side: usize,
    [columns, rows]: [usize; 2],
    [width, height]: [usize; 2],
) -> (Vec<Node>, Vec<Band>) {
    let middle = |k: usize, size: usize| (k * side + side / 2).min(size - 1);
    let row = |row: usize| {
        let mut nodes = Vec::with_capacity(columns);
        let mut band = Vec::new();
        let mut candidates = Vec::new();
        for first in (0..columns).step_by(TOGETHER) {
            let last = columns.min(first + TOGETHER);
            let (u, v) = (first * side, row * side);
            let window = Window {
                u,
                v,
                width: width.min(last * side) - u,
                height: height.min(v + side) - v,
            };
            let among = selector.within(window);
            for column in first..last {
                let point = selector.point_m(middle(column, width), middle(row, height));
                candidates.clear();
                if let Some(point) = point {
                    selector.candidates(point, &among, &mut candidates);
                }
                nodes.push(match (point, candidates.as_slice()) {
                    (Some(point), [best, second, ..]) => {
                        match in_band(selector, point, best, second) {
                            Some(found) => {
                                band.push(found);
                                Node::Open(band.len() as u32 - 1)
                            }
                            None => Node::Seed(best.view as u32),
                        }
                    }
                    (_, [only]) => Node::Seed(only.view as u32),
                    _ => Node::Empty,
                });
            }
        }
        (nodes, band)
    };
    let found: Vec<(Vec<Node>, Vec<Band>)> = (0..rows).into_par_iter().map(row).collect();
    let (mut nodes, mut band) = (Vec::with_capacity(columns * rows), Vec::new());
    for (of_row, of_band) in found {
        let first = band.len() as u32;
        nodes.extend(of_row.into_iter().map(|node| match node {
            Node::Open(k) => Node::Open(first + k),
            other => other,
        }));
        band.extend(of_band);
    }
    (nodes, band)
}

fn in_band(
    selector: &PhotoSelector<'_>,
    point_m: [f64; 3],
    best: &Candidate,
    second: &Candidate,
) -> Option<Band> {
    let [a, b] = [best, second].map(|of| selector.views()[of.view].centre_m());
    let apart = (a[0] - b[0]).hypot(a[1] - b[1]);
    let off_line = selector.to_seam_m(point_m, best.view, second.view) / (BAND * apart).max(1e-9);
    (off_line < 1.0).then(|| Band {
        photos: [best.view as u32, second.view as u32],
        at_px: [best, second].map(|of| of.image_px.map(|x| x as f32)),
        off_line: off_line as f32,
    })
}

/// What a cut through each square of the band costs.
fn weights<E: Send>(
    band: &[Band],
    side: usize,
    corrections: Option<&[ColourCorrection]>,
    photos: &mut PhotoCache<'_, E>,
) -> Result<Vec<f32>, E> {
    let mut wanted: Vec<Vec<(u32, u8)>> = vec![Vec::new(); photos.count()];
    for (k, square) in band.iter().enumerate() {
        for (slot, &photo) in (0..).zip(&square.photos) {
            wanted[photo as usize].push((k as u32, slot));
        }
    }
    let needed: Vec<usize> = (0..wanted.len()).filter(|&k| !wanted[k].is_empty()).collect();
    let mut colours: Vec<[Option<[u8; 3]>; 2]> = vec![[None; 2]; band.len()];
    photos.each_group(&needed, |photos| {
        let present = photos.iter().enumerate().filter_map(|(k, photo)| Some((k, (*photo)?)));
        for (k, photo) in present {
            let correction = corrections.map(|of| of[k].prepared());
            let read: Vec<Option<[u8; 3]>> = wanted[k]
                .par_iter()
                .map(|&(square, slot)| {
                    let at = band[square as usize].at_px[usize::from(slot)];
                    let mut colour = mean_colour(photo, at, side)?;
                    if let Some(correction) = &correction {
                        correction.apply(at, &mut colour);
                    }
                    Some([0, 1, 2].map(|c| (colour[c] + 0.5).clamp(0.0, 255.0) as u8))
                })
                .collect();
            for (&(square, slot), colour) in wanted[k].iter().zip(read) {
                colours[square as usize][usize::from(slot)] = colour;
            }
        }
    })?;
    let weight = |colours: &[Option<[u8; 3]>; 2]| {
        let [Some(a), Some(b)] = colours else { return f32::MAX };
        let [a, b] = [a, b].map(|of| of.map(f64::from));
        let difference = (0..3).map(|c| (a[c] - b[c]).abs()).sum::<f64>() / 3.0;
        let [red, green, blue] = [0, 1, 2].map(|c| 0.5 * (a[c] + b[c]));
        (difference + LEAF_WEIGHT * (2.0 * green - red - blue).max(0.0)) as f32
    };
    Ok(colours.iter().map(weight).collect())
}

/// The mean colour of a square window about a position; `None` where it is not all in the photo or has no data.
fn mean_colour(photo: &DecodedPhoto, [u, v]: [f32; 2], side: usize) -> Option<[f32; 4]> {
    let mut sums = [0.0; 4];
    let half = 0.5 * (side as f32 - 1.0);
    // Every second pixel of every second row says as much.
    let steps = || (0..side).step_by(2);
    let mut count = 0.0;
    for j in steps() {
        for i in steps() {
            let pixel = photo.pixel([u - half + i as f32, v - half + j as f32])?;
            (0..4).for_each(|c| sums[c] += f32::from(pixel[c]));
            count += 1.0;
        }
    }
    Some(sums.map(|sum| sum / count))
}

/// Grows the seeds over the band; the photos plus 1 of the squares of the band, 0 of all others.
fn grow(nodes: &[Node], band: &[Band], weights: &[f32], columns: usize) -> Vec<u32> {
    let neighbours = |at: usize| {
        let column = at % columns;
        [
            (column > 0).then(|| at - 1),
            (column + 1 < columns).then_some(at + 1),
            at.checked_sub(columns),
            Some(at + columns).filter(|&at| at < nodes.len()),
        ]
        .into_iter()
        .flatten()
    };
    // Weights are positive: their bits are in their order. Steps of about a tenth make like ones alike.
    let level = |k: u32| (8.0 * (1.0 + weights[k as usize]).log2()) as u32;
    let mut taken: Vec<u32> = vec![0; nodes.len()];
    let mut open = BinaryHeap::new();
    let push =
        |open: &mut BinaryHeap<_>, from: Option<u32>, at: usize, photo: u32, taken: &[u32]| {
            for next in neighbours(at) {
                let Node::Open(k) = nodes[next] else { continue };
                let Band { photos, off_line, .. } = band[k as usize];
                if taken[next] == 0 && photos.contains(&photo) {
                    let weight = from.map_or(0, level).max(level(k));
                    // Of like weights the photo that shows the square best comes first, far from the default seam before near.
                    let inside = if photo == photos[0] { off_line } else { -off_line };
                    open.push((weight, (inside * INSIDE_STEPS) as i32, Reverse(next), photo, k));
                }
            }
        };
    for (at, node) in nodes.iter().enumerate() {
        if let Node::Seed(photo) = *node {
            push(&mut open, None, at, photo, &taken);
        }
    }
    while let Some((_, _, Reverse(at), photo, k)) = open.pop() {
        if taken[at] == 0 {
            taken[at] = photo + 1;
            push(&mut open, Some(k), at, photo, &taken);
        }
    }
    // What no seed reaches stays with its best photo.
    for (taken, node) in taken.iter_mut().zip(nodes) {
        if let (0, Node::Open(k)) = (*taken, node) {
            *taken = band[*k as usize].photos[0] + 1;
        }
    }
    taken
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::{Interior, Model},
        mapping::{Surface, View, select::SelectionOptions, surface::HeightInterpolation},
        scene::Pose,
    };
    use image::{Rgb, RgbImage};
    use rowgram_raster::georeference::{Crs, Georeference};

    const SIZE: [u32; 2] = [800, 600];
    /// Cells of the map, 2 cm each; its corner is at (-4, 3).
    const CELLS: [usize; 2] = [600, 300];
    const GROUND: [u8; 3] = [140, 120, 100];
    const LEAF: [u8; 3] = [60, 160, 50];

    /// 8 m x 6 m on the ground each, 4 m apart, 1 cm a pixel.
    fn views() -> Vec<View> {
        let values = [1000.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let interior = Interior::new(Model::Smac, SIZE, &values).unwrap();
        let at = |k: usize| Pose::from_centre([1.0, 0.0, 0.0, 0.0], [4.0 * k as f64, 0.0, 10.0]);
        (0..2).map(|k| View::new(&format!("p{k}"), interior, at(k), None)).collect()
    }

    /// Bare ground with a plant across the line between the cameras at x = 2 m, which the second photo shows elsewhere.
    fn photo(k: usize) -> DecodedPhoto {
        let image = RgbImage::from_fn(SIZE[0], SIZE[1], |u, v| {
            let x = f64::from(u) / 100.0 - 3.995 + 4.0 * k as f64;
            let y = 2.995 - f64::from(v) / 100.0;
            let shift = 0.2 * k as f64;
            let is_leaf = (1.7 + shift..2.4 + shift).contains(&x) && y.abs() < 0.5;
            Rgb(if is_leaf { LEAF } else { GROUND })
        });
        DecodedPhoto::new(&image, None)
    }

    fn squares(room: usize, threads: usize) -> Squares {
        let place = Georeference::north_up([-10.0, 10.0], 1.0, Crs::LOCAL);
        let level = vec![0.0; 31 * 21];
        let surface = Surface::new(place, [31, 21], level, HeightInterpolation::Bilinear).unwrap();
        let views = views();
        let grid = Georeference::north_up([-3.99, 2.99], 0.02, Crs::LOCAL);
        let selector = PhotoSelector::new(&views, &surface, grid, SelectionOptions::default());
        let read = |k: usize| -> Result<DecodedPhoto, String> { Ok(photo(k)) };
        let mut cache = PhotoCache::new(&views, &read, room);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| least_difference(&selector, CELLS, None, &mut cache)).unwrap()
    }

    #[test]
    fn a_seam_goes_round_a_plant_and_is_the_default_one_on_plain_ground() {
        let found = squares(usize::MAX, 2);
        assert_eq!((found.side, found.columns), (8, 75));
        // A square is 0.16 m.
        let at = |x: f64, y: f64| {
            let [column, row] = [(x + 4.0) / 0.16, (3.0 - y) / 0.16].map(|v| v as usize);
            found.photos[row * found.columns + column]
        };
        for y in [2.5, 1.5, -1.5, -2.5] {
            for (x, photo) in [(1.3, 1), (1.8, 1), (2.2, 2), (2.7, 2)] {
                assert_eq!(at(x, y), photo, "({x}, {y})");
            }
        }
        for y in [0.3, 0.0, -0.3] {
            // The right side of the band is nearer to the middle of what either photo shows of the plant.
            for x in [1.8, 2.0, 2.2, 2.4, 2.7] {
                assert_eq!(at(x, y), 2, "({x}, {y})");
            }
            assert_eq!(at(1.3, y), 1, "{y}");
        }
        // Far from the line squares have no photo.
        assert!(at(-1.0, 0.0) == 0 && at(5.0, 0.0) == 0);
    }

    #[test]
    fn neither_threads_nor_room_change_a_seam() {
        let found = squares(usize::MAX, 1);
        assert!(found == squares(0, 3));
    }
}
