//! The stages that look at pixels: features of every photo, matches of the pairs worth trying.

use super::{Finding, cache::Cache, project::Project};
use crate::{
    error::Error,
    features::{
        self, Descriptors, KeyPoint,
        matching::{MatchOptions, Prepared, match_prepared},
        pairs,
    },
    io::images,
    sfm::{self, verify::Matched},
};
use image::RgbImage;
use indicatif::{ProgressBar, ProgressStyle};
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
    /// Mark of all of it.
    pub(super) mark: u64,
}

/// A bar with rate and time left.
pub(super) fn bar(count: usize, message: &'static str) -> ProgressBar {
    let style =
        ProgressStyle::with_template("{msg:10} {wide_bar} {pos}/{len} {per_sec} {eta} left")
            .unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(count as u64).with_style(style).with_message(message)
}

/// A photo with fewer features shows nothing.
const LEAST_FEATURES: usize = 30;

/// Finds the features of all photos; those whose photo cannot be used are empty and named.
pub(super) fn features(
    project: &Project,
    options: &features::Options,
    (cache, fresh): (&Cache, bool),
    findings: &mut Vec<Finding>,
) -> Result<Extracted, Error> {
    let cache = cache.within("features")?;
    let described = format!("{options:?}");
    let progress = bar(project.photos.len(), "features");
    let mut all = Extracted { features: Vec::new(), colours: Vec::new(), mark: 0 };
    let mut mark = Cache::mark().text(&described);
    let key = |k: usize| {
        let photo = &project.photos[k];
        (
            Cache::mark().text(&described).count(photo.content).finish(),
            format!("{:016x}.cbor", photo.content),
        )
    };
    // While the features of one photo are looked for, the next is decoded.
    let decode = |k: usize| -> Option<Result<RgbImage, String>> {
        let photo = project.photos.get(k)?;
        let (mark, name) = key(k);
        if !fresh && cache.load::<Found>(&name, mark).is_some() {
            return None;
        }
        Some(images::read_photo(&photo.path).map_err(|e| e.to_string()))
    };
    let mut next = decode(0);
    for k in 0..project.photos.len() {
        let (photo_mark, name) = key(k);
        let picture = next.take();
        let (found, following) =
            rayon::join(|| picture.map(|picture| find(picture, options)), || decode(k + 1));
        next = following;
        let found = match found {
            Some(found) => {
                cache.save(&name, photo_mark, &found)?;
                found
            }
            None => cache.load::<Found>(&name, photo_mark).unwrap_or_default(),
        };
        let photo = &project.photos[k];
        if let Some(fault) = &found.fault {
            findings.push(Finding::new(&photo.name, &format!("it cannot be used: {fault}")));
        } else if found.numbers.len() < 5 * LEAST_FEATURES {
            findings.push(Finding::new(
                &photo.name,
                &format!("it shows next to nothing: {} features", found.numbers.len() / 5),
            ));
        }
        mark = mark.count(photo_mark);
        let key_points = found.numbers.as_chunks::<5>().0.iter().map(|v| KeyPoint {
            u_px: v[0],
            v_px: v[1],
            sigma_px: v[2],
            angle_rad: v[3],
            response: v[4],
        });
        all.features.push(features::Features {
            width_px: found.width_px,
            height_px: found.height_px,
            key_points: key_points.collect(),
            descriptors: Descriptors::from_bytes(found.descriptors).unwrap_or_default(),
        });
        all.colours.push(found.colours.as_chunks::<3>().0.to_vec());
        progress.inc(1);
    }
    progress.finish_and_clear();
    all.mark = mark.finish();
    Ok(all)
}

fn find(picture: Result<RgbImage, String>, options: &features::Options) -> Found {
    let picture = match picture {
        Ok(picture) => picture,
        Err(fault) => return Found { fault: Some(fault), ..Found::default() },
    };
    let grey = features::grey(&picture);
    let found = features::detect(&grey, options);
    let mut out = Found {
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
    /// What the geometry needs of it.
    pub(super) fn geometric(&self, project: &Project) -> Vec<sfm::Features> {
        let of = |k: usize| sfm::Features {
            name: project.photos[k].name.clone(),
            camera: project.photos[k].camera,
            positions_px: self.features[k]
                .key_points
                .iter()
                .map(|point| [f64::from(point.u_px), f64::from(point.v_px)])
                .collect(),
            colours: self.colours[k].clone(),
        };
        (0..project.photos.len()).map(of).collect()
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
fn following(project: &Project, reach: usize) -> Vec<pairs::Pair> {
    let order = project.flight();
    pairs::in_sequence(order.len(), reach)
        .into_iter()
        .map(|[a, b]| [order[a].min(order[b]), order[a].max(order[b])])
        .collect()
}

/// Pairs worth a look: neighbours by position, those that follow each other, and all where there is
/// neither.
fn candidates(project: &Project, choice: &Choice) -> Vec<pairs::Pair> {
    let n = project.photos.len();
    let placed = project.plan_m.iter().filter(|p| p[0].is_finite()).count();
    let mut lists = vec![following(project, choice.following)];
    if placed * 2 >= n {
        lists.push(pairs::nearest(&project.plan_m, choice.nearest, f64::INFINITY));
        // A photo without a position may belong anywhere.
        let lost: Vec<usize> = (0..n).filter(|&k| !project.plan_m[k][0].is_finite()).collect();
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
    project: &Project,
    extracted: &Extracted,
    choice: &Choice,
    options: &MatchOptions,
    (cache, fresh): (&Cache, bool),
) -> Result<(Vec<Matched>, u64), Error> {
    let candidates = candidates(project, choice);
    let mark = candidates
        .iter()
        .fold(Cache::mark().count(extracted.mark), |mark, [a, b]| {
            mark.count(*a as u64).count(*b as u64)
        })
        .text(&format!("{choice:?} {options:?}"))
        .finish();
    if let Some(found) =
        cache.load::<Vec<([u32; 2], Vec<[u32; 2]>)>>("matches.cbor", mark).filter(|_| !fresh)
    {
        let found = found.into_iter().map(|(images, matches)| Matched { images, matches });
        return Ok((found.collect(), mark));
    }
    // The nearest few and those that follow each other are matched whatever the coarse look says:
    // on a plain crop it sees little.
    let close = [
        following(project, choice.certain),
        pairs::nearest(&project.plan_m, 2 * choice.certain, f64::INFINITY),
    ];
    let chosen =
        pairs::join(&[shortlist(extracted, &candidates, choice, options), pairs::join(&close)]);
    let prepared: Vec<Prepared<'_>> =
        extracted.features.par_iter().map(|f| Prepared::new(&f.descriptors)).collect();
    let progress = bar(chosen.len(), "matching");
    let found: Vec<Matched> = chosen
        .par_iter()
        .map(|&[a, b]| {
            let found = match_prepared(&prepared[a], &prepared[b], options);
            progress.inc(1);
            Matched {
                images: [a as u32, b as u32],
                matches: found.iter().map(|m| [m.first, m.second]).collect(),
            }
        })
        .collect();
    progress.finish_and_clear();
    let plain: Vec<([u32; 2], &Vec<[u32; 2]>)> =
        found.iter().map(|m| (m.images, &m.matches)).collect();
    cache.save("matches.cbor", mark, &plain)?;
    Ok((found, mark))
}

/// A photo and its double match in at least this share of their features.
const DOUBLE_SHARE: f64 = 0.2;
/// And stand this close to each other in the middle, pixels.
const DOUBLE_PX: f32 = 0.5;

/// Takes pictures that show the same as another, pixel by pixel, out of the matches: saved twice, they
/// have no base and tell nothing. Of two the one that has a position stays, or else the first.
pub(super) fn take_out_doubles(
    project: &Project,
    extracted: &Extracted,
    matched: &mut Vec<Matched>,
    findings: &mut Vec<Finding>,
) {
    let mut out = vec![false; project.photos.len()];
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
        let placed = |k: usize| project.plan_m[k][0].is_finite();
        let (stays, goes) = if placed(b) && !placed(a) { (b, a) } else { (a, b) };
        out[goes] = true;
        findings.push(Finding::new(
            &project.photos[goes].name,
            &format!("it is the same picture as {}: left out", project.photos[stays].name),
        ));
    }
    matched.retain(|pair| pair.images.iter().all(|&k| !out[k as usize]));
}

/// A coarse look at the candidates: features of the largest scales, and of each photo the pairs with
/// most matches.
fn shortlist(
    extracted: &Extracted,
    candidates: &[pairs::Pair],
    choice: &Choice,
    options: &MatchOptions,
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
    let progress = bar(candidates.len(), "pairs");
    let mut counted: Vec<(usize, pairs::Pair)> = candidates
        .par_iter()
        .map(|&[a, b]| {
            progress.inc(1);
            (match_prepared(&prepared[a], &prepared[b], options).len(), [a, b])
        })
        .filter(|(count, _)| *count >= choice.coarse_matches)
        .collect();
    progress.finish_and_clear();
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
