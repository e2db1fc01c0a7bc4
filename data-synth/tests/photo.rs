//! Photos show what is true where it is true, and each of light's and sensor's effects alone does what it says.

use crate::moments;
use data_synth::{
    camera::CameraConfig,
    clutter::ClutterConfig,
    corrupt::Corruption,
    exif,
    field::{FieldConfig, GrowthStage},
    flight::FlightConfig,
    photo::{ImageConfig, Photo},
    targets::TargetConfig,
    terrain::TerrainConfig,
    twin::{FlightPreset, Twin, TwinConfig},
};
use image::RgbImage;

/// Light and sensor without any effect.
fn plain() -> ImageConfig {
    ImageConfig {
        exposure_spread: 0.0,
        white_balance_spread: 0.0,
        vignetting: 0.0,
        defocus_px: 0.0,
        motion_blur: false,
        read_noise: 0.0,
        shot_noise: 0.0,
        ..ImageConfig::default()
    }
}

/// Few small photos of 13 mm a pixel over uneven ground, through a strongly distorting lens.
fn config() -> TwinConfig {
    TwinConfig {
        field: FieldConfig {
            rows: 8,
            row_length_m: 8.0,
            spacing_m: 0.3,
            stage: GrowthStage::Early,
            heading_deg: 30.0,
            terrain: TerrainConfig {
                slope_percent: 3.0,
                relief_m: 0.1,
                relief_wavelength_m: 5.0,
                furrow_m: 0.05,
                ..TerrainConfig::default()
            },
            ..FieldConfig::default()
        },
        camera: CameraConfig::wide(480, 360, 450.0),
        flight: FlightConfig {
            height_m: 6.0,
            strips: 1,
            photos_per_strip: 2,
            position_m: 0.1,
            height_drift_m: 0.1,
            readout_seconds: 0.02,
            speed_m_s: 4.0,
            ..FlightConfig::default()
        },
        targets: TargetConfig { control: 9, check: 0, size_m: 0.5, ..TargetConfig::default() },
        image: plain(),
        ..TwinConfig::default()
    }
}

fn photos(twin: &Twin) -> Vec<Photo> {
    let studio = twin.studio();
    twin.shots.iter().enumerate().map(|(number, shot)| studio.photo(shot, number)).collect()
}

fn first(image: ImageConfig) -> Photo {
    let twin = TwinConfig { image, ..config() }.build().unwrap();
    twin.studio().photo(&twin.shots[0], 0)
}

/// Light by the sRGB transfer function, of every value in order.
fn linear(image: &RgbImage) -> Vec<f64> {
    let light = |value: u8| {
        let coded = f64::from(value) / 255.0;
        if coded <= 0.04045 { coded / 12.92 } else { ((coded + 0.055) / 1.055).powf(2.4) }
    };
    image.iter().map(|&value| light(value)).collect()
}

/// Light at a position between pixels, green.
fn light_at(image: &RgbImage, [u, v]: [f64; 2]) -> f64 {
    let (i, j) = (u.floor(), v.floor());
    let get = |i: f64, j: f64| f64::from(image.get_pixel(i as u32, j as u32).0[1]);
    let (s, t) = (u - i, v - j);
    (get(i, j) * (1.0 - s) + get(i + 1.0, j) * s) * (1.0 - t)
        + (get(i, j + 1.0) * (1.0 - s) + get(i + 1.0, j + 1.0) * s) * t
}

#[test]
fn targets_appear_where_their_marks_truly_are() {
    // Nothing lies on the plates and no leaf shades them.
    let mut config = config();
    config.clutter = ClutterConfig { residue_per_m2: 0.0, stones_per_m2: 0.0 };
    config.targets.clearing_m = 0.7;
    let twin = config.build().unwrap();
    let photos = photos(&twin);
    let mut checked = 0;
    for mark in &twin.marks {
        let (target, shot) = (&twin.targets[mark.target], &twin.shots[mark.shot]);
        let image = &photos[mark.shot].image;
        let (sin, cos) = target.azimuth_rad.sin_cos();
        // How much the picture looks like the four squares when their middle is moved by (a, b) on the plate.
        let likeness = |a: f64, b: f64| -> f64 {
            let mut sum = 0.0;
            for i in -15i32..=15 {
                for j in -15i32..=15 {
                    let (s, t) = (f64::from(i) * 0.0065, f64::from(j) * 0.0065);
                    let place = [
                        target.place_m[0] + (s + a) * cos - (t + b) * sin,
                        target.place_m[1] + (s + a) * sin + (t + b) * cos,
                        target.place_m[2],
                    ];
                    let pixel = shot.project(&twin.camera, place).unwrap();
                    sum += f64::from(i.signum() * j.signum()) * light_at(image, pixel);
                }
            }
            sum
        };
        let mut best = (f64::NEG_INFINITY, 0.0, 0.0);
        for a in -5..=5 {
            for b in -5..=5 {
                let (a, b) = (f64::from(a) * 0.0025, f64::from(b) * 0.0025);
                let score = likeness(a, b);
                if score > best.0 {
                    best = (score, a, b);
                }
            }
        }
        // A fifth of a pixel is 2.7 mm on the ground.
        let off_m = f64::hypot(best.1, best.2);
        assert!(off_m <= 0.0036, "{} in {}: {off_m} m", target.label, shot.name);
        assert!(best.0 > 3000.0, "a target of high contrast: {}", best.0);
        checked += 1;
    }
    assert!(checked >= 4, "{checked} marks");
}

#[test]
fn leaves_appear_where_their_axes_project() {
    let twin = config().build().unwrap();
    let photos = photos(&twin);
    let (mut own, mut green, mut count) = (0, 0, 0);
    for (photo, shot) in photos.iter().zip(&twin.shots) {
        for (number, plant) in twin.field().plants.iter().enumerate() {
            for leaf in &plant.leaves {
                let place = twin.field().leaf_axis_m(plant.z_m, leaf)[4];
                let pixel = shot
                    .project(&twin.camera, place)
                    .filter(|&pixel| twin.camera.inside(pixel, 2.0));
                let Some([u, v]) = pixel else { continue };
                let (u, v) = (u.round() as u32, v.round() as u32);
                let [r, g, b] = photo.plants.get_pixel(u, v).0.map(u32::from);
                count += 1;
                own += u32::from(r + 256 * g + 65_536 * b == number as u32 + 1);
                green += u32::from(photo.mask.get_pixel(u, v).0 == [255]);
            }
        }
    }
    assert!(count > 300, "{count}");
    // Leaves are 1.1 to 1.9 pixels wide here, so a pixel on an axis shows the leaf but where another hides it or
    // soil fills half of it.
    assert!(f64::from(green) > 0.93 * f64::from(count), "{green} of {count}");
    assert!(f64::from(own) > 0.88 * f64::from(count), "{own} of {count}");
}

#[test]
fn masks_plants_and_greenness_agree() {
    let twin = TwinConfig { corruption: Corruption::default(), ..config() }.build().unwrap();
    let photo = &photos(&twin)[0];
    let (mut leaf, mut soil) = (Vec::new(), Vec::new());
    for ((mask, plant), colour) in
        photo.mask.pixels().zip(photo.plants.pixels()).zip(photo.image.pixels())
    {
        let [r, g, b] = colour.0.map(f64::from);
        if mask.0 == [255] {
            assert_ne!(plant.0, [0, 0, 0], "green that is no plant's in a field without weeds");
            leaf.push(2.0 * g - r - b);
        } else {
            soil.push(2.0 * g - r - b);
        }
    }
    // Where a pixel shows a leaf, it mostly shows that leaf's plant.
    let owner_of: Vec<u32> = (1..)
        .zip(&twin.field().plants)
        .flat_map(|(number, plant)| vec![number; plant.leaves.len()])
        .collect();
    let (mut same, mut blades) = (0, 0);
    for (&label, plant) in photo.leaves.iter().zip(photo.plants.pixels()).filter(|(l, _)| **l > 0) {
        let [r, g, b] = plant.0;
        blades += 1;
        same += usize::from(owner_of[label as usize - 1] == u32::from_le_bytes([r, g, b, 0]));
    }
    assert!(blades * 10 > leaf.len() * 8, "{blades} of {}", leaf.len());
    assert!(same * 100 > blades * 97, "{same} of {blades}");
    let ((leaf_mean, leaf_spread), (soil_mean, soil_spread)) = (moments(&leaf), moments(&soil));
    assert!(leaf_mean - soil_mean > leaf_spread + soil_spread, "{leaf_mean} {soil_mean}");
}

#[test]
fn light_and_sensor_change_no_truth() {
    let base = first(plain());
    let all = first(ImageConfig::default());
    assert_eq!(base.mask, all.mask);
    assert_eq!(base.plants, all.plants);
    assert_ne!(base.image, all.image);
}

#[test]
fn exposure_and_white_balance_alone_scale_photos_as_asked() {
    let base = linear(&first(plain()).image);
    let ratios = |image: ImageConfig| -> [f64; 3] {
        let other = linear(&first(image).image);
        [0, 1, 2].map(|channel| {
            // Dark enough not to saturate, bright enough that 8 bits say something.
            let pairs = base.iter().zip(&other).skip(channel).step_by(3);
            let pairs: Vec<_> = pairs.filter(|(a, _)| (0.05..0.6).contains(*a)).collect();
            let (sum_a, sum_b) = pairs.iter().fold((0.0, 0.0), |(a, b), (x, y)| (a + **x, b + **y));
            let ratio = sum_b / sum_a;
            assert!(
                pairs.iter().all(|(a, b)| (**b / **a / ratio - 1.0).abs() < 0.09),
                "the same everywhere"
            );
            ratio
        })
    };
    let [r, g, b] = ratios(ImageConfig { exposure_spread: 0.2, ..plain() });
    assert!((g - 1.0).abs() > 0.01 && (0.5..1.7).contains(&g), "{g}");
    assert!((r / g - 1.0).abs() < 0.01 && (b / g - 1.0).abs() < 0.01, "{r} {g} {b}");
    let [r, g, b] = ratios(ImageConfig { white_balance_spread: 0.1, ..plain() });
    assert!((g - 1.0).abs() < 1e-9, "{g}");
    assert!((r - 1.0).abs() > 0.01 && (b - 1.0).abs() > 0.01, "{r} {b}");
}

#[test]
fn vignetting_alone_darkens_towards_the_corners() {
    let base = first(plain()).image;
    let dark = first(ImageConfig { vignetting: 0.4, ..plain() }).image;
    let (width, height) = base.dimensions();
    let part = |u0: u32, v0: u32| {
        let mean = |image: &RgbImage| {
            let view = image::imageops::crop_imm(image, u0, v0, 12, 12).to_image();
            moments(&linear(&view)).0
        };
        mean(&dark) / mean(&base)
    };
    approx::assert_abs_diff_eq!(part(width / 2 - 6, height / 2 - 6), 1.0, epsilon = 0.01);
    for corner in [(0, 0), (width - 12, 0), (0, height - 12), (width - 12, height - 12)] {
        // 6 pixels inside, the fall is 0.4 (294/300)^2.
        approx::assert_abs_diff_eq!(part(corner.0, corner.1), 0.615, epsilon = 0.02);
    }
}

#[test]
fn noise_alone_has_its_deviation() {
    let base = linear(&first(plain()).image);
    let deviation = |image: ImageConfig, range: std::ops::Range<f64>| {
        let noisy = linear(&first(image).image);
        let differences: Vec<f64> = base
            .iter()
            .zip(&noisy)
            .filter(|(a, _)| range.contains(*a))
            .map(|(a, b)| b - a)
            .collect();
        assert!(differences.len() > 10_000, "{}", differences.len());
        moments(&differences).1
    };
    let read = ImageConfig { read_noise: 0.02, ..plain() };
    for range in [0.1..0.15, 0.2..0.3] {
        let found = deviation(read.clone(), range);
        assert!((found / 0.02 - 1.0).abs() < 0.04, "{found}");
    }
    let shot = ImageConfig { shot_noise: 0.06, ..plain() };
    for (range, level) in [(0.1..0.12, 0.11f64), (0.24..0.28, 0.26)] {
        let found = deviation(shot.clone(), range);
        assert!((found / (0.06 * level.sqrt()) - 1.0).abs() < 0.05, "{found} at {level}");
    }
}

/// Mean squared difference of neighbours along u and along v.
fn roughness(image: &RgbImage) -> [f64; 2] {
    let light = linear(image);
    let (width, height) = (image.width() as usize, image.height() as usize);
    let at = |u: usize, v: usize| light[3 * (v * width + u) + 1];
    let mut sums = [0.0; 2];
    for v in 1..height {
        for u in 1..width {
            sums[0] += (at(u, v) - at(u - 1, v)).powi(2);
            sums[1] += (at(u, v) - at(u, v - 1)).powi(2);
        }
    }
    sums
}

#[test]
fn defocus_alone_blurs_both_ways_and_motion_along_the_flight_only() {
    let base = first(plain());
    let [base_u, base_v] = roughness(&base.image);
    let blurred = first(ImageConfig { defocus_px: 1.5, ..plain() });
    let [u, v] = roughness(&blurred.image);
    assert!(u < 0.2 * base_u && v < 0.2 * base_v, "{u} {v}");
    let (before, after) = (moments(&linear(&base.image)).0, moments(&linear(&blurred.image)).0);
    assert!((after / before - 1.0).abs() < 0.01, "light is kept: {before} {after}");

    // 4 m/s for 10 ms are 4 cm, three pixels, along v.
    let mut moving = config();
    moving.flight.exposure_seconds = 0.01;
    moving.flight.heading_deg = 0.0;
    moving.flight.wind_m_s = 0.0;
    let sharp = moving.build().unwrap();
    moving.image.motion_blur = true;
    let smeared = moving.build().unwrap();
    let [sharp_u, sharp_v] = roughness(&sharp.studio().photo(&sharp.shots[0], 0).image);
    let [u, v] = roughness(&smeared.studio().photo(&smeared.shots[0], 0).image);
    assert!(v < 0.4 * sharp_v, "{v} of {sharp_v}");
    assert!(u > 1.5 * v * sharp_u / sharp_v, "{u} of {sharp_u}");
}

#[test]
fn contrast_clutter_and_weeds_do_what_they_say() {
    let bare = |change: &dyn Fn(&mut TwinConfig)| {
        let mut config = config();
        config.field.missing_fraction = 1.0;
        config.targets.control = 0;
        config.clutter = ClutterConfig { residue_per_m2: 0.0, stones_per_m2: 0.0 };
        change(&mut config);
        let twin = config.build().unwrap();
        twin.studio().photo(&twin.shots[0], 0)
    };
    let spread = |photo: &Photo| {
        moments(&linear(&photo.image).into_iter().skip(1).step_by(3).collect::<Vec<_>>()).1
    };
    let soil = bare(&|_| ());
    assert!(soil.mask.iter().all(|&pixel| pixel == 0));
    assert!(spread(&bare(&|c| c.image.soil_contrast = 0.3)) < 0.8 * spread(&soil));
    for change in [(|c| c.clutter.residue_per_m2 = 20.0) as fn(&mut TwinConfig), |c| {
        c.clutter.stones_per_m2 = 20.0
    }] {
        let littered = bare(&change);
        let pixels = soil.image.pixels().zip(littered.image.pixels());
        let changed = pixels.filter(|(a, b)| a != b).count() as f64 / f64::from(480 * 360);
        assert!((0.005..0.4).contains(&changed), "{changed}");
        assert!(littered.mask.iter().all(|&pixel| pixel == 0), "not green");
    }
    let weedy = bare(&|c| c.corruption.weeds_per_m2 = 10.0);
    assert!(weedy.mask.iter().filter(|&&pixel| pixel == 255).count() > 500);
    assert!(weedy.plants.iter().all(|&part| part == 0), "weeds are no plants");
}

#[test]
fn the_sun_throws_shadows_away_from_itself() {
    let photo = |azimuth_deg: f64| {
        let mut config = config();
        config.field.stage = GrowthStage::Mid;
        config.image.sun_azimuth_deg = azimuth_deg;
        config.image.sun_elevation_deg = 40.0;
        let twin = config.build().unwrap();
        let photo = twin.studio().photo(&twin.shots[0], 0);
        (twin, photo)
    };
    // Soil at a place on either side of each stalk, towards the sun and away from it.
    let mean = |(twin, photo): &(Twin, Photo), azimuth_deg: f64| {
        let (sin, cos) = azimuth_deg.to_radians().sin_cos();
        let light = linear(&photo.image);
        let (mut sum, mut count) = (0.0, 0);
        for plant in &twin.field().plants {
            let [x, y] = [plant.x_m + 0.25 * cos, plant.y_m + 0.25 * sin];
            let place = [x, y, twin.field().terrain.height_m(x, y)];
            let pixel =
                twin.shots[0].project(&twin.camera, place).filter(|&p| twin.camera.inside(p, 1.0));
            let Some([u, v]) = pixel else { continue };
            let (u, v) = (u.round() as u32, v.round() as u32);
            if photo.mask.get_pixel(u, v).0 == [0] {
                sum += light[3 * (v * 480 + u) as usize + 1];
                count += 1;
            }
        }
        assert!(count > 50);
        sum / f64::from(count)
    };
    for azimuth_deg in [-150.0, 20.0] {
        let shot = photo(azimuth_deg);
        let (towards, away) = (mean(&shot, azimuth_deg), mean(&shot, azimuth_deg + 180.0));
        assert!(away < 0.92 * towards, "{away} {towards}");
    }
}

#[test]
fn another_seed_is_another_flight() {
    let mut config = config();
    let one = config.build().unwrap();
    config.field.seed = 2;
    let two = config.build().unwrap();
    assert_ne!(one.shots, two.shots);
    assert_ne!(photos(&one)[0].image, photos(&two)[0].image);
}

#[test]
fn exif_says_where_and_when() {
    let mut config = TwinConfig::preset(FlightPreset::Small);
    config.flight.photos_per_strip = 2;
    config.flight.strips = 1;
    let twin = config.build().unwrap();
    let image = RgbImage::from_pixel(64, 64, image::Rgb([90, 80, 60]));
    let shot = &twin.shots[1];
    let low = exif::jpeg(&image, 30, shot, &twin.config.camera, &twin.site).unwrap();
    let bytes = exif::jpeg(&image, 95, shot, &twin.config.camera, &twin.site).unwrap();
    assert!(low.len() < bytes.len());
    let read =
        ::exif::Reader::new().read_from_container(&mut std::io::Cursor::new(&bytes)).unwrap();
    let get = |tag| read.get_field(tag, ::exif::In::PRIMARY).unwrap();
    let degrees = |tag| match &get(tag).value {
        ::exif::Value::Rational(parts) => {
            parts[0].to_f64() + parts[1].to_f64() / 60.0 + parts[2].to_f64() / 3600.0
        }
        other => panic!("{other:?}"),
    };
    let [latitude, longitude, height] = twin.site.geographic(shot.gnss_m).unwrap();
    use ::exif::Tag;
    // A hundred-thousandth of an arc second; west of Greenwich.
    approx::assert_abs_diff_eq!(degrees(Tag::GPSLatitude), latitude, epsilon = 2e-9);
    approx::assert_abs_diff_eq!(degrees(Tag::GPSLongitude), -longitude, epsilon = 2e-9);
    assert_eq!(get(Tag::GPSLongitudeRef).display_value().to_string(), "W");
    assert_eq!(get(Tag::GPSLatitudeRef).display_value().to_string(), "N");
    match &get(Tag::GPSAltitude).value {
        ::exif::Value::Rational(parts) => {
            approx::assert_abs_diff_eq!(parts[0].to_f64(), height, epsilon = 1e-3)
        }
        other => panic!("{other:?}"),
    }
    for (tag, expected) in [(Tag::Make, "Synthetic"), (Tag::Model, "Compact camera")] {
        assert!(get(tag).display_value().to_string().contains(expected));
    }
    assert!(get(Tag::DateTimeOriginal).display_value().to_string().starts_with("2015-06-24 11:30"));
    assert!(get(Tag::FocalLength).display_value().to_string().starts_with("4.3"));
}
