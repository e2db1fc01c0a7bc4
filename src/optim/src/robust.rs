//! Location and scale of numbers of which some may be wrong.
//!
//! ```text
//! m = median(x),   s = 1.4826 median|x - m|          numbers
//!                  s = median(d) / 1.1774            distances in a plane
//! ```
//!
//! Both estimate the standard deviation of normal errors (of one coordinate), and bear up to half of the numbers being wrong. The first is the
//! normalised median absolute deviation.
//!
//! Reference: P. J. Huber and E. M. Ronchetti, *Robust Statistics*, 2009, chapter 5.

/// The standard deviation of normal errors over the median of their absolute values, `1 / Phi^-1(3/4)`.
pub const NORMAL_MAD_RATIO: f64 = 1.4826;
/// The median of distances in a plane over the standard deviation of one coordinate, `sqrt(2 ln 2)`.
const PLANE_MEDIAN_RATIO: f64 = 1.1774;

/// The median; of an even number of values the larger one of the two in the middle, so that it is always one of them.
/// `None` without any.
pub fn median<T: Real>(values: impl IntoIterator<Item = T>) -> Option<T> {
    let mut values: Vec<T> = values.into_iter().collect();
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, T::order).1)
}

/// The median and the normalised median absolute deviation from it.
pub fn median_and_sigma(values: &[f64]) -> Option<(f64, f64)> {
    let middle = median(values.iter().copied())?;
    Some((middle, sigma_of_errors(values.iter().map(|value| value - middle))?))
}

/// The standard deviation of normal errors, from the median of their absolute values.
pub fn sigma_of_errors(errors: impl IntoIterator<Item = f64>) -> Option<f64> {
    median(errors.into_iter().map(f64::abs)).map(|middle| NORMAL_MAD_RATIO * middle)
}

/// The standard deviation of one coordinate, from the median of distances in a plane.
pub fn sigma_of_distances(distances: impl IntoIterator<Item = f64>) -> Option<f64> {
    median(distances).map(|middle| middle / PLANE_MEDIAN_RATIO)
}

/// Numbers of single or double precision.
pub trait Real: Copy {
    /// Their total order, NaN at the ends.
    fn order(a: &Self, b: &Self) -> std::cmp::Ordering;
}

impl Real for f64 {
    fn order(a: &f64, b: &f64) -> std::cmp::Ordering {
        a.total_cmp(b)
    }
}

impl Real for f32 {
    fn order(a: &f32, b: &f32) -> std::cmp::Ordering {
        a.total_cmp(b)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, Normal};

    #[test]
    fn the_median_is_one_of_the_values() {
        assert_eq!(median(Vec::<f64>::new()), None);
        assert_eq!(median([3.0]), Some(3.0));
        assert_eq!(median(vec![4.0, 1.0, 3.0, 2.0]), Some(3.0));
        assert_eq!(median([5.0f32, 1.0, 3.0]), Some(3.0));
    }

    #[test]
    fn the_scale_is_that_of_the_good_part_of_the_numbers() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let normal = Normal::new(7.0, 0.5).unwrap();
        let mut draw = || normal.sample(&mut rng);
        let mut values: Vec<f64> = (0..4001).map(|_| draw()).collect();
        values[..400].fill(1e6);
        let (middle, sigma) = median_and_sigma(&values).unwrap();
        assert!((middle - 7.0).abs() < 0.1 && (sigma - 0.5).abs() < 0.1, "{middle} {sigma}");
        let distances = (0..4001).map(|_| (draw() - 7.0).hypot(draw() - 7.0));
        let sigma = sigma_of_distances(distances.collect::<Vec<_>>()).unwrap();
        assert!((sigma - 0.5).abs() < 0.05, "{sigma}");
    }
}
