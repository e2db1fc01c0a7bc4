//! A reconstruction as a least-squares problem.

pub(super) use super::settings::{Group, Settings};
use super::{
    factors::{CameraPositionFactor, GroundPointFactor, ScaleBarFactor},
    reprojection::{DATA, LENS, Shutter, lens_block, lens_values},
};
use crate::camera::{Lens, Model};
use crate::scene::{Axes, Reconstruction, Role};
use rowgram_optim::{
    engine::SolveError,
    nlls::{
        BlockId, Euclidean, Factor, Factors, GaussianPrior, LeastSquares, Loss, Measurement,
        Problem, manifold,
    },
};

/// A reconstruction as a least-squares problem, and which block is what.
#[derive(Debug)]
pub struct AdjustmentProblem {
    /// The problem; its blocks start at the reconstruction's values.
    pub problem: Problem,
    pub(super) origin_m: [f64; 3],
    pub(super) lenses: Vec<BlockId>,
    pub(super) images: Vec<BlockId>,
    /// None for ground points that take no part.
    pub(super) ground: Vec<Option<BlockId>>,
    pub(super) points: Vec<BlockId>,
    /// Batches besides the tie points: group, name, the index of what each factor observes.
    pub(super) batches: Vec<(Group, String, Vec<usize>)>,
    /// What orientations of each camera have in common; none where it has none.
    pub(super) attitude_biases: Vec<Option<BlockId>>,
    pub(super) shutter: Shutter,
    /// Factor on the standard deviations of marks.
    pub(super) mark_sigma_factor: f64,
    scale_datum: Option<ScaleDatum>,
}

/// What holds the scale of a block with a minimal datum, beside its first image: one coordinate of another image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ScaleDatum {
    /// The image.
    pub image: usize,
    /// Which of the three coordinates of its translation.
    pub axis: usize,
}

impl ScaleDatum {
    /// The image farthest from the first, and the coordinate of its centre that points most away from there.
    fn choose(reconstruction: &Reconstruction) -> Option<ScaleDatum> {
        let from = reconstruction.images.first()?.pose.centre_m();
        let distance = |k: usize| -> f64 {
            let centre = reconstruction.images[k].pose.centre_m();
            (0..3).map(|axis| (centre[axis] - from[axis]).powi(2)).sum()
        };
        let image = (1..reconstruction.images.len())
            .max_by(|&a, &b| distance(a).total_cmp(&distance(b)))?;
        // Where the first centre is, seen from the farthest camera.
        let seen = reconstruction.images[image].pose.to_camera(from);
        let axis = (0..3).max_by(|&a, &b| seen[a].abs().total_cmp(&seen[b].abs())).unwrap_or(0);
        Some(ScaleDatum { image, axis })
    }
}

/// An image measurement: image, camera, data.
pub(super) fn measurement(
    reconstruction: &Reconstruction,
    image: u32,
    image_px: [f64; 2],
    sigma_px: f64,
) -> (usize, usize, [f64; DATA]) {
    let image = image as usize;
    let camera = reconstruction.images[image].camera;
    let centre = reconstruction.cameras[camera].interior.centre_px();
    let data = [
        image_px[0] - centre[0],
        image_px[1] - centre[1],
        1.0 / sigma_px,
        reconstruction.readout_share(image, image_px[1]),
    ];
    (image, camera, data)
}

impl AdjustmentProblem {
    /// Sets up the adjustment of a reconstruction that has been validated
    /// ([`super::validation::validate`]).
    ///
    /// # Errors
    /// [`SolveError::Misuse`] where the problem cannot be set up.
    pub fn new(
        reconstruction: &Reconstruction,
        settings: &Settings,
    ) -> Result<AdjustmentProblem, SolveError> {
        AdjustmentProblem::with_scale_datum(reconstruction, settings, None)
    }

    /// As [`AdjustmentProblem::new`], with the scale held as in another problem of the same images: the farthest image may
    /// be another one once all have moved, and covariances of two different data do not go together.
    ///
    /// # Errors
    /// As [`AdjustmentProblem::new`].
    pub fn with_scale_datum(
        reconstruction: &Reconstruction,
        settings: &Settings,
        datum: Option<ScaleDatum>,
    ) -> Result<AdjustmentProblem, SolveError> {
        let origin_m = reconstruction.origin_m();
        let mut local = reconstruction.clone();
        local.shift(origin_m);
        let mut adjustment = AdjustmentProblem {
            problem: Problem::new(),
            origin_m,
            lenses: Vec::new(),
            images: Vec::new(),
            ground: Vec::new(),
            points: Vec::new(),
            batches: Vec::new(),
            attitude_biases: Vec::new(),
            shutter: match reconstruction.rolling_shutter {
                Some(_) => Shutter::Rolling,
                None => Shutter::Global,
            },
            mark_sigma_factor: settings.factor(Group::Marks),
            scale_datum: None,
        };
        adjustment.add_images(&local, settings)?;
        adjustment.add_lenses(&local, settings)?;
        adjustment.add_ground(&local, settings)?;
        adjustment.add_tie_points(&local, settings)?;
        adjustment.add_motion(&local, settings)?;
        adjustment.add_orientations(&local, settings)?;
        if settings.minimal_datum {
            adjustment.hold_datum(datum.or_else(|| ScaleDatum::choose(&local)))?;
        }
        Ok(adjustment)
    }

    fn add_images(
        &mut self,
        reconstruction: &Reconstruction,
        settings: &Settings,
    ) -> Result<(), SolveError> {
        // A pose at rest has no motion behind it.
        let space =
            manifold::PoseWithParameters(if self.shutter == Shutter::Rolling { 3 } else { 0 });
        for image in &reconstruction.images {
            let mut values = image.pose.rotation.to_vec();
            values.extend(image.pose.translation);
            if self.shutter == Shutter::Rolling {
                values.extend(&image.motion[3..]);
            }
            self.images.push(self.problem.block("image", space, &values)?);
        }
        let factor = settings.factor(Group::Positions);
        let offset = self.position_offset(reconstruction, settings)?;
        let antennas = reconstruction.positions.iter().map(|position| CameraPositionFactor {
            blocks: std::iter::once(self.images[position.image as usize]).chain(offset).collect(),
            lever_arm_m: reconstruction.lever_arm_m,
            position_m: position.position_m,
            sigma_m: position.sigma_m.map(|sigma| sigma * factor),
        });
        let antennas = antennas.collect();
        let subjects = (0..reconstruction.positions.len()).collect();
        self.add(Group::Positions, "camera positions", antennas, subjects)
    }

    /// The offset of camera positions from control, along the axes that control knows.
    fn position_offset(
        &mut self,
        reconstruction: &Reconstruction,
        settings: &Settings,
    ) -> Result<Option<BlockId>, SolveError> {
        if !settings.position_offset || reconstruction.positions.is_empty() {
            return Ok(None);
        }
        let control = reconstruction.ground.iter().filter(|point| point.role == Role::Control);
        let known: Vec<usize> = control.flat_map(|point| point.axes.indices()).copied().collect();
        let held: Vec<usize> = (0..3).filter(|axis| !known.contains(axis)).collect();
        let block = self.problem.block("offset of camera positions", Euclidean(3), &[0.0; 3])?;
        self.problem.fix_entries(block, &held)?;
        Ok(Some(block))
    }

    fn add_lenses(
        &mut self,
        reconstruction: &Reconstruction,
        settings: &Settings,
    ) -> Result<(), SolveError> {
        for (index, camera) in reconstruction.cameras.iter().enumerate() {
            let corrected = settings.corrected_domain && camera.interior.model() == Model::Smac;
            let values = lens_block(&camera.interior, corrected);
            let block = self.problem.block("camera", Euclidean(LENS), &values)?;
            self.lenses.push(block);
            // Nothing says anything of a camera without images.
            let is_used = reconstruction.images.iter().any(|image| image.camera == index);
            let is_free = |k: usize| is_used && camera.free.get(k).copied().unwrap_or(false);
            let held: Vec<usize> = (0..LENS).filter(|&k| !is_free(k)).collect();
            self.problem.fix_entries(block, &held)?;
            if !is_used {
                continue;
            }
            let Some((places, covariance)) = camera.covariance() else { continue };
            // Only what is free needs a prior; what is held is known exactly.
            let free: Vec<usize> = (0..places.len()).filter(|&k| camera.free[places[k]]).collect();
            if free.is_empty() {
                continue;
            }
            let n = free.len();
            let factor = settings.factor(Group::Interior);
            let part: Vec<f64> = (0..n * n)
                .map(|k| covariance[(free[k / n], free[k % n])] * factor * factor)
                .collect();
            let now = camera.interior.values();
            let expected = camera.expected.as_deref().unwrap_or(now);
            let entries: Vec<usize> = free.iter().map(|&k| places[k]).collect();
            let expected: Vec<f64> =
                entries.iter().map(|&k| values[k] + (expected[k] - now[k])).collect();
            let known =
                GaussianPrior::with_covariance(&self.problem, block, &entries, &expected, &part)
                    .map_err(|error| {
                        SolveError::Misuse(format!("camera {:?}: {error}", camera.name))
                    })?;
            let name = format!("interior orientation {index}");
            self.add(Group::Interior, &name, vec![known], vec![index])?;
        }
        Ok(())
    }

    fn add_ground(
        &mut self,
        reconstruction: &Reconstruction,
        settings: &Settings,
    ) -> Result<(), SolveError> {
        for point in &reconstruction.ground {
            self.ground.push(match point.role {
                Role::Check => None,
                Role::Control | Role::Tie => {
                    Some(self.problem.block("ground point", Euclidean(3), &point.position_m)?)
                }
            });
        }
        let mut marks = Vec::new();
        let mut subjects = Vec::new();
        let factor = settings.factor(Group::Marks);
        for (k, mark) in reconstruction.marks.iter().enumerate() {
            if let Some(ground) = self.ground[mark.ground as usize] {
                let sigma_px = mark.sigma_px * factor;
                let (image, camera, data) =
                    measurement(reconstruction, mark.image, mark.image_px, sigma_px);
                marks.push(GroundPointFactor {
                    shutter: self.shutter,
                    blocks: [self.images[image], self.lenses[camera], ground],
                    data,
                });
                subjects.push(k);
            }
        }
        self.add(Group::Marks, "marks", marks, subjects)?;
        let factor = settings.factor(Group::Control);
        for (axes, name) in [
            (Axes::Xyz, "control coordinates"),
            (Axes::Xy, "control coordinates in plan"),
            (Axes::Z, "control heights"),
        ] {
            let mut subjects = Vec::new();
            let mut factors = Vec::new();
            for (k, point) in reconstruction.ground.iter().enumerate() {
                if let (Some(block), Role::Control) = (self.ground[k], point.role)
                    && point.axes == axes
                {
                    subjects.push(k);
                    let entries = axes.indices();
                    let of_axes = |v: [f64; 3]| entries.iter().map(|&k| v[k]).collect::<Vec<f64>>();
                    factors.push(GaussianPrior::of_entries(
                        &self.problem,
                        block,
                        entries,
                        &of_axes(point.position_m),
                        &of_axes(point.sigma_m.map(|sigma| sigma * factor)),
                    )?);
                }
            }
            self.add(Group::Control, name, factors, subjects)?;
        }
        let factor = settings.factor(Group::ScaleBars);
        let mut bars = Vec::new();
        let mut subjects = Vec::new();
        for (k, bar) in reconstruction.scale_bars.iter().enumerate() {
            if let [Some(a), Some(b)] = bar.ends.map(|end| self.ground[end as usize]) {
                bars.push(ScaleBarFactor {
                    blocks: [a, b],
                    length_m: bar.length_m,
                    sigma_m: bar.sigma_m * factor,
                });
                subjects.push(k);
            }
        }
        self.add(Group::ScaleBars, "scale bars", bars, subjects)
    }

    fn add_tie_points(
        &mut self,
        reconstruction: &Reconstruction,
        settings: &Settings,
    ) -> Result<(), SolveError> {
        for point in &reconstruction.points {
            let block = self.problem.block("tie point", Euclidean(3), &point.position_m)?;
            self.problem.eliminate(block);
            self.points.push(block);
        }
        if reconstruction.observations.is_empty() {
            return Ok(());
        }
        let sigma_px = reconstruction.tie_sigma_px * settings.factor(Group::TiePoints);
        let pairs: Vec<Measurement<DATA>> = reconstruction
            .observations
            .iter()
            .map(|o| {
                let (image, camera, data) =
                    measurement(reconstruction, o.image, o.image_px, sigma_px);
                let point = self.points[o.point as usize];
                Measurement::with_shared(self.images[image], self.lenses[camera], point, data)
            })
            .collect();
        let name = Group::TiePoints.name();
        self.shutter.add_measurements(&mut self.problem, name, settings.tie_loss, pairs)
    }

    fn add_motion(
        &mut self,
        reconstruction: &Reconstruction,
        settings: &Settings,
    ) -> Result<(), SolveError> {
        let Some(shutter) = reconstruction.rolling_shutter else { return Ok(()) };
        let sigma_m =
            shutter.sigma_velocity_m_s * shutter.readout_s * settings.factor(Group::Motion);
        let mut known = Vec::new();
        for (image, &block) in reconstruction.images.iter().zip(&self.images) {
            let expected = &image.expected_motion[3..];
            let prior = GaussianPrior::of_entries(
                &self.problem,
                block,
                &[6, 7, 8],
                expected,
                &[sigma_m; 3],
            )?;
            known.push(prior);
        }
        let subjects = (0..known.len()).collect();
        self.add(Group::Motion, "motion", known, subjects)
    }

    /// Holds the first image and one coordinate of another: position, orientation and scale of the block.
    fn hold_datum(&mut self, scale: Option<ScaleDatum>) -> Result<(), SolveError> {
        let Some(scale) = scale else { return Ok(()) };
        self.problem.fix_entries(self.images[0], &[0, 1, 2, 3, 4, 5])?;
        self.problem.fix_entries(self.images[scale.image], &[3 + scale.axis])?;
        self.scale_datum = Some(scale);
        Ok(())
    }

    /// What holds the scale of the block, where a minimal datum does.
    pub fn scale_datum(&self) -> Option<ScaleDatum> {
        self.scale_datum
    }

    pub(super) fn add<F: Factor + 'static>(
        &mut self,
        group: Group,
        name: &str,
        factors: Vec<F>,
        subjects: Vec<usize>,
    ) -> Result<(), SolveError> {
        if factors.is_empty() {
            return Ok(());
        }
        self.batches.push((group, name.to_owned(), subjects));
        self.problem.add(name, Loss::Trivial, Factors(factors))
    }

    /// Keeps the pose of an image as it is.
    ///
    /// # Errors
    /// [`SolveError::Misuse`] for an image that is not there.
    pub fn hold_image(&mut self, image: usize) -> Result<(), SolveError> {
        let block = self.images.get(image).copied();
        let block =
            block.ok_or_else(|| SolveError::Misuse(format!("there is no image {image}")))?;
        self.problem.fix_entries(block, &[0, 1, 2, 3, 4, 5])
    }

    /// The engine for it.
    pub fn engine(settings: &Settings) -> LeastSquares {
        LeastSquares::new(settings.engine())
    }

    /// Writes the values `x` into `reconstruction`, the one this came from. What was measured stays.
    pub fn update(&self, x: &[f64], reconstruction: &mut Reconstruction) {
        for (camera, &block) in reconstruction.cameras.iter_mut().zip(&self.lenses) {
            let values = lens_values(&camera.interior, self.problem.values(x, block));
            if let Ok(interior) = camera.interior.with_values(&values) {
                camera.interior = interior;
            }
        }
        let ground = |reconstruction: &Reconstruction| -> Vec<[f64; 3]> {
            reconstruction.ground.iter().map(|point| point.position_m).collect()
        };
        let (kept, positions) = (ground(reconstruction), reconstruction.positions.clone());
        reconstruction.shift(self.origin_m);
        for (image, &block) in reconstruction.images.iter_mut().zip(&self.images) {
            let v = self.problem.values(x, block);
            image.pose.rotation = [v[0], v[1], v[2], v[3]];
            image.pose.translation = [v[4], v[5], v[6]];
            if self.shutter == Shutter::Rolling {
                image.motion[3..].copy_from_slice(&v[7..]);
            }
        }
        for (point, &block) in reconstruction.points.iter_mut().zip(&self.points) {
            point.position_m.copy_from_slice(self.problem.values(x, block));
        }
        reconstruction.shift(self.origin_m.map(|v| -v));
        for (point, position_m) in reconstruction.ground.iter_mut().zip(kept) {
            point.position_m = position_m;
        }
        reconstruction.positions = positions;
    }

    /// Where the adjustment puts a ground point that took part, metres.
    pub fn ground_m(&self, x: &[f64], ground: usize) -> Option<[f64; 3]> {
        let values = self.problem.values(x, self.ground[ground]?);
        Some(std::array::from_fn(|k| values[k] + self.origin_m[k]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::{Camera, Interior},
        scene::{Image, Pose},
    };

    #[test]
    fn a_problem_of_the_same_images_can_hold_the_scale_as_another_did() {
        let values = [480.0, 1.0, 299.5, 224.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let lens = Interior::new(Model::Brown, [600, 450], &values).unwrap();
        let image = |x: f64| Image {
            name: format!("{x}"),
            id: 0,
            camera: 0,
            pose: Pose::from_centre([1.0, 0.0, 0.0, 0.0], [x, 0.0, 12.0]),
            motion: [0.0; 6],
            expected_motion: [0.0; 6],
        };
        let mut scene = Reconstruction {
            cameras: vec![Camera::new("toy", lens)],
            images: vec![image(0.0), image(10.0), image(10.1)],
            tie_sigma_px: 0.5,
            ..Reconstruction::default()
        };
        let settings = Settings { minimal_datum: true, ..Settings::default() };
        let started = AdjustmentProblem::new(&scene, &settings).unwrap();
        let datum = started.scale_datum();
        assert_eq!(datum, Some(ScaleDatum { image: 2, axis: 0 }));
        // The adjustment makes another image the farthest.
        scene.images[1] = image(10.3);
        let again = AdjustmentProblem::new(&scene, &settings).unwrap();
        assert_eq!(again.scale_datum(), Some(ScaleDatum { image: 1, axis: 0 }));
        let same = AdjustmentProblem::with_scale_datum(&scene, &settings, datum).unwrap();
        assert_eq!(same.scale_datum(), datum);
        let free = |problem: &AdjustmentProblem| problem.problem.parameter_count();
        assert_eq!(free(&same), free(&started));
    }
}
