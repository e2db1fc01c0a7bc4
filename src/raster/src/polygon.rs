//! Polygons over a raster: which pixels lie in one.
//!
//! A pixel belongs to a polygon if its centre lies inside by the even-odd rule (holes are rings like others, in either
//! sense). A centre on a side belongs to the polygon on one side of it only, so that neighbouring plots
//! share no pixel and leave none out.

use std::ops::Range;

/// Closed rings of `[u, v]`, pixels; the last point joins the first.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Polygon {
    /// The rings, outer ones and holes.
    pub rings: Vec<Vec<[f64; 2]>>,
}

impl Polygon {
    /// Its sides from the lower to the upper end, in the order of their lower ends; level ones are left out.
    fn sides(&self) -> Vec<Side> {
        let sides = |ring: &Vec<[f64; 2]>| {
            let n = ring.len();
            let ends = (0..n).map(|i| (ring[i], ring[(i + 1) % n])).collect::<Vec<_>>();
            // From the lower to the upper end, so that both neighbours of a side compute the same.
            ends.into_iter().filter_map(|(a, b)| match a[1].partial_cmp(&b[1])? {
                std::cmp::Ordering::Less => Some(Side { from: a, to: b }),
                std::cmp::Ordering::Greater => Some(Side { from: b, to: a }),
                std::cmp::Ordering::Equal => None,
            })
        };
        let mut sides: Vec<Side> = self.rings.iter().flat_map(sides).collect();
        sides.sort_by(|a, b| a.from[1].total_cmp(&b.from[1]));
        sides
    }

    /// The least and the greatest coordinates; `None` without a point.
    pub fn bounds(&self) -> Option<[[f64; 2]; 2]> {
        let mut points = self.rings.iter().flatten();
        let first = *points.next()?;
        Some(points.fold([first; 2], |[low, high], at| {
            [[0, 1].map(|k| at[k].min(low[k])), [0, 1].map(|k| at[k].max(high[k]))]
        }))
    }

    /// The pixels inside, as columns of each row, within a raster of `width` columns and `height` rows.
    pub fn runs(&self, width: usize, height: usize) -> Vec<(usize, Range<usize>)> {
        let Some([[_, low], [_, high]]) = self.bounds() else { return Vec::new() };
        if !(low.is_finite() && high.is_finite()) {
            return Vec::new();
        }
        let mut runs = Vec::new();
        let mut sweep = Sweep::new(self.sides());
        let mut crossings = Vec::new();
        // A conversion to usize saturates at both ends.
        for v in low.ceil().max(0.0) as usize..((high.floor() + 1.0).max(0.0) as usize).min(height)
        {
            crossings.clear();
            crossings.extend(sweep.crossings(v as f64));
            crossings.sort_by(f64::total_cmp);
            for pair in crossings.chunks_exact(2) {
                let start = pair[0].ceil().max(0.0) as usize;
                let end = (pair[1].ceil().max(0.0) as usize).min(width);
                if start < end {
                    runs.push((v, start..end));
                }
            }
        }
        runs
    }

    /// Which of some positions lie inside, by the same rule, in their order.
    pub fn inside(&self, positions: &[[f64; 2]]) -> Vec<usize> {
        Positions::new(positions.iter().copied()).inside(self)
    }

    /// How many pixels lie inside of it, on a raster without edges.
    pub fn pixels(&self) -> usize {
        let points = || self.rings.iter().flatten();
        let bound = |axis: usize| {
            let low = points().map(|at| at[axis]).fold(f64::INFINITY, f64::min).floor();
            let high = points().map(|at| at[axis]).fold(f64::NEG_INFINITY, f64::max);
            (low, (high - low + 2.0) as usize)
        };
        let ((u, width), (v, height)) = (bound(0), bound(1));
        let ring = |ring: &Vec<[f64; 2]>| ring.iter().map(|at| [at[0] - u, at[1] - v]).collect();
        let shifted = Polygon { rings: self.rings.iter().map(ring).collect() };
        shifted.runs(width, height).iter().map(|(_, run)| run.len()).sum()
    }

    /// Its parts, each an outer ring and the holes in it, where holes come after the ring that they are in.
    pub fn parts(&self) -> Vec<Polygon> {
        let mut parts = Vec::<Polygon>::new();
        for ring in &self.rings {
            // Rings may touch at corners and along sides, so most of its sides decide.
            let next = ring.iter().cycle().skip(1);
            let middle = |(a, b): (&[f64; 2], &[f64; 2])| [0, 1].map(|k| 0.5 * (a[k] + b[k]));
            let middles: Vec<[f64; 2]> = ring.iter().zip(next).map(middle).collect();
            let is_hole = |part: &&mut Polygon| 2 * part.inside(&middles).len() > middles.len();
            match parts.iter_mut().find(is_hole) {
                Some(part) => part.rings.push(ring.clone()),
                None => parts.push(Polygon { rings: vec![ring.clone()] }),
            }
        }
        parts
    }

    /// Where two sides of a ring cross each other, as those of a bow tie do; rings that only touch themselves do not cross.
    pub fn crossing(&self) -> Option<[f64; 2]> {
        self.rings.iter().find_map(|ring| Chain { ring }.crossing_within(0..ring.len()))
    }

    /// Whether all its points lie on one line.
    pub fn is_flat(&self) -> bool {
        let Some(first) = self.rings.first().and_then(|ring| ring.first()) else { return true };
        let points = || self.rings.iter().flatten().map(|at| [at[0] - first[0], at[1] - first[1]]);
        let longest = points().map(|at| at[0].hypot(at[1])).fold(0.0, f64::max);
        let far = points().find(|at| at[0].hypot(at[1]) == longest).unwrap_or_default();
        // A millionth of its length beside the line is rounding, whatever the unit.
        points().all(|at| (at[0] * far[1] - at[1] * far[0]).abs() <= 1e-6 * longest * longest)
    }
}

/// A side from its lower to its upper end.
#[derive(Debug, Clone, Copy)]
struct Side {
    from: [f64; 2],
    to: [f64; 2],
}

/// The sides of a polygon that a level line crosses, while it rises.
struct Sweep {
    /// Sides that it has not reached, the next one last.
    ahead: Vec<Side>,
    reached: Vec<Side>,
}

impl Sweep {
    fn new(mut sides: Vec<Side>) -> Sweep {
        sides.reverse();
        Sweep { ahead: sides, reached: Vec::new() }
    }

    /// Where the line at `y` crosses sides; `y` never falls.
    fn crossings(&mut self, y: f64) -> impl Iterator<Item = f64> + '_ {
        while let Some(side) = self.ahead.pop_if(|side| side.from[1] <= y) {
            self.reached.push(side);
        }
        self.reached.retain(|side| side.to[1] > y);
        self.reached.iter().map(move |Side { from, to }| {
            from[0] + (y - from[1]) / (to[1] - from[1]) * (to[0] - from[0])
        })
    }
}

/// Positions in the order of their rows, so that each of many polygons looks at those of its own rows only.
pub struct Positions {
    at: Vec<[f64; 2]>,
    order: Vec<usize>,
}

impl Positions {
    /// Sorts them; those that are no numbers lie in no polygon.
    pub fn new(at: impl IntoIterator<Item = [f64; 2]>) -> Positions {
        let at: Vec<[f64; 2]> = at.into_iter().collect();
        let mut order: Vec<usize> =
            (0..at.len()).filter(|&k| at[k].iter().all(|x| x.is_finite())).collect();
        order.sort_by(|&a, &b| at[a][1].total_cmp(&at[b][1]));
        Positions { at, order }
    }

    /// Those inside of a polygon, in the order in which they were given.
    pub fn inside(&self, polygon: &Polygon) -> Vec<usize> {
        let Some([low, high]) = polygon.bounds() else { return Vec::new() };
        let first = self.order.partition_point(|&k| self.at[k][1] < low[1]);
        let end = self.order.partition_point(|&k| self.at[k][1] <= high[1]);
        let mut sweep = Sweep::new(polygon.sides());
        let mut found = Vec::new();
        for &k in self.order.get(first..end).unwrap_or_default() {
            let [u, v] = self.at[k];
            if u < low[0] || u > high[0] {
                continue;
            }
            if sweep.crossings(v).filter(|&crossing| u >= crossing).count() % 2 == 1 {
                found.push(k);
            }
        }
        found.sort_unstable();
        found
    }
}

/// The sides of a ring as a chain, whose parts meet only where the boxes around them do.
struct Chain<'a> {
    ring: &'a [[f64; 2]],
}

/// The box around some sides: least and greatest coordinates.
type Bounds = [[f64; 2]; 2];

impl Chain<'_> {
    fn side(&self, k: usize) -> ([f64; 2], [f64; 2]) {
        (self.ring[k], self.ring[(k + 1) % self.ring.len()])
    }

    /// The boxes of the halves of a range, of their halves, and so on.
    fn tree(&self, sides: Range<usize>) -> Node {
        if sides.len() <= LEAF_SIDES {
            let ends = sides.clone().flat_map(|k| {
                let (a, b) = self.side(k);
                [a, b]
            });
            let bounds =
                ends.fold([[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]], |[low, high], at| {
                    [[0, 1].map(|k| at[k].min(low[k])), [0, 1].map(|k| at[k].max(high[k]))]
                });
            return Node { bounds, sides, halves: None };
        }
        let middle = sides.start + sides.len() / 2;
        let halves = [self.tree(sides.start..middle), self.tree(middle..sides.end)];
        let [a, b] = [halves[0].bounds, halves[1].bounds];
        let bounds = [[0, 1].map(|k| a[0][k].min(b[0][k])), [0, 1].map(|k| a[1][k].max(b[1][k]))];
        Node { bounds, sides, halves: Some(Box::new(halves)) }
    }

    fn crossing_within(&self, sides: Range<usize>) -> Option<[f64; 2]> {
        let tree = self.tree(sides);
        self.crossing_of(&tree, &tree)
    }

    fn crossing_of(&self, a: &Node, b: &Node) -> Option<[f64; 2]> {
        let apart =
            (0..2).any(|k| a.bounds[1][k] < b.bounds[0][k] || b.bounds[1][k] < a.bounds[0][k]);
        if apart {
            return None;
        }
        let is_same = a.sides == b.sides;
        match (&a.halves, &b.halves) {
            (Some(of), Some(_)) if is_same => {
                let [first, second] = of.as_ref();
                self.crossing_of(first, first)
                    .or_else(|| self.crossing_of(second, second))
                    .or_else(|| self.crossing_of(first, second))
            }
            (Some(of), _) if a.sides.len() >= b.sides.len() => {
                of.iter().find_map(|half| self.crossing_of(half, b))
            }
            (_, Some(of)) => of.iter().find_map(|half| self.crossing_of(a, half)),
            (Some(of), None) => of.iter().find_map(|half| self.crossing_of(half, b)),
            (None, None) => a.sides.clone().find_map(|i| {
                let others = if is_same { i + 1..b.sides.end } else { b.sides.clone() };
                others.into_iter().find_map(|j| meet(self.side(i), self.side(j)))
            }),
        }
    }
}

/// Some sides, the box around them, and their halves.
struct Node {
    bounds: Bounds,
    sides: Range<usize>,
    halves: Option<Box<[Node; 2]>>,
}

/// Sides that are compared one by one.
const LEAF_SIDES: usize = 8;

/// The place where two sides cross, strictly within both.
fn meet((a, b): ([f64; 2], [f64; 2]), (c, d): ([f64; 2], [f64; 2])) -> Option<[f64; 2]> {
    let cross = |o: [f64; 2], p: [f64; 2], q: [f64; 2]| {
        (p[0] - o[0]) * (q[1] - o[1]) - (p[1] - o[1]) * (q[0] - o[0])
    };
    let (of_c, of_d) = (cross(a, b, c), cross(a, b, d));
    let (of_a, of_b) = (cross(c, d, a), cross(c, d, b));
    if of_c * of_d >= 0.0 || of_a * of_b >= 0.0 {
        return None;
    }
    let share = of_a / (of_a - of_b);
    Some([0, 1].map(|axis| a[axis] + share * (b[axis] - a[axis])))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn count(polygon: &Polygon) -> usize {
        polygon.runs(100, 100).iter().map(|(_, run)| run.len()).sum()
    }

    #[test]
    fn parts_have_their_holes() {
        let square = |low: f64, side: f64| {
            let high = low + side;
            vec![[low, 0.5 * low], [high, 0.5 * low], [high, high], [low, high]]
        };
        // A hole, a part in it, a hole in that, and a part that shares a side with the first.
        let beside = vec![[90.0, 0.0], [99.0, 0.0], [99.0, 90.0], [90.0, 90.0]];
        let rings = vec![
            square(0.0, 90.0),
            square(10.0, 60.0),
            square(20.0, 40.0),
            square(30.0, 9.0),
            beside,
        ];
        let parts: Vec<usize> =
            Polygon { rings }.parts().iter().map(|part| part.rings.len()).collect();
        assert_eq!(parts, [2, 2, 1]);
    }

    #[test]
    fn neighbours_share_no_pixel_and_leave_none_out() {
        // A square cut by lines through its middle, corners and sides on pixel centres.
        let square =
            Polygon { rings: vec![vec![[10.0, 10.0], [50.0, 10.0], [50.0, 50.0], [10.0, 50.0]]] };
        let middle = [30.0, 27.0];
        let ring = &square.rings[0];
        let mut seen = vec![0; 100 * 100];
        for i in 0..4 {
            let part = Polygon { rings: vec![vec![ring[i], ring[(i + 1) % 4], middle]] };
            for (v, run) in part.runs(100, 100) {
                run.for_each(|u| seen[v * 100 + u] += 1);
            }
        }
        assert_eq!(count(&square), 1600);
        assert_eq!(seen.iter().sum::<i32>(), 1600);
        assert!(seen.iter().all(|&n| n <= 1));
    }

    #[test]
    fn holes_are_left_out_and_the_border_cuts() {
        let hole = vec![[20.0, 20.0], [30.0, 20.0], [30.0, 30.0], [20.0, 30.0]];
        let outer = vec![[10.0, 10.0], [50.0, 10.0], [50.0, 50.0], [10.0, 50.0]];
        assert_eq!(count(&Polygon { rings: vec![outer, hole] }), 1500);
        let large = vec![[-50.0, -50.0], [500.0, -50.0], [500.0, 20.0], [-50.0, 20.0]];
        assert_eq!(count(&Polygon { rings: vec![large] }), 2000);
        assert_eq!(count(&Polygon::default()), 0);
        assert_eq!(count(&Polygon { rings: vec![vec![[f64::NAN; 2], [1.0, 2.0]]] }), 0);
    }

    #[test]
    fn bow_ties_cross_and_what_touches_does_not() {
        let bow = vec![[0.0, 0.0], [10.0, 10.0], [10.0, 0.0], [0.0, 10.0]];
        let at = Polygon { rings: vec![bow] }.crossing().unwrap();
        assert!((at[0] - 5.0).abs() < 1e-12 && (at[1] - 5.0).abs() < 1e-12, "{at:?}");
        // Two triangles that touch in a corner, and a corner that is there twice.
        let touching =
            vec![[0.0, 0.0], [5.0, 5.0], [10.0, 0.0], [10.0, 10.0], [5.0, 5.0], [0.0, 10.0]];
        let twice = vec![[0.0, 0.0], [9.0, 0.0], [9.0, 0.0], [9.0, 9.0], [0.0, 9.0]];
        for ring in [touching, twice] {
            assert_eq!(Polygon { rings: vec![ring] }.crossing(), None);
        }
        let line = vec![[1e5, 0.0], [1e5 + 3.0, 3.0], [1e5 + 9.0, 9.0]];
        assert!(Polygon { rings: vec![line] }.is_flat());
        assert!(!Polygon { rings: vec![vec![[0.0, 0.0], [9.0, 0.0], [9.0, 0.1]]] }.is_flat());
    }

    #[test]
    fn pixels_beyond_the_raster_are_counted() {
        let ring = vec![[-50.3, -20.0], [49.7, -20.0], [49.7, 20.0], [-50.3, 20.0]];
        assert_eq!(Polygon { rings: vec![ring] }.pixels(), 4000);
        assert_eq!(Polygon::default().pixels(), 0);
    }

    #[test]
    fn outlines_of_many_corners_are_quick() {
        // A circle of 300,000 corners and a plot whose long sides have as many: seconds, not minutes.
        let n = 300_000;
        let circle = (0..n).map(|k| {
            let (sin, cos) = (f64::from(k) * std::f64::consts::TAU / f64::from(n)).sin_cos();
            [50.0 + 40.0 * cos, 50.0 + 40.0 * sin]
        });
        let side = |u: f64, from: f64, to: f64| {
            (0..n / 2).map(move |k| [u, from + (to - from) * f64::from(k) / f64::from(n / 2)])
        };
        let plot = side(10.0, 10.0, 90.0).chain(side(30.0, 90.0, 10.0));
        let started = std::time::Instant::now();
        for ring in [circle.collect::<Vec<_>>(), plot.collect()] {
            let polygon = Polygon { rings: vec![ring] };
            assert_eq!(polygon.crossing(), None);
            let positions: Vec<[f64; 2]> =
                (0..10_000).map(|k| [f64::from(k % 100), f64::from(k / 100)]).collect();
            assert_eq!(polygon.inside(&positions).len(), count(&polygon));
        }
        assert!(started.elapsed().as_secs() < 20, "{:?}", started.elapsed());
    }

    #[test]
    fn positions_are_inside_as_pixels_are() {
        let polygon = Polygon {
            rings: vec![
                vec![[1.0, 1.0], [9.0, 2.0], [7.0, 8.0], [2.0, 6.0]],
                vec![[4.0, 3.0], [6.0, 3.0], [5.0, 5.0]],
            ],
        };
        let mut inside = [[false; 10]; 10];
        for (v, run) in polygon.runs(10, 10) {
            run.for_each(|u| inside[v][u] = true);
        }
        for (v, row) in inside.iter().enumerate() {
            for (u, &is) in row.iter().enumerate() {
                let at = [u as f64, v as f64];
                assert_eq!(polygon.inside(&[at]).len(), usize::from(is), "{u}, {v}");
            }
        }
    }
}
