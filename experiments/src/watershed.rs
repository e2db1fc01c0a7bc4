//! The baseline that leaf segmentation is compared with: a watershed of the distance to the background.
//!
//! As scikit-image and PlantCV do it: markers at the local maxima of the distance transform that are at least so far
//! apart, pixels flooded from the markers in the order of falling distance.

use rowgram::raster::Mask;
use std::{cmp::Reverse, collections::BinaryHeap};

/// Labels `1..` of the plant pixels, 0 elsewhere.
pub(crate) fn labels(mask: &Mask, apart_px: usize) -> Vec<u32> {
    let (width, height) = (mask.width, mask.height);
    let distance = distance(mask);
    // Markers by falling distance, each forbidding others around it.
    let mut order: Vec<usize> = (0..mask.data.len()).filter(|&i| mask.data[i] != 0).collect();
    order.sort_by_key(|&i| (Reverse(distance[i]), i));
    let mut labels = vec![0u32; mask.data.len()];
    let mut forbidden = vec![false; mask.data.len()];
    let mut heap = BinaryHeap::new();
    let mut count = 0;
    for &i in &order {
        let (u, v) = (i % width, i / width);
        if forbidden[i] {
            continue;
        }
        count += 1;
        labels[i] = count;
        heap.push((distance[i], Reverse(i)));
        for y in v.saturating_sub(apart_px)..(v + apart_px + 1).min(height) {
            for x in u.saturating_sub(apart_px)..(u + apart_px + 1).min(width) {
                forbidden[y * width + x] = true;
            }
        }
    }
    while let Some((_, Reverse(i))) = heap.pop() {
        let (u, v) = (i % width, i / width);
        for y in v.saturating_sub(1)..(v + 2).min(height) {
            for x in u.saturating_sub(1)..(u + 2).min(width) {
                let next = y * width + x;
                if mask.data[next] != 0 && labels[next] == 0 {
                    labels[next] = labels[i];
                    heap.push((distance[next], Reverse(next)));
                }
            }
        }
    }
    labels
}

/// Distance to the background in thirds of a pixel (3-4 chamfer); outside the picture is background.
fn distance(mask: &Mask) -> Vec<u32> {
    let (width, height) = (mask.width as i64, mask.height as i64);
    let mut distance: Vec<u32> =
        mask.data.iter().map(|&m| if m == 0 { 0 } else { 1 << 30 }).collect();
    let steps = [(-1, 0, 3), (0, -1, 3), (-1, -1, 4), (1, -1, 4)];
    for forward in [true, false] {
        for k in 0..width * height {
            let i = if forward { k } else { width * height - 1 - k };
            let (u, v) = (i % width, i / width);
            for (du, dv, step) in steps {
                let (du, dv) = if forward { (du, dv) } else { (-du, -dv) };
                let (x, y) = (u + du, v + dv);
                let inside = x >= 0 && y >= 0 && x < width && y < height;
                let near = if inside { distance[(y * width + x) as usize] } else { 0 };
                let here = &mut distance[i as usize];
                *here = (*here).min(near + step);
            }
        }
    }
    distance
}
