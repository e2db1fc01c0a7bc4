//! GeoTIFF files, by window: orthomosaics, masks, heights, labels.
//!
//! A raster of any size is read through [`Reader`], a window at a time, and written through
//! [`Writer`], tile by tile, so neither needs the whole of it in memory. Classic TIFF and BigTIFF, tiles
//! and strips, 8 to 32 bits, deflate, LZW, PackBits, JPEG, ZSTD and LERC are read; what is written is a
//! cloud optimised GeoTIFF: tiles of [`TILE`] pixels, deflate, overviews, all directories before the data.
//!
//! GeoTIFF counts pixels from their corners, everything else here from their centres; the half pixel
//! is added and taken away in this folder and nowhere else.
//!
//! Reference: OGC GeoTIFF standard 19-008r4; OGC Cloud Optimized GeoTIFF 21-026; the coding itself is that of the
//! crates `geotiff-reader` and `tiff-writer`.

mod bands;
mod directory;
mod overview;
mod place;
mod read;
mod square;
mod write;

pub(crate) use directory::geo_keys;
pub use place::beside;
pub(crate) use place::side_files;
pub use read::{Reader, Reading, Spectra};
pub(crate) use square::Square;
pub use write::{Colour, Layout, Writer, write};

/// Codes of the metre, the international foot and the foot of the US survey.
const METRE: u16 = 9001;
const FOOT: u16 = 9002;
const SURVEY_FOOT: u16 = 9003;

/// Side of the tiles that are written, pixels.
pub const TILE: usize = 512;

mod private {
    /// What the reader and the writer must know of a sample.
    pub trait Stored: tiff_writer::TiffWriteSample + tiff_reader::TiffSample {}
}

/// A kind of sample: `u8`, `u16`, `u32` or `f32`.
pub trait Sample:
    private::Stored + Copy + Default + PartialEq + Into<f64> + Send + Sync + 'static
{
    /// Its name for a person.
    const NAME: &'static str;
    /// Whether it has fractions.
    const IS_FLOAT: bool;

    /// The nearest one.
    fn from_f64(value: f64) -> Self;

    /// The samples as bytes, where that is what they are.
    fn as_bytes(_samples: &[Self]) -> Option<&[u8]> {
        None
    }

    /// The samples as bytes to write into, where that is what they are.
    fn as_bytes_mut(_samples: &mut [Self]) -> Option<&mut [u8]> {
        None
    }
}

macro_rules! samples {
    ($($type:ty = $name:literal, $is_float:literal, $round:expr $(, $bytes:item $bytes_mut:item)?;)+) => {
        $(impl private::Stored for $type {}
        impl Sample for $type {
            const NAME: &'static str = $name;
            const IS_FLOAT: bool = $is_float;

            fn from_f64(value: f64) -> Self {
                $round(value) as $type
            }

            $($bytes $bytes_mut)?
        })+
    };
}
samples!(
    u8 = "8-bit", false, f64::round,
        fn as_bytes(samples: &[u8]) -> Option<&[u8]> { Some(samples) }
        fn as_bytes_mut(samples: &mut [u8]) -> Option<&mut [u8]> { Some(samples) };
    u16 = "16-bit", false, f64::round;
    u32 = "32-bit", false, f64::round;
    f32 = "32-bit floating point", true, f64::from;
);

/// Whether a file begins like a TIFF or BigTIFF.
pub fn is_tiff(first_bytes: &[u8]) -> bool {
    matches!(first_bytes.get(..4), Some(b"II*\0" | b"MM\0*" | b"II+\0" | b"MM\0+"))
}

#[cfg(test)]
mod tests;
