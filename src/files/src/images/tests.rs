//! Every kind of picture, whole and damaged.

use super::*;
use image::{ImageBuffer, Luma, Rgb, Rgba};
use proptest::prelude::*;
use std::sync::LazyLock;

fn encoded(image: impl Into<DynamicImage>, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image.into().write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

fn png(image: impl Into<DynamicImage>) -> Vec<u8> {
    encoded(image, ImageFormat::Png)
}

/// Something like a photo.
fn scene(width: u32, height: u32) -> RgbImage {
    RgbImage::from_fn(width, height, |u, v| {
        Rgb([(40 + 3 * u + v) as u8, (90 + u * v % 60) as u8, (30 + 2 * v) as u8])
    })
}

fn mask_of(bytes: &[u8]) -> Option<Vec<u8>> {
    decode_bytes(bytes).unwrap().as_mask(false).map(|mask| mask.data)
}

fn photo_of(bytes: &[u8]) -> RgbImage {
    let stored = decode_bytes(bytes).unwrap();
    assert_eq!(stored.as_mask(false), None);
    stored.into_rgb()
}

#[test]
fn photos_are_read_from_every_format() {
    let photo = scene(31, 17);
    assert_eq!(photo_of(&png(photo.clone())), photo);
    assert_eq!(photo_of(&encoded(photo.clone(), ImageFormat::Tiff)), photo);
    let jpeg = photo_of(&encoded(photo.clone(), ImageFormat::Jpeg));
    assert_eq!(jpeg.dimensions(), (31, 17));
    let grey = GrayImage::from_fn(20, 20, |u, v| Luma([(10 * u + v) as u8]));
    for format in [ImageFormat::Png, ImageFormat::Tiff, ImageFormat::Jpeg] {
        let read = photo_of(&encoded(grey.clone(), format));
        assert!(read.pixels().all(|p| p.0[0] == p.0[1] && p.0[1] == p.0[2]), "{format:?}");
    }
}

#[test]
fn sixteen_bits_and_transparency_are_handled() {
    let deep = ImageBuffer::<Rgb<u16>, _>::from_raw(2, 1, vec![0, 128, 65535, 257, 514, 771]);
    assert_eq!(photo_of(&png(deep.unwrap())).into_raw(), [0, 0, 255, 1, 2, 3]);
    let clear = ImageBuffer::<Rgba<u8>, _>::from_raw(2, 1, vec![9, 8, 7, 0, 6, 5, 4, 1]);
    assert_eq!(photo_of(&png(clear.unwrap())).into_raw(), [0, 0, 0, 6, 5, 4]);
    let float = image::Rgb32FImage::from_pixel(2, 2, Rgb([0.5; 3]));
    let error = decode_bytes(&encoded(float, ImageFormat::Tiff)).err().unwrap();
    assert_eq!(error, "unsupported TIFF: Rgb32F, expected 8 or 16 bits per channel");
}

#[test]
fn two_values_in_grey_or_pure_black_and_white_are_a_mask() {
    let grey =
        |values: &[u8]| GrayImage::from_raw(values.len() as u32, 1, values.to_vec()).unwrap();
    assert_eq!(mask_of(&png(grey(&[0, 255, 0]))), Some(vec![0, 1, 0]));
    assert_eq!(mask_of(&png(grey(&[1, 0, 1]))), Some(vec![1, 0, 1]));
    assert_eq!(mask_of(&png(grey(&[200, 17]))), Some(vec![1, 0]));
    assert_eq!(mask_of(&encoded(grey(&[255, 0]), ImageFormat::Tiff)), Some(vec![1, 0]));
    assert_eq!(mask_of(&png(grey(&[0, 128, 255]))), None);
    assert_eq!(mask_of(&png(grey(&[0, 0]))), Some(vec![0, 0]), "an empty mask");
    assert_eq!(mask_of(&png(grey(&[255]))), Some(vec![1]));
    assert_eq!(mask_of(&png(grey(&[128]))), None);
    let deep = ImageBuffer::<Luma<u16>, _>::from_raw(2, 1, vec![65535u16, 0]).unwrap();
    assert_eq!(mask_of(&png(deep)), Some(vec![1, 0]));
    let colours = |values: &[u8]| RgbImage::from_raw(2, 1, values.to_vec()).unwrap();
    assert_eq!(mask_of(&png(colours(&[0, 0, 0, 255, 255, 255]))), Some(vec![0, 1]));
    assert_eq!(mask_of(&png(colours(&[0, 0, 0, 255, 0, 0]))), None);
    assert_eq!(mask_of(&png(colours(&[0; 6]))), None);
    assert_eq!(mask_of(&png(RgbImage::from_pixel(1, 1, Rgb([90, 150, 40])))), None);
    let clear = image::RgbaImage::from_raw(2, 1, vec![255, 255, 255, 0, 255, 255, 255, 255]);
    assert_eq!(mask_of(&png(clear.unwrap())), Some(vec![0, 1]));
    let black = decode_bytes(&png(colours(&[0; 6]))).unwrap();
    assert_eq!(black.as_mask(true).unwrap().data, [0, 0], "where a mask is expected");
}

/// A PNG whose pixels are bits, with a palette of two colours or in grey.
fn bit_png(palette: Option<[u8; 6]>, bytes: &[u8; 2]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut encoder = png_writer(&mut out, palette);
    encoder.write_image_data(bytes).unwrap();
    encoder.finish().unwrap();
    out
}

fn png_writer(out: &mut Vec<u8>, palette: Option<[u8; 6]>) -> png::Writer<&mut Vec<u8>> {
    let mut encoder = png::Encoder::new(out, 8, 2);
    encoder.set_depth(png::BitDepth::One);
    encoder.set_color(png::ColorType::Grayscale);
    if let Some(palette) = palette {
        encoder.set_color(png::ColorType::Indexed);
        encoder.set_palette(palette.to_vec());
    }
    encoder.write_header().unwrap()
}

#[test]
fn bilevel_and_palette_pngs_are_masks() {
    let expected = vec![1, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1];
    assert_eq!(mask_of(&bit_png(None, &[0xA0, 0x0F])), Some(expected.clone()));
    let green_on_brown = Some([60, 30, 10, 50, 200, 50]);
    assert_eq!(mask_of(&bit_png(green_on_brown, &[0xA0, 0x0F])), Some(expected.clone()));
    let inverted = Some([255, 0, 0, 0, 0, 0]);
    assert_eq!(mask_of(&bit_png(inverted, &[0x5F, 0xF0])), Some(expected));
    assert_eq!(mask_of(&bit_png(green_on_brown, &[0, 0])), None, "one colour alone may be a photo");
    assert_eq!(mask_of(&bit_png(inverted, &[0xFF, 0xFF])), Some(vec![0; 16]));
}

#[test]
fn files_are_written_and_told_apart() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let mask = Mask::from_fn(9, 4, |u, v| (u + v) % 3 == 0);
    let white: Vec<u8> = mask.data.iter().map(|&plant| if plant == 0 { 0 } else { 255 }).collect();
    write_grey(&path("mask.png"), false, (9, 4), &white).unwrap();
    write_photo(&path("photo.jpg"), false, &scene(9, 4)).unwrap();
    assert_eq!(read(&path("mask.png")).unwrap(), Picture::Mask(mask.clone()));
    assert_eq!(read_mask(&path("mask.png")).unwrap(), mask);
    assert_eq!(read_photo(&path("photo.jpg")).unwrap(), scene(9, 4), "told by content");
    let error = read_photo(&path("mask.png")).unwrap_err().to_string();
    assert!(error.ends_with("mask.png: it holds a mask (two values), expected a photo"), "{error}");
    let error = read_mask(&path("photo.jpg")).unwrap_err().to_string();
    assert!(error.ends_with("it holds a photo (more than two values), expected a mask"), "{error}");
    assert!(matches!(
        write_grey(&path("mask.png"), false, (9, 4), &white),
        Err(FileError::Exists { .. })
    ));
    assert!(matches!(read(&path("none.png")), Err(FileError::Read { .. })));
    let error = write_grey(&path("empty.png"), false, (0, 3), &[]).unwrap_err();
    assert!(error.to_string().contains("0 x 3 pixels cannot be a PNG"), "{error}");
    assert!(write_photo(&path("empty.png"), false, &RgbImage::new(0, 0)).is_err());
    assert!(write_grey(&path("wrong.png"), false, (3, 3), &[1; 8]).is_err());
    assert!(!path("wrong.png").exists());
}

#[test]
fn truncated_files_are_refused() {
    for format in [ImageFormat::Png, ImageFormat::Tiff, ImageFormat::Jpeg] {
        let bytes = encoded(scene(64, 48), format);
        for end in (0..bytes.len()).step_by(1 + bytes.len() / 150).chain([bytes.len() - 1]) {
            // The directory of a TIFF is at its end, the last chunk of a PNG is empty.
            let needed = if format == ImageFormat::Png { bytes.len() - 12 } else { bytes.len() };
            let result = decode_bytes(&bytes[..end]);
            assert!(result.is_err() || end >= needed, "{format:?} cut to {end} of {}", bytes.len());
        }
    }
    assert!(decode_bytes(&[]).err().unwrap().contains("is empty"));
    let webp = decode_bytes(b"RIFF\x24\0\0\0WEBPVP8 ").err().unwrap();
    assert!(webp.starts_with("it is a WebP picture whatever its name says"), "{webp}");
    assert_eq!(decode_bytes(b"u_px,v_px\n").err().unwrap(), "expected a PNG, JPEG or TIFF picture");
}

#[test]
fn a_thumbnail_does_not_stand_for_the_end() {
    let photo = encoded(scene(64, 48), ImageFormat::Jpeg);
    let thumbnail = encoded(scene(8, 8), ImageFormat::Jpeg);
    let length = (thumbnail.len() + 2) as u16;
    let mut bytes = photo[..2].to_vec();
    bytes.extend([0xFF, 0xE1]);
    bytes.extend(length.to_be_bytes());
    bytes.extend(&thumbnail);
    bytes.extend(&photo[2..]);
    assert!(decode_bytes(&bytes).is_ok());
    assert!(decode_bytes(&bytes[..bytes.len() - 2]).is_err());
    bytes.extend([0; 1000]);
    assert!(decode_bytes(&bytes).is_ok(), "cameras write more after the end");
}

#[test]
fn a_header_that_lies_about_the_size_is_refused_before_memory_is_asked_for() {
    let mut bytes = png(scene(8, 8));
    bytes[16..24].copy_from_slice(&[0, 0, 0xFF, 0xFF, 0, 0, 0x7F, 0xFF]);
    let crc = {
        let mut crc = flate2::Crc::new();
        crc.update(&bytes[12..29]);
        crc.sum()
    };
    bytes[29..33].copy_from_slice(&crc.to_be_bytes());
    let error = decode_bytes(&bytes).err().unwrap();
    assert!(error.contains("the header says 65535 x 32767 pixels, too many for"), "{error}");
    assert!(check_size(40_000, 60_000, usize::MAX, 1).unwrap_err().contains("into tiles"));
    assert!(check_size(12_000, 10_000, 5_000_000, 1024).is_ok());
}

#[test]
fn a_large_picture_is_read() {
    let large = GrayImage::from_fn(12_500, 8_400, |u, _| Luma([if u < 10 { 255 } else { 0 }]));
    let mask = decode_bytes(&png(large)).unwrap().as_mask(false).unwrap();
    assert_eq!((mask.width, mask.height, mask.count()), (12_500, 8_400, 84_000));
}

static SAMPLES: LazyLock<Vec<Vec<u8>>> = LazyLock::new(|| {
    let formats = [ImageFormat::Png, ImageFormat::Jpeg, ImageFormat::Tiff];
    let mut samples: Vec<_> = formats.into_iter().map(|f| encoded(scene(40, 24), f)).collect();
    samples.push(bit_png(Some([0, 0, 0, 9, 9, 9]), &[0xA0, 0x0F]));
    samples
});

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1500))]
    #[test]
    fn damaged_files_never_panic(
        which in 0usize..4,
        damage in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8),
        end in any::<prop::sample::Index>(),
        cut in any::<bool>(),
    ) {
        let mut bytes = SAMPLES[which].clone();
        if cut {
            bytes.truncate(end.index(bytes.len()));
        }
        for (place, value) in damage {
            if !bytes.is_empty() {
                let place = place.index(bytes.len());
                bytes[place] = value;
            }
        }
        if let Ok(stored) = decode_bytes(&bytes) {
            let mask = stored.as_mask(true);
            let photo = stored.into_rgb();
            if let Some(mask) = mask {
                prop_assert_eq!(mask.data.len(), photo.as_raw().len() / 3);
            }
        }
    }
}
