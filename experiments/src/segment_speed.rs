//! The time of the leaf mask alone, for `scripts/segment_speed.py`.

use image::RgbImage;
use rowgram::{
    Error,
    io::{FileError, output},
    raster::mask::Thresholds,
};
use std::{path::Path, time::Instant};

/// Times the mask of raw RGB pixels, the best of two, in seconds on stdout; writes the mask.
#[expect(clippy::print_stdout, reason = "the time is the output")]
pub(crate) fn run(raw: &Path, width: u32, height: u32, mask: &Path) -> Result<(), Error> {
    let bytes = std::fs::read(raw).map_err(|error| FileError::read(raw, error))?;
    let photo = RgbImage::from_raw(width, height, bytes).ok_or_else(|| {
        FileError::malformed(raw, None, format!("expected {width} x {height} pixels"))
    })?;
    let mut best = f64::INFINITY;
    let mut found = Thresholds::default().mask(&photo);
    for _ in 0..2 {
        let start = Instant::now();
        found = Thresholds::default().mask(&photo);
        best = best.min(start.elapsed().as_secs_f64());
    }
    println!("{best}");
    output::write(mask, true, |out| out.write_all(&found.data))?;
    Ok(())
}
