//! Validation before an adjustment: what is contradictory is refused, what cannot take part is
//! excluded by name, and nothing is lost.

use super::consistency::check;
use crate::scene::{
    Axes, CameraOrientation, CameraPosition, Excluded, ExcludedKind, GroundObservation,
    Observation, Reconstruction, Role, ScaleBar,
};
use rowgram_optim::geometry::{cross, dot};
use std::collections::HashSet;

/// What is wrong with a reconstruction as a whole.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{0}")]
pub struct InvalidReconstruction(pub String);

/// The part of a reconstruction that can be adjusted, and where it comes from.
#[derive(Debug, Clone)]
pub struct Validated {
    /// That part.
    pub reconstruction: Reconstruction,
    /// What takes no part.
    pub excluded: Vec<Excluded>,
    /// For each of its images its index in the whole.
    pub images: Vec<usize>,
    /// For each of its tie points its index in the whole.
    pub points: Vec<usize>,
    /// For each of its ground points its index in the whole.
    pub ground: Vec<usize>,
    /// For each of its tie observations its index in the whole.
    pub observations: Vec<usize>,
    /// For each of its marks its index in the whole.
    pub marks: Vec<usize>,
    /// For each of its camera positions its index in the whole.
    pub positions: Vec<usize>,
    /// For each of its scale bars its index in the whole.
    pub scale_bars: Vec<usize>,
}

/// Equations that an image needs: three points.
const MIN_OBSERVATIONS: usize = 3;

/// Validates a reconstruction.
///
/// # Errors
/// Numbers that are not finite, indices that are not there, standard deviations that are not
/// positive, names and marks that are there twice, nothing left to adjust.
pub fn validate(whole: &Reconstruction) -> Result<Validated, InvalidReconstruction> {
    check(whole)?;
    let mut excluded = Vec::new();
    let mut tie = vec![true; whole.observations.len()];
    let mut mark = vec![true; whole.marks.len()];
    keep_feasible(whole, &mut tie, &mut mark, &mut excluded);
    let mut image = vec![true; whole.images.len()];
    let mut point = vec![true; whole.points.len()];
    let mut ground = vec![true; whole.ground.len()];
    // Taking one thing away may leave too little for another.
    loop {
        let before = excluded.len();
        drop_points(whole, &tie, &mut point, &mut excluded);
        tie.iter_mut().zip(&whole.observations).for_each(|(keep, o)| {
            *keep &= point[o.point as usize] && image[o.image as usize];
        });
        drop_ground(whole, &mark, &mut ground, &mut excluded);
        mark.iter_mut().zip(&whole.marks).for_each(|(keep, m)| {
            *keep &= ground[m.ground as usize] && image[m.image as usize];
        });
        drop_images(whole, (&tie, &mark), &mut image, &mut excluded);
        if excluded.len() == before {
            break;
        }
    }
    if !image.contains(&true) {
        let reasons: Vec<String> = excluded.iter().take(3).map(ToString::to_string).collect();
        return Err(InvalidReconstruction(format!(
            "no image is left to adjust; the first reasons: {}",
            reasons.join("; ")
        )));
    }
    Ok(compact(whole, [&image, &point, &ground], (&tie, &mark), excluded))
}

/// Excludes measurements that their camera cannot make at the starting values, and second ones
/// of a point in one image.
fn keep_feasible(
    reconstruction: &Reconstruction,
    tie: &mut [bool],
    mark: &mut [bool],
    excluded: &mut Vec<Excluded>,
) {
    let why = |image: usize, image_px: [f64; 2], point_m: [f64; 3]| -> Option<String> {
        if reconstruction.is_feasible(image, image_px, point_m) {
            None
        } else if reconstruction.pose_at(image, image_px[1]).to_camera(point_m)[2] >= 0.0 {
            Some("the point is behind the camera".into())
        } else {
            Some("the point is outside the range in which the lens model is one to one".into())
        }
    };
    let mut seen = HashSet::new();
    for (keep, o) in tie.iter_mut().zip(&reconstruction.observations) {
        let point = &reconstruction.points[o.point as usize];
        let reason = if seen.insert((o.image, o.point)) {
            why(o.image as usize, o.image_px, point.position_m)
        } else {
            Some("the point is measured twice in this image".into())
        };
        if let Some(reason) = reason {
            *keep = false;
            excluded.push(Excluded {
                kind: ExcludedKind::Observation,
                image: Some(reconstruction.images[o.image as usize].name.clone()),
                point: Some(point.id.to_string()),
                reason,
            });
        }
    }
    for (keep, m) in mark.iter_mut().zip(&reconstruction.marks) {
        let ground = &reconstruction.ground[m.ground as usize];
        if let Some(reason) = why(m.image as usize, m.image_px, ground.position_m) {
            *keep = false;
            excluded.push(Excluded {
                kind: ExcludedKind::Mark,
                image: Some(reconstruction.images[m.image as usize].name.clone()),
                point: Some(ground.name.clone()),
                reason,
            });
        }
    }
}

/// Rays of a point that are within this of each other everywhere do not say how far away it is, radians:
/// those of a photo and of its double, for one.
const MIN_ANGLE_RAD: f64 = 1e-4;

fn drop_points(
    reconstruction: &Reconstruction,
    tie: &[bool],
    point: &mut [bool],
    excluded: &mut Vec<Excluded>,
) {
    let centres: Vec<[f64; 3]> =
        reconstruction.images.iter().map(|image| image.pose.centre_m()).collect();
    let mut rays = vec![0usize; reconstruction.points.len()];
    let mut first = vec![[0.0; 3]; reconstruction.points.len()];
    let mut widest = vec![0.0f64; reconstruction.points.len()];
    for (_, o) in tie.iter().zip(&reconstruction.observations).filter(|(keep, _)| **keep) {
        let (k, centre) = (o.point as usize, centres[o.image as usize]);
        let at = reconstruction.points[k].position_m;
        let ray: [f64; 3] = std::array::from_fn(|axis| at[axis] - centre[axis]);
        let length = dot(ray, ray).sqrt();
        let ray = ray.map(|v| v / length);
        if rays[k] == 0 {
            first[k] = ray;
        }
        let across = cross(ray, first[k]);
        widest[k] = widest[k].max(dot(across, across).sqrt());
        rays[k] += 1;
    }
    for (k, keep) in point.iter_mut().enumerate() {
        if !*keep {
            continue;
        }
        let reason = if rays[k] < 2 {
            format!("{} image(s) see it, two are needed", rays[k])
        } else if widest[k] < MIN_ANGLE_RAD {
            "the images that see it see it along one line".into()
        } else {
            continue;
        };
        *keep = false;
        excluded.push(Excluded {
            kind: ExcludedKind::TiePoint,
            image: None,
            point: Some(reconstruction.points[k].id.to_string()),
            reason,
        });
    }
}

fn drop_ground(
    reconstruction: &Reconstruction,
    mark: &[bool],
    ground: &mut [bool],
    excluded: &mut Vec<Excluded>,
) {
    let mut rays = vec![0usize; reconstruction.ground.len()];
    for (_, m) in mark.iter().zip(&reconstruction.marks).filter(|(keep, _)| **keep) {
        rays[m.ground as usize] += 1;
    }
    for (k, keep) in ground.iter_mut().enumerate() {
        let point = &reconstruction.ground[k];
        let needed = match (point.role, point.axes) {
            (Role::Control, Axes::Xyz | Axes::Xy | Axes::Z) => 1,
            (Role::Check | Role::Tie, _) => 2,
        };
        if *keep && rays[k] < needed {
            *keep = false;
            excluded.push(Excluded {
                kind: ExcludedKind::GroundPoint,
                image: None,
                point: Some(point.name.clone()),
                reason: format!("it is marked in {} image(s), {needed} needed", rays[k]),
            });
        }
    }
}

fn drop_images(
    reconstruction: &Reconstruction,
    (tie, mark): (&[bool], &[bool]),
    image: &mut [bool],
    excluded: &mut Vec<Excluded>,
) {
    let mut seen = vec![0usize; reconstruction.images.len()];
    for (_, o) in tie.iter().zip(&reconstruction.observations).filter(|(keep, _)| **keep) {
        seen[o.image as usize] += 1;
    }
    for (_, m) in mark.iter().zip(&reconstruction.marks).filter(|(keep, _)| **keep) {
        seen[m.image as usize] +=
            usize::from(reconstruction.ground[m.ground as usize].role != Role::Check);
    }
    for (k, keep) in image.iter_mut().enumerate() {
        if *keep && seen[k] < MIN_OBSERVATIONS {
            *keep = false;
            excluded.push(Excluded {
                kind: ExcludedKind::Image,
                image: Some(reconstruction.images[k].name.clone()),
                point: None,
                reason: format!(
                    "it has {} usable observation(s), its pose needs {MIN_OBSERVATIONS}",
                    seen[k]
                ),
            });
        }
    }
}

/// New indices of what is kept, and the old ones.
fn renumber(keep: &[bool]) -> (Vec<u32>, Vec<usize>) {
    let old: Vec<usize> = (0..keep.len()).filter(|&k| keep[k]).collect();
    let mut new = vec![u32::MAX; keep.len()];
    for (k, &place) in old.iter().enumerate() {
        new[place] = k as u32;
    }
    (new, old)
}

fn compact(
    whole: &Reconstruction,
    [image, point, ground]: [&[bool]; 3],
    (tie, mark): (&[bool], &[bool]),
    mut excluded: Vec<Excluded>,
) -> Validated {
    let ((new_image, images), (new_point, points), (new_ground, grounds)) =
        (renumber(image), renumber(point), renumber(ground));
    let mut reconstruction = Reconstruction {
        images: images.iter().map(|&k| whole.images[k].clone()).collect(),
        points: points.iter().map(|&k| whole.points[k]).collect(),
        ground: grounds.iter().map(|&k| whole.ground[k].clone()).collect(),
        observations: Vec::new(),
        marks: Vec::new(),
        positions: Vec::new(),
        orientations: Vec::new(),
        scale_bars: Vec::new(),
        accuracy: None,
        ..whole.clone()
    };
    let (mut observations, mut marks) = (Vec::new(), Vec::new());
    let (mut positions, mut scale_bars) = (Vec::new(), Vec::new());
    for (k, o) in whole.observations.iter().enumerate().filter(|(k, _)| tie[*k]) {
        let (image, point) = (new_image[o.image as usize], new_point[o.point as usize]);
        if image != u32::MAX && point != u32::MAX {
            observations.push(k);
            reconstruction.observations.push(Observation { image, point, ..*o });
        }
    }
    for (k, m) in whole.marks.iter().enumerate().filter(|(k, _)| mark[*k]) {
        let (image, ground) = (new_image[m.image as usize], new_ground[m.ground as usize]);
        if image != u32::MAX && ground != u32::MAX {
            marks.push(k);
            reconstruction.marks.push(GroundObservation { image, ground, ..*m });
        }
    }
    for (k, position) in whole.positions.iter().enumerate() {
        let image = new_image[position.image as usize];
        if image != u32::MAX {
            positions.push(k);
            reconstruction.positions.push(CameraPosition { image, ..*position });
        } else {
            excluded.push(Excluded {
                kind: ExcludedKind::CameraPosition,
                image: Some(whole.images[position.image as usize].name.clone()),
                point: None,
                reason: "its image takes no part".into(),
            });
        }
    }
    for known in &whole.orientations {
        let image = new_image[known.image as usize];
        if image != u32::MAX {
            reconstruction.orientations.push(CameraOrientation { image, ..*known });
        }
    }
    for (k, bar) in whole.scale_bars.iter().enumerate() {
        let ends = bar.ends.map(|end| new_ground[end as usize]);
        let used =
            |end: u32| end != u32::MAX && reconstruction.ground[end as usize].role != Role::Check;
        if ends.iter().all(|&end| used(end)) {
            scale_bars.push(k);
            reconstruction.scale_bars.push(ScaleBar { ends, ..*bar });
        } else {
            let names = bar.ends.map(|end| whole.ground[end as usize].name.clone());
            excluded.push(Excluded {
                kind: ExcludedKind::ScaleBar,
                image: None,
                point: Some(names.join(" - ")),
                reason: "one of its ends takes no part".into(),
            });
        }
    }
    Validated {
        reconstruction,
        excluded,
        images,
        points,
        ground: grounds,
        observations,
        marks,
        positions,
        scale_bars,
    }
}

impl Validated {
    /// Writes what was adjusted into the reconstruction that this came from.
    pub fn update(&self, adjusted: &Reconstruction, whole: &mut Reconstruction) {
        whole.cameras.clone_from(&adjusted.cameras);
        for (image, &k) in adjusted.images.iter().zip(&self.images) {
            whole.images[k].pose = image.pose;
            whole.images[k].motion = image.motion;
        }
        for (point, &k) in adjusted.points.iter().zip(&self.points) {
            whole.points[k].position_m = point.position_m;
        }
    }
}
