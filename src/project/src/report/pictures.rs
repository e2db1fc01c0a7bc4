//! Pictures that go into the page itself, as data URIs.

use base64::{Engine, engine::general_purpose::STANDARD};
use image::{ImageFormat, Rgb, RgbImage, RgbaImage, codecs::jpeg::JpegEncoder};
use rowgram_base::error::Error;
use rowgram_files::rasters::Source;
use rowgram_optim::output::FileError;
use std::{io::Cursor, path::Path};

/// Quality of the JPEGs.
const QUALITY: u8 = 82;

/// Largest side of a picture of a stage in the page, pixels: wider than the page is shown on most screens. At full size the three largest
/// pictures of a map of 247 million pixels (`rowgram run`) had 47 megabytes.
const SIDE_PX: u32 = 1600;

/// An SVG drawing or a PNG picture: as the file is, but a picture larger than [`SIDE_PX`] as a smaller JPEG.
///
/// # Errors
/// A file that cannot be read, or that is no PNG picture.
pub(super) fn file(path: &Path) -> Result<String, Error> {
    let bytes = std::fs::read(path).map_err(|e| FileError::read(path, e))?;
    if path.extension().is_some_and(|ending| ending == "svg") {
        return Ok(format!("data:image/svg+xml;base64,{}", STANDARD.encode(bytes)));
    }
    let malformed = |e: image::ImageError| FileError::malformed(path, None, e.to_string());
    let reader = || image::ImageReader::with_format(Cursor::new(&bytes), ImageFormat::Png);
    let (width, height) = reader().into_dimensions().map_err(malformed)?;
    if width.max(height) > SIDE_PX {
        let picture = reader().decode().map_err(malformed)?.to_rgba8();
        return jpeg(&on_white(&picture), SIDE_PX);
    }
    Ok(format!("data:image/png;base64,{}", STANDARD.encode(bytes)))
}

/// A picture that may be transparent, on white.
fn on_white(picture: &RgbaImage) -> RgbImage {
    RgbImage::from_fn(picture.width(), picture.height(), |u, v| {
        let [red, green, blue, alpha] = picture.get_pixel(u, v).0.map(u32::from);
        let over = |colour: u32| ((colour * alpha + 255 * (255 - alpha) + 127) / 255) as u8;
        Rgb([over(red), over(green), over(blue)])
    })
}

/// A picture as JPEG, no wider or higher than `side_px`.
///
/// # Errors
/// Where it cannot be encoded.
pub(super) fn jpeg(picture: &RgbImage, side_px: u32) -> Result<String, Error> {
    let largest = picture.width().max(picture.height());
    let small = (largest > side_px).then(|| {
        let scale = f64::from(side_px) / f64::from(largest);
        let size = |n: u32| (f64::from(n) * scale).round().max(1.0) as u32;
        image::imageops::thumbnail(picture, size(picture.width()), size(picture.height()))
    });
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, QUALITY)
        .encode_image(small.as_ref().unwrap_or(picture))
        .map_err(|e| FileError::write("report.html".as_ref(), std::io::Error::other(e)))?;
    Ok(format!("data:image/jpeg;base64,{}", STANDARD.encode(bytes)))
}

/// A raster in a smaller scale.
pub(super) struct Overview {
    pub(super) picture: RgbImage,
    /// Columns and rows of the raster.
    pub(super) size: (usize, usize),
    /// Which pixels of the picture (row by row) show nothing.
    gaps: Vec<bool>,
    /// Whether the raster says which of its pixels show nothing.
    states_gaps: bool,
}

impl Overview {
    /// The picture with paper where it shows nothing.
    pub(super) fn on_paper(self) -> RgbImage {
        on_paper(self.picture, Some(&self.gaps), self.states_gaps)
    }
}

/// What is drawn where a map shows nothing: it reads as paper in both colour schemes, black as a dark field.
const NOTHING: Rgb<u8> = Rgb([238, 239, 235]);

/// `picture` with paper where it shows nothing: in its `gaps`, and where it is entirely black, as mosaics are outside of what photos
/// cover, unless its file `states_gaps` and black is a colour.
pub(super) fn on_paper(
    mut picture: RgbImage,
    gaps: Option<&[bool]>,
    states_gaps: bool,
) -> RgbImage {
    for (k, pixel) in picture.pixels_mut().enumerate() {
        let is_gap = gaps.is_some_and(|gaps| gaps[k]);
        if is_gap || (!states_gaps && pixel.0 == [0; 3]) {
            *pixel = NOTHING;
        }
    }
    picture
}

/// Reads a raster by bands and means blocks of its pixels, so that no side is longer than `side_px`.
///
/// # Errors
/// Where it cannot be read.
pub(super) fn overview(source: &Source, side_px: usize) -> Result<Overview, Error> {
    let (width, height) = source.size();
    let step = width.max(height).div_ceil(side_px).max(1);
    let (columns, rows) = (width.div_ceil(step), height.div_ceil(step));
    let mut sums = vec![[0u32; 4]; columns * rows];
    for band in rowgram_raster::window::bands(height, rowgram_files::rasters::BAND_ROWS, 0) {
        let (part, gaps) = source.rgb_and_gaps(band.rows.clone())?;
        for (k, (u, v, Rgb(pixel))) in part.enumerate_pixels().enumerate() {
            if gaps.as_ref().is_some_and(|gaps| gaps[k]) {
                continue;
            }
            let row = (band.rows.start + v as usize) / step;
            let sum = &mut sums[row * columns + u as usize / step];
            (0..3).for_each(|k| sum[k] += u32::from(pixel[k]));
            sum[3] += 1;
        }
    }
    let picture = RgbImage::from_fn(columns as u32, rows as u32, |u, v| {
        let sum = sums[v as usize * columns + u as usize];
        Rgb([0, 1, 2].map(|k| (sum[k] / sum[3].max(1)) as u8))
    });
    let gaps = sums.iter().map(|sum| sum[3] == 0).collect();
    Ok(Overview { picture, size: (width, height), gaps, states_gaps: source.states_gaps() })
}

/// Pixels of a raster as they are, around a place.
///
/// # Errors
/// Where it cannot be read.
pub(super) fn detail(
    source: &Source,
    around: [f64; 2],
    [width, height]: [usize; 2],
) -> Result<([usize; 2], RgbImage), Error> {
    let (columns, rows) = source.size();
    let (width, height) = (width.min(columns), height.min(rows));
    let first = |at: f64, size: usize, all: usize| {
        ((at - size as f64 / 2.0).max(0.0) as usize).min(all - size)
    };
    let (u, v) = (first(around[0], width, columns), first(around[1], height, rows));
    let band = source.rgb(v..v + height)?;
    let part = image::imageops::crop_imm(&band, u as u32, 0, width as u32, height as u32);
    Ok(([u, v], part.to_image()))
}

/// Several pixels of a mask as one, darker where more of them are plant.
pub(super) fn green(overview: &RgbImage) -> RgbImage {
    RgbImage::from_fn(overview.width(), overview.height(), |u, v| {
        let share = f64::from(overview.get_pixel(u, v).0[0]) / 255.0;
        let from = |paper: f64, leaf: f64| (paper + share * (leaf - paper)) as u8;
        Rgb([from(247.0, 28.0), from(246.0, 110.0), from(240.0, 56.0)])
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decoded(uri: &str) -> image::DynamicImage {
        let (_, encoded) = uri.split_once(";base64,").unwrap();
        image::load_from_memory(&STANDARD.decode(encoded).unwrap()).unwrap()
    }

    #[test]
    fn large_pictures_are_shrunk_and_small_ones_stay_as_they_are() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.png");
        let clear_left = |u: u32| if u < 1000 { [0; 4] } else { [10, 120, 30, 255] };
        let large = RgbaImage::from_fn(4000, 1000, |u, _| image::Rgba(clear_left(u)));
        large.save(&path).unwrap();
        let uri = file(&path).unwrap();
        assert!(uri.starts_with("data:image/jpeg;"), "{}", &uri[..30]);
        let shown = decoded(&uri).to_rgb8();
        assert_eq!(shown.dimensions(), (1600, 400));
        let near = |at: &Rgb<u8>, to: [u8; 3]| (0..3).all(|k| at.0[k].abs_diff(to[k]) < 8);
        assert!(near(shown.get_pixel(100, 200), [255; 3]), "nothing reads as paper");
        assert!(near(shown.get_pixel(1000, 200), [10, 120, 30]));

        image::imageops::crop_imm(&large, 0, 0, 300, 200).to_image().save(&path).unwrap();
        let uri = file(&path).unwrap();
        let encoded = STANDARD.encode(std::fs::read(&path).unwrap());
        assert_eq!(uri, format!("data:image/png;base64,{encoded}"));

        std::fs::write(&path, "no picture").unwrap();
        assert!(file(&path).unwrap_err().to_string().contains("map.png"));
    }
}
