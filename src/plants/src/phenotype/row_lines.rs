//! Row lines at a known heading, from all leaf pixels.
//!
//! The profile across the heading, the share of leaf by position, peaks on the rows; the lag at which its autocorrelation peaks is
//! the distance between them. Pixels belong to the nearest peak. No list of them is made: they are looked at four times, part by part.

use super::{
    leaf_pixels::{map_parts, visit},
    periodicity::{blur, period, two_rows},
    rows::{Row, nearest},
};
use crate::problems::plants::lines::Axes;
use rowgram_raster::Mask;

/// One of so many pixels of a row is left out at either end: weeds and noise beyond it. Not searched for.
const ENDS: usize = 500;
/// Bins of positions along the rows, by which the ends are looked for. Any number gives the same ends; more of them take more memory,
/// fewer leave more pixels to be sorted.
const BINS: usize = 256;

/// Row lines at a heading, by position across, and the distance between them.
pub(super) fn lines(mask: &Mask, axes: &Axes) -> (Vec<Row>, Option<f64>) {
    let extents = map_parts(|part| {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        visit(mask, part, |at| {
            for (k, at) in axes.aligned(at).into_iter().enumerate() {
                low[k] = low[k].min(at);
                high[k] = high[k].max(at);
            }
        });
        (low, high)
    });
    let [along, across] = [0, 1].map(|k| {
        let low = extents.iter().map(|(low, _)| low[k]).fold(f64::INFINITY, f64::min);
        let high = extents.iter().map(|(_, high)| high[k]).fold(f64::NEG_INFINITY, f64::max);
        [low, high]
    });
    let first = across[0].floor();
    let mut profile = vec![0.0; (across[1] - first) as usize + 1];
    let counts = map_parts(|part| {
        let mut counts = vec![0_u32; profile.len()];
        visit(mask, part, |at| counts[(axes.aligned(at)[1] - first) as usize] += 1);
        counts
    });
    for counts in counts {
        profile.iter_mut().zip(counts).for_each(|(sum, count)| *sum += f64::from(count));
    }
    let period = period(&profile).or_else(|| two_rows(&profile));
    let peaks = Peaks {
        first: first + 0.5,
        at: peaks(&profile, period),
        band: period.map_or(profile.len() as f64, |period| period / 2.0),
    };
    let rows = peaks.rows(mask, axes, along);
    let gaps: Vec<f64> = rows.windows(2).map(|w| w[1].across_px - w[0].across_px).collect();
    let spacing = period.filter(|_| rows.len() > 1).map(|period| refine(&gaps, period));
    (rows, spacing)
}

/// The peaks of the profile, by position.
fn peaks(profile: &[f64], period: Option<f64>) -> Vec<usize> {
    let smooth_px = period.map_or(profile.len() as f64 / 8.0, |period| period / 7.0);
    let smooth = blur(profile, smooth_px);
    let apart = period.map_or(profile.len() as f64, |period| 0.6 * period);
    let highest = smooth.iter().copied().fold(0.0, f64::max);
    let mut peaks: Vec<usize> = (0..smooth.len())
        .filter(|&k| {
            let left = k.checked_sub(1).map_or(0.0, |j| smooth[j]);
            let right = smooth.get(k + 1).copied().unwrap_or(0.0);
            smooth[k] > left && smooth[k] >= right && smooth[k] >= 0.35 * highest
        })
        .collect();
    // The higher of two that are too close stays.
    peaks.sort_by(|&a, &b| smooth[b].total_cmp(&smooth[a]).then(a.cmp(&b)));
    let mut kept: Vec<usize> = Vec::new();
    for peak in peaks {
        if kept.iter().all(|&k| k.abs_diff(peak) as f64 > apart) {
            kept.push(peak);
        }
    }
    kept.sort_unstable();
    kept
}

/// Peaks of the profile, to which pixels belong.
struct Peaks {
    /// Position across of the middle of the profile's first bin.
    first: f64,
    /// Their bins.
    at: Vec<usize>,
    /// Distance up to which a pixel belongs to the nearest.
    band: f64,
}

/// The pixels of a row.
#[derive(Clone)]
struct Tally {
    pixels: usize,
    across: f64,
    /// Their number by position along the row.
    along: [u32; BINS],
}

impl Peaks {
    fn nearest(&self, across: f64) -> Option<usize> {
        let strip = across - self.first;
        let found = nearest(&self.at, |&k| k as f64, strip);
        found.filter(|(_, distance)| *distance <= self.band).map(|(row, _)| row)
    }

    /// The rows on the peaks, of those that have pixels.
    fn rows(&self, mask: &Mask, axes: &Axes, [low, high]: [f64; 2]) -> Vec<Row> {
        let width = (high - low).max(1.0) / BINS as f64;
        let bin = |along: f64| (((along - low) / width) as usize).min(BINS - 1);
        let none = Tally { pixels: 0, across: 0.0, along: [0; BINS] };
        let of_parts = map_parts(|part| {
            let mut tallies = vec![none.clone(); self.at.len()];
            visit(mask, part, |at| {
                let [along, across] = axes.aligned(at);
                if let Some(row) = self.nearest(across) {
                    tallies[row].pixels += 1;
                    tallies[row].across += across;
                    tallies[row].along[bin(along)] += 1;
                }
            });
            tallies
        });
        let mut tallies = vec![none.clone(); self.at.len()];
        for of_part in of_parts {
            for (sum, of_part) in tallies.iter_mut().zip(of_part) {
                sum.pixels += of_part.pixels;
                sum.across += of_part.across;
                sum.along.iter_mut().zip(of_part.along).for_each(|(sum, count)| *sum += count);
            }
        }
        // The bins of both ends, and how many pixels lie beyond them.
        let ends: Vec<[(usize, usize); 2]> = tallies.iter().map(Tally::ends).collect();
        let in_bins = map_parts(|part| {
            let mut places = vec![[Vec::new(), Vec::new()]; self.at.len()];
            visit(mask, part, |at| {
                let [along, across] = axes.aligned(at);
                let Some(row) = self.nearest(across) else { return };
                for (places, end) in places[row].iter_mut().zip(ends[row]) {
                    if bin(along) == end.0 {
                        places.push(along);
                    }
                }
            });
            places
        });
        let filled = tallies.iter().enumerate().filter(|(_, tally)| tally.pixels > 0);
        filled
            .map(|(row, tally)| {
                let end = |k: usize| {
                    let places = in_bins.iter().flat_map(|of_part| &of_part[row][k]);
                    let mut places: Vec<f64> = places.copied().collect();
                    places.sort_by(f64::total_cmp);
                    let beyond = tally.pixels / ENDS - ends[row][k].1;
                    places[if k == 0 { beyond } else { places.len() - 1 - beyond }]
                };
                Row {
                    across_px: tally.across / tally.pixels as f64,
                    start_px: end(0) - 0.5,
                    end_px: end(1) + 0.5,
                    pixels: tally.pixels,
                }
            })
            .collect()
    }
}

impl Tally {
    /// The bins in which the row begins and ends, and how many of its pixels lie beyond each.
    fn ends(&self) -> [(usize, usize); 2] {
        let cut = self.pixels / ENDS;
        [false, true].map(|from_top| {
            let mut beyond = 0;
            for k in 0..BINS {
                let bin = if from_top { BINS - 1 - k } else { k };
                let count = self.along[bin] as usize;
                if beyond + count > cut {
                    return (bin, beyond);
                }
                beyond += count;
            }
            (0, beyond)
        })
    }
}

/// The distance between rows that explains the gaps, each a whole number of them.
fn refine(gaps: &[f64], period: f64) -> f64 {
    let steps = |gap: &f64| (gap / period).round().max(1.0);
    let total: f64 = gaps.iter().sum();
    total / gaps.iter().map(steps).sum::<f64>()
}
