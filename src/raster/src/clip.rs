//! Polygons made smaller: cut along a line, and moved in from their outline.

use crate::polygon::Polygon;

/// The part of a polygon on the side of a line from which `normal` points away: `normal . p <= offset`.
pub fn half_plane(polygon: &Polygon, normal: [f64; 2], offset: f64) -> Polygon {
    let height = |at: [f64; 2]| normal[0] * at[0] + normal[1] * at[1] - offset;
    let ring = |ring: &Vec<[f64; 2]>| {
        let mut kept: Vec<[f64; 2]> = Vec::with_capacity(ring.len() + 2);
        for (k, &from) in ring.iter().enumerate() {
            let to = ring[(k + 1) % ring.len()];
            let (a, b) = (height(from), height(to));
            if a <= 0.0 {
                kept.push(from);
            }
            if (a <= 0.0) != (b <= 0.0) {
                let share = a / (a - b);
                kept.push([0, 1].map(|axis| from[axis] + share * (to[axis] - from[axis])));
            }
        }
        kept
    };
    let rings = polygon.rings.iter().map(ring).filter(|ring| ring.len() > 2);
    Polygon { rings: rings.collect() }
}

/// A convex outline moved in by `along` in a direction (of length 1) and by `across` at right angles to it; `None` where the
/// polygon is not convex, or has holes or parts. What is left may be nothing.
pub fn inset(polygon: &Polygon, direction: [f64; 2], along: f64, across: f64) -> Option<Polygon> {
    let [ring] = &polygon.rings[..] else { return None };
    let n = ring.len();
    let sides: Vec<([f64; 2], [f64; 2])> = (0..n)
        .map(|k| {
            let (a, b) = (ring[k], ring[(k + 1) % n]);
            let [du, dv] = [b[0] - a[0], b[1] - a[1]];
            let length = du.hypot(dv).max(f64::MIN_POSITIVE);
            (a, [dv / length, -du / length])
        })
        .collect();
    let area: f64 = (0..n)
        .map(|k| {
            let (a, b) = (ring[k], ring[(k + 1) % n]);
            a[0] * b[1] - b[0] * a[1]
        })
        .sum();
    // The normals that were made point outwards where the outline runs in the sense of a positive area.
    let sense = area.signum();
    let reach =
        polygon.bounds().map_or(0.0, |[low, high]| (high[0] - low[0]).hypot(high[1] - low[1]));
    let mut inner = polygon.clone();
    for (at, normal) in sides {
        let normal = normal.map(|x| sense * x);
        let offset = normal[0] * at[0] + normal[1] * at[1];
        // Corners that were drawn by hand are a thousandth beside a straight side.
        let is_beyond = |p: &[f64; 2]| normal[0] * p[0] + normal[1] * p[1] > offset + 1e-3 * reach;
        if ring.iter().any(is_beyond) {
            return None;
        }
        let [cos, sin] = [
            normal[0] * direction[0] + normal[1] * direction[1],
            normal[0] * direction[1] - normal[1] * direction[0],
        ];
        inner = half_plane(&inner, normal, offset - along * cos.abs() - across * sin.abs());
    }
    Some(inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plot_is_moved_in_along_and_across() {
        let (sin, cos) = 0.4f64.sin_cos();
        let turn = |[u, v]: [f64; 2]| [50.0 + cos * u - sin * v, 50.0 + sin * u + cos * v];
        for corners in [
            [[0.0, 0.0], [30.0, 0.0], [30.0, 20.0], [0.0, 20.0]],
            [[0.0, 20.0], [30.0, 20.0], [30.0, 0.0], [0.0, 0.0]],
        ] {
            let plot = Polygon { rings: vec![corners.map(turn).to_vec()] };
            let inner = inset(&plot, [cos, sin], 3.0, 1.0).unwrap();
            for expected in [[3.0, 1.0], [27.0, 1.0], [27.0, 19.0], [3.0, 19.0]].map(turn) {
                let near = |at: &&[f64; 2]| (at[0] - expected[0]).hypot(at[1] - expected[1]) < 1e-9;
                assert!(inner.rings[0].iter().any(|at| near(&at)), "{expected:?} {inner:?}");
            }
            assert_eq!(inset(&plot, [cos, sin], 15.1, 0.0).unwrap().rings.len(), 0);
        }
        let ell = vec![[0.0, 0.0], [9.0, 0.0], [9.0, 4.0], [4.0, 4.0], [4.0, 9.0], [0.0, 9.0]];
        assert_eq!(inset(&Polygon { rings: vec![ell] }, [1.0, 0.0], 1.0, 1.0), None);
    }

    #[test]
    fn a_line_cuts_outlines_and_holes() {
        let square = |a: f64, b: f64| vec![[a, a], [b, a], [b, b], [a, b]];
        let plot = Polygon { rings: vec![square(-0.5, 9.5), square(1.5, 3.5)] };
        let half = half_plane(&plot, [1.0, 0.0], 2.5);
        assert_eq!(half.pixels(), 30 - 2);
    }
}
