//! Points of a network that start at the centre of a camera that sees them: there the image has no value, the cost no slope,
//! and the steps of all other points are held as small as theirs. They begin where their rays come nearest to each other.

use super::bundle::{Camera, Network};
use nalgebra::{Matrix3, Vector3};
use rowgram_optim::geometry::rotation;

/// Nearer to a camera than this share of the usual distance is at its centre.
const AT_CENTRE: f64 = 1e-4;

fn centre(camera: &Camera) -> Vector3<f64> {
    let q = rotation::exp(camera.rotation_rad);
    -Vector3::from(rotation::rotate(rotation::inverse(q), camera.translation))
}

/// The direction of a measurement in the world, its lens without distortion.
fn direction(camera: &Camera, image_px: [f64; 2]) -> Option<Vector3<f64>> {
    let f = camera.interior[0];
    let q = rotation::exp(camera.rotation_rad);
    let ray = [image_px[0] / f, image_px[1] / f, -1.0];
    let ray = Vector3::from(rotation::rotate(rotation::inverse(q), ray));
    ray.try_normalize(0.0).filter(|ray| ray.iter().all(|v| v.is_finite()))
}

/// Moves points that start at the centre of a camera that sees them to where their rays come nearest to each other, or where
/// there is but one ray along it by the usual distance; which they are.
pub fn move_points_off_centres(network: &mut Network) -> Vec<usize> {
    let centres: Vec<Vector3<f64>> = network.cameras.iter().map(centre).collect();
    let distance = |camera: u32, point: u32| {
        (Vector3::from(network.points[point as usize]) - centres[camera as usize]).norm()
    };
    let distances: Vec<f64> =
        network.observations.iter().map(|o| distance(o.camera, o.point)).collect();
    let mut lost: Vec<usize> = Vec::new();
    let mut sorted = distances.clone();
    sorted.sort_by(f64::total_cmp);
    let usual = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
    for (o, distance) in network.observations.iter().zip(&distances) {
        if *distance < AT_CENTRE * usual {
            lost.push(o.point as usize);
        }
    }
    lost.sort_unstable();
    lost.dedup();
    for &point in &lost {
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        let mut first = None;
        for o in network.observations.iter().filter(|o| o.point as usize == point) {
            let at = centres[o.camera as usize];
            let Some(ray) = direction(&network.cameras[o.camera as usize], o.image_px) else {
                continue;
            };
            let across = Matrix3::identity() - ray * ray.transpose();
            normal += across;
            right += across * at;
            first.get_or_insert(at + usual * ray);
        }
        let is_fixed = normal.symmetric_eigenvalues().min() > 1e-9;
        let nearest = normal.try_inverse().filter(|_| is_fixed).map(|inverse| inverse * right);
        if let Some(at) = nearest.or(first) {
            network.points[point] = at.into();
        }
    }
    lost
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{camera::bal, problems::bundle::Observation};

    #[test]
    fn a_point_on_a_camera_begins_where_its_rays_meet() {
        let camera = |x: f64, turn: f64| {
            let q = rotation::exp([0.0, turn, 0.0]);
            let t = rotation::rotate(q, [-x, 0.0, 0.0]);
            Camera { rotation_rad: [0.0, turn, 0.0], translation: t, interior: [800.0, 0.0, 0.0] }
        };
        let cameras = vec![camera(0.0, 0.0), camera(1.0, 0.1), camera(2.0, 0.2)];
        let truth: Vec<[f64; 3]> = (0..20).map(|k| [f64::from(k) * 0.1, 0.3, -10.0]).collect();
        let mut network = Network { cameras, points: truth.clone(), observations: Vec::new() };
        for (camera, of) in (0..).zip(&network.cameras) {
            for (point, at) in (0..).zip(&truth) {
                let q = rotation::exp(of.rotation_rad);
                let p = rotation::rotate(q, *at);
                let p = std::array::from_fn(|k| p[k] + of.translation[k]);
                let image_px = bal::project(p, of.interior);
                network.observations.push(Observation { camera, point, image_px });
            }
        }
        assert!(move_points_off_centres(&mut network).is_empty());
        network.points[7] = [1.0, 0.0, 0.0];
        assert_eq!(move_points_off_centres(&mut network), [7]);
        let off = (Vector3::from(network.points[7]) - Vector3::from(truth[7])).norm();
        assert!(off < 1e-9, "{off}");
    }
}
