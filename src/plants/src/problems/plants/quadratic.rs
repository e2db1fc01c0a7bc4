//! Quadratic functions of the offset of one plant: its prior.

/// `1/2 x^T H x - g^T x`, with `x` an offset in pixels: the prior of one plant.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Quadratic {
    /// `H` as (uu, uv, vv).
    pub hessian: [f64; 3],
    /// `g`.
    pub pull: [f64; 2],
}

impl Quadratic {
    /// Adds `(n^T x - c)^2 / (2 variance)`, but for its constant.
    pub fn add(&mut self, normal: [f64; 2], offset: f64, variance: f64) {
        let [a, b] = normal;
        self.hessian[0] += a * a / variance;
        self.hessian[1] += a * b / variance;
        self.hessian[2] += b * b / variance;
        self.pull[0] += a * offset / variance;
        self.pull[1] += b * offset / variance;
    }

    /// `H x - g`, the gradient.
    pub fn gradient(&self, x: [f64; 2]) -> [f64; 2] {
        let [uu, uv, vv] = self.hessian;
        [uu * x[0] + uv * x[1] - self.pull[0], uv * x[0] + vv * x[1] - self.pull[1]]
    }

    /// The value at `x`.
    pub fn value(&self, x: [f64; 2]) -> f64 {
        let [uu, uv, vv] = self.hessian;
        0.5 * (uu * x[0] * x[0] + vv * x[1] * x[1]) + uv * x[0] * x[1]
            - self.pull[0] * x[0]
            - self.pull[1] * x[1]
    }

    /// The minimiser with the least norm.
    pub fn minimiser(&self) -> [f64; 2] {
        let trace = self.hessian[0] + self.hessian[2];
        if trace <= 0.0 {
            return [0.0; 2];
        }
        solve2(self.hessian, self.pull)
            // Of rank one: H = t n n^T, so g = t c n and x = c n = g / t.
            .unwrap_or([self.pull[0] / trace, self.pull[1] / trace])
    }
}

/// Solves a symmetric 2 x 2 system, unless it is (numerically) singular.
pub(super) fn solve2([uu, uv, vv]: [f64; 3], [a, b]: [f64; 2]) -> Option<[f64; 2]> {
    let determinant = uu * vv - uv * uv;
    if determinant <= 1e-12 * (uu + vv) * (uu + vv) {
        return None;
    }
    Some([(vv * a - uv * b) / determinant, (uu * b - uv * a) / determinant])
}
