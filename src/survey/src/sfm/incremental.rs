//! Exterior orientation, image by image: three that fit start a block, then always those join that
//! are most compatible with it.
//!
//! What an image's pairs with the block predict for its rotation must agree among themselves, and
//! with what the points of the block that it sees say of its pose. After every round the new images
//! and what they see are adjusted, and everything whenever the block has grown by a fifth.

use super::{
    block::{Block, Features, Pair},
    bundle::BundleAdjustmentOptions,
    resection::{quaternion, resect},
    single_pair_registration,
    start::{Graph, MAX_CLOSURE_RAD, Triplet},
    tracks::Tracks,
    triangulate::TriangulationOptions,
};
use crate::{camera::Camera, scene::Pose};
use nalgebra::Matrix3;
use rayon::prelude::*;
use rowgram_optim::{engine::SolveError, geometry::rotation, nlls::Loss};

/// How blocks grow.
#[derive(Debug, Clone, PartialEq)]
pub struct IncrementalOptions {
    /// Distance up to which an image position belongs to a point, pixels.
    pub tolerance_px: f64,
    /// The least angle at which the rays of a point meet, radians.
    pub min_angle_rad: f64,
    /// The fewest points that an image must agree with.
    pub min_points: usize,
    /// Names of the lens parameters that are adjusted while the block grows.
    pub free: Vec<String>,
    /// Seed of all sampling.
    pub seed: u64,
}

impl Default for IncrementalOptions {
    fn default() -> IncrementalOptions {
        IncrementalOptions {
            tolerance_px: 4.0,
            min_angle_rad: 0.026,
            min_points: 15,
            free: ["f_px", "k1", "k2"].map(str::to_owned).to_vec(),
            seed: 1,
        }
    }
}

/// What happened to a block on its way.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// It began with these images.
    Started(Triplet),
    /// An image joined it: index, points that it saw and agreed with.
    Joined(usize, usize, usize),
    /// An image had to leave again.
    Left(usize),
    /// Images, points, reprojection error in pixels after an adjustment of everything.
    Adjusted(usize, usize, f64),
}

/// All blocks that the images fall into, the largest first; images that belong to none are in none.
///
/// # Errors
/// Where an adjustment cannot be evaluated.
pub fn reconstruct<'a>(
    features: &'a [Features],
    tracks: &'a Tracks,
    pairs: &[Pair],
    cameras: &[Camera],
    options: &IncrementalOptions,
    mut tell: impl FnMut(&Event),
) -> Result<Vec<Block<'a>>, SolveError> {
    let graph = Graph::new(features.len(), pairs);
    let mut allowed = vec![true; features.len()];
    let mut blocks: Vec<Block<'a>> = Vec::new();
    let mut cameras = cameras.to_vec();
    loop {
        let grown = Incremental {
            block: Block::new(features, tracks, &cameras),
            graph: &graph,
            options,
            allowed: &allowed,
            tell: &mut tell,
        };
        let Some(block) = grown.run()? else { break };
        for (image, pose) in block.poses.iter().enumerate() {
            allowed[image] &= pose.is_none();
        }
        // What the first block learnt of the lenses helps the next.
        if blocks.is_empty() {
            cameras.clone_from(&block.cameras);
        }
        blocks.push(block);
    }
    blocks.sort_by_key(|block| std::cmp::Reverse(block.registered()));
    Ok(blocks)
}

/// From how many images on lens parameters are adjusted.
const FREE_FROM: usize = 5;
/// The fewest images of a block.
const MIN_IMAGES: usize = 3;
/// How many starts are tried.
const MAX_STARTS: usize = 20;

struct Incremental<'a, 'b> {
    block: Block<'a>,
    graph: &'b Graph<'b>,
    options: &'b IncrementalOptions,
    allowed: &'b [bool],
    tell: &'b mut dyn FnMut(&Event),
}

impl<'a> Incremental<'a, '_> {
    fn demands(&self) -> TriangulationOptions {
        TriangulationOptions {
            tolerance_px: self.options.tolerance_px,
            min_angle_rad: self.options.min_angle_rad,
        }
    }

    fn refining(&self, iterations: u64) -> BundleAdjustmentOptions {
        BundleAdjustmentOptions { loss: Loss::SoftL1(1.0), iterations, cost_tolerance: 1e-4 }
    }

    fn run(mut self) -> Result<Option<Block<'a>>, SolveError> {
        let triplets = self.graph.triplets(self.block.tracks, self.block.features, self.allowed);
        for triplet in triplets.into_iter().take(MAX_STARTS) {
            if !self.start(&triplet)? {
                self.block.poses.fill(None);
                self.block.points.fill(None);
                self.block.used.fill(false);
                continue;
            }
            (self.tell)(&Event::Started(triplet));
            self.grow()?;
            let enough = self.block.registered() >= MIN_IMAGES;
            return Ok(enough.then_some(self.block));
        }
        Ok(None)
    }

    /// The pair of the three with the widest angle, then the third by what it sees.
    fn start(&mut self, triplet: &Triplet) -> Result<bool, SolveError> {
        let [a, b, c] = triplet.images;
        let mut order = [(a, b, c), (b, c, a), (a, c, b)];
        let worth = |x: u32, y: u32| {
            self.graph.pair(x, y).map_or(0.0, |p| p.angle_rad.min(0.3) * p.matches.len() as f64)
        };
        order.sort_by(|x, y| worth(y.0, y.1).total_cmp(&worth(x.0, x.1)));
        let (first, second, third) = order[0];
        let Some((turn, shift)) = self.graph.relative(first, second) else { return Ok(false) };
        self.block.poses[first as usize] =
            Some(Pose { rotation: rotation::IDENTITY, translation: [0.0; 3] });
        self.block.poses[second as usize] =
            Some(Pose { rotation: quaternion(&turn), translation: shift.into() });
        let tracks = self.block.tracks_of(&[first as usize, second as usize]);
        // The lens is not yet known: what is off by it must not be lost.
        let loose = TriangulationOptions {
            tolerance_px: 2.0 * self.options.tolerance_px,
            ..self.demands()
        };
        self.block.retriangulate(&tracks, &loose);
        let third = third as usize;
        let Some(pose) = self.judge().resection(third, 2.0) else { return Ok(false) };
        self.block.poses[third] = Some(pose.0);
        let three = [first as usize, second as usize, third];
        let tracks = self.block.tracks_of(&three);
        self.block.retriangulate(&tracks, &loose);
        self.block.adjust(None, &self.refining(30))?;
        let points = self.block.retriangulate(&tracks, &self.demands());
        self.block.adjust(None, &self.refining(20))?;
        Ok(points >= 2 * self.options.min_points
            && self.block.rms_px().0 < self.options.tolerance_px)
    }

    fn judge(&self) -> PoseVerifier<'_> {
        PoseVerifier { block: &self.block, graph: self.graph, options: self.options }
    }

    fn grow(&mut self) -> Result<(), SolveError> {
        let mut adjusted = 0;
        let mut failed = vec![0usize; self.block.poses.len()];
        let mut refused = vec![false; self.block.poses.len()];
        loop {
            let registered = self.block.registered();
            let judge = self.judge();
            let mut candidates: Vec<(f64, usize)> = (0..self.block.poses.len())
                .filter(|&k| self.allowed[k] && self.block.poses[k].is_none() && failed[k] < 2)
                .map(|k| (self.block.sight_count(k) as f64 * judge.rotation_consensus(k), k))
                .filter(|(worth, _)| *worth >= 0.5 * self.options.min_points as f64)
                .collect();
            candidates.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
            let Some(&(best, _)) = candidates.first() else {
                if self.register_from_single_pair(&mut refused)? {
                    continue;
                }
                break;
            };
            let most = (registered / 3).max(1);
            candidates.retain(|(worth, _)| *worth >= 0.6 * best);
            candidates.truncate(most);
            let found: Vec<Option<(Pose, usize, usize)>> =
                candidates.par_iter().map(|&(_, image)| judge.resection(image, 1.5)).collect();
            let mut joined = Vec::new();
            for (&(_, image), found) in candidates.iter().zip(found) {
                if let Some((pose, seen, inliers)) = found {
                    self.block.poses[image] = Some(pose);
                    joined.push(image);
                    (self.tell)(&Event::Joined(image, seen, inliers));
                } else {
                    failed[image] += 1;
                }
            }
            if joined.is_empty() {
                continue;
            }
            failed.fill(0);
            let tracks = self.block.tracks_of(&joined);
            self.block.retriangulate(&tracks, &self.demands());
            self.block.adjust(Some(&joined), &self.refining(8))?;
            self.block.retriangulate(&tracks, &self.demands());
            if 5 * self.block.registered() >= 6 * adjusted {
                self.adjust_global(false)?;
                adjusted = self.block.registered();
            }
        }
        self.adjust_global(true)
    }

    /// Registers an image from a single pair, if its matches agree; whether there was one.
    fn register_from_single_pair(&mut self, refused: &mut [bool]) -> Result<bool, SolveError> {
        for image in 0..self.block.poses.len() {
            if !self.allowed[image] || refused[image] || self.block.poses[image].is_some() {
                continue;
            }
            refused[image] = true;
            let Some(pose) =
                single_pair_registration::pose(&self.block, self.graph, self.options, image)
            else {
                continue;
            };
            let sights = self.block.sight_count(image);
            self.block.poses[image] = Some(pose);
            let tracks = self.block.tracks_of(&[image]);
            // The pair was found before the lens was.
            for looser in [8.0, 2.0, 1.0] {
                let tolerance_px = looser * self.options.tolerance_px;
                let demands = TriangulationOptions { tolerance_px, ..self.demands() };
                self.block.retriangulate(&tracks, &demands);
                self.block.adjust(Some(&[image]), &self.refining(12))?;
            }
            self.block.retriangulate(&tracks, &self.demands());
            let kept = |least: usize| {
                let used = |(track, place): &&(u32, u32)| {
                    self.block.used[*place as usize] && self.block.rays(*track as usize) >= least
                };
                self.block.tracks.in_image(image).iter().filter(used).count()
            };
            let (inliers, shared) = (kept(2), kept(3));
            let adjusted = self.block.poses[image].unwrap_or(pose);
            let (agree, all) = self.judge().agreement(image, &adjusted);
            if inliers >= 4 * self.options.min_points
                && shared >= single_pair_registration::FEWEST.max(sights.div_ceil(2))
                && 2 * agree >= all
            {
                (self.tell)(&Event::Joined(image, tracks.len(), inliers));
                return Ok(true);
            }
            self.block.forget(image);
            self.block.retriangulate(&tracks, &self.demands());
        }
        Ok(false)
    }

    /// Adjusts everything, and again where that has changed what belongs to what.
    fn adjust_global(&mut self, last: bool) -> Result<(), SolveError> {
        // Where nothing is named the cameras keep what they say themselves.
        if !self.options.free.is_empty() && self.block.registered() >= FREE_FROM {
            for camera in &mut self.block.cameras {
                // A model without one of these parameters goes without it.
                let names: Vec<&String> = self
                    .options
                    .free
                    .iter()
                    .filter(|name| camera.interior.model().place(name).is_some())
                    .collect();
                if camera.set_free(&names).is_err() {
                    camera.free.fill(false);
                }
            }
        }
        let tracks = self.block.all_tracks();
        let rounds = if last { 3 } else { 1 };
        for _ in 0..rounds {
            self.block.adjust(None, &self.refining(if last { 25 } else { 12 }))?;
            self.block.retriangulate(&tracks, &self.demands());
            self.filter_images();
        }
        let points = self.block.points.iter().flatten().count();
        let rms = self.block.rms_px().0;
        (self.tell)(&Event::Adjusted(self.block.registered(), points, rms));
        Ok(())
    }

    /// Images that have lost their points leave.
    fn filter_images(&mut self) {
        for image in 0..self.block.poses.len() {
            if self.block.poses[image].is_none() {
                continue;
            }
            let kept = self.block.tracks.in_image(image).iter();
            let kept = kept.filter(|(_, place)| self.block.used[*place as usize]).count();
            if kept < self.options.min_points {
                self.block.forget(image);
                (self.tell)(&Event::Left(image));
            }
        }
    }
}

/// What a block knows of images that are not in it.
struct PoseVerifier<'s> {
    block: &'s Block<'s>,
    graph: &'s Graph<'s>,
    options: &'s IncrementalOptions,
}

impl PoseVerifier<'_> {
    /// The pose of an image by what it sees of the block and by what its pairs say, with how many
    /// points it sees and agrees with.
    fn resection(&self, image: usize, looser: f64) -> Option<(Pose, usize, usize)> {
        let sights = self.block.sights(image);
        // Half as many are enough where a pair confirms them.
        let least = self.options.min_points.div_ceil(2);
        if sights.len() < least {
            return None;
        }
        let seed = self.options.seed ^ ((image as u64 + 1) << 20);
        let tolerance_px = looser * self.options.tolerance_px;
        let found = resect(&sights, self.block.lens(image), tolerance_px, seed)?;
        let inliers = found.inliers.len();
        if inliers < least || 4 * inliers < sights.len() {
            return None;
        }
        // The pairs have a say: more of them must agree with the pose than not, unless the points
        // are nearly unanimous.
        let (agree, all) = self.agreement(image, &found.model);
        if inliers < self.options.min_points && (agree == 0 || 2 * agree < all) {
            return None;
        }
        let unanimous = 10 * inliers >= 6 * sights.len() && inliers >= 3 * self.options.min_points;
        if all > 0 && 2 * agree < all && !unanimous {
            return None;
        }
        Some((found.model, sights.len(), inliers))
    }

    /// How many of an image's pairs with the block predict a rotation like that of a pose.
    fn agreement(&self, image: usize, pose: &Pose) -> (usize, usize) {
        let (mut agree, mut all) = (0, 0);
        for predicted in self.predictions(image) {
            all += 1;
            let turn = rotation::multiply(pose.rotation, rotation::inverse(predicted));
            let angle = rotation::log(turn).iter().map(|v| v * v).sum::<f64>().sqrt();
            agree += usize::from(angle < 3.0 * MAX_CLOSURE_RAD);
        }
        (agree, all)
    }

    /// The rotations that its pairs with the block predict.
    fn predictions(&self, image: usize) -> Vec<rotation::Quaternion> {
        let mut found = Vec::new();
        for &neighbour in self.graph.neighbours(image as u32) {
            let Some(pose) = self.block.poses[neighbour as usize] else { continue };
            let Some((turn, _)) = self.graph.relative(neighbour, image as u32) else { continue };
            found.push(rotation::multiply(quaternion(&turn), pose.rotation));
        }
        found
    }

    /// The share of the predictions that agree with the one that most agree with.
    fn rotation_consensus(&self, image: usize) -> f64 {
        let predictions = self.predictions(image);
        let matrices: Vec<Matrix3<f64>> = predictions
            .iter()
            .map(|q| Matrix3::from_fn(|i, j| rotation::matrix(*q)[i][j]))
            .collect();
        let near = |a: &Matrix3<f64>, b: &Matrix3<f64>| {
            let cosine = 0.5 * ((a.transpose() * b).trace() - 1.0);
            cosine.clamp(-1.0, 1.0).acos() < 2.0 * MAX_CLOSURE_RAD
        };
        let most = matrices
            .iter()
            .map(|a| matrices.iter().filter(|b| near(a, b)).count())
            .max()
            .unwrap_or(0);
        // One pair alone proves nothing, but is no contradiction either.
        (most as f64 + 0.5) / (matrices.len() as f64 + 0.5)
    }
}
