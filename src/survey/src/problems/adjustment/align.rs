//! Brings a block from a frame of its own into the mapping frame: a closed-form similarity from
//! control points or camera positions, robust to wrong ones.
//!
//! ```text
//! min sum |s R x_k + t - y_k|^2
//! ```
//!
//! by the singular value decomposition of the cross-covariance (Umeyama, *Least-squares estimation of
//! transformation parameters*, PAMI 13(4), 1991), first from threes: the three whose similarity leaves
//! the least median residual says who is in.

use super::check_points::nearest_to_rays;
use crate::camera::Lens;
use crate::scene::{Axes, GroundObservation, Reconstruction, Role};
use nalgebra::{Matrix3, Vector3};
use serde::Serialize;

/// How a block was brought into the mapping frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Alignment {
    /// "control points" or "camera positions".
    pub by: &'static str,
    /// Metres per unit of the block before.
    pub scale: f64,
    /// Names of what was used.
    pub used: Vec<String>,
    /// Names of what does not fit, with the distances left, metres; of control points that are
    /// marked in one image only, which say nothing about the similarity, those from their rays.
    pub misfits: Vec<(String, f64)>,
    /// Root mean square distance of what was used, metres.
    pub rmse_m: f64,
}

struct Similarity {
    scale: f64,
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
}

impl Similarity {
    fn apply(&self, x: [f64; 3]) -> Vector3<f64> {
        self.scale * self.rotation * Vector3::from(x) + self.translation
    }
}

type Pairing = (String, [f64; 3], [f64; 3]);

/// Brings `reconstruction` into the frame of its control points, or of its camera positions where there
/// are fewer than three of those; `None`, and nothing changed, where there are too few of both.
pub fn align(reconstruction: &mut Reconstruction) -> Option<Alignment> {
    let mut pairs: Vec<Pairing> = Vec::new();
    for (k, point) in reconstruction.ground.iter().enumerate() {
        let marks: Vec<GroundObservation> =
            reconstruction.marks.iter().filter(|mark| mark.ground as usize == k).copied().collect();
        if point.role == Role::Control && point.axes == Axes::Xyz && marks.len() >= 2 {
            let found = nearest_to_rays(reconstruction, &marks);
            pairs.extend(found.map(|at| (point.name.clone(), at, point.position_m)));
        }
    }
    let mut by = "control points";
    let mut best = fit_robustly(&pairs);
    if best.is_none() {
        by = "camera positions";
        let positions = reconstruction.positions.iter().map(|position| {
            let image = &reconstruction.images[position.image as usize];
            (image.name.clone(), image.pose.centre_m(), position.position_m)
        });
        pairs = positions.collect();
        best = fit_robustly(&pairs);
    }
    let (similarity, inside) = best?;
    let Similarity { scale, rotation, translation } = &similarity;
    reconstruction.transform(*scale, rotation, translation);
    let mut alignment = Alignment {
        by,
        scale: similarity.scale,
        used: Vec::new(),
        misfits: Vec::new(),
        rmse_m: 0.0,
    };
    for (k, (name, from, to)) in pairs.iter().enumerate() {
        let left = (similarity.apply(*from) - Vector3::from(*to)).norm();
        if inside[k] {
            alignment.used.push(name.clone());
            alignment.rmse_m += left * left;
        } else {
            alignment.misfits.push((name.clone(), left));
        }
    }
    alignment.rmse_m = (alignment.rmse_m / alignment.used.len() as f64).sqrt();
    if by == "control points" {
        // A similarity takes seven of the numbers that its points give.
        let numbers = 3.0 * alignment.used.len() as f64;
        let sigma_m = alignment.rmse_m * (numbers / (numbers - 7.0)).sqrt();
        let rest = beside_their_rays(reconstruction, sigma_m);
        alignment.misfits.extend(rest);
    }
    Some(alignment)
}

/// A single ray beside its point by this many times what the other points are off is wrong: the
/// block is bent most at its rim, where points are marked in one image only.
const BESIDE: f64 = 8.0;

/// Control points with one mark whose ray does not come near them, with the distances, metres.
fn beside_their_rays(reconstruction: &Reconstruction, sigma_m: f64) -> Vec<(String, f64)> {
    let mut found = Vec::new();
    for (k, point) in reconstruction.ground.iter().enumerate() {
        let mut marks = reconstruction.marks.iter().filter(|mark| mark.ground as usize == k);
        let (Some(mark), None) = (marks.next(), marks.next()) else { continue };
        if point.role != Role::Control || point.axes != Axes::Xyz {
            continue;
        }
        let image = &reconstruction.images[mark.image as usize];
        let Some(ray) = reconstruction.cameras[image.camera].interior.unproject(mark.image_px)
        else {
            continue;
        };
        let at = Vector3::from(image.pose.to_camera(point.position_m));
        let left = at.cross(&Vector3::from(ray)).norm() / Vector3::from(ray).norm();
        let given = point.sigma_m.iter().copied().fold(0.0, f64::max);
        if left > BESIDE * sigma_m.max(given) {
            found.push((point.name.clone(), left));
        }
    }
    found
}

/// The most threes that are tried.
const MAX_TRIALS: usize = 3000;

fn fit_robustly(pairs: &[Pairing]) -> Option<(Similarity, Vec<bool>)> {
    let n = pairs.len();
    let left = |similarity: &Similarity, pair: &Pairing| -> f64 {
        (similarity.apply(pair.1) - Vector3::from(pair.2)).norm()
    };
    let threes =
        (0..n).flat_map(|i| (i + 1..n).flat_map(move |j| (j + 1..n).map(move |k| [i, j, k])));
    let total = n * n.saturating_sub(1) * n.saturating_sub(2) / 6;
    let every = total.div_ceil(MAX_TRIALS).max(1);
    let mut best: Option<(f64, Similarity)> = None;
    for three in threes.step_by(every) {
        let three = three.map(|k| (pairs[k].1, pairs[k].2));
        let Some(similarity) = fit(&three) else { continue };
        let mut distances: Vec<f64> = pairs.iter().map(|pair| left(&similarity, pair)).collect();
        distances.sort_by(f64::total_cmp);
        // The median, but beyond the three that fit by themselves.
        let median = distances[(n / 2).max(3.min(n - 1))];
        if best.as_ref().is_none_or(|(least, _)| median < *least) {
            best = Some((median, similarity));
        }
    }
    let (median, similarity) = best?;
    let inside: Vec<bool> =
        pairs.iter().map(|pair| left(&similarity, pair) <= 3.0 * median).collect();
    let used: Vec<_> = pairs
        .iter()
        .zip(&inside)
        .filter(|(_, inside)| **inside)
        .map(|(pair, _)| (pair.1, pair.2))
        .collect();
    match fit(&used) {
        Some(refined) => Some((refined, inside)),
        // Three points: all of them.
        None => fit(&pairs.iter().map(|pair| (pair.1, pair.2)).collect::<Vec<_>>())
            .map(|all| (all, vec![true; n])),
    }
}

/// The similarity of at least three pairs; `None` where they are nearly in one line.
fn fit(pairs: &[([f64; 3], [f64; 3])]) -> Option<Similarity> {
    if pairs.len() < 3 {
        return None;
    }
    let count = pairs.len() as f64;
    let from = pairs.iter().map(|pair| Vector3::from(pair.0)).sum::<Vector3<f64>>() / count;
    let to = pairs.iter().map(|pair| Vector3::from(pair.1)).sum::<Vector3<f64>>() / count;
    let mut cross = Matrix3::zeros();
    let mut spread = 0.0;
    for (x, y) in pairs {
        let (x, y) = (Vector3::from(*x) - from, Vector3::from(*y) - to);
        cross += y * x.transpose() / count;
        spread += x.norm_squared() / count;
    }
    let svd = cross.svd(true, true);
    let (u, vt) = (svd.u?, svd.v_t?);
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| svd.singular_values[b].total_cmp(&svd.singular_values[a]));
    if svd.singular_values[order[1]] < 1e-4 * svd.singular_values[order[0]] {
        return None;
    }
    let mut signs = Vector3::repeat(1.0);
    if u.determinant() * vt.determinant() < 0.0 {
        signs[order[2]] = -1.0;
    }
    let rotation = u * Matrix3::from_diagonal(&signs) * vt;
    let scale = svd.singular_values.dot(&signs) / spread;
    (scale.is_finite() && scale > 0.0).then(|| Similarity {
        scale,
        rotation,
        translation: to - scale * rotation * from,
    })
}
