//! Which key points stay when there are more than asked for.
//!
//! The picture is cut into square cells. In each, key points are ranked by their contrast; then all
//! are taken by rank, and by contrast within a rank, until the number is reached. So every cell gives
//! its strongest before any gives its second, cells with few leave their share to the others, and
//! where the number would take all, all stay.

/// Cells on the picture's longer side when a given number of key points is asked for: about eight in
/// a cell, so that the strongest can be chosen without clustering.
fn cells_on_long_side(wanted: usize, width: f32, height: f32) -> f32 {
    let cells = (wanted as f32 / 8.0).max(1.0);
    let ratio = width.max(height) / width.min(height).max(1.0);
    (cells * ratio).sqrt().clamp(1.0, 256.0)
}

/// Indices of the `wanted` best of the points `(x_px, y_px, strength)`, the best first.
///
/// Points of equal rank and strength come in the order given.
pub(super) fn grid_select(
    points: &[(f32, f32, f32)],
    (width_px, height_px): (f32, f32),
    wanted: usize,
) -> Vec<usize> {
    if wanted == 0 {
        return Vec::new();
    }
    let long = cells_on_long_side(wanted, width_px, height_px);
    let side_px = (width_px.max(height_px) / long).max(1.0);
    let columns = (width_px / side_px).ceil().max(1.0) as usize;
    let cell_of = |&(x, y, _): &(f32, f32, f32)| {
        let column = ((x / side_px).max(0.0) as usize).min(columns - 1);
        (y / side_px).max(0.0) as usize * columns + column
    };
    let stronger = |&a: &usize, &b: &usize| points[b].2.total_cmp(&points[a].2).then(a.cmp(&b));
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.sort_unstable_by(|a, b| {
        cell_of(&points[*a]).cmp(&cell_of(&points[*b])).then(stronger(a, b))
    });
    let mut ranked: Vec<(usize, usize)> = Vec::with_capacity(points.len());
    let (mut cell, mut rank) = (usize::MAX, 0);
    for index in order {
        let own = cell_of(&points[index]);
        rank = if own == cell { rank + 1 } else { 0 };
        cell = own;
        ranked.push((rank, index));
    }
    ranked.sort_unstable_by(|a, b| a.0.cmp(&b.0).then(stronger(&a.1, &b.1)));
    ranked.iter().take(wanted).map(|&(_, index)| index).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn a_busy_corner_does_not_take_all() {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        // Nine tenths of the points, and the strongest, lie in one sixteenth of the picture.
        let points: Vec<(f32, f32, f32)> = (0..20_000)
            .map(|k| {
                let (size, strength) = if k % 10 > 0 { (250.0, 2.0) } else { (1000.0, 1.0) };
                let random = &mut random;
                let mut upto = |limit: f32| random.random::<f32>() * limit;
                (upto(size), upto(size), upto(strength))
            })
            .collect();
        let kept = grid_select(&points, (1000.0, 1000.0), 1600);
        assert_eq!(kept.len(), 1600);
        let in_corner = |&k: &usize| points[k].0 < 250.0 && points[k].1 < 250.0;
        let corner = kept.iter().filter(|k| in_corner(k)).count();
        assert!((80..200).contains(&corner), "{corner} of 1600 in a sixteenth of the picture");
        // Elsewhere four of five stay; of evenly spread strengths up to 1 their mean is 0.6.
        let elsewhere: Vec<f32> =
            kept.iter().filter(|k| !in_corner(k)).map(|&k| points[k].2).collect();
        assert!(elsewhere.iter().sum::<f32>() > 0.55 * elsewhere.len() as f32);
    }

    #[test]
    fn fewer_than_asked_for_all_stay() {
        let points = [(1.0, 1.0, 0.5), (1.0, 1.0, 0.5), (9.0, 3.0, 0.1)];
        assert_eq!(grid_select(&points, (10.0, 10.0), 3), [0, 1, 2]);
        assert!(grid_select(&points, (10.0, 10.0), 0).is_empty());
        assert!(grid_select(&[], (0.0, 0.0), 7).is_empty());
        assert_eq!(grid_select(&points, (10.0, 10.0), 1), [0], "equal ones in their order");
    }
}
