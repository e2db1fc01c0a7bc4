//! The matching against trying everything, a dense solver, and the clock.

use super::*;
use proptest::prelude::*;

/// Most pairs, then least distance, by trying everything.
fn by_force(found: &[[f64; 2]], truth: &[[f64; 2]], radius: f64) -> (usize, f64) {
    let Some((first, rest)) = found.split_first() else { return (0, 0.0) };
    let mut best = by_force(rest, truth, radius);
    for (i, &other) in truth.iter().enumerate() {
        if distance(*first, other) <= radius {
            let mut left = truth.to_vec();
            left.remove(i);
            let (pairs, sum) = by_force(rest, &left, radius);
            let candidate = (pairs + 1, sum + distance(*first, other));
            if candidate.0 > best.0 || candidate.0 == best.0 && candidate.1 < best.1 {
                best = candidate;
            }
        }
    }
    best
}

fn check(
    pairs: &[MatchedPlants],
    found: &[[f64; 2]],
    truth: &[[f64; 2]],
    radius: f64,
) -> (usize, f64) {
    let (mut used_found, mut used_truth) = (vec![false; found.len()], vec![false; truth.len()]);
    for pair in pairs {
        assert!(!std::mem::replace(&mut used_found[pair.found], true), "one to one");
        assert!(!std::mem::replace(&mut used_truth[pair.truth], true), "one to one");
        assert_eq!(pair.distance_px, distance(found[pair.found], truth[pair.truth]));
        assert!(pair.distance_px <= radius);
    }
    (pairs.len(), pairs.iter().map(|pair| pair.distance_px).sum())
}

#[test]
fn more_pairs_come_before_shorter_ones() {
    // The nearest pair (1, 2) would leave two points alone.
    let (found, truth) = ([[1.0, 0.0], [5.0, 0.0]], [[2.0, 0.0], [-2.0, 0.0]]);
    let pairs = within(&found, &truth, 3.5);
    assert_eq!(check(&pairs, &found, &truth, 3.5), (2, 6.0));
    assert_eq!(within(&found, &truth, 1.0).len(), 1, "the radius is inclusive");
    assert_eq!(within(&found, &truth, 0.99), []);
    assert_eq!(within(&[], &truth, 9.0), []);
    assert_eq!(within(&[[f64::NAN, 0.0]], &truth, 9.0), []);
    assert_eq!(within(&truth, &[[f64::NAN, f64::INFINITY]], 9.0), []);
}

fn small_sets() -> impl Strategy<Value = (Vec<[f64; 2]>, Vec<[f64; 2]>, f64)> {
    let lattice = proptest::array::uniform2((0..12).prop_map(f64::from));
    let anywhere = proptest::array::uniform2(0.0..12.0f64);
    let point = prop_oneof![lattice, anywhere].boxed();
    let set = proptest::collection::vec(point, 0..7);
    (set.clone(), set, prop_oneof![0.5..8.0f64, (1..20).prop_map(f64::from)])
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]
    #[test]
    fn equal_to_trying_everything((found, truth, radius) in small_sets()) {
        let (pairs, sum) = check(&within(&found, &truth, radius), &found, &truth, radius);
        let (best_pairs, best_sum) = by_force(&found, &truth, radius);
        prop_assert_eq!(pairs, best_pairs);
        prop_assert!((sum - best_sum).abs() <= 1e-9, "{} is not {}", sum, best_sum);
    }
}

/// A dense Hungarian method, with a price for being alone that no distance reaches.
fn dense(found: &[[f64; 2]], truth: &[[f64; 2]], radius: f64) -> (usize, f64) {
    let (n, m) = (found.len(), truth.len() + found.len());
    let price = 1e4 * radius;
    let cost = |i: usize, j: usize| match truth.get(j) {
        Some(&point) if distance(found[i], point) <= radius => distance(found[i], point),
        Some(_) => f64::INFINITY,
        None if j - truth.len() == i => price,
        None => f64::INFINITY,
    };
    let (mut u, mut v) = (vec![0.0; n], vec![0.0; m]);
    let mut row_of = vec![usize::MAX; m];
    for start in 0..n {
        let (mut least, mut before) = (vec![f64::INFINITY; m], vec![usize::MAX; m]);
        let (mut done, mut row, mut column) = (vec![false; m], start, usize::MAX);
        let mut tree: Vec<(usize, f64)> = vec![(start, 0.0)];
        let mut length = 0.0;
        loop {
            for j in (0..m).filter(|&j| !done[j]) {
                let to = length + cost(row, j) - u[row] - v[j];
                if to < least[j] {
                    (least[j], before[j]) = (to, column);
                }
            }
            column = (0..m)
                .filter(|&j| !done[j])
                .min_by(|&a, &b| least[a].total_cmp(&least[b]))
                .unwrap();
            (done[column], length) = (true, least[column]);
            row = row_of[column];
            if row == usize::MAX {
                break;
            }
            tree.push((row, length));
        }
        for j in (0..m).filter(|&j| done[j]) {
            v[j] += least[j] - length;
        }
        for &(i, to) in &tree {
            u[i] += length - to;
        }
        while before[column] != usize::MAX {
            row_of[column] = row_of[before[column]];
            column = before[column];
        }
        row_of[column] = start;
    }
    let pairs: Vec<f64> =
        (0..truth.len()).filter(|&j| row_of[j] != usize::MAX).map(|j| cost(row_of[j], j)).collect();
    (pairs.len(), pairs.iter().sum())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]
    #[test]
    fn equal_to_a_dense_hungarian(
        found in proptest::collection::vec(proptest::array::uniform2(0.0..100.0f64), 0..70),
        truth in proptest::collection::vec(proptest::array::uniform2(0.0..100.0f64), 0..70),
        radius in 1.0..60.0f64,
    ) {
        let (pairs, sum) = check(&within(&found, &truth, radius), &found, &truth, radius);
        let (best_pairs, best_sum) = dense(&found, &truth, radius);
        prop_assert_eq!(pairs, best_pairs);
        prop_assert!((sum - best_sum).abs() <= 1e-6, "{} is not {}", sum, best_sum);
    }
}

/// A field of rows, and the same with errors, losses and false plants.
fn field(rows: usize, plants: usize, noise: f64) -> (Vec<[f64; 2]>, Vec<[f64; 2]>) {
    let mut state = 1_u64;
    let mut random = || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 11) as f64 / (1_u64 << 53) as f64
    };
    let (mut truth, mut found) = (Vec::new(), Vec::new());
    for row in 0..rows {
        for plant in 0..plants {
            let (u, v) = (13.0 * plant as f64 + random(), 50.0 * row as f64 + random());
            truth.push([u, v]);
            if random() > 0.1 {
                found.push([u + noise * (random() - 0.5), v + noise * (random() - 0.5)]);
            }
            if random() > 0.93 {
                found.push([u + 30.0 * random(), v + 50.0 * random()]);
            }
        }
    }
    (found, truth)
}

#[test]
fn a_whole_field_is_matched_fast() {
    let (found, truth) = field(100, 500, 20.0);
    for radius in [3.0, 8.0, 20.0, 60.0, 200.0, 1e6] {
        let start = std::time::Instant::now();
        let pairs = within(&found, &truth, radius);
        let (count, sum) = check(&pairs, &found, &truth, radius);
        let seconds = start.elapsed().as_secs_f64();
        println!("radius {radius}: {count} pairs, sum {sum:.1}, {seconds:.2} s");
        // Generous, for a busy machine and a build without full optimisation.
        assert!(seconds < 60.0, "radius {radius}: {seconds} s");
    }
}

#[test]
fn many_equal_points_are_matched() {
    let (found, truth) = (vec![[3.0, 3.0]; 700], vec![[3.0, 4.0]; 500]);
    let pairs = within(&found, &truth, 1.0);
    assert_eq!(check(&pairs, &found, &truth, 1.0), (500, 500.0));
}
