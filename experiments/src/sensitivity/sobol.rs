//! Sobol' points: a sequence that fills the unit cube more evenly than random numbers do.
//!
//! Coordinate `j` of point `n` is the exclusive or of the direction numbers `v_i` of `j` for all bits `i` of `n`. With the
//! primitive polynomial `x^s + a_1 x^(s-1) + ... + a_(s-1) x + 1` of the coordinate,
//!
//! ```text
//! v_i = a_1 v_(i-1) ^ ... ^ a_(s-1) v_(i-s+1) ^ v_(i-s) ^ (v_(i-s) >> s)
//! ```
//!
//! Direction numbers: S. Joe and F. Y. Kuo, "Constructing Sobol sequences with better two-dimensional
//! projections", SIAM Journal on Scientific Computing 30, 2008.

/// Bits of a coordinate.
const BITS: usize = 32;

/// Polynomials, as the bits of their coefficients, and first numbers of the coordinates after the first.
const TABLE: [(u32, &[u32]); 39] = [
    (3, &[1]),
    (7, &[1, 3]),
    (11, &[1, 3, 1]),
    (13, &[1, 1, 1]),
    (19, &[1, 1, 3, 3]),
    (25, &[1, 3, 5, 13]),
    (37, &[1, 1, 5, 5, 17]),
    (41, &[1, 1, 5, 5, 5]),
    (47, &[1, 1, 7, 11, 19]),
    (55, &[1, 1, 5, 1, 1]),
    (59, &[1, 1, 1, 3, 11]),
    (61, &[1, 3, 5, 5, 31]),
    (67, &[1, 3, 3, 9, 7, 49]),
    (91, &[1, 1, 1, 15, 21, 21]),
    (97, &[1, 3, 1, 13, 27, 49]),
    (103, &[1, 1, 1, 15, 7, 5]),
    (109, &[1, 3, 1, 15, 13, 25]),
    (115, &[1, 1, 5, 5, 19, 61]),
    (131, &[1, 3, 7, 11, 23, 15, 103]),
    (137, &[1, 3, 7, 13, 13, 15, 69]),
    (143, &[1, 1, 3, 13, 7, 35, 63]),
    (145, &[1, 3, 5, 9, 1, 25, 53]),
    (157, &[1, 3, 1, 13, 9, 35, 107]),
    (167, &[1, 3, 1, 5, 27, 61, 31]),
    (171, &[1, 1, 5, 11, 19, 41, 61]),
    (185, &[1, 3, 5, 3, 3, 13, 69]),
    (191, &[1, 1, 7, 13, 1, 19, 1]),
    (193, &[1, 3, 7, 5, 13, 19, 59]),
    (203, &[1, 1, 3, 9, 25, 29, 41]),
    (211, &[1, 3, 5, 13, 23, 1, 55]),
    (213, &[1, 3, 7, 3, 13, 59, 17]),
    (229, &[1, 3, 1, 3, 5, 53, 69]),
    (239, &[1, 1, 5, 5, 23, 33, 13]),
    (241, &[1, 1, 7, 7, 1, 61, 123]),
    (247, &[1, 1, 7, 9, 13, 61, 49]),
    (253, &[1, 3, 3, 5, 3, 55, 33]),
    (285, &[1, 3, 1, 15, 31, 13, 49, 245]),
    (299, &[1, 3, 5, 15, 31, 59, 63, 97]),
    (301, &[1, 3, 1, 11, 11, 11, 77, 249]),
];

/// Most coordinates.
pub(crate) const MAX_COORDINATES: usize = TABLE.len() + 1;

/// The direction numbers of a coordinate below [`MAX_COORDINATES`].
pub(super) fn directions(coordinate: usize) -> [u32; BITS] {
    let mut v = [0; BITS];
    let Some(&(polynomial, first)) = coordinate.checked_sub(1).and_then(|place| TABLE.get(place))
    else {
        return std::array::from_fn(|i| 1 << (BITS - 1 - i));
    };
    let degree = first.len();
    for i in 0..BITS {
        v[i] = match first.get(i) {
            Some(m) => m << (BITS - 1 - i),
            None => {
                let back = v[i - degree];
                (1..degree).fold(back ^ (back >> degree), |sum, k| {
                    let taken = (polynomial >> (degree - k)) & 1 == 1;
                    if taken { sum ^ v[i - k] } else { sum }
                })
            }
        };
    }
    v
}

/// A coordinate of a point, moved by a digital shift, inside the unit interval.
pub(super) fn coordinate(v: &[u32; BITS], point: u32, shift: u32) -> f64 {
    let bits = (0..BITS).filter(|i| point >> i & 1 == 1).fold(shift, |sum, i| sum ^ v[i]);
    (f64::from(bits) + 0.5) / 2f64.powi(BITS as i32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_are_those_of_joe_and_kuo() {
        // scipy.stats.qmc.Sobol(40, scramble=False).random(1024), whose order is that of the Gray code.
        let columns = [0, 1, 2, 7, 20, 30, 39];
        for (n, expected) in [
            (5, [896.0, 896.0, 128.0, 384.0, 640.0, 896.0, 384.0]),
            (100, [424.0, 264.0, 792.0, 488.0, 776.0, 728.0, 136.0]),
            (1001, [737.0, 611.0, 19.0, 409.0, 23.0, 663.0, 1003.0]),
        ] {
            for (column, expected) in columns.into_iter().zip(expected) {
                let found = coordinate(&directions(column), n ^ (n >> 1), 0);
                assert_eq!((found * 1024.0).floor(), expected, "point {n}, coordinate {column}");
            }
        }
    }

    #[test]
    fn every_coordinate_has_one_point_in_each_interval() {
        for column in 0..MAX_COORDINATES {
            let v = directions(column);
            let mut seen = [false; 256];
            for point in 0..256 {
                seen[(coordinate(&v, point, 0x1234_5678) * 256.0) as usize] = true;
            }
            assert!(seen.iter().all(|&seen| seen), "{column}");
        }
    }
}
