//! Bridges: which ends of segments belong to one leaf, across a crossing or a gap in the slices.
//!
//! From an end `e` with the outward direction `d_e` the leaf is looked for along `d_e`. The ends `e`, `f`
//! of two segments can be one leaf where, with the gap `g = f - e`, the signed turns
//!
//! ```text
//! a = angle from d_e to g,      b = angle from g to -d_f,      |a| < T_c,  |b| < T_c,  |a + b| < T_c,
//! ```
//!
//! are small, the gap is not longer than a limit, and what lies in it is plant. Every end is in one
//! bridge at most. [`Bridging::Greedy`] takes the shortest gap first, as a search from each end would;
//! ties go to the pair found first. [`Bridging::Global`] weighs all gaps of a part at once: it takes the
//! matching of the largest sum of `most - cost`,
//!
//! ```text
//! cost = |g| / limit  +  (a^2 - a b + b^2) / T_c^2  +  (log2 w_e/w_f)^2 / 2  +  8 min(t_e, t_f)  +  (1 - c) |g| / (2 (|g| + w)),
//! ```
//!
//! where the second term is the bending energy of the cubic curve that continues both directions
//! (Hermite, slopes `-a` and `b` against the chord) and the third that of a width that changes. `t = log2
//! (w_inner/w)` is how much a segment narrows towards its end: a leaf that passes under another one does not narrow
//! on both sides of it, but two leaves of a plant do where their bases meet. `c` is the share of the gap that shows
//! another segment: the leaf that crosses.
//!
//! Reference: J. Edmonds, "Paths, trees, and flowers", 1965; Z. Galil, ACM Computing Surveys 18, 1986 (matching).

use super::{
    Bridging,
    axis::{End, distance},
    part::Local,
    segments::{NONE, Segment},
    slices::turn,
};
use rowgram_base::disjoint_sets::DisjointSets;

/// Share of a gap that must be plant.
const COVERED: f64 = 0.7;
/// What may be bridged.
pub(super) struct Rules {
    pub(super) t_c: f64,
    pub(super) limit_px: f64,
    pub(super) bridging: Bridging,
    pub(super) curvature: bool,
    /// Cost from which two ends are better left alone.
    pub(super) most: f64,
}

/// A bridge between the ends `2 segment + last` of two segments.
#[derive(Debug, Clone, Copy)]
struct Gap {
    ends: [usize; 2],
    length: f64,
    cost: f64,
}

/// The segment of each local pixel, by its number.
pub(super) struct Owners<'a> {
    pub(super) number: &'a [u32],
    pub(super) of: &'a [u32],
}

/// Leaves as chains of segments: `(segment, reversed)`, in the order along the leaf.
pub(super) fn chains(
    local: &Local,
    owners: &Owners<'_>,
    segments: &[Segment],
    rules: &Rules,
) -> Vec<Vec<(usize, bool)>> {
    let mut partner = vec![None; 2 * segments.len()];
    if rules.bridging != Bridging::None {
        let gaps = gaps(local, owners, segments, rules);
        for gap in choose(gaps, rules, 2 * segments.len()) {
            partner[gap.ends[0]] = Some(gap.ends[1]);
            partner[gap.ends[1]] = Some(gap.ends[0]);
        }
    }
    let mut seen = vec![false; segments.len()];
    let mut chains = Vec::new();
    for start in 0..segments.len() {
        if seen[start] {
            continue;
        }
        // Back to where the chain begins, or once around a ring.
        let mut end = 2 * start;
        while let Some(previous) = partner[end] {
            end = previous ^ 1;
            if end == 2 * start {
                break;
            }
        }
        let mut chain = Vec::new();
        loop {
            let segment = end / 2;
            if seen[segment] {
                break;
            }
            seen[segment] = true;
            chain.push((segment, end % 2 == 1));
            match partner[end ^ 1] {
                Some(next) => end = next,
                None => break,
            }
        }
        chains.push(chain);
    }
    chains
}

/// All gaps that the rules allow, by their ends.
fn gaps(local: &Local, owners: &Owners<'_>, segments: &[Segment], rules: &Rules) -> Vec<Gap> {
    let ends: Vec<End> =
        segments.iter().flat_map(|s| [s.axis.end(false), s.axis.end(true)]).collect();
    // Sorted by column, so that only ends within the limit are looked at.
    let mut order: Vec<usize> = (0..ends.len()).collect();
    order.sort_by(|&a, &b| ends[a].at[0].total_cmp(&ends[b].at[0]).then(a.cmp(&b)));
    let mut found = Vec::new();
    for (i, &one) in order.iter().enumerate() {
        for &other in &order[i + 1..] {
            if ends[other].at[0] - ends[one].at[0] > rules.limit_px {
                break;
            }
            let pair = [one.min(other), one.max(other)];
            if pair[0] / 2 != pair[1] / 2
                && let Some(gap) = gap(local, owners, pair, &ends[pair[0]], &ends[pair[1]], rules)
            {
                found.push(gap);
            }
        }
    }
    found.sort_by_key(|gap| gap.ends);
    found
}

fn gap(
    local: &Local,
    owners: &Owners<'_>,
    ends: [usize; 2],
    e: &End,
    f: &End,
    rules: &Rules,
) -> Option<Gap> {
    let length = distance(e.at, f.at);
    if length > rules.limit_px {
        return None;
    }
    let angle = |d: [f64; 2]| d[1].atan2(d[0]);
    let (from, to) = (angle(e.outward), angle([-f.outward[0], -f.outward[1]]));
    // Ends that touch or overlap by a front have no gap with a direction of its own.
    let (a, b) = if length < 2.0 {
        let half = 0.5 * signed(to - from);
        (half, half)
    } else {
        let along = angle([f.at[0] - e.at[0], f.at[1] - e.at[1]]);
        (signed(along - from), signed(to - along))
    };
    let t_c = rules.t_c;
    if a.abs() >= t_c || b.abs() >= t_c || turn(from, to) >= t_c {
        return None;
    }
    let samples = (2.0 * length).ceil() as usize + 1;
    let (mut covered, mut crossed) = (0, 0);
    for i in 0..samples {
        let t = (i as f64 + 0.5) / samples as f64;
        let at: [f64; 2] = std::array::from_fn(|k| e.at[k] + t * (f.at[k] - e.at[k]));
        if let Some(pixel) = local.pixel(at) {
            let owner = owners.of[owners.number[pixel as usize] as usize];
            covered += 1;
            let other = owner != NONE && !ends.iter().any(|&end| end / 2 == owner as usize);
            crossed += usize::from(other);
        }
    }
    if f64::from(covered) < COVERED * samples as f64 {
        return None;
    }
    let bend = if rules.curvature { (a * a - a * b + b * b) / (t_c * t_c) } else { 0.0 };
    let wider = (e.width / f.width).log2();
    let narrows = 8.0 * e.narrows.min(f.narrows).max(0.0);
    let uncrossed = 1.0 - crossed as f64 / samples as f64;
    let open = 0.5 * uncrossed * length / (length + 0.5 * (e.width + f.width));
    let cost = length / rules.limit_px + bend + 0.5 * wider * wider + narrows + open;
    Some(Gap { ends, length, cost })
}

fn signed(angle: f64) -> f64 {
    let turn = std::f64::consts::TAU;
    (angle + 0.5 * turn).rem_euclid(turn) - 0.5 * turn
}

/// The gaps that are bridged.
fn choose(mut gaps: Vec<Gap>, rules: &Rules, ends: usize) -> Vec<Gap> {
    if rules.bridging == Bridging::Greedy {
        gaps.sort_by(|a, b| a.length.total_cmp(&b.length).then(a.ends.cmp(&b.ends)));
        let mut taken = vec![false; ends];
        gaps.retain(|gap| {
            let free = !taken[gap.ends[0]] && !taken[gap.ends[1]];
            for end in gap.ends {
                taken[end] |= free;
            }
            free
        });
        return gaps;
    }
    gaps.retain(|gap| gap.cost < rules.most);
    groups(&gaps, ends).into_iter().flat_map(|group| heaviest(&group, rules.most)).collect()
}

/// Gaps that share no end do not compete: one group for each connected set of them.
fn groups(gaps: &[Gap], ends: usize) -> Vec<Vec<Gap>> {
    let mut sets = DisjointSets::new(ends);
    for gap in gaps {
        sets.join(gap.ends[0], gap.ends[1]);
    }
    let mut groups: std::collections::BTreeMap<usize, Vec<Gap>> = Default::default();
    for gap in gaps {
        groups.entry(sets.root(gap.ends[0])).or_default().push(*gap);
    }
    groups.into_values().collect()
}

/// The matching of the largest weight.
fn heaviest(group: &[Gap], most: f64) -> Vec<Gap> {
    if group.len() == 1 {
        return group.to_vec();
    }
    let mut names: Vec<usize> = group.iter().flat_map(|gap| gap.ends).collect();
    names.sort_unstable();
    names.dedup();
    let place = |end: usize| names.binary_search(&end).unwrap_or(0);
    // The solver counts in whole numbers; a millionth of a cost decides nothing.
    let edges: Vec<(usize, usize, i32)> = group
        .iter()
        .map(|gap| {
            let weight = ((most - gap.cost) * 1e6).round() as i32;
            (place(gap.ends[0]), place(gap.ends[1]), weight)
        })
        .collect();
    let mates = mwmatching::Matching::new(edges).solve();
    let matched =
        |gap: &&Gap| mates.get(place(gap.ends[0])).is_some_and(|&mate| mate == place(gap.ends[1]));
    group.iter().filter(matched).copied().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;
    use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

    const MAX_BRIDGE_COST: f64 = 0.8;

    fn rules(bridging: Bridging) -> Rules {
        Rules { t_c: 0.5, limit_px: 9.0, bridging, curvature: true, most: MAX_BRIDGE_COST }
    }

    fn weight(gaps: &[Gap]) -> f64 {
        gaps.iter().map(|gap| MAX_BRIDGE_COST - gap.cost).sum()
    }

    /// The heaviest matching by trying all of them.
    fn exhaustive(gaps: &[Gap], taken: &mut Vec<usize>) -> f64 {
        let Some((first, rest)) = gaps.split_first() else { return 0.0 };
        let without = exhaustive(rest, taken);
        if first.ends.iter().any(|end| taken.contains(end)) {
            return without;
        }
        taken.extend(first.ends);
        let with = MAX_BRIDGE_COST - first.cost + exhaustive(rest, taken);
        taken.truncate(taken.len() - 2);
        without.max(with)
    }

    #[test]
    fn the_global_choice_is_the_best_of_all_and_the_greedy_one_need_not_be() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut greedy_lost = 0;
        for _ in 0..200 {
            let mut gaps = Vec::new();
            for a in 0..7usize {
                for b in a + 1..7 {
                    if rng.random_range(0..2) == 0 {
                        let cost = rng.random_range(0.0..3.0 * MAX_BRIDGE_COST);
                        gaps.push(Gap { ends: [a, b], length: cost, cost });
                    }
                }
            }
            let best = exhaustive(&gaps, &mut Vec::new());
            let global = weight(&choose(gaps.clone(), &rules(Bridging::Global), 7));
            assert!((best - global).abs() < 1e-4, "{best} {global}");
            let greedy = weight(&choose(gaps, &rules(Bridging::Greedy), 7));
            assert!(greedy <= best + 1e-9);
            greedy_lost += usize::from(greedy < best - 1e-3);
        }
        assert!(greedy_lost > 10, "{greedy_lost}");
    }
}
