//! Bundle adjustment on the way: the one place where a block, or a part of it, becomes a least-squares problem and takes
//! its solution back.

use super::block::Block;
use crate::{
    problems::adjustment::{AdjustmentProblem, Settings},
    scene::Reconstruction,
};
use rowgram_optim::{
    engine::SolveError,
    nlls::{Loss, Options as Engine, solve},
};

/// How a block is adjusted.
#[derive(Debug, Clone, PartialEq)]
pub struct BundleAdjustmentOptions {
    /// Robust loss, in pixels.
    pub loss: Loss,
    /// The most iterations.
    pub iterations: u64,
    /// Relative decrease that is no longer worth an iteration.
    pub cost_tolerance: f64,
}

/// Leaves out what cannot be evaluated where the block stands now: a point behind a camera, a mark whose ground point is.
/// The block keeps it, and its turn comes when it can be.
fn keep_feasible(scene: &mut Reconstruction) {
    let marks = std::mem::take(&mut scene.marks);
    let observations = std::mem::take(&mut scene.observations);
    scene.marks = marks
        .into_iter()
        .filter(|m| {
            let at = scene.ground[m.ground as usize].position_m;
            scene.is_feasible(m.image as usize, m.image_px, at)
        })
        .collect();
    scene.observations = observations
        .into_iter()
        .filter(|o| {
            let at = scene.points[o.point as usize].position_m;
            scene.is_feasible(o.image as usize, o.image_px, at)
        })
        .collect();
}

/// Adjusts a reconstruction whose images from `free` on are held; the final cost. What cannot be evaluated at the start
/// takes no part.
///
/// # Errors
/// Where it cannot be evaluated.
pub(super) fn bundle_adjust(
    scene: &mut Reconstruction,
    free: usize,
    options: &BundleAdjustmentOptions,
) -> Result<f64, SolveError> {
    keep_feasible(scene);
    let settings = Settings { tie_loss: options.loss, ..Settings::default() };
    let mut problem = AdjustmentProblem::new(scene, &settings)?;
    (free..scene.images.len()).try_for_each(|image| problem.hold_image(image))?;
    let engine = Engine { cost_tolerance: options.cost_tolerance, ..settings.engine() };
    let mut x = problem.problem.start();
    let summary = solve(&problem.problem, &mut x, &engine, options.iterations)?;
    problem.update(&x, scene);
    Ok(summary.final_cost)
}

impl Block<'_> {
    /// Adjusts the block, or some images and all points that they see while the other images that see
    /// them stand still.
    ///
    /// # Errors
    /// Where the block cannot be evaluated.
    pub fn adjust(
        &mut self,
        images: Option<&[usize]>,
        options: &BundleAdjustmentOptions,
    ) -> Result<(), SolveError> {
        let (mut scene, tracks, order) = self.reconstruction(images);
        if scene.images.len() < 2 || scene.points.is_empty() {
            return Ok(());
        }
        let free = images.map_or(scene.images.len(), |asked| {
            asked.iter().filter(|&&image| self.poses[image].is_some()).count()
        });
        if images.is_some() {
            scene.cameras.iter_mut().for_each(|camera| camera.free.fill(false));
        }
        bundle_adjust(&mut scene, free, options)?;
        self.take(&scene, &tracks, &order);
        Ok(())
    }

    /// Takes back what was adjusted of it: poses, motions, points, lenses.
    pub(super) fn take(&mut self, scene: &Reconstruction, tracks: &[u32], order: &[usize]) {
        for (image, &index) in scene.images.iter().zip(order) {
            self.poses[index] = Some(image.pose);
            self.motions[index] = image.motion;
        }
        for (point, &track) in scene.points.iter().zip(tracks) {
            self.points[track as usize] = Some(point.position_m);
        }
        for (camera, adjusted) in self.cameras.iter_mut().zip(&scene.cameras) {
            camera.interior = adjusted.interior;
        }
    }
}
