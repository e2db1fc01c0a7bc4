//! Real roots of polynomials, for the minimal solvers.
//!
//! Between two neighbouring real roots of the derivative a polynomial is monotonic, so it has at most
//! one root there. From the linear derivative upwards that isolates all roots, which bisected Newton
//! steps then find. Exact for simple roots; a double root shows up where rounding makes it two.

/// The most coefficients of a polynomial.
pub(super) const MOST: usize = 11;

/// All real roots of `sum_k c[k] x^k` within `-bound..bound`, ascending.
pub(super) fn real_roots(c: &[f64], bound: f64) -> Vec<f64> {
    debug_assert!(c.len() <= MOST);
    let scale = c.iter().fold(0.0f64, |most, v| most.max(v.abs()));
    let mut degree = c.len().saturating_sub(1);
    while degree > 0 && c[degree].abs() <= 1e-14 * scale {
        degree -= 1;
    }
    if degree == 0 {
        return Vec::new();
    }
    // derivatives[k]: the k-th, divided by k! to keep the numbers in range.
    let mut derivatives = vec![c[..=degree].to_vec()];
    for k in 1..degree {
        let before = &derivatives[k - 1];
        let next = (1..before.len()).map(|p| before[p] * p as f64 / k as f64).collect();
        derivatives.push(next);
    }
    let mut roots: Vec<f64> = Vec::new();
    for polynomial in derivatives.iter().rev() {
        let mut ends = vec![-bound];
        ends.append(&mut roots);
        ends.push(bound);
        for pair in ends.windows(2) {
            if let Some(root) = root_between(polynomial, pair[0], pair[1]) {
                roots.push(root);
            }
        }
    }
    roots
}

fn value_and_slope(c: &[f64], x: f64) -> (f64, f64) {
    let (mut value, mut slope) = (0.0, 0.0);
    for &v in c.iter().rev() {
        slope = slope * x + value;
        value = value * x + v;
    }
    (value, slope)
}

/// The root of a monotonic stretch, if the signs at its ends differ.
fn root_between(c: &[f64], mut low: f64, mut high: f64) -> Option<f64> {
    let (at_low, at_high) = (value_and_slope(c, low).0, value_and_slope(c, high).0);
    if at_low == 0.0 {
        return Some(low);
    }
    if at_low * at_high > 0.0 || at_high == 0.0 {
        return None;
    }
    let mut x = 0.5 * (low + high);
    for _ in 0..100 {
        let (value, slope) = value_and_slope(c, x);
        if value == 0.0 {
            return Some(x);
        }
        if (value > 0.0) == (at_low > 0.0) {
            low = x;
        } else {
            high = x;
        }
        let newton = x - value / slope;
        let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
        if (next - x).abs() <= 1e-15 * x.abs() + 1e-300 || next == low && next == high {
            return Some(next);
        }
        x = next;
    }
    Some(x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn roots_of_a_product_of_factors_are_found() {
        let wanted: [f64; 10] = [-7.5, -3.0, -1.25, -0.5, -0.125, 0.25, 0.75, 1.5, 4.0, 9.0];
        let mut c = vec![1.0];
        for root in wanted {
            let mut next = vec![0.0; c.len() + 1];
            for (k, v) in c.iter().enumerate() {
                next[k + 1] += v;
                next[k] -= root * v;
            }
            c = next;
        }
        let found = real_roots(&c, 1e3);
        assert_eq!(found.len(), 10);
        for (a, b) in found.iter().zip(wanted) {
            assert!((a - b).abs() < 1e-7, "{a} {b}");
        }
    }

    #[test]
    fn a_polynomial_without_real_roots_has_none() {
        assert!(real_roots(&[1.0, 0.0, 2.0, 0.0, 1.0], 1e3).is_empty());
        assert!(real_roots(&[3.0], 1e3).is_empty());
        assert_eq!(real_roots(&[-1.0, 2.0, 0.0], 1e3), [0.5]);
    }
}
