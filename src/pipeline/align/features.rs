//! The step that looks at pixels: features of every photo.

use super::{
    EnlargeChoice,
    descriptor_store::{Bytes, DescriptorStore},
    enlarge::detect,
    inputs::Inputs,
    sharpness::{self, Quality},
};
use crate::{
    error::Error,
    features::{
        self, Descriptors,
        pairs::{self, CoarseOptions},
    },
    io::images,
    monitor::{Counter, Diagnostic, Monitor},
    pipeline::record::{Cache, Key},
    sfm,
};
use image::RgbImage;
use serde::{Deserialize, Serialize};

/// Features of a photo with their colours; the descriptors are in a file beside it.
#[derive(Serialize, Deserialize, Default)]
struct Found {
    width_px: u32,
    height_px: u32,
    /// `u, v` of each.
    positions_px: Vec<f32>,
    colours: Bytes,
    /// Descriptors of those of the largest scales.
    largest: Bytes,
    /// Median blur of the features, where there are enough.
    feature_sigma_px: Option<f32>,
    /// Shares of the pixels that are black, and white.
    clipped: [f32; 2],
    /// Why there are none, where the photo could not be used.
    fault: Option<String>,
}

/// Features of all photos.
pub(super) struct Extracted {
    /// What the geometry needs of each photo.
    pub(super) geometric: Vec<sfm::Features>,
    /// Descriptors of the features of the largest scales, for a first look.
    pub(super) largest: Vec<Descriptors>,
    /// Those of all features.
    pub(super) descriptors: DescriptorStore,
    /// Key of all of it.
    pub(super) key: Key,
}

/// Where the features are kept.
pub(super) const FEATURES: &str = "features";
/// Where, within that, the descriptors are kept.
const DESCRIPTORS: &str = "descriptors";

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
    let (mut geometric, mut largest) = (Vec::new(), Vec::new());
    let key = |k: usize| Key::begin().text(&described).key(inputs.photos[k].content).finish();
    let name = |k: usize| format!("{}.cbor", inputs.photos[k].content);
    let mut descriptors = DescriptorStore::new(cache.within(DESCRIPTORS)?);
    let names: Vec<String> =
        (0..inputs.photos.len()).map(name).chain([DESCRIPTORS.to_owned()]).collect();
    cache.retain(&names)?;
    descriptors.cache().retain(&names)?;
    // While the features of one photo are looked for, the next is decoded.
    let decode = |k: usize| -> Option<Result<RgbImage, String>> {
        let photo = inputs.photos.get(k)?;
        let key = key(k);
        let known = cache.load::<Found>(&name(k), key);
        if known.is_some() && descriptors.cache().load::<Bytes>(&name(k), key).is_some() {
            return None;
        }
        Some(images::read_photo(&photo.path).map_err(|e| e.to_string()))
    };
    let mut next = decode(0);
    let mut stored = Vec::new();
    for k in 0..inputs.photos.len() {
        let (photo_key, name) = (key(k), name(k));
        let picture = next.take();
        let (found, following) = rayon::join(
            || picture.map(|picture| find(picture, options, enlarge)),
            || decode(k + 1),
        );
        next = following;
        let found = match found {
            Some((found, looks)) => {
                descriptors.cache().save(&name, photo_key, &looks)?;
                cache.save(&name, photo_key, &found)?;
                found
            }
            None => cache.load::<Found>(&name, photo_key).unwrap_or_default(),
        };
        stored.push((name, photo_key));
        let photo = &inputs.photos[k];
        let count = found.positions_px.len() / 2;
        if let Some(fault) = &found.fault {
            faults.push(Diagnostic::warning(
                "photo-unusable",
                photo.name.as_str(),
                format!("it cannot be used: {fault}"),
            ));
        } else if count < LEAST_FEATURES {
            faults.push(Diagnostic::warning(
                "few-features",
                photo.name.as_str(),
                format!("it shows next to nothing: {count} features"),
            ));
        }
        qualities.push(Quality {
            name: &photo.name,
            size_px: [found.width_px, found.height_px],
            feature_sigma_px: found.feature_sigma_px,
            clipped: found.clipped,
        });
        whole_key = whole_key.key(photo_key);
        geometric.push(sfm::Features {
            name: photo.name.clone(),
            camera: photo.camera,
            positions_px: found
                .positions_px
                .as_chunks()
                .0
                .iter()
                .map(|at| at.map(f64::from))
                .collect(),
            colours: found.colours.0.as_chunks::<3>().0.to_vec(),
        });
        largest.push(Descriptors::from_bytes(found.largest.0).unwrap_or_default());
        counter.tick();
    }
    descriptors.hold(stored);
    faults.extend(sharpness::judge(&qualities));
    faults.iter().for_each(|fault| monitor.diagnostic(fault));
    Ok(Extracted { geometric, largest, descriptors, key: whole_key.finish() })
}

fn find(
    picture: Result<RgbImage, String>,
    options: &features::FeatureOptions,
    enlarge: EnlargeChoice,
) -> (Found, Bytes) {
    let picture = match picture {
        Ok(picture) => picture,
        Err(fault) => return (Found { fault: Some(fault), ..Found::default() }, Bytes::default()),
    };
    let grey = features::grey(&picture);
    let found = detect(&grey, options, enlarge);
    let share = |is: &dyn Fn(u8) -> bool| {
        grey.as_raw().iter().filter(|&&value| is(value)).count() as f32 / grey.len().max(1) as f32
    };
    let largest = pairs::largest(&found, CoarseOptions::default().features);
    let sigmas_px = found.key_points.iter().map(|point| point.sigma_px).collect();
    let mut out = Found {
        clipped: [share(&|value| value < 3), share(&|value| value > 252)],
        width_px: found.width_px,
        height_px: found.height_px,
        largest: Bytes(largest.as_bytes().to_vec()),
        feature_sigma_px: (found.key_points.len() >= LEAST_FEATURES)
            .then(|| sharpness::median(sigmas_px)),
        ..Found::default()
    };
    for point in &found.key_points {
        out.positions_px.extend([point.u_px, point.v_px]);
        let side = |at: f32, size: u32| (at.round().max(0.0) as u32).min(size - 1);
        let (u, v) = (side(point.u_px, picture.width()), side(point.v_px, picture.height()));
        out.colours.0.extend(picture.get_pixel(u, v).0);
    }
    (out, Bytes(found.descriptors.as_bytes().to_vec()))
}
