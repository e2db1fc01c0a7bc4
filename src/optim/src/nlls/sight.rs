//! Steps of points that are seen from about one place: straight in inverse distance.
//!
//! A point `x` seen from `c`, with `v = x - c`, moves by `d` to
//!
//! ```text
//! c + (v + d - (d.u) u) / k      u = v/|v|      k = max(1 - d.u/|v|, 1/FARTHER)
//! ```
//!
//! which is `x + d` to first order and adds `-d.u/|v|^2` to the inverse distance. An image position is nearly linear in
//! the inverse distance and not at all in the distance: of a point far away Gauss-Newton's `x + d` at most doubles the
//! distance in a step, and a hundred such points make the long valley at whose end all of them are at infinity. `k`
//! stays positive, so a point never passes through infinity and comes back behind its cameras.
//!
//! Reference: J. Civera, A. J. Davison, J. M. M. Montiel, "Inverse depth parametrization for monocular SLAM", IEEE
//! Transactions on Robotics 24(5), 2008.

/// A step takes a point at most so many times as far. With 10, Ladybug's 49-7776 takes 19 steps to 1e-6 of the best cost
/// instead of 40, with 100 it takes 14 and the start of a collection of streets (`synth bundle --preset ladybug-1723`) two
/// more.
const FARTHER: f64 = 10.0;

/// Where `x`, seen from `from`, comes to by the step `d`.
#[inline(always)]
pub(super) fn moved<const P: usize>(from: &[f64; P], x: &[f64; P], d: &[f64; P]) -> [f64; P] {
    let (mut v, mut square, mut along) = ([0.0; P], 0.0, 0.0);
    for k in 0..P {
        v[k] = x[k] - from[k];
        square += v[k] * v[k];
        along += d[k] * v[k];
    }
    if square == 0.0 {
        let mut plain = *x;
        for k in 0..P {
            plain[k] += d[k];
        }
        return plain;
    }
    let along = along / square;
    let nearer = f64::max(1.0 - along, 1.0 / FARTHER);
    let mut out = *from;
    for k in 0..P {
        out[k] += (v[k] + d[k] - along * v[k]) / nearer;
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_is_the_plain_one_to_first_order_and_straight_in_inverse_distance() {
        let (from, x) = ([1.0, -2.0, 0.5], [4.0, 2.0, 12.5]);
        let direction = [0.3, -0.2, 0.9];
        for length in [1e-3, 1e-5] {
            let d = direction.map(|v| v * length);
            let found = moved(&from, &x, &d);
            for k in 0..3 {
                assert!((found[k] - x[k] - d[k]).abs() < 2.0 * length * length);
            }
        }
        // Along the ray |v| = 13: inverse distances are added.
        let d = [3.0, 4.0, 12.0].map(|v| v / 13.0 * 6.5);
        let found = moved(&from, &x, &d);
        let distance = (0..3).map(|k| (found[k] - from[k]).powi(2)).sum::<f64>().sqrt();
        assert!((1.0 / distance - (1.0 / 13.0 - 6.5 / 169.0)).abs() < 1e-12);
        // Never through infinity, and towards the cameras never beyond them.
        for factor in [20.0, 1e6, -20.0, -1e6] {
            let d = [3.0, 4.0, 12.0].map(|v| v / 13.0 * factor);
            let found = moved(&from, &x, &d);
            let along: f64 = (0..3).map(|k| (found[k] - from[k]) * (x[k] - from[k])).sum();
            assert!(along > 0.0 && found.iter().all(|v| v.is_finite()), "{factor}: {found:?}");
        }
    }
}
