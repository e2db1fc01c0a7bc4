//! An image at the edge of a block that hardly shows what two others see, but much of what one does: its pair tells
//! rotation and direction, and the few points that it shares with the block how far away it is.

use super::{block::Block, incremental::IncrementalOptions, resection::quaternion, start::Graph};
use crate::scene::Pose;
use rowgram_optim::geometry::{cross, dot, rotation};

/// The fewest points that tell a distance.
pub(super) const FEWEST: usize = 3;

/// The pose of an image by its pair with most matches among those with images of the block. `None` where that has not
/// four times as many matches as an image needs points, where another pair has twice as many (the image
/// belongs to another block), or where points do not say how far away it is.
pub(super) fn pose(
    block: &Block<'_>,
    graph: &Graph<'_>,
    options: &IncrementalOptions,
    image: usize,
) -> Option<Pose> {
    let own = image as u32;
    let (count, neighbour) = graph
        .neighbours(own)
        .iter()
        .filter(|&&other| block.poses[other as usize].is_some())
        .filter_map(|&other| {
            let pair = graph.pair(own, other)?;
            let wide = pair.angle_rad >= options.min_angle_rad;
            wide.then_some((pair.matches.len(), std::cmp::Reverse(other)))
        })
        .max()?;
    let pairs = graph.neighbours(own).iter().filter_map(|&other| graph.pair(own, other));
    let most = pairs.map(|pair| pair.matches.len()).max().unwrap_or(0);
    if count < 4 * options.min_points || 2 * count < most {
        return None;
    }
    let (turn, shift) = graph.relative(neighbour.0, own)?;
    let from = block.poses[neighbour.0 as usize]?;
    let turn = quaternion(&turn);
    let beside = Pose {
        rotation: rotation::normalize(rotation::multiply(turn, from.rotation)),
        translation: rotation::rotate(turn, from.translation),
    };
    let shift: [f64; 3] = shift.into();
    // Where p + s shift has the direction of the ray.
    let mut distances: Vec<f64> = block
        .sights(image)
        .iter()
        .filter_map(|sight| {
            let (off, along) =
                (cross(sight.ray, beside.to_camera(sight.point)), cross(sight.ray, shift));
            let distance = -dot(off, along) / dot(along, along);
            (distance.is_finite() && distance > 0.0).then_some(distance)
        })
        .collect();
    if distances.len() < FEWEST {
        return None;
    }
    let middle = distances.len() / 2;
    let distance = *distances.select_nth_unstable_by(middle, f64::total_cmp).1;
    let translation = [0, 1, 2].map(|k| beside.translation[k] + distance * shift[k]);
    Some(Pose { translation, ..beside })
}
