//! All rotations at once: the camera rotations that agree best with those of the pairs.
//!
//! ```text
//! min sum_e w_e rho( |log(R_ij^T R_j R_i^T)| )
//! ```
//!
//! from a spanning tree of the pairs with the most matches, by iteratively reweighted steps in the
//! tangent spaces, each a linear system with the Laplacian of the graph. Reference: A. Chatterjee and
//! V. Govindu, *Robust relative rotation averaging*, PAMI 40(4), 2018.

use super::{block::Pair, resection::quaternion};
use nalgebra::{DMatrix, DVector};
use rowgram_base::disjoint_sets::DisjointSets;
use rowgram_optim::geometry::rotation::{self, Quaternion};

/// Angle at which a pair counts half, radians.
const HALF_RAD: f64 = 0.03;
const ROUNDS: usize = 40;

/// Rotations `camera_from_world` of the images in the largest connected part of the pairs; `None` for
/// the others.
pub fn rotations(images: usize, pairs: &[Pair]) -> Vec<Option<Quaternion>> {
    let relative: Vec<Quaternion> =
        pairs.iter().map(|pair| quaternion(&pair.pose.rotation)).collect();
    let mut found = spanning_tree(images, pairs, &relative);
    let members: Vec<usize> = (0..images).filter(|&k| found[k].is_some()).collect();
    if members.len() < 2 {
        return found;
    }
    // The first member stands still.
    let mut place = vec![usize::MAX; images];
    members.iter().enumerate().for_each(|(k, &image)| place[image] = k);
    let unknowns = members.len() - 1;
    for round in 0..ROUNDS {
        let mut laplacian = DMatrix::<f64>::zeros(unknowns, unknowns);
        let mut right = [(); 3].map(|()| DVector::<f64>::zeros(unknowns));
        for (pair, relative) in pairs.iter().zip(&relative) {
            let [i, j] = pair.images.map(|k| k as usize);
            let (Some(first), Some(second)) = (found[i], found[j]) else { continue };
            // In the world: R_j^T R_ij R_i takes what is left to the identity.
            let predicted = rotation::multiply(*relative, first);
            let left = rotation::log(rotation::multiply(rotation::inverse(second), predicted));
            let squared: f64 = left.iter().map(|v| v * v).sum();
            let share = 1.0 / (1.0 + squared / (HALF_RAD * HALF_RAD));
            // The first rounds are gentle: a bad start must not make good pairs look bad.
            let robust = if round < 5 { share.sqrt() } else { share * share };
            let weight = (pair.matches.len() as f64).sqrt() * robust;
            let (i, j) = (place[i], place[j]);
            for (at, sign) in [(i, -1.0), (j, 1.0)] {
                if at > 0 {
                    laplacian[(at - 1, at - 1)] += weight;
                    (0..3).for_each(|k| right[k][at - 1] += sign * weight * left[k]);
                }
            }
            if i > 0 && j > 0 {
                laplacian[(i - 1, j - 1)] -= weight;
                laplacian[(j - 1, i - 1)] -= weight;
            }
        }
        let Some(factor) = laplacian.cholesky() else { return found };
        let steps = right.map(|right| factor.solve(&right));
        let mut largest: f64 = 0.0;
        for (k, &image) in members.iter().enumerate().skip(1) {
            let step = [0, 1, 2].map(|axis: usize| steps[axis][k - 1]);
            largest = largest.max(step.iter().map(|v| v.abs()).fold(0.0, f64::max));
            if let Some(q) = &mut found[image] {
                *q = rotation::normalize(rotation::multiply(*q, rotation::exp(step)));
            }
        }
        if round >= 8 && largest < 1e-9 {
            break;
        }
    }
    found
}

/// The rotations along the tree of the strongest pairs of the largest connected part.
fn spanning_tree(
    images: usize,
    pairs: &[Pair],
    relative: &[Quaternion],
) -> Vec<Option<Quaternion>> {
    let mut order: Vec<usize> = (0..pairs.len()).collect();
    order.sort_by_key(|&k| (std::cmp::Reverse(pairs[k].matches.len()), pairs[k].images));
    let mut parts = DisjointSets::new(images);
    let mut tree: Vec<Vec<(usize, Quaternion)>> = vec![Vec::new(); images];
    for k in order {
        let [a, b] = pairs[k].images.map(|image| image as usize);
        let (ra, rb) = (parts.root(a), parts.root(b));
        if ra != rb {
            parts.link(ra, rb);
            tree[a].push((b, relative[k]));
            tree[b].push((a, rotation::inverse(relative[k])));
        }
    }
    let mut sizes = vec![0usize; images];
    (0..images).for_each(|k| sizes[parts.root(k)] += 1);
    let mut found = vec![None; images];
    let largest = (0..images).max_by_key(|&k| (sizes[k], std::cmp::Reverse(k)));
    let Some(start) = largest.filter(|&k| sizes[k] >= 2) else { return found };
    let mut queue = vec![start];
    found[start] = Some(rotation::IDENTITY);
    while let Some(image) = queue.pop() {
        let Some(own) = found[image] else { continue };
        for (other, relative) in &tree[image] {
            if found[*other].is_none() {
                found[*other] = Some(rotation::normalize(rotation::multiply(*relative, own)));
                queue.push(*other);
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sfm::relative::{RelativePose, Solver};
    use nalgebra::{Matrix3, Vector3};

    #[test]
    fn wrong_pairs_do_not_turn_the_others() {
        let truth: Vec<Quaternion> = (0..10)
            .map(|k| rotation::exp([0.1 * f64::from(k), -0.05, 0.7 * f64::from(k)]))
            .collect();
        let mut pairs = Vec::new();
        for i in 0..10u32 {
            for j in i + 1..(i + 4).min(10) {
                let wrong = (i, j) == (2, 4) || (i, j) == (6, 7);
                let mut turn =
                    rotation::multiply(truth[j as usize], rotation::inverse(truth[i as usize]));
                if wrong {
                    turn = rotation::multiply(rotation::exp([0.4, 0.3, -0.5]), turn);
                }
                let m = rotation::matrix(turn);
                pairs.push(Pair {
                    images: [i, j],
                    matches: vec![[0, 0]; if wrong { 30 } else { 100 }],
                    pose: RelativePose {
                        rotation: Matrix3::from_fn(|r, c| m[r][c]),
                        translation: Vector3::x(),
                    },
                    solver: Solver::FivePoint,
                    angle_rad: 0.1,
                });
            }
        }
        let found = rotations(11, &pairs);
        assert!(found[10].is_none());
        let first = rotation::multiply(rotation::inverse(truth[0]), found[0].unwrap());
        for k in 0..10 {
            let expected = rotation::multiply(truth[k], first);
            let left =
                rotation::log(rotation::multiply(found[k].unwrap(), rotation::inverse(expected)));
            assert!(left.iter().all(|v| v.abs() < 2e-3), "{k}: {left:?}");
        }
    }
}
