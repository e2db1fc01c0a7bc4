//! Which plant a leaf belongs to.

use super::Leaves;
use rayon::prelude::*;

/// A leaf has no plant when the nearest is farther than this many leaf lengths (at least 10 usual widths).
const FARTHEST: f64 = 0.75;

/// The plant of each leaf, by its place in `plants_px` (`[u, v]`, pixels).
///
/// A leaf points at its plant with one end: of the plants in reach of either end, it goes to the one with the
/// smallest distance to the end, counted as far along the leaf as `d` and across it as `2 d`. Ties go
/// to the first plant. `None` where no plant is in reach.
pub fn assign(leaves: &Leaves, plants_px: &[[f64; 2]]) -> Vec<Option<usize>> {
    // Plants by column, so that a leaf looks only at those in reach.
    let mut order: Vec<usize> = (0..plants_px.len()).collect();
    order.sort_by(|&a, &b| plants_px[a][0].total_cmp(&plants_px[b][0]).then(a.cmp(&b)));
    let assign_one = |leaf: &super::Leaf| {
        let reach = (FARTHEST * leaf.length_px).max(10.0 * leaves.usual_width_px);
        let (Some(&first), Some(&last)) = (leaf.axis_px.first(), leaf.axis_px.last()) else {
            return None;
        };
        let length = (first[0] - last[0]).hypot(first[1] - last[1]).max(1e-9);
        let along = [(last[0] - first[0]) / length, (last[1] - first[1]) / length];
        let mut best: Option<(f64, usize)> = None;
        for end in [first, last] {
            let from = order.partition_point(|&plant| plants_px[plant][0] < end[0] - reach);
            for &plant in &order[from..] {
                let d = [plants_px[plant][0] - end[0], plants_px[plant][1] - end[1]];
                if d[0] > reach {
                    break;
                }
                let (a, b) = (d[0] * along[0] + d[1] * along[1], d[0] * along[1] - d[1] * along[0]);
                let distance = a.hypot(2.0 * b);
                if d[0].hypot(d[1]) <= reach && best.is_none_or(|best| (distance, plant) < best) {
                    best = Some((distance, plant));
                }
            }
        }
        best.map(|(_, plant)| plant)
    };
    leaves.leaves.par_iter().map(assign_one).collect()
}
