//! One colour for all photos: overlap samples for the radiometric block adjustment, and what it leaves.
//!
//! ```text
//! x_pic = mean of the linear light of photo i in a window of a few pixels about u_i(X_p, Y_p, Z(X_p, Y_p))
//! ```
//!
//! for places `p` spread evenly over what photos show, in every photo that shows them. Windows with pixels that are cut off, and dark
//! ones, take no part. [`crate::problems::radiometry`] has the equations, [`ColourCorrection`] undoes what it finds.

use super::{
    colour_correction::{ColourCorrection, PixelGeometry, linear_light, log_shape},
    photo_cache::PhotoCache,
    select::PhotoSelector,
};
use crate::problems::radiometry::{
    DIRECTION, Observation, Photo, RADIAL, RadiometricBlock, RadiometricSolution,
};
use rayon::prelude::*;
use rowgram_optim::engine::SolveError;
use rowgram_optim::robust::median;
use rowgram_raster::{srgb::grey_value, window::Window};
use serde::{Deserialize, Serialize};

/// Places that are looked at, for each photo, and the least number of them.
const PLACES_PER_PHOTO: usize = 120;
const LEAST_PLACES: usize = 3000;
/// Side of a window, pixels: wide against what leaves move between two views and against noise, narrow against vignetting.
const WINDOW_PX: usize = 15;
/// Windows darker than this, of linear light, say little: half a grey value is then 3 % of it.
const DARK: f64 = 0.006;
/// Side of the squares of cells for which photos are listed together.
const SQUARE: usize = 512;

/// When and how photos were taken.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Exposure {
    /// The moment, in a form that sorts by time; empty where unknown.
    pub moment: String,
    /// Natural logarithm of time, sensitivity and aperture together.
    pub log_exposure: Option<f64>,
    /// Index of the camera.
    pub camera: usize,
}

/// Median differences of photos in overlaps, grey values of sRGB.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct OverlapDifference {
    /// As the photos are.
    pub before: f64,
    /// After correction.
    pub after: f64,
}

/// Vignetting of a camera and dependence of its photos on the direction of view.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CameraLight {
    /// Coefficients of `r^2, r^4, r^6` of the log of the light.
    pub vignetting: [f64; RADIAL],
    /// Their standard deviations.
    pub vignetting_sigma: [f64; RADIAL],
    /// The light in the corners over that at the principal point.
    pub corner_light: f64,
    /// Coefficients of `s_x, s_y, s_x^2 - s_y^2, 2 s_x s_y`.
    pub direction: [f64; DIRECTION],
    /// Their standard deviations.
    pub direction_sigma: [f64; DIRECTION],
}

/// How the colours of photos were brought together.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ColourBalance {
    /// Number of places.
    pub points: usize,
    /// Number of windows in photos.
    pub observations: usize,
    /// Photos that no observation ties to others; their gains come from the photos before and after.
    pub untied_photos: usize,
    /// Whether the exposures that the camera reports took part.
    pub with_exposures: bool,
    /// Standard deviation of the brightness of a window, relative.
    pub sigma: f64,
    /// Share of the windows whose weight the robust loss reduces.
    pub downweighted: f64,
    /// Median difference of two photos of a place: mean of the channels.
    pub difference: OverlapDifference,
    /// Smallest and largest gain of a photo, mean of the channels: how bright it is beside the others.
    pub gain_range: [f64; 2],
    /// Median standard deviation of the log gains.
    pub gain_sigma: f64,
    /// Each camera.
    pub cameras: Vec<CameraLight>,
}

/// The colours of all photos: how they were brought together, and what that means for each, in their order.
#[derive(Debug, Clone, PartialEq)]
pub struct BalancedPhotos {
    /// How they were brought together.
    pub balance: ColourBalance,
    /// Standard deviations of the log gain of each photo, red, green, blue.
    pub log_gain_sigmas: Vec<[f64; 3]>,
    /// What undoes the gain and the shape of each photo.
    pub corrections: Vec<ColourCorrection>,
}

/// A photo, and the pixel of it that shows a place.
type Seen = (usize, [f64; 2]);

/// A window in a photo that is to be read.
#[derive(Debug, Clone, Copy)]
struct Wanted {
    point: u32,
    at_px: [f64; 2],
}

/// Brings the colours of photos together, sampled on a map of `[width, height]` cells; `None` where no two photos show the same
/// ground. `exposures` are those of the photos, in their order.
///
/// # Errors
/// Photos that cannot be read, and an adjustment without a solution.
pub fn balance<E: Send + From<SolveError>>(
    selector: &PhotoSelector<'_>,
    size: [usize; 2],
    exposures: &[Exposure],
    photos: &mut PhotoCache<'_, E>,
) -> Result<Option<BalancedPhotos>, E> {
    let wanted = places(selector, size);
    let observations = observe(selector, &wanted, photos)?;
    if observations.is_empty() {
        return Ok(None);
    }
    let places = selector.views().iter().map(|view| view.centre_m());
    let places: Vec<[f64; 2]> = places.map(|[x, y, _]| [x, y]).collect();
    let (block, order) = block(observations, exposures, &places);
    let solution = block.adjust()?;
    Ok(Some(summary(selector, &block, &order, &solution)))
}

/// The windows of each photo.
fn places(selector: &PhotoSelector<'_>, [width, height]: [usize; 2]) -> Vec<Vec<Wanted>> {
    let count = selector.views().len();
    let places = LEAST_PLACES.max(count * PLACES_PER_PHOTO);
    // Multiples of two irrational numbers spread evenly, and never in step with rows of plants (M. Roberts, 2018).
    const STEPS: [f64; 2] = [0.754_877_666_246_693, 0.569_840_290_998_053];
    let columns = width.div_ceil(SQUARE);
    let mut squares: Vec<Vec<[usize; 2]>> = vec![Vec::new(); columns * height.div_ceil(SQUARE)];
    for n in 0..places {
        let at = STEPS.map(|step| (0.5 + step * n as f64).fract());
        let cell = [(at[0] * width as f64) as usize, (at[1] * height as f64) as usize];
        squares[cell[1] / SQUARE * columns + cell[0] / SQUARE].push(cell);
    }
    let found: Vec<Vec<Vec<Seen>>> = squares
        .par_iter()
        .enumerate()
        .map(|(n, cells)| {
            let (u, v) = (n % columns * SQUARE, n / columns * SQUARE);
            let window =
                Window { u, v, width: SQUARE.min(width - u), height: SQUARE.min(height - v) };
            let among = selector.within(window);
            let mut candidates = Vec::new();
            let mut found = Vec::new();
            for &[u, v] in cells {
                let Some(point) = selector.point_m(u, v) else { continue };
                selector.candidates(point, &among, &mut candidates);
                if candidates.len() >= 2 {
                    found.push(candidates.iter().map(|of| (of.view, of.image_px)).collect());
                }
            }
            found
        })
        .collect();
    let mut wanted = vec![Vec::new(); count];
    for (point, seen) in found.iter().flatten().enumerate() {
        for &(view, at_px) in seen {
            wanted[view].push(Wanted { point: point as u32, at_px });
        }
    }
    wanted
}

/// Reads the windows; points are renumbered, those that fewer than two photos show left out.
fn observe<E: Send>(
    selector: &PhotoSelector<'_>,
    wanted: &[Vec<Wanted>],
    photos: &mut PhotoCache<'_, E>,
) -> Result<Vec<Observation>, E> {
    let light = linear_light();
    let needed: Vec<usize> = (0..wanted.len()).filter(|&k| !wanted[k].is_empty()).collect();
    let mut found: Vec<Vec<Observation>> = vec![Vec::new(); wanted.len()];
    photos.each_group(&needed, |photos| {
        let read: Vec<(usize, Vec<Observation>)> = photos
            .par_iter()
            .enumerate()
            .filter_map(|(k, photo)| {
                let photo = (*photo)?;
                let geometry = PixelGeometry::new(&selector.views()[k]);
                let of = wanted[k].iter().filter_map(|&Wanted { point, at_px }| {
                    let mean = photo.mean_light(at_px, WINDOW_PX, &light)?;
                    let (radius2, direction) = geometry.of(at_px);
                    let bright = mean.iter().all(|&value| value >= DARK);
                    bright.then(|| Observation {
                        point,
                        photo: k as u32,
                        log_light: mean.map(f64::ln),
                        radius2,
                        direction,
                    })
                });
                Some((k, of.collect()))
            })
            .collect();
        read.into_iter().for_each(|(k, of)| found[k] = of);
    })?;
    let mut all: Vec<Observation> = found.into_iter().flatten().collect();
    all.sort_by_key(|seen| (seen.point, seen.photo));
    let mut kept = Vec::with_capacity(all.len());
    let shared = all.chunk_by(|a, b| a.point == b.point).filter(|of| of.len() >= 2);
    for (point, of) in (0_u32..).zip(shared) {
        kept.extend(of.iter().map(|seen| Observation { point, ..*seen }));
    }
    Ok(kept)
}

/// The block with photos in the order in which they were taken, and which photo each of them is.
fn block(
    mut observations: Vec<Observation>,
    exposures: &[Exposure],
    places: &[[f64; 2]],
) -> (RadiometricBlock, Vec<usize>) {
    let mut order: Vec<usize> = (0..exposures.len()).collect();
    order.sort_by(|&a, &b| exposures[a].moment.cmp(&exposures[b].moment).then(a.cmp(&b)));
    let mut place = vec![0; order.len()];
    order.iter().enumerate().for_each(|(n, &k)| place[k] = n as u32);
    observations.iter_mut().for_each(|seen| seen.photo = place[seen.photo as usize]);
    let points = observations.last().map_or(0, |last| last.point as usize + 1);
    let photos = order.iter().map(|&k| Photo {
        camera: exposures[k].camera,
        place: places[k],
        log_exposure: exposures[k].log_exposure,
    });
    let cameras = exposures.iter().map(|of| of.camera + 1).max().unwrap_or(0);
    (RadiometricBlock { photos: photos.collect(), cameras, points, observations }, order)
}

fn summary(
    selector: &PhotoSelector<'_>,
    block: &RadiometricBlock,
    order: &[usize],
    solution: &RadiometricSolution,
) -> BalancedPhotos {
    let count = order.len();
    let mut log_gains = vec![[0.0; 3]; count];
    let mut log_gain_sigmas = vec![[0.0; 3]; count];
    let mut cameras_of = vec![0; count];
    for (n, &k) in order.iter().enumerate() {
        log_gains[k] = solution.log_gains[n].value;
        log_gain_sigmas[k] = solution.log_gains[n].sigma;
        cameras_of[k] = block.photos[n].camera;
    }
    let shapes: Vec<([f64; RADIAL], [f64; DIRECTION])> = (0..block.cameras)
        .map(|c| (solution.vignetting[c].value, solution.direction[c].value))
        .collect();
    let correction = |k: usize| {
        let (radial, direction) = shapes[cameras_of[k]];
        let geometry = PixelGeometry::new(&selector.views()[k]);
        ColourCorrection::new(&geometry, log_gains[k], radial, direction)
    };
    let corrections: Vec<ColourCorrection> = (0..count).map(correction).collect();
    let mean = |rgb: &[f64; 3]| rgb.iter().sum::<f64>() / 3.0;
    let gains = log_gains.iter().map(|of| mean(of).exp());
    let (least, most) = gains.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), gain| {
        (f64::min(a, gain), f64::max(b, gain))
    });
    let mut tied = vec![false; count];
    block.observations.iter().for_each(|seen| tied[seen.photo as usize] = true);
    let cameras = (0..block.cameras).map(|c| {
        let (vignetting, direction) = (&solution.vignetting[c], &solution.direction[c]);
        CameraLight {
            vignetting: vignetting.value,
            vignetting_sigma: vignetting.sigma,
            corner_light: vignetting.value.iter().sum::<f64>().exp(),
            direction: direction.value,
            direction_sigma: direction.sigma,
        }
    });
    let balance = ColourBalance {
        points: block.points,
        observations: block.observations.len(),
        untied_photos: tied.iter().filter(|tied| !**tied).count(),
        with_exposures: block.photos.iter().any(|photo| photo.log_exposure.is_some()),
        sigma: solution.sigma[0],
        downweighted: solution.downweighted,
        difference: differences(block, solution, &shapes),
        gain_range: [least, most],
        gain_sigma: median(log_gain_sigmas.iter().map(mean)).unwrap_or(0.0),
        cameras: cameras.collect(),
    };
    BalancedPhotos { balance, log_gain_sigmas, corrections }
}

/// Differences of the photos of each place, taken one after the other.
fn differences(
    block: &RadiometricBlock,
    solution: &RadiometricSolution,
    shapes: &[([f64; RADIAL], [f64; DIRECTION])],
) -> OverlapDifference {
    let grey = |seen: &Observation, corrected: bool| {
        let photo = seen.photo as usize;
        let (radial, direction) = &shapes[block.photos[photo].camera];
        let shape = log_shape(seen.radius2, seen.direction, radial, direction);
        std::array::from_fn::<f64, 3, _>(|c| {
            let off = solution.log_gains[photo].value[c] + shape;
            grey_value((seen.log_light[c] - if corrected { off } else { 0.0 }).exp())
        })
    };
    let of = |corrected: bool| {
        let pairs = block.observations.windows(2).filter(|pair| pair[0].point == pair[1].point);
        let off = pairs.map(|pair| {
            let (a, b) = (grey(&pair[0], corrected), grey(&pair[1], corrected));
            (0..3).map(|c| (a[c] - b[c]).abs()).sum::<f64>() / 3.0
        });
        median(off).unwrap_or(0.0)
    };
    OverlapDifference { before: of(false), after: of(true) }
}
