//! Places that the maps of two dates share: plants, which stay where they are.
//!
//! Soil changes its look with light and weather, leaves grow; the place of a plant does neither. Which plants are the same is not
//! known, so all differences of place vote:
//!
//! ```text
//! T(x) = c + d + s R(phi) (x - c)
//! coarse   max over (s, phi, d)   #{(i, j): |y_j - T(x_i)| in the same cell of d}
//! fine     (i, j) one another's nearest within r;  least squares over T;  r shrinks to three times the scatter
//! ```
//!
//! `x_i` and `y_j`: plants of the two dates, metres; `c` the middle of the plants that vote, the ones nearest to the middle of what both
//! maps show. Rows and an even spacing repeat, so another shift has votes too; where the runner-up has nearly as many as the
//! best, nothing is said (`MIN_LEAD`).
//!
//! Reference: the Hough transform, D. H. Ballard, Pattern Recognition 13, 1981; iterated closest points, P. J. Besl and N. D. McKay,
//! IEEE PAMI 14, 1992.

use crate::problems::map_transform::{self, MapTie, MapTransform};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Plants of the first date that vote.
const VOTERS: usize = 600;
/// Side of a cell of shifts, metres: a plant is located to a few centimetres.
const CELL_M: f64 = 0.06;
/// Maps of two receivers are turned and scaled against each other at most so far that the outermost plants move by this share of how far
/// maps may be apart: by 1 m where that is 5 m, which is 0.05 rad and 5 % over a field of 20 m.
const TURNED: f64 = 0.2;
/// And never by more than this, radians and share: on fields of 5 m (`rowgram synth season --preset tiny`) 0.052 rad and 4.9 % were found.
const MAX_TURN: f64 = 0.12;
/// Votes of the best shift over those of the best one elsewhere.
const MIN_LEAD: f64 = 1.25;
/// Shifts nearer than this to the best one are the same one, metres.
const SAME_SHIFT_M: f64 = 0.15;
/// Rounds of the fine search, and the radius that it begins with, metres.
const ROUNDS: usize = 8;
const FIRST_RADIUS_M: f64 = 0.15;
/// The radius shrinks no further than this, metres.
const MIN_RADIUS_M: f64 = 0.03;

/// Plants that stand at the same place on two maps, as pairs of places; empty where it cannot be told which they are. `search_m` is
/// how far the maps may be apart.
pub fn plant_ties(from_m: &[[f64; 2]], to_m: &[[f64; 2]], search_m: f64) -> Vec<MapTie> {
    let Some(coarse) = coarse(from_m, to_m, search_m) else { return Vec::new() };
    let grid = Grid::of(to_m, FIRST_RADIUS_M.max(CELL_M));
    let back = Grid::of(from_m, FIRST_RADIUS_M.max(CELL_M));
    let (mut similarity, mut radius_m) = (coarse, FIRST_RADIUS_M);
    let mut ties = Vec::new();
    for round in 0..ROUNDS {
        ties = mutual(from_m, to_m, &back, &grid, &similarity, radius_m);
        let Some(fit) = map_transform::fit(&ties) else { return Vec::new() };
        similarity = fit.transform;
        let wanted = (3.0 * fit.scatter_m).clamp(MIN_RADIUS_M, FIRST_RADIUS_M);
        if round > 0 && wanted >= radius_m {
            break;
        }
        radius_m = wanted;
    }
    ties
}

/// The similarity with most votes.
fn coarse(from_m: &[[f64; 2]], to_m: &[[f64; 2]], search_m: f64) -> Option<MapTransform> {
    let shared: Vec<[f64; 2]> = [bounds(from_m)?, bounds(to_m)?]
        .iter()
        .copied()
        .reduce(|a, b| [0, 1].map(|k| [a[k][0].max(b[k][0]), a[k][1].min(b[k][1])]))?
        .to_vec();
    let centre_m = [0, 1].map(|k| 0.5 * (shared[k][0] + shared[k][1]));
    let apart = |at: &[f64; 2]| (at[0] - centre_m[0]).hypot(at[1] - centre_m[1]);
    let mut voters = from_m.to_vec();
    voters.sort_by(|a, b| apart(a).total_cmp(&apart(b)));
    voters.truncate(VOTERS);
    if voters.len() < map_transform::LEAST_TIES {
        return None;
    }
    let reach_m = voters.last().map_or(0.0, apart).max(CELL_M);
    let near: Vec<[f64; 2]> =
        to_m.iter().copied().filter(|at| apart(at) < 1.1 * reach_m + search_m).collect();
    // Neighbouring rotations move the outermost voter by a cell.
    let most_m = (TURNED * search_m).min(MAX_TURN * reach_m);
    let steps = (most_m / CELL_M).ceil() as i64;
    let candidates: Vec<[f64; 2]> = (-steps..=steps)
        .flat_map(|s| (-steps..=steps).map(move |t| [s as f64, t as f64]))
        .map(|[s, t]| [s * CELL_M / reach_m, t * CELL_M / reach_m])
        .collect();
    let grid = Grid::of(&near, search_m);
    let votes: Vec<Votes> = candidates
        .par_iter()
        .map(|&[scale, rotation]| {
            let (shift_m, stretch) = ([0.0; 2], [0.0; 2]);
            let similarity = MapTransform { centre_m, shift_m, scale, rotation, stretch };
            votes(&voters, &near, &grid, similarity, search_m)
        })
        .collect();
    // The first of equals, whatever the number of threads.
    let best =
        votes.into_iter().reduce(|best, next| if next.most > best.most { next } else { best })?;
    let enough =
        best.most >= map_transform::LEAST_TIES as f64 && best.most >= MIN_LEAD * best.elsewhere;
    enough.then_some(best.transform)
}

/// What the differences of place say under one rotation and scale.
struct Votes {
    transform: MapTransform,
    /// Votes of the best shift, over a square of three cells a side.
    most: f64,
    /// Those of the best one that is another.
    elsewhere: f64,
}

fn votes(
    voters: &[[f64; 2]],
    near: &[[f64; 2]],
    grid: &Grid,
    similarity: MapTransform,
    search_m: f64,
) -> Votes {
    let half = (search_m / CELL_M).ceil() as i64 + 1;
    let side = (2 * half + 1) as usize;
    let mut cells = vec![0_u32; side * side];
    for &voter in voters {
        let at = similarity.apply(voter);
        grid.near(at, |k| {
            let [i, j] =
                [0, 1].map(|axis| ((near[k][axis] - at[axis]) / CELL_M).round() as i64 + half);
            if (1..side as i64 - 1).contains(&i) && (1..side as i64 - 1).contains(&j) {
                cells[j as usize * side + i as usize] += 1;
            }
        });
    }
    let sum = |i: usize, j: usize| -> u32 {
        (j - 1..=j + 1)
            .map(|row| cells[row * side + i - 1..=row * side + i + 1].iter().sum::<u32>())
            .sum()
    };
    let (mut most, mut at) = (0, [half as usize; 2]);
    let mut sums = vec![0_u32; side * side];
    for j in 1..side - 1 {
        for i in 1..side - 1 {
            let here = sum(i, j);
            sums[j * side + i] = here;
            if here > most {
                (most, at) = (here, [i, j]);
            }
        }
    }
    let apart = (SAME_SHIFT_M / CELL_M).ceil() as i64;
    let is_other = |k: usize| {
        let [i, j] = [k % side, k / side].map(|x| x as i64);
        (i - at[0] as i64).abs() > apart || (j - at[1] as i64).abs() > apart
    };
    let elsewhere = (0..side * side).filter(|&k| is_other(k)).map(|k| sums[k]).max().unwrap_or(0);
    let shift_m = at.map(|x| (x as i64 - half) as f64 * CELL_M);
    Votes {
        transform: MapTransform { shift_m, ..similarity },
        most: f64::from(most),
        elsewhere: f64::from(elsewhere),
    }
}

/// Pairs that are one another's nearest.
fn mutual(
    from_m: &[[f64; 2]],
    to_m: &[[f64; 2]],
    back: &Grid,
    grid: &Grid,
    similarity: &MapTransform,
    radius_m: f64,
) -> Vec<MapTie> {
    let nearest = |grid: &Grid, of: &[[f64; 2]], at: [f64; 2]| -> Option<usize> {
        let mut best: Option<(f64, usize)> = None;
        grid.near(at, |k| {
            let apart = (of[k][0] - at[0]).hypot(of[k][1] - at[1]);
            if apart < radius_m && best.is_none_or(|(least, other)| (apart, k) < (least, other)) {
                best = Some((apart, k));
            }
        });
        best.map(|(_, k)| k)
    };
    (0..from_m.len())
        .filter_map(|i| {
            let j = nearest(grid, to_m, similarity.apply(from_m[i]))?;
            let again = nearest(back, from_m, similarity.invert(to_m[j]))?;
            (again == i).then_some(MapTie { from_m: from_m[i], to_m: to_m[j] })
        })
        .collect()
}

/// Points by squares of the plane.
struct Grid {
    side_m: f64,
    cells: BTreeMap<[i64; 2], Vec<usize>>,
}

impl Grid {
    fn of(points: &[[f64; 2]], side_m: f64) -> Grid {
        let mut cells: BTreeMap<[i64; 2], Vec<usize>> = BTreeMap::new();
        for (k, at) in points.iter().enumerate() {
            cells.entry(at.map(|x| (x / side_m).floor() as i64)).or_default().push(k);
        }
        Grid { side_m, cells }
    }

    /// The points of the square that a place lies in and of those around it.
    fn near(&self, at: [f64; 2], mut each: impl FnMut(usize)) {
        let [i, j] = at.map(|x| (x / self.side_m).floor() as i64);
        for row in j - 1..=j + 1 {
            for column in i - 1..=i + 1 {
                self.cells.get(&[column, row]).into_iter().flatten().for_each(|&k| each(k));
            }
        }
    }
}

/// Lowest and highest of each axis; `None` without points.
fn bounds(points: &[[f64; 2]]) -> Option<[[f64; 2]; 2]> {
    let first = points.first()?;
    Some(points.iter().fold(first.map(|x| [x, x]), |bounds, at| {
        [0, 1].map(|k| [bounds[k][0].min(at[k]), bounds[k][1].max(at[k])])
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Rows 75 cm apart with a plant every 20 cm, off by up to `jitter` of that, some missing.
    fn field(jitter: f64, rng: &mut ChaCha8Rng) -> Vec<[f64; 2]> {
        let mut plants = Vec::new();
        for row in 0..16 {
            for k in 0..60 {
                let off = jitter * 0.2 * (2.0 * rng.random::<f64>() - 1.0);
                if rng.random::<f64>() > 0.08 {
                    plants.push([500.0 + 0.2 * f64::from(k) + off, 800.0 + 0.75 * f64::from(row)]);
                }
            }
        }
        plants
    }

    /// As another flight has them: moved, some not found, some that are none.
    fn seen(plants: &[[f64; 2]], by: &MapTransform, rng: &mut ChaCha8Rng) -> Vec<[f64; 2]> {
        let noise =
            move |rng: &mut ChaCha8Rng| 0.02 * (rng.random::<f64>() + rng.random::<f64>() - 1.0);
        let mut found = Vec::new();
        for &plant in plants {
            let at = by.apply(plant);
            if rng.random::<f64>() > 0.15 {
                found.push([at[0] + noise(rng), at[1] + noise(rng)]);
            }
            if rng.random::<f64>() < 0.05 {
                found.push([at[0] + 3.0 * rng.random::<f64>(), at[1] + 3.0 * rng.random::<f64>()]);
            }
        }
        found
    }

    #[test]
    fn a_field_is_found_again() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        for shift_m in [[0.8, -0.5], [-2.9, 1.7], [0.0, 0.0]] {
            let (centre_m, stretch) = ([505.0, 805.0], [0.0; 2]);
            let by = MapTransform { centre_m, shift_m, scale: 0.012, rotation: -0.02, stretch };
            let plants = field(0.5, &mut rng);
            let (a, b) =
                (seen(&plants, &MapTransform::IDENTITY, &mut rng), seen(&plants, &by, &mut rng));
            let ties = plant_ties(&a, &b, 4.0);
            assert!(
                ties.len() * 2 > plants.len(),
                "{shift_m:?}: {} of {}",
                ties.len(),
                plants.len()
            );
            let fit = map_transform::fit(&ties).unwrap();
            for plant in plants {
                let (found, wanted) = (fit.transform.apply(plant), by.apply(plant));
                let off = (found[0] - wanted[0]).hypot(found[1] - wanted[1]);
                assert!(off < 0.005, "{shift_m:?}: {off} m");
            }
        }
    }

    #[test]
    fn a_perfect_grid_says_nothing() {
        let mut plants = Vec::new();
        for row in 0..16 {
            plants.extend((0..60).map(|k| [0.2 * f64::from(k), 0.75 * f64::from(row)]));
        }
        let shifted: Vec<[f64; 2]> = plants.iter().map(|at| [at[0] + 0.31, at[1]]).collect();
        assert!(plant_ties(&plants, &shifted, 3.0).is_empty(), "one spacing further is as good");
        assert!(plant_ties(&plants[..5], &shifted, 3.0).is_empty());
        assert!(plant_ties(&[], &shifted, 3.0).is_empty());
    }

    #[test]
    fn another_field_has_no_ties() {
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let (a, b) = (field(0.5, &mut rng), field(0.5, &mut rng));
        assert!(plant_ties(&a, &b, 4.0).is_empty());
    }
}
