//! What a flight was like, from its block: height above the ground, and how much neighbouring photos share.
//!
//! The ground is taken as the horizontal plane at the median height of the tie points. A grid of pixels of each photo is projected to it
//! and into the nearest photos in plan: `overlap = max over neighbours (shared pixels / pixels of the grid)`. All coordinates are
//! in the frame of the block; heights and distances are metres where that has a scale.

use crate::{
    camera::Lens,
    scene::{Image, Reconstruction},
};
use rowgram_optim::geometry::rotation;
use rowgram_optim::robust::median;
use serde::{Deserialize, Serialize};

/// Pixels of a photo that are followed, along each side.
const GRID: usize = 9;
/// Photos that a photo is compared with: two to each side along the strip and across, and those between.
const NEIGHBOURS: usize = 24;

/// What a flight was like. Medians over its photos.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct FlightSummary {
    /// When the first photo was taken, as the photos say, after ISO 8601.
    pub first_photo_time: Option<String>,
    /// When the last photo was taken.
    pub last_photo_time: Option<String>,
    /// Height of the projection centre above the ground, metres where the block has a scale.
    pub height_above_ground_m: Option<f64>,
    /// Share of a photo that the photo beside it shows too.
    pub overlap: Option<f64>,
    /// How many photos show a place.
    pub photos_per_place: Option<f64>,
}

impl FlightSummary {
    /// Of a block, and the times of its photos after ISO 8601.
    pub fn of(block: &Reconstruction, times: &[String]) -> FlightSummary {
        let heights = block.points.iter().map(|point| point.position_m[2]);
        let mut found = FlightSummary {
            first_photo_time: times.iter().min().cloned(),
            last_photo_time: times.iter().max().cloned(),
            ..FlightSummary::default()
        };
        let Some(ground) = finite_median(heights) else { return found };
        let above = |image: &Image| image.pose.centre_m()[2] - ground;
        found.height_above_ground_m = finite_median(block.images.iter().map(above));
        let shares: Vec<[f64; 2]> =
            (0..block.images.len()).filter_map(|image| shared(block, image, ground)).collect();
        let column = |k: usize| shares.iter().map(move |share| share[k]);
        found.overlap = finite_median(column(0));
        found.photos_per_place = finite_median(column(1));
        found
    }
}

/// Share of a photo that the neighbour shows which shares most, and how many photos show a place of it on average. `None` where
/// no pixel of it looks at the ground.
fn shared(block: &Reconstruction, image: usize, ground: f64) -> Option<[f64; 2]> {
    let places = on_ground(block, image, ground);
    if places.is_empty() {
        return None;
    }
    let here = block.images[image].pose.centre_m();
    let mut others: Vec<(f64, usize)> = (0..block.images.len())
        .filter(|&other| other != image)
        .map(|other| {
            let [x, y, _] = block.images[other].pose.centre_m();
            ((x - here[0]).hypot(y - here[1]), other)
        })
        .collect();
    let nearest = NEIGHBOURS.min(others.len());
    if nearest > 0 && nearest < others.len() {
        others.select_nth_unstable_by(nearest - 1, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    }
    let counts = others[..nearest].iter().map(|&(_, other)| {
        places.iter().filter(|place| shows(block, other, **place)).count() as f64
    });
    let counts: Vec<f64> = counts.collect();
    let all = places.len() as f64;
    let most = counts.iter().copied().fold(0.0, f64::max);
    Some([most / all, 1.0 + counts.iter().sum::<f64>() / all])
}

/// Where a grid of pixels of a photo meets the ground.
fn on_ground(block: &Reconstruction, image: usize, ground: f64) -> Vec<[f64; 3]> {
    let of = &block.images[image];
    let lens = &block.cameras[of.camera].interior;
    let [width, height] = lens.size_px().map(f64::from);
    let step = |k: usize, length: f64| (k as f64 + 0.5) / GRID as f64 * length - 0.5;
    let pixels = (0..GRID * GRID).map(|k| [step(k % GRID, width), step(k / GRID, height)]);
    let meets = |pixel: [f64; 2]| {
        let pose = block.pose_at(image, pixel[1]);
        let ray = rotation::rotate(rotation::inverse(pose.rotation), lens.unproject(pixel)?);
        let centre = pose.centre_m();
        let along = (ground - centre[2]) / ray[2];
        (along.is_finite() && along > 0.0)
            .then(|| std::array::from_fn(|axis| centre[axis] + along * ray[axis]))
    };
    pixels.filter_map(meets).collect()
}

fn shows(block: &Reconstruction, image: usize, place: [f64; 3]) -> bool {
    let of = &block.images[image];
    let lens = &block.cameras[of.camera].interior;
    let size = lens.size_px().map(f64::from);
    lens.project(of.pose.to_camera(place))
        .is_some_and(|at| (0..2).all(|axis| at[axis] >= -0.5 && at[axis] < size[axis] - 0.5))
}

/// The median; `None` of nothing, and where it is no number.
fn finite_median(values: impl IntoIterator<Item = f64>) -> Option<f64> {
    median(values).filter(|value| value.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::{Camera, Interior, Model},
        scene::{Pose, TiePoint},
    };
    use approx::assert_abs_diff_eq;

    /// Photos looking straight down from 50 m over flat ground at 10 m; each shows 100 m by 75 m.
    fn block(centres: &[[f64; 2]]) -> Reconstruction {
        let mut values = vec![0.0; Model::Brown.parameters().len()];
        values[..4].copy_from_slice(&[2000.0, 1.0, 1999.5, 1499.5]);
        let interior = Interior::new(Model::Brown, [4000, 3000], &values);
        let image = |(k, [x, y]): (usize, &[f64; 2])| Image {
            name: format!("{k}.jpg"),
            id: k as u32,
            camera: 0,
            pose: Pose::from_centre([1.0, 0.0, 0.0, 0.0], [*x, *y, 60.0]),
            motion: [0.0; 6],
            expected_motion: [0.0; 6],
        };
        let point =
            |k: usize| TiePoint { id: k as u64, position_m: [k as f64, 0.0, 10.0], colour: [0; 3] };
        Reconstruction {
            cameras: vec![Camera::new("camera", interior.unwrap())],
            images: centres.iter().enumerate().map(image).collect(),
            points: (0..5).map(point).collect(),
            ..Reconstruction::default()
        }
    }

    #[test]
    fn height_and_overlap_are_those_of_the_plan() {
        // Along the strip 25 m of 100 m apart, strips 1 km apart: neighbours share three quarters.
        let centres: Vec<[f64; 2]> =
            (0..12).map(|k| [25.0 * f64::from(k % 6), 1000.0 * f64::from(k / 6)]).collect();
        let times = ["2026-06-01T12:01:00", "2026-06-01T12:00:00"].map(str::to_owned);
        let found = FlightSummary::of(&block(&centres), &times);
        assert_eq!(found.first_photo_time.as_deref(), Some("2026-06-01T12:00:00"));
        assert_eq!(found.last_photo_time.as_deref(), Some("2026-06-01T12:01:00"));
        assert_abs_diff_eq!(found.height_above_ground_m.unwrap(), 50.0, epsilon = 1e-9);
        assert_abs_diff_eq!(found.overlap.unwrap(), 0.75, epsilon = 0.06);
        // The photo itself, two at 75 %, at least one at 50 % and one at 25 %.
        let places = found.photos_per_place.unwrap();
        assert!((3.2..=4.2).contains(&places), "{places}");
    }

    #[test]
    fn a_single_photo_overlaps_with_nothing() {
        let found = FlightSummary::of(&block(&[[0.0, 0.0]]), &[]);
        assert_eq!((found.overlap, found.photos_per_place), (Some(0.0), Some(1.0)));
        assert_eq!(FlightSummary::of(&Reconstruction::default(), &[]), FlightSummary::default());
    }
}
