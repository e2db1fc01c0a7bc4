//! Which plant of one date is which of the next.
//!
//! Plants stay where they are; what moves is the map, by a drift `d_p` per plot, and the place at which a plant is found, by a
//! deviation of `sigma` in each axis. From one date to the next the plants `i` last seen at `x_i` and the plants `j` found at `y_j` are
//! matched one to one: as many pairs as possible with `|x_i + d_p - y_j|` below 0.7 of the distance of neighbouring plants, and
//! of these the least sum of distances ([`crate::score::matching`]). `d_p` is the median displacement of mutual nearest neighbours of
//! the plot, `sigma` comes from the distances of the pairs. That a pair is one plant and not one lost beside one that is new
//! has the probability
//!
//! ```text
//! q N(d; 0, sigma^2 I) / (q N(d; 0, sigma^2 I) + (1 - q) b),
//! ```
//!
//! `q` the share of plants that are seen again, `b` new plants per square metre. A plant that is not seen again has been lost or
//! missed: with the probability `m_k` of missing one on date `k`, from plants that are seen before and after, and the probability `l_k` of
//! losing one before it, Bayes' rule over the dates since it was last seen gives the probability that it is lost; likewise one
//! that is first seen on a later date is new or was missed before.
//!
//! Positions in metres in one frame for all dates. Reference of the matching rule: D. B. Reid, IEEE Trans. Autom. Control 24, 1979,
//! 843-854, with one hypothesis.

use crate::score::{matching, tree::Tree};
use rowgram_optim::robust::{median, sigma_of_distances};

/// A plant as one date shows it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sighting {
    /// Where it stands, metres.
    pub at_m: [f64; 2],
    /// The plot that it stands in.
    pub plot: Option<usize>,
}

/// A plant through the dates.
#[derive(Debug, Clone, PartialEq)]
pub struct Track {
    /// The plot that it stands in.
    pub plot: Option<usize>,
    /// Which plant of each date it is.
    pub seen: Vec<Option<usize>>,
    /// For each date on which it is seen again: the probability that it is the same plant.
    pub same_probability: Vec<Option<f64>>,
    /// Probability that it was not there before the date on which it is first seen; `None` where that is the first date.
    pub new_probability: Option<f64>,
    /// Probability that it is gone by the last date; `None` where it is seen on that date.
    pub lost_probability: Option<f64>,
}

impl Track {
    /// The first date on which it is seen.
    pub fn first(&self) -> Option<usize> {
        self.seen.iter().position(Option::is_some)
    }

    /// The last date on which it is seen.
    pub fn last(&self) -> Option<usize> {
        self.seen.iter().rposition(Option::is_some)
    }
}

/// What happens from one date to the next.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// Drift of each plot, metres.
    pub drift_m: Vec<[f64; 2]>,
    /// Standard deviation of a plant's displacement beyond the drift, each axis, metres; `None` without a pair.
    pub sigma_m: Option<f64>,
    /// Pairs.
    pub matched: usize,
    /// Plants of the later date without a partner.
    pub new: usize,
    /// Plants looked for without a partner.
    pub unseen: usize,
}

/// All plants of a season.
#[derive(Debug, Clone, PartialEq)]
pub struct Tracks {
    /// Plants in the order in which they are first seen.
    pub tracks: Vec<Track>,
    /// From each date to the next.
    pub steps: Vec<Step>,
}

/// Dates for which a plant that is not seen is still looked for.
const PATIENCE: usize = 2;
/// A plant is looked for within this share of the distance of neighbouring plants. The synthetic season `small` gives the same within a
/// hundredth from 0.6 to 0.8 (`rowgram synth season`, `experiments season`); at 0.5 plants that one date puts half a place beside are lost.
const REACH: f64 = 0.7;
/// Nearest neighbours that tell the drift are so near, as a share of the same: beyond half of it lies the next plant.
const DRIFT_REACH: f64 = 0.5;
/// Fewer pairs than this say nothing about the drift of a single plot.
const LEAST_PAIRS: usize = 8;

/// Follows plants through the dates; plots are numbered from 0 to `plots - 1`.
pub fn follow(dates: &[Vec<Sighting>], plots: usize) -> Tracks {
    let mut tracks: Vec<Track> = Vec::new();
    let mut heads: Vec<[f64; 2]> = Vec::new();
    let mut steps = Vec::new();
    for (k, date) in dates.iter().enumerate() {
        let open: Vec<usize> = (0..tracks.len())
            .filter(|&t| tracks[t].last().is_some_and(|last| k - last <= PATIENCE))
            .collect();
        let from: Vec<Sighting> =
            open.iter().map(|&t| Sighting { at_m: heads[t], plot: tracks[t].plot }).collect();
        let mut taken = vec![false; date.len()];
        if k > 0 {
            let (step, pairs) = step(&from, date, plots);
            for (found, place, probability) in pairs {
                let t = open[found];
                tracks[t].seen[k] = Some(place);
                tracks[t].same_probability[k] = Some(probability);
                heads[t] = date[place].at_m;
                taken[place] = true;
            }
            // What is not seen moves with its plot.
            for (&t, sighting) in open.iter().zip(&from) {
                if tracks[t].seen[k].is_none() {
                    let drift = sighting.plot.map_or([0.0; 2], |plot| step.drift_m[plot]);
                    heads[t] = [sighting.at_m[0] + drift[0], sighting.at_m[1] + drift[1]];
                }
            }
            steps.push(step);
        }
        for (place, sighting) in date.iter().enumerate().filter(|(place, _)| !taken[*place]) {
            let mut seen = vec![None; dates.len()];
            seen[k] = Some(place);
            let same_probability = vec![None; dates.len()];
            let (new_probability, lost_probability) = (None, None);
            let plot = sighting.plot;
            tracks.push(Track { plot, seen, same_probability, new_probability, lost_probability });
            heads.push(sighting.at_m);
        }
    }
    let missed = missed(&tracks, dates.len());
    births_and_losses(&mut tracks, &missed);
    Tracks { tracks, steps }
}

/// For each point the nearest of the others and its distance.
fn nearest(points: &[[f64; 2]], others: &[[f64; 2]]) -> Vec<Option<(usize, f64)>> {
    let tree = Tree::new(others);
    points.iter().map(|&at| tree.nearest(others, at, None)).collect()
}

/// Distance of neighbouring plants: the median of that to the nearest one.
fn spacing_m(points: &[[f64; 2]]) -> Option<f64> {
    let tree = Tree::new(points);
    let of = |k: usize| tree.nearest(points, points[k], Some(k));
    median((0..points.len()).filter_map(of).map(|(_, distance)| distance))
}

/// Matches plants of the dates before with those of a date: the pairs as (before, now, probability).
fn step(from: &[Sighting], to: &[Sighting], plots: usize) -> (Step, Vec<(usize, usize, f64)>) {
    let places = |all: &[Sighting]| all.iter().map(|s| s.at_m).collect::<Vec<_>>();
    let (before, now) = (places(from), places(to));
    let nothing = |matched| Step {
        drift_m: vec![[0.0; 2]; plots],
        sigma_m: None,
        matched,
        new: to.len() - matched,
        unseen: from.len() - matched,
    };
    // The date with more plants says how far apart they are.
    let dense = if before.len() > now.len() { &before } else { &now };
    let Some(spacing_m) =
        spacing_m(dense).filter(|s| *s > 0.0 && !before.is_empty() && !now.is_empty())
    else {
        return (nothing(0), Vec::new());
    };
    let (forth, back) = (nearest(&before, &now), nearest(&now, &before));
    let mutual: Vec<(Option<usize>, [f64; 2])> = forth
        .iter()
        .enumerate()
        .filter_map(|(i, found)| {
            let (j, d) = (*found)?;
            let is_mutual =
                back[j].is_some_and(|(other, _)| other == i) && d <= DRIFT_REACH * spacing_m;
            is_mutual.then(|| (from[i].plot, [now[j][0] - before[i][0], now[j][1] - before[i][1]]))
        })
        .collect();
    let middle = |of: &dyn Fn(Option<usize>) -> bool, least: usize| -> Option<[f64; 2]> {
        let chosen: Vec<[f64; 2]> = mutual.iter().filter(|m| of(m.0)).map(|m| m.1).collect();
        if chosen.len() < least {
            return None;
        }
        let axis = |k: usize| median(chosen.iter().map(|d| d[k]));
        Some([axis(0)?, axis(1)?])
    };
    let of_field = middle(&|_| true, 1).unwrap_or([0.0; 2]);
    let drift_m: Vec<[f64; 2]> = (0..plots)
        .map(|plot| middle(&|of| of == Some(plot), LEAST_PAIRS).unwrap_or(of_field))
        .collect();
    let expected: Vec<[f64; 2]> = from
        .iter()
        .map(|s| {
            let drift = s.plot.map_or(of_field, |plot| drift_m[plot]);
            [s.at_m[0] + drift[0], s.at_m[1] + drift[1]]
        })
        .collect();
    let pairs = matching::within(&expected, &now, REACH * spacing_m);
    // Half of the distances in the plane are below 1.1774 standard deviations of an axis.
    let scale = sigma_of_distances(pairs.iter().map(|pair| pair.distance_px));
    let sigma_m = scale.map(|s| s.max(1e-3 * spacing_m));
    let matched = pairs.len();
    let seen_again = (matched as f64 + 0.5) / (from.len() as f64 + 1.0);
    // New plants are counted against the least area that the plants can stand on, so there are rather too many.
    let per_m2 = ((to.len() - matched) as f64 + 0.5) / (to.len() as f64 * spacing_m * spacing_m);
    let probability = |d: f64| {
        let Some(sigma) = sigma_m else { return 0.0 };
        let density = (-0.5 * (d / sigma).powi(2)).exp() / (std::f64::consts::TAU * sigma * sigma);
        let (same, other) = (seen_again * density, (1.0 - seen_again) * per_m2);
        same / (same + other)
    };
    let pairs =
        pairs.iter().map(|pair| (pair.found, pair.truth, probability(pair.distance_px))).collect();
    (Step { drift_m, sigma_m, ..nothing(matched) }, pairs)
}

/// Probability of missing a plant that is there, by date: the share of those seen before and after that are not seen on it.
fn missed(tracks: &[Track], dates: usize) -> Vec<f64> {
    (0..dates)
        .map(|k| {
            let within = tracks.iter().filter(|track| {
                track.first().is_some_and(|first| first < k)
                    && track.last().is_some_and(|last| last > k)
            });
            let (all, gaps) = within.fold((0.0, 0.0), |(all, gaps), track| {
                (all + 1.0, gaps + f64::from(u8::from(track.seen[k].is_none())))
            });
            (gaps + 0.5) / (all + 1.0)
        })
        .collect()
}

fn births_and_losses(tracks: &mut [Track], missed: &[f64]) {
    let dates = missed.len();
    // The share that is not seen on the next date was lost or missed; on the last date nothing says how many are missed, so
    // there it is taken from the date before.
    let miss_of = |k: usize| if k + 1 == dates && k > 1 { missed[k - 1] } else { missed[k] };
    let mut lost = vec![0.0; dates];
    let mut born = vec![0.0; dates];
    for k in 1..dates {
        let before: Vec<&Track> = tracks.iter().filter(|t| t.seen[k - 1].is_some()).collect();
        let unseen = before.iter().filter(|t| t.seen[k..].iter().all(Option::is_none)).count();
        let share = (unseen as f64 + 0.5) / (before.len() as f64 + 1.0);
        lost[k] = share.clamp(1e-4, 1.0 - 1e-4);
        let now = tracks.iter().filter(|t| t.seen[k].is_some()).count();
        let first = tracks.iter().filter(|t| t.first() == Some(k)).count();
        born[k] = ((first as f64 + 0.5) / (now as f64 + 1.0)).clamp(1e-4, 1.0 - 1e-4);
    }
    for track in tracks {
        let (Some(first), Some(last)) = (track.first(), track.last()) else { continue };
        if last + 1 < dates {
            let (mut there, mut gone) = (1.0, 0.0);
            for k in last + 1..dates {
                gone += there * lost[k];
                there *= (1.0 - lost[k]) * miss_of(k);
            }
            track.lost_probability = Some(gone / (gone + there));
        }
        if first > 0 {
            let before = if first > 1 { missed[first - 1] } else { missed[first] };
            track.new_probability =
                Some(born[first] / (born[first] + (1.0 - born[first]) * before));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    /// Two plots of rows with plants 25 cm apart; which of them each date shows.
    fn season(
        seed: u64,
        sigma_m: f64,
        drift_m: f64,
        seen: impl Fn(usize, usize) -> bool,
    ) -> (Vec<Vec<Sighting>>, Vec<Vec<usize>>) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || -> f64 { rng.sample(StandardNormal) };
        let plants: Vec<Sighting> = (0..400)
            .map(|k| {
                let (plot, row, place) = (k / 200, k % 200 / 20, k % 20);
                let x = 0.25 * place as f64 + 0.04 * normal() + 7.0 * plot as f64;
                Sighting { at_m: [x, 0.75 * row as f64 + 0.01 * normal()], plot: Some(plot) }
            })
            .collect();
        let (mut dates, mut names) = (Vec::new(), Vec::new());
        for date in 0..5 {
            let drifts = [[0.0; 2]; 2].map(|d| d.map(|_: f64| drift_m * normal()));
            let mut list = Vec::new();
            let mut name = Vec::new();
            for (k, plant) in plants.iter().enumerate() {
                let noise = [sigma_m * normal(), sigma_m * normal()];
                if seen(k, date) {
                    let drift = drifts[k / 200];
                    let at_m = [0, 1].map(|axis| plant.at_m[axis] + drift[axis] + noise[axis]);
                    list.push(Sighting { at_m, ..*plant });
                    name.push(k);
                }
            }
            dates.push(list);
            names.push(name);
        }
        (dates, names)
    }

    /// Of the plants seen on two neighbouring dates, how many are one track.
    fn right(tracks: &Tracks, names: &[Vec<usize>]) -> f64 {
        let mut track_of = vec![std::collections::BTreeMap::new(); names.len()];
        for (t, track) in tracks.tracks.iter().enumerate() {
            for (k, place) in track.seen.iter().enumerate() {
                if let Some(place) = place {
                    track_of[k].insert(names[k][*place], t);
                }
            }
        }
        let (mut all, mut same) = (0u32, 0u32);
        for k in 1..names.len() {
            for (name, track) in &track_of[k - 1] {
                if let Some(next) = track_of[k].get(name) {
                    all += 1;
                    same += u32::from(next == track);
                }
            }
        }
        f64::from(same) / f64::from(all)
    }

    #[test]
    fn plants_are_followed_under_the_drift_of_their_plots() {
        let hash = |k: usize, date: usize| (k * 7919 + date * 104_729) % 100;
        let (dates, names) = season(1, 0.02, 0.015, |k, date| hash(k, date) >= 8);
        let found = follow(&dates, 2);
        assert!(right(&found, &names) > 0.97, "{}", right(&found, &names));
        for step in &found.steps {
            // Two dates of 2 cm each.
            assert!((0.022..0.034).contains(&step.sigma_m.unwrap()), "{step:?}");
        }
        // One of twelve is missed.
        let missed = missed(&found.tracks, dates.len());
        assert!(missed[1..4].iter().all(|m| (0.05..0.12).contains(m)), "{missed:?}");
    }

    #[test]
    fn plants_that_are_gone_are_told_from_plants_that_were_missed() {
        // The first 40 plants are gone from the fourth date on, the next 40 are missed on the last date only.
        let (dates, names) = season(2, 0.01, 0.0, |k, date| {
            let gone = k < 40 && date >= 3;
            let missed = (40..80).contains(&k) && date == 4 || (k * 31 + date * 17) % 10 == 0;
            !(gone || missed)
        });
        let found = follow(&dates, 2);
        let mean = |range: std::ops::Range<usize>| {
            let of: Vec<f64> = found
                .tracks
                .iter()
                .filter(|t| {
                    range.contains(&names[t.first().unwrap()][t.seen[t.first().unwrap()].unwrap()])
                })
                .filter_map(|t| t.lost_probability)
                .collect();
            of.iter().sum::<f64>() / of.len() as f64
        };
        let (gone, missed) = (mean(0..40), mean(40..80));
        assert!(gone > 0.9 && missed < gone, "{gone} {missed}");
    }

    #[test]
    fn plants_that_come_late_are_new() {
        let (dates, _) = season(3, 0.01, 0.0, |k, date| k % 4 != 0 || date >= 2);
        let found = follow(&dates, 2);
        let late: Vec<&Track> = found.tracks.iter().filter(|t| t.first() == Some(2)).collect();
        assert_eq!(late.len(), 100);
        assert!(late.iter().all(|t| t.new_probability.unwrap() > 0.9));
        assert!(
            found
                .tracks
                .iter()
                .filter(|t| t.first() == Some(0))
                .all(|t| t.new_probability.is_none())
        );
    }

    #[test]
    fn plants_on_one_line_are_followed() {
        let row = |k: i32| Sighting { at_m: [0.0, 0.2 * f64::from(k)], plot: Some(0) };
        let date: Vec<Sighting> = (0..30).map(row).collect();
        let found = follow(&[date.clone(), date], 1);
        assert_eq!((found.tracks.len(), found.steps[0].matched), (30, 30));
    }

    #[test]
    fn dates_without_plants_are_no_failure() {
        let plant = Sighting { at_m: [1.0, 2.0], plot: None };
        assert!(follow(&[], 0).tracks.is_empty());
        assert!(follow(&[vec![], vec![]], 3).tracks.is_empty());
        let found = follow(&[vec![], vec![plant], vec![plant], vec![]], 0);
        assert!(!found.tracks.is_empty());
        assert_eq!(found.steps.len(), 3);
    }
}
