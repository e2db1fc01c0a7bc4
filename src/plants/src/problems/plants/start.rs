//! Where the descent starts.
//!
//! k-means++ takes a first leaf pixel at random and every further one with a probability
//! proportional to `min_p |Z_n - X_p|^2`. The tree over the pixels finds those that a new plant
//! comes closest to, so `P` plants cost about `N ln P` instead of `N P`.
//!
//! Positions in pixels.
//!
//! Reference: D. Arthur and S. Vassilvitskii, "k-means++: the advantages of careful seeding",
//! SODA 2007.

use super::{
    assignment::distance2,
    index::{PixelIndex, Reach, Walk, largest},
};
use rand::{RngExt, seq::index::sample};
use rand_chacha::ChaCha8Rng;

/// Leaves whose sums are added up together.
const BLOCK: usize = 256;

/// `count` different leaf pixels, all equally likely.
pub fn random(index: &PixelIndex, count: usize, rng: &mut ChaCha8Rng) -> Vec<[f64; 2]> {
    let count = count.min(index.len());
    sample(rng, index.len(), count).into_iter().map(|pixel| index.position(pixel)).collect()
}

/// `count` leaf pixels by k-means++, in the order of the index, so that plants visited one after
/// the other are neighbours.
pub fn kmeans_plus_plus(index: &PixelIndex, count: usize, rng: &mut ChaCha8Rng) -> Vec<[f64; 2]> {
    let mut plants: Vec<usize> = Vec::with_capacity(count);
    if index.is_empty() || count == 0 {
        return Vec::new();
    }
    let mut nearest2 = vec![f32::INFINITY; index.len()];
    let mut reach = Reach::new(index, &nearest2);
    let mut leaf_sums = vec![0.0_f64; index.leaves()];
    let mut block_sums = vec![0.0_f64; index.leaves().div_ceil(BLOCK)];
    let (mut walk, mut nodes, mut changed) = (Walk::default(), Vec::new(), Vec::new());
    let mut pixel = rng.random_range(0..index.len());
    loop {
        let plant = index.position(pixel);
        plants.push(pixel);
        if plants.len() == count {
            plants.sort_unstable();
            return plants.into_iter().map(|pixel| index.position(pixel)).collect();
        }
        index.within_reach(&reach, &[plant], &mut walk);
        changed.clear();
        for &leaf in &walk.found {
            let mut closer = false;
            let range = index.pixels_of(leaf as usize);
            for n in range.clone() {
                let d2 = distance2(index.u_px()[n], index.v_px()[n], plant);
                if d2 < nearest2[n] {
                    nearest2[n] = d2;
                    closer = true;
                }
            }
            if closer {
                reach.set(leaf as usize, largest(&nearest2[range.clone()]));
                leaf_sums[leaf as usize] = nearest2[range].iter().map(|&d2| f64::from(d2)).sum();
                changed.push(leaf);
            }
        }
        index.repair(&mut reach, &changed, &mut nodes);
        let mut done = usize::MAX;
        for block in changed.iter().map(|&leaf| leaf as usize / BLOCK) {
            if block != done {
                let last = ((block + 1) * BLOCK).min(leaf_sums.len());
                block_sums[block] = leaf_sums[block * BLOCK..last].iter().sum();
                done = block;
            }
        }
        let total: f64 = block_sums.iter().sum();
        pixel = if total > 0.0 {
            draw(index, &block_sums, &leaf_sums, &nearest2, total * rng.random::<f64>())
        } else {
            rng.random_range(0..index.len())
        };
    }
}

/// The pixel in which the running sum of squared distances passes `mark`; the last that counts,
/// should rounding carry the mark past the end.
fn draw(
    index: &PixelIndex,
    block_sums: &[f64],
    leaf_sums: &[f64],
    nearest2: &[f32],
    mut mark: f64,
) -> usize {
    let block = pass(block_sums.iter().copied(), &mut mark);
    let last = ((block + 1) * BLOCK).min(leaf_sums.len());
    let leaf = block * BLOCK + pass(leaf_sums[block * BLOCK..last].iter().copied(), &mut mark);
    let pixels = index.pixels_of(leaf);
    let values = nearest2[pixels.clone()].iter().map(|&d2| f64::from(d2));
    pixels.start + pass(values, &mut mark)
}

fn pass(values: impl Iterator<Item = f64>, mark: &mut f64) -> usize {
    let mut chosen = 0;
    for (k, value) in values.enumerate() {
        if value > 0.0 {
            chosen = k;
            if *mark < value {
                break;
            }
            *mark -= value;
        }
    }
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    fn blobs() -> PixelIndex {
        let at = |k: u32| [k % 12 + 100 * (k / 144 % 5), k / 12 % 12 + 60 * (k / 144 / 5)];
        PixelIndex::new(&(0..144 * 10).map(at).collect::<Vec<_>>())
    }

    #[test]
    fn kmeans_plus_plus_finds_separate_blobs_and_repeats_itself() {
        let index = blobs();
        let plants = kmeans_plus_plus(&index, 10, &mut ChaCha8Rng::seed_from_u64(1));
        let mut cells: Vec<(u32, u32)> =
            plants.iter().map(|p| (p[0] as u32 / 100, p[1] as u32 / 60)).collect();
        cells.sort_unstable();
        cells.dedup();
        assert!(cells.len() >= 9, "{cells:?}");
        assert_eq!(plants, kmeans_plus_plus(&index, 10, &mut ChaCha8Rng::seed_from_u64(1)));
        assert_ne!(plants, kmeans_plus_plus(&index, 10, &mut ChaCha8Rng::seed_from_u64(2)));
    }

    #[test]
    fn as_many_plants_as_pixels_take_every_pixel_once() {
        let index = PixelIndex::new(&(0..100).map(|k| [k % 7 * 3, k / 7]).collect::<Vec<_>>());
        type Start = fn(&PixelIndex, usize, &mut ChaCha8Rng) -> Vec<[f64; 2]>;
        for start in [kmeans_plus_plus as Start, random as Start] {
            let plants = start(&index, 100, &mut ChaCha8Rng::seed_from_u64(1));
            let mut keys: Vec<(i64, i64)> =
                plants.iter().map(|p| (p[0] as i64, p[1] as i64)).collect();
            keys.sort_unstable();
            keys.dedup();
            assert_eq!(keys.len(), 100);
        }
    }
}
