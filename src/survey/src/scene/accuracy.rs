//! How well a reconstruction is known, as its last adjustment found it.

use super::Reconstruction;
use crate::camera::{Camera, Correlation};
use serde::{Deserialize, Serialize};

/// Standard deviations of an image's exterior orientation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PoseSigma {
    /// Of the projection centre, metres.
    pub centre_m: [f64; 3],
    /// Of omega, phi, kappa, radians.
    pub angles_rad: [f64; 3],
}

/// Standard deviations and correlations of the parameters of a camera that were adjusted.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraSigma {
    /// The parameters, in the order of the lens model.
    pub names: Vec<String>,
    /// Their standard deviations, in their units.
    pub sigmas: Vec<f64>,
    /// Their correlations, row by row.
    pub correlation: Vec<Vec<f64>>,
}

impl CameraSigma {
    /// The covariance matrix of the parameters, row by row.
    pub fn covariance(&self) -> Vec<Vec<f64>> {
        let rows = self.correlation.iter().zip(&self.sigmas);
        rows.map(|(row, a)| row.iter().zip(&self.sigmas).map(|(r, b)| r * a * b).collect())
            .collect()
    }
}

/// How well everything is known. Standard deviations are scaled by `sigma0`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Accuracy {
    /// Standard deviation of unit weight after the adjustment: how many times larger residuals are than assumed.
    pub sigma0: f64,
    /// Every image, in the order of the reconstruction.
    pub images: Vec<PoseSigma>,
    /// Every camera, in the order of the reconstruction; without entries where it was held.
    pub cameras: Vec<CameraSigma>,
    /// Standard deviations of every tie point along X, Y, Z, metres, in the order of the reconstruction.
    pub points_m: Vec<[f64; 3]>,
}

impl Reconstruction {
    /// The cameras with the standard deviations and correlations that the adjustment found, in place of what was known
    /// beforehand. Held parameters keep theirs.
    pub fn calibrated_cameras(&self) -> Vec<Camera> {
        let mut cameras = self.cameras.clone();
        let Some(accuracy) = &self.accuracy else { return cameras };
        for (camera, found) in cameras.iter_mut().zip(&accuracy.cameras) {
            if found.names.is_empty() {
                continue;
            }
            for (name, sigma) in found.names.iter().zip(&found.sigmas) {
                if let Some(index) = camera.interior.model().place(name) {
                    camera.standard_deviations[index] = Some(*sigma);
                }
            }
            let matrix = found.correlation.clone();
            camera.correlation = Some(Correlation { names: found.names.clone(), matrix });
        }
        cameras
    }
}
