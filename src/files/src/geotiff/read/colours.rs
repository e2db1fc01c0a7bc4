//! The samples of a raster as 8-bit colours.

use super::{super::bands::ToldBy, BLACK_IS_ZERO, RGB, Reader};
use image::RgbImage;
use rowgram_optim::output::FileError;
use rowgram_raster::{
    spectral::{Band, listed},
    window::Window,
};
use tiff_reader::TiffSample;

/// Windows along each axis, and their side, in which the range of the samples is looked at.
const LOOKS: usize = 8;
const LOOK_PX: usize = 64;
/// Full brightness of 16 bits, and the share of it that colours in full range reach: those of cameras do, reflectance times
/// 10,000 (at most .6 of leaves and soil in the visible) and 12 bits do not.
const FULL_16: f64 = 65_535.0;
const FULL_RANGE: f64 = 0.25;

impl Reader {
    /// How its samples become colours, where that is not by their order and in full range: for people.
    ///
    /// # Errors
    /// Where it is not known which bands are colours, or the file is damaged.
    pub fn colour_notes(&self) -> Result<Vec<String>, FileError> {
        let colours = self.colours()?;
        let mut notes = Vec::new();
        let roles = &self.bands.roles;
        let more = self.bands() - usize::from(self.bands.alpha.is_some());
        let is_stored = self.bands.is_colour && matches!(self.photometric, BLACK_IS_ZERO | RGB);
        let is_known = roles.iter().all(|band| !matches!(band, None | Some(Band::Other)));
        let how = match self.bands.told_by {
            ToldBy::Order => "by their order, for they have no names",
            ToldBy::Names => "by their names",
            ToldBy::Settings => "by [project] bands",
        };
        if is_stored && (more > 3 || colours != [0, 1, 2]) {
            let unused = if is_known { "" } else { "; others are used in formulas by number only" };
            notes.push(format!("its bands are, {how}: {}{unused}", listed(roles)));
        }
        if is_stored && more > 3 {
            notes.push(self.reflectance_note()?);
        }
        if !u8::matches_layout(&self.layout) {
            let full = self.full()?;
            if full != FULL_16 {
                notes.push(format!(
                    "{} samples: {full} is taken for full brightness",
                    self.sample_name()
                ));
            }
        }
        Ok(notes)
    }

    fn colours(&self) -> Result<[usize; 3], FileError> {
        self.bands.colours.clone().map_err(|why| self.malformed(why))
    }

    /// The sample value of full brightness.
    fn full(&self) -> Result<f64, FileError> {
        match self.photometric {
            _ if u8::matches_layout(&self.layout) => return Ok(255.0),
            BLACK_IS_ZERO | RGB => {}
            _ => return Ok(FULL_16),
        }
        if let Some(&full) = self.full.get() {
            return Ok(full);
        }
        let high = self.brightest(&self.colours()?)?;
        let is_float = f32::matches_layout(&self.layout) || f64::matches_layout(&self.layout);
        let full = match high {
            high if u16::matches_layout(&self.layout) && high >= FULL_RANGE * FULL_16 => FULL_16,
            // Bytes that a program has written as another type; reflectances are at most 1 or 100.
            high if high <= 255.0 && (!is_float || high >= 150.0) => 255.0,
            high => high,
        };
        Ok(*self.full.get_or_init(|| full))
    }

    /// What its bands show, where that is known and they hold anything: programs write empty bands, too.
    ///
    /// # Errors
    /// Where the file is damaged.
    pub fn filled_roles(&self) -> Result<Vec<Option<Band>>, FileError> {
        let of_band = |(place, role): (usize, &Option<Band>)| match role {
            Some(Band::RedEdge | Band::Nir) if self.looks(&[place])?.is_empty() => Ok(None),
            role => Ok(*role),
        };
        self.bands.roles.iter().enumerate().map(of_band).collect()
    }

    /// The value that all but the brightest thousandth of the samples of some bands do not exceed; that may be glare.
    pub(super) fn brightest(&self, bands: &[usize]) -> Result<f64, FileError> {
        let mut seen = self.looks(bands)?;
        let place = seen.len().saturating_sub(1) * 999 / 1000;
        Ok(match seen.is_empty() {
            true => 1.0,
            false => f64::from(*seen.select_nth_unstable_by(place, f32::total_cmp).1),
        })
    }

    /// Samples of some bands that are greater than 0, here and there over the raster.
    fn looks(&self, bands: &[usize]) -> Result<Vec<f32>, FileError> {
        let (columns, rows) = (self.width(), self.height());
        let mut seen: Vec<f32> = Vec::new();
        for look in 0..LOOKS * LOOKS {
            let at = |k: usize, size: usize| k * size.saturating_sub(LOOK_PX) / (LOOKS - 1);
            let (u, v) = (at(look % LOOKS, columns), at(look / LOOKS, rows));
            let window = Window { u, v, width: LOOK_PX.min(columns), height: LOOK_PX.min(rows) };
            for pixel in self.values(self.directory, window)?.chunks_exact(self.bands()) {
                let is_shown = self.bands.alpha.is_none_or(|band| pixel[band] != 0.0);
                let values = bands.iter().map(|&band| pixel[band]);
                seen.extend(values.filter(|x| is_shown && x.is_finite() && *x > 0.0));
            }
        }
        Ok(seen)
    }

    pub(super) fn rgb_and_gaps(
        &self,
        directory: usize,
        mask: Option<usize>,
        window: Window,
    ) -> Result<(RgbImage, Option<Vec<bool>>), FileError> {
        self.require(window)?;
        let Window { width, height, .. } = window;
        let mut gaps = Vec::with_capacity(window.pixels());
        let stored = matches!(self.photometric, BLACK_IS_ZERO | RGB);
        let mut rgb = Vec::with_capacity(3 * window.pixels());
        if u8::matches_layout(&self.layout) {
            let samples = self.window::<u8>(directory, window, stored)?;
            self.add_rgb(&samples, window, |x| x, (&mut rgb, &mut gaps))?;
        } else if u16::matches_layout(&self.layout) {
            let samples = self.window::<u16>(directory, window, stored)?;
            let full = self.full()?;
            let byte = |x: u16| (f64::from(x) * 255.0 / full).round() as u8;
            self.add_rgb(&samples, window, byte, (&mut rgb, &mut gaps))?;
        } else if self.is_colour() {
            let samples = self.values(directory, window)?;
            let full = self.full()?;
            let byte = |x: f32| (f64::from(x) * 255.0 / full).round() as u8;
            self.add_rgb(&samples, window, byte, (&mut rgb, &mut gaps))?;
        } else {
            return Err(self.malformed(format!(
                "its pixels are single values of {} (a vegetation index, heights), expected a photo in colours",
                self.sample_name()
            )));
        }
        if let Some(mask) = mask {
            let seen = self.window::<u8>(mask, window, false)?;
            for ((gap, pixel), seen) in gaps.iter_mut().zip(rgb.chunks_exact_mut(3)).zip(seen) {
                if seen == 0 {
                    *gap = true;
                    pixel.fill(0);
                }
            }
        }
        let rgb = RgbImage::from_raw(width as u32, height as u32, rgb).ok_or_else(|| {
            self.malformed("damaged: it has fewer pixels than it says".to_owned())
        })?;
        Ok((rgb, gaps.contains(&true).then_some(gaps)))
    }

    fn add_rgb<T: Copy + Into<f64>>(
        &self,
        samples: &[T],
        window: Window,
        byte: impl Fn(T) -> u8,
        (rgb, gaps): (&mut Vec<u8>, &mut Vec<bool>),
    ) -> Result<(), FileError> {
        let bands = (samples.len() / window.pixels().max(1)).max(1);
        let colours = self.colours()?.map(|band| band.min(bands - 1));
        let alpha = match self.bands.alpha {
            Some(band) => Some(band),
            // Colours that were decoded (a palette, YCbCr) have alpha behind them, where they have one.
            None if self.photometric > RGB && matches!(bands, 2 | 4) => Some(bands - 1),
            None => None,
        };
        let nodata = self.nodata;
        for pixel in samples.chunks_exact(bands) {
            let values = colours.map(|band| pixel[band].into());
            let empty = alpha.is_some_and(|band| pixel[band].into() == 0.0)
                || nodata.is_some_and(|nodata| values.iter().all(|&x| x == nodata))
                || values.iter().all(|x| x.is_nan());
            gaps.push(empty);
            if empty {
                rgb.extend([0; 3]);
            } else {
                rgb.extend(colours.map(|band| byte(pixel[band])));
            }
        }
        Ok(())
    }
}
