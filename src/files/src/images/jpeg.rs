//! JPEG files: decoded strictly, so that what is damaged is refused and not filled with grey.

use super::{check_memory, check_size, damaged};
use image::{DynamicImage, GrayImage, RgbImage};
use zune_jpeg::zune_core::{bytestream::ZCursor, colorspace::ColorSpace, options::DecoderOptions};

/// Decodes a JPEG to 8-bit grey or RGB; other colours (CMYK, YCCK) are converted.
pub(super) fn decode(bytes: &[u8]) -> Result<DynamicImage, String> {
    let failed = |error| damaged("JPEG", error);
    // Some cameras pad between the headers, which the strict mode minds; it is for the data.
    let options = DecoderOptions::default()
        .set_strict_mode(false)
        .set_max_width(usize::MAX)
        .set_max_height(usize::MAX);
    let mut decoder = zune_jpeg::JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(failed)?;
    let (width, height) = decoder.dimensions().ok_or("damaged JPEG: it has no size")?;
    // At least one bit for every 8 x 8 block.
    check_size(width as u64, height as u64, bytes.len(), 1024)?;
    check_memory(3 * width as u64 * height as u64, width as u64, height as u64)?;
    let grey = decoder.input_colorspace() == Some(ColorSpace::Luma);
    let colour = if grey { ColorSpace::Luma } else { ColorSpace::RGB };
    decoder.set_options(options.set_strict_mode(true).jpeg_set_out_colorspace(colour));
    let data = decoder.decode().map_err(failed)?;
    if !jpeg_is_whole(bytes) {
        return Err("damaged JPEG: it ends before its end marker".to_owned());
    }
    let (width, height) = (width as u32, height as u32);
    let image = if grey {
        GrayImage::from_raw(width, height, data).map(DynamicImage::from)
    } else {
        RgbImage::from_raw(width, height, data).map(DynamicImage::from)
    };
    image.ok_or_else(|| "damaged JPEG: it has fewer pixels than its header says".to_owned())
}

/// Where the scan of a JPEG begins; `None` without one. The headers may hold a thumbnail with markers of its own and are
/// stepped over.
pub(crate) fn scan(bytes: &[u8]) -> Option<usize> {
    let mut at = 2;
    while let Some(&[marker, kind, high, low]) = bytes.get(at..).and_then(|b| b.first_chunk::<4>())
    {
        match (marker, kind) {
            (0xFF, 0xDA) => return Some(at),
            (0xFF, 0..=0xFE) => at += 2 + usize::from(u16::from_be_bytes([high, low])),
            _ => at += 1,
        }
    }
    None
}

/// Whether an end marker (FF D9) follows the first scan.
fn jpeg_is_whole(bytes: &[u8]) -> bool {
    scan(bytes).is_some_and(|at| bytes[at..].windows(2).any(|pair| pair == [0xFF, 0xD9]))
}
