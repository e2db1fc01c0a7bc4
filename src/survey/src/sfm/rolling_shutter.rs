//! A shutter that reads its rows one after the other while the camera flies: the block grows without it
//! (over flat ground it is nearly an affinity of all photos, which their poses and points share), but as soon
//! as control and camera positions fix the ground, it pulls at them.
//!
//! ```text
//! P = R X + t + tau s       tau: share of the readout, -1/2 .. 1/2;   s = -R d l
//! ```
//!
//! `d` is the direction in which an image flew, by the images before and after it, `l` the displacement during one readout:
//! one number for all images that fly equally fast. Every image has its own shift about that, in this and in every
//! later adjustment; one whose direction is not known has it about what was found before.

use super::{
    block::Block,
    bundle::{BundleAdjustmentOptions, bundle_adjust},
    georeference::Known,
};
use crate::{
    camera::Camera,
    scene::{Reconstruction, RollingShutter},
};
use nalgebra::Vector3;
use rowgram_optim::robust::median;
use rowgram_optim::{engine::SolveError, geometry::rotation, nlls::Loss};

/// What a rolling shutter does to a block.
#[derive(Debug, Clone, PartialEq)]
pub struct RollingShutterEstimate {
    /// How far a camera flies while one photo is read, metres.
    pub readout_displacement_m: f64,
    /// The same on the ground, pixels.
    pub readout_displacement_px: f64,
    /// Standard deviation of single images about it, metres.
    pub image_sigma_m: f64,
    /// The shutter, and how closely images are expected to keep to that displacement.
    pub shutter: RollingShutter,
    /// How every image moves, as in [`Block::motions`].
    pub motions: Vec<[f64; 6]>,
    /// What was expected of these.
    pub expected_motions: Vec<[f64; 6]>,
}

/// Standard deviation of shifts of which nothing is known yet, as a share of the distance of the ground.
const ANY: f64 = 0.02;
/// Standard deviation of single images about the common displacement, as a share of it.
///
/// Then it is what was found with that, but no less than that of [`CALM`] flight.
const SPEED_SIGMA_RATIO: f64 = 0.1;
/// The least of it: what an autopilot holds its speed to.
const CALM: f64 = 0.03;
/// And as a share of the distance of the ground, where nothing moves.
const LEAST: f64 = 1e-4;
/// How far images are off for each metre that the displacement expected of them is: at least so much, or else two expectations do not
/// tell the right one. Not searched for.
const LEAST_PULL: f64 = 0.02;
/// Displacements that are looked at, at most, and the change that ends it, as a share of it. Neither was searched for.
const MOST_STEPS: usize = 5;
const CLOSE: f64 = 0.01;
/// The fewest images whose direction must be known.
const LEAST_IMAGES: usize = 6;
/// The gain that each of the new numbers must be worth.
const WORTH: f64 = 4.0;
/// How often a block with a global shutter is adjusted further, at most. Not searched for.
const MOST_ATTEMPTS: usize = 10;
/// The common displacement must be this many times its standard deviation.
const SURE: f64 = 5.0;
/// And longer than this on the ground, pixels.
const LEAST_PX: f64 = 0.5;
/// Pieces of the flight are straight where they turn by less than this, as a cosine.
const STRAIGHT: f64 = 0.87;

/// Unit vectors along which images flew, in the world; `centres_m` in the order of the flight. `None` where
/// an image has no neighbour on a straight piece.
pub fn directions(centres_m: &[[f64; 3]]) -> Vec<Option<[f64; 3]>> {
    let pieces: Vec<Option<Vector3<f64>>> = centres_m
        .windows(2)
        .map(|pair| (Vector3::from(pair[1]) - Vector3::from(pair[0])).try_normalize(1e-9))
        .collect();
    let straight = |k: usize| -> Option<Vector3<f64>> {
        let own = pieces[k]?;
        let along = |other: Option<&Option<Vector3<f64>>>| {
            other.copied().flatten().is_some_and(|other| own.dot(&other) > STRAIGHT)
        };
        (along(k.checked_sub(1).and_then(|k| pieces.get(k))) || along(pieces.get(k + 1)))
            .then_some(own)
    };
    (0..centres_m.len())
        .map(|k| {
            let before = k.checked_sub(1).and_then(straight);
            let after = if k < pieces.len() { straight(k) } else { None };
            let sum = before.unwrap_or_default() + after.unwrap_or_default();
            sum.try_normalize(1e-9).map(Into::into)
        })
        .collect()
}

/// The drift of a georeferenced block; `flight` holds its images in the order in which they were taken.
/// `None` where nothing speaks for one (unless somebody is `certain` that there is), or too few images for it
/// to be told.
///
/// # Errors
/// Where the block cannot be evaluated.
pub fn estimate(
    block: &Block<'_>,
    known: &Known,
    flight: &[usize],
    tie_sigma_px: f64,
    readout_s: f64,
    certain: bool,
) -> Result<Option<RollingShutterEstimate>, SolveError> {
    let Some(mut problem) = ShutterProblem::of(block, known, flight, tie_sigma_px) else {
        return Ok(None);
    };
    problem.survey.rolling_shutter = Some(shutter(ANY * problem.distance_m, readout_s));
    adjust_survey(&mut problem.survey)?;
    let (drift, is_sure) = problem.judged(readout_s, certain)?;
    Ok(is_sure.then_some(drift))
}

/// What became of a rolling shutter when the block was better known.
pub enum Update {
    /// Nothing can be said.
    Unknown,
    /// It moves images by this.
    Rolling(Box<RollingShutterEstimate>),
    /// Nothing speaks for one any more.
    Global,
}

/// The drift once more, of a block that has one and is better known than when that was found.
///
/// # Errors
/// Where the block cannot be evaluated.
pub fn update(
    block: &Block<'_>,
    known: &Known,
    flight: &[usize],
    tie_sigma_px: f64,
    certain: bool,
) -> Result<Update, SolveError> {
    let Some(RollingShutter { readout_s, .. }) = block.shutter else { return Ok(Update::Unknown) };
    let Some(mut problem) = ShutterProblem::of(block, known, flight, tie_sigma_px) else {
        return Ok(Update::Unknown);
    };
    let (drift, is_sure) = problem.judged(readout_s, certain)?;
    Ok(if is_sure { Update::Rolling(Box::new(drift)) } else { Update::Global })
}

impl RollingShutterEstimate {
    /// Puts it into a block, so that all that is done with it knows of it.
    pub fn apply(&self, block: &mut Block<'_>) {
        block.motions.clone_from(&self.motions);
        block.expected_motions.clone_from(&self.expected_motions);
        block.shutter = Some(self.shutter);
    }
}

/// Takes it out of a block.
pub fn remove(block: &mut Block<'_>) {
    block.motions.iter_mut().chain(&mut block.expected_motions).for_each(|m| *m = [0.0; 6]);
    block.shutter = None;
}

fn shutter(sigma_m: f64, readout_s: f64) -> RollingShutter {
    let sigma_velocity_m_s = sigma_m / readout_s;
    RollingShutter { readout_s, sigma_velocity_m_s }
}

/// A block and how its images flew.
struct ShutterProblem {
    survey: Reconstruction,
    /// Which images of the block its images are, of how many.
    order: Vec<usize>,
    images: usize,
    /// Unit vectors along which they flew.
    along: Vec<Option<[f64; 3]>>,
    distance_m: f64,
}

impl ShutterProblem {
    /// `None` where the directions of too few images are known.
    fn of(
        block: &Block<'_>,
        known: &Known,
        flight: &[usize],
        tie_sigma_px: f64,
    ) -> Option<ShutterProblem> {
        let (mut survey, _, order) = block.reconstruction(None);
        known.attach(&mut survey, &order);
        survey.tie_sigma_px = tie_sigma_px;
        let place = |image: usize| order.iter().position(|&k| k == image);
        let flown: Vec<usize> = flight.iter().filter_map(|&image| place(image)).collect();
        let centres: Vec<[f64; 3]> =
            flown.iter().map(|&k| survey.images[k].pose.centre_m()).collect();
        let mut along: Vec<Option<[f64; 3]>> = vec![None; survey.images.len()];
        flown.iter().zip(directions(&centres)).for_each(|(&k, direction)| along[k] = direction);
        let distance_m = distance_m(&survey)?;
        let problem =
            ShutterProblem { survey, order, images: block.poses.len(), along, distance_m };
        (problem.directed() >= LEAST_IMAGES).then_some(problem)
    }

    /// How many images have a direction.
    fn directed(&self) -> usize {
        self.along.iter().flatten().count()
    }

    /// The drift, and whether it is there: because somebody is `certain`, or a global shutter explains the measurements clearly worse.
    fn judged(
        &mut self,
        readout_s: f64,
        certain: bool,
    ) -> Result<(RollingShutterEstimate, bool), SolveError> {
        let (drift, cost) = self.readout_displacements(readout_s)?;
        if certain {
            return Ok((drift, true));
        }
        let survey = &self.survey;
        let freedom = survey.observations.len() as f64 * 2.0
            - 3.0 * survey.points.len() as f64
            - 9.0 * survey.images.len() as f64;
        let variance = (2.0 * cost / freedom.max(1.0)).max(1e-12);
        let worth = WORTH * 3.0 * survey.images.len() as f64;
        let deviation_m = drift.image_sigma_m / (self.directed() as f64).sqrt();
        let is_seen = drift.readout_displacement_m > SURE * deviation_m
            && drift.readout_displacement_px > LEAST_PX;
        let gain = if is_seen {
            2.0 * (self.global_shutter_cost(cost, 0.5 * worth * variance)? - cost) / variance
        } else {
            0.0
        };
        let is_sure = is_seen && gain > worth;
        tracing::debug!(
            "rolling shutter: {:.3} m ({:.1} px) +- {:.3} in a readout, gain {gain:.0}{}",
            drift.readout_displacement_m,
            drift.readout_displacement_px,
            drift.image_sigma_m,
            if is_sure { "" } else { ", not enough" }
        );
        Ok((drift, is_sure))
    }

    /// The cost without any motion, from where the block is with it. A block goes to its least cost slowly, so it is adjusted until a
    /// difference of `worth` from `cost` is decided: what one has not yet gained would pass for a gain of the other.
    fn global_shutter_cost(&self, cost: f64, worth: f64) -> Result<f64, SolveError> {
        let mut still = self.survey.clone();
        still.rolling_shutter = None;
        for image in &mut still.images {
            (image.motion, image.expected_motion) = ([0.0; 6], [0.0; 6]);
        }
        let mut found = adjust_survey(&mut still)?;
        for _ in 0..MOST_ATTEMPTS {
            let next = adjust_survey(&mut still)?;
            let gained = found - next;
            found = next;
            // Were every further attempt worth half of the last.
            if found - cost < worth || found - 2.0 * gained - cost > worth {
                break;
            }
        }
        Ok(found)
    }

    /// Estimates the common displacement and the spread about it, and all else with them; and the cost.
    fn readout_displacements(
        &mut self,
        readout_s: f64,
    ) -> Result<(RollingShutterEstimate, f64), SolveError> {
        let (start_m, _) = common(&self.survey, &self.along);
        // The displacement about which images spread evenly, by the secant method.
        let about_m = SPEED_SIGMA_RATIO * start_m;
        let (mut readout_displacement_m, mut image_sigma_m) = (start_m, 0.0);
        let mut last: Option<[f64; 2]> = None;
        for _ in 0..MOST_STEPS {
            let at_m = readout_displacement_m;
            let (found_m, sigma_m, _) = self.about(at_m, about_m, readout_s)?;
            image_sigma_m = sigma_m;
            let own = [at_m, found_m - at_m];
            readout_displacement_m = last.map_or(found_m, |last| evenly(last, own));
            last = Some(own);
            if (readout_displacement_m - at_m).abs() < CLOSE * at_m.abs() {
                break;
            }
        }
        let sigma_m = image_sigma_m.max(CALM * readout_displacement_m.abs());
        let (readout_displacement_m, image_sigma_m, cost) =
            self.about(readout_displacement_m, sigma_m, readout_s)?;
        let c_px = |c: &Camera| c.interior.principal_distance_px();
        let c_px = self.survey.cameras.iter().map(c_px).fold(0.0, f64::max);
        let mut motions = vec![[0.0; 6]; self.images];
        let mut expected_motions = motions.clone();
        for (image, &index) in self.survey.images.iter().zip(&self.order) {
            motions[index] = image.motion;
            expected_motions[index] = image.expected_motion;
        }
        let drift = RollingShutterEstimate {
            readout_displacement_m,
            readout_displacement_px: readout_displacement_m * c_px / self.distance_m,
            image_sigma_m,
            shutter: shutter(sigma_m.max(LEAST * self.distance_m), readout_s),
            motions,
            expected_motions,
        };
        Ok((drift, cost))
    }

    /// Adjusts the block about a common displacement; the one that is found, the spread about it, and the cost.
    fn about(
        &mut self,
        readout_displacement_m: f64,
        sigma_m: f64,
        readout_s: f64,
    ) -> Result<(f64, f64, f64), SolveError> {
        for (image, direction) in self.survey.images.iter_mut().zip(&self.along) {
            image.expected_motion = direction.map_or(image.motion, |direction| {
                let flown = direction.map(|v| -v * readout_displacement_m);
                let [x, y, z] = rotation::rotate(image.pose.rotation, flown);
                [0.0, 0.0, 0.0, x, y, z]
            });
            image.motion = image.expected_motion;
        }
        let sigma_m = sigma_m.abs().max(LEAST * self.distance_m);
        self.survey.rolling_shutter = Some(shutter(sigma_m, readout_s));
        let cost = adjust_survey(&mut self.survey)?;
        let (found_m, image_sigma_m) = common(&self.survey, &self.along);
        Ok((found_m, image_sigma_m, cost))
    }
}

/// Where images would not be off from what was expected on the whole, by two expectations `[displacement, how far images are off]`. Images are
/// drawn to what is expected, and so are off by a share of the error only; where that is next to nothing, they lead as far as they are off.
fn evenly([before, off_before]: [f64; 2], [at, off]: [f64; 2]) -> f64 {
    let slope = (off - off_before) / (at - before);
    if (-1.0..-LEAST_PULL).contains(&slope) { at - off / slope } else { at + off }
}

/// Mean and standard deviation of the displacements of images along their directions, metres.
fn common(survey: &Reconstruction, along: &[Option<[f64; 3]>]) -> (f64, f64) {
    let displacements: Vec<f64> = survey
        .images
        .iter()
        .zip(along)
        .filter_map(|(image, direction)| {
            let shift = [image.motion[3], image.motion[4], image.motion[5]];
            let world = rotation::rotate(rotation::inverse(image.pose.rotation), shift);
            Some(-Vector3::from(world).dot(&Vector3::from((*direction)?)))
        })
        .collect();
    let n = displacements.len().max(1) as f64;
    let mean = displacements.iter().sum::<f64>() / n;
    let squares: f64 = displacements.iter().map(|displacement| (displacement - mean).powi(2)).sum();
    (mean, (squares / (n - 1.0).max(1.0)).sqrt())
}

/// Median distance of points from the cameras that see them, metres.
fn distance_m(survey: &Reconstruction) -> Option<f64> {
    let all = survey.observations.iter().step_by(5).map(|o| {
        let pose = survey.images[o.image as usize].pose;
        -pose.to_camera(survey.points[o.point as usize].position_m)[2]
    });
    median(all).filter(|&distance| distance > 0.0)
}

fn adjust_survey(survey: &mut Reconstruction) -> Result<f64, SolveError> {
    let options =
        BundleAdjustmentOptions { loss: Loss::SoftL1(2.0), iterations: 30, cost_tolerance: 1e-6 };
    bundle_adjust(survey, survey.images.len(), &options)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::{Interior, Lens, Model},
        mapping::View,
        scene::{Axes, GroundObservation, GroundPoint, Pose, Role},
        sfm::{Features, tracks::Tracks},
    };
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use std::collections::BTreeMap;

    #[test]
    fn two_expectations_lead_to_the_one_in_which_images_are_not_off() {
        // Images that go a tenth of the way from what is expected to 0.12.
        let off = |expected: f64| [expected, 0.1 * (0.12 - expected)];
        assert!((evenly(off(0.3), off(0.28)) - 0.12).abs() < 1e-12);
        assert!((evenly(off(0.0), off(0.02)) - 0.12).abs() < 1e-12);
        // Nothing pulls, or away from the right one.
        assert_eq!(evenly([0.3, 0.001], [0.2, 0.001]), 0.201);
        assert!((evenly([0.3, 0.02], [0.2, 0.01]) - 0.21).abs() < 1e-12);
        assert_eq!(evenly([0.2, 0.0], [0.2, 0.0]), 0.2);
    }

    #[test]
    fn images_in_strips_have_directions_and_turns_have_none() {
        let mut centres: Vec<[f64; 3]> = (0..4).map(|k| [10.0 * f64::from(k), 0.0, 30.0]).collect();
        centres.extend((0..4).map(|k| [30.0 - 10.0 * f64::from(k), 20.0, 30.0]));
        let found = directions(&centres);
        for (k, direction) in found.iter().enumerate() {
            let x = if k < 4 { 1.0 } else { -1.0 };
            assert_eq!(*direction, Some([x, 0.0, 0.0]), "{k}");
        }
        assert_eq!(directions(&centres[..1]), [None]);
        assert_eq!(directions(&centres[..2]), [None, None], "two images may be a turn");
    }

    struct Flown {
        features: Vec<Features>,
        tracks: Tracks,
        cameras: Vec<Camera>,
        poses: Vec<Pose>,
        points_m: Vec<[f64; 3]>,
        known: Known,
    }

    /// Three strips of six photos from 12 m, whose camera flies `readout_m` while a photo is read: features, tracks, points and
    /// whatever is known, as it is after the block has found its frame without a shutter.
    fn flight(readout_m: f64) -> Flown {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let values = [480.0, 1.0, 299.5, 224.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let lens = Interior::new(Model::Brown, [600, 450], &values).unwrap();
        let views: Vec<View> = (0..18)
            .map(|k| {
                let (strip, along) = (k / 6, k % 6);
                let sense = if strip % 2 == 0 { 1.0 } else { -1.0 };
                let x = 2.5 * f64::from(if sense > 0.0 { along } else { 5 - along });
                let rotation = rotation::exp([0.02, -0.01, 0.03 * f64::from(along)]);
                let pose = Pose::from_centre(rotation, [x, 4.0 * f64::from(strip), 12.0]);
                let s = rotation::rotate(rotation, [-sense * readout_m, 0.0, 0.0]);
                View::new("photo", lens, pose, Some([0.0, 0.0, 0.0, s[0], s[1], s[2]]))
            })
            .collect();
        let mut features = vec![Features::default(); views.len()];
        let mut matches: BTreeMap<[u32; 2], Vec<[u32; 2]>> = BTreeMap::new();
        let mut points = vec![];
        let mut noise =
            |sigma: f64| sigma * (rng.random_range(-1.7..1.7) + rng.random_range(-0.1..0.1));
        for k in 0..900 {
            let at = [0.7 * f64::from(k % 30) - 4.0, 0.6 * f64::from(k / 30) - 5.0, noise(0.2)];
            let mut last: Option<[u32; 2]> = None;
            for (image, view) in views.iter().enumerate() {
                let Some(px) = view.pixel(at) else { continue };
                let of = &mut features[image].positions_px;
                of.push(px.map(|v| v + noise(0.1)));
                let own = [image as u32, of.len() as u32 - 1];
                if let Some([image, feature]) = last {
                    matches.entry([image, own[0]]).or_default().push([feature, own[1]]);
                }
                last = Some(own);
            }
            points.push(at);
        }
        let counts: Vec<usize> = features.iter().map(|of| of.positions_px.len()).collect();
        let tracks = Tracks::join(&counts, matches.iter().map(|(pair, of)| (*pair, of.as_slice())));
        let mut known = Known::default();
        for (k, [x, y]) in [[-2.0, -3.0], [14.0, -3.0], [-2.0, 11.0], [14.0, 11.0], [6.0, 4.0]]
            .into_iter()
            .enumerate()
        {
            known.ground.push(GroundPoint {
                name: format!("T{k}"),
                position_m: [x, y, 0.0],
                sigma_m: [0.01; 3],
                role: Role::Control,
                axes: Axes::Xyz,
            });
            for (image, view) in views.iter().enumerate() {
                if let Some(px) = view.pixel([x, y, 0.0]) {
                    let (image, ground) = (image as u32, k as u32);
                    known.marks.push(GroundObservation {
                        image,
                        ground,
                        image_px: px,
                        sigma_px: 0.3,
                    });
                }
            }
        }
        let poses = views.iter().map(|view| view.pose).collect();
        let cameras = vec![Camera::new("drone", lens)];
        Flown { features, tracks, cameras, poses, points_m: points, known }
    }

    #[test]
    fn a_rolling_shutter_is_told_from_none_and_a_wrong_one_is_taken_back() {
        for readout_m in [0.0, 0.15] {
            let Flown { features, tracks, cameras, poses, points_m, known } = flight(readout_m);
            let mut block = Block::new(&features, &tracks, &cameras);
            block.poses = poses.into_iter().map(Some).collect();
            let order: Vec<usize> = (0..18).collect();
            for track in 0..tracks.count() {
                let member = tracks.of(track)[0];
                let at = features[member.image as usize].positions_px[member.feature as usize];
                let pose = block.poses[member.image as usize].unwrap();
                let off = |point: &[f64; 3]| {
                    let px = cameras[0].interior.project(pose.to_camera(*point)).unwrap();
                    (px[0] - at[0]).hypot(px[1] - at[1])
                };
                let nearest = points_m.iter().min_by(|a, b| off(a).total_cmp(&off(b)));
                block.points[track] = nearest.copied();
                block.used[tracks.places(track)].fill(true);
            }
            let found = estimate(&block, &known, &order, 0.1, 0.03, false).unwrap();
            if readout_m == 0.0 {
                assert_eq!(found, None);
                // Somebody took it for one.
                let forced = estimate(&block, &known, &order, 0.1, 0.03, true).unwrap().unwrap();
                forced.apply(&mut block);
                let update = update(&block, &known, &order, 0.1, false).unwrap();
                assert!(matches!(update, Update::Global));
                remove(&mut block);
                assert!(
                    block.shutter.is_none() && block.motions.iter().flatten().all(|&v| v == 0.0)
                );
            } else {
                let found = found.unwrap();
                let off_m = found.readout_displacement_m - readout_m;
                assert!(off_m.abs() < 0.04 * readout_m, "{off_m}");
                found.apply(&mut block);
                let update = update(&block, &known, &order, 0.1, false).unwrap();
                assert!(matches!(update, Update::Rolling(_)));
            }
        }
    }
}
