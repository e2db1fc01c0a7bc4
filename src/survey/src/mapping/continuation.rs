//! Heights beyond the points: the plane of the surface, and off it what the heights nearest are.
//!
//! ```text
//! Z(X, Y) = a + b X + c Y + r(X, Y)
//! ```
//!
//! `a`, `b`, `c` by least squares over all heights that are known. `r` is what is left there, and is filled from coarser and coarser
//! means where nothing is known ("pull-push"): it joins the known heights without a step, never leaves their range, and far from
//! them is their mean.
//!
//! Reference: S. J. Gortler, R. Grzeszczuk, R. Szeliski, M. F. Cohen, "The lumigraph", SIGGRAPH 1996, section 3.3.

/// A grid of values with weights from 0, not known, to 1.
struct Level {
    size: [usize; 2],
    values: Vec<f32>,
    weights: Vec<f32>,
}

/// Gives every cell of a grid that has no height (NaN) one; how many. Nothing where no cell has a height.
pub fn continue_heights(heights_m: &mut [f32], [width, height]: [usize; 2]) -> usize {
    let plane = plane(heights_m, width);
    let unknown = heights_m.iter().filter(|z| !z.is_finite()).count();
    let Some(plane) = plane.filter(|_| unknown > 0) else { return 0 };
    let on_plane = |k: usize| plane_at(plane, k, width);
    let weights: Vec<f32> =
        heights_m.iter().map(|z| if z.is_finite() { 1.0 } else { 0.0 }).collect();
    let off = heights_m.iter().enumerate();
    let off =
        off.map(|(k, &z)| if z.is_finite() { (f64::from(z) - on_plane(k)) as f32 } else { 0.0 });
    let finest = Level { size: [width, height], values: off.collect(), weights };
    let filled = filled(finest);
    for (k, z) in heights_m.iter_mut().enumerate().filter(|(_, z)| !z.is_finite()) {
        *z = (on_plane(k) + f64::from(filled.values[k])) as f32;
    }
    unknown
}

/// The plane `[a, b, c]` over columns and rows; level where places are on a line.
fn plane(heights_m: &[f32], width: usize) -> Option<[f64; 3]> {
    let known = || heights_m.iter().enumerate().filter(|(_, z)| z.is_finite());
    let n = known().count() as f64;
    if n == 0.0 {
        return None;
    }
    let at = |k: usize| [(k % width) as f64, (k / width) as f64];
    let mut means = [0.0; 3];
    for (k, &z) in known() {
        let [u, v] = at(k);
        means = [means[0] + u / n, means[1] + v / n, means[2] + f64::from(z) / n];
    }
    let [mut uu, mut uv, mut vv, mut uz, mut vz] = [0.0; 5];
    for (k, &z) in known() {
        let [u, v] = at(k);
        let (u, v, z) = (u - means[0], v - means[1], f64::from(z) - means[2]);
        (uu, uv, vv) = (uu + u * u, uv + u * v, vv + v * v);
        (uz, vz) = (uz + u * z, vz + v * z);
    }
    let determinant = uu * vv - uv * uv;
    let (b, c) = match determinant > 1e-9 * uu.max(vv).powi(2) {
        true => ((uz * vv - vz * uv) / determinant, (vz * uu - uz * uv) / determinant),
        false => (0.0, 0.0),
    };
    Some([means[2] - b * means[0] - c * means[1], b, c])
}

fn plane_at([a, b, c]: [f64; 3], cell: usize, width: usize) -> f64 {
    a + b * (cell % width) as f64 + c * (cell / width) as f64
}

/// The level with all values known, from those that are.
fn filled(mut level: Level) -> Level {
    if level.size == [1, 1] || level.weights.iter().all(|&weight| weight >= 1.0) {
        return level;
    }
    let coarser = filled(halved(&level));
    let [width, _] = level.size;
    for k in 0..level.values.len() {
        let weight = level.weights[k];
        if weight < 1.0 {
            let from = between(&coarser, k % width, k / width);
            level.values[k] = weight * level.values[k] + (1.0 - weight) * from;
        }
    }
    level
}

/// Means of two by two cells.
fn halved(fine: &Level) -> Level {
    let [width, height] = fine.size;
    let size = fine.size.map(|n| n.div_ceil(2));
    let cells = size[0] * size[1];
    let (mut values, mut weights) = (vec![0.0; cells], vec![0.0; cells]);
    for v in 0..height {
        for u in 0..width {
            let (from, to) = (v * width + u, v / 2 * size[0] + u / 2);
            values[to] += fine.weights[from] * fine.values[from];
            weights[to] += fine.weights[from];
        }
    }
    for (value, weight) in values.iter_mut().zip(&mut weights) {
        if *weight > 0.0 {
            *value /= *weight;
            *weight = weight.min(1.0);
        }
    }
    Level { size, values, weights }
}

/// A value of a coarser level at the middle of a cell of the finer one, bilinear.
fn between(coarse: &Level, u: usize, v: usize) -> f32 {
    let [width, height] = coarse.size;
    let neighbours = |at: usize, size: usize| {
        let own = at / 2;
        let other =
            if at.is_multiple_of(2) { own.saturating_sub(1) } else { (own + 1).min(size - 1) };
        [(own, 0.75), (other, 0.25)]
    };
    let mut sum = 0.0;
    for (row, of_row) in neighbours(v, height) {
        for (column, of_column) in neighbours(u, width) {
            sum += of_row * of_column * coarse.values[row * width + column];
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [90, 70];

    /// A disc of known heights within unknown ones.
    fn disc(height: impl Fn(f64, f64) -> f64) -> Vec<f32> {
        let [width, rows] = SIZE;
        let at = |k: usize| [(k % width) as f64, (k / width) as f64];
        let known = |[u, v]: [f64; 2]| (u - 40.0).hypot(v - 30.0) < 20.0;
        (0..width * rows)
            .map(|k| if known(at(k)) { height(at(k)[0], at(k)[1]) as f32 } else { f32::NAN })
            .collect()
    }

    #[test]
    fn a_plane_goes_on_as_a_plane() {
        let slope = |u: f64, v: f64| 180.0 + 0.03 * u - 0.02 * v;
        let given = disc(slope);
        let mut heights = given.clone();
        let unknown = given.iter().filter(|z| z.is_nan()).count();
        assert_eq!(continue_heights(&mut heights, SIZE), unknown);
        for (k, z) in heights.iter().enumerate() {
            let expected = slope((k % SIZE[0]) as f64, (k / SIZE[0]) as f64);
            assert!((f64::from(*z) - expected).abs() < 1e-4, "{k}: {z} {expected}");
        }
    }

    #[test]
    fn relief_is_joined_without_a_step_and_never_exceeded() {
        let relief = |u: f64, v: f64| 0.02 * u + 0.5 * (0.2 * u).sin() * (0.15 * v).cos();
        let given = disc(relief);
        let mut heights = given.clone();
        continue_heights(&mut heights, SIZE);
        let plane = plane(&given, SIZE[0]).unwrap();
        let off = |z: f32, k: usize| f64::from(z) - plane_at(plane, k, SIZE[0]);
        let known = || given.iter().enumerate().filter(|(_, z)| z.is_finite());
        let low = known().map(|(k, &z)| off(z, k)).fold(f64::INFINITY, f64::min);
        let high = known().map(|(k, &z)| off(z, k)).fold(f64::NEG_INFINITY, f64::max);
        for (k, &z) in heights.iter().enumerate() {
            assert!(z.is_finite() && (low - 1e-5..high + 1e-5).contains(&off(z, k)), "{k}: {z}");
            if given[k].is_finite() {
                assert_eq!(z, given[k]);
            }
        }
        // The steepest known step from cell to cell is 0.13.
        for row in heights.chunks_exact(SIZE[0]) {
            assert!(row.windows(2).all(|pair| (pair[1] - pair[0]).abs() < 0.25));
        }
    }

    #[test]
    fn nothing_comes_of_nothing() {
        let mut heights = vec![f32::NAN; 12];
        assert_eq!(continue_heights(&mut heights, [4, 3]), 0);
        assert!(heights.iter().all(|z| z.is_nan()));
        let mut one = vec![f32::NAN, 7.0, f32::NAN];
        assert_eq!(continue_heights(&mut one, [3, 1]), 2);
        assert_eq!(one, [7.0; 3]);
    }
}
