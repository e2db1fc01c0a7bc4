//! One block in its frame: rounds from loose to tight, the shutter, other tie points, outliers.

use super::{
    AdjustedBlock, BlockOptions, DatumInfo, Flight, MARK, Photos, SHUTTER, ShutterModel,
    determined::{keep_tied, snoop_determined},
    gsd_m,
    review::{self, mark_triangulation, name_wrong_marks, worst_control},
    triangulation,
};
use crate::{
    problems::adjustment::{DataSnoopingOptions, Group, Removed, Settings, retained_suspects},
    scene::{self, Role},
    sfm::{
        Block, Features,
        georeference::{self, Known, WrongMark, adjust, review_marks, weigh_positions},
        guided_matching::match_guided,
        longer_tracks::{MAX_RAYS, lengthen},
        refinement::{MIN_REFINED, refine_tie_points},
        rolling_shutter::{self, Update},
        tracks::Tracks,
        triangulate::TriangulationOptions,
    },
};
use rowgram_base::{
    error::Error,
    monitor::{Counter, Diagnostic, Monitor},
};
use rowgram_optim::nlls::Loss;
use std::collections::BTreeSet;

/// Pixels, on the ground or in a photo, that control, image measurements and camera positions may be off by without being
/// removed: what flights with a cheap lens leave at their borders.
const MIN_ERROR_PX: f64 = 6.0;
/// Control that is off by less than this many of its expected standard deviations may take part again.
const AS_EXPECTED: f64 = 3.0;
/// The most iterations of a round.
const ITERATIONS: u64 = 30;
/// The most iterations of a round by other tie points.
const REMATCHED_ITERATIONS: u64 = 12;

/// Control with standard deviations of at least `sigma_m`.
fn with_relaxed_sigmas(known: &Known, sigma_m: f64) -> Known {
    let mut known = known.clone();
    for point in &mut known.ground {
        point.sigma_m = point.sigma_m.map(|sigma| sigma.max(sigma_m));
    }
    known
}

/// One block in its frame, with everything that it is adjusted by.
pub(super) struct BlockAdjuster<'a> {
    pub(super) flight: &'a Flight<'a>,
    /// What is known, image measurements and coordinates as they are to be read, nothing rejected.
    pub(super) given: &'a Known,
    pub(super) photos: &'a Photos<'a>,
    pub(super) options: &'a BlockOptions,
    pub(super) datum: &'a DatumInfo,
}

impl BlockAdjuster<'_> {
    /// The adjusted block, and what was found on the way.
    pub(super) fn adjust(
        &self,
        block: Block<'_>,
        mut known: Known,
        monitor: &mut dyn Monitor,
    ) -> Result<(AdjustedBlock, Vec<Diagnostic>), Error> {
        // Tracks and features outlive the block over them.
        let (guided, refined);
        let mut block = block;
        let mut found = Vec::new();
        let mut sigma_px = self.settle(&mut block, &mut known, &mut found)?;
        if self.datum.georeferenced {
            self.model_shutter(&mut block, &mut known, &mut sigma_px, &mut found)?;
        }
        if self.options.guided_matching.applies(&known) {
            guided = self.match_again(&block, monitor);
            block = block.over(block.features, &guided);
            self.settle_rematched(&mut block, &known, &mut sigma_px, &mut found)?;
        }
        self.photos.descriptors.release();
        if self.options.refine_tie_points.applies(&known) {
            refined = self.refine(&block, &mut found, monitor)?;
            block = block.over(&refined.0, &refined.1);
            self.settle_rematched(&mut block, &known, &mut sigma_px, &mut found)?;
        }
        keep_tied(&mut block, &known, self.datum.georeferenced, &mut found);
        let said = found.len();
        let adjusted = self.reject_outliers(&block, &known, sigma_px, &mut found)?;
        let Some(known) = self.reconsidered(&mut block, &known, &adjusted) else {
            return Ok((adjusted, found));
        };
        let before = found.split_off(said);
        let limits = triangulation((6.0 * sigma_px).max(0.1 * self.options.tolerance_px));
        adjust(&mut block, &known, sigma_px, &limits, REMATCHED_ITERATIONS)?;
        let removed = adjusted.removed;
        let mut adjusted = self.reject_outliers(&block, &known, sigma_px, &mut found)?;
        // What was rejected and does not take part again stays rejected.
        let is_out = |name: &str| {
            let mut checks = known.ground.iter().filter(|point| point.role == Role::Check);
            checks.any(|point| name == format!("control point {}", point.name))
        };
        found.extend(before.into_iter().filter(|said| is_out(&said.subject)));
        let still = removed.into_iter().filter(|r| r.group == Group::Control && is_out(&r.name));
        adjusted.removed.splice(0..0, still);
        Ok((adjusted, found))
    }

    /// What is known with those control points and image measurements again that were rejected, and that the adjusted block
    /// would not reject; `None` where there are none. `block` gets the adjusted poses and lenses.
    ///
    /// Most is rejected while a block is still bent, or while something else that is wrong still bends it.
    fn reconsidered(
        &self,
        block: &mut Block<'_>,
        known: &Known,
        adjusted: &AdjustedBlock,
    ) -> Option<Known> {
        let mut again = known.clone();
        for point in &mut again.ground {
            let name = format!("control point {}", point.name);
            if adjusted.removed.iter().any(|removed| removed.name == name) {
                point.role = Role::Check;
            }
        }
        let adjusted = &adjusted.adjusted;
        let scene = &adjusted.reconstruction;
        let mut is_any = false;
        let least_m = MIN_ERROR_PX * gsd_m(scene);
        for check in &adjusted.check_points {
            let point = &scene.ground[check.ground];
            let was_control = |given: &&scene::GroundPoint| {
                given.name == point.name && given.role == Role::Control
            };
            // One ray fits wherever its photo is bent to.
            if check.rays < 2 || self.given.ground.iter().find(was_control).is_none() {
                continue;
            }
            let variance = adjusted.statistics.sigma0.powi(2);
            let (mut error, mut expected) = (0.0, 0.0);
            for &axis in point.axes.indices() {
                error += check.error_m[axis].powi(2);
                expected +=
                    variance * check.covariance_m2[axis][axis] + point.sigma_m[axis].powi(2);
            }
            if error.sqrt() > least_m.max(AS_EXPECTED * expected.sqrt()) {
                continue;
            }
            for known in again.ground.iter_mut().filter(|known| known.name == point.name) {
                known.role = Role::Control;
                is_any = true;
            }
        }
        let index = |image: &scene::Image| image.id.saturating_sub(1) as usize;
        let mut solved = block.clone();
        for image in &scene.images {
            solved.poses[index(image)] = Some(image.pose);
            solved.motions[index(image)] = image.motion;
        }
        for (camera, of) in solved.cameras.iter_mut().zip(&scene.cameras) {
            camera.interior = of.interior;
        }
        let limits =
            TriangulationOptions { tolerance_px: MIN_ERROR_PX, ..mark_triangulation(self.options) };
        let mut fitting = self.given.clone();
        let review = review_marks(&solved, &mut fitting, &[], false, &limits);
        let in_use: BTreeSet<(usize, &str)> = scene
            .marks
            .iter()
            .map(|mark| {
                let ground = scene.ground[mark.ground as usize].name.as_str();
                (index(&scene.images[mark.image as usize]), ground)
            })
            .collect();
        let is_used = |mark: &scene::GroundObservation| {
            let ground = self.given.ground[mark.ground as usize].name.as_str();
            in_use.contains(&(mark.image as usize, ground))
        };
        again.marks.retain(|mark| is_used(mark));
        for mark in &fitting.marks {
            let disagrees =
                |wrong: &&WrongMark| wrong.ground == mark.ground && wrong.error_px.is_infinite();
            let oriented = solved.poses[mark.image as usize].is_some();
            if oriented && !is_used(mark) && review.wrong.iter().find(disagrees).is_none() {
                again.marks.push(*mark);
                is_any = true;
            }
        }
        if !is_any {
            return None;
        }
        *block = solved;
        Some(again)
    }

    /// Rounds from loose to tight; the robust standard deviation of an image coordinate, pixels.
    fn settle(
        &self,
        block: &mut Block<'_>,
        known: &mut Known,
        found: &mut Vec<Diagnostic>,
    ) -> Result<f64, Error> {
        let tolerance_px = self.options.tolerance_px;
        let mut sigma_px: f64 = 1.0;
        let mut last_fit = None;
        let positions = known.positions.clone();
        for round in 0..4 {
            if self.datum.georeferenced && !positions.is_empty() {
                // What a bent block rejects may fit a straight one.
                known.positions.clone_from(&positions);
                last_fit = weigh_positions(block, known, &self.datum.position_sigmas);
            }
            let widest_px = if round == 0 { 2.0 * tolerance_px } else { tolerance_px };
            let limits = triangulation((6.0 * sigma_px).max(0.1 * tolerance_px).min(widest_px));
            // A free block is bent: control first draws it gently into shape, and what then still does not fit is wrong,
            // before the rest is taken at its word.
            let gentle = [1.0, 0.1, 0.01, 0.0][round] * self.datum.max_control_misfit_m;
            adjust(block, &with_relaxed_sigmas(known, gentle), sigma_px, &limits, ITERATIONS)?;
            while round < 3
                && let Some((index, left)) = worst_control(block, known, gentle)
            {
                known.ground[index].role = Role::Check;
                let subject = format!("control point {}", known.ground[index].name);
                let message = format!(
                    "its coordinates are {left:.2} m from where the block puts it; it is not used as control"
                );
                let diagnostic = Diagnostic::warning("control-rejected", subject, message);
                found.push(diagnostic.with_remedy("check its coordinates and its marks"));
                adjust(block, &with_relaxed_sigmas(known, gentle), sigma_px, &limits, ITERATIONS)?;
            }
            sigma_px = block.robust_sigma_px().max(0.05);
        }
        if let Some(fit) = last_fit {
            found.extend(review::rejected_positions(&fit, block.features));
            found.extend(review::exceeded_accuracy(&fit, &self.datum.position_sigmas));
        }
        Ok(sigma_px)
    }

    /// A rolling shutter, where there is one: estimated, believed where it explains much, and then everything is adjusted
    /// again.
    fn model_shutter(
        &self,
        block: &mut Block<'_>,
        known: &mut Known,
        sigma_px: &mut f64,
        found: &mut Vec<Diagnostic>,
    ) -> Result<(), Error> {
        let (readout_s, certain) = match self.options.shutter {
            ShutterModel::Global => return Ok(()),
            ShutterModel::Auto(seconds) => (seconds, false),
            ShutterModel::Rolling(seconds) => (seconds, true),
        };
        let order = self.flight.order;
        let estimate =
            rolling_shutter::estimate(block, known, order, *sigma_px, readout_s, certain)?;
        let Some(estimate) = estimate else {
            if certain {
                let message =
                    "too few photos on straight strips to tell how they moved: not modelled";
                found.push(Diagnostic::warning(
                    "rolling-shutter-unknown",
                    "rolling shutter",
                    message,
                ));
            }
            return Ok(());
        };
        estimate.apply(block);
        found.push(review::shutter(&estimate, self.options.shutter));
        // Marks that were off by what the shutter does are right after all.
        found.retain(|diagnostic| diagnostic.code != MARK);
        known.marks.clone_from(&self.given.marks);
        let limits = mark_triangulation(self.options);
        let review = review_marks(block, known, &[], false, &limits);
        name_wrong_marks(&review, known, block.features, found);
        for factor in [2.0, 1.0, 1.0] {
            let tolerance_px = (6.0 * factor * *sigma_px).max(0.1 * self.options.tolerance_px);
            adjust(block, known, *sigma_px, &triangulation(tolerance_px), ITERATIONS)?;
            *sigma_px = block.robust_sigma_px().max(0.05);
        }
        Ok(())
    }

    /// The tracks of all that the block now tells.
    fn match_again(&self, block: &Block<'_>, monitor: &mut dyn Monitor) -> Tracks {
        let counter = Counter::new(monitor, "guided matching", None, "pairs");
        let &Photos { descriptors, matched, .. } = self.photos;
        let found = match_guided(block, descriptors, matched, &|_| counter.tick());
        let pairs = found.iter().map(|pair| (pair.images, pair.matches.as_slice()));
        Tracks::of_pairs(block.features, pairs)
            .thinned(block.features, self.options.max_tie_observations)
    }

    /// Its tie points, measured again in the photos: features and tracks.
    fn refine(
        &self,
        block: &Block<'_>,
        found: &mut Vec<Diagnostic>,
        monitor: &mut dyn Monitor,
    ) -> Result<(Vec<Features>, Tracks), Error> {
        let counter =
            Counter::new(monitor, "refining tie points", 2 * block.features.len(), "photos");
        let longer = lengthen(block, MAX_RAYS);
        let mut block = block.over(&longer.features, &longer.tracks);
        georeference::retriangulate_and_filter(
            &mut block,
            &triangulation(self.options.tolerance_px),
        );
        let (measured, tell) = (longer.measured.as_slice(), &|| counter.tick());
        let refined = refine_tie_points(&block, measured, self.photos.read, tell)?;
        tracing::debug!(
            "{} pairs of tracks are one, {} of {} places in further photos measured",
            longer.joined,
            refined.further,
            longer.predicted
        );
        found.extend(refined.kept.iter().map(|(image, count)| {
            let message = format!(
                "fewer than {MIN_REFINED} of its tie points were refined by least-squares matching; {count} keep the less exact positions of their features"
            );
            let subject = block.features[*image as usize].name.as_str();
            Diagnostic::warning("tie-points-not-refined", subject, message)
        }));
        let pairs = refined.matches.iter().map(|pair| (pair.images, pair.matches.as_slice()));
        let tracks = Tracks::of_pairs(&refined.features, pairs)
            .thinned(&refined.features, self.options.max_tie_observations);
        Ok((refined.features, tracks))
    }

    /// The block by other tracks, adjusted; its rolling shutter is estimated anew, or taken back where these do not bear it out.
    ///
    /// Some matches are wrong, and lie anywhere within the tolerance: cut off close to the block, they hold it where it was.
    /// So the tolerance is a wide one until the block has converged.
    fn settle_rematched(
        &self,
        block: &mut Block<'_>,
        known: &Known,
        sigma_px: &mut f64,
        found: &mut Vec<Diagnostic>,
    ) -> Result<(), Error> {
        let tolerance_px = self.options.tolerance_px;
        let mut settle = |block: &mut Block<'_>, within_px: f64| -> Result<f64, Error> {
            adjust(block, known, *sigma_px, &triangulation(within_px), REMATCHED_ITERATIONS)?;
            *sigma_px = block.robust_sigma_px().max(0.05);
            Ok(*sigma_px)
        };
        georeference::retriangulate_and_filter(block, &triangulation(tolerance_px));
        let sigma = settle(block, tolerance_px)?;
        let certain = matches!(self.options.shutter, ShutterModel::Rolling(_));
        match rolling_shutter::update(block, known, self.flight.order, sigma, certain)? {
            Update::Rolling(estimate) => {
                estimate.apply(block);
                let mut said = found.iter_mut();
                if let Some(said) = said.rfind(|diagnostic| diagnostic.code == SHUTTER) {
                    *said = review::shutter(&estimate, self.options.shutter);
                }
            }
            Update::Global => {
                rolling_shutter::remove(block);
                found.retain(|diagnostic| diagnostic.code != SHUTTER);
            }
            Update::Unknown => {}
        }
        let sigma = settle(block, tolerance_px)?;
        settle(block, (6.0 * sigma).clamp(0.1 * tolerance_px, tolerance_px))?;
        Ok(())
    }

    /// The last adjustment, from which suspect observations are removed one after the other.
    fn reject_outliers(
        &self,
        block: &Block<'_>,
        known: &Known,
        sigma_px: f64,
        found: &mut Vec<Diagnostic>,
    ) -> Result<AdjustedBlock, Error> {
        let (mut scene, _, order) = block.reconstruction(None);
        known.attach(&mut scene, &order);
        scene.tie_sigma_px = sigma_px;
        // The camera of photos that are not in the block has nothing to be estimated from.
        for camera in 0..scene.cameras.len() {
            if scene.images.iter().all(|image| image.camera != camera) {
                scene.cameras[camera].free.fill(false);
            }
        }
        let was_check = |name: &String| {
            let mut given = self.flight.known.ground.iter();
            given.any(|point| point.name == *name && point.role == Role::Check)
        };
        let checks = scene.ground.iter().filter(|point| point.role == Role::Check);
        let checks = checks.map(|point| point.name.clone()).filter(was_check).collect();
        // Without a mapping frame the first photo and the distance to the farthest one are the frame.
        let minimal_datum = !self.datum.georeferenced;
        let mut settings = Settings {
            tie_loss: Loss::SoftL1(2.0),
            minimal_datum,
            position_offset: self.datum.position_offset,
            ..Settings::default()
        };
        let snooping = DataSnoopingOptions {
            rounds: 8,
            least_error_m: MIN_ERROR_PX * gsd_m(&scene),
            least_error_px: MIN_ERROR_PX,
            keep: known.keep.clone(),
            ..DataSnoopingOptions::default()
        };
        let snooped = snoop_determined(&mut scene, &mut settings, &snooping, found)?;
        for removed in snooped.removed.iter().filter(|removed| removed.group != Group::TiePoints) {
            let message = format!(
                "the rest of the block puts it {} away ({:.1} times the critical value); removed",
                distance(removed),
                removed.excess
            );
            found.push(Diagnostic::warning("observation-rejected", removed.name.as_str(), message));
        }
        for doubt in retained_suspects(&snooped.adjusted, &settings, &snooping) {
            let message = format!(
                "the rest of the block puts it {} away, more than its accuracy says ({:.1} times the critical value); kept",
                distance(&doubt),
                doubt.excess
            );
            found.push(Diagnostic::warning("observation-retained", doubt.name.as_str(), message));
        }
        Ok(AdjustedBlock {
            adjusted: snooped.adjusted,
            settings: Settings { tie_loss: Loss::Trivial, ..settings },
            alignment: None,
            removed: snooped.removed,
            complete: snooped.complete,
            georeferenced: self.datum.georeferenced,
            fragments: Vec::new(),
            checks,
            orientations: None,
            diagnostics: Vec::new(),
        })
    }
}

/// How far off something is, in its unit.
fn distance(removed: &Removed) -> String {
    let distance = removed.error.iter().map(|e| e * e).sum::<f64>().sqrt();
    if removed.group == Group::Marks {
        format!("{distance:.1} px")
    } else {
        format!("{distance:.3} m")
    }
}
