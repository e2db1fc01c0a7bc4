//! A start of all images at once: averaged rotations, then positions by convex programming.

use super::{
    averaging,
    block::{Block, Pair},
};
use crate::scene::Pose;
use rowgram_optim::{
    convex::positions::{Baseline, positions},
    engine::SolveError,
    geometry::rotation,
};

/// Pairs whose rotation is farther than this from the averaged ones say nothing about positions,
/// radians.
const AGREES_RAD: f64 = 0.06;

/// Gives all images of the largest connected part a pose; returns how many.
///
/// # Errors
/// Where the positions cannot be found.
pub fn start(block: &mut Block<'_>, pairs: &[Pair]) -> Result<usize, SolveError> {
    let rotations = averaging::rotations(block.poses.len(), pairs);
    let members: Vec<usize> = (0..rotations.len()).filter(|&k| rotations[k].is_some()).collect();
    let mut place = vec![usize::MAX; rotations.len()];
    members.iter().enumerate().for_each(|(k, &image)| place[image] = k);
    let mut baselines = Vec::new();
    for pair in pairs {
        let [i, j] = pair.images.map(|k| k as usize);
        let (Some(first), Some(second)) = (rotations[i], rotations[j]) else { continue };
        let relative = super::resection::quaternion(&pair.pose.rotation);
        let predicted = rotation::multiply(relative, first);
        let left = rotation::log(rotation::multiply(second, rotation::inverse(predicted)));
        let angle = left.iter().map(|v| v * v).sum::<f64>().sqrt();
        if angle > AGREES_RAD {
            continue;
        }
        let back = rotation::rotate(rotation::inverse(second), pair.pose.translation.into());
        baselines.push(Baseline {
            ends: [place[i], place[j]],
            direction: back.map(|v| -v),
            weight: (pair.matches.len() as f64).sqrt() * pair.angle_rad.min(0.2),
        });
    }
    baselines.retain(|baseline| baseline.weight > 0.0);
    // Only what baselines still hold together has a place.
    let mut reached = vec![false; members.len()];
    if let Some(first) = reached.first_mut() {
        *first = true;
    }
    loop {
        let before = reached.iter().filter(|&&r| r).count();
        for baseline in &baselines {
            let [i, j] = baseline.ends;
            if reached[i] || reached[j] {
                (reached[i], reached[j]) = (true, true);
            }
        }
        if reached.iter().filter(|&&r| r).count() == before {
            break;
        }
    }
    let mut dense = vec![usize::MAX; members.len()];
    let kept: Vec<usize> = (0..members.len()).filter(|&k| reached[k]).collect();
    kept.iter().enumerate().for_each(|(new, &old)| dense[old] = new);
    baselines.retain(|b| b.ends.iter().all(|&k| reached[k]));
    for baseline in &mut baselines {
        baseline.ends = baseline.ends.map(|k| dense[k]);
    }
    let centres = positions(kept.len(), &baselines)?;
    for (&k, centre) in kept.iter().zip(centres) {
        let image = members[k];
        if let Some(q) = rotations[image] {
            block.poses[image] = Some(Pose::from_centre(q, centre));
        }
    }
    Ok(kept.len())
}
