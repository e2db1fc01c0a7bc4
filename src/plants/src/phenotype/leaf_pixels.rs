//! Leaf pixels as the search for rows sees them: some of them, spread evenly over all, and all of them, part by part.
//!
//! The sample is every so many pixels along a Hilbert curve, which has as many in each region as the region has leaf. Of a mask it is
//! found without an index of the pixels: the curve goes through square blocks one after the other, so that the pixels of each block are
//! counted, and only blocks that hold a pixel of the sample are sorted.

use crate::problems::plants::index::{Bounds, hilbert, hilbert_order};
use rayon::prelude::*;
use rowgram_raster::Mask;
use std::ops::Range;

/// Parts of the pixels: the same on any number of threads. Not searched for.
const PARTS: usize = 32;
/// Side of a block is two to this power, in pixels. Any gives the same sample; not searched for.
const BLOCK_ORDER: u32 = 5;

/// What each part gives, in order.
pub(super) fn map_parts<T: Send>(of_part: impl Fn(usize) -> T + Sync + Send) -> Vec<T> {
    (0..PARTS).into_par_iter().map(of_part).collect()
}

/// Part `part` of so many things.
fn range(part: usize, of: usize) -> Range<usize> {
    part * of / PARTS..(part + 1) * of / PARTS
}

/// The bounding box of the leaf pixels, if there are any.
pub(super) fn extent(mask: &Mask) -> Option<Bounds> {
    let of_rows = map_parts(|part| {
        let mut extent: Option<[usize; 4]> = None;
        for v in range(part, mask.height) {
            let row = mask.row(v);
            let Some(first) = row.iter().position(|&pixel| pixel != 0) else { continue };
            let last = row.iter().rposition(|&pixel| pixel != 0).unwrap_or(first);
            let [u_min, u_max, v_min, _] = extent.unwrap_or([first, last, v, v]);
            extent = Some([u_min.min(first), u_max.max(last), v_min, v]);
        }
        extent
    });
    let join = |a: [usize; 4], b: [usize; 4]| [a[0].min(b[0]), a[1].max(b[1]), a[2], b[3]];
    let [u_min, u_max, v_min, v_max] =
        of_rows.into_iter().flatten().reduce(join)?.map(|at| at as f32);
    Some(Bounds { u_min, u_max, v_min, v_max })
}

/// Every `stride`-th of them along a Hilbert curve, each by its column and row.
pub(super) fn sample(mask: &Mask, stride: usize) -> Vec<[f64; 2]> {
    let Some(extent) = extent(mask) else { return Vec::new() };
    let order = hilbert_order(extent.u_max.max(extent.v_max) as u32);
    let blocks = [mask.width, mask.height].map(|size| size.div_ceil(1 << BLOCK_ORDER));
    // Blocks with leaf, along the curve: their place on it, number and pixels.
    let of_row = |row: usize| {
        let mut counts = vec![0_u32; blocks[0]];
        for v in block_range(row, mask.height) {
            for (count, line) in counts.iter_mut().zip(mask.row(v).chunks(1 << BLOCK_ORDER)) {
                *count += line.iter().map(|&pixel| u32::from(pixel != 0)).sum::<u32>();
            }
        }
        let filled = counts.into_iter().enumerate().filter(|(_, count)| *count > 0);
        let of_block = |(column, count): (usize, u32)| {
            let first = [column << BLOCK_ORDER, row << BLOCK_ORDER].map(|at| at as u32);
            (hilbert(order, first) >> (2 * BLOCK_ORDER), [column as u32, row as u32], count)
        };
        filled.map(of_block).collect::<Vec<_>>()
    };
    let mut along: Vec<(u64, [u32; 2], u32)> =
        (0..blocks[1]).into_par_iter().flat_map_iter(of_row).collect();
    along.par_sort_unstable();
    // The pixels of the sample in each block, by how many of its pixels come before them.
    let mut wanted: Vec<([u32; 2], Range<usize>)> = Vec::new();
    let mut before = 0_usize;
    for (_, block, count) in along {
        let first = before.div_ceil(stride) * stride - before;
        if first < count as usize {
            wanted.push((block, first..count as usize));
        }
        before += count as usize;
    }
    let of_block = |(block, within): ([u32; 2], Range<usize>)| {
        let [column, row] = block.map(|at| at as usize);
        let mut pixels: Vec<(u64, [u32; 2])> = Vec::with_capacity(within.end);
        for v in block_range(row, mask.height) {
            for u in block_range(column, mask.width).filter(|&u| mask.get(u, v)) {
                let at = [u as u32, v as u32];
                pixels.push((hilbert(order, at), at));
            }
        }
        pixels.sort_unstable();
        let chosen = within.step_by(stride).map(|n| pixels[n].1.map(f64::from));
        chosen.collect::<Vec<_>>()
    };
    wanted.into_par_iter().flat_map_iter(of_block).collect()
}

/// Looks at all pixels of a part, in an order that is always the same.
pub(super) fn visit(mask: &Mask, part: usize, mut see: impl FnMut([f64; 2])) {
    for v in range(part, mask.height) {
        let leaf = mask.row(v).iter().enumerate().filter(|(_, pixel)| **pixel != 0);
        leaf.for_each(|(u, _)| see([u as f64, v as f64]));
    }
}

/// The columns or rows of a block, of `size` in all.
fn block_range(block: usize, size: usize) -> Range<usize> {
    block << BLOCK_ORDER..((block + 1) << BLOCK_ORDER).min(size)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::problems::plants::index::PixelIndex;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_mask_and_its_index_show_the_same_pixels(
            width in 1usize..90, bits in prop::collection::vec(0u8..4, 1..6000), stride in 1usize..40,
        ) {
            let height = bits.len().div_ceil(width);
            let of = |u, v| bits.get(v * width + u).is_some_and(|&bit| bit == 0);
            let mask = Mask::from_fn(width, height, of);
            let index = PixelIndex::from_mask(width, &mask.data);
            prop_assert_eq!(extent(&mask), index.extent());
            let expected = (0..index.len()).step_by(stride).map(|n| index.position(n));
            prop_assert_eq!(sample(&mask, stride), expected.collect::<Vec<_>>());
            let mut seen = Vec::new();
            (0..PARTS).for_each(|part| visit(&mask, part, |at| seen.push(at.map(|x| x as usize))));
            let all = (0..height).flat_map(|v| (0..width).map(move |u| [u, v]));
            prop_assert_eq!(seen, all.filter(|&[u, v]| mask.get(u, v)).collect::<Vec<_>>());
        }
    }
}
