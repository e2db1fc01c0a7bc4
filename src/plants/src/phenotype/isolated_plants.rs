//! Isolated plants: in young crops each is a connected patch of leaf in bare soil, and patches tell the spacing.
//!
//! Along every row the leaf mass of a band is gathered, and what has soil on both sides is a patch. Plants that
//! touch make one patch of two, so that the middle distance is somewhat too long. Where too little of the rows is
//! bare, or patches are long against their distance, plants have grown together and patches tell nothing.
//!
//! Such plants are found by their leaf mass (`mass_stand`); where that is switched off, the distance of
//! patches is where the search for the spacing starts.

use super::rows::Rows;
use rowgram_optim::robust::median;
use rowgram_raster::Mask;

/// Share of the rows that must be bare: photos of young maize and seedlings have from 0.16 on, closed and young canopies of 20 cm less.
/// Chosen on half the training plots and clips, as all that is only used where plants stand apart.
const LEAST_BARE: f64 = 0.22;
/// The longest that the middle patch may be, in distances between patches.
const LONGEST: f64 = 0.65;
/// The fewest patches.
const LEAST: usize = 12;
/// A patch with less than this share of the middle one's mass is a weed or a speck.
const SPECK: f64 = 0.1;
/// Half the width of a row's band where there is only one row, as a share of its length.
const LONE: f64 = 0.1;

/// A run of leaf along a row: where it begins and ends, its mass, and the first moment of that.
#[derive(Debug, Clone, Copy)]
struct Patch {
    from: f64,
    to: f64,
    mass: f64,
    moment: f64,
}

impl Patch {
    fn middle(&self) -> f64 {
        self.moment / self.mass
    }
}

/// The middle of the distances between neighbouring patches of the same row, pixels; `None` where plants do
/// not stand apart.
pub fn spacing_px(mask: &Mask, rows: &Rows) -> Option<f64> {
    let profiles = profiles(mask, rows);
    let mut patches: Vec<Vec<Patch>> = profiles.iter().map(|profile| runs(profile)).collect();
    let length: f64 = profiles.iter().map(|profile| profile.len() as f64).sum();
    remove_small_patches(&mut patches);
    let covered: f64 = patches.iter().flatten().map(|patch| patch.to - patch.from).sum();
    if covered > (1.0 - LEAST_BARE) * length {
        return None;
    }
    let spacing = middle_distance(&patches)?;
    let longest = median(patches.iter().flatten().map(|patch| patch.to - patch.from))?;
    let count: usize = patches.iter().map(Vec::len).sum();
    (count >= LEAST && longest <= LONGEST * spacing).then_some(spacing)
}

/// Share of the length of the rows that has leaf within their bands.
pub(super) fn covered_share(mask: &Mask, rows: &Rows) -> f64 {
    let profiles = profiles(mask, rows);
    let length: usize = profiles.iter().map(Vec::len).sum();
    let covered = profiles.iter().flatten().filter(|mass| **mass > 0.0).count();
    covered as f64 / length.max(1) as f64
}

/// Leaf mass along every row, by pixels.
fn profiles(mask: &Mask, rows: &Rows) -> Vec<Vec<f64>> {
    let mut profiles: Vec<Vec<f64>> =
        rows.rows.iter().map(|row| vec![0.0; row.length_px().ceil().max(1.0) as usize]).collect();
    for (v, line) in mask.data.chunks_exact(mask.width.max(1)).enumerate() {
        for (u, _) in line.iter().enumerate().filter(|(_, pixel)| **pixel != 0) {
            let [along, across] = rows.axes.aligned([u as f64, v as f64]);
            let Some((row, away)) = rows.nearest(across) else { continue };
            let band = rows.spacing_px.map_or(LONE * rows.rows[row].length_px(), |s| 0.4 * s);
            let place = along - rows.rows[row].start_px;
            if away <= band
                && place >= 0.0
                && let Some(mass) = profiles[row].get_mut(place as usize)
            {
                *mass += 1.0;
            }
        }
    }
    profiles
}

fn runs(profile: &[f64]) -> Vec<Patch> {
    let mut found: Vec<Patch> = Vec::new();
    let mut open = false;
    for (k, &mass) in profile.iter().enumerate() {
        let at = k as f64 + 0.5;
        match (mass > 0.0, open) {
            (true, true) => {
                if let Some(patch) = found.last_mut() {
                    patch.to = at + 0.5;
                    patch.mass += mass;
                    patch.moment += mass * at;
                }
            }
            (true, false) => {
                found.push(Patch { from: at - 0.5, to: at + 0.5, mass, moment: mass * at });
            }
            (false, _) => {}
        }
        open = mass > 0.0;
    }
    found
}

fn middle_distance(patches: &[Vec<Patch>]) -> Option<f64> {
    let pairs = patches.iter().flat_map(|row| row.windows(2));
    median(pairs.map(|pair| pair[1].middle() - pair[0].middle()))
}

fn remove_small_patches(patches: &mut [Vec<Patch>]) {
    let masses = patches.iter().flatten().map(|patch| patch.mass);
    let Some(middle) = median(masses) else { return };
    patches.iter_mut().for_each(|row| row.retain(|patch| patch.mass >= SPECK * middle));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::phenotype::rows;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Three rows of discs, some of which are missing, and specks.
    fn crop(spacing: f64, radius: f64) -> (Mask, Rows) {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let (width, height) = (1200usize, 400usize);
        let mut mask = Mask::empty(width, height);
        let mut disc = |at: [f64; 2], radius: f64| {
            let near = |k: usize, most: usize| {
                (at[k] - radius).max(0.0) as usize..most.min((at[k] + radius) as usize + 2)
            };
            for v in near(1, height) {
                for u in near(0, width) {
                    if (u as f64 - at[0]).hypot(v as f64 - at[1]) <= radius {
                        mask.data[v * width + u] = 255;
                    }
                }
            }
        };
        for row in [70.0, 200.0, 330.0] {
            for plant in 0..(1100.0 / spacing) as usize {
                let at = 50.0 + spacing * (plant as f64 + 0.16 * (rng.random::<f64>() - 0.5));
                if plant % 9 != 4 {
                    disc([at, row], radius);
                } else {
                    disc([at, row], 1.0);
                }
            }
        }
        let detection = rows::detect(&mask);
        (mask, detection.rows().unwrap().clone())
    }

    #[test]
    fn plants_that_stand_apart_tell_their_spacing_and_others_do_not() {
        for spacing in [24.0, 45.0, 70.0] {
            let (mask, rows) = crop(spacing, 0.25 * spacing);
            let found = spacing_px(&mask, &rows).unwrap();
            assert!((found / spacing - 1.0).abs() < 0.06, "{found} for {spacing}");
        }
        let (mask, rows) = crop(24.0, 14.0);
        assert_eq!(spacing_px(&mask, &rows), None, "leaves have closed");
    }
}
