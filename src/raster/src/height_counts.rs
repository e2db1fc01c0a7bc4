//! How often heights occur, in classes of equal width: percentiles of any number of cells in little memory.
//!
//! ```text
//! q(p) = (k + 1/2) w,   k = min { k : sum_(i <= k) n_i >= p sum_i n_i },   n_i = #{ h : i w <= h < (i + 1) w }
//! ```
//!
//! with `w` the width, metres. Within half of it of the exact percentile.

/// Classes that are counted side by side: a matter of memory and time, not of results.
const TOGETHER: usize = 1024;

/// Usual width of the classes in which heights of a canopy are counted, metres: a tenth of the spread of bare soil at best (0.63 cells of
/// 1.5 cm, docs/accuracy.md).
pub const HEIGHT_CLASS_M: f64 = 1e-3;

/// Numbers of heights by class. Memory follows how many classes occur, not how far they are apart.
#[derive(Debug, Clone, PartialEq)]
pub struct HeightCounts {
    width_m: f64,
    /// Numbers of the first of [`TOGETHER`] classes and of the following ones, in ascending order.
    counts: Vec<(i64, Vec<u64>)>,
    /// Which of these had the last height: mostly it has the next one too.
    last: usize,
}

impl HeightCounts {
    /// None yet, in classes of this width.
    pub fn new(width_m: f64) -> HeightCounts {
        HeightCounts { width_m, counts: Vec::new(), last: 0 }
    }

    /// Counts a height; what is not finite is none, and beyond any height on Earth neither.
    pub fn add(&mut self, height_m: f64) {
        const MAX_M: f64 = 1e4;
        if height_m.is_finite() && height_m.abs() < MAX_M {
            let classes = height_m / self.width_m;
            let whole = classes as i64;
            let class = whole - i64::from(whole as f64 > classes);
            let (group, at) =
                (class.div_euclid(TOGETHER as i64), class.rem_euclid(TOGETHER as i64));
            if self.counts.get(self.last).is_none_or(|(of, _)| *of != group) {
                self.last = self.counts.partition_point(|(of, _)| *of < group);
                if self.counts.get(self.last).is_none_or(|(of, _)| *of != group) {
                    self.counts.insert(self.last, (group, vec![0; TOGETHER]));
                }
            }
            self.counts[self.last].1[at as usize] += 1;
        }
    }

    /// Counts what others counted, in classes of the same width.
    pub fn merge(&mut self, others: &HeightCounts) {
        debug_assert!(self.width_m == others.width_m, "classes of one width");
        for (group, counts) in &others.counts {
            let at = self.counts.partition_point(|(of, _)| of < group);
            match self.counts.get_mut(at).filter(|(of, _)| of == group) {
                Some((_, own)) => own.iter_mut().zip(counts).for_each(|(own, more)| *own += more),
                None => self.counts.insert(at, (*group, counts.clone())),
            }
        }
    }

    /// The height that a share of them does not exceed; `None` where there are none.
    pub fn percentile_m(&self, share: f64) -> Option<f64> {
        let total: u64 = self.counts.iter().flat_map(|(_, counts)| counts).sum();
        let (wanted, mut sum) = (share * total as f64, 0);
        for (group, counts) in &self.counts {
            for (at, count) in counts.iter().enumerate() {
                sum += count;
                if sum > 0 && sum as f64 >= wanted {
                    let class = (group * TOGETHER as i64 + at as i64) as f64;
                    return Some((class + 0.5) * self.width_m);
                }
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_exact_to_half_a_class() {
        let mut counts = HeightCounts::new(0.001);
        assert_eq!(counts.percentile_m(0.5), None);
        let heights: Vec<f64> = (0..1001).map(|k| -0.25 + 0.0013 * f64::from(k)).collect();
        // From the middle outwards, so that classes are added at both ends.
        for k in 0..=500 {
            counts.add(heights[500 + k]);
            if k > 0 {
                counts.add(heights[500 - k]);
            }
        }
        counts.add(f64::NAN);
        for share in [0.0, 0.05, 0.5, 0.95, 1.0] {
            let off = counts.percentile_m(share).unwrap() - heights[(share * 1000.0) as usize];
            assert!(off.abs() <= 0.0015, "{share}: {off}");
        }
    }

    #[test]
    fn parts_together_are_the_whole() {
        let heights = |from: i32, to: i32| {
            let mut counts = HeightCounts::new(0.001);
            (from..to).for_each(|k| counts.add(0.0037 * f64::from(k)));
            counts
        };
        let whole = heights(-900, 900);
        for cut in [-300, 0, 899] {
            let (mut low, high) = (heights(-900, cut), heights(cut, 900));
            low.merge(&high);
            assert_eq!(low.counts, whole.counts, "{cut}");
        }
    }

    #[test]
    fn heights_far_apart_take_little_memory() {
        let mut counts = HeightCounts::new(1e-4);
        [9e3, 0.01, -9e3].into_iter().for_each(|height_m| counts.add(height_m));
        assert_eq!(counts.counts.len(), 3);
        assert!((counts.percentile_m(0.5).unwrap() - 0.01).abs() <= 1e-4);
    }
}
