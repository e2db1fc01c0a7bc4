//! A photo with its lens and pose: where it shows a point, which part of the map it can reach.
//!
//! With a rolling shutter the pose changes while the frame is read out; the row at which a point is seen
//! and the pose at which that row is read are found together by a few repetitions.

use super::Surface;
use crate::{
    camera::{Interior, Lens},
    scene::{Image, Pose, Reconstruction},
};
use rowgram_optim::geometry::rotation;

/// Points along each side of a photo by which its outline is followed.
const OUTLINE: usize = 24;
/// Share by which the outline's box is grown for what bulges between those.
const BULGE: f64 = 0.03;

/// A photo with its lens and pose.
#[derive(Debug, Clone)]
pub struct View {
    /// Its file name.
    pub name: String,
    /// Its lens.
    pub interior: Interior,
    /// Its pose in the middle of the exposure.
    pub pose: Pose,
    /// With a rolling shutter: how the camera frame turns (rotation vector, radians) and shifts (metres)
    /// from the first to the last row, in the camera frame.
    pub motion: Option<[f64; 6]>,
    rotation: [[f64; 3]; 3],
    centre_m: [f64; 3],
    size_px: [f64; 2],
}

/// The photos of a reconstruction, in its order, each with the exact lens of its own camera.
pub fn views(reconstruction: &Reconstruction) -> Vec<View> {
    let view = |image: &Image| {
        let interior = reconstruction.cameras[image.camera].interior;
        View::new(&image.name, interior, image.pose, Some(image.motion))
    };
    reconstruction.images.iter().map(view).collect()
}

/// Least and greatest x and y, metres.
pub type Bounds = [[f64; 2]; 2];

impl View {
    /// A posed photo.
    pub fn new(name: &str, interior: Interior, pose: Pose, motion: Option<[f64; 6]>) -> View {
        View {
            name: name.to_owned(),
            interior,
            pose,
            motion: motion.filter(|motion| motion.iter().any(|&m| m != 0.0)),
            rotation: rotation::matrix(pose.rotation),
            centre_m: pose.centre_m(),
            size_px: interior.size_px().map(f64::from),
        }
    }

    /// The projection centre, metres.
    pub fn centre_m(&self) -> [f64; 3] {
        self.centre_m
    }

    fn to_camera(&self, point_m: [f64; 3]) -> [f64; 3] {
        let d: [f64; 3] = std::array::from_fn(|k| point_m[k] - self.centre_m[k]);
        self.rotation.map(|row| row[0] * d[0] + row[1] * d[1] + row[2] * d[2])
    }

    /// World to camera frame: the rows of the rotation.
    pub(super) fn rotation(&self) -> &[[f64; 3]; 3] {
        &self.rotation
    }

    /// Whether it has a rolling shutter.
    pub(super) fn has_rolling_shutter(&self) -> bool {
        self.motion.is_some()
    }

    /// The pixel that shows a point; `None` where the photo does not.
    #[inline]
    pub fn pixel(&self, point_m: [f64; 3]) -> Option<[f64; 2]> {
        let at = self.image_px(self.to_camera(point_m))?;
        self.inside(at).then_some(at)
    }

    /// Where in the image plane a point is, inside the photo or not; `None` where the lens has no answer.
    #[inline]
    pub(crate) fn seen_px(&self, point_m: [f64; 3]) -> Option<[f64; 2]> {
        self.image_px(self.to_camera(point_m))
    }

    /// Where in the image plane a point of the camera frame (of the middle of the exposure) is, inside the
    /// photo or not; `None` where the lens has no answer.
    #[inline]
    pub(super) fn image_px(&self, in_camera: [f64; 3]) -> Option<[f64; 2]> {
        let mut at = self.interior.project(in_camera)?;
        if let Some(motion) = &self.motion {
            for _ in 0..4 {
                let moved = at_row(in_camera, motion, self.share(at[1]));
                at = self.interior.project_near(moved, at)?;
            }
        }
        Some(at)
    }

    /// Where in the readout a row is: -1/2 for the first, +1/2 for the last.
    fn share(&self, v_px: f64) -> f64 {
        (v_px - 0.5 * (self.size_px[1] - 1.0)) / self.size_px[1]
    }

    fn inside(&self, [u, v]: [f64; 2]) -> bool {
        u >= -0.5 && v >= -0.5 && u < self.size_px[0] - 0.5 && v < self.size_px[1] - 0.5
    }

    /// The ray of a pixel: where it starts and its direction in the world.
    pub fn ray(&self, image_px: [f64; 2]) -> Option<([f64; 3], [f64; 3])> {
        let direction = self.interior.unproject(image_px)?;
        let (mut from, mut direction) = ([0.0; 3], direction);
        if let Some(motion) = &self.motion {
            let share = self.share(image_px[1]);
            let back = rotation::inverse(turn(motion, share));
            let shift = [motion[3], motion[4], motion[5]].map(|m| -share * m);
            from = rotation::rotate(back, shift);
            direction = rotation::rotate(back, direction);
        }
        let back = rotation::inverse(self.pose.rotation);
        let offset = rotation::rotate(back, from);
        Some((
            std::array::from_fn(|k| self.centre_m[k] + offset[k]),
            rotation::rotate(back, direction),
        ))
    }

    /// Where on a surface a pixel is.
    pub fn ground(&self, image_px: [f64; 2], surface: &Surface) -> Option<[f64; 3]> {
        let (from, direction) = self.ray(image_px)?;
        surface.intersect_ray(from, direction)
    }

    /// The part of the map outside of which the photo shows nothing between two heights; infinite where
    /// it looks at the horizon.
    pub fn footprint_between_m(&self, [low, high]: [f64; 2]) -> Bounds {
        const ALL: Bounds = [[f64::NEG_INFINITY, f64::INFINITY]; 2];
        let mut bounds = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
        for at in self.outline() {
            // A lens of limited radius: what it shows lies within the rays that it has, but a ray
            // missing at the border says nothing of where.
            let Some((from, direction)) = self.ray(at) else { return ALL };
            if direction[2] > -0.02 {
                return ALL;
            }
            for z in [low, high] {
                let s = (z - from[2]) / direction[2];
                for (k, [least, most]) in bounds.iter_mut().enumerate() {
                    let x = from[k] + s * direction[k];
                    (*least, *most) = (least.min(x), most.max(x));
                }
            }
        }
        bounds.map(|[least, most]| {
            let margin = BULGE * (most - least);
            [least - margin, most + margin]
        })
    }

    /// Bounds of what the photo shows of a surface, and whether its whole outline is on the surface, where they are
    /// close; `None` where it shows nothing of it.
    pub fn footprint_m(&self, surface: &Surface) -> Option<(Bounds, bool)> {
        let mut bounds = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
        for at in self.outline() {
            let Some(point) = self.ground(at, surface) else {
                // It ends beyond the surface: what both reach.
                let (reach, known) =
                    (self.footprint_between_m(surface.range_m()), surface.bounds_m());
                let both: Bounds = std::array::from_fn(|k| {
                    [reach[k][0].max(known[k][0]), reach[k][1].min(known[k][1])]
                });
                return both.iter().all(|[low, high]| low <= high).then_some((both, false));
            };
            for (k, [least, most]) in bounds.iter_mut().enumerate() {
                (*least, *most) = (least.min(point[k]), most.max(point[k]));
            }
        }
        Some((bounds, true))
    }

    fn outline(&self) -> Vec<[f64; 2]> {
        let [right, below] = self.size_px.map(|n| n - 0.5);
        let mut outline = Vec::with_capacity(4 * OUTLINE + 4);
        for k in 0..=OUTLINE {
            let share = k as f64 / OUTLINE as f64;
            let (u, v) = (share * (right + 0.5) - 0.5, share * (below + 0.5) - 0.5);
            outline.extend([[u, -0.5], [u, below], [-0.5, v], [right, v]]);
        }
        outline
    }

    /// Ground sampling distance at the middle of the photo, metres per pixel.
    pub fn gsd_m(&self, surface: &Surface) -> Option<f64> {
        let [width, height] = self.size_px;
        let middle = [0.5 * (width - 1.0), 0.5 * (height - 1.0)];
        let point = self.ground(middle, surface)?;
        let d: f64 = (0..3).map(|k| (point[k] - self.centre_m[k]).powi(2)).sum();
        Some(d.sqrt() / self.interior.principal_distance_px())
    }
}

fn turn(motion: &[f64; 6], share: f64) -> rotation::Quaternion {
    rotation::exp([motion[0] * share, motion[1] * share, motion[2] * share])
}

/// A point in the camera frame of the middle of the exposure, in that of a row.
fn at_row(point: [f64; 3], motion: &[f64; 6], share: f64) -> [f64; 3] {
    let turned = rotation::rotate(turn(motion, share), point);
    std::array::from_fn(|k| turned[k] + share * motion[3 + k])
}
