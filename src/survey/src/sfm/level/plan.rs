//! Similarities of the plane: a flight seen from above against its positions.

/// A similarity of the plane, `scale Rz(heading) p + shift`.
#[derive(Clone, Copy)]
pub(in crate::sfm) struct PlanFit {
    /// Scale times cosine and sine of the heading.
    pub(in crate::sfm) factor: [f64; 2],
    pub(in crate::sfm) shift: [f64; 2],
}

impl PlanFit {
    fn apply(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [c, s] = self.factor;
        [c * x - s * y + self.shift[0], s * x + c * y + self.shift[1]]
    }

    fn of(pairs: &[([f64; 2], [f64; 2])]) -> Option<PlanFit> {
        let n = pairs.len() as f64;
        let mean = |side: usize, k: usize| {
            pairs.iter().map(|p| if side == 0 { p.0[k] } else { p.1[k] }).sum::<f64>() / n
        };
        let (from, to) = ([mean(0, 0), mean(0, 1)], [mean(1, 0), mean(1, 1)]);
        let (mut real, mut imaginary, mut spread) = (0.0, 0.0, 0.0);
        for (p, q) in pairs {
            let (a, b) = ([p[0] - from[0], p[1] - from[1]], [q[0] - to[0], q[1] - to[1]]);
            real += a[0] * b[0] + a[1] * b[1];
            imaginary += a[0] * b[1] - a[1] * b[0];
            spread += a[0] * a[0] + a[1] * a[1];
        }
        let factor = [real / spread, imaginary / spread];
        let sound = factor[0].hypot(factor[1]);
        let moved = PlanFit { factor, shift: [0.0; 2] }.apply(from);
        let shift = [to[0] - moved[0], to[1] - moved[1]];
        (sound.is_finite() && sound > 1e-12).then_some(PlanFit { factor, shift })
    }

    pub(in crate::sfm) fn left(&self, (p, q): &([f64; 2], [f64; 2])) -> f64 {
        let at = self.apply(*p);
        (at[0] - q[0]).hypot(at[1] - q[1])
    }

    /// Robustly: the two whose similarity leaves the least median, then all that fit.
    pub(in crate::sfm) fn robust(pairs: &[([f64; 2], [f64; 2])]) -> Option<(PlanFit, Vec<bool>)> {
        let n = pairs.len();
        let every = (n * n.saturating_sub(1) / 2).div_ceil(2000).max(1);
        let twos = (0..n).flat_map(|i| (i + 1..n).map(move |j| [i, j]));
        let mut best: Option<(f64, PlanFit)> = None;
        for two in twos.step_by(every) {
            let Some(fit) = PlanFit::of(&two.map(|k| pairs[k])) else { continue };
            let mut left: Vec<f64> = pairs.iter().map(|pair| fit.left(pair)).collect();
            left.sort_by(f64::total_cmp);
            let median = left[(n / 2).max(2.min(n - 1))];
            if best.as_ref().is_none_or(|(least, _)| median < *least) {
                best = Some((median, fit));
            }
        }
        let (median, mut fit) = best?;
        let mut inside = vec![true; n];
        for _ in 0..3 {
            inside = pairs.iter().map(|pair| fit.left(pair) <= 4.0 * median).collect();
            let of: Vec<_> =
                pairs.iter().zip(&inside).filter(|(_, inside)| **inside).map(|(p, _)| *p).collect();
            fit = PlanFit::of(&of).unwrap_or(fit);
        }
        Some((fit, inside))
    }
}
