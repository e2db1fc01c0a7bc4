//! `rowgram segment`, as a user meets it.

use crate::{data, program::rowgram};
use image::{Rgb, RgbImage};
use insta::assert_snapshot;
use rowgram::io::images::{self, Picture};
use std::path::Path;

const SOIL: Rgb<u8> = Rgb([150, 120, 90]);
const LEAF: Rgb<u8> = Rgb([70, 160, 60]);

/// A leaf of 8 x 4 pixels with a hole, a speck, and soil.
fn photo(folder: &Path) -> RgbImage {
    let photo = RgbImage::from_fn(30, 20, |u, v| match (u, v) {
        (7, 7) => SOIL,
        (5..13, 6..10) | (25, 15) => LEAF,
        _ => SOIL,
    });
    photo.save(folder.join("photo.png")).unwrap();
    photo
}

fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    photo(folder.path());
    folder
}

#[test]
fn a_photo_becomes_a_mask() {
    let folder = folder();
    let run = rowgram(folder.path(), "segment photo.png --hsv 30,79,30,163 -o mask.png");
    assert_eq!((run.code, run.stderr.as_str()), (0, ""));
    assert_snapshot!(run.stdout.trim(), @"32 of 600 pixels are leaf (5.33 %), in 2 connected areas");
    let mask = images::read_mask(&folder.path().join("mask.png")).unwrap();
    assert!(mask.get(5, 6) && mask.get(25, 15) && !mask.get(7, 7) && !mask.get(4, 6));
    assert_eq!(mask.count(), 32);
    let stored = image::open(folder.path().join("mask.png")).unwrap();
    let image::DynamicImage::ImageLuma8(stored) = stored else { panic!("it is grey") };
    assert!(stored.pixels().all(|pixel| pixel.0[0] == 0 || pixel.0[0] == 255));
}

#[test]
fn a_mask_is_cleaned_and_drawn() {
    let folder = folder();
    let options =
        "--hsv 30,79,30,163 --min-pixels 2 --fill-holes 1 --figures figures --json --quiet";
    let run = rowgram(folder.path(), &format!("segment photo.png -o mask.png {options}"));
    assert_eq!((run.code, run.stderr.as_str()), (0, ""));
    assert_snapshot!(run.stdout, @r#"{"image":"photo.png","width_px":30,"height_px":20,"hsv":[30,79,30,163],"leaf_pixels":32,"leaf_share":0.05333333333333334,"valid_share":1.0,"components":1,"removed_components":1,"removed_pixels":1,"filled_holes":1,"filled_pixels":1,"diagnostics":[]}"#);
    let seen = images::read_photo(&folder.path().join("figures/mask.png")).unwrap();
    assert_eq!(seen.get_pixel(0, 0), &SOIL);
    assert_eq!(seen.get_pixel(25, 15), &LEAF, "the speck is not marked");
    assert_ne!(seen.get_pixel(5, 6), &LEAF);
}

#[test]
fn the_smallest_pictures_work() {
    let folder = tempfile::tempdir().unwrap();
    RgbImage::from_pixel(1, 1, LEAF).save(folder.path().join("one.png")).unwrap();
    let run =
        rowgram(folder.path(), "segment one.png --hsv 30,79,30,163 -o mask.png --figures figures");
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert_eq!(images::read_mask(&folder.path().join("mask.png")).unwrap().data, [1]);
    RgbImage::from_pixel(1, 1, SOIL).save(folder.path().join("soil.png")).unwrap();
    let run = rowgram(folder.path(), "segment soil.png --hsv 30,79,30,163 -o empty.png --json");
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert_snapshot!(run.stderr.trim(), @"warning: soil.png: no pixel is within the thresholds; the leaf mask is empty; choose other thresholds (rowgram segment thresholds, then --hsv)");
    assert!(run.stdout.contains("\"leaf_pixels\":0,\"leaf_share\":0.0"), "{}", run.stdout);
    // A PNG header with a width of 0.
    let mut bytes = std::fs::read(folder.path().join("one.png")).unwrap();
    bytes[16..20].fill(0);
    let mut crc = flate2::Crc::new();
    crc.update(&bytes[12..29]);
    bytes[29..33].copy_from_slice(&crc.sum().to_be_bytes());
    std::fs::write(folder.path().join("zero.png"), bytes).unwrap();
    let run = rowgram(folder.path(), "segment zero.png -o none.png");
    assert_eq!(run.code, 2);
    assert!(run.stderr.starts_with("error: zero.png: "), "{}", run.stderr);
}

#[test]
fn bad_input_is_explained() {
    let folder = folder();
    let path = |name: &str| folder.path().join(name);
    let photo = std::fs::read(path("photo.png")).unwrap();
    std::fs::write(path("cut.png"), &photo[..photo.len() / 2]).unwrap();
    std::fs::write(path("text.png"), "u_px,v_px\n").unwrap();
    std::fs::write(path("empty.png"), "").unwrap();
    std::fs::write(path("taken.png"), "mine").unwrap();
    images::write_grey(&path("mask.png"), false, (3, 3), &[0; 9]).unwrap();
    std::os::unix::fs::symlink(path("photo.png"), path("link.png")).unwrap();
    let error = |arguments: &str| {
        let run = rowgram(folder.path(), &format!("segment {arguments}"));
        assert_eq!((run.code, run.stdout.as_str()), (2, ""), "{arguments}: {}", run.stderr);
        assert!(!path("new.png").exists(), "{arguments}");
        run.stderr
    };
    let first = |arguments: &str| error(arguments).lines().next().unwrap_or_default().to_owned();
    assert_snapshot!(first("photo.png --hsv 30,181,30,163 -o new.png"), @"error: --hsv [30, 181, 30, 163]: the largest hue is 181, expected a number from 0 to 180");
    assert_snapshot!(first("photo.png --hsv 80,79,30,163 -o new.png"), @"error: --hsv [80, 79, 30, 163]: the least hue 80 is above the largest hue 79");
    assert_snapshot!(first("photo.png --hsv -1,79,30,163 -o new.png"), @"error: --hsv [-1, 79, 30, 163]: expected auto or 4 whole numbers from 0 to 255");
    assert_snapshot!(first("photo.png --hsv 30,79 -o new.png"), @"error: --hsv [30, 79]: expected auto or 4 whole numbers from 0 to 255");
    assert_snapshot!(first("photo.png --hsv green -o new.png"), @r#"error: --hsv ["green"]: expected auto or 4 whole numbers from 0 to 255"#);
    assert_snapshot!(first("photo.png --min-pixel -1 -o new.png"), @"error: unexpected argument '--min-pixel' found");
    assert_snapshot!(first("photo.png"), @"error: photo.png is a single file: give the file to write (--output)");
    assert!(
        error("cut.png -o new.png").starts_with("error: cut.png: damaged or unsupported PNG: ")
    );
    assert_snapshot!(error("text.png -o new.png"), @"error: text.png: expected a PNG, JPEG or TIFF picture");
    assert_snapshot!(error("empty.png -o new.png"), @"error: empty.png: the file is empty, expected a PNG, JPEG or TIFF picture");
    assert_snapshot!(error("mask.png -o new.png"), @"error: mask.png: it holds a mask (two values), expected a photo");
    assert_snapshot!(error("none.png -o new.png"), @"error: cannot read none.png: No such file or directory (os error 2)");
    assert_snapshot!(error(". -o results"), @"error: there is no orthomosaic in results/ortho; make one with rowgram ortho");
    assert_snapshot!(error("photo.png -o taken.png"), @"error: taken.png exists already; give --force to replace it, or another path");
    assert_snapshot!(error("photo.png -o taken.png --figures figures"), @"error: taken.png exists already; give --force to replace it, or another path");
    assert_snapshot!(error("photo.png -o photo.png --force"), @"error: photo.png is an input, expected another output");
    assert_snapshot!(error("photo.png -o link.png --force"), @"error: link.png is an input, expected another output");
    assert_snapshot!(error("photo.png -o new.jpg"), @"error: new.jpg: expected a name that ends in .png or .tif or .tiff");
    assert_eq!(std::fs::read(path("photo.png")).unwrap(), photo);
    assert_eq!(std::fs::read(path("taken.png")).unwrap(), b"mine");
    let run = rowgram(folder.path(), "segment photo.png -o taken.png --force");
    assert_eq!(run.code, 0, "{}", run.stderr);
    let run = rowgram(folder.path(), "segment photo.png -o missing/new.png");
    assert_eq!(run.code, 2, "a path that cannot be used is bad input");
    assert!(run.stderr.contains("its folder does not exist"), "{}", run.stderr);
}

#[test]
fn real_photos_and_masks_are_told_apart() {
    for (name, mask) in [
        ("maize_plots/image/500001.jpg", false),
        ("seg_rgbweed/Images/IMG_3438.JPG", false),
        ("seg_rgbweed/Weed_Plant_Masks/IMG_3438_mask.png", false),
        ("field_masks/mid20/1000.png", true),
        ("leaf_cvppp_a1/plant001_fg.png", true),
        ("leaf_cvppp_a1/plant001_label.png", false),
        ("leaf_cvppp_a1/plant001_rgb.png", false),
    ] {
        if let Some(path) = data::path(name) {
            let found = images::read(&path).unwrap();
            assert_eq!(matches!(found, Picture::Mask(_)), mask, "{name}");
        }
    }
}

/// A field in three colours with noise: leaves where `is_leaf` says so.
fn noisy(width: u32, height: u32, is_leaf: impl Fn(u32, u32) -> bool) -> RgbImage {
    RgbImage::from_fn(width, height, |u, v| {
        let noise = (u.wrapping_mul(2_654_435_761) ^ v.wrapping_mul(40_503)) >> 7;
        let add = |value: u8, k: u32| value + ((noise >> (4 * k)) % 14) as u8;
        let [r, g, b] = if is_leaf(u, v) { [62, 118, 48] } else { [122, 104, 84] };
        Rgb([add(r, 0), add(g, 1), add(b, 2)])
    })
}

/// One round plant of 11 px radius.
fn is_plant(u: u32, v: u32) -> bool {
    (u as f32 - 90.0).hypot(v as f32 - 60.0) < 11.0
}

/// The share of pixels on which the mask of a photo agrees with the plant, and the leaf pixels.
fn of_one_plant(folder: &Path, photo: &str) -> (f64, usize) {
    let mask = folder.join("mask.png");
    let run = rowgram(folder, &format!("segment {photo} -o mask.png --force"));
    assert_eq!(run.code, 0, "{photo}: {}", run.stderr);
    let mask = images::read_mask(&mask).unwrap();
    let right = (0..mask.data.len()).filter(|i| {
        let (u, v) = (i % mask.width, i / mask.width);
        mask.get(u, v) == is_plant(u as u32, v as u32)
    });
    (right.count() as f64 / mask.data.len() as f64, mask.count())
}

#[test]
fn a_noisy_photo_is_called_noisy() {
    let folder = tempfile::tempdir().unwrap();
    let mut photo = noisy(180, 120, is_plant);
    photo.save(folder.path().join("usual.png")).unwrap();
    // Noise six times as strong as that of `noisy`: bits of a product are as good as random.
    for (u, v, pixel) in photo.enumerate_pixels_mut() {
        let noise = (u.wrapping_mul(2_246_822_519) ^ v.wrapping_mul(3_266_489_917)) >> 9;
        for (k, value) in pixel.0.iter_mut().enumerate() {
            *value = value.saturating_add(((noise >> (5 * k)) % 84) as u8);
        }
    }
    photo.save(folder.path().join("noisy.png")).unwrap();
    for (name, is_noisy) in [("usual", false), ("noisy", true)] {
        let run = rowgram(folder.path(), &format!("segment {name}.png -o {name}-mask.png"));
        assert_eq!(run.code, 0, "{name}: {}", run.stderr);
        assert_eq!(run.stderr.contains("colours are noisy"), is_noisy, "{name}: {}", run.stderr);
    }
}

#[test]
fn surrounds_transparency_and_depth_do_not_change_the_vegetation() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let plant = noisy(180, 120, is_plant);
    plant.save(path("plain.png")).unwrap();
    // A mosaic with a black surround that JPEG compression has made noisy.
    let mut framed = plant.clone();
    for (u, _, pixel) in framed.enumerate_pixels_mut() {
        if !(40..140).contains(&u) {
            *pixel = Rgb([0; 3]);
        }
    }
    images::write_as_named(&path("framed.jpg"), false, &framed).unwrap();
    // The surround is transparent and green.
    let mut clear = image::DynamicImage::from(plant.clone()).into_rgba8();
    for (u, v, pixel) in clear.enumerate_pixels_mut() {
        if !(40..140).contains(&u) || (5..15).contains(&v) {
            *pixel = image::Rgba([20, 250, 20, 0]);
        }
    }
    clear.save(path("clear.png")).unwrap();
    image::DynamicImage::from(plant).into_rgb16().save(path("deep.png")).unwrap();
    for photo in ["plain.png", "framed.jpg", "clear.png", "deep.png"] {
        let (right, _) = of_one_plant(folder.path(), photo);
        assert!(right > 0.99, "{photo}: {right} of the pixels are right");
    }
    let nothing = image::RgbaImage::from_pixel(30, 20, image::Rgba([20, 250, 20, 0]));
    nothing.save(path("nothing.png")).unwrap();
    let run = rowgram(folder.path(), "segment nothing.png -o none.png");
    assert_eq!(run.code, 2, "{}", run.stderr);
    assert!(run.stderr.contains("no pixel of 30 x 20 shows anything"), "{}", run.stderr);
}

/// As GDAL and cameras write them (`golden/pictures.py`); an orientation in the metadata does not turn pixels.
#[test]
fn masks_inks_and_orientations_do_not_change_the_vegetation() {
    let folder = tempfile::tempdir().unwrap();
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/pictures");
    for photo in ["internal_mask.tif", "nodata.tif", "cmyk.jpg", "turned.jpg"] {
        std::fs::copy(golden.join(photo), folder.path().join(photo)).unwrap();
        let (right, _) = of_one_plant(folder.path(), photo);
        assert!(right > 0.995, "{photo}: {right} of the pixels are right");
        let run = rowgram(folder.path(), &format!("locate {photo} -o plants.csv --force --json"));
        assert_eq!(run.code, 0, "{photo}: {}", run.stderr);
        assert!(run.stdout.contains(r#""plants":1,"#), "{photo}: {}", run.stdout);
    }
}

#[test]
fn no_plant_and_one_plant_are_answers() {
    let folder = tempfile::tempdir().unwrap();
    noisy(180, 120, |_, _| false).save(folder.path().join("soil.png")).unwrap();
    noisy(180, 120, is_plant).save(folder.path().join("plant.png")).unwrap();
    let two = |u, v| is_plant(u, v) || is_plant(u + 50, v + 9);
    noisy(180, 120, two).save(folder.path().join("two.png")).unwrap();
    for (photo, plants) in [("plant.png", 1), ("two.png", 2)] {
        let run = rowgram(folder.path(), &format!("locate {photo} -o plants.csv --force --json"));
        assert_eq!(run.code, 0, "{photo}: {}", run.stderr);
        let number = format!(r#""plants":{plants},"#);
        assert!(run.stdout.contains(&number), "{photo}: {}", run.stdout);
    }
    let run = rowgram(folder.path(), "locate soil.png -o none.csv");
    let told = run.stdout.contains("0 plants") || run.stderr.contains("no leaf pixel");
    assert!(told, "{} {}", run.stdout, run.stderr);
}

#[test]
fn bare_soil_is_empty_and_full_cover_is_full() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    noisy(180, 120, |_, _| false).save(path("soil.png")).unwrap();
    noisy(180, 120, |_, _| true).save(path("full.png")).unwrap();
    noisy(180, 120, |u, v| u / 3 != 20 || v / 3 != 20).save(path("hardly.png")).unwrap();
    let (_, soil) = of_one_plant(folder.path(), "soil.png");
    assert!(soil < 22, "{soil} leaf pixels on bare soil");
    for photo in ["full.png", "hardly.png"] {
        let (_, full) = of_one_plant(folder.path(), photo);
        assert!(full > 21_380, "{photo}: {full} of 21600 leaf pixels");
    }
}

#[test]
fn the_posterior_is_written_on_request() {
    let folder = tempfile::tempdir().unwrap();
    noisy(180, 120, is_plant).save(folder.path().join("plant.png")).unwrap();
    let run = rowgram(folder.path(), "segment plant.png -o mask.png --posterior posterior.png");
    assert_eq!(run.code, 0, "{}", run.stderr);
    let posterior = image::open(folder.path().join("posterior.png")).unwrap().into_luma8();
    assert!(posterior.get_pixel(90, 60).0[0] > 200 && posterior.get_pixel(20, 20).0[0] < 50);
    let refused = "segment plant.png --hsv 30,79,30,163 -o other.png --posterior no.png";
    let run = rowgram(folder.path(), refused);
    assert_eq!(run.code, 2, "{}", run.stderr);
    assert!(run.stderr.contains("thresholds (hsv) give no posterior"), "{}", run.stderr);
}
