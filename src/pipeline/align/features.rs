//! The steps that look at pixels: features of every photo, matches of the pairs worth trying.

use super::{
    EnlargeChoice,
    enlarge::detect,
    inputs::Inputs,
    sharpness::{self, Quality},
};
use crate::{
    error::Error,
    features::{
        self, Descriptors, KeyPoint,
        matching::{MatchOptions, Prepared, match_prepared},
        pairs,
    },
    io::images,
    monitor::{Counter, Diagnostic, Monitor},
    pipeline::record::{Cache, Key},
    sfm::{self, verify::PairMatches},
};
use image::RgbImage;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Features of a photo with their colours.
#[derive(Serialize, Deserialize, Default)]
pub(super) struct Found {
    width_px: u32,
    height_px: u32,
    /// `u, v, sigma, angle, response` of each.
    numbers: Vec<f32>,
    #[serde(with = "serde_bytes")]
    descriptors: Vec<u8>,
    #[serde(with = "serde_bytes")]
    colours: Vec<u8>,
    /// Shares of the pixels that are black, and white.
    clipped: [f32; 2],
    /// Why there are none, where the photo could not be used.
    fault: Option<String>,
}

mod serde_bytes {
    //! Bytes as one CBOR string instead of a list of numbers.
    use serde::{Deserializer, Serializer, de::Visitor};

    pub(super) fn serialize<S: Serializer>(bytes: &[u8], serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_bytes(bytes)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<u8>, D::Error> {
        struct Bytes;
        impl Visitor<'_> for Bytes {
            type Value = Vec<u8>;
            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("bytes")
            }
            fn visit_bytes<E>(self, v: &[u8]) -> Result<Vec<u8>, E> {
                Ok(v.to_vec())
            }
            fn visit_byte_buf<E>(self, v: Vec<u8>) -> Result<Vec<u8>, E> {
                Ok(v)
            }
        }
        from.deserialize_byte_buf(Bytes)
    }
}

/// Features of all photos.
pub(super) struct Extracted {
    pub(super) features: Vec<features::Features>,
    pub(super) colours: Vec<Vec<[u8; 3]>>,
    /// Key of all of it.
    pub(super) key: Key,
}

/// Where the features are kept.
pub(super) const FEATURES: &str = "features";
/// Where the matches are kept.
pub(super) const MATCHES: &str = "matches.cbor";

/// A photo with fewer features shows nothing.
const LEAST_FEATURES: usize = 30;

/// Finds the features of all photos; those whose photo cannot be used are empty and named.
pub(super) fn features(
    inputs: &Inputs,
    options: &features::FeatureOptions,
    enlarge: EnlargeChoice,
    cache: &Cache,
    monitor: &mut dyn Monitor,
) -> Result<Extracted, Error> {
    let cache = cache.within(FEATURES)?;
    let described = format!("{options:?} {enlarge:?}");
    let counter = Counter::new(monitor, "detecting features", inputs.photos.len(), "photos");
    let (mut faults, mut qualities) = (Vec::new(), Vec::new());
    let mut whole_key = Key::begin().text(&described);
    let (mut all, mut colours) = (Vec::new(), Vec::new());
    let key = |k: usize| {
        let content = inputs.photos[k].content;
        (Key::begin().text(&described).key(content).finish(), format!("{content}.cbor"))
    };
    let names: Vec<String> = (0..inputs.photos.len()).map(|k| key(k).1).collect();
    cache.retain(&names)?;
    // While the features of one photo are looked for, the next is decoded.
    let decode = |k: usize| -> Option<Result<RgbImage, String>> {
        let photo = inputs.photos.get(k)?;
        let (key, name) = key(k);
        if cache.load::<Found>(&name, key).is_some() {
            return None;
        }
        Some(images::read_photo(&photo.path).map_err(|e| e.to_string()))
    };
    let mut next = decode(0);
    for k in 0..inputs.photos.len() {
        let (photo_key, name) = key(k);
        let picture = next.take();
        let (found, following) = rayon::join(
            || picture.map(|picture| find(picture, options, enlarge)),
            || decode(k + 1),
        );
        next = following;
        let found = match found {
            Some(found) => {
                cache.save(&name, photo_key, &found)?;
                found
            }
            None => cache.load::<Found>(&name, photo_key).unwrap_or_default(),
        };
        let photo = &inputs.photos[k];
        if let Some(fault) = &found.fault {
            faults.push(Diagnostic::warning(
                "photo-unusable",
                photo.name.as_str(),
                format!("it cannot be used: {fault}"),
            ));
        } else if found.numbers.len() < 5 * LEAST_FEATURES {
            faults.push(Diagnostic::warning(
                "few-features",
                photo.name.as_str(),
                format!("it shows next to nothing: {} features", found.numbers.len() / 5),
            ));
        }
        let sigmas_px = found.numbers.as_chunks::<5>().0.iter().map(|v| v[2]);
        qualities.push(Quality {
            name: &photo.name,
            size_px: [found.width_px, found.height_px],
            feature_sigma_px: (found.numbers.len() >= 5 * LEAST_FEATURES)
                .then(|| sharpness::median(sigmas_px.collect())),
            clipped: found.clipped,
        });
        whole_key = whole_key.key(photo_key);
        let key_points = found.numbers.as_chunks::<5>().0.iter().map(|v| KeyPoint {
            u_px: v[0],
            v_px: v[1],
            sigma_px: v[2],
            angle_rad: v[3],
            response: v[4],
        });
        all.push(features::Features {
            width_px: found.width_px,
            height_px: found.height_px,
            key_points: key_points.collect(),
            descriptors: Descriptors::from_bytes(found.descriptors).unwrap_or_default(),
        });
        colours.push(found.colours.as_chunks::<3>().0.to_vec());
        counter.tick();
    }
    faults.extend(sharpness::judge(&qualities));
    faults.iter().for_each(|fault| monitor.diagnostic(fault));
    Ok(Extracted { features: all, colours, key: whole_key.finish() })
}

fn find(
    picture: Result<RgbImage, String>,
    options: &features::FeatureOptions,
    enlarge: EnlargeChoice,
) -> Found {
    let picture = match picture {
        Ok(picture) => picture,
        Err(fault) => return Found { fault: Some(fault), ..Found::default() },
    };
    let grey = features::grey(&picture);
    let found = detect(&grey, options, enlarge);
    let share = |is: &dyn Fn(u8) -> bool| {
        grey.as_raw().iter().filter(|&&value| is(value)).count() as f32 / grey.len().max(1) as f32
    };
    let mut out = Found {
        clipped: [share(&|value| value < 3), share(&|value| value > 252)],
        width_px: found.width_px,
        height_px: found.height_px,
        descriptors: found.descriptors.as_bytes().to_vec(),
        ..Found::default()
    };
    for point in &found.key_points {
        out.numbers.extend([
            point.u_px,
            point.v_px,
            point.sigma_px,
            point.angle_rad,
            point.response,
        ]);
        let side = |at: f32, size: u32| (at.round().max(0.0) as u32).min(size - 1);
        let (u, v) = (side(point.u_px, picture.width()), side(point.v_px, picture.height()));
        out.colours.extend(picture.get_pixel(u, v).0);
    }
    out
}

impl Extracted {
    /// The descriptors of every photo.
    pub(super) fn descriptors(&self) -> Vec<&Descriptors> {
        self.features.iter().map(|features| &features.descriptors).collect()
    }

    /// What the geometry needs of it.
    pub(super) fn geometric(&self, inputs: &Inputs) -> Vec<sfm::Features> {
        let of = |k: usize| sfm::Features {
            name: inputs.photos[k].name.clone(),
            camera: inputs.photos[k].camera,
            positions_px: self.features[k]
                .key_points
                .iter()
                .map(|point| [f64::from(point.u_px), f64::from(point.v_px)])
                .collect(),
            colours: self.colours[k].clone(),
        };
        (0..inputs.photos.len()).map(of).collect()
    }
}

/// How pairs are chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Choice {
    /// Neighbours by position that are looked at.
    pub(super) nearest: usize,
    /// Photos that follow in time.
    pub(super) following: usize,
    /// Pairs of each photo that are matched in full.
    pub(super) partners: usize,
    /// Photos that follow in time, and half of the nearest ones, that are matched in any case.
    pub(super) certain: usize,
    /// Features of a first, coarse look.
    pub(super) coarse_features: usize,
    /// The fewest coarse matches.
    pub(super) coarse_matches: usize,
}

impl Default for Choice {
    fn default() -> Choice {
        Choice {
            nearest: 40,
            following: 3,
            partners: 16,
            certain: 2,
            coarse_features: 768,
            coarse_matches: 4,
        }
    }
}

/// Up to so many photos without positions everything is compared with everything, coarsely.
const MOST_EXHAUSTIVE: usize = 1000;

/// Photos that follow each other in time, up to `reach` apart.
fn following(inputs: &Inputs, reach: usize) -> Vec<pairs::Pair> {
    let order = inputs.flight();
    pairs::in_sequence(order.len(), reach)
        .into_iter()
        .map(|[a, b]| [order[a].min(order[b]), order[a].max(order[b])])
        .collect()
}

/// Pairs worth a look: neighbours by position, those that follow each other, and all where there is
/// neither.
fn candidates(inputs: &Inputs, choice: &Choice) -> Vec<pairs::Pair> {
    let n = inputs.photos.len();
    let placed = inputs.plan_m.iter().filter(|p| p[0].is_finite()).count();
    let mut lists = vec![following(inputs, choice.following)];
    if placed * 2 >= n {
        lists.push(pairs::nearest(&inputs.plan_m, choice.nearest, f64::INFINITY));
        // A photo without a position may belong anywhere.
        let lost: Vec<usize> = (0..n).filter(|&k| !inputs.plan_m[k][0].is_finite()).collect();
        let with_lost = lost
            .iter()
            .flat_map(|&a| (0..n).filter(move |&b| b != a).map(move |b| [a.min(b), a.max(b)]));
        lists.push(with_lost.collect());
    } else if n <= MOST_EXHAUSTIVE {
        lists.push(pairs::all(n));
    }
    pairs::join(&lists)
}

/// Matches the pairs worth it.
pub(super) fn matches(
    inputs: &Inputs,
    extracted: &Extracted,
    cache: &Cache,
    monitor: &mut dyn Monitor,
) -> Result<(Vec<PairMatches>, Key), Error> {
    let (choice, options) = (&Choice::default(), &MatchOptions::default());
    let candidates = candidates(inputs, choice);
    let key = candidates
        .iter()
        .fold(Key::begin().key(extracted.key), |key, [a, b]| key.count(*a as u64).count(*b as u64))
        .text(&format!("{choice:?} {options:?}"))
        .finish();
    if let Some(found) = cache.load::<Vec<([u32; 2], Vec<[u32; 2]>)>>(MATCHES, key) {
        let found = found.into_iter().map(|(images, matches)| PairMatches { images, matches });
        return Ok((found.collect(), key));
    }
    // The nearest few and those that follow each other are matched whatever the coarse look says:
    // on a plain crop it sees little.
    let close = [
        following(inputs, choice.certain),
        pairs::nearest(&inputs.plan_m, 2 * choice.certain, f64::INFINITY),
    ];
    let shortlist = shortlist(extracted, &candidates, (choice, options), monitor);
    let chosen = pairs::join(&[shortlist, pairs::join(&close)]);
    let prepared: Vec<Prepared<'_>> =
        extracted.features.par_iter().map(|f| Prepared::new(&f.descriptors)).collect();
    let counter = Counter::new(monitor, "matching", chosen.len(), "pairs");
    let found: Vec<PairMatches> = chosen
        .par_iter()
        .map(|&[a, b]| {
            let found = match_prepared(&prepared[a], &prepared[b], options);
            counter.tick();
            PairMatches {
                images: [a as u32, b as u32],
                matches: found.iter().map(|m| [m.first, m.second]).collect(),
            }
        })
        .collect();
    let plain: Vec<([u32; 2], &Vec<[u32; 2]>)> =
        found.iter().map(|m| (m.images, &m.matches)).collect();
    cache.save(MATCHES, key, &plain)?;
    Ok((found, key))
}

/// A photo and its double match in at least this share of their features.
const DOUBLE_SHARE: f64 = 0.2;
/// And stand this close to each other in the middle, pixels.
const DOUBLE_PX: f32 = 0.5;

/// Removes photos that show the same as another, pixel by pixel, from the matches: saved twice, they
/// have no base and tell nothing. Of two the one that has a position stays, or else the first.
pub(super) fn remove_duplicates(
    inputs: &Inputs,
    extracted: &Extracted,
    matched: &mut Vec<PairMatches>,
    monitor: &mut dyn Monitor,
) {
    let mut out = vec![false; inputs.photos.len()];
    for pair in matched.iter() {
        let [a, b] = pair.images.map(|k| k as usize);
        let [first, second] = [a, b].map(|k| &extracted.features[k].key_points);
        let fewer = first.len().min(second.len());
        if out[a] || out[b] || (pair.matches.len() as f64) < DOUBLE_SHARE * fewer as f64 {
            continue;
        }
        let mut apart: Vec<f32> = pair
            .matches
            .iter()
            .map(|[i, j]| {
                let (p, q) = (&first[*i as usize], &second[*j as usize]);
                (p.u_px - q.u_px).hypot(p.v_px - q.v_px)
            })
            .collect();
        apart.sort_by(f32::total_cmp);
        if apart.get(apart.len() / 2).is_none_or(|&middle| middle > DOUBLE_PX) {
            continue;
        }
        let placed = |k: usize| inputs.plan_m[k][0].is_finite();
        let (stays, goes) = if placed(b) && !placed(a) { (b, a) } else { (a, b) };
        out[goes] = true;
        let message = format!("it shows the same as {}: left out", inputs.photos[stays].name);
        let subject = inputs.photos[goes].name.as_str();
        monitor.diagnostic(&Diagnostic::warning("duplicate-photo", subject, message));
    }
    matched.retain(|pair| pair.images.iter().all(|&k| !out[k as usize]));
}

/// A coarse look at the candidates: features of the largest scales, and of each photo the pairs with
/// most matches.
fn shortlist(
    extracted: &Extracted,
    candidates: &[pairs::Pair],
    (choice, options): (&Choice, &MatchOptions),
    monitor: &mut dyn Monitor,
) -> Vec<pairs::Pair> {
    let few: Vec<Descriptors> = extracted
        .features
        .par_iter()
        .map(|photo| {
            let mut order: Vec<usize> = (0..photo.key_points.len()).collect();
            order.sort_by(|&a, &b| {
                let (a_px, b_px) = (photo.key_points[a].sigma_px, photo.key_points[b].sigma_px);
                b_px.total_cmp(&a_px).then(a.cmp(&b))
            });
            order.truncate(choice.coarse_features);
            photo.descriptors.select(&order)
        })
        .collect();
    let prepared: Vec<Prepared<'_>> = few.par_iter().map(Prepared::new).collect();
    let counter = Counter::new(monitor, "choosing pairs", candidates.len(), "pairs");
    let mut counted: Vec<(usize, pairs::Pair)> = candidates
        .par_iter()
        .map(|&[a, b]| {
            counter.tick();
            (match_prepared(&prepared[a], &prepared[b], options).len(), [a, b])
        })
        .filter(|(count, _)| *count >= choice.coarse_matches)
        .collect();
    counted.sort_by(|a, b| b.0.cmp(&a.0).then(a.1.cmp(&b.1)));
    let mut partners = vec![0; extracted.features.len()];
    let mut chosen: Vec<pairs::Pair> = Vec::new();
    for (_, [a, b]) in counted {
        if partners[a] < choice.partners || partners[b] < choice.partners {
            partners[a] += 1;
            partners[b] += 1;
            chosen.push([a, b]);
        }
    }
    chosen.sort_unstable();
    chosen
}
