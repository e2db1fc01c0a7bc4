//! What a reconstruction's files say: the block itself, and what must be kept to write it again.

use rowgram_optim::geometry::rotation;
use rowgram_survey::{
    camera::{Interior, Lens, Model as LensModel},
    scene::{Pose, Reconstruction},
};
use std::collections::HashSet;

/// A reconstruction as read from files.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Model {
    /// The block.
    pub survey: Reconstruction,
    /// The number of each camera in the files.
    pub camera_ids: Vec<u32>,
    /// The features of each image in the files' order, with the number of the point that they belong
    /// to, if any; empty where the format has none but observations.
    pub features: Vec<Vec<Feature>>,
}

/// A position found in an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Feature {
    /// Pixels.
    pub image_px: [f64; 2],
    /// The tie point's number.
    pub point: Option<u64>,
}

/// A turn by pi about the x axis: between the camera frame of computer vision and ours.
const ABOUT_X: rotation::Quaternion = [0.0, 1.0, 0.0, 0.0];

/// A pose whose camera frame is that of computer vision (y down, looking along +z), as one of ours.
pub(super) fn from_computer_vision(rotation: rotation::Quaternion, t: [f64; 3]) -> Pose {
    Pose {
        rotation: rotation::normalize(rotation::multiply(ABOUT_X, rotation)),
        translation: [t[0], -t[1], -t[2]],
    }
}

/// One of our poses with the camera frame of computer vision; the scalar part is not negative.
pub(super) fn to_computer_vision(pose: &Pose) -> (rotation::Quaternion, [f64; 3]) {
    let q = rotation::multiply(rotation::inverse(ABOUT_X), pose.rotation);
    let q = if q[0] < 0.0 { q.map(|v| -v) } else { q };
    let t = pose.translation;
    (q, [t[0], -t[1], -t[2]])
}

/// A lens as one of Brown's model, where it is one; `None` for others.
pub(super) fn as_brown(interior: &Interior) -> Option<[f64; 12]> {
    let v = interior.values();
    match interior.model() {
        LensModel::Brown => Some(std::array::from_fn(|k| v[k])),
        LensModel::Bal => {
            let [cx, cy] = interior.centre_px();
            Some([v[0], 1.0, cx, cy, v[1], v[2], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        }
        LensModel::Smac | LensModel::Fisheye => None,
    }
}

/// Why a block is refused whose images share a name, if they do: tables and other files name images.
pub(super) fn names_once(survey: &Reconstruction) -> Result<(), String> {
    let mut names = HashSet::new();
    match survey.images.iter().find(|image| !names.insert(image.name.as_str())) {
        None => Ok(()),
        Some(image) => {
            Err(format!("two images are called {:?}, expected each name once", image.name))
        }
    }
}

impl Model {
    /// The features of each image: as they were read, less those whose point or observation is no
    /// longer there, or else the observations.
    pub(super) fn features_to_write(&self) -> Vec<Vec<Feature>> {
        let survey = &self.survey;
        let mut of_images: Vec<Vec<Feature>> = vec![Vec::new(); survey.images.len()];
        let mut kept: Vec<HashSet<u64>> = vec![Default::default(); of_images.len()];
        for o in &survey.observations {
            let id = survey.points[o.point as usize].id;
            kept[o.image as usize].insert(id);
            of_images[o.image as usize].push(Feature { image_px: o.image_px, point: Some(id) });
        }
        if self.features.len() != survey.images.len() {
            return of_images;
        }
        let read = self.features.iter().zip(&kept).map(|(features, kept)| {
            let still =
                |f: &Feature| Feature { point: f.point.filter(|point| kept.contains(point)), ..*f };
            features.iter().map(still).collect()
        });
        read.collect()
    }
}
