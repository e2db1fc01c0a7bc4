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
    /// The pixels inside, as columns of each row, within a raster of `width` columns and `height` rows.
    pub fn runs(&self, width: usize, height: usize) -> Vec<(usize, Range<usize>)> {
        let sides = || {
            self.rings
                .iter()
                .flat_map(|ring| (0..ring.len()).map(|i| (ring[i], ring[(i + 1) % ring.len()])))
        };
        let (low, high) = sides()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), (a, _)| {
                (low.min(a[1]), high.max(a[1]))
            });
        if !(low.is_finite() && high.is_finite()) {
            return Vec::new();
        }
        let mut runs = Vec::new();
        let mut crossings = Vec::new();
        // A conversion to usize saturates at both ends.
        for v in low.ceil().max(0.0) as usize..((high.floor() + 1.0).max(0.0) as usize).min(height)
        {
            let y = v as f64;
            crossings.clear();
            crossings.extend(sides().filter(|(a, b)| (a[1] <= y) != (b[1] <= y)).map(|(a, b)| {
                // From the lower to the upper end, so that both neighbours of a side compute the same.
                let (a, b) = if a[1] < b[1] { (a, b) } else { (b, a) };
                a[0] + (y - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
            }));
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

    /// Where two sides of a ring cross each other, as those of a bow tie do; rings that only touch themselves do not cross.
    pub fn crossing(&self) -> Option<[f64; 2]> {
        self.rings.iter().find_map(|ring| {
            let side = |k: usize| (ring[k], ring[(k + 1) % ring.len()]);
            (0..ring.len()).find_map(|i| (i + 1..ring.len()).find_map(|j| meet(side(i), side(j))))
        })
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

    /// Whether a position lies inside, by the same rule.
    pub fn holds(&self, [u, v]: [f64; 2]) -> bool {
        let mut inside = false;
        for ring in &self.rings {
            for i in 0..ring.len() {
                let (a, b) = (ring[i], ring[(i + 1) % ring.len()]);
                if (a[1] <= v) != (b[1] <= v) {
                    let (a, b) = if a[1] < b[1] { (a, b) } else { (b, a) };
                    inside ^= u >= a[0] + (v - a[1]) / (b[1] - a[1]) * (b[0] - a[0]);
                }
            }
        }
        inside
    }
}

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
                assert_eq!(polygon.holds([u as f64, v as f64]), is, "{u}, {v}");
            }
        }
    }
}
