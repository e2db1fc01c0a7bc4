//! Photos and masks in PNG, JPEG and TIFF files.
//!
//! The format is told from the content, never from the file's name. Pixels are taken as stored:
//! an orientation in the metadata is not applied, and colour profiles are ignored, so that pixel
//! positions and colours are those of the file.
//!
//! - 16 bits per channel are scaled to 8 (65535 becomes 255). Floating point is refused.
//! - Transparent pixels (alpha 0) become black, which is no plant; any other alpha is ignored.
//! - A **mask** is a picture in grey or with a palette that has only two values (the brighter one
//!   is plant), a grey or black-and-white one that has only one, or any picture in pure black and
//!   white; also one that JPEG has blurred. Everything else is a **photo**.
//! - A JPEG that ends early or whose data are damaged is refused, not filled with grey.

pub(super) mod jpeg;
mod lossy;

use super::{FileError, memory, output};
use image::{
    DynamicImage, ExtendedColorType, GrayImage, ImageDecoder, ImageEncoder, ImageFormat, Limits,
    RgbImage,
    codecs::{
        jpeg::JpegEncoder,
        png::{PngDecoder, PngEncoder},
        tiff::{TiffDecoder, TiffEncoder},
    },
};
use rowgram_raster::Mask;
use std::{io::Cursor, path::Path};

/// What a picture file holds.
#[derive(Debug, Clone, PartialEq)]
pub enum Picture {
    /// A colour or grey photo.
    Photo(RgbImage),
    /// A leaf mask.
    Mask(Mask),
}

/// Reads a picture and tells whether it is a photo or a mask.
///
/// # Errors
/// Where the file cannot be read, or is not a whole PNG, JPEG or TIFF picture.
pub fn read(path: &Path) -> Result<Picture, FileError> {
    Ok(read_with_gaps(path)?.0)
}

/// As [`read`], and which pixels (row by row) are transparent (alpha 0); `None` where none is.
///
/// # Errors
/// As [`read`].
pub fn read_with_gaps(path: &Path) -> Result<(Picture, Option<Vec<bool>>), FileError> {
    let stored = decode(path)?;
    let gaps = stored.gaps();
    Ok(match stored.as_mask(false) {
        Some(mask) => (Picture::Mask(mask), gaps),
        None => (Picture::Photo(stored.into_rgb()), gaps),
    })
}

/// Reads a photo.
///
/// # Errors
/// As [`read`], and where the file holds a mask.
pub fn read_photo(path: &Path) -> Result<RgbImage, FileError> {
    match read(path)? {
        Picture::Photo(photo) => Ok(photo),
        Picture::Mask(_) => {
            Err(FileError::malformed(path, None, "it holds a mask (two values), expected a photo"))
        }
    }
}

/// Reads a picture in grey, whether photo or mask: luma of JPEGs as stored.
///
/// # Errors
/// As [`read`].
pub fn read_grey(path: &Path) -> Result<GrayImage, FileError> {
    Ok(decode(path)?.image.into_luma8())
}

/// Reads a picture in colour, whether photo or mask.
///
/// # Errors
/// As [`read`].
pub fn read_colour(path: &Path) -> Result<RgbImage, FileError> {
    Ok(read_colour_and_gaps(path)?.0)
}

/// As [`read_colour`], and which pixels (row by row) are transparent (alpha 0); `None` where none is.
///
/// # Errors
/// As [`read`].
pub fn read_colour_and_gaps(path: &Path) -> Result<(RgbImage, Option<Vec<bool>>), FileError> {
    let stored = decode(path)?;
    let gaps = stored.gaps();
    Ok((stored.into_rgb(), gaps))
}

/// Reads a mask; here a colour picture that is all black or all white is one too.
///
/// # Errors
/// As [`read`], and where the file holds a photo.
pub fn read_mask(path: &Path) -> Result<Mask, FileError> {
    decode(path)?.as_mask(true).ok_or_else(|| {
        let message = "it holds a photo (more than two values), expected a mask";
        FileError::malformed(path, None, message)
    })
}

/// Writes values as a grey PNG of so many columns and rows.
///
/// # Errors
/// As [`output::write`], and where there is no pixel or their number is another.
pub fn write_grey(
    path: &Path,
    force: bool,
    size: (usize, usize),
    values: &[u8],
) -> Result<(), FileError> {
    write_png(path, force, values, size, ExtendedColorType::L8)
}

/// Writes a photo or drawing as an RGB PNG.
///
/// # Errors
/// As [`output::write`], and where the picture has no pixel.
pub fn write_photo(path: &Path, force: bool, photo: &RgbImage) -> Result<(), FileError> {
    let size = (photo.width() as usize, photo.height() as usize);
    write_png(path, force, photo.as_raw(), size, ExtendedColorType::Rgb8)
}

/// Writes a photo in the format of the path's ending: PNG, TIFF, or JPEG of quality 95.
///
/// # Errors
/// As [`output::write`], and where the ending names none of these or the picture has no pixel.
pub fn write_as_named(path: &Path, force: bool, photo: &RgbImage) -> Result<(), FileError> {
    let ending = path.extension().and_then(|end| end.to_str()).unwrap_or("").to_lowercase();
    let (width, height) = photo.dimensions();
    let colour = ExtendedColorType::Rgb8;
    match ending.as_str() {
        "png" => write_photo(path, force, photo),
        "jpg" | "jpeg" => output::write(path, force, |writer| {
            JpegEncoder::new_with_quality(writer, JPEG_QUALITY)
                .write_image(photo.as_raw(), width, height, colour)
                .map_err(std::io::Error::other)
        }),
        "tif" | "tiff" => {
            let mut bytes = Cursor::new(Vec::new());
            TiffEncoder::new(&mut bytes)
                .write_image(photo.as_raw(), width, height, colour)
                .map_err(|error| FileError::write(path, std::io::Error::other(error)))?;
            output::write(path, force, |writer| writer.write_all(bytes.get_ref()))
        }
        _ => Err(FileError::Unusable {
            path: path.to_owned(),
            message: "expected a name that ends in .png, .jpg or .tif",
        }),
    }
}

/// High enough that what is measured in a photo does not change.
const JPEG_QUALITY: u8 = 95;

fn write_png(
    path: &Path,
    force: bool,
    bytes: &[u8],
    (width, height): (usize, usize),
    colour: ExtendedColorType,
) -> Result<(), FileError> {
    let invalid = |message: String| std::io::Error::new(std::io::ErrorKind::InvalidInput, message);
    let side = |pixels: usize| u32::try_from(pixels).ok().filter(|&pixels| pixels > 0);
    let expected = width.saturating_mul(height).saturating_mul(colour.channel_count().into());
    let (Some(columns), Some(rows), true) = (side(width), side(height), bytes.len() == expected)
    else {
        let message = format!("a picture of {width} x {height} pixels cannot be a PNG");
        return Err(FileError::write(path, invalid(message)));
    };
    output::write(path, force, |writer| {
        PngEncoder::new(writer)
            .write_image(bytes, columns, rows, colour)
            .map_err(std::io::Error::other)
    })
}

/// A decoded picture, and what its decoded form does not tell any more.
struct Stored {
    image: DynamicImage,
    palette: bool,
    lossy: bool,
}

impl Stored {
    /// The mask that it is, if it is one. A colour picture that is all black or all white may be
    /// either and counts as a mask only where one is `expected`.
    fn as_mask(&self, expected: bool) -> Option<Mask> {
        let (width, height) = (self.image.width() as usize, self.image.height() as usize);
        let grey = !self.image.color().has_color();
        if self.lossy
            && let Some(data) = lossy::black_and_white(&self.image)
        {
            return Some(Mask { width, height, data });
        }
        let data = match &self.image {
            DynamicImage::ImageLuma8(image) => {
                two_values(image.as_raw().iter().copied(), |v| grey_rank(v, 255))
            }
            DynamicImage::ImageLuma16(image) => {
                two_values(image.as_raw().iter().copied(), |v| grey_rank(v, 65535))
            }
            DynamicImage::ImageLumaA8(image) => {
                two_values(image.pixels().map(|p| if p.0[1] == 0 { 0 } else { p.0[0] }), |v| {
                    grey_rank(v, 255)
                })
            }
            DynamicImage::ImageLumaA16(image) => {
                two_values(image.pixels().map(|p| if p.0[1] == 0 { 0 } else { p.0[0] }), |v| {
                    grey_rank(v, 65535)
                })
            }
            DynamicImage::ImageRgb8(image) => {
                two_values(image.pixels().map(|p| p.0), |v| self.colour_rank(v, 255))
            }
            DynamicImage::ImageRgba8(image) => {
                two_values(image.pixels().map(|p| over_black(p.0)), |v| self.colour_rank(v, 255))
            }
            DynamicImage::ImageRgb16(image) => {
                two_values(image.pixels().map(|p| p.0), |v| self.colour_rank(v, 65535))
            }
            DynamicImage::ImageRgba16(image) => {
                two_values(image.pixels().map(|p| over_black(p.0)), |v| self.colour_rank(v, 65535))
            }
            _ => None,
        }?;
        let uniform = data.windows(2).all(|pair| pair[0] == pair[1]);
        if uniform && !grey && !self.palette && !expected {
            return None;
        }
        Some(Mask { width, height, data })
    }

    /// The rank of a colour in a mask.
    fn colour_rank<T: Into<u32>>(&self, colour: [T; 3], white: u32) -> Rank {
        let colour: [u32; 3] = colour.map(Into::into);
        let pure = colour == [0; 3] || colour == [white; 3];
        Rank { brightness: colour.iter().sum(), in_pair: pure || self.palette, alone: pure }
    }

    /// Which pixels are transparent (alpha 0); `None` where none is.
    fn gaps(&self) -> Option<Vec<bool>> {
        let gaps: Vec<bool> = match &self.image {
            DynamicImage::ImageRgba8(image) => image.pixels().map(|p| p.0[3] == 0).collect(),
            DynamicImage::ImageLumaA8(image) => image.pixels().map(|p| p.0[1] == 0).collect(),
            DynamicImage::ImageRgba16(image) => image.pixels().map(|p| p.0[3] == 0).collect(),
            DynamicImage::ImageLumaA16(image) => image.pixels().map(|p| p.0[1] == 0).collect(),
            _ => return None,
        };
        gaps.contains(&true).then_some(gaps)
    }

    fn into_rgb(self) -> RgbImage {
        let mut image = self.image;
        if let DynamicImage::ImageRgb8(rgb) = image {
            return rgb;
        }
        if let DynamicImage::ImageRgba16(_) | DynamicImage::ImageRgba8(_) = image {
            let mut rgba = image.into_rgba8();
            for pixel in rgba.pixels_mut().filter(|pixel| pixel.0[3] == 0) {
                pixel.0 = [0; 4];
            }
            image = rgba.into();
        } else if let DynamicImage::ImageLumaA8(_) | DynamicImage::ImageLumaA16(_) = image {
            let mut grey = image.into_luma_alpha8();
            for pixel in grey.pixels_mut().filter(|pixel| pixel.0[1] == 0) {
                pixel.0 = [0; 2];
            }
            image = grey.into();
        }
        image.into_rgb8()
    }
}

/// What a value says about a picture's being a mask.
struct Rank {
    /// Of two values the brighter is plant.
    brightness: u32,
    /// Whether it may be one of two values of a mask.
    in_pair: bool,
    /// Whether it may be the only value of a mask.
    alone: bool,
}

/// Any grey may be one of two values; alone it must be black, white or 1.
fn grey_rank<T: Into<u32>>(value: T, white: u32) -> Rank {
    let brightness = value.into();
    let alone = brightness <= 1 || brightness == white;
    Rank { brightness, in_pair: true, alone }
}

fn over_black<T: Copy + Default + PartialEq>([r, g, b, alpha]: [T; 4]) -> [T; 3] {
    if alpha == T::default() { [alpha; 3] } else { [r, g, b] }
}

/// 0 and 1 for the darker and brighter of at most two values; `None` where there are more, or
/// where their rank is not that of a mask.
fn two_values<T: Copy + PartialEq>(
    values: impl Iterator<Item = T> + Clone,
    rank: impl Fn(T) -> Rank,
) -> Option<Vec<u8>> {
    let first = values.clone().next()?;
    let Some(other) = values.clone().find(|&value| value != first) else {
        let rank = rank(first);
        let plant = u8::from(rank.brightness > 0);
        return rank.alone.then(|| values.map(|_| plant).collect());
    };
    if values.clone().any(|value| value != first && value != other) {
        return None;
    }
    let ranks = (rank(first), rank(other));
    if !ranks.0.in_pair || !ranks.1.in_pair || ranks.0.brightness == ranks.1.brightness {
        return None;
    }
    let plant = if ranks.0.brightness > ranks.1.brightness { first } else { other };
    Some(values.map(|value| u8::from(value == plant)).collect())
}

/// Largest number of pixels of one picture; an orthomosaic beyond it comes in tiles.
const MAX_PIXELS: u64 = 1 << 31;

/// Columns and rows of a picture, from its header.
///
/// # Errors
/// A file that cannot be read, or is no PNG, JPEG or TIFF picture.
pub fn size_px(path: &Path) -> Result<[u32; 2], FileError> {
    let failed = |error| FileError::read(path, error);
    let reader = image::ImageReader::open(path).map_err(failed)?.with_guessed_format();
    match reader.map_err(failed)?.into_dimensions() {
        Ok((width, height)) => Ok([width, height]),
        Err(image::ImageError::IoError(error)) => Err(failed(error)),
        Err(error) => Err(FileError::malformed(path, None, damaged("picture", error))),
    }
}

fn decode(path: &Path) -> Result<Stored, FileError> {
    let bytes = memory::read_file(path)?;
    decode_bytes(&bytes).map_err(|message| FileError::malformed(path, None, message))
}

fn decode_bytes(bytes: &[u8]) -> Result<Stored, String> {
    if bytes.is_empty() {
        return Err("the file is empty, expected a PNG, JPEG or TIFF picture".to_owned());
    }
    let stored = match image::guess_format(bytes) {
        Ok(ImageFormat::Png) => {
            let decoder = PngDecoder::new(Cursor::new(bytes)).map_err(|e| damaged("PNG", e))?;
            // The colour type stands at a fixed place in the header; 3 is a palette.
            let palette = bytes.get(25) == Some(&3);
            // A bit per pixel, and at best 1032 bytes out of one by deflate.
            Stored { image: by(decoder, "PNG", bytes.len(), 8 * 1032)?, palette, lossy: false }
        }
        Ok(ImageFormat::Tiff) => {
            let decoder = TiffDecoder::new(Cursor::new(bytes)).map_err(|e| damaged("TIFF", e))?;
            // Fax codes take one bit for a blank line.
            Stored {
                image: by(decoder, "TIFF", bytes.len(), 1 << 17)?,
                palette: false,
                lossy: false,
            }
        }
        Ok(ImageFormat::Jpeg) => {
            Stored { image: jpeg::decode(bytes)?, palette: false, lossy: true }
        }
        // Whatever the name says: pictures saved from web pages often are WebP under another name.
        Ok(
            other @ (ImageFormat::WebP | ImageFormat::Gif | ImageFormat::Bmp | ImageFormat::Avif),
        ) => {
            let kind = match other {
                ImageFormat::WebP => "WebP",
                ImageFormat::Gif => "GIF",
                ImageFormat::Bmp => "BMP",
                _ => "AVIF",
            };
            return Err(format!(
                "it is a {kind} picture whatever its name says, expected PNG, JPEG or TIFF: convert it first"
            ));
        }
        _ => return Err("expected a PNG, JPEG or TIFF picture".to_owned()),
    };
    if stored.image.width() == 0 || stored.image.height() == 0 {
        return Err("the picture has no pixel".to_owned());
    }
    Ok(stored)
}

fn damaged(format: &str, error: impl std::fmt::Display) -> String {
    format!("damaged or unsupported {format}: {error}")
}

/// Refuses sizes that the file cannot hold (`most` pixels in one byte), before memory is asked for.
fn check_size(width: u64, height: u64, length: usize, most: u64) -> Result<(), String> {
    let pixels = width.saturating_mul(height);
    if pixels > MAX_PIXELS {
        return Err(format!(
            "{width} x {height} pixels are more than {MAX_PIXELS}; cut the picture into tiles"
        ));
    }
    if pixels > 1 << 24 && pixels / most > length as u64 {
        return Err(format!(
            "damaged: the header says {width} x {height} pixels, too many for {length} bytes"
        ));
    }
    Ok(())
}

/// Refuses pictures that do not fit into memory: as decoded, and the mask and the colours that are made of them.
fn check_memory(decoded_bytes: u64, width: u64, height: u64) -> Result<(), String> {
    let pixels = width.saturating_mul(height);
    let what = format!("decoding {width} x {height} pixels");
    memory::check(&what, decoded_bytes.saturating_add(pixels.saturating_mul(4)))
}

fn by(
    mut decoder: impl ImageDecoder,
    format: &str,
    length: usize,
    most: u64,
) -> Result<DynamicImage, String> {
    let (width, height) = decoder.dimensions();
    check_size(width.into(), height.into(), length, most)?;
    check_memory(decoder.total_bytes(), width.into(), height.into())?;
    let colour = decoder.color_type();
    if colour.bytes_per_pixel() / colour.channel_count() > 2 {
        return Err(format!("unsupported {format}: {colour:?}, expected 8 or 16 bits per channel"));
    }
    // Room for the picture and a working copy, but not for whatever a damaged tag asks for.
    let mut limits = Limits::no_limits();
    limits.max_alloc = Some(2 * decoder.total_bytes() + length as u64 + (1 << 26));
    decoder.set_limits(limits).map_err(|e| damaged(format, e))?;
    DynamicImage::from_decoder(decoder).map_err(|e| damaged(format, e))
}

#[cfg(test)]
mod tests;
