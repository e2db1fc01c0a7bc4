//! Where plants stand, from the probability of one at each place.

use super::RowPosterior;
use std::collections::BinaryHeap;

/// Probability around a place below which no plant is looked for there: a first choice, not compared with others.
const MIN_TOGETHER: f64 = 0.05;
/// The normal weight ends so many standard deviations from its middle, where it is 0.01.
const REACH: f64 = 3.0;

/// The `count` places, row by row and along it, at which most of the probability of a plant is together; fewer where there are not so many.
///
/// About a place `x` the probabilities `m` of all places count by a normal weight with standard deviation `radius` (places),
///
/// `h(x) = sum_y m(y) k(x, y)`, `k(x, y) = exp( -(x - y)^2 / (2 radius^2) )`.
///
/// The place with the greatest is a plant, which takes `m(y) k(x, y) / max(1, h(x))` of the probability around it, one at most; and so on with what is left.
pub fn likeliest_places(posteriors: &[RowPosterior], radius: f64, count: usize) -> Vec<Vec<usize>> {
    let kernel: Vec<f64> = (0..=(REACH * radius).ceil() as usize)
        .map(|k| (-0.5 * (k as f64 / radius).powi(2)).exp())
        .collect();
    let mut found: Vec<(f64, usize, usize)> = posteriors
        .iter()
        .enumerate()
        .flat_map(|(row, of)| {
            places_of_row(&of.marginals, &kernel).into_iter().map(move |(h, at)| (h, row, at))
        })
        .collect();
    found.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    found.truncate(count);
    let mut places = vec![vec![]; posteriors.len()];
    for (_, row, at) in found {
        places[row].push(at);
    }
    places.iter_mut().for_each(|row| row.sort_unstable());
    places
}

/// The places of a row with what is together about each, the greatest first.
fn places_of_row(marginals: &[f64], kernel: &[f64]) -> Vec<(f64, usize)> {
    let mut left = marginals.to_vec();
    let (count, reach) = (left.len(), kernel.len() - 1);
    let around = |at: usize, reach: usize| at.saturating_sub(reach)..(at + reach + 1).min(count);
    let together = |left: &[f64], at: usize| -> f64 {
        around(at, reach).map(|k| left[k] * kernel[k.abs_diff(at)]).sum()
    };
    // Numbers that are not negative are in the order of their bits. Of several the first place.
    let key = |h: f64, at: usize| (h.to_bits(), std::cmp::Reverse(at));
    let mut heights: Vec<f64> = (0..count).map(|at| together(&left, at)).collect();
    let mut open: BinaryHeap<_> = heights.iter().enumerate().map(|(at, &h)| key(h, at)).collect();
    let mut found = Vec::new();
    let mut is_taken = vec![false; count];
    while let Some((bits, std::cmp::Reverse(at))) = open.pop() {
        let height = f64::from_bits(bits);
        if height < MIN_TOGETHER {
            break;
        }
        if heights[at].to_bits() != bits || is_taken[at] {
            continue;
        }
        found.push((height, at));
        is_taken[at] = true;
        for k in around(at, reach) {
            left[k] -= left[k] * kernel[k.abs_diff(at)] / height.max(1.0);
        }
        for k in around(at, 2 * reach) {
            let less = together(&left, k);
            if less != heights[k] {
                heights[k] = less;
                open.push(key(less, k));
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(probabilities: &[(usize, f64)]) -> RowPosterior {
        let mut marginals = vec![0.0; 200];
        probabilities.iter().for_each(|&(at, p)| marginals[at] = p);
        RowPosterior { marginals, count: 0.0, count_variance: 0.0 }
    }

    #[test]
    fn a_plant_stands_where_its_probability_is_together() {
        // One plant spread over four places, one that is sure, two in one place, one that is half there.
        let rows = [
            row(&[(20, 0.2), (22, 0.3), (24, 0.3), (26, 0.2), (60, 1.0)]),
            row(&[(40, 1.0), (46, 0.9), (120, 0.5)]),
        ];
        let places = likeliest_places(&rows, 5.0, 5);
        assert_eq!(places[0], [23, 60]);
        let [first, second, third] = places[1][..] else { panic!("{places:?}") };
        assert!(
            (38..45).contains(&first) && (42..56).contains(&second) && third == 120,
            "{places:?}"
        );
        // Of fewer the likeliest.
        let places = likeliest_places(&rows, 5.0, 2);
        assert_eq!(places.iter().map(Vec::len).sum::<usize>(), 2);
        assert!(!places[1].contains(&120));
    }
}
