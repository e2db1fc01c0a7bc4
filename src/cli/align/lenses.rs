//! Where nobody has calibrated a camera: a principal distance to begin with where its files tell none, and
//! how much the lens bends rays, both by how much of the matches each of some lenses explains.
//!
//! With the principal distance `c` and a measured radius `r = |x - x0| / c` the lenses tried are
//! `r_ideal = r (1 + a r^2)`: a wide lens of an action camera has an `a` of 0.2 to 0.5, and without it three
//! pairs of photos do not close a loop. SMAC has that very form. Brown, from ideal to measured, comes near it with
//! two terms while `a` is small, and not where the rays at the corners are bent by half: such lenses are SMAC's where
//! nobody asked for one of the two.

use super::{
    Args, Finding, LensName,
    cache::Cache,
    project::{Project, camera_at},
};
use crate::{
    camera::{Camera, Interior, Lens, Model},
    error::Error,
    sfm::{
        self,
        verify::{Matched, Verifying, shares_by_lens},
    },
};
use serde::{Deserialize, Serialize};

/// Pairs by which lenses are judged.
const PAIRS: usize = 10;
/// Distance from co-planarity that tells one lens from another, pixels.
const TOLERANCE_PX: f64 = 1.5;
/// Distance from co-planarity that tells one principal distance from another, pixels: a pair makes up for a wrong one
/// by its rotation and base, but for some pixels.
const FINE_PX: f64 = 1.0;
/// What is tried for `a`.
const BENDS: [f64; 10] = [-0.1, -0.05, 0.0, 0.05, 0.1, 0.17, 0.25, 0.33, 0.42, 0.52];
/// How much more of the matches than a lens without distortion one must explain.
const CLEARLY: f64 = 1.08;
/// By how much of the matches the best principal distance must be ahead of the middle one.
const AHEAD: f64 = 0.02;
/// Principal distances that fall behind the best by less than this share of its lead are as good.
const AS_GOOD: f64 = 0.2;
/// How much more SMAC must explain than Brown.
const BETTER_BY_SMAC: f64 = 1.03;

/// What was found for one camera.
#[derive(Serialize, Deserialize, Clone)]
struct Begun {
    /// Whether it is SMAC's now.
    smac: bool,
    values: Vec<f64>,
    sigma_px: Option<f64>,
    findings: Vec<String>,
}

/// Gives every camera that was not calibrated a lens to begin with.
///
/// # Errors
/// Where what was found cannot be kept.
pub(super) fn begin(
    project: &mut Project,
    features: &[sfm::Features],
    (matched, matched_mark): (&[Matched], u64),
    args: &Args,
    (cache, fresh): (&Cache, bool),
    findings: &mut Vec<Finding>,
) -> Result<(), Error> {
    if args.camera.is_some() {
        return Ok(());
    }
    let verifying = args.verifying();
    let mut mark =
        Cache::mark().count(matched_mark).text(&format!("{verifying:?} {BENDS:?} {:?}", args.lens));
    for (camera, _) in &project.cameras {
        mark = mark.text(camera.interior.model().word()).numbers(camera.interior.values());
    }
    let mark = mark.finish();
    let known = cache.load::<Vec<Begun>>("lenses.cbor", mark).filter(|_| !fresh);
    let begun = match known.filter(|known| known.len() == project.cameras.len()) {
        Some(begun) => begun,
        None => {
            let all = 0..project.cameras.len();
            let begun: Vec<Begun> = all
                .map(|camera| one(project, camera, features, matched, (&verifying, args.lens)))
                .collect::<Result<_, Error>>()?;
            cache.save("lenses.cbor", mark, &begun)?;
            begun
        }
    };
    for ((camera, _), begun) in project.cameras.iter_mut().zip(begun) {
        if begun.smac && camera.interior.model() != Model::Smac {
            let c = camera.interior.principal_distance_px();
            *camera = camera_at(&camera.name, Model::Smac, camera.interior.size_px(), c)?;
        }
        camera.interior = camera
            .interior
            .with_values(&begun.values)
            .map_err(|e| Error::Incomplete(format!("camera {}: {e}", camera.name)))?;
        camera.standard_deviations[0] = begun.sigma_px;
        let of = |what: &String| Finding::new(&camera.name, what);
        findings.extend(begun.findings.iter().map(of));
    }
    Ok(())
}

fn one(
    project: &Project,
    camera: usize,
    features: &[sfm::Features],
    matched: &[Matched],
    (verifying, wanted): (&Verifying, LensName),
) -> Result<Begun, Error> {
    let mut own: Vec<&Matched> = matched
        .iter()
        .filter(|m| m.images.iter().all(|&k| features[k as usize].camera == camera))
        .collect();
    own.sort_by(|a, b| b.matches.len().cmp(&a.matches.len()).then(a.images.cmp(&b.images)));
    own.truncate(PAIRS);
    let own: Vec<Matched> = own.into_iter().cloned().collect();
    let (entry, source) = &project.cameras[camera];
    let mut found = entry.clone();
    let mut told = Vec::new();
    if source.is_none() {
        let (c, what) = principal_distance(entry, features, &own, verifying)?;
        found = camera_at(&entry.name, entry.interior.model(), entry.interior.size_px(), c)?;
        found.standard_deviations[0] = Some(0.3 * c);
        told.push(format!("principal distance {c:.0} px to begin with, {what}"));
    }
    let straight = found.interior;
    let fine = Verifying { tolerance_px: TOLERANCE_PX, ..*verifying };
    let (least, bends) = explaining(&straight, features, &own, &fine);
    let mut smac = straight.model() == Model::Smac;
    let mut begin = bends;
    if wanted == LensName::Auto {
        let c = straight.principal_distance_px();
        let other = camera_at(&entry.name, Model::Smac, entry.interior.size_px(), c)?;
        let (_, bends) = explaining(&other.interior, features, &own, &fine);
        let before = begin.as_ref().map_or(least, |(_, share)| *share);
        if let Some((lens, share)) = bends.filter(|(_, share)| *share > before * BETTER_BY_SMAC) {
            let deviation = found.standard_deviations[0];
            (found, smac) = (other, true);
            found.standard_deviations[0] = deviation;
            begin = Some((lens, share));
        }
    }
    if let Some((lens, share)) = begin {
        found.interior = lens;
        told.push(format!(
            "its lens bends rays; a radial distortion with which {:.0} per cent of the matches agree, {:.0} without, is where it begins{}",
            100.0 * share,
            100.0 * least,
            if smac && wanted == LensName::Auto {
                ", in the form that ends at the ideal image (SMAC; COLMAP and OpenSfM have none such: --lens brown for those)"
            } else {
                ""
            }
        ));
    }
    Ok(Begun {
        smac,
        values: found.interior.values().to_vec(),
        sigma_px: found.standard_deviations[0],
        findings: told,
    })
}

/// The share of the matches that agrees with a lens without distortion, and the bent one that explains clearly more,
/// with its share.
fn explaining(
    straight: &Interior,
    features: &[sfm::Features],
    own: &[Matched],
    fine: &Verifying,
) -> (f64, Option<(Interior, f64)>) {
    let lenses: Vec<Interior> = BENDS.iter().filter_map(|&a| bent(straight, a)).collect();
    let shares = shares_by_lens(features, own, &lenses, fine);
    let plain = lenses.iter().position(|lens| lens.values() == straight.values());
    let least = plain.map_or(0.0, |place| shares[place]);
    let best = (0..shares.len()).max_by(|&a, &b| shares[a].total_cmp(&shares[b]));
    let best = best.filter(|&best| shares[best] > least * CLEARLY);
    (least, best.map(|best| (lenses[best], shares[best])))
}

fn principal_distance(
    entry: &Camera,
    features: &[sfm::Features],
    own: &[Matched],
    verifying: &Verifying,
) -> Result<(f64, &'static str), Error> {
    let size_px = entry.interior.size_px();
    let larger = f64::from(size_px[0].max(size_px[1]));
    let candidates: Vec<f64> = (0..12).map(|k| larger * 0.5 * 1.18f64.powi(k)).collect();
    let lens =
        |c: &f64| camera_at(&entry.name, Model::Brown, size_px, *c).map(|camera| camera.interior);
    let lenses: Vec<Interior> = candidates.iter().map(lens).collect::<Result<_, _>>()?;
    let fine = Verifying { tolerance_px: FINE_PX, ..*verifying };
    let shares = shares_by_lens(features, own, &lenses, &fine);
    // Photos of a plane from above say little: then the usual is as good.
    Ok(match peak(&candidates, &shares) {
        Some(c) => (c, "which explains most of the matches"),
        None => (entry.interior.principal_distance_px(), "for want of anything better"),
    })
}

/// The middle, in ratios, of the principal distances that explain the largest shares; `None` where it makes no
/// difference.
fn peak(candidates: &[f64], shares: &[f64]) -> Option<f64> {
    let mut sorted = shares.to_vec();
    sorted.sort_by(f64::total_cmp);
    let most = *sorted.last()?;
    let lead = most - sorted[sorted.len() / 2];
    if lead <= AHEAD {
        return None;
    }
    let good: Vec<f64> = candidates
        .iter()
        .zip(shares)
        .filter(|(_, share)| **share >= most - AS_GOOD * lead)
        .map(|(c, _)| c.ln())
        .collect();
    Some((good.iter().sum::<f64>() / good.len() as f64).exp())
}

/// A lens that bends rays by `a`; `None` where its model has no such form.
fn bent(straight: &Interior, a: f64) -> Option<Interior> {
    let c = straight.principal_distance_px();
    let model = straight.model();
    let mut values = straight.values().to_vec();
    match model {
        Model::Smac => values[model.place("K1")?] = a / (c * c),
        Model::Brown => {
            let [k1, k2] = forward(a, 0.5 * diagonal(straight) / c);
            values[model.place("k1")?] = k1;
            values[model.place("k2")?] = k2;
        }
        Model::Fisheye | Model::Bal => return None,
    }
    straight.with_values(&values).ok()
}

fn diagonal(lens: &Interior) -> f64 {
    let [width, height] = lens.size_px().map(f64::from);
    width.hypot(height)
}

/// The two coefficients of `r = s (1 + k1 s^2 + k2 s^4)` that come nearest to the inverse of
/// `s = r (1 + a r^2)` up to a measured radius.
fn forward(a: f64, most: f64) -> [f64; 2] {
    let (mut n11, mut n12, mut n22, mut b1, mut b2) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for k in 1..=40 {
        let r = most * f64::from(k) / 40.0;
        let s = r * (1.0 + a * r * r);
        let (f1, f2, rest) = (s.powi(3), s.powi(5), r - s);
        n11 += f1 * f1;
        n12 += f1 * f2;
        n22 += f2 * f2;
        b1 += f1 * rest;
        b2 += f2 * rest;
    }
    let determinant = n11 * n22 - n12 * n12;
    if determinant <= 1e-12 * n11 * n22 {
        return [if n11 > 0.0 { b1 / n11 } else { 0.0 }, 0.0];
    }
    [(b1 * n22 - b2 * n12) / determinant, (b2 * n11 - b1 * n12) / determinant]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_models_bend_a_ray_alike() {
        for a in [-0.1f64, 0.1, 0.26, 0.52] {
            // SMAC has the very form; two terms of its inverse come near enough to begin with, and are worth
            // less the more a lens bends.
            let near = if a.abs() < 0.3 { 0.04 } else { 0.2 };
            for (model, near) in [(Model::Smac, 1e-9), (Model::Brown, near)] {
                let straight = camera_at("", model, [2288, 1716], 1000.0).unwrap().interior;
                let lens = bent(&straight, a).unwrap();
                for far in [0.0, 300.0, 800.0, 1100.0] {
                    let at = [1143.5 + far, 857.5];
                    let Some([x, _, z]) = lens.unproject(at) else {
                        panic!("{model:?}, {a}: nothing at {far}");
                    };
                    let r = far / 1000.0;
                    let wanted = r * (1.0 + a * r * r);
                    assert!((x / -z - wanted).abs() < near, "{model:?}, {a}, {far}: {}", x / -z);
                    assert!((x / -z - r) * a >= 0.0, "{model:?}, {a}, {far}: the other way");
                }
            }
        }
        assert_eq!(forward(0.0, 1.0), [0.0, 0.0]);
    }

    #[test]
    fn a_principal_distance_must_stand_out() {
        let candidates = [1000.0, 1200.0, 1440.0, 1728.0, 2074.0];
        let flat = peak(&candidates, &[0.97, 0.98, 0.975, 0.97, 0.96]);
        assert_eq!(flat, None);
        let between = peak(&candidates, &[0.80, 0.95, 0.95, 0.85, 0.80]).unwrap();
        assert!((between - 1000.0 * 1.2f64.powf(1.5)).abs() < 1e-6, "{between}");
        assert_eq!(peak(&[], &[]), None);
    }
}
