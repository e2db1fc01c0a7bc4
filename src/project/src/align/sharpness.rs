//! What the photos themselves say of their quality: blur and exposure, against the other photos of the flight.

use rowgram_base::monitor::Diagnostic;
use rowgram_optim::robust::median;

/// What is known of one photo.
pub(super) struct Quality<'a> {
    /// Its name.
    pub(super) name: &'a str,
    /// Width and height.
    pub(super) size_px: [u32; 2],
    /// Median size (sigma) of its features; `None` where there are too few.
    pub(super) feature_sigma_px: Option<f32>,
    /// Share of its pixels that are black, and share that are white.
    pub(super) clipped: [f32; 2],
}

/// Features that are so many times as large as those of most photos of the size: what blur leaves.
/// Of the 123 photos of five real flights one is above (1.7), which the camera moved in (`rowgram align --until features`).
const BLURRED_RATIO: f32 = 1.6;
/// Fewer photos of a size do not say what is usual.
const LEAST_PHOTOS: usize = 4;
/// A photo with a larger share of black or white pixels has lost what it could have shown there.
const CLIPPED_SHARE: f32 = 0.5;

/// Names photos that are blurred, too dark or too bright.
pub(super) fn judge(photos: &[Quality<'_>]) -> Vec<Diagnostic> {
    let mut found = Vec::new();
    for photo in photos {
        let [black, white] = photo.clipped;
        for (share, word) in [(black, "black"), (white, "white")] {
            if share > CLIPPED_SHARE {
                let message = format!("{:.0} % of it is {word}: wrongly exposed", 100.0 * share);
                found.push(Diagnostic::warning("photo-exposure", photo.name, message));
            }
        }
        let alike = photos.iter().filter(|other| other.size_px == photo.size_px);
        let sizes: Vec<f32> = alike.filter_map(|other| other.feature_sigma_px).collect();
        let Some(sigma_px) = photo.feature_sigma_px else { continue };
        if sizes.len() < LEAST_PHOTOS {
            continue;
        }
        let ratio = sigma_px / median(sizes).unwrap_or(0.0);
        if ratio > BLURRED_RATIO {
            let message = format!(
                "it seems blurred: what it shows is {ratio:.1} times as coarse as in the other photos"
            );
            found.push(Diagnostic::warning("photo-blurred", photo.name, message).with_remedy(
                "look at it, and take it out of the folder if others show the same ground",
            ));
        }
    }
    found
}
