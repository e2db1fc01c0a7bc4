//! The direction of a gradient, in plain arithmetic that the compiler can vectorise.

/// Direction of `(x, y)` as a share of the full turn, from 0 up to 1, counter-clockwise from the x axis
/// when y points up; 0 for the zero vector.
///
/// An odd polynomial of degree 7 for the arc tangent of the smaller by the larger; within 4e-5 of a
/// turn (0.015 degrees).
#[inline(always)]
pub(super) fn turn(y: f32, x: f32) -> f32 {
    const P1: f32 = 0.999_787_9 / TURN;
    const P3: f32 = -0.325_808_4 / TURN;
    const P5: f32 = 0.155_578_65 / TURN;
    const P7: f32 = -0.044_326_555 / TURN;
    const TURN: f32 = std::f32::consts::TAU;
    let (size_x, size_y) = (x.abs(), y.abs());
    let steep = size_y > size_x;
    let (small, large) = if steep { (size_x, size_y) } else { (size_y, size_x) };
    let ratio = small / (large + f32::MIN_POSITIVE);
    let square = ratio * ratio;
    let angle = (((P7 * square + P5) * square + P3) * square + P1) * ratio;
    let angle = if steep { 0.25 - angle } else { angle };
    let angle = if x < 0.0 { 0.5 - angle } else { angle };
    if y < 0.0 { 1.0 - angle } else { angle }
}

/// Rounds a number of at most a million to the nearest whole number, without a call.
#[inline(always)]
pub(super) fn round(value: f32) -> i32 {
    // From 1.5 * 2^23 on, single precision has steps of one.
    const MAGIC: f32 = 12_582_912.0;
    (value + MAGIC).to_bits() as i32 - MAGIC.to_bits() as i32
}

/// The largest whole number not above a number of at most a million.
#[inline(always)]
pub(super) fn floor(value: f32) -> i32 {
    let rounded = round(value);
    rounded - i32::from(rounded as f32 > value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directions_agree_with_the_library() {
        for k in 0..3600 {
            let angle = f64::from(k) / 3600.0;
            let (y, x) = (angle * std::f64::consts::TAU).sin_cos();
            for size in [1e-6, 1.0, 300.0] {
                let got = f64::from(turn((size * y) as f32, (size * x) as f32));
                let off = (got - angle + 0.5).rem_euclid(1.0) - 0.5;
                assert!(off.abs() < 4e-5, "{angle}: {got}");
            }
        }
        assert_eq!(turn(0.0, 0.0), 0.0);
    }

    #[test]
    fn numbers_are_rounded() {
        for k in -4000..4000 {
            let value = k as f32 * 0.0625;
            assert_eq!(round(value), value.round_ties_even() as i32);
            assert_eq!(floor(value), value.floor() as i32);
        }
    }
}
