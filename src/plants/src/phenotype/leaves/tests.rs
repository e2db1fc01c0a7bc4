//! Ribbons whose width, length and direction are known.

use super::*;

/// Pixels whose centres are within half a width of a line from `a` to `b` (square ends).
fn ribbon(mask: &mut Mask, a: [f64; 2], b: [f64; 2], width: f64) {
    let length = (b[0] - a[0]).hypot(b[1] - a[1]);
    let along = [(b[0] - a[0]) / length, (b[1] - a[1]) / length];
    for v in 0..mask.height {
        for u in 0..mask.width {
            let d = [u as f64 - a[0], v as f64 - a[1]];
            let (s, t) = (d[0] * along[0] + d[1] * along[1], d[1] * along[0] - d[0] * along[1]);
            if (0.0..=length).contains(&s) && t.abs() <= 0.5 * width {
                mask.data[v * mask.width + u] = 1;
            }
        }
    }
}

fn turned(middle: [f64; 2], angle: f64, length: f64) -> [[f64; 2]; 2] {
    let half = [0.5 * length * angle.cos(), 0.5 * length * angle.sin()];
    [[middle[0] - half[0], middle[1] - half[1]], [middle[0] + half[0], middle[1] + half[1]]]
}

fn difference(a: f64, b: f64) -> f64 {
    slices::tilt(a, b)
}

#[test]
fn a_ribbon_is_one_leaf_of_its_width_length_and_direction() {
    for width in [2.2, 4.0, 9.0] {
        let (mut worst_width, mut worst_length, mut worst_angle) = (0.0f64, 0.0f64, 0.0f64);
        for step in 0..24 {
            let angle = f64::from(step) * PI / 24.0 + 0.013;
            let mut mask = Mask::empty(90, 90);
            let [a, b] = turned([44.3, 44.8], angle, 60.0);
            ribbon(&mut mask, a, b, width);
            let found = find(&mask, &LeafOptions::default());
            assert_eq!(found.leaves.len(), 1, "width {width}, angle {angle}");
            let leaf = &found.leaves[0];
            worst_width = worst_width.max((leaf.mean_width_px() - width).abs());
            worst_length = worst_length.max((leaf.length_px - 60.0).abs());
            worst_angle = worst_angle.max(difference(leaf.angle_rad(), angle));
            assert_eq!(leaf.area_px, mask.count());
        }
        // The ribbon is sampled at pixel centres: its edge is known to half a pixel at worst.
        assert!(worst_width < 0.45, "width {width}: {worst_width}");
        assert!(worst_length < 3.0, "width {width}: {worst_length}");
        assert!(worst_angle < 0.08, "width {width}: {worst_angle}");
    }
}

#[test]
fn crossing_leaves_are_two_leaves() {
    let mut mask = Mask::empty(100, 100);
    ribbon(&mut mask, [10.0, 20.0], [88.0, 70.0], 5.0);
    ribbon(&mut mask, [20.0, 85.0], [80.0, 10.0], 5.0);
    for options in [LeafOptions::default(), LeafOptions::paper()] {
        let found = find(&mask, &options);
        let mut lengths: Vec<f64> = found.leaves.iter().map(|leaf| leaf.length_px).collect();
        lengths.sort_by(f64::total_cmp);
        assert_eq!(lengths.len(), 2, "{lengths:?}");
        assert!((lengths[0] - 92.6).abs() < 5.0 && (lengths[1] - 96.0).abs() < 5.0, "{lengths:?}");
    }
    let apart = find(&mask, &LeafOptions { bridging: Bridging::None, ..LeafOptions::default() });
    assert!(apart.leaves.len() >= 3, "{}", apart.leaves.len());
}

#[test]
fn two_leaves_base_to_base_are_split_by_their_width() {
    // Two leaves in line, each narrow at both ends.
    let mask = Mask::from_fn(140, 30, |u, v| {
        let q = (u as f64 - 10.0) / 60.0;
        let inside = (0.0..2.0).contains(&q);
        let half = 1.2 + 3.5 * (PI * q.rem_euclid(1.0)).sin();
        inside && (v as f64 - 15.0).abs() <= half
    });
    assert_eq!(find(&mask, &LeafOptions::default()).leaves.len(), 2);
    assert_eq!(
        find(&mask, &LeafOptions { split: false, ..LeafOptions::default() }).leaves.len(),
        1
    );
}

#[test]
fn empty_full_and_single_pixel_masks() {
    let options = LeafOptions::default();
    assert_eq!(find(&Mask::empty(20, 10), &options).leaves.len(), 0);
    assert_eq!(find(&Mask::empty(0, 0), &options).leaves.len(), 0);
    let mut one = Mask::empty(9, 9);
    one.data[4 * 9 + 4] = 1;
    let found = find(&one, &options);
    assert_eq!(found.leaves.len(), 1);
    assert_eq!(found.leaves[0].runs, [Run { v: 4, start: 4, end: 5 }]);
    for (width, height) in [(1, 1), (30, 20), (200, 3)] {
        let full = Mask::from_fn(width, height, |_, _| true);
        let found = find(&full, &options);
        assert_eq!(found.leaves.iter().map(|leaf| leaf.area_px).sum::<usize>(), width * height);
    }
}

/// A field of ribbons without an order.
fn tangle(width: usize, height: usize, seed: u32) -> Mask {
    let mut mask = Mask::empty(width, height);
    let mut state = seed;
    let mut draw = |most: usize| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as usize % most
    };
    for _ in 0..width * height / 900 {
        let middle = [draw(width) as f64, draw(height) as f64];
        let [a, b] = turned(middle, draw(628) as f64 / 200.0, 20.0 + draw(30) as f64);
        ribbon(&mut mask, a, b, 2.0 + draw(40) as f64 / 10.0);
    }
    mask
}

#[test]
fn every_plant_pixel_has_one_leaf() {
    let mask = tangle(240, 180, 7);
    for options in [LeafOptions::default(), LeafOptions::paper()] {
        let mut seen = vec![0u8; mask.data.len()];
        for leaf in find(&mask, &options).leaves {
            let area: usize = leaf.runs.iter().map(Run::len).sum();
            assert_eq!(area, leaf.area_px);
            for run in &leaf.runs {
                seen[run.pixels(240)].iter_mut().for_each(|n| *n += 1);
            }
        }
        assert!(seen == mask.data);
    }
}

#[test]
fn leaves_do_not_depend_on_what_lies_elsewhere() {
    // The width is given: the only number that parts share.
    let options = LeafOptions { leaf_width_px: Some(4.0), ..LeafOptions::default() };
    let (part, other) = (tangle(120, 90, 3), tangle(80, 90, 4));
    let joined = Mask::from_fn(240, 200, |u, v| {
        (u >= 5 && v >= 7 && part.get(u - 5, v - 7))
            || (u >= 140 && v < 90 && other.get(u - 140, v))
    });
    let moved: Vec<(usize, f64)> = find(&joined, &options)
        .leaves
        .iter()
        .filter(|leaf| leaf.runs.iter().all(|run| run.end <= 126))
        .map(|leaf| (leaf.area_px, leaf.length_px))
        .collect();
    let alone: Vec<(usize, f64)> =
        find(&part, &options).leaves.iter().map(|leaf| (leaf.area_px, leaf.length_px)).collect();
    let sorted = |mut leaves: Vec<(usize, f64)>| {
        leaves.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
        leaves
    };
    assert_eq!(sorted(moved), sorted(alone));
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let mask = tangle(300, 200, 11);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| find(&mask, &LeafOptions::default()))
    };
    let one = run(1);
    assert!(one == run(2) && one == run(5));
    assert!(one.leaves.len() > 20);
}

#[test]
fn leaves_go_to_the_plant_they_point_at() {
    let mut mask = Mask::empty(120, 60);
    // Two plants at (30, 30) and (90, 30), two leaves each.
    for (a, b) in [([32.0, 31.0], [52.0, 45.0]), ([28.0, 29.0], [8.0, 14.0])] {
        ribbon(&mut mask, a, b, 4.0);
        ribbon(&mut mask, [a[0] + 60.0, a[1]], [b[0] + 60.0, b[1]], 4.0);
    }
    let found = find(&mask, &LeafOptions::default());
    let owners = assign(&found, &[[30.0, 30.0], [90.0, 30.0]]);
    let mut counts = [0, 0];
    for (leaf, owner) in found.leaves.iter().zip(owners) {
        let plant = owner.unwrap();
        assert_eq!(plant, usize::from(leaf.middle_px()[0] > 60.0));
        counts[plant] += 1;
    }
    assert_eq!(counts[0], counts[1]);
    assert!(assign(&found, &[]).iter().all(Option::is_none));
    assert!(assign(&found, &[[1e6, 1e6]]).iter().all(Option::is_none));
}
