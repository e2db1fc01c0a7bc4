//! How often heights occur, in classes of equal width: percentiles of any number of cells in little memory.
//!
//! ```text
//! q(p) = (k + 1/2) w,   k = min { k : sum_(i <= k) n_i >= p sum_i n_i },   n_i = #{ h : i w <= h < (i + 1) w }
//! ```
//!
//! with `w` the width, metres. Within half of it of the exact percentile.

/// Numbers of heights by class.
#[derive(Debug, Clone, PartialEq)]
pub struct HeightCounts {
    width_m: f64,
    lowest: i64,
    counts: Vec<u64>,
}

impl HeightCounts {
    /// None yet, in classes of this width.
    pub fn new(width_m: f64) -> HeightCounts {
        HeightCounts { width_m, lowest: 0, counts: Vec::new() }
    }

    /// Counts a height; what is not finite is none.
    pub fn add(&mut self, height_m: f64) {
        // Classes further out than any height on Earth would only take memory.
        const MAX_M: f64 = 1e4;
        if height_m.is_finite() && height_m.abs() < MAX_M {
            let class = (height_m / self.width_m).floor() as i64;
            if self.counts.is_empty() {
                self.lowest = class;
            }
            if class < self.lowest {
                let more = (self.lowest - class) as usize;
                self.counts.splice(0..0, std::iter::repeat_n(0, more));
                self.lowest = class;
            }
            let at = (class - self.lowest) as usize;
            if at >= self.counts.len() {
                self.counts.resize(at + 1, 0);
            }
            self.counts[at] += 1;
        }
    }

    /// The height that a share of them does not exceed; `None` where there are none.
    pub fn percentile_m(&self, share: f64) -> Option<f64> {
        let total: u64 = self.counts.iter().sum();
        let (wanted, mut sum) = (share * total as f64, 0);
        let class = self.counts.iter().position(|&count| {
            sum += count;
            sum > 0 && sum as f64 >= wanted
        })?;
        Some((self.lowest as f64 + class as f64 + 0.5) * self.width_m)
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
}
