//! Image measurements that are meant otherwise than as column and row in pixels: found by the block's own geometry, which
//! needs no coordinates on the ground.

use super::{
    block::Block,
    georeference::Known,
    triangulate::{TriangulationOptions, error_px, triangulate},
};

/// Marks that the block contradicts, by the distances from where the others of their point put them.
#[derive(Debug, Clone, PartialEq)]
pub struct WrongMark {
    /// Index of the image.
    pub image: u32,
    /// Index of the ground point.
    pub ground: u32,
    /// Distance, pixels; infinite where no two marks of the point agree.
    pub error_px: f64,
}

/// What the two numbers of marks are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum MarkReading {
    /// Column and row, pixels, from the centre of the top-left one.
    Pixels,
    /// The same in images so many times smaller than the photos.
    Resized(f64),
    /// Row and column.
    Exchanged,
    /// Column, and row counted from the bottom.
    FromBottom,
    /// Row counted from the bottom, and column.
    ExchangedFromBottom,
    /// Shares of the width and the height.
    Shares,
    /// Shares, the second counted from the bottom.
    SharesFromBottom,
    /// From the middle of the image, in the longer side of it.
    FromMiddle,
}

impl MarkReading {
    /// Those that are tried besides pixels and other sizes.
    const OTHERS: [MarkReading; 6] = [
        MarkReading::Exchanged,
        MarkReading::FromBottom,
        MarkReading::ExchangedFromBottom,
        MarkReading::Shares,
        MarkReading::SharesFromBottom,
        MarkReading::FromMiddle,
    ];

    /// Column and row of a mark in an image of this size, pixels.
    pub fn px(self, [a, b]: [f64; 2], size_px: [u32; 2]) -> [f64; 2] {
        let [width, height] = size_px.map(f64::from);
        let from_bottom = |v: f64| height - 1.0 - v;
        match self {
            MarkReading::Pixels => [a, b],
            MarkReading::Resized(scale) => [a, b].map(|v| (v + 0.5) * scale - 0.5),
            MarkReading::Exchanged => [b, a],
            MarkReading::FromBottom => [a, from_bottom(b)],
            MarkReading::ExchangedFromBottom => [b, from_bottom(a)],
            MarkReading::Shares => [a * width - 0.5, b * height - 0.5],
            MarkReading::SharesFromBottom => [a * width - 0.5, from_bottom(b * height - 0.5)],
            MarkReading::FromMiddle => {
                let longer = width.max(height);
                [a * longer + 0.5 * (width - 1.0), b * longer + 0.5 * (height - 1.0)]
            }
        }
    }

    /// In words, where it is none of pixels.
    pub fn words(self) -> &'static str {
        match self {
            MarkReading::Pixels => "column and row in pixels",
            MarkReading::Resized(_) => "pixels of resized images",
            MarkReading::Exchanged => "row and column: u and v are exchanged",
            MarkReading::FromBottom => "counted from the bottom of the photos",
            MarkReading::ExchangedFromBottom => {
                "row and column, counted from the bottom of the photos: u and v are exchanged"
            }
            MarkReading::Shares => "shares of the width and height instead of pixels",
            MarkReading::SharesFromBottom => {
                "shares of the width and height, counted from the bottom, instead of pixels"
            }
            MarkReading::FromMiddle => {
                "counted from the middle of the photos, in their longer side"
            }
        }
    }
}

/// How many marks of a block fit and which do not, read in one way.
fn marks_that_fit(
    block: &Block<'_>,
    known: &Known,
    reading: MarkReading,
    demands: &TriangulationOptions,
) -> (usize, Vec<WrongMark>) {
    let (mut fitting, mut wrong) = (0, Vec::new());
    for ground in 0..known.ground.len() {
        let mut marks = Vec::new();
        let mut views = Vec::new();
        for mark in known.marks.iter().filter(|mark| mark.ground as usize == ground) {
            let lens = block.lens(mark.image as usize);
            let image_px = reading.px(mark.image_px, lens.size_px());
            if let Some(view) = block.view(mark.image, image_px) {
                views.push(view);
                marks.push(*mark);
            }
        }
        if views.len() < 2 {
            continue;
        }
        match triangulate(&views, demands) {
            Some((point, fits)) => {
                for (k, fits) in fits.into_iter().enumerate() {
                    if fits {
                        fitting += 1;
                    } else {
                        let error_px = error_px(&views[k], point).unwrap_or(f64::INFINITY);
                        wrong.push(WrongMark {
                            image: marks[k].image,
                            ground: ground as u32,
                            error_px,
                        });
                    }
                }
            }
            None => wrong.extend(marks.iter().map(|mark| WrongMark {
                image: mark.image,
                ground: ground as u32,
                error_px: f64::INFINITY,
            })),
        }
    }
    (fitting, wrong)
}

/// What is wrong with the marks of a block.
#[derive(Debug, Clone, PartialEq)]
pub struct MarkReview {
    /// What their numbers are.
    pub reading: MarkReading,
    /// How many fit.
    pub fitting: usize,
    /// Those that do not; they were taken out, unless nothing of their point agrees.
    pub wrong: Vec<WrongMark>,
    /// Whether most marks contradict each other by more than a block may be bent, however they are read.
    pub is_contradiction: bool,
}

/// So many marks tell what is wrong with all.
const LEAST_TELLING: usize = 4;
/// A block with a lens that is not known yet leaves marks off by up to so many times what is demanded.
const BENT_TIMES: f64 = 5.0;

/// Looks through the marks by the block's own geometry: marks that are meant otherwise are brought to pixels of the photos,
/// wrong ones are taken out. `scales` are sizes of images, relative to the photos, that marks may be of; `others` whether
/// any other reading is tried.
pub fn review_marks(
    block: &Block<'_>,
    known: &mut Known,
    scales: &[f64],
    others: bool,
    demands: &TriangulationOptions,
) -> MarkReview {
    let mut reading = MarkReading::Pixels;
    let (mut fitting, mut wrong) = marks_that_fit(block, known, reading, demands);
    let resized = scales.iter().map(|scale| MarkReading::Resized(*scale));
    for other in resized.chain(MarkReading::OTHERS.into_iter().filter(|_| others)) {
        let (more, rest) = marks_that_fit(block, known, other, demands);
        // Some marks fit by chance: another reading must explain clearly more.
        if more > 2 * fitting && more >= LEAST_TELLING {
            (fitting, wrong, reading) = (more, rest, other);
        }
    }
    let bent = TriangulationOptions { tolerance_px: BENT_TIMES * demands.tolerance_px, ..*demands };
    let is_contradiction = 2 * fitting < fitting + wrong.len() && {
        let (fitting, wrong) = marks_that_fit(block, known, reading, &bent);
        fitting + wrong.len() >= LEAST_TELLING && fitting < wrong.len()
    };
    for mark in &mut known.marks {
        mark.image_px = reading.px(mark.image_px, block.lens(mark.image as usize).size_px());
    }
    let out: std::collections::BTreeSet<(u32, u32)> = wrong
        .iter()
        .filter(|mark| mark.error_px.is_finite())
        .map(|mark| (mark.image, mark.ground))
        .collect();
    known.marks.retain(|mark| !out.contains(&(mark.image, mark.ground)));
    MarkReview { reading, fitting, wrong, is_contradiction }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_reading_gives_the_pixel_back() {
        let (size, at) = ([1000, 750], [176.5, 497.5]);
        for (numbers, reading) in [
            ([497.5, 176.5], MarkReading::Exchanged),
            ([176.5, 251.5], MarkReading::FromBottom),
            ([251.5, 176.5], MarkReading::ExchangedFromBottom),
            ([0.177, 498.0 / 750.0], MarkReading::Shares),
            ([0.177, 252.0 / 750.0], MarkReading::SharesFromBottom),
            ([(176.5 - 499.5) / 1000.0, (497.5 - 374.5) / 1000.0], MarkReading::FromMiddle),
            ([88.0, 248.5], MarkReading::Resized(2.0)),
        ] {
            let found = reading.px(numbers, size);
            assert!((0..2).all(|k| (found[k] - at[k]).abs() < 1e-9), "{reading:?}: {found:?}");
        }
    }
}
