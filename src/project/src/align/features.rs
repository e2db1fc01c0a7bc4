//! The step that looks at pixels: features of every photo.

use super::{
    When,
    descriptor_store::DescriptorStore,
    enlarge::detect,
    inputs::Inputs,
    sharpness::{self, Quality},
};
use crate::{
    batches::Part,
    features::require_memory,
    record::{Bytes, Key, Store},
};
use image::RgbImage;
use rowgram_base::{
    error::Error,
    monitor::{Counter, Diagnostic, Monitor},
};
use rowgram_files::images;
use rowgram_survey::{
    features::{
        self, Descriptors,
        pairs::{self, CoarseOptions},
    },
    sfm,
};
use serde::{Deserialize, Serialize};
use std::ops::Range;

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

/// The files with the features of the photos.
struct Files<'a> {
    inputs: &'a Inputs,
    options: &'a features::FeatureOptions,
    enlarge: When,
    /// Of all photos, what decides their features besides their content.
    described: String,
    store: Store,
    descriptors: Store,
}

/// What there is to do about a photo.
enum PhotoWork {
    /// Its features are there.
    Kept(Box<Found>),
    /// They have to be looked for.
    Photo(Result<RgbImage, String>),
}

impl<'a> Files<'a> {
    fn new(
        inputs: &'a Inputs,
        options: &'a features::FeatureOptions,
        enlarge: When,
        store: &Store,
    ) -> Files<'a> {
        let store = store.within(FEATURES);
        let descriptors = store.within(DESCRIPTORS);
        let described = format!("{options:?} {enlarge:?}");
        Files { inputs, options, enlarge, described, store, descriptors }
    }

    fn key(&self, k: usize) -> Key {
        Key::begin().text(&self.described).key(self.inputs.photos[k].content).finish()
    }

    fn name(&self, k: usize) -> String {
        self.inputs.photos[k].content.to_string()
    }

    /// Removes what was found in photos that are no longer there.
    fn retain(&self) -> Result<(), Error> {
        let names: Vec<String> = (0..self.inputs.photos.len()).map(|k| self.name(k)).collect();
        self.store.retain(&names)?;
        self.descriptors.retain(&names)
    }

    fn work(&self, k: usize) -> PhotoWork {
        let (key, name) = (self.key(k), self.name(k));
        if let Some(found) = self.store.load::<Found>(&name, key)
            && self.descriptors.load::<Bytes>(&name, key).is_some()
        {
            return PhotoWork::Kept(Box::new(found));
        }
        let path = &self.inputs.photos[k].path;
        let read = require_memory(path).and_then(|()| images::read_photo(path));
        PhotoWork::Photo(read.map_err(|e| e.to_string()))
    }

    /// The features of some photos, kept; while those of one are looked for, the next is decoded.
    fn each(&self, photos: Range<usize>, mut take: impl FnMut(usize, Found)) -> Result<(), Error> {
        let end = photos.end;
        let next = |k: usize| (k < end).then(|| self.work(k));
        let mut waiting = next(photos.start);
        for k in photos {
            let Some(work) = waiting.take() else { break };
            let (found, following) = rayon::join(
                || match work {
                    PhotoWork::Kept(found) => (*found, None),
                    PhotoWork::Photo(picture) => {
                        let (found, looks) = find(picture, self.options, self.enlarge);
                        (found, Some(looks))
                    }
                },
                || next(k + 1),
            );
            waiting = following;
            let (found, looks) = found;
            if let Some(looks) = looks {
                self.descriptors.save(&self.name(k), self.key(k), &looks)?;
                self.store.save(&self.name(k), self.key(k), &found)?;
            }
            take(k, found);
        }
        Ok(())
    }
}

/// Finds the features of a part of the photos and keeps them; gives the number of these photos.
pub(super) fn find_part(
    inputs: &Inputs,
    (options, enlarge): (&features::FeatureOptions, When),
    part: Part,
    store: &Store,
    monitor: &mut dyn Monitor,
) -> Result<usize, Error> {
    let files = Files::new(inputs, options, enlarge, store);
    let photos = part.range(inputs.photos.len());
    let count = photos.len();
    let counter = Counter::new(monitor, "detecting features", count, "photos");
    files.each(photos, |_, _| counter.tick())?;
    Ok(count)
}

/// Finds the features of all photos; those whose photo cannot be used are empty and named. Where other processes work on parts at the
/// same time (`alone` is false), nothing is removed.
pub(super) fn features(
    inputs: &Inputs,
    (options, enlarge): (&features::FeatureOptions, When),
    alone: bool,
    store: &Store,
    monitor: &mut dyn Monitor,
) -> Result<Extracted, Error> {
    let files = Files::new(inputs, options, enlarge, store);
    if alone {
        files.retain()?;
    }
    let counter = Counter::new(monitor, "detecting features", inputs.photos.len(), "photos");
    let (mut faults, mut qualities) = (Vec::new(), Vec::new());
    let mut whole_key = Key::begin().text(&files.described);
    let (mut geometric, mut largest, mut stored) = (Vec::new(), Vec::new(), Vec::new());
    files.each(0..inputs.photos.len(), |k, found| {
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
        stored.push((files.name(k), files.key(k)));
        whole_key = whole_key.clone().key(files.key(k));
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
    })?;
    let mut descriptors = DescriptorStore::new(files.descriptors);
    descriptors.hold(stored);
    faults.extend(sharpness::judge(&qualities));
    faults.iter().for_each(|fault| monitor.diagnostic(fault));
    Ok(Extracted { geometric, largest, descriptors, key: whole_key.finish() })
}

fn find(
    picture: Result<RgbImage, String>,
    options: &features::FeatureOptions,
    enlarge: When,
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
    let sigmas_px = found.key_points.iter().map(|point| point.sigma_px);
    let mut out = Found {
        clipped: [share(&|value| value < 3), share(&|value| value > 252)],
        width_px: found.width_px,
        height_px: found.height_px,
        largest: Bytes(largest.as_bytes().to_vec()),
        feature_sigma_px: (found.key_points.len() >= LEAST_FEATURES)
            .then(|| rowgram_optim::robust::median(sigmas_px).unwrap_or(0.0)),
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
