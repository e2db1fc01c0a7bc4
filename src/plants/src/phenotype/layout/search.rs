//! Where a plan may lie: the best shift and stretch on a lattice, and every other that is nearly as good.
//!
//! Rows repeat themselves, so least squares find the nearest row and not the right one. *Along*, with `n_b` plants in strips `b`
//! of the picture, planned occupancy `o` and a share `eps` of plants where none was planned,
//!
//! ```text
//! J(u, a) = - sum_b n_b ln(lambda_b / sum lambda),   lambda_b = v_b (o((s_b - u) / (1 + a)) + eps)
//! ```
//!
//! (`v_b`: the part of the strip that the picture shows). *Across*, with the distance `x` of each piece of a found row from the
//! nearest row of the plan in quarters of the row spacing,
//!
//! ```text
//! J(v, b) = nats_per_row / (pieces of a row) * [ sum_pieces min(1, x^2) + planned pieces without a found one ]
//! ```
//!
//! so that rows without a plan and plans without a row count alike: outer rows fix the row offset. Both have the
//! priors of shift and stretch added, are in nats, and so differences are logarithms of odds.

use super::{
    Plan,
    observed::{FoundRows, Lookup},
};
use crate::problems::plot_layout::{AFFINE, Placement};

/// Plants stand where none was planned with this share of the density within plots.
const STRAY: f64 = 0.02;
/// Strips along, metres.
const STRIP_M: f64 = 0.05;
/// What a row that was planted and not found, or found and not planted, counts: odds of 1 to 55.
const NATS_PER_ROW: f64 = 4.0;
/// Shifts and stretches are tried to so many standard deviations.
const REACH: f64 = 3.0;
/// Length of the pieces that are compared, metres.
const PIECE_M: f64 = 2.0;
/// Steps of a lattice to either side, at most.
const MAX_STEPS: f64 = 400.0;

/// Standard deviations of what is known beforehand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reach {
    /// Of the shift, metres.
    pub position_m: f64,
    /// Of the stretches.
    pub stretch: f64,
}

/// A place where the plan may lie.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// Shift along or across the rows, metres.
    pub shift_m: f64,
    /// Stretch.
    pub stretch: f64,
    /// Negative logarithm of its probability, up to a constant.
    pub cost: f64,
}

/// Where the plan may lie, best first.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidates {
    /// Along the rows.
    pub along: Vec<Candidate>,
    /// Across the rows.
    pub across: Vec<Candidate>,
}

/// Finds where the plan may lie, its rows having turned by `turn_rad` against `about`.
pub fn search(
    found: &FoundRows,
    plan: &Plan,
    lookup: &Lookup,
    about: &Placement,
    turn_rad: f64,
    reach: &Reach,
    is_visible: &dyn Fn([f64; 2]) -> bool,
) -> Candidates {
    let nominal = Placement::nominal(about.origin_m, about.heading_rad, about.half_length_m);
    let (sin, cos) = turn_rad.sin_cos();
    let turned = |q: &[f64; 2]| [cos * q[0] + sin * q[1], cos * q[1] - sin * q[0]];
    let sees = |[s, t]: [f64; 2]| is_visible(nominal.map([cos * s - sin * t, sin * s + cos * t]));
    // The shift of `about` in the turned axes; candidates are shifts from there.
    let start = turned(&[about.affine[0], about.affine[1]]);
    let rows: Vec<Vec<[f64; 2]>> =
        found.rows.iter().map(|row| row.iter().map(turned).collect()).collect();
    let of = |stretch: f64| Lattice { reach: *reach, about_stretch: stretch };
    let along = along(&rows, plan, lookup, start[0], &of(about.affine[3]), &sees);
    let best = along.first().copied().unwrap_or(Candidate {
        shift_m: 0.0,
        stretch: about.affine[3],
        cost: 0.0,
    });
    let place = (start[0] + best.shift_m, best.stretch);
    let across = across(&rows, plan, lookup, (place, start[1]), &of(about.affine[4]), &sees);
    Candidates { along, across }
}

/// The affine numbers of a pair of candidates.
pub fn affine_of(
    about: &Placement,
    turn_rad: f64,
    along: &Candidate,
    across: &Candidate,
) -> [f64; AFFINE] {
    let (sin, cos) = turn_rad.sin_cos();
    // The shift of the start in the turned axes, moved, and back.
    let [u, v] = [about.affine[0], about.affine[1]];
    let s = cos * u + sin * v + along.shift_m;
    let t = cos * v - sin * u + across.shift_m;
    let shear = about.affine[5];
    [cos * s - sin * t, sin * s + cos * t, turn_rad, along.stretch, across.stretch, shear]
}

struct Lattice {
    reach: Reach,
    about_stretch: f64,
}

impl Lattice {
    /// Shifts in steps; stretches so that the ends of a field of this half length move by a step.
    fn nodes(&self, step_m: f64, half_m: f64) -> (Vec<f64>, Vec<f64>) {
        let steps = |limit: f64, step: f64| -> Vec<f64> {
            let count = (limit / step).ceil().clamp(1.0, MAX_STEPS);
            (-(count as i64)..=count as i64).map(|k| k as f64 * limit / count).collect()
        };
        let shifts = steps(REACH * self.reach.position_m, step_m);
        let stretches = steps(REACH * self.reach.stretch, step_m / half_m.max(step_m));
        (shifts, stretches.into_iter().map(|a| self.about_stretch + a).collect())
    }

    fn prior(&self, shift_m: f64, stretch: f64) -> f64 {
        let (u, a) =
            (shift_m / self.reach.position_m, (stretch - self.about_stretch) / self.reach.stretch);
        0.5 * (u * u + a * a)
    }

    /// For every shift its best stretch; of these the local minima, best first.
    fn minima(
        &self,
        (shifts, stretches): (&[f64], &[f64]),
        cost: impl Fn(f64, f64) -> f64,
    ) -> Vec<Candidate> {
        let best = |&shift_m: &f64| {
            let of = |&stretch: &f64| {
                let cost = cost(shift_m, stretch) + self.prior(shift_m, stretch);
                Candidate { shift_m, stretch, cost }
            };
            stretches.iter().map(of).min_by(|a, b| a.cost.total_cmp(&b.cost))
        };
        let profile: Vec<Candidate> = shifts.iter().filter_map(best).collect();
        let cost = |k: usize| profile.get(k).map_or(f64::INFINITY, |node| node.cost);
        let mut minima: Vec<Candidate> = (0..profile.len())
            .filter(|&k| cost(k) < cost(k.wrapping_sub(1)) && cost(k) <= cost(k + 1))
            .map(|k| profile[k])
            .collect();
        minima.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        minima
    }
}

fn along(
    rows: &[Vec<[f64; 2]>],
    plan: &Plan,
    lookup: &Lookup,
    start_m: f64,
    lattice: &Lattice,
    sees: &dyn Fn([f64; 2]) -> bool,
) -> Vec<Candidate> {
    let [[s0, s1], [t0, t1]] = plan.extent();
    let half_m = 0.5 * (s1 - s0);
    let (shifts, stretches) = lattice.nodes(STRIP_M, half_m);
    let plants = || rows.iter().flatten();
    let spare = REACH * (lattice.reach.position_m + half_m * lattice.reach.stretch) + 1.0;
    let low = plants().map(|q| q[0]).fold(start_m + s0 - spare, f64::min);
    let high = plants().map(|q| q[0]).fold(start_m + s1 + spare, f64::max);
    let strips = ((high - low) / STRIP_M).ceil() as usize + 1;
    let mut counts = vec![0.0; strips];
    for q in plants() {
        counts[((q[0] - low) / STRIP_M) as usize] += 1.0;
    }
    let middle = |strip: usize| low + (strip as f64 + 0.5) * STRIP_M;
    /// Places across at which a strip is looked at.
    const ACROSS: usize = 16;
    let visible: Vec<f64> = (0..strips)
        .map(|strip| {
            let at = |k: usize| t0 + (k as f64 + 0.5) / ACROSS as f64 * (t1 - t0);
            (0..ACROSS).filter(|&k| sees([middle(strip), at(k)])).count() as f64 / ACROSS as f64
        })
        .collect();
    let occupied = occupancy(lookup, s0, s1);
    let planned = |s: f64| {
        let at = (s - s0) / STRIP_M;
        if at < 0.0 { 0.0 } else { occupied.get(at as usize).copied().unwrap_or(0.0) }
    };
    let total: f64 = counts.iter().sum();
    lattice.minima((&shifts, &stretches), |shift_m, stretch| {
        let (mut sum, mut logs) = (0.0, 0.0);
        for strip in (0..strips).filter(|&strip| visible[strip] > 0.0) {
            let s = (middle(strip) - start_m - shift_m) / (1.0 + stretch);
            let density = visible[strip] * (planned(s) + STRAY);
            sum += density;
            if counts[strip] > 0.0 {
                logs += counts[strip] * density.ln();
            }
        }
        total * sum.max(f64::MIN_POSITIVE).ln() - logs
    })
}

/// The share of the rows of the plan that reach each strip.
fn occupancy(lookup: &Lookup, s0: f64, s1: f64) -> Vec<f64> {
    let mut occupied = vec![0.0; ((s1 - s0) / STRIP_M).ceil() as usize + 1];
    for (_, row) in &lookup.rows {
        let strip = |s: f64| (((s - s0) / STRIP_M).round() as usize).min(occupied.len());
        let (from, to) = (strip(row.ends[0][0]), strip(row.ends[1][0]));
        occupied[from..to].iter_mut().for_each(|share| *share += 1.0);
    }
    let most = occupied.iter().copied().fold(1.0, f64::max);
    occupied.iter_mut().for_each(|share| *share /= most);
    occupied
}

fn across(
    rows: &[Vec<[f64; 2]>],
    plan: &Plan,
    lookup: &Lookup,
    ((along_m, along_stretch), start_m): ((f64, f64), f64),
    lattice: &Lattice,
    sees: &dyn Fn([f64; 2]) -> bool,
) -> Vec<Candidate> {
    let [[s0, s1], [t0, t1]] = plan.extent();
    let quarter_m = 0.25 * plan.row_spacing_m;
    let (shifts, stretches) = lattice.nodes(0.5 * quarter_m, 0.5 * (t1 - t0));
    let pieces: Vec<[f64; 2]> = rows.iter().flat_map(|row| pieces(row)).collect();
    let per_row = ((s1 - s0) / PIECE_M).max(1.0);
    lattice.minima((&shifts, &stretches), |shift_m, stretch| {
        let mut misfit = 0.0;
        let mut hits = vec![0.0; lookup.rows.len()];
        for q in &pieces {
            let s = (q[0] - along_m) / (1.0 + along_stretch);
            let t = (q[1] - start_m - shift_m) / (1.0 + stretch);
            let Some((index, off)) = lookup.nearest([s, t]) else { continue };
            let x = off / quarter_m;
            misfit += (x * x).min(1.0);
            if x.abs() < 1.0 {
                hits[index] += 1.0;
            }
        }
        for ((_, row), hits) in lookup.rows.iter().zip(&hits) {
            let [from, to] = row.ends;
            let pieces = (to[0] - from[0]) / PIECE_M;
            let at = |share: f64| {
                let s = from[0] + share * (to[0] - from[0]);
                let t = row.across(s);
                [along_m + (1.0 + along_stretch) * s, start_m + shift_m + (1.0 + stretch) * t]
            };
            let shown = [0.1, 0.5, 0.9].iter().filter(|&&share| sees(at(share))).count();
            // Half of the pieces are enough: gaps happen.
            let lacking = (1.0 - 2.0 * hits / pieces).max(0.0);
            misfit += lacking * pieces * shown as f64 / 3.0;
        }
        NATS_PER_ROW * misfit / per_row
    })
}

/// Mean positions of the plants of a row by pieces along.
fn pieces(row: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let mut pieces: Vec<([f64; 2], f64, i64)> = Vec::new();
    for q in row {
        let piece = (q[0] / PIECE_M).floor() as i64;
        match pieces.last_mut().filter(|last| last.2 == piece) {
            Some((sum, count, _)) => {
                (sum[0], sum[1]) = (sum[0] + q[0], sum[1] + q[1]);
                *count += 1.0;
            }
            None => pieces.push((*q, 1.0, piece)),
        }
    }
    pieces.into_iter().map(|(sum, count, _)| sum.map(|x| x / count)).collect()
}
