//! What a photogrammetric block is: cameras, images, tie points, ground points and their marks,
//! measured camera positions and distances.

use super::{Accuracy, CameraOrientation, Excluded, Pose, ReferenceFrame};
use crate::camera::{Camera, Lens};
use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use rowgram_optim::geometry::{dot, rotation};
use serde::{Deserialize, Serialize};

/// One image.
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    /// Its file name.
    pub name: String,
    /// Its number in the files it came from.
    pub id: u32,
    /// Index of its camera.
    pub camera: usize,
    /// Its exterior orientation, in the middle of the exposure.
    pub pose: Pose,
    /// With a rolling shutter: how the camera frame turns (rotation vector, radians) and shifts
    /// (metres) while the frame is read out, in the camera frame.
    pub motion: [f64; 6],
    /// What is expected of that before anything is measured.
    pub expected_motion: [f64; 6],
}

/// One tie point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TiePoint {
    /// Its number in the files it came from.
    pub id: u64,
    /// Where it is, metres.
    pub position_m: [f64; 3],
    /// Its colour, red, green, blue.
    pub colour: [u8; 3],
}

/// A tie point measured in an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// Index of the image.
    pub image: u32,
    /// Index of the tie point.
    pub point: u32,
    /// Pixels.
    pub image_px: [f64; 2],
}

/// What a ground point is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Role {
    /// Its coordinates are observations.
    Control,
    /// It takes no part and is compared afterwards.
    Check,
    /// Its marks take part, its coordinates do not.
    Tie,
}

/// Which coordinates of a ground point are known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Axes {
    /// All three.
    Xyz,
    /// The position in plan only.
    Xy,
    /// The height only.
    Z,
}

impl Axes {
    /// The indices of the known coordinates.
    pub fn indices(self) -> &'static [usize] {
        match self {
            Axes::Xyz => &[0, 1, 2],
            Axes::Xy => &[0, 1],
            Axes::Z => &[2],
        }
    }
}

/// A point on the ground with known coordinates.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GroundPoint {
    /// Its name.
    pub name: String,
    /// Its coordinates, metres.
    pub position_m: [f64; 3],
    /// Their standard deviations, metres.
    pub sigma_m: [f64; 3],
    /// What it is for.
    pub role: Role,
    /// Which of the coordinates are known.
    pub axes: Axes,
}

/// A ground point measured in an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundObservation {
    /// Index of the image.
    pub image: u32,
    /// Index of the ground point.
    pub ground: u32,
    /// Pixels.
    pub image_px: [f64; 2],
    /// Standard deviation of each coordinate, pixels.
    pub sigma_px: f64,
}

/// A measured position of the antenna of an image's camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraPosition {
    /// Index of the image.
    pub image: u32,
    /// Metres.
    pub position_m: [f64; 3],
    /// Standard deviations, metres.
    pub sigma_m: [f64; 3],
}

/// A measured distance between two ground points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScaleBar {
    /// Indices of the ground points.
    pub ends: [u32; 2],
    /// Metres.
    pub length_m: f64,
    /// Standard deviation, metres.
    pub sigma_m: f64,
}

/// A shutter that reads the rows one after the other. Files may have a `sigma_rate_rad_s` of 0 beside these.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "StoredShutter")]
pub struct RollingShutter {
    /// Time from the first to the last row, seconds.
    pub readout_s: f64,
    /// Standard deviation of each component of the velocity about the expected one, metres per second.
    pub sigma_velocity_m_s: f64,
}

/// [`RollingShutter`] as files have it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct StoredShutter {
    readout_s: f64,
    sigma_velocity_m_s: f64,
    #[serde(default)]
    sigma_rate_rad_s: f64,
}

impl TryFrom<StoredShutter> for RollingShutter {
    type Error = String;

    fn try_from(stored: StoredShutter) -> Result<RollingShutter, String> {
        let StoredShutter { readout_s, sigma_velocity_m_s, sigma_rate_rad_s: rate } = stored;
        match rate == 0.0 {
            true => Ok(RollingShutter { readout_s, sigma_velocity_m_s }),
            false => Err(format!(
                "sigma_rate_rad_s is {rate}, expected 0: the rotation of photos during readout is not estimated"
            )),
        }
    }
}

/// A block of images and everything measured in and about it. Lengths in metres in the mapping
/// frame, image positions in pixels with the centre of the top-left pixel at (0, 0).
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Reconstruction {
    /// The frame in which all coordinates are.
    pub reference: ReferenceFrame,
    /// The cameras; a free parameter that has a standard deviation has its value as a prior.
    pub cameras: Vec<Camera>,
    /// The images.
    pub images: Vec<Image>,
    /// The tie points.
    pub points: Vec<TiePoint>,
    /// Their measurements.
    pub observations: Vec<Observation>,
    /// Standard deviation of each coordinate of those, pixels.
    pub tie_sigma_px: f64,
    /// The ground points.
    pub ground: Vec<GroundPoint>,
    /// Their measurements.
    pub marks: Vec<GroundObservation>,
    /// Measured camera positions.
    pub positions: Vec<CameraPosition>,
    /// Measured orientations of cameras.
    pub orientations: Vec<CameraOrientation>,
    /// The antenna in the camera frame, metres.
    pub lever_arm_m: [f64; 3],
    /// Measured distances.
    pub scale_bars: Vec<ScaleBar>,
    /// Whether the shutter rolls.
    pub rolling_shutter: Option<RollingShutter>,
    /// How well all of it is known, where an adjustment has found it.
    pub accuracy: Option<Accuracy>,
    /// What took no part, and why.
    pub excluded: Vec<Excluded>,
}

impl Reconstruction {
    /// Applies `x -> scale turn x + shift` to the poses of images and to tie points.
    pub(crate) fn transform(&mut self, scale: f64, turn: &Matrix3<f64>, shift: &Vector3<f64>) {
        let apply =
            |x: [f64; 3]| -> [f64; 3] { (scale * (turn * Vector3::from(x)) + shift).into() };
        let q = UnitQuaternion::from_matrix(turn);
        let back = rotation::inverse(rotation::normalize([q.w, q.i, q.j, q.k]));
        for image in &mut self.images {
            let turned = rotation::normalize(rotation::multiply(image.pose.rotation, back));
            image.pose = Pose::from_centre(turned, apply(image.pose.centre_m()));
        }
        for point in &mut self.points {
            point.position_m = apply(point.position_m);
        }
    }

    /// Where in the readout a row is: -1/2 for the first, +1/2 for the last.
    pub fn readout_share(&self, image: usize, v_px: f64) -> f64 {
        let height = f64::from(self.cameras[self.images[image].camera].interior.size_px()[1]);
        (v_px - 0.5 * (height - 1.0)) / height
    }

    /// The pose of an image while it read a row.
    pub fn pose_at(&self, image: usize, v_px: f64) -> Pose {
        let Image { pose, motion, .. } = &self.images[image];
        if self.rolling_shutter.is_none() {
            return *pose;
        }
        pose.moved(motion.map(|v| v * self.readout_share(image, v_px)))
    }

    /// Whether a camera can have a point where it was measured: in front of it, and where its lens is one to one.
    pub fn is_feasible(&self, image: usize, image_px: [f64; 2], point_m: [f64; 3]) -> bool {
        let lens = &self.cameras[self.images[image].camera].interior;
        lens.project(self.pose_at(image, image_px[1]).to_camera(point_m)).is_some()
    }

    /// Root mean square distance of where a ground point was measured and where it is seen if it is at `position_m`, pixels; `None`
    /// where it was measured in no image that can see it there.
    pub fn ground_point_rms_px(&self, ground: usize, position_m: [f64; 3]) -> Option<f64> {
        let squares =
            self.marks.iter().filter(|mark| mark.ground as usize == ground).filter_map(|mark| {
                let image = mark.image as usize;
                let lens = &self.cameras[self.images[image].camera].interior;
                let [u, v] =
                    lens.project(self.pose_at(image, mark.image_px[1]).to_camera(position_m))?;
                Some((u - mark.image_px[0]).powi(2) + (v - mark.image_px[1]).powi(2))
            });
        let squares: Vec<f64> = squares.collect();
        (!squares.is_empty()).then(|| (squares.iter().sum::<f64>() / squares.len() as f64).sqrt())
    }

    /// The velocity of an image in the world, metres per second, from its motion.
    pub fn velocity_m_s(&self, image: usize) -> Option<[f64; 3]> {
        let readout_s = self.rolling_shutter?.readout_s;
        let image = &self.images[image];
        let shift = [image.motion[3], image.motion[4], image.motion[5]];
        let back = rotation::rotate(rotation::inverse(image.pose.rotation), shift);
        Some(back.map(|v| -v / readout_s))
    }

    /// The middle of what holds the block in the world, on whole metres: numbers near it keep their
    /// digits.
    pub(crate) fn origin_m(&self) -> [f64; 3] {
        let control: Vec<[f64; 3]> = self
            .ground
            .iter()
            .filter(|point| point.role == Role::Control && point.axes == Axes::Xyz)
            .map(|point| point.position_m)
            .collect();
        let of = if control.is_empty() {
            self.images.iter().map(|image| image.pose.centre_m()).collect()
        } else {
            control
        };
        let count = of.len().max(1) as f64;
        std::array::from_fn(|k| (of.iter().map(|p| p[k]).sum::<f64>() / count).round())
    }

    /// Moves the whole block by `-origin_m`.
    pub(crate) fn shift(&mut self, origin_m: [f64; 3]) {
        for image in &mut self.images {
            let turned = rotation::matrix(image.pose.rotation).map(|row| dot(row, origin_m));
            for k in 0..3 {
                image.pose.translation[k] += turned[k];
            }
        }
        let moved = |position: &mut [f64; 3]| (0..3).for_each(|k| position[k] -= origin_m[k]);
        self.points.iter_mut().for_each(|point| moved(&mut point.position_m));
        self.ground.iter_mut().for_each(|point| moved(&mut point.position_m));
        self.positions.iter_mut().for_each(|position| moved(&mut position.position_m));
    }
}
