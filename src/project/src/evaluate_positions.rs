//! Found plants against true ones, both from files.

use rowgram_base::error::Error;
use rowgram_files::points;
use rowgram_plants::score::Score;
use std::path::Path;

/// Compares the positions of two CSV files, one to one, at radii in pixels. Columns are found by their names: `u_px,v_px`,
/// or `x,y`; a file without a header has two columns.
///
/// # Errors
/// Radii that are not positive; files that cannot be read.
pub fn evaluate_positions(found: &Path, truth: &Path, radii_px: &[f64]) -> Result<Score, Error> {
    // A radius that cannot be is refused before files are read.
    Score::new(&[], &[], radii_px)?;
    Score::new(&points::read(found)?, &points::read(truth)?, radii_px)
}
