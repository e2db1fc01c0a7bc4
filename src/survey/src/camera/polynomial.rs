//! Real roots of small polynomials and the inverse of monotonic curves, for the radial part of
//! lens models.

/// The most coefficients.
const MOST: usize = 8;

/// The value of `sum_k c_k s^k` and of its derivative.
pub(super) fn evaluate(c: &[f64], s: f64) -> (f64, f64) {
    let (mut value, mut slope) = (0.0, 0.0);
    for &coefficient in c.iter().rev() {
        slope = slope * s + value;
        value = value * s + coefficient;
    }
    (value, slope)
}

/// The smallest `s > 0` at which `sum_k c_k s^k` changes its sign, if there is one; at most eight
/// coefficients.
pub(super) fn smallest_positive_root(c: &[f64]) -> Option<f64> {
    let mut roots = [0.0; MOST];
    let count = positive_roots(c, &mut roots);
    roots[..count].first().copied()
}

/// Between two roots of the derivative there is at most one root: they are found from the lowest
/// degree up.
fn positive_roots(c: &[f64], roots: &mut [f64; MOST]) -> usize {
    debug_assert!(c.len() <= MOST);
    let degree = c.iter().rposition(|&v| v != 0.0).unwrap_or(0);
    if degree == 0 {
        return 0;
    }
    let leading = c[degree];
    // Fujiwara's bound.
    let bound = (0..degree)
        .map(|k| (c[k] / leading).abs().powf(1.0 / (degree - k) as f64))
        .fold(0.0, f64::max)
        * 2.0;
    if !(bound.is_finite() && bound > 0.0) {
        return 0;
    }
    let mut derivative = [0.0; MOST];
    for k in 1..=degree {
        derivative[k - 1] = k as f64 * c[k];
    }
    let mut turns = [0.0; MOST];
    let count = positive_roots(&derivative[..degree], &mut turns);
    let mut found = 0;
    let mut low = 0.0;
    for &high in turns[..count].iter().filter(|&&turn| turn < bound).chain(&[bound]) {
        if let Some(root) = bisect(&c[..=degree], low, high) {
            roots[found] = root;
            found += 1;
        }
        low = high;
    }
    found
}

fn bisect(c: &[f64], mut low: f64, mut high: f64) -> Option<f64> {
    let start = evaluate(c, low).0;
    if start == 0.0 || start * evaluate(c, high).0 > 0.0 {
        return None;
    }
    loop {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            return Some(high);
        }
        if start * evaluate(c, middle).0 > 0.0 {
            low = middle;
        } else {
            high = middle;
        }
    }
}

/// The `r` in `0..=limit` with `curve(r) = target`, for a curve from 0 that grows up to `limit`
/// (which may be infinite); `curve` gives value and slope. `None` where the curve does not reach so
/// far, and of a target that is not finite.
pub(super) fn invert_monotonic(
    target: f64,
    limit: f64,
    curve: impl Fn(f64) -> (f64, f64),
) -> Option<f64> {
    if target == 0.0 {
        return Some(0.0);
    }
    if !target.is_finite() {
        return None;
    }
    let (mut low, mut high) = (0.0, limit);
    if !high.is_finite() {
        high = target;
        let mut doublings = 0;
        while curve(high).0 < target {
            low = high;
            high *= 2.0;
            doublings += 1;
            if doublings > 60 {
                return None;
            }
        }
    } else if curve(high).0 < target {
        return None;
    }
    let mut r = target.clamp(low, high);
    for _ in 0..100 {
        let (value, slope) = curve(r);
        let excess = value - target;
        if excess > 0.0 {
            high = r;
        } else {
            low = r;
        }
        let newton = r - excess / slope;
        // Newton's method squares the error: after a step this short it is below rounding.
        let (next, small) = if newton > low && newton < high {
            (newton, 1e-10)
        } else {
            (0.5 * (low + high), 4.0 * f64::EPSILON)
        };
        if (next - r).abs() <= small * r || next <= low || next >= high {
            return Some(next);
        }
        r = next;
    }
    Some(r)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_smallest_of_chosen_roots_is_found(
            mut roots in prop::collection::vec(0.05..5.0f64, 1..6),
            negative in -3.0..-0.1f64,
            scale in -9..9i32,
        ) {
            roots.sort_by(f64::total_cmp);
            prop_assume!(roots.windows(2).all(|pair| pair[1] - pair[0] > 0.05));
            roots.push(negative);
            let scale = 10f64.powi(scale);
            let mut c = vec![1.0];
            for root in &roots {
                // times (1 - s / (root scale))
                let mut next = c.clone();
                next.push(0.0);
                for (k, v) in c.iter().enumerate() {
                    next[k + 1] -= v / (root * scale);
                }
                c = next;
            }
            let found = smallest_positive_root(&c).unwrap();
            prop_assert!((found / (roots[0] * scale) - 1.0).abs() < 1e-9, "{found} {roots:?}");
        }

        #[test]
        fn monotonic_curves_are_inverted(k in -0.1..0.5f64, r in 0.0..1.5f64) {
            let curve = |r: f64| (r + k * r.powi(3), 1.0 + 3.0 * k * r * r);
            let limit = if k < 0.0 { (-1.0 / (3.0 * k)).sqrt() } else { f64::INFINITY };
            let found = invert_monotonic(curve(r).0, limit, curve).unwrap();
            prop_assert!((found - r).abs() < 1e-12 / curve(r).1.max(1e-3));
        }
    }

    #[test]
    fn without_a_root_there_is_none() {
        assert_eq!(smallest_positive_root(&[1.0, 2.0, 3.0]), None);
        assert_eq!(smallest_positive_root(&[1.0]), None);
        assert_eq!(smallest_positive_root(&[1.0, 0.0, 0.0]), None);
        // Near is not crossing.
        assert_eq!(smallest_positive_root(&[1.000_001, -2.0, 1.0]), None);
        assert_eq!(invert_monotonic(3.0, 1.0, |r| (r, 1.0)), None);
    }

    #[test]
    fn a_target_that_is_not_finite_is_not_reached() {
        for target in [f64::NAN, f64::INFINITY] {
            for limit in [1.0, f64::INFINITY] {
                assert_eq!(invert_monotonic(target, limit, |r| (r, 1.0)), None);
            }
        }
    }
}
