//! Where the rays of a track meet.
//!
//! `min_X sum |(I - d d^T)(X - C)|^2`: the point nearest to all rays, closed; where not all of them
//! agree, the two whose point most others confirm decide.

use crate::{
    camera::{Interior, Lens},
    scene::Pose,
};
use nalgebra::{Matrix3, Vector3};
use rowgram_optim::geometry::{dot, rotation};

/// One ray of a track.
#[derive(Debug, Clone, Copy)]
pub struct View<'a> {
    /// The camera's pose.
    pub pose: Pose,
    /// Its lens.
    pub lens: &'a Interior,
    /// Pixels.
    pub image_px: [f64; 2],
}

/// What a point must be like.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TriangulationOptions {
    /// Distance between measured and projected position up to which a ray belongs to it, pixels.
    pub tolerance_px: f64,
    /// The least angle that two of its rays make, radians.
    pub min_angle_rad: f64,
}

/// Distance between measured and projected position, pixels; `None` where there is no projection.
pub fn error_px(view: &View<'_>, point: [f64; 3]) -> Option<f64> {
    let [u, v] = view.lens.project(view.pose.to_camera(point))?;
    let off = [u - view.image_px[0], v - view.image_px[1]];
    Some((off[0] * off[0] + off[1] * off[1]).sqrt())
}

struct Ray {
    centre: Vector3<f64>,
    direction: Vector3<f64>,
}

fn nearest(rays: &[&Ray]) -> Option<[f64; 3]> {
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for ray in rays {
        let across = Matrix3::identity() - ray.direction * ray.direction.transpose();
        normal += across;
        right += across * ray.centre;
    }
    let inverse = normal.try_inverse()?;
    let point = inverse * right;
    point.iter().all(|v| v.is_finite()).then(|| point.into())
}

/// The widest angle between the rays from a point to some centres, radians.
pub fn widest_angle_rad(centres: &[[f64; 3]], point: [f64; 3]) -> f64 {
    let mut least: f64 = 1.0;
    let rays: Vec<[f64; 3]> = centres
        .iter()
        .map(|c| {
            let d: [f64; 3] = std::array::from_fn(|k| c[k] - point[k]);
            let norm = dot(d, d).sqrt().max(1e-300);
            d.map(|v| v / norm)
        })
        .collect();
    for i in 1..rays.len() {
        for j in 0..i {
            least = least.min(dot(rays[i], rays[j]));
        }
    }
    least.clamp(-1.0, 1.0).acos()
}

/// Pairs that are tried where not all rays agree.
const MAX_PAIRS: usize = 45;

/// The point of some views and which of them belong to it; `None` where fewer than two do or they are
/// too nearly parallel.
pub fn triangulate(
    views: &[View<'_>],
    demands: &TriangulationOptions,
) -> Option<([f64; 3], Vec<bool>)> {
    let rays: Vec<Option<Ray>> = views
        .iter()
        .map(|view| {
            let d = view.lens.unproject(view.image_px)?;
            let back = rotation::inverse(view.pose.rotation);
            Some(Ray {
                centre: view.pose.centre_m().into(),
                direction: rotation::rotate(back, d).into(),
            })
        })
        .collect();
    let inside = |point: [f64; 3]| -> Vec<bool> {
        views
            .iter()
            .map(|view| error_px(view, point).is_some_and(|error| error <= demands.tolerance_px))
            .collect()
    };
    let wide = |point: [f64; 3], inside: &[bool]| {
        let of = views.iter().zip(inside).filter(|(_, inside)| **inside);
        let centres: Vec<[f64; 3]> = of.map(|(view, _)| view.pose.centre_m()).collect();
        centres.len() >= 2 && widest_angle_rad(&centres, point) >= demands.min_angle_rad
    };
    let all: Vec<&Ray> = rays.iter().flatten().collect();
    if all.len() < 2 {
        return None;
    }
    if let Some(point) = nearest(&all) {
        let fits = inside(point);
        if fits.iter().all(|&fits| fits) {
            return wide(point, &fits).then_some((point, fits));
        }
    }
    if all.len() == 2 {
        return None;
    }
    let n = views.len();
    let mut best: Option<(usize, Vec<bool>)> = None;
    // Far apart first: those are the widest.
    let pairs = (1..n).rev().flat_map(|apart| (0..n - apart).map(move |i| (i, i + apart)));
    for (i, j) in pairs.take(MAX_PAIRS) {
        let (Some(a), Some(b)) = (&rays[i], &rays[j]) else { continue };
        let Some(point) = nearest(&[a, b]) else { continue };
        let fits = inside(point);
        let count = fits.iter().filter(|&&fits| fits).count();
        if count >= 2 && best.as_ref().is_none_or(|(most, _)| count > *most) && wide(point, &fits) {
            best = Some((count, fits));
        }
    }
    let (count, fits) = best?;
    // Two of three or more that agree are no majority.
    if 2 * count < n {
        return None;
    }
    let chosen: Vec<&Ray> =
        rays.iter().zip(&fits).filter_map(|(ray, &fits)| ray.as_ref().filter(|_| fits)).collect();
    let point = nearest(&chosen)?;
    let fits = inside(point);
    wide(point, &fits).then_some((point, fits))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Model;

    #[test]
    fn one_wrong_ray_among_four_is_left_out() {
        let mut values = [0.0; 12];
        (values[0], values[1], values[2], values[3]) = (800.0, 1.0, 500.0, 400.0);
        let lens = Interior::new(Model::Brown, [1001, 801], &values).unwrap();
        let poses: Vec<Pose> = (0..4)
            .map(|k| Pose::from_centre(rotation::IDENTITY, [5.0 * f64::from(k), 0.0, 30.0]))
            .collect();
        let point = [8.0, 2.0, 1.0];
        let mut views: Vec<View<'_>> = poses
            .iter()
            .map(|&pose| View {
                pose,
                lens: &lens,
                image_px: lens.project(pose.to_camera(point)).unwrap(),
            })
            .collect();
        let demands = TriangulationOptions { tolerance_px: 2.0, min_angle_rad: 0.02 };
        let (found, fits) = triangulate(&views, &demands).unwrap();
        assert!((0..3).all(|k| (found[k] - point[k]).abs() < 1e-9));
        assert_eq!(fits, [true; 4]);
        views[1].image_px[0] += 40.0;
        let (found, fits) = triangulate(&views, &demands).unwrap();
        assert!((0..3).all(|k| (found[k] - point[k]).abs() < 1e-9));
        assert_eq!(fits, [true, false, true, true]);
        // All from one place: no angle, no point.
        assert!(triangulate(&[views[0], views[0]], &demands).is_none());
    }
}
