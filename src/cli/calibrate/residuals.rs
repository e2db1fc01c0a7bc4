//! Residuals corner by corner and by radius, and the distortion curve.

use super::Outcome;
use crate::{
    camera::{Interior, Lens},
    error::Error,
    problems::calibration::statistics::residuals,
};
use serde::Serialize;

/// One corner with its residual.
#[derive(Debug, Clone, Serialize)]
pub(super) struct ResidualRow<'a> {
    pub(super) image: &'a str,
    pub(super) column: usize,
    pub(super) row: usize,
    pub(super) u_px: f64,
    pub(super) v_px: f64,
    /// Measured minus projected.
    pub(super) du_px: f64,
    pub(super) dv_px: f64,
    /// Distance from the principal point.
    pub(super) radius_px: f64,
    /// Away from the principal point, and across.
    pub(super) radial_px: f64,
    pub(super) tangential_px: f64,
}

pub(super) fn residual_rows(outcome: &Outcome) -> Result<Vec<ResidualRow<'_>>, Error> {
    let all = residuals(&outcome.views, &outcome.solution.state)?;
    let centre = principal_point(&outcome.solution.state.interior);
    let mut rows = Vec::new();
    for (&photo, residuals) in outcome.used.iter().zip(&all) {
        let photo = &outcome.photos[photo];
        for (corner, residual) in photo.corners.iter().zip(residuals) {
            let [u, v] = corner.image_px;
            let (du, dv) = (-residual[0], -residual[1]);
            let (x, y) = (u - centre[0], v - centre[1]);
            let radius = x.hypot(y).max(f64::MIN_POSITIVE);
            rows.push(ResidualRow {
                image: &photo.name,
                column: corner.column,
                row: corner.row,
                u_px: u,
                v_px: v,
                du_px: du,
                dv_px: dv,
                radius_px: radius,
                radial_px: (du * x + dv * y) / radius,
                tangential_px: (dv * x - du * y) / radius,
            });
        }
    }
    Ok(rows)
}

/// Where the lens's axis meets the image, pixels.
pub(super) fn principal_point(interior: &Interior) -> [f64; 2] {
    interior.project([0.0, 0.0, -1.0]).unwrap_or([0.0; 2])
}

/// Residuals of one ring around the principal point.
#[derive(Debug, Clone, Serialize)]
pub(super) struct RingRow {
    pub(super) radius_px: f64,
    pub(super) corners: usize,
    pub(super) radial_mean_px: f64,
    pub(super) radial_rms_px: f64,
    pub(super) tangential_mean_px: f64,
    pub(super) tangential_rms_px: f64,
}

/// Twenty rings of equal width.
pub(super) fn rings(rows: &[ResidualRow<'_>]) -> Vec<RingRow> {
    const RINGS: usize = 20;
    let largest = rows.iter().map(|row| row.radius_px).fold(0.0, f64::max);
    let width = (largest / RINGS as f64).max(f64::MIN_POSITIVE);
    (0..RINGS)
        .filter_map(|ring| {
            let inside: Vec<&ResidualRow<'_>> = rows
                .iter()
                .filter(|row| ((row.radius_px / width) as usize).min(RINGS - 1) == ring)
                .collect();
            let count = inside.len() as f64;
            let mean = |part: fn(&ResidualRow<'_>) -> f64| {
                inside.iter().map(|row| part(row)).sum::<f64>() / count
            };
            (!inside.is_empty()).then(|| RingRow {
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
#[derive(Debug, Clone, Serialize)]
pub(super) struct CurveRow {
    pub(super) radius_px: f64,
    /// Where a lens without distortion would have the same ray; empty beyond 85 degrees.
    pub(super) ideal_radius_px: Option<f64>,
    /// Measured minus ideal radius.
    pub(super) distortion_px: Option<f64>,
    /// Angle of the ray from the axis.
    pub(super) angle_deg: f64,
}

/// The distortion curve: the mean over eight directions, out to the furthest corner of the photos.
pub(super) fn curve(interior: &Interior) -> Vec<CurveRow> {
    const STEPS: usize = 100;
    let centre = principal_point(interior);
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
            Some(CurveRow {
                radius_px: radius,
                ideal_radius_px: ideal,
                distortion_px: ideal.map(|ideal| radius - ideal),
                angle_deg: angle.to_degrees(),
            })
        })
        .collect()
}
