//! Leaf segmentation of pictures of which every leaf is known, beside a watershed.
//!
//! Symmetric best Dice (SBD): the smaller of the mean best Dice of found leaves over true ones and of true over found ones
//! (Scharr et al., "Leaf segmentation in plant phenotyping", MVA 27, 2016).

use crate::watershed;
use rowgram::{
    io::{FileError, images},
    phenotype::leaves::{self, LeafOptions},
    raster::Mask,
};
use std::{collections::BTreeMap, path::Path};

pub(crate) enum Method {
    /// With markers at least so many usual widths apart.
    Watershed(f64),
    Slices(LeafOptions),
}

/// What one method did on one mask.
pub(crate) struct Run {
    pub(crate) sbd: f64,
    pub(crate) found: f64,
    pub(crate) truth: f64,
}

/// The labels of a picture in which every leaf has a colour, and the mask of all leaves.
pub(crate) fn classes(path: &Path) -> Result<(Vec<u32>, Mask), FileError> {
    let picture = match images::read(path)? {
        images::Picture::Photo(picture) => picture,
        images::Picture::Mask(mask) => mask.to_rgb(),
    };
    let mut classes: BTreeMap<[u8; 3], u32> = BTreeMap::from([([0; 3], 0)]);
    let labels: Vec<u32> = picture
        .pixels()
        .map(|pixel| {
            let next = classes.len() as u32;
            *classes.entry(pixel.0).or_insert(next)
        })
        .collect();
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    let mask = Mask { width, height, data: labels.iter().map(|&x| u8::from(x > 0)).collect() };
    Ok((labels, mask))
}

pub(crate) fn segment(mask: &Mask, how: &Method) -> Vec<u32> {
    match how {
        Method::Watershed(widths) => {
            let usual = leaves::find(mask, &LeafOptions::paper()).usual_width_px;
            watershed::labels(mask, (widths * usual).round().max(1.0) as usize)
        }
        Method::Slices(options) => {
            let mut labels = vec![0; mask.data.len()];
            for (leaf, label) in leaves::find(mask, options).leaves.iter().zip(1..) {
                for run in &leaf.runs {
                    labels[run.pixels(mask.width)].fill(label);
                }
            }
            labels
        }
    }
}

type Sizes = BTreeMap<u32, f64>;

/// Sizes of the labels of both, and of their intersections.
fn overlaps(found: &[u32], truth: &[u32]) -> (Sizes, Sizes, BTreeMap<(u32, u32), f64>) {
    let (mut a, mut b, mut both) = (Sizes::new(), Sizes::new(), BTreeMap::new());
    for (&f, &t) in found.iter().zip(truth) {
        if f > 0 {
            *a.entry(f).or_default() += 1.0;
        }
        if t > 0 {
            *b.entry(t).or_default() += 1.0;
        }
        if f > 0 && t > 0 {
            *both.entry((f, t)).or_default() += 1.0;
        }
    }
    (a, b, both)
}

pub(crate) fn judge(found: &[u32], truth: &[u32]) -> Run {
    let (a, b, both) = overlaps(found, truth);
    let (mut best_a, mut best_b) = (Sizes::new(), Sizes::new());
    for ((f, t), n) in both {
        let dice = 2.0 * n / (a[&f] + b[&t]);
        for (best, label) in [(&mut best_a, f), (&mut best_b, t)] {
            let best = best.entry(label).or_default();
            *best = best.max(dice);
        }
    }
    let mean = |best: &Sizes, all: &Sizes| best.values().sum::<f64>() / all.len().max(1) as f64;
    Run {
        sbd: mean(&best_a, &a).min(mean(&best_b, &b)),
        found: a.len() as f64,
        truth: b.len() as f64,
    }
}
