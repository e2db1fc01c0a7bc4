//! Lenses that nobody has calibrated: a principal distance to start with where the files tell none, and how strong the
//! distortion is, both by how many of the matches each of some lenses explains.
//!
//! With the principal distance `c` and a measured radius `r = |x - x0| / c` the lenses tried are
//! `r_ideal = r (1 + a r^2)`: a wide lens of an action camera has an `a` of 0.2 to 0.5, and without it three
//! pairs of photos do not close a loop. SMAC has that very form. Brown, from ideal to measured, comes near it with
//! two terms while `a` is small, and not where the rays at the corners are bent by half: such lenses are SMAC's where
//! nobody asked for one of the two.

use super::{
    Features,
    verify::{GeometricVerificationOptions, PairMatches, shares_by_lens},
};
use crate::camera::{Camera, CameraError, Interior, Lens, Model};
use serde::{Deserialize, Serialize};

/// The lens model of cameras that are not given.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LensChoice {
    /// Brown, or SMAC where that explains clearly more matches: lenses with strong distortion.
    #[default]
    Auto,
    /// Ideal to measured, radial and decentring distortion, as in OpenCV and COLMAP.
    Brown,
    /// Measured to ideal, as in the paper.
    Smac,
}

rowgram_base::choices!(LensChoice: Auto, Brown, Smac);

impl LensChoice {
    /// The model to start with.
    pub fn model(self) -> Model {
        match self {
            LensChoice::Auto | LensChoice::Brown => Model::Brown,
            LensChoice::Smac => Model::Smac,
        }
    }
}

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

/// What is known of a camera before anything is adjusted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct InitialIntrinsics {
    /// Its lens model.
    pub model: Model,
    /// The values of the model's parameters.
    pub values: Vec<f64>,
    /// Standard deviation of the principal distance, pixels.
    pub principal_distance_sigma_px: Option<f64>,
    /// What was found, for people.
    pub notes: Vec<String>,
}

impl InitialIntrinsics {
    /// Puts them into a camera.
    ///
    /// # Errors
    /// Values that the model cannot have.
    pub fn apply(&self, camera: &mut Camera) -> Result<(), CameraError> {
        if camera.interior.model() != self.model {
            let c = camera.interior.principal_distance_px();
            *camera = without_distortion(&camera.name, self.model, camera.interior.size_px(), c)?;
        }
        camera.interior = camera.interior.with_values(&self.values)?;
        camera.standard_deviations[0] = self.principal_distance_sigma_px;
        Ok(())
    }
}

/// A camera without distortion.
///
/// # Errors
/// A principal distance that is not positive.
pub fn without_distortion(
    name: &str,
    model: Model,
    size_px: [u32; 2],
    principal_distance_px: f64,
) -> Result<Camera, CameraError> {
    let mut values: Vec<f64> = (0..model.parameters().len())
        .map(|index| model.default_value(index, size_px).unwrap_or(0.0))
        .collect();
    values[0] = principal_distance_px;
    Ok(Camera::new(name, Interior::new(model, size_px, &values)?))
}

/// The parameters that a block determines of a lens: all but the aspect and rational terms, or of a `whole` lens only
/// the principal distance and two radial terms.
pub fn estimable(model: Model, whole: bool) -> Vec<String> {
    let wanted: &[&str] = match (whole, model) {
        (true, Model::Smac) => &["c_px", "xp_px", "yp_px", "K1", "K2", "K3", "P1", "P2"],
        (false, Model::Smac) => &["c_px", "K1", "K2"],
        (true, _) => &["f_px", "cx_px", "cy_px", "k1", "k2", "k3", "p1", "p2"],
        (false, _) => &["f_px", "k1", "k2"],
    };
    let known = wanted.iter().filter(|name| model.place(name).is_some());
    known.map(|&name| name.to_owned()).collect()
}

/// A lens to start with for the camera with index `camera`, from the matches of its photos; `is_known` says that its
/// principal distance comes from somewhere.
///
/// # Errors
/// A camera whose principal distance is not positive.
pub fn initialize_intrinsics(
    (entry, camera): (&Camera, usize),
    is_known: bool,
    features: &[Features],
    matched: &[PairMatches],
    (verification, wanted): (&GeometricVerificationOptions, LensChoice),
) -> Result<InitialIntrinsics, CameraError> {
    let mut own: Vec<&PairMatches> = matched
        .iter()
        .filter(|m| m.images.iter().all(|&k| features[k as usize].camera == camera))
        .collect();
    own.sort_by(|a, b| b.matches.len().cmp(&a.matches.len()).then(a.images.cmp(&b.images)));
    own.truncate(PAIRS);
    let own: Vec<PairMatches> = own.into_iter().cloned().collect();
    let mut found = entry.clone();
    let mut told = Vec::new();
    if !is_known {
        let (c, what) = principal_distance(entry, features, &own, verification)?;
        found =
            without_distortion(&entry.name, entry.interior.model(), entry.interior.size_px(), c)?;
        found.standard_deviations[0] = Some(0.3 * c);
        told.push(format!("its principal distance starts at {c:.0} px, {what}"));
    }
    let straight = found.interior;
    let fine = GeometricVerificationOptions { tolerance_px: TOLERANCE_PX, ..*verification };
    let (least, bends) = explaining(&straight, features, &own, &fine);
    let mut smac = straight.model() == Model::Smac;
    let mut begin = bends;
    if wanted == LensChoice::Auto {
        let c = straight.principal_distance_px();
        let other = without_distortion(&entry.name, Model::Smac, entry.interior.size_px(), c)?;
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
            "its lens has radial distortion: a start value was chosen with which {:.0} per cent of the matches agree, {:.0} without{}",
            100.0 * share,
            100.0 * least,
            if smac && wanted == LensChoice::Auto {
                " (the SMAC model; COLMAP and OpenSfM have none such: [align] lens = \"brown\" for those)"
            } else {
                ""
            }
        ));
    }
    Ok(InitialIntrinsics {
        model: if smac { Model::Smac } else { found.interior.model() },
        values: found.interior.values().to_vec(),
        principal_distance_sigma_px: found.standard_deviations[0],
        notes: told,
    })
}

/// The share of the matches that agrees with a lens without distortion, and the bent one that explains clearly more,
/// with its share.
fn explaining(
    straight: &Interior,
    features: &[Features],
    own: &[PairMatches],
    fine: &GeometricVerificationOptions,
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
    features: &[Features],
    own: &[PairMatches],
    verification: &GeometricVerificationOptions,
) -> Result<(f64, &'static str), CameraError> {
    let size_px = entry.interior.size_px();
    let larger = f64::from(size_px[0].max(size_px[1]));
    let candidates: Vec<f64> = (0..12).map(|k| larger * 0.5 * 1.18f64.powi(k)).collect();
    let lens = |c: &f64| {
        without_distortion(&entry.name, Model::Brown, size_px, *c).map(|camera| camera.interior)
    };
    let lenses: Vec<Interior> = candidates.iter().map(lens).collect::<Result<_, _>>()?;
    let fine = GeometricVerificationOptions { tolerance_px: FINE_PX, ..*verification };
    let shares = shares_by_lens(features, own, &lenses, &fine);
    // Photos of a plane from above say little: then the usual is as good.
    Ok(match peak(&candidates, &shares) {
        Some(c) => (c, "which explains most matches"),
        None => {
            (entry.interior.principal_distance_px(), "the usual value, as the matches do not tell")
        }
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
                let straight =
                    without_distortion("", model, [2288, 1716], 1000.0).unwrap().interior;
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
