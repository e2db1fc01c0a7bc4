//! Residuals corner by corner and by radius, and the distortion curve.

use crate::camera::{Interior, Lens};
use serde::Serialize;

/// The residual of one measured corner.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct CornerResidual {
    /// Where the corner is in the photo, pixels.
    pub u_px: f64,
    /// The same, down.
    pub v_px: f64,
    /// Measured minus projected, pixels.
    pub du_px: f64,
    /// The same, down.
    pub dv_px: f64,
    /// Distance from the principal point, pixels.
    pub radius_px: f64,
    /// The part away from the principal point, pixels.
    pub radial_px: f64,
    /// The part across, pixels.
    pub tangential_px: f64,
}

impl CornerResidual {
    /// Of a corner measured at `image_px` whose projection is off by `residual_px` (projected minus measured), in a camera
    /// with this principal point.
    pub fn new(
        image_px: [f64; 2],
        residual_px: [f64; 2],
        principal_point_px: [f64; 2],
    ) -> CornerResidual {
        let [u, v] = image_px;
        let (du, dv) = (-residual_px[0], -residual_px[1]);
        let (x, y) = (u - principal_point_px[0], v - principal_point_px[1]);
        let radius = x.hypot(y).max(f64::MIN_POSITIVE);
        CornerResidual {
            u_px: u,
            v_px: v,
            du_px: du,
            dv_px: dv,
            radius_px: radius,
            radial_px: (du * x + dv * y) / radius,
            tangential_px: (dv * x - du * y) / radius,
        }
    }
}

/// Where the lens's axis meets the image, pixels.
pub fn principal_point_px(interior: &Interior) -> [f64; 2] {
    interior.project([0.0, 0.0, -1.0]).unwrap_or([0.0; 2])
}

/// Residuals of one ring around the principal point.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Ring {
    /// Middle of the ring, distance from the principal point, pixels.
    pub radius_px: f64,
    /// Corners in it.
    pub corners: usize,
    /// Mean of the residuals away from the principal point, pixels.
    pub radial_mean_px: f64,
    /// Their root mean square, pixels.
    pub radial_rms_px: f64,
    /// Mean of the residuals across, pixels.
    pub tangential_mean_px: f64,
    /// Their root mean square, pixels.
    pub tangential_rms_px: f64,
}

/// Twenty rings of equal width.
pub fn rings(rows: &[CornerResidual]) -> Vec<Ring> {
    const RINGS: usize = 20;
    let largest = rows.iter().map(|row| row.radius_px).fold(0.0, f64::max);
    let width = (largest / RINGS as f64).max(f64::MIN_POSITIVE);
    (0..RINGS)
        .filter_map(|ring| {
            let inside: Vec<&CornerResidual> = rows
                .iter()
                .filter(|row| ((row.radius_px / width) as usize).min(RINGS - 1) == ring)
                .collect();
            let count = inside.len() as f64;
            let mean = |part: fn(&CornerResidual) -> f64| {
                inside.iter().map(|row| part(row)).sum::<f64>() / count
            };
            (!inside.is_empty()).then(|| Ring {
                radius_px: (ring as f64 + 0.5) * width,
                corners: inside.len(),
                radial_mean_px: mean(|row| row.radial_px),
                radial_rms_px: mean(|row| row.radial_px.powi(2)).sqrt(),
                tangential_mean_px: mean(|row| row.tangential_px),
                tangential_rms_px: mean(|row| row.tangential_px.powi(2)).sqrt(),
            })
        })
        .collect()
}

/// The distortion at one distance from the principal point.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DistortionAt {
    /// The distance, pixels.
    pub radius_px: f64,
    /// Where a lens without distortion would have the same ray, pixels; `None` beyond 85 degrees.
    pub ideal_radius_px: Option<f64>,
    /// Measured minus ideal radius, pixels.
    pub distortion_px: Option<f64>,
    /// Angle of the ray from the axis, degrees.
    pub angle_deg: f64,
}

/// The distortion curve: the mean over eight directions, out to the furthest corner of the photos.
pub fn distortion_curve(interior: &Interior) -> Vec<DistortionAt> {
    const STEPS: usize = 100;
    let centre = principal_point_px(interior);
    let size = interior.size_px().map(f64::from);
    let furthest = [[0.0, 0.0], [size[0], 0.0], [0.0, size[1]], size]
        .iter()
        .map(|p: &[f64; 2]| (p[0] - centre[0]).hypot(p[1] - centre[1]))
        .fold(0.0, f64::max);
    let f = interior.principal_distance_px();
    (0..=STEPS)
        .filter_map(|k| {
            let radius = furthest * k as f64 / STEPS as f64;
            let angles: Option<Vec<f64>> = (0..8)
                .map(|d| {
                    let (sine, cosine) = (f64::from(d) * std::f64::consts::FRAC_PI_4).sin_cos();
                    let ray = interior
                        .unproject([centre[0] + radius * cosine, centre[1] + radius * sine])?;
                    Some(ray[0].hypot(ray[1]).atan2(-ray[2]))
                })
                .collect();
            let angle = angles?.iter().sum::<f64>() / 8.0;
            let ideal = (angle.to_degrees() < 85.0).then(|| f * angle.tan());
            Some(DistortionAt {
                radius_px: radius,
                ideal_radius_px: ideal,
                distortion_px: ideal.map(|ideal| radius - ideal),
                angle_deg: angle.to_degrees(),
            })
        })
        .collect()
}
