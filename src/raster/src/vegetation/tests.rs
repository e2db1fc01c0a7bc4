use super::*;
use crate::window;
use image::Rgb;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Round plants of 9 px radius on soil, both noisy; which pixels are plant.
fn field(light: f32, plants: &[(f32, f32)]) -> (RgbImage, Mask) {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let truth = Mask::from_fn(240, 180, |u, v| {
        plants.iter().any(|&(x, y)| (u as f32 - x).hypot(v as f32 - y) < 9.0)
    });
    let photo = RgbImage::from_fn(240, 180, |u, v| {
        let colour = if truth.get(u as usize, v as usize) {
            [70.0, 120.0, 55.0]
        } else {
            [125.0, 105.0, 85.0]
        };
        let shade = light * (0.8 + 0.4 * rng.random::<f32>());
        Rgb(colour.map(|c: f32| (c * shade + 12.0 * rng.random::<f32>()).clamp(0.0, 255.0) as u8))
    });
    (photo, truth)
}

fn iou(a: &Mask, b: &Mask) -> f64 {
    let both = a.data.iter().zip(&b.data).filter(|(a, b)| **a + **b == 2).count();
    let any = a.data.iter().zip(&b.data).filter(|(a, b)| **a + **b > 0).count();
    both as f64 / any.max(1) as f64
}

const GRID: [(f32, f32); 6] =
    [(30.0, 40.0), (90.0, 42.0), (150.0, 38.0), (210.0, 40.0), (60.0, 130.0), (180.0, 130.0)];

#[test]
fn plants_are_found_in_bright_and_in_dim_light() {
    for light in [0.5, 1.0, 1.6] {
        let (photo, truth) = field(light, &GRID);
        let found = segment(&photo, None, &Options::default()).unwrap();
        assert!(iou(&found.mask, &truth) > 0.93, "light {light}: {}", iou(&found.mask, &truth));
        assert!(
            (found.cover() - truth.count() as f64 / 43_200.0).abs() < 0.015,
            "{}",
            found.cover()
        );
    }
}

#[test]
fn plants_are_found_in_warm_and_in_cold_light() {
    let (photo, truth) = field(1.0, &GRID);
    let neutral = segment(&photo, None, &Options::default()).unwrap();
    assert_eq!(neutral.model.white_balance, [1.0; 3]);
    for (red, blue) in [(1.3, 0.7), (0.8, 1.4)] {
        let mut photo = photo.clone();
        for pixel in photo.pixels_mut() {
            let [r, g, b] = pixel.0.map(f32::from);
            *pixel = Rgb([(red * r) as u8, g as u8, (blue * b) as u8]);
        }
        let found = segment(&photo, None, &Options::default()).unwrap();
        let agrees = iou(&found.mask, &truth);
        assert!(agrees > 0.9, "red {red}, blue {blue}: {agrees}, {:?}", found.model);
        let [of_red, of_green, of_blue] = found.model.white_balance;
        assert!((of_red <= 1.0) == (red > 1.0) && of_green == 1.0, "{:?}", found.model);
        assert!((of_blue >= 1.0) == (blue < 1.0), "{:?}", found.model);
    }
}

#[test]
fn bare_soil_and_full_cover_are_not_cut_in_two() {
    let (bare, _) = field(1.0, &[]);
    let found = segment(&bare, None, &Options::default()).unwrap();
    assert!(found.mask.count() < 43, "{} pixels of bare soil", found.mask.count());
    let full: Vec<(f32, f32)> =
        (0..24).flat_map(|i| (0..18).map(move |j| (10.0 * i as f32, 10.0 * j as f32))).collect();
    let (full, _) = field(1.0, &full);
    let found = segment(&full, None, &Options::default()).unwrap();
    assert!(found.mask.count() > 42_000, "{} of 43200 pixels of full cover", found.mask.count());
}

#[test]
fn what_shows_nothing_is_never_vegetation() {
    let (photo, _) = field(1.0, &GRID);
    let valid = Mask::from_fn(240, 180, |u, _| u >= 120);
    let found = segment(&photo, Some(&valid), &Options::default()).unwrap();
    assert!(found.mask.plant_pixels().all(|(u, _)| u >= 120));
    assert!(found.mask.count() > 500);
    assert_eq!(found.valid.as_ref(), Some(&valid));
    let nothing = segment(&photo, Some(&Mask::empty(240, 180)), &Options::default());
    assert_eq!(nothing, Err(VegetationError::Nothing { width: 240, height: 180 }));
    let size = segment(&photo, Some(&Mask::empty(2, 3)), &Options::default());
    assert!(matches!(size, Err(VegetationError::Size { mask_width: 2, .. })));
    let weight =
        Options { coherence: Coherence::Icm { weight: -1.0, sweeps: 1 }, ..Options::default() };
    assert!(segment(&photo, None, &weight).is_err());
}

#[test]
fn a_black_surround_changes_nothing_inside() {
    let (photo, truth) = field(1.0, &GRID);
    let mut framed = RgbImage::new(480, 180);
    image::imageops::overlay(&mut framed, &photo, 240, 0);
    for v in 0..180 {
        for u in 0..240 {
            let noise = ((u * 5 + v * 11) % 20) as u8;
            framed.put_pixel(u, v, Rgb([0, noise, 0]));
        }
    }
    let found = segment(&framed, None, &Options::default()).unwrap();
    let inside = Mask::from_fn(240, 180, |u, v| found.mask.get(u + 240, v));
    assert!(found.mask.plant_pixels().all(|(u, _)| u >= 240));
    assert!(iou(&inside, &truth) > 0.9, "{}", iou(&inside, &truth));
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let (photo, _) = field(1.0, &GRID);
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| segment(&photo, None, &Options::default()).unwrap())
    };
    assert_eq!(on(1), on(3));
}

#[test]
fn tiny_photos_do_not_fail() {
    for (width, height) in [(1, 1), (1, 7), (5, 1), (2, 2)] {
        let photo = RgbImage::from_pixel(width, height, Rgb([120, 100, 80]));
        let found = segment(&photo, None, &Options::default()).unwrap();
        assert_eq!(found.posterior.len(), (width * height) as usize);
        assert_eq!(found.mask.count(), 0);
    }
}

#[test]
fn bands_give_what_the_whole_photo_gives() {
    let (photo, _) = field(1.0, &GRID);
    // A black frame on two sides, and pixels that show nothing.
    let photo = RgbImage::from_fn(240, 180, |u, v| {
        if u < 30 || v < 24 { Rgb([0, 3, 0]) } else { *photo.get_pixel(u, v) }
    });
    let valid = Mask::from_fn(240, 180, |u, v| u + v < 380);
    for valid in [None, Some(&valid)] {
        let whole = segment(&photo, valid, &Options::default()).unwrap();
        for rows in [4, 20, 44] {
            let seen = |band: &Band| {
                let (top, height) = (band.seen.start as u32, band.seen.len() as u32);
                let part = image::imageops::crop_imm(&photo, 0, top, 240, height).to_image();
                (part, valid.map(|valid| &valid.data[band.seen.start * 240..band.seen.end * 240]))
            };
            let mut estimator = Estimator::new((240, 180), &Options::default()).unwrap();
            for band in window::bands(180, rows, Estimator::HALO) {
                let (part, shown) = seen(&band);
                estimator.add(&band, Seen { photo: &part, ndvi: None, shown });
            }
            let estimate = estimator.finish().unwrap();
            assert_eq!(estimate.model, whole.model);
            let (mut mask, mut posterior, mut shown) = (vec![], vec![], vec![]);
            for band in window::bands(180, rows, estimate.halo()) {
                let (part, valid) = seen(&band);
                let found =
                    estimate.classify(&band, Seen { photo: &part, ndvi: None, shown: valid });
                mask.extend(found.mask);
                posterior.extend(found.posterior);
                shown.extend(found.shown.unwrap());
            }
            assert_eq!(mask, whole.mask.data, "{rows}");
            assert_eq!(posterior, whole.posterior, "{rows}");
            assert_eq!(Some(shown), whole.valid.as_ref().map(|valid| valid.data.clone()));
        }
    }
}
