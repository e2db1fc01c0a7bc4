//! The samples of a raster as reflectances.
//!
//! A sample `s` is the reflectance `scale s + offset`: by the tags of GDAL where the file has them, else `s / full`. What `full` is is told
//! by the kind of samples and by the brightest thousandth of them over all spectral bands: soil and leaves do not reflect more than arrives.
//!
//! | samples | brightest | full |
//! |---|---|---|
//! | 8 bits | any | 255 |
//! | 16 bits and more, whole | to 10,000; to 32,768; more | 10,000; 32,768; 65,535 |
//! | floating point | to 2; to 150; to 255; more as whole numbers | 1; 100; 255; as those |

use super::{BLACK_IS_ZERO, RGB, Reader};
use rowgram_optim::output::FileError;
use rowgram_raster::{spectral::Band, window::Window};
use tiff_reader::TiffSample;

/// Reflectances of a window: the samples of each pixel side by side, all bands of the raster, NaN without data; and which pixels
/// show nothing, where some do.
pub type Spectra = (Vec<f32>, Option<Vec<bool>>);

impl Reader {
    /// The reflectances of a window. What was decoded into colours has three bands, and 255 for full reflectance.
    ///
    /// # Errors
    /// As [`Reader::read_rgb_and_gaps`].
    pub fn read_spectra(&self, window: Window) -> Result<Spectra, FileError> {
        let (rgb, gaps) = self.read_rgb_and_gaps(window)?;
        if !matches!(self.photometric, BLACK_IS_ZERO | RGB) {
            let samples = rgb.as_raw().iter().map(|&x| f32::from(x) / 255.0);
            return Ok((samples.collect(), gaps));
        }
        let scales = self.scales()?;
        let mut samples = self.values(self.directory, window)?;
        for pixel in samples.chunks_exact_mut(scales.len()) {
            for (x, [scale, offset]) in pixel.iter_mut().zip(&scales) {
                *x = (f64::from(*x) * scale + offset) as f32;
            }
        }
        Ok((samples, gaps))
    }

    /// How samples become reflectances: for people.
    pub(super) fn reflectance_note(&self) -> Result<String, FileError> {
        let scales = self.scales()?;
        Ok(match (self.given_reflectance, &self.bands.scales) {
            (Some(full), _) => format!("[project] reflectance_scale: {full} is a reflectance of 1"),
            (None, Some(_)) => {
                let [scale, offset] = scales.first().copied().unwrap_or([1.0, 0.0]);
                format!("its tags say that a reflectance is {scale} times a sample and {offset}")
            }
            (None, None) => format!(
                "{} samples: {} is taken for a reflectance of 1 (else [project] reflectance_scale)",
                self.sample_name(),
                self.full_reflectance()?
            ),
        })
    }

    /// Scale and offset of every sample of a pixel.
    fn scales(&self) -> Result<Vec<[f64; 2]>, FileError> {
        match (self.given_reflectance, &self.bands.scales) {
            (None, Some(scales)) => Ok(scales.clone()),
            (given, _) => {
                let full = given.map_or_else(|| self.full_reflectance(), Ok)?;
                Ok(vec![[1.0 / full, 0.0]; self.bands()])
            }
        }
    }

    /// The sample value that is taken for a reflectance of 1.
    fn full_reflectance(&self) -> Result<f64, FileError> {
        if u8::matches_layout(&self.layout) {
            return Ok(255.0);
        }
        if let Some(&full) = self.reflectance.get() {
            return Ok(full);
        }
        let is_spectral =
            |band: &Option<Band>| band.is_some_and(|of| !matches!(of, Band::Alpha | Band::Other));
        let roles = self.bands.roles.iter().enumerate();
        let spectral: Vec<usize> =
            roles.filter(|(_, band)| is_spectral(band)).map(|(k, _)| k).collect();
        let high = self.brightest(&spectral)?;
        let is_float = f32::matches_layout(&self.layout) || f64::matches_layout(&self.layout);
        let full = match high {
            high if is_float && high <= 2.0 => 1.0,
            high if is_float && high <= 150.0 => 100.0,
            high if is_float && high <= 255.0 => 255.0,
            high if high <= 10_000.0 => 10_000.0,
            high if high <= 32_768.0 => 32_768.0,
            _ => 65_535.0,
        };
        Ok(*self.reflectance.get_or_init(|| full))
    }
}
