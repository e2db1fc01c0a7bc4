//! Ground control targets in the photos of an oriented block, found and measured.
//!
//! 1. *Prediction*: the block says where a surveyed point is in a photo and how large a metre is there. Heights are those of the
//!    tie points around it, so that heights of another datum do not matter.
//! 2. *Search* (`search`): places that correlate with the shape of the target (`shape`), within the uncertainty of the block.
//! 3. *Measurement* (`fit`): the shape fitted to the photo by least squares; standard deviations follow from what is left. Coded
//!    targets (`codes`) are read and fitted with their code.
//! 4. *Consensus* (`consensus`): the shift between block and survey that most targets agree with; then a narrow search, and rays
//!    of a target that meet in a point. What does not fit is refused.
//!
//! Image positions are in pixels, the centre of the top-left pixel being (0, 0); places are in the mapping frame, metres.

mod code_words;
mod codes;
mod consensus;
mod expected;
mod fit;
mod outcome;
mod patch;
mod search;
mod shape;
pub mod sheet;

pub use expected::{ExpectedMark, ExpectedMarks, expected_marks, on_the_ground};
pub use outcome::{
    FoundTargets, NotFound, ReadPhoto, TargetKind, TargetMeasurement, TargetSearch, TargetSighting,
};

use crate::{
    mapping::{View, view::views},
    scene::{Axes, GroundPoint, Reconstruction},
};
use consensus::{FrameOffset, Located, Sight, common_shift, locate, offset_m, residual_px};
use fit::{Jacobian, px_per_m};
use patch::Patch;
use rayon::prelude::*;
use rowgram_base::Error;
use rowgram_optim::robust;
use search::{Searched, Wanted};

/// Targets with fewer pixels are not looked for.
pub const MIN_SIZE_PX: f64 = 6.0;
/// What the shift may differ between targets of a block that GNSS holds, as a share of the search radius.
const DEFORMATION_SHARE: f64 = 0.1;
/// How far from its place a target is looked for once the shift is known, in sizes: enough for its own deviation, and too near for
/// much else.
const NEAR_SIZES: f64 = 0.75;
/// How far from the shift of the others a target may be beside their scatter, in sizes.
const MAX_DEVIATION_SIZES: f64 = 0.5;
/// By how much less a target may score where it has to be: on 36 hand-marked crosses of 10 pixels in grass (Swindale, 5.5 cm per
/// pixel) half of them score less than 0.7.
const NEAR_SCORE_MARGIN: f64 = 0.2;
/// Photos from which kind and size are decided.
const DECIDING_PHOTOS: usize = 12;

/// A target in a photo before it is looked for.
#[derive(Debug, Clone, Copy)]
struct Prediction {
    ground: usize,
    image: usize,
    centre_px: [f64; 2],
    /// Metres to the east and to the south, in pixels.
    jacobian: Jacobian,
    radius_m: f64,
}

/// Finds the targets of surveyed points in the photos of a block.
///
/// # Errors
/// A photo that cannot be read; `None` as a result means that nothing was found that photos and survey agree about.
pub fn find_targets(
    reconstruction: &Reconstruction,
    points: &[GroundPoint],
    options: &TargetSearch,
    read: ReadPhoto<'_>,
) -> Result<Option<FoundTargets>, Error> {
    let block = Block { reconstruction, views: views(reconstruction), points, options };
    let grounds = on_the_ground(reconstruction, points);
    let first = block.predict(|k| Some((grounds[k], options.search_m)));
    let Some(wanted) = block.decide(&first, &grounds, read)? else { return Ok(None) };
    let searched = block.search(&wanted, &first, read)?;
    let sights = block.sights(&first, &searched, &grounds);
    let offset = block.offset(&sights, &grounds, wanted.size_m);
    let offset = offset.filter(|(frame, _)| frame.is_consistent(wanted.size_m));
    let Some((frame, located)) = offset else { return Ok(None) };
    let near_m = NEAR_SIZES * wanted.size_m + 3.0 * frame.sigma_m;
    let narrow = |k: usize| -> Option<([f64; 3], f64)> {
        let expected = match &located[k] {
            Some(found) => found.position_m,
            None => block.expected_m(&frame, &grounds, k),
        };
        Some((expected, near_m))
    };
    let second = block.predict(narrow);
    // Close to where it has to be, less is enough.
    let is_near = 3.0 * frame.sigma_m <= NEAR_SIZES * wanted.size_m;
    let margin = f64::from(u8::from(is_near)) * NEAR_SCORE_MARGIN;
    let wanted = wanted.with_min_score(options.min_score - margin);
    let searched = block.search(&wanted, &second, read)?;
    let sights = block.sights(&second, &searched, &grounds);
    Ok(Some(block.judge(&wanted, (&frame, &grounds), &second, &searched, &sights)))
}

struct Block<'a> {
    reconstruction: &'a Reconstruction,
    views: Vec<View>,
    points: &'a [GroundPoint],
    options: &'a TargetSearch,
}

impl Block<'_> {
    /// Where the photos should show points, of which `place` has the position and the radius of the search.
    fn predict(&self, place: impl Fn(usize) -> Option<([f64; 3], f64)>) -> Vec<Prediction> {
        let mut found = Vec::new();
        for ground in 0..self.points.len() {
            let Some((at, radius_m)) = place(ground) else { continue };
            for (image, view) in self.views.iter().enumerate() {
                let Some(centre_px) = view.seen_px(at) else { continue };
                // Half a metre to each side.
                let moved = |x: f64, y: f64| view.seen_px([at[0] + x, at[1] + y, at[2]]);
                let sides = (moved(0.5, 0.0), moved(-0.5, 0.0), moved(0.0, -0.5), moved(0.0, 0.5));
                let (Some(east), Some(west), Some(south), Some(north)) = sides else { continue };
                let jacobian: Jacobian =
                    std::array::from_fn(|k| [east[k] - west[k], south[k] - north[k]]);
                let radius_px = radius_m * px_per_m(&jacobian);
                let size = view.interior.size_px().map(f64::from);
                let inside =
                    (0..2).all(|k| (-radius_px..size[k] + radius_px).contains(&centre_px[k]));
                if inside && px_per_m(&jacobian).is_finite() {
                    found.push(Prediction { ground, image, centre_px, jacobian, radius_m });
                }
            }
        }
        found
    }

    /// Where a point is in the block.
    fn expected_m(&self, frame: &FrameOffset, grounds: &[[f64; 3]], point: usize) -> [f64; 3] {
        let at = self.points[point].position_m;
        let offset = frame.at_m(at);
        let mut expected: [f64; 3] = std::array::from_fn(|k| at[k] + offset[k]);
        if self.points[point].axes == Axes::Xy {
            expected[2] = grounds[point][2];
        }
        expected
    }

    /// Looks for targets at their predictions.
    fn search(
        &self,
        wanted: &Wanted,
        predictions: &[Prediction],
        read: ReadPhoto<'_>,
    ) -> Result<Vec<Searched>, Error> {
        let mut of_choices = self.search_all(std::slice::from_ref(wanted), predictions, read)?;
        Ok(of_choices.pop().unwrap_or_default())
    }

    /// Looks for targets of several kinds and sizes at their predictions; photos are read once.
    fn search_all(
        &self,
        choices: &[Wanted],
        predictions: &[Prediction],
        read: ReadPhoto<'_>,
    ) -> Result<Vec<Vec<Searched>>, Error> {
        let found: Vec<Result<Vec<_>, Error>> = (0..self.views.len())
            .into_par_iter()
            .map(|image| {
                let own = predictions.iter().enumerate().filter(|(_, p)| p.image == image);
                let own: Vec<(usize, usize)> =
                    own.flat_map(|(k, _)| (0..choices.len()).map(move |c| (c, k))).collect();
                if own.is_empty() {
                    return Ok(Vec::new());
                }
                let photo = read(image)?;
                let search = |(choice, k): (usize, usize)| {
                    let (wanted, p): (&Wanted, &Prediction) = (&choices[choice], &predictions[k]);
                    let scale = px_per_m(&p.jacobian);
                    let (size_px, radius_px) = (scale * wanted.size_m, scale * p.radius_m);
                    let patch = Patch::cut(&photo, p.centre_px, radius_px + 1.5 * size_px + 4.0);
                    let found = match patch {
                        Some(patch) if size_px >= MIN_SIZE_PX => {
                            wanted.search(&patch, &p.jacobian, p.centre_px, radius_px)
                        }
                        _ => Searched::default(),
                    };
                    (choice, k, found)
                };
                Ok(own.into_par_iter().map(search).collect())
            })
            .collect();
        let mut searched = vec![vec![Searched::default(); predictions.len()]; choices.len()];
        for of_image in found {
            for (choice, k, found) in of_image? {
                searched[choice][k] = found;
            }
        }
        Ok(searched)
    }

    /// The candidates of every target, in the order of images.
    fn sights(
        &self,
        predictions: &[Prediction],
        searched: &[Searched],
        grounds: &[[f64; 3]],
    ) -> Vec<Vec<Sight>> {
        let mut sights = vec![Vec::new(); self.points.len()];
        for (p, found) in predictions.iter().zip(searched) {
            for &candidate in &found.candidates {
                let at_px = candidate.fit.centre_px;
                if let Some(offset_m) = offset_m(&self.views[p.image], at_px, grounds[p.ground]) {
                    sights[p.ground].push(Sight { image: p.image, candidate, offset_m });
                }
            }
        }
        sights
    }

    fn tolerance_m(&self, size_m: f64) -> f64 {
        (DEFORMATION_SHARE * self.options.search_m).max(size_m)
    }

    /// The kind and size that the photos with the most targets agree about best.
    fn decide(
        &self,
        predictions: &[Prediction],
        grounds: &[[f64; 3]],
        read: ReadPhoto<'_>,
    ) -> Result<Option<Wanted>, Error> {
        let kinds = self.options.kind.map_or(TargetKind::ALL.to_vec(), |kind| vec![kind]);
        let sizes_m = &self.options.sizes_m;
        let choices = kinds.iter().flat_map(|&kind| {
            sizes_m.iter().map(move |&size_m| Wanted::new(kind, size_m, self.options.min_score))
        });
        let mut choices: Vec<Wanted> = choices.collect();
        if choices.len() < 2 {
            return Ok(choices.pop());
        }
        let mut counts = vec![(0usize, 0usize); self.views.len()];
        counts.iter_mut().enumerate().for_each(|(image, count)| count.1 = image);
        predictions.iter().for_each(|p| counts[p.image].0 += 1);
        counts.sort_by_key(|&(count, image)| (std::cmp::Reverse(count), image));
        let deciding: Vec<usize> =
            counts.iter().take(DECIDING_PHOTOS).map(|&(_, image)| image).collect();
        let few: Vec<Prediction> =
            predictions.iter().filter(|p| deciding.contains(&p.image)).copied().collect();
        let mut best: Option<(f64, Wanted)> = None;
        let searched = self.search_all(&choices, &few, read)?;
        for (wanted, searched) in choices.into_iter().zip(searched) {
            let sights = self.sights(&few, &searched, grounds);
            // The same tolerance for all, or larger ones would gather more by chance.
            let Some((_, sum)) = common_shift(&sights, self.tolerance_m(0.0)) else { continue };
            tracing::debug!("{} of {} m: support {sum:.2}", wanted.kind, wanted.size_m);
            if best.as_ref().is_none_or(|(most, _)| sum > *most) {
                best = Some((sum, wanted));
            }
        }
        Ok(best.map(|(_, wanted)| wanted))
    }

    /// How block and survey differ, and the targets that photos agree about and that agree with the others.
    fn offset(
        &self,
        sights: &[Vec<Sight>],
        grounds: &[[f64; 3]],
        size_m: f64,
    ) -> Option<(FrameOffset, Vec<Option<Located>>)> {
        let tolerance_m = self.tolerance_m(size_m);
        let (shift, support) = common_shift(sights, tolerance_m)?;
        tracing::debug!("shift {shift:.2?} m in plan, support {support:.2}");
        let near = |own: &Vec<Sight>| -> Vec<Sight> {
            let off = |s: &Sight| (s.offset_m[0] - shift[0]).hypot(s.offset_m[1] - shift[1]);
            own.iter().filter(|s| off(s) <= 2.0 * tolerance_m).copied().collect()
        };
        let locate_near =
            |own: &Vec<Sight>| locate(self.reconstruction, &near(own), self.options.tolerance_px);
        let mut located: Vec<Option<Located>> = sights.par_iter().map(locate_near).collect();
        let surveyed = |k: usize| match self.points[k].axes {
            Axes::Xy => grounds[k],
            Axes::Xyz | Axes::Z => self.points[k].position_m,
        };
        let difference = |k: usize, found: &Located| -> [f64; 3] {
            let at = surveyed(k);
            std::array::from_fn(|axis| found.position_m[axis] - at[axis])
        };
        let places: Vec<([f64; 3], [f64; 3])> = (located.iter().enumerate())
            .filter_map(|(k, found)| Some((surveyed(k), difference(k, found.as_ref()?))))
            .collect();
        let frame = match FrameOffset::of(&places) {
            Some(frame) => frame,
            None => {
                let dz = |k: usize| grounds[k][2] - self.points[k].position_m[2];
                let dz = robust::median((0..self.points.len()).map(dz))?;
                FrameOffset::constant([shift[0], shift[1], dz], tolerance_m)
            }
        };
        for (k, found) in located.iter_mut().enumerate() {
            let fits = found.as_ref().is_some_and(|found| {
                let left = frame.deviation_m(surveyed(k), difference(k, found));
                left <= 4.0 * frame.sigma_m + size_m
            });
            if !fits {
                *found = None;
            }
        }
        Some((frame, located))
    }

    /// What all photos together say of every sighting.
    fn judge(
        &self,
        wanted: &Wanted,
        (frame, grounds): (&FrameOffset, &[[f64; 3]]),
        predictions: &[Prediction],
        searched: &[Searched],
        sights: &[Vec<Sight>],
    ) -> FoundTargets {
        let tolerance_px = self.options.tolerance_px;
        let same_code = |own: &Vec<Sight>| -> Vec<Sight> {
            let code = most_frequent(own.iter().filter_map(|sight| sight.candidate.code));
            own.iter().filter(|sight| sight.candidate.code == code).copied().collect()
        };
        let sights: Vec<Vec<Sight>> = sights.iter().map(same_code).collect();
        // What photos agree about may still be another thing beside the target.
        let fits = |k: usize, found: &Located| {
            let expected = self.expected_m(frame, grounds, k);
            let off = (0..3).map(|axis| (found.position_m[axis] - expected[axis]).powi(2));
            off.sum::<f64>().sqrt() <= 4.0 * frame.sigma_m + MAX_DEVIATION_SIZES * wanted.size_m
        };
        let located: Vec<Option<Located>> = (sights.par_iter().enumerate())
            .map(|(k, own)| {
                locate(self.reconstruction, own, tolerance_px).filter(|found| fits(k, found))
            })
            .collect();
        let residual = |p: &Prediction, at_px: [f64; 2]| {
            let found = located[p.ground].as_ref()?;
            residual_px(self.reconstruction, p.image, at_px, found.position_m)
        };
        let member = |p: &Prediction| -> Option<&Sight> {
            let own = &sights[p.ground];
            let members = &located[p.ground].as_ref()?.members;
            members.iter().map(|&k| &own[k]).find(|sight| sight.image == p.image)
        };
        let residuals =
            predictions.iter().filter_map(|p| residual(p, member(p)?.candidate.fit.centre_px));
        let typical = robust::sigma_of_distances(residuals).unwrap_or(0.0);
        let most_px =
            (OUTLIER_RATIO * typical).clamp(MIN_OUTLIER_PX, tolerance_px.max(MIN_OUTLIER_PX));
        let confirmed = located.iter().flatten().count() >= MIN_CONFIRMING;
        let outcome = |p: &Prediction, found: &Searched| {
            let measured = |sight: &Sight, residual_px: Option<f64>| {
                let fit = &sight.candidate.fit;
                TargetMeasurement {
                    image_px: fit.centre_px,
                    sigma_px: fit.sigma_px,
                    score: fit.score,
                    code: sight.candidate.code,
                    residual_px,
                }
            };
            let size_px = px_per_m(&p.jacobian) * wanted.size_m;
            if size_px < MIN_SIZE_PX {
                return Err(NotFound::TooSmall { size_px });
            }
            if let Some(sight) = member(p) {
                let off_px = residual(p, sight.candidate.fit.centre_px).unwrap_or(f64::INFINITY);
                return match off_px <= most_px {
                    true => Ok(measured(sight, Some(off_px))),
                    false => Err(NotFound::Inconsistent { off_px }),
                };
            }
            let mut own = sights[p.ground].iter().filter(|sight| sight.image == p.image);
            match (own.next(), &located[p.ground], found.refused) {
                (Some(sight), Some(_), _) => {
                    let off = residual(p, sight.candidate.fit.centre_px);
                    Err(NotFound::Inconsistent { off_px: off.unwrap_or(f64::INFINITY) })
                }
                (Some(sight), None, _) => {
                    let alone = sights[p.ground].iter().all(|other| other.image == p.image);
                    let [u, v] = sight.candidate.fit.centre_px;
                    let off_m =
                        (u - p.centre_px[0]).hypot(v - p.centre_px[1]) / px_per_m(&p.jacobian);
                    match alone && confirmed && off_m <= 3.0 * frame.sigma_m + 0.5 * wanted.size_m {
                        true => Ok(measured(sight, None)),
                        false => Err(NotFound::Unconfirmed),
                    }
                }
                (None, _, Some((_, true))) => Err(NotFound::Unreadable),
                (None, _, refused) => {
                    Err(NotFound::NothingAlike { score: refused.map_or(0.0, |(score, _)| score) })
                }
            }
        };
        let sightings = predictions.iter().zip(searched).filter_map(|(p, found)| {
            let size_px = px_per_m(&p.jacobian) * wanted.size_m;
            let size = self.views[p.image].interior.size_px().map(f64::from);
            let outcome = outcome(p, found);
            // What is not whole in a photo need not be found in it.
            let whole = (0..2)
                .all(|k| (0.7 * size_px..size[k] - 1.0 - 0.7 * size_px).contains(&p.centre_px[k]));
            (whole || outcome.is_ok()).then_some(TargetSighting {
                ground: p.ground,
                image: p.image,
                predicted_px: p.centre_px,
                size_px,
                outcome,
            })
        });
        FoundTargets {
            kind: wanted.kind,
            size_m: wanted.size_m,
            shift_m: frame.shift_m(),
            shift_sigma_m: frame.sigma_m,
            sightings: sightings.collect(),
        }
    }
}

/// A measurement is refused from so many typical residuals on, but not below this.
const OUTLIER_RATIO: f64 = 4.0;
const MIN_OUTLIER_PX: f64 = 1.0;
/// Targets that have to be certain before one in a single photo is believed.
const MIN_CONFIRMING: usize = 3;

/// The value that is there most often, the least of equals.
fn most_frequent(values: impl Iterator<Item = usize>) -> Option<usize> {
    let mut counts = std::collections::BTreeMap::new();
    values.for_each(|value| *counts.entry(value).or_insert(0usize) += 1);
    counts
        .into_iter()
        .max_by_key(|&(value, count)| (count, std::cmp::Reverse(value)))
        .map(|(v, _)| v)
}

#[cfg(test)]
mod tests;
