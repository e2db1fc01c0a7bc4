//! The step that compares photos: matches of the pairs worth trying.

use super::{features::Extracted, inputs::Inputs};
use crate::{
    batches::Part,
    record::{Key, Store},
};
use rayon::prelude::*;
use rowgram_base::{
    error::Error,
    monitor::{Counter, Diagnostic, Monitor},
};
use rowgram_optim::robust::median;
use rowgram_survey::{
    features::{
        DescriptorSource, Descriptors,
        matching::{MatchOptions, Prepared, match_prepared},
        pairs::{self, CoarseOptions},
        retrieval::{self, RetrievalOptions},
    },
    sfm::verify::PairMatches,
};
use std::sync::Arc;

/// Where the matches are kept.
pub(super) const MATCHES: &str = "matches";
/// Where parts of them are, until all have been found.
pub(super) const PARTS: &str = "matching";
/// Within that, the pairs that are matched.
const CHOSEN: &str = "chosen";

/// Pairs that are matched and kept together, and whose photos' descriptors are in memory together.
const TOGETHER: usize = 512;

/// How pairs are chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Choice {
    /// Neighbours by position that are looked at.
    nearest: usize,
    /// Photos that follow in time.
    following: usize,
    /// Photos that follow in time, and half of the nearest ones, that are matched in any case.
    certain: usize,
    /// A first look at few features.
    coarse: CoarseOptions,
    /// Without positions.
    retrieval: RetrievalOptions,
}

impl Choice {
    fn new(seed: u64) -> Choice {
        Choice {
            nearest: 40,
            following: 3,
            certain: 2,
            coarse: CoarseOptions::default(),
            retrieval: RetrievalOptions { seed, ..RetrievalOptions::default() },
        }
    }
}

/// Up to so many photos without positions everything is compared with everything, coarsely: with more, retrieval has fewer pairs to look
/// at, 40 a photo instead of half of all photos.
const MOST_EXHAUSTIVE: usize = 100;

/// Photos that follow each other in time, up to `reach` apart.
fn following(inputs: &Inputs, reach: usize) -> Vec<pairs::Pair> {
    let order = inputs.flight();
    pairs::in_sequence(order.len(), reach)
        .into_iter()
        .map(|[a, b]| [order[a].min(order[b]), order[a].max(order[b])])
        .collect()
}

/// Pairs worth a look: neighbours by position, those that follow each other, and without positions those that are alike.
fn candidates(inputs: &Inputs, extracted: &Extracted, choice: &Choice) -> Vec<pairs::Pair> {
    let n = inputs.photos.len();
    let placed = inputs.plan_m.iter().filter(|p| p[0].is_finite()).count();
    let alike = || match n {
        0..=MOST_EXHAUSTIVE => pairs::all(n),
        _ => retrieval::similar(&extracted.largest, &choice.retrieval),
    };
    let mut lists = vec![following(inputs, choice.following)];
    if placed * 2 >= n {
        lists.push(pairs::nearest(&inputs.plan_m, choice.nearest, f64::INFINITY));
        // A photo without a position may belong anywhere.
        let is_lost = |k: &usize| !inputs.plan_m[*k][0].is_finite();
        let mut with_lost = if (0..n).any(|k| is_lost(&k)) { alike() } else { Vec::new() };
        with_lost.retain(|pair| pair.iter().any(is_lost));
        lists.push(with_lost);
    } else {
        lists.push(alike());
    }
    pairs::join(&lists)
}

/// Matches as they are kept.
type Stored = Vec<([u32; 2], Vec<[u32; 2]>)>;

/// The pairs worth matching, in sets that are matched and kept one by one.
pub(super) struct Matching<'a> {
    inputs: &'a Inputs,
    extracted: &'a Extracted,
    choice: Choice,
    options: MatchOptions,
    candidates: Vec<pairs::Pair>,
    store: &'a Store,
    parts: Store,
    key: Key,
}

impl<'a> Matching<'a> {
    /// Looks for pairs that may be worth it.
    pub(super) fn new(
        inputs: &'a Inputs,
        extracted: &'a Extracted,
        seed: u64,
        store: &'a Store,
    ) -> Matching<'a> {
        let (choice, options) = (Choice::new(seed), MatchOptions::default());
        let candidates = candidates(inputs, extracted, &choice);
        let key = candidates
            .iter()
            .fold(Key::begin().key(extracted.key), |key, [a, b]| {
                key.count(*a as u64).count(*b as u64)
            })
            .text(&format!("{choice:?} {options:?}"))
            .finish();
        let parts = store.within(PARTS);
        Matching { inputs, extracted, choice, options, candidates, store, parts, key }
    }

    /// All matches.
    ///
    /// # Errors
    /// Where they cannot be kept.
    pub(super) fn all(&self, monitor: &mut dyn Monitor) -> Result<(Vec<PairMatches>, Key), Error> {
        let stored = match self.store.load::<Stored>(MATCHES, self.key) {
            Some(stored) => stored,
            None => {
                let mut all = Stored::new();
                self.part(Part::WHOLE, monitor, |found| all.extend(found))?;
                self.store.save(MATCHES, self.key, &all)?;
                all
            }
        };
        self.store.forget(PARTS)?;
        let found = stored.into_iter().map(|(images, matches)| PairMatches { images, matches });
        Ok((found.collect(), self.key))
    }

    /// Matches a part of the sets, unless that was done, and gives the number of these.
    ///
    /// # Errors
    /// Where they cannot be kept.
    pub(super) fn part(
        &self,
        part: Part,
        monitor: &mut dyn Monitor,
        mut take: impl FnMut(Stored),
    ) -> Result<usize, Error> {
        let chosen = self.chosen(monitor)?;
        let sets: Vec<&[pairs::Pair]> = chosen.chunks(TOGETHER).collect();
        let own = part.range(sets.len());
        let pairs = own.clone().map(|k| sets[k].len()).sum::<usize>();
        let counter = Counter::new(monitor, "matching", pairs, "pairs");
        for k in own.clone() {
            let name = k.to_string();
            let key = Key::begin().key(self.key).count(k as u64).finish();
            let found = match self.parts.load::<Stored>(&name, key) {
                Some(found) => {
                    found.iter().for_each(|_| counter.tick());
                    found
                }
                None => {
                    let found = self.match_set(sets[k], &|| counter.tick());
                    self.extracted.descriptors.check()?;
                    self.parts.save(&name, key, &found)?;
                    found
                }
            };
            take(found);
        }
        Ok(own.len())
    }

    /// The pairs that are matched.
    fn chosen(&self, monitor: &mut dyn Monitor) -> Result<Vec<pairs::Pair>, Error> {
        if let Some(chosen) = self.parts.load(CHOSEN, self.key) {
            return Ok(chosen);
        }
        // The nearest few and those that follow each other are matched whatever the coarse look says:
        // on a plain crop it sees little.
        let close = [
            following(self.inputs, self.choice.certain),
            pairs::nearest(&self.inputs.plan_m, 2 * self.choice.certain, f64::INFINITY),
        ];
        let counter = Counter::new(monitor, "choosing pairs", self.candidates.len(), "pairs");
        let tick = || counter.tick();
        let looks = &self.extracted.largest;
        let shortlist = pairs::coarse(looks, &self.candidates, &self.choice.coarse, &tick);
        let chosen = pairs::join(&[shortlist, pairs::join(&close)]);
        self.parts.save(CHOSEN, self.key, &chosen)?;
        Ok(chosen)
    }

    fn match_set(&self, set: &[pairs::Pair], tick: &(dyn Fn() + Sync)) -> Stored {
        let mut photos: Vec<usize> = set.iter().flatten().copied().collect();
        photos.sort_unstable();
        photos.dedup();
        let source = &self.extracted.descriptors;
        let looks: Vec<Arc<Descriptors>> =
            photos.par_iter().map(|&photo| source.descriptors(photo)).collect();
        let prepared: Vec<Prepared<'_>> = looks.par_iter().map(|of| Prepared::new(of)).collect();
        let of = |photo: usize| &prepared[photos.partition_point(|&other| other < photo)];
        set.par_iter()
            .map(|&[a, b]| {
                let matches = match_prepared(of(a), of(b), &self.options);
                tick();
                let matches = matches.iter().map(|m| [m.first, m.second]).collect();
                ([a as u32, b as u32], matches)
            })
            .collect()
    }
}

/// A photo and its double match in at least this share of their features.
const DOUBLE_SHARE: f64 = 0.2;
/// And stand this close to each other in the middle, pixels.
const DOUBLE_PX: f64 = 0.5;

/// Removes photos that show the same as another, pixel by pixel, from the matches: saved twice, they
/// have no base and tell nothing. Of two the one that has a position stays, or else the first.
pub(super) fn remove_duplicates(
    inputs: &Inputs,
    extracted: &Extracted,
    matched: &mut Vec<PairMatches>,
    monitor: &mut dyn Monitor,
) {
    let mut out = vec![false; inputs.photos.len()];
    for pair in matched.iter() {
        let [a, b] = pair.images.map(|k| k as usize);
        let [first, second] = [a, b].map(|k| &extracted.geometric[k].positions_px);
        let fewer = first.len().min(second.len());
        if out[a] || out[b] || (pair.matches.len() as f64) < DOUBLE_SHARE * fewer as f64 {
            continue;
        }
        let apart = pair.matches.iter().map(|[i, j]| {
            let (p, q) = (&first[*i as usize], &second[*j as usize]);
            (p[0] - q[0]).hypot(p[1] - q[1])
        });
        if median(apart).is_none_or(|middle| middle > DOUBLE_PX) {
            continue;
        }
        let placed = |k: usize| inputs.plan_m[k][0].is_finite();
        let (stays, goes) = if placed(b) && !placed(a) { (b, a) } else { (a, b) };
        out[goes] = true;
        let message = format!("it shows the same as {}: left out", inputs.photos[stays].name);
        let subject = inputs.photos[goes].name.as_str();
        monitor.diagnostic(&Diagnostic::warning("duplicate-photo", subject, message));
    }
    matched.retain(|pair| pair.images.iter().all(|&k| !out[k as usize]));
}
