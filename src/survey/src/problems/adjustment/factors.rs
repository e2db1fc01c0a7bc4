//! The observations besides tie points that are no priors of numbers: marks, camera positions, distances. All residuals are divided by their standard
//! deviations.

use super::reprojection::{DATA, LENS, Shutter};
use rowgram_optim::{
    geometry::{cross, dot, rotation},
    nlls::{BlockId, Factor, Infeasible, Jacobian},
};

/// A ground point measured in an image: blocks image, lens, ground point.
#[derive(Debug, Clone)]
pub(super) struct GroundPointFactor {
    pub(super) shutter: Shutter,
    pub(super) blocks: [BlockId; 3],
    pub(super) data: [f64; DATA],
}

impl Factor for GroundPointFactor {
    fn rows(&self) -> usize {
        2
    }

    fn blocks(&self) -> &[BlockId] {
        &self.blocks
    }

    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        jacobian: Option<&mut Jacobian<'_>>,
    ) -> Result<(), Infeasible> {
        let point = [x[2][0], x[2][1], x[2][2]];
        let prepared = self.shutter.prepare(x[0], x[1]);
        let found = self.shutter.linearize(&prepared, &point, &self.data);
        residual.copy_from_slice(&found.residual);
        if let Some(jacobian) = jacobian {
            let dimension = found.by_image.len() / 2;
            for row in 0..2 {
                let (by_image, rest) = jacobian.row(row).split_at_mut(dimension);
                let (by_lens, by_point) = rest.split_at_mut(LENS);
                by_image.copy_from_slice(&found.by_image[row * dimension..][..dimension]);
                by_lens.copy_from_slice(&found.by_lens[row * LENS..][..LENS]);
                by_point.copy_from_slice(&found.by_point[row]);
            }
        }
        if residual.iter().all(|v| v.is_finite()) { Ok(()) } else { Err(Infeasible) }
    }
}

/// The measured position of the antenna, `R^T (l - t) + o` with the lever arm `l`, and the offset `o` of the receiver's frame
/// from that of the control where there is one.
#[derive(Debug, Clone)]
pub(super) struct CameraPositionFactor {
    /// The pose, and the offset.
    pub(super) blocks: Vec<BlockId>,
    pub(super) lever_arm_m: [f64; 3],
    pub(super) position_m: [f64; 3],
    pub(super) sigma_m: [f64; 3],
}

impl Factor for CameraPositionFactor {
    fn rows(&self) -> usize {
        3
    }

    fn blocks(&self) -> &[BlockId] {
        &self.blocks
    }

    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        mut jacobian: Option<&mut Jacobian<'_>>,
    ) -> Result<(), Infeasible> {
        let r = rotation::matrix([x[0][0], x[0][1], x[0][2], x[0][3]]);
        let l = self.lever_arm_m;
        let from_centre = [l[0] - x[0][4], l[1] - x[0][5], l[2] - x[0][6]];
        for k in 0..3 {
            let axis = [r[0][k], r[1][k], r[2][k]];
            let offset = x.get(1).map_or(0.0, |offset| offset[k]);
            residual[k] = (dot(axis, from_centre) + offset - self.position_m[k]) / self.sigma_m[k];
            if let Some(jacobian) = jacobian.as_deref_mut() {
                let row = jacobian.row(k);
                // The camera turns about its own centre: the antenna moves by R^T (l x w - s).
                let turn = cross(axis, l);
                for c in 0..3 {
                    row[c] = turn[c] / self.sigma_m[k];
                    row[3 + c] = -axis[c] / self.sigma_m[k];
                }
                if x.len() > 1 {
                    let offset = row.len() - 3;
                    row[offset + k] = 1.0 / self.sigma_m[k];
                }
            }
        }
        Ok(())
    }
}

/// A measured distance between two ground points.
#[derive(Debug, Clone)]
pub(super) struct ScaleBarFactor {
    pub(super) blocks: [BlockId; 2],
    pub(super) length_m: f64,
    pub(super) sigma_m: f64,
}

impl Factor for ScaleBarFactor {
    fn rows(&self) -> usize {
        1
    }

    fn blocks(&self) -> &[BlockId] {
        &self.blocks
    }

    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        jacobian: Option<&mut Jacobian<'_>>,
    ) -> Result<(), Infeasible> {
        let between: [f64; 3] = std::array::from_fn(|k| x[1][k] - x[0][k]);
        let length = dot(between, between).sqrt();
        if length.is_nan() || length <= 0.0 {
            return Err(Infeasible);
        }
        residual[0] = (length - self.length_m) / self.sigma_m;
        if let Some(jacobian) = jacobian {
            let row = jacobian.row(0);
            for k in 0..3 {
                let slope = between[k] / (length * self.sigma_m);
                (row[k], row[3 + k]) = (-slope, slope);
            }
        }
        Ok(())
    }
}
