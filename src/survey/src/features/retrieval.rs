//! Which photos show the same, where neither positions nor an order say so: image retrieval by a vocabulary that is learned on
//! the photos themselves.
//!
//! The descriptors of the largest features of every photo are gathered into words by k-means, and an index lists for each
//! word the features of all photos that are nearest to it. Two features of the same word vote for their photos where their
//! signatures agree: 64 bits, each the sign of a random projection of the difference between descriptor and word (Hamming
//! embedding). At a Hamming distance `h` a vote counts `ln(N / n)^2 exp(-h^2 / s^2)`, with `n` of the `N` photos having the word; a
//! feature votes once for a photo, so that what repeats in a photo (rows, furrows) does not count twice. Sums are divided by
//! the root of the photos' numbers of features. The work grows with the number of features, not with the number of pairs.
//!
//! References: J. Sivic and A. Zisserman, "Video Google: a text retrieval approach to object matching in videos", ICCV 2003; H. Jegou,
//! M. Douze and C. Schmid, "Hamming embedding and weak geometric consistency for large scale image search", ECCV 2008.

use super::{
    DESCRIPTOR_LENGTH, Descriptors,
    matching::{Prepared, nearest_prepared},
    pairs::{self, Pair},
};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// How [`similar`] works.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RetrievalOptions {
    /// The most alike photos that each photo asks for.
    pub per_photo: usize,
    /// Seed of the first words and of the projections.
    pub seed: u64,
}

impl Default for RetrievalOptions {
    fn default() -> RetrievalOptions {
        RetrievalOptions { per_photo: 40, seed: 1 }
    }
}

/// Features of all photos per word, about; with fewer, what belongs together falls into different words more often, and
/// with more the index takes longer.
const FEATURES_PER_WORD: usize = 256;
/// The most words: as long as a descriptor is compared with all of them, more would take longer than the index saves.
const MAX_WORDS: usize = 8192;
/// Descriptors per word that the words are learned from: a sixth of all of them at 256 per word. Not tuned.
const SAMPLE: usize = 40;
/// Rounds of k-means. Not tuned: words need not be at rest to tell photos apart.
const ROUNDS: usize = 8;
/// Bits of a signature.
const BITS: usize = 64;
/// Hamming distance beyond which features do not vote. Two descriptors that have nothing in common but the word differ in 32 bits with a standard
/// deviation of 4; this is two deviations below. Not tuned.
const FARTHEST: u32 = 24;
/// The `s` of the weight of a vote, in bits: a quarter of them. Not tuned.
const SCALE: f32 = 16.0;

/// Of each photo the others that are most alike, as pairs, by the descriptors of a few of their features: those of the largest scales
/// ([`pairs::largest`]), as many in each photo.
pub fn similar(photos: &[Descriptors], options: &RetrievalOptions) -> Vec<Pair> {
    let total: usize = photos.iter().map(Descriptors::len).sum();
    let words = (total / FEATURES_PER_WORD).clamp(1, MAX_WORDS);
    let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
    let words = learn(photos, words, &mut rng);
    let signs = Signs::new(&mut rng);
    let prepared = Prepared::new(&words);
    let described: Vec<Vec<Entry>> = photos
        .par_iter()
        .enumerate()
        .map(|(photo, descriptors)| describe(photo, descriptors, &prepared, &signs))
        .collect();
    let index = Index::new(&described, words.len());
    let asked = (0..photos.len()).into_par_iter().flat_map_iter(|one| {
        let mut scores = index.scores(one, &described);
        scores.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        scores.truncate(options.per_photo);
        scores.into_iter().map(move |(_, other)| [one.min(other), one.max(other)])
    });
    let asked: Vec<Pair> = asked.collect();
    pairs::join(&[asked])
}

/// A feature in the index.
#[derive(Debug, Clone, Copy)]
struct Entry {
    word: u32,
    photo: u32,
    signature: u64,
}

/// Words by k-means over a sample of all descriptors; with whole numbers only, so that they are the same on every machine.
fn learn(all: &[Descriptors], words: usize, rng: &mut ChaCha8Rng) -> Descriptors {
    let mut places: Vec<(usize, usize)> = all
        .iter()
        .enumerate()
        .flat_map(|(photo, descriptors)| (0..descriptors.len()).map(move |k| (photo, k)))
        .collect();
    let count = (SAMPLE * words).min(places.len());
    for k in 0..count {
        let other = rng.random_range(k..places.len());
        places.swap(k, other);
    }
    places.truncate(count);
    let of = |&(photo, k): &(usize, usize)| all[photo].select(&[k]).as_bytes().to_vec();
    let sample = places.par_iter().flat_map_iter(of).collect::<Vec<u8>>();
    let sample = Descriptors::from_bytes(sample).unwrap_or_default();
    let mut found = sample.select(&(0..words.min(count)).collect::<Vec<usize>>());
    for _ in 0..ROUNDS {
        let nearest = nearest_prepared(&sample, &Prepared::new(&found));
        let mut sums = vec![[0u32; DESCRIPTOR_LENGTH + 1]; found.len()];
        for (nearest, descriptor) in nearest.iter().zip(sample.iter()) {
            let sum = &mut sums[nearest.index as usize];
            sum.iter_mut().zip(descriptor).for_each(|(sum, &byte)| *sum += u32::from(byte));
            sum[DESCRIPTOR_LENGTH] += 1;
        }
        let before = found.as_bytes().as_chunks::<DESCRIPTOR_LENGTH>().0.to_vec();
        let mean = |(sum, before): (&[u32; DESCRIPTOR_LENGTH + 1], [u8; DESCRIPTOR_LENGTH])| {
            let count = sum[DESCRIPTOR_LENGTH];
            std::array::from_fn::<u8, DESCRIPTOR_LENGTH, _>(|k| match count {
                0 => before[k],
                count => ((sum[k] + count / 2) / count) as u8,
            })
        };
        let bytes = sums.iter().zip(before).flat_map(mean).collect();
        found = Descriptors::from_bytes(bytes).unwrap_or_default();
    }
    found
}

/// Random projections: each bit of a signature adds and subtracts the numbers of a descriptor by these signs.
struct Signs(Vec<[i16; DESCRIPTOR_LENGTH]>);

impl Signs {
    fn new(rng: &mut ChaCha8Rng) -> Signs {
        let mut of_bit = || {
            let mut bytes = [0u8; DESCRIPTOR_LENGTH];
            rng.fill_bytes(&mut bytes);
            bytes.map(|byte| if byte % 2 == 0 { 1 } else { -1 })
        };
        Signs((0..BITS).map(|_| of_bit()).collect())
    }

    fn signature(
        &self,
        descriptor: &[u8; DESCRIPTOR_LENGTH],
        word: &[u8; DESCRIPTOR_LENGTH],
    ) -> u64 {
        let away: [i16; DESCRIPTOR_LENGTH] =
            std::array::from_fn(|k| i16::from(descriptor[k]) - i16::from(word[k]));
        let bit = |signs: &[i16; DESCRIPTOR_LENGTH]| {
            signs.iter().zip(&away).map(|(sign, away)| i32::from(sign * away)).sum::<i32>() > 0
        };
        self.0.iter().fold(0, |bits, signs| bits << 1 | u64::from(bit(signs)))
    }
}

fn describe(
    photo: usize,
    descriptors: &Descriptors,
    words: &Prepared<'_>,
    signs: &Signs,
) -> Vec<Entry> {
    let known = words.descriptors().as_bytes().as_chunks::<DESCRIPTOR_LENGTH>().0;
    let nearest = nearest_prepared(descriptors, words);
    let entry = |(nearest, descriptor): (&super::matching::Nearest, _)| Entry {
        word: nearest.index,
        photo: photo as u32,
        signature: signs.signature(descriptor, &known[nearest.index as usize]),
    };
    nearest.iter().zip(descriptors.iter()).map(entry).collect()
}

/// The features of all photos by their words, and within a word by photo.
struct Index {
    entries: Vec<Entry>,
    /// Where the entries of each word begin.
    begins: Vec<usize>,
    /// Weight of a word.
    weights: Vec<f32>,
}

impl Index {
    fn new(described: &[Vec<Entry>], words: usize) -> Index {
        let mut entries = described.concat();
        entries.sort_by_key(|entry| entry.word);
        let begins: Vec<usize> = (0..=words as u32)
            .map(|word| entries.partition_point(|entry| entry.word < word))
            .collect();
        let weight = |span: &[usize]| {
            let photos = entries[span[0]..span[1]].chunk_by(|a, b| a.photo == b.photo).count();
            (described.len() as f32 / photos.max(1) as f32).ln().powi(2)
        };
        let weights = begins.windows(2).map(weight).collect();
        Index { entries, begins, weights }
    }

    /// How alike a photo is to each other that has a vote.
    fn scores(&self, one: usize, described: &[Vec<Entry>]) -> Vec<(f32, usize)> {
        let mut sums = vec![0.0f32; described.len()];
        for entry in &described[one] {
            let word = entry.word as usize;
            let of_word = &self.entries[self.begins[word]..self.begins[word + 1]];
            for of_photo in of_word.chunk_by(|a, b| a.photo == b.photo) {
                let distance = |other: &Entry| (other.signature ^ entry.signature).count_ones();
                let least = of_photo.iter().map(distance).min().unwrap_or(u32::MAX);
                if least <= FARTHEST {
                    let near = (-(least as f32 / SCALE).powi(2)).exp();
                    sums[of_photo[0].photo as usize] += self.weights[word] * near;
                }
            }
        }
        let size = |photo: usize| (described[photo].len().max(1) as f32).sqrt();
        let voted = (0..sums.len()).filter(|&other| other != one && sums[other] > 0.0);
        voted.map(|other| (sums[other] / size(other), other)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Photos of a flight, `strips` by `per_strip`: each sees the `side` by `side` things around its place, a third of the next
    /// ones being new, as descriptors with noise, and as many that nobody else sees.
    fn flight(strips: usize, per_strip: usize, side: usize, seed: u64) -> Vec<Descriptors> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let step = side / 3;
        let across = step * per_strip + side;
        let mut draw = || -> [u8; DESCRIPTOR_LENGTH] {
            // Most numbers of a descriptor are small.
            std::array::from_fn(|_| (160.0 * rng.random::<f32>().powi(3)) as u8)
        };
        let things: Vec<_> = (0..across * (step * strips + side)).map(|_| draw()).collect();
        let lone: Vec<_> = (0..strips * per_strip * side * side).map(|_| draw()).collect();
        let mut noise = ChaCha8Rng::seed_from_u64(seed + 1);
        let mut photo = |k: usize| {
            let (row, column) = (step * (k / per_strip), step * (k % per_strip));
            let seen = (0..side * side)
                .map(|j| things[(row + j / side) * across + column + j % side])
                .chain(lone[k * side * side..][..side * side].iter().copied());
            let bytes: Vec<u8> = seen
                .flatten()
                .map(|byte| (i32::from(byte) + noise.random_range(-12..=12)).clamp(0, 255) as u8)
                .collect();
            Descriptors::from_bytes(bytes).unwrap()
        };
        (0..strips * per_strip).map(&mut photo).collect()
    }

    #[test]
    fn overlapping_photos_are_found_among_hundreds() {
        let (strips, per_strip, side) = (15, 20, 12);
        let photos = flight(strips, per_strip, side, 1);
        let options = RetrievalOptions { per_photo: 30, ..RetrievalOptions::default() };
        let found = similar(&photos, &options);
        assert!(found.len() <= 30 * photos.len());
        let overlap = |[a, b]: Pair| {
            let away = |a: usize, b: usize| a.abs_diff(b) <= 2;
            away(a / per_strip, b / per_strip) && away(a % per_strip, b % per_strip)
        };
        let all = pairs::all(photos.len()).into_iter().filter(|pair| overlap(*pair));
        let (mut of, mut missed) = (0, 0);
        for pair in all {
            of += 1;
            missed += usize::from(found.binary_search(&pair).is_err());
        }
        assert!(20 * missed <= of, "{missed} of {of} missed");
        let again = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert_eq!(again.install(|| similar(&photos, &options)), found);
    }

    #[test]
    fn few_photos_and_photos_without_features() {
        let options = RetrievalOptions::default();
        assert_eq!(similar(&[], &options), Vec::<Pair>::new());
        let mut photos = flight(1, 3, 6, 2);
        photos.push(Descriptors::default());
        let found = similar(&photos, &options);
        assert!(found.iter().all(|pair| !pair.contains(&3)), "{found:?}");
        assert_eq!(similar(&photos[3..], &options), Vec::<Pair>::new());
    }
}
