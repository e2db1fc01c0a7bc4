//! A block with what is known on the ground and in the air: rounds from loose to tight, a rolling shutter where there is
//! one, guided matching, tie points refined by least-squares matching, and what of it all cannot be right.
//!
//! The strategy, in memory: [`adjust_blocks`] is all of it, from blocks in frames of their own to one adjusted block in
//! the mapping frame. What is found on the way is a [`Diagnostic`].

use super::{
    Block, Features, Pair,
    georeference::{
        self, Joined, Known, adjust, axes_exchanged, join, review_marks, weigh_positions,
    },
    guided_matching::{GuidedMatchingOptions, match_guided},
    incremental::IncrementalOptions,
    refinement::{LeastSquaresMatchingOptions, MIN_REFINED, refine_tie_points},
    rolling_shutter::{self, RollingShutterEstimate},
    tracks::Tracks,
    triangulate::TriangulationOptions,
    verify::PairMatches,
};
use crate::{
    camera::Lens,
    error::Error,
    features::Descriptors,
    monitor::{Counter, Diagnostic, Monitor},
    nlls::Loss,
    problems::adjustment::{
        Adjusted, Alignment, DataSnoopingOptions, Group, Removed, Settings, retained_suspects,
        snoop,
    },
    scene::{Reconstruction, Role},
};
use image::GrayImage;
use serde::{Deserialize, Serialize};

/// Whether something that takes time is done.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum When {
    /// Where there is ground control, which says that coordinates matter.
    #[default]
    Auto,
    /// In any case.
    On,
    /// Never.
    Off,
}

crate::choices!(When: Auto, On, Off);

impl When {
    /// Whether it is done for a block with this control.
    pub fn applies(self, known: &Known) -> bool {
        match self {
            When::Auto => known.has_control(),
            When::On => true,
            When::Off => false,
        }
    }
}

/// Whether rows are read one after the other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ShutterModel {
    /// It is found out; the time from the first to the last row, seconds.
    Auto(f64),
    /// All rows are read at once.
    Global,
    /// One after the other; the time from the first to the last row, seconds.
    Rolling(f64),
}

/// A readout time where nobody has told it, seconds: it only turns displacements into velocities.
pub const USUAL_READOUT_S: f64 = 0.03;

/// How a block is adjusted.
#[derive(Debug, Clone, PartialEq)]
pub struct BlockOptions {
    /// Distance from the projection of its point up to which an image position is used, pixels.
    pub tolerance_px: f64,
    /// Whether the shutter rolls.
    pub shutter: ShutterModel,
    /// Whether the adjusted block is used to find more matches.
    pub guided_matching: When,
    /// Whether tie points are measured again by least-squares matching.
    pub refine_tie_points: When,
    /// Lens parameters to adjust; all but the aspect and rational terms where not set.
    pub free: Option<Vec<String>>,
    /// Whether the cameras are calibrated: then what they say themselves is free.
    pub calibrated: bool,
}

/// What is known of a flight beforehand; images by their index in the block.
#[derive(Debug, Clone, Copy)]
pub struct Flight<'a> {
    /// Ground points, image measurements and camera positions as they were given.
    pub known: &'a Known,
    /// The images in the order in which they were taken.
    pub order: &'a [usize],
    /// For each image whether the accuracy of its position was given.
    pub has_position_sigma: &'a [bool],
    /// Sizes of images that image measurements may have been made in, relative to the photos.
    pub mark_scales: &'a [f64],
}

/// The photos themselves.
#[derive(Clone, Copy)]
pub struct Photos<'a> {
    /// Descriptors of the features of each.
    pub descriptors: &'a [&'a Descriptors],
    /// Descriptor matches, by images.
    pub matched: &'a [PairMatches],
    /// Reads one.
    pub read: &'a (dyn Fn(usize) -> Result<GrayImage, Error> + Sync),
}

/// Where the frame of a block comes from.
struct DatumInfo {
    georeferenced: bool,
    /// Standard deviations of camera positions that were given, image by image.
    position_sigmas: Vec<Option<[f64; 3]>>,
    /// What control is off by at most before it is adjusted, metres.
    max_control_misfit_m: f64,
}

/// An adjusted block.
#[derive(Debug)]
pub struct AdjustedBlock {
    /// The adjustment, what took part and what did not.
    pub adjusted: Adjusted,
    /// How it was adjusted.
    pub settings: Settings,
    /// How the largest block came into the mapping frame.
    pub alignment: Option<Alignment>,
    /// Observations that were removed.
    pub removed: Vec<Removed>,
    /// Whether nothing is suspect any more.
    pub complete: bool,
    /// Whether the frame is a mapping frame.
    pub georeferenced: bool,
    /// The blocks that came in: names of their images, and whether they are part of it.
    pub fragments: Vec<(Vec<String>, bool)>,
    /// Names of check points that were given as such, not those that control was made into.
    pub checks: Vec<String>,
    /// What was found.
    pub diagnostics: Vec<Diagnostic>,
}

/// Pixels, on the ground or in a photo, that control, image measurements and camera positions may be off by without being
/// removed: what flights with a cheap lens leave at their borders.
const MIN_ERROR_PX: f64 = 6.0;
/// Control that is this many times as far off as half of it is wrong.
const GROSS_ERROR_RATIO: f64 = 8.0;
/// Fewer images than this do not determine a whole lens.
const MIN_IMAGES_FOR_WHOLE_LENS: usize = 6;
/// A difference of heights beyond this is one of vertical datums, metres.
const DATUM_DIFFERENCE_M: f64 = 10.0;
/// The most iterations of a round.
const ITERATIONS: u64 = 30;
/// The most iterations of a round by other tie points.
const REMATCHED_ITERATIONS: u64 = 12;

/// Codes of diagnostics that a later step may take back.
const MARK: &str = "mark-rejected";
const SHUTTER: &str = "rolling-shutter";

/// Brings blocks into the mapping frame, makes them one, adjusts it and finds what cannot be right.
///
/// Without ground control and camera positions the largest block is adjusted in a frame of its own.
///
/// # Errors
/// [`Error::Incomplete`] where there is no block; a block that cannot be evaluated; a photo that cannot be read any more.
pub fn adjust_blocks(
    blocks: Vec<Block<'_>>,
    flight: &Flight<'_>,
    photos: &Photos<'_>,
    options: &BlockOptions,
    monitor: &mut dyn Monitor,
) -> Result<AdjustedBlock, Error> {
    let mut known = flight.known.clone();
    let mut found = Vec::new();
    let mut fragments: Vec<(Vec<String>, bool)> =
        blocks.iter().map(|block| (block.image_names(), false)).collect();
    if let Some(largest) = blocks.first() {
        review(largest, &mut known, flight, options, &mut found);
    }
    name_scarcely_marked(&blocks, &known, &mut found);
    let Some(Joined { mut block, alignments, georeferenced, position_shift_m }) =
        join(blocks, &mut known, &triangulation(3.0 * options.tolerance_px))
    else {
        return Err(Error::Incomplete(
            "no three photos could be oriented together: look at the matches (rowgram align --until match), or give the camera (--camera)".into(),
        ));
    };
    for (k, alignment) in alignments.iter().enumerate() {
        fragments[k].1 = alignment.is_some() || !georeferenced && k == 0;
    }
    found.extend(position_shift_m.filter(|_| !known.positions.is_empty()).map(position_shift));
    prepare_cameras(&mut block, georeferenced, options)?;
    let mut position_sigmas = vec![None; flight.has_position_sigma.len()];
    for position in &flight.known.positions {
        let image = position.image as usize;
        position_sigmas[image] = flight.has_position_sigma[image].then_some(position.sigma_m);
    }
    let by_control =
        alignments.iter().flatten().filter(|alignment| alignment.by == "control points");
    let max_control_misfit_m = by_control.map(control_misfit_m).fold(0.0, f64::max);
    let datum = DatumInfo { georeferenced, position_sigmas, max_control_misfit_m };
    let adjuster = BlockAdjuster { flight, photos, options, datum: &datum };
    let (mut adjusted, mut more) = adjuster.adjust(block.clone(), known.clone(), monitor)?;
    let wrong: Vec<Removed> =
        adjusted.removed.iter().filter(|r| r.group == Group::Control).cloned().collect();
    if !wrong.is_empty() {
        // All that was found with it in leaned on it, a shutter that seems to roll above all.
        let named = |subject: &str| wrong.iter().any(|removed| removed.name == subject);
        found.extend(more.into_iter().filter(|diagnostic| named(&diagnostic.subject)));
        for point in &mut known.ground {
            if named(&format!("control point {}", point.name)) {
                point.role = Role::Check;
            }
        }
        (adjusted, more) = adjuster.adjust(block, known, monitor)?;
        adjusted.removed.splice(0..0, wrong);
    }
    found.extend(more);
    Ok(AdjustedBlock {
        alignment: alignments.into_iter().flatten().next(),
        fragments,
        diagnostics: found,
        ..adjusted
    })
}

/// What control is off by at most after a similarity, but for the worst of it, metres.
fn control_misfit_m(alignment: &Alignment) -> f64 {
    let mut left: Vec<f64> = alignment.misfits.iter().map(|(_, left)| *left).collect();
    left.extend(std::iter::repeat_n(alignment.rmse_m, alignment.used.len()));
    left.sort_by(f64::total_cmp);
    left.get(left.len() * 3 / 4).copied().unwrap_or(0.0)
}

fn position_shift([x, y, z]: [f64; 3]) -> Diagnostic {
    let message = format!(
        "they are offset from the control by {x:+.2} {y:+.2} {z:+.2} m (easting, northing, height); the offset was removed"
    );
    if z.abs() > DATUM_DIFFERENCE_M {
        let message =
            format!("{message}; heights that differ by so much have different vertical datums");
        return Diagnostic::warning("vertical-datum", "camera positions", message);
    }
    Diagnostic::info("position-offset", "camera positions", message)
}

/// What rays must be like.
fn triangulation(tolerance_px: f64) -> TriangulationOptions {
    let min_angle_rad = IncrementalOptions::default().min_angle_rad;
    TriangulationOptions { tolerance_px, min_angle_rad }
}

/// What image measurements of one ground point must be like: a free block is bent, but not within the few photos of one.
fn mark_triangulation(options: &BlockOptions) -> TriangulationOptions {
    TriangulationOptions { tolerance_px: 3.0 * options.tolerance_px, min_angle_rad: 0.01 }
}

/// Ground points that do little or nothing for want of image measurements.
fn name_scarcely_marked(blocks: &[Block<'_>], known: &Known, found: &mut Vec<Diagnostic>) {
    for (ground, point) in known.ground.iter().enumerate() {
        let oriented = |image: u32| {
            blocks.iter().any(|block| block.poses.get(image as usize).is_some_and(Option::is_some))
        };
        let marks = known.marks.iter().filter(|mark| mark.ground as usize == ground);
        let message = match marks.filter(|mark| oriented(mark.image)).count() {
            0 => "it is measured in no oriented photo: it takes no part",
            1 => "it is measured in one oriented photo only: two at least fix its place",
            _ => continue,
        };
        let subject = format!("ground point {}", point.name);
        found.push(Diagnostic::warning("scarcely-measured", subject, message));
    }
}

/// Image measurements and coordinates that cannot be as they are.
fn review(
    block: &Block<'_>,
    known: &mut Known,
    flight: &Flight<'_>,
    options: &BlockOptions,
    found: &mut Vec<Diagnostic>,
) {
    if known.marks.is_empty() {
        return;
    }
    let review = review_marks(block, known, flight.mark_scales, &mark_triangulation(options));
    if review.scale != 1.0 {
        let message = format!(
            "they fit the photos only when multiplied by {}: they were made in resized images, and were converted",
            review.scale
        );
        found.push(Diagnostic::warning("marks-resized", "marks", message));
    }
    name_wrong_marks(&review, known, block.features, found);
    if axes_exchanged(block, known) {
        known.ground.iter_mut().for_each(|point| point.position_m.swap(0, 1));
        let message = "X and Y are exchanged: as given they would turn the block upside down; they were swapped";
        found.push(Diagnostic::warning("axes-exchanged", "control points", message));
    }
}

fn name_wrong_marks(
    review: &georeference::MarkReview,
    known: &Known,
    images: &[Features],
    found: &mut Vec<Diagnostic>,
) {
    for wrong in &review.wrong {
        let point = &known.ground[wrong.ground as usize].name;
        let subject = format!("mark of {point} in {}", images[wrong.image as usize].name);
        let message = if wrong.error_px.is_finite() {
            format!(
                "it is {:.0} px from where the other marks of the point put it; removed",
                wrong.error_px
            )
        } else {
            "no two marks of the point agree".to_owned()
        };
        found.push(Diagnostic::warning(MARK, subject, message));
    }
}

/// What of the lenses the last adjustment frees, and what is known of them beforehand.
fn prepare_cameras(
    block: &mut Block<'_>,
    georeferenced: bool,
    options: &BlockOptions,
) -> Result<(), Error> {
    let images = block.registered();
    for camera in &mut block.cameras {
        let model = camera.interior.model();
        let names: Vec<String> = match &options.free {
            Some(names) => names.clone(),
            None if options.calibrated => {
                let free = camera.free.iter().zip(model.parameters()).filter(|(free, _)| **free);
                free.map(|(_, parameter)| parameter.name.to_owned()).collect()
            }
            None => super::intrinsics::estimable(model, images >= MIN_IMAGES_FOR_WHOLE_LENS),
        };
        camera.set_free(&names).map_err(|e| Error::Argument(format!("free: {e}")))?;
        if options.calibrated {
            continue;
        }
        let larger = f64::from(camera.interior.size_px()[0].max(camera.interior.size_px()[1]));
        let parameters = camera.interior.parameters();
        for (k, parameter) in parameters.iter().enumerate() {
            camera.standard_deviations[k] = match parameter.name {
                "f_px" | "c_px" if !georeferenced => {
                    // A block of its own has found it better than the files told it, where they did.
                    let c = camera.interior.principal_distance_px();
                    if let Some(expected) = &mut camera.expected {
                        expected[k] = c;
                    }
                    Some(0.1 * c)
                }
                "cx_px" | "cy_px" | "xp_px" | "yp_px" => Some(0.02 * larger),
                _ => None,
            };
        }
    }
    Ok(())
}

/// Control with standard deviations of at least `sigma_m`.
fn with_relaxed_sigmas(known: &Known, sigma_m: f64) -> Known {
    let mut known = known.clone();
    for point in &mut known.ground {
        point.sigma_m = point.sigma_m.map(|sigma| sigma.max(sigma_m));
    }
    known
}

/// The control point that the block contradicts most, and by how many metres.
fn worst_control(block: &Block<'_>, known: &Known, sigma_m: f64) -> Option<(usize, f64)> {
    let left = georeference::control_left_m(block, known);
    if left.len() < 4 {
        return None;
    }
    let mut sorted: Vec<f64> = left.iter().map(|(_, left)| *left).collect();
    sorted.sort_by(f64::total_cmp);
    let half = sorted[sorted.len() / 2];
    let (index, most) = left.into_iter().max_by(|a, b| a.1.total_cmp(&b.1))?;
    let given = known.ground[index].sigma_m.iter().copied().fold(0.0, f64::max);
    let is_gross = most > GROSS_ERROR_RATIO * half && most > GROSS_ERROR_RATIO * given;
    (is_gross && most > sigma_m).then_some((index, most))
}

/// One block in its frame, with everything that it is adjusted by.
struct BlockAdjuster<'a> {
    flight: &'a Flight<'a>,
    photos: &'a Photos<'a>,
    options: &'a BlockOptions,
    datum: &'a DatumInfo,
}

impl BlockAdjuster<'_> {
    fn adjust(
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
        if self.options.refine_tie_points.applies(&known) {
            refined = self.refine(&block, &mut found, monitor)?;
            block = block.over(&refined.0, &refined.1);
            self.settle_rematched(&mut block, &known, &mut sigma_px, &mut found)?;
        }
        let adjusted = self.reject_outliers(&block, &known, sigma_px, &mut found)?;
        Ok((adjusted, found))
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
        for round in 0..4 {
            if self.datum.georeferenced && !known.positions.is_empty() {
                let fit = weigh_positions(block, known, &self.datum.position_sigmas);
                for (image, distance) in fit.iter().flat_map(|fit| &fit.outliers) {
                    let subject = block.features[*image as usize].name.as_str();
                    let message = format!(
                        "its camera position is {distance:.1} m from where the block puts it; the position is not used"
                    );
                    found.push(Diagnostic::warning("position-rejected", subject, message));
                }
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
        found.push(self.shutter_diagnostic(&estimate));
        // Marks that were off by what the shutter does are right after all.
        found.retain(|diagnostic| diagnostic.code != MARK);
        known.marks.clone_from(&self.flight.known.marks);
        let limits = mark_triangulation(self.options);
        let review = review_marks(block, known, self.flight.mark_scales, &limits);
        name_wrong_marks(&review, known, block.features, found);
        for factor in [2.0, 1.0, 1.0] {
            let tolerance_px = (6.0 * factor * *sigma_px).max(0.1 * self.options.tolerance_px);
            adjust(block, known, *sigma_px, &triangulation(tolerance_px), ITERATIONS)?;
            *sigma_px = block.robust_sigma_px().max(0.05);
        }
        Ok(())
    }

    fn shutter_diagnostic(&self, estimate: &RollingShutterEstimate) -> Diagnostic {
        let message = format!(
            "while a photo is read its camera moves {:.2} m, {:.1} px on the ground (single photos +- {:.3} m); the motion is part of the adjustment",
            estimate.readout_displacement_m,
            estimate.readout_displacement_px,
            estimate.image_sigma_m
        );
        let diagnostic = Diagnostic::info(SHUTTER, "rolling shutter", message);
        match self.options.shutter {
            ShutterModel::Rolling(_) => diagnostic,
            _ => diagnostic.with_remedy("[align] rolling_shutter = \"off\" leaves it out"),
        }
    }

    /// The tracks of all that the block now tells.
    fn match_again(&self, block: &Block<'_>, monitor: &mut dyn Monitor) -> Tracks {
        let counter = Counter::new(monitor, "guided matching", None, "pairs");
        let options = GuidedMatchingOptions::default();
        let Photos { descriptors, matched, .. } = self.photos;
        let found = match_guided(block, descriptors, matched, &options, &|_| counter.tick());
        let pairs = found.iter().map(|pair| (pair.images, pair.matches.as_slice()));
        Tracks::of_pairs(block.features, pairs)
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
        let options = LeastSquaresMatchingOptions::default();
        let refined = refine_tie_points(block, self.photos.read, &options, &|| counter.tick())?;
        drop(counter);
        found.extend(refined.kept.iter().map(|(image, count)| {
            let message = format!(
                "fewer than {MIN_REFINED} of its tie points were refined by least-squares matching; {count} keep the less exact positions of their features"
            );
            let subject = block.features[*image as usize].name.as_str();
            Diagnostic::warning("tie-points-not-refined", subject, message)
        }));
        let pairs = refined.matches.iter().map(|pair| (pair.images, pair.matches.as_slice()));
        let tracks = Tracks::of_pairs(&refined.features, pairs);
        Ok((refined.features, tracks))
    }

    /// The block by other tracks, adjusted; its rolling shutter is estimated anew.
    ///
    /// Some matches are wrong, and lie anywhere within the tolerance: cut off close to the block, they hold it where it was.
    /// So the tolerance is a wide one until the block has converged.
    fn settle_rematched(
        &self,
        block: &mut Block<'_>,
        known: &Known,
        sigma_px: &mut f64,
        found: &mut [Diagnostic],
    ) -> Result<(), Error> {
        let tolerance_px = self.options.tolerance_px;
        let mut settle = |block: &mut Block<'_>, within_px: f64| -> Result<f64, Error> {
            adjust(block, known, *sigma_px, &triangulation(within_px), REMATCHED_ITERATIONS)?;
            *sigma_px = block.robust_sigma_px().max(0.05);
            Ok(*sigma_px)
        };
        georeference::retriangulate_and_filter(block, &triangulation(tolerance_px));
        let sigma = settle(block, tolerance_px)?;
        if let Some(estimate) = rolling_shutter::update(block, known, self.flight.order, sigma)? {
            estimate.apply(block);
            if let Some(said) = found.iter_mut().rfind(|diagnostic| diagnostic.code == SHUTTER) {
                *said = self.shutter_diagnostic(&estimate);
            }
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
        let was_check = |name: &String| {
            let mut given = self.flight.known.ground.iter();
            given.any(|point| point.name == *name && point.role == Role::Check)
        };
        let checks = scene.ground.iter().filter(|point| point.role == Role::Check);
        let checks = checks.map(|point| point.name.clone()).filter(was_check).collect();
        // Without a mapping frame the first photo and the distance to the farthest one are the frame.
        let minimal_datum = !self.datum.georeferenced;
        let settings =
            Settings { tie_loss: Loss::SoftL1(2.0), minimal_datum, ..Settings::default() };
        let snooping = DataSnoopingOptions {
            rounds: 8,
            least_error_m: MIN_ERROR_PX * gsd_m(&scene),
            least_error_px: MIN_ERROR_PX,
            ..DataSnoopingOptions::default()
        };
        let snooped = snoop(&mut scene, &settings, &snooping)?;
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
            found.push(Diagnostic::warning(
                "observation-retained_suspects",
                doubt.name.as_str(),
                message,
            ));
        }
        Ok(AdjustedBlock {
            adjusted: snooped.adjusted,
            settings: Settings { minimal_datum, ..Settings::default() },
            alignment: None,
            removed: snooped.removed,
            complete: snooped.complete,
            georeferenced: self.datum.georeferenced,
            fragments: Vec::new(),
            checks,
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

/// Ground sample distance: the median of the distances of points over the principal distance, metres per pixel.
pub fn gsd_m(scene: &Reconstruction) -> f64 {
    let mut all: Vec<f64> = scene
        .observations
        .iter()
        .step_by(5)
        .map(|o| {
            let image = &scene.images[o.image as usize];
            let c = scene.cameras[image.camera].interior.principal_distance_px();
            -image.pose.to_camera(scene.points[o.point as usize].position_m)[2] / c
        })
        .collect();
    all.sort_by(f64::total_cmp);
    all.get(all.len() / 2).copied().unwrap_or(0.0)
}

/// Why photos are not part of a block: one diagnostic for each that is not and of which nothing is said yet.
pub fn unregistered(
    adjusted: &AdjustedBlock,
    features: &[Features],
    pairs: &[Pair],
    said: &[Diagnostic],
) -> Vec<Diagnostic> {
    let registered: std::collections::HashSet<&str> =
        adjusted.adjusted.reconstruction.images.iter().map(|image| image.name.as_str()).collect();
    let mut found = Vec::new();
    for (k, photo) in features.iter().enumerate() {
        let name = &photo.name;
        if registered.contains(name.as_str()) || said.iter().any(|d| d.subject == *name) {
            continue;
        }
        let own = pairs.iter().filter(|pair| pair.images.contains(&(k as u32))).count();
        let apart = adjusted.fragments.iter().find(|(images, _)| images.contains(name));
        let message = match (apart, own) {
            (Some((images, false)), _) => format!(
                "it is in a group of {} photos that nothing ties to the others",
                images.len()
            ),
            (_, 0) => "not oriented: it matches no other photo".to_owned(),
            (_, own) => format!(
                "not oriented: it matches {own} other photo(s), too little or in contradiction"
            ),
        };
        found.push(Diagnostic::warning("not-oriented", name.as_str(), message));
    }
    found
}
