//! The contact sheet: a row for each target, a crop for each photo that should show it, what was found drawn into it.

use image::{Rgb, RgbImage, imageops};
use rayon::prelude::*;
use rowgram_base::error::Error;
use rowgram_survey::ground_targets::{FoundTargets, TargetSighting};

/// Side of a crop in the sheet, pixels.
const CROP_PX: u32 = 96;
/// Space between crops, pixels.
const GAP_PX: u32 = 4;
/// What a crop shows, in sizes of the target.
const SHOWN_SIZES: f64 = 3.0;
/// Crops of a row: those found first, then those missed.
const MAX_COLUMNS: usize = 24;
/// Colours that are told apart by everybody (Okabe and Ito): found, and not.
const FOUND: Rgb<u8> = Rgb([0, 158, 115]);
const MISSED: Rgb<u8> = Rgb([213, 94, 0]);

/// The sightings of every target, those found first; those beyond the columns of the sheet are last.
pub(super) fn order(found: &FoundTargets) -> Vec<Vec<usize>> {
    let last = found.sightings.iter().map(|sighting| sighting.ground + 1).max().unwrap_or(0);
    let mut rows = vec![Vec::new(); last];
    let sightings = found.sightings.iter().enumerate();
    sightings.for_each(|(k, sighting)| rows[sighting.ground].push(k));
    rows.iter_mut().for_each(|row| row.sort_by_key(|&k| found.sightings[k].outcome.is_err()));
    rows.retain(|row| !row.is_empty());
    rows
}

/// Draws the sheet; photos are read once.
pub(super) fn draw(
    found: &FoundTargets,
    order: &[Vec<usize>],
    read: impl Fn(usize) -> Result<RgbImage, Error> + Sync,
) -> Result<RgbImage, Error> {
    let columns = order.iter().map(Vec::len).max().unwrap_or(0).min(MAX_COLUMNS) as u32;
    let side = |count: u32| count.max(1) * (CROP_PX + GAP_PX) + GAP_PX;
    let mut sheet = RgbImage::from_pixel(side(columns), side(order.len() as u32), Rgb([255; 3]));
    let shown = order.iter().enumerate().flat_map(|(row, sightings)| {
        sightings.iter().take(MAX_COLUMNS).enumerate().map(move |(column, &k)| (row, column, k))
    });
    let mut by_image: std::collections::BTreeMap<usize, Vec<(usize, usize, usize)>> =
        std::collections::BTreeMap::new();
    for place in shown {
        by_image.entry(found.sightings[place.2].image).or_default().push(place);
    }
    let images: Vec<_> = by_image.into_iter().collect();
    let crops: Vec<Result<Vec<_>, Error>> = images
        .par_iter()
        .map(|(image, places)| {
            let photo = read(*image)?;
            let of = |&(row, column, k): &(usize, usize, usize)| {
                (row as u32, column as u32, crop(&photo, &found.sightings[k]))
            };
            Ok(places.iter().map(of).collect())
        })
        .collect();
    for crops in crops {
        for (row, column, crop) in crops? {
            let at = [column, row].map(|k| i64::from(GAP_PX + k * (CROP_PX + GAP_PX)));
            imageops::replace(&mut sheet, &crop, at[0], at[1]);
        }
    }
    Ok(sheet)
}

/// What a photo shows around a sighting, with its middle marked.
fn crop(photo: &RgbImage, sighting: &TargetSighting) -> RgbImage {
    let centre = sighting.outcome.as_ref().map_or(sighting.predicted_px, |found| found.image_px);
    let step = SHOWN_SIZES * sighting.size_px.max(1.0) / f64::from(CROP_PX);
    let place = |k: u32, centre: f64| centre + step * (f64::from(k) - 0.5 * f64::from(CROP_PX - 1));
    let mut crop = RgbImage::from_fn(CROP_PX, CROP_PX, |i, j| {
        let (u, v) = (place(i, centre[0]).round(), place(j, centre[1]).round());
        let inside =
            u >= 0.0 && v >= 0.0 && u < f64::from(photo.width()) && v < f64::from(photo.height());
        if inside { *photo.get_pixel(u as u32, v as u32) } else { Rgb([0; 3]) }
    });
    // Four strokes that leave the middle open, and a frame.
    let colour = if sighting.outcome.is_ok() { FOUND } else { MISSED };
    let middle = CROP_PX / 2;
    for k in 0..CROP_PX {
        for (i, j) in [(k, 0), (k, CROP_PX - 1), (0, k), (CROP_PX - 1, k)] {
            crop.put_pixel(i, j, colour);
        }
        if (4..20).contains(&k.abs_diff(middle)) {
            crop.put_pixel(k, middle, colour);
            crop.put_pixel(middle, k, colour);
        }
    }
    crop
}
