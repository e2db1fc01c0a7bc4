//! A block with what is known on the ground and in the air: rounds from loose to tight, a rolling shutter where there is
//! one, guided matching, tie points refined by least-squares matching, and what of it all cannot be right.
//!
//! The strategy, in memory: [`adjust_blocks`] is all of it, from blocks in frames of their own to one adjusted block in
//! the mapping frame. What is found on the way is a [`Diagnostic`].

mod determined;
mod review;
mod rounds;

use super::{
    Block, Features, Pair,
    georeference::{Joined, Known, join},
    incremental::IncrementalOptions,
    orientation_review::{OrientationSummary, review_orientations, summarize_orientations},
    triangulate::TriangulationOptions,
    verify::PairMatches,
};
use crate::{
    features::DescriptorSource,
    problems::adjustment::{Adjusted, Alignment, Group, Removed, Settings},
    scene::{Reconstruction, Role},
};
use determined::keep_tied;
use image::GrayImage;
use review::{name_scarcely_marked, position_shift, prepare_cameras, review};
use rounds::BlockAdjuster;
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_optim::robust::median;
use serde::{Deserialize, Serialize};

/// Whether something optional is done.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum When {
    /// Where it is needed; each option says when.
    #[default]
    Auto,
    /// In any case.
    On,
    /// Never.
    Off,
}

rowgram_base::choices!(When: Auto, On, Off);

impl When {
    /// Whether it is done for a block with this control: auto where there is ground control, which says that coordinates matter.
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
    /// The most image measurements of tie points that are adjusted ([`Tracks::thinned`](crate::sfm::tracks::Tracks::thinned)).
    pub max_tie_observations: usize,
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
    pub descriptors: &'a dyn DescriptorSource,
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
    /// Whether camera positions and control differ by an offset.
    position_offset: bool,
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
    /// Orientations of a gimbal that took part.
    pub orientations: Option<OrientationSummary>,
    /// What was found.
    pub diagnostics: Vec<Diagnostic>,
}

/// Codes of diagnostics that a later step may take back.
const MARK: &str = "mark-rejected";
const SHUTTER: &str = "rolling-shutter";

/// Brings blocks into the mapping frame, makes them one, adjusts it and finds what cannot be right.
///
/// Without ground control and camera positions the largest block is adjusted in a frame of its own. Where it cannot be
/// adjusted with them, it is adjusted without control, then without positions, and an error says so: the block of the photos
/// is there in any case.
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
    let mut said = Vec::new();
    loop {
        let with = Flight { known: &known, ..*flight };
        let error = match adjust_with_known(blocks.clone(), &with, photos, options, monitor) {
            Ok(mut found) => {
                found.diagnostics.splice(0..0, said);
                return Ok(found);
            }
            Err(error) => error,
        };
        let is_of_the_block =
            matches!(error, Error::Solve(_) | Error::Incomplete(_) | Error::Module { .. });
        let what = if known.marks.is_empty() { "camera positions" } else { "ground control" };
        if !is_of_the_block || known.marks.is_empty() && known.positions.is_empty() {
            return Err(in_words(error));
        }
        tracing::debug!("with {what}: {error}");
        if known.marks.is_empty() {
            known.positions.clear();
        } else {
            known.without_control();
        }
        let message = format!(
            "with it the photos cannot be adjusted as one block: {what} and photos contradict each other; the block is adjusted without"
        );
        let remedy = "check coordinates, image measurements and the reference system";
        said.push(Diagnostic::error("control-contradicts", what, message).with_remedy(remedy));
    }
}

/// An error of the engine says nothing to a person.
fn in_words(error: Error) -> Error {
    match error {
        Error::Solve(why) => {
            tracing::debug!("{why}");
            Error::Incomplete(
                "the photos fell apart while they were adjusted: too few points tie them to each other".to_owned(),
            )
        }
        other => other,
    }
}

fn adjust_with_known(
    blocks: Vec<Block<'_>>,
    flight: &Flight<'_>,
    photos: &Photos<'_>,
    options: &BlockOptions,
    monitor: &mut dyn Monitor,
) -> Result<AdjustedBlock, Error> {
    let mut known = flight.known.clone();
    let told = known.positions.iter().filter(|p| flight.has_position_sigma[p.image as usize]);
    known.told_positions = 2 * told.count() > known.positions.len();
    let mut found = Vec::new();
    let mut fragments: Vec<(Vec<String>, bool)> =
        blocks.iter().map(|block| (block.image_names(), false)).collect();
    let mut given = match blocks.first() {
        Some(largest) => review(largest, &mut known, flight, options, &mut found),
        None => known.clone(),
    };
    name_scarcely_marked(&blocks, &known, &mut found);
    if let Some(largest) = blocks.first()
        && let Some(review) = review_orientations(largest, &mut known)
    {
        found.extend(review::orientations(&review, largest.features));
    }
    let Some(Joined { mut block, alignments, georeferenced, position_shift_m, heights }) =
        join(blocks, &mut known, flight.order, &triangulation(3.0 * options.tolerance_px))
    else {
        return Err(Error::Incomplete(
            "no three photos could be oriented together: look at the matches (rowgram align --until match), or give the camera (--camera)".into(),
        ));
    };
    found.extend(heights.iter().flat_map(review::heights));
    found.extend(review::datum(&block, &known, georeferenced));
    if !georeferenced {
        known = Known::default();
        given = Known::default();
    }
    keep_tied(&mut block, &known, georeferenced, &mut found);
    let within = block.image_names();
    for (k, alignment) in alignments.iter().enumerate() {
        let there = fragments[k].0.iter().any(|name| within.contains(name));
        fragments[k].1 = there && (alignment.is_some() || !georeferenced && k == 0);
    }
    found.extend(position_shift_m.filter(|_| !known.positions.is_empty()).map(position_shift));
    prepare_cameras(&mut block, georeferenced, options)?;
    let mut position_sigmas = vec![None; flight.has_position_sigma.len()];
    for position in &flight.known.positions {
        let image = position.image as usize;
        position_sigmas[image] = flight.has_position_sigma[image].then_some(position.sigma_m);
    }
    let by_control =
        alignments.iter().flatten().filter(|alignment| alignment.by.ends_with("control points"));
    let max_control_misfit_m = by_control.map(control_misfit_m).fold(0.0, f64::max);
    let position_offset = position_shift_m.is_some();
    let datum = DatumInfo { georeferenced, position_sigmas, position_offset, max_control_misfit_m };
    let adjuster = BlockAdjuster { flight, given: &given, photos, options, datum: &datum };
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
    if more.iter().any(|diagnostic| diagnostic.code == SHUTTER) {
        // With the shutter in the model, image measurements were looked through anew.
        found.retain(|diagnostic| diagnostic.code != MARK);
    }
    found.extend(more);
    take_back(&mut adjusted, &mut found);
    let orientations = summarize_orientations(&adjusted.adjusted.reconstruction);
    match &orientations {
        Some(summary) => found.push(review::orientations_used(summary)),
        None => found.extend(review::tilt(&adjusted.adjusted.reconstruction, georeferenced)),
    }
    Ok(AdjustedBlock {
        orientations,
        alignment: alignments.into_iter().flatten().next(),
        fragments,
        diagnostics: found,
        ..adjusted
    })
}

/// Takes back what was said of control points and image measurements that take part after all.
fn take_back(adjusted: &mut AdjustedBlock, found: &mut Vec<Diagnostic>) {
    let scene = &adjusted.adjusted.reconstruction;
    let name = |ground: u32| &scene.ground[ground as usize].name;
    let control = scene.ground.iter().filter(|point| point.role == Role::Control);
    let control = control.map(|point| format!("control point {}", point.name));
    let marks = scene.marks.iter().map(|mark| {
        format!("mark of {} in {}", name(mark.ground), scene.images[mark.image as usize].name)
    });
    let in_use: std::collections::HashSet<String> = control.chain(marks).collect();
    adjusted.removed.retain(|removed| !in_use.contains(&removed.name));
    let mut back = Vec::new();
    found.retain(|said| {
        let rejected =
            ["control-rejected", "observation-rejected", MARK].contains(&said.code.as_ref());
        let stays = !(rejected && in_use.contains(&said.subject));
        if !stays && !back.contains(&said.subject) {
            back.push(said.subject.clone());
        }
        stays
    });
    for subject in back {
        let message = "it did not fit at first and was left out; it fits the adjusted block, and takes part again";
        found.push(Diagnostic::info("observation-reconsidered", subject, message));
    }
}

/// What control is off by at most after a similarity, but for the worst of it, metres.
fn control_misfit_m(alignment: &Alignment) -> f64 {
    let mut left: Vec<f64> = alignment.misfits.iter().map(|(_, left)| *left).collect();
    left.extend(std::iter::repeat_n(alignment.rmse_m, alignment.used.len()));
    left.sort_by(f64::total_cmp);
    left.get(left.len() * 3 / 4).copied().unwrap_or(0.0)
}

/// What rays must be like.
fn triangulation(tolerance_px: f64) -> TriangulationOptions {
    let min_angle_rad = IncrementalOptions::default().min_angle_rad;
    TriangulationOptions { tolerance_px, min_angle_rad }
}

/// Ground sample distance: the median of the distances of points over the principal distance, metres per pixel.
pub fn gsd_m(scene: &Reconstruction) -> f64 {
    let of = |o: &crate::scene::Observation| {
        let image = &scene.images[o.image as usize];
        let c = scene.cameras[image.camera].interior.principal_distance_px();
        -image.pose.to_camera(scene.points[o.point as usize].position_m)[2] / c
    };
    median(scene.observations.iter().step_by(5).map(of)).unwrap_or(0.0)
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
