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
/// takes no part; points, images and cameras that this leaves without any measurement stay where they are.
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
    problem.problem.fix_unused();
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::{Camera, Interior, Lens, Model},
        scene::{Image, Observation, Pose, TiePoint},
    };

    #[test]
    fn what_has_lost_all_its_measurements_stays_and_ends_nothing() {
        let values = [480.0, 1.0, 299.5, 224.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let lens = Interior::new(Model::Brown, [600, 450], &values).unwrap();
        let mut scene = Reconstruction {
            cameras: vec![Camera::new("toy", lens)],
            tie_sigma_px: 0.5,
            ..Reconstruction::default()
        };
        for k in 0..4_u32 {
            scene.images.push(Image {
                name: format!("photo {k}"),
                id: k,
                camera: 0,
                pose: Pose::from_centre([1.0, 0.0, 0.0, 0.0], [2.0 * f64::from(k), 0.0, 12.0]),
                motion: [0.0; 6],
                expected_motion: [0.0; 6],
            });
        }
        let mut point = |position_m: [f64; 3]| {
            scene.points.push(TiePoint { id: 7, position_m, colour: [0; 3] });
            scene.points.len() as u32 - 1
        };
        let seen: Vec<(u32, [f64; 3])> = (0..25_u32)
            .map(|k| [f64::from(k % 5), f64::from(k / 5) - 2.0, 0.3 * f64::from(k % 3)])
            .map(|at| (point(at), at))
            .collect();
        // Above the photos: no step has put it there yet, but none can see it. The last photo has nothing else.
        let lost = point([2.0, 0.0, 30.0]);
        for (point, at) in seen {
            for image in 0..3 {
                let image_px = lens.project(scene.images[image].pose.to_camera(at)).unwrap();
                scene.observations.push(Observation { image: image as u32, point, image_px });
            }
        }
        for image in 0..4 {
            scene.observations.push(Observation { image, point: lost, image_px: [300.0, 200.0] });
        }
        scene.images[2].pose.translation[0] += 0.05;
        let before = scene.clone();
        let options =
            BundleAdjustmentOptions { loss: Loss::Trivial, iterations: 50, cost_tolerance: 1e-9 };
        let cost = bundle_adjust(&mut scene, 4, &options).unwrap();
        assert!(cost < 1e-6, "{cost}");
        for k in 0..3 {
            let [was, is] =
                [&before, &scene].map(|scene| scene.points[lost as usize].position_m[k]);
            assert!((was - is).abs() < 1e-9);
            let [was, is] = [&before, &scene].map(|scene| scene.images[3].pose.translation[k]);
            assert!((was - is).abs() < 1e-9);
        }
    }
}
