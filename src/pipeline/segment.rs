//! The leaf mask.

use crate::options::Auto;

crate::options! {
    /// The leaf mask: pixels of the orthomosaic that show leaves.
    pub struct SegmentOptions in "segment" {
        /// Thresholds of leaf pixels in 8-bit HSV: hue from, hue to (0 to 180), least saturation, least value (0 to 255), as
        /// 30,79,30,163 (the paper's, for June); auto proposes them from the picture.
        pub hsv: Auto<[u16; 4]> = Auto::Auto, limits between(0.0, 255.0);
        /// Connected leaf areas of fewer pixels are removed.
        pub min_pixels: usize = 0;
        /// Holes of at most this many pixels are filled, after the removal.
        pub fill_holes: usize = 0;
    }
}
