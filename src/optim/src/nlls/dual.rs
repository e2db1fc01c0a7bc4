//! Numbers that residuals are written over: `f64` for values, dual numbers for derivatives.
//!
//! A dual number `a + sum_k b_k e_k` with `e_i e_k = 0` carries a value and its derivatives along `N`
//! directions; every operation applies the chain rule. Evaluating a formula over them gives its exact
//! derivatives (forward-mode automatic differentiation; Ceres calls them jets).
//!
//! The crate `num-dual` was considered: its vector of derivatives is an optional matrix, which is
//! tested at every operation and kept with the matrix library that it pins; here it is a plain array,
//! which the compiler puts into registers.

use std::ops::{Add, Div, Mul, Neg, Sub};

/// A real number or a dual one.
///
/// Mixed operations with `f64` are there so that constants need no conversion: `2.0 * x` is written
/// `x * 2.0`, and a constant alone is [`Scalar::constant`].
pub trait Scalar:
    Copy
    + std::fmt::Debug
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + Add<f64, Output = Self>
    + Sub<f64, Output = Self>
    + Mul<f64, Output = Self>
    + Div<f64, Output = Self>
{
    /// A number without derivatives.
    fn constant(value: f64) -> Self;

    /// The value, for comparisons and branches.
    fn value(self) -> f64;

    /// `f(self)` where `f` has this value and this derivative at [`Scalar::value`]: how a function
    /// that is not here is added.
    fn chain(self, value: f64, derivative: f64) -> Self;

    /// The square root.
    fn sqrt(self) -> Self {
        let root = self.value().sqrt();
        self.chain(root, 0.5 / root)
    }

    /// The exponential function.
    fn exp(self) -> Self {
        let e = self.value().exp();
        self.chain(e, e)
    }

    /// The natural logarithm.
    fn ln(self) -> Self {
        self.chain(self.value().ln(), 1.0 / self.value())
    }

    /// The sine of an angle in radians.
    fn sin(self) -> Self {
        let (sin, cos) = self.value().sin_cos();
        self.chain(sin, cos)
    }

    /// The cosine of an angle in radians.
    fn cos(self) -> Self {
        let (sin, cos) = self.value().sin_cos();
        self.chain(cos, -sin)
    }

    /// The tangent of an angle in radians.
    fn tan(self) -> Self {
        let tan = self.value().tan();
        self.chain(tan, 1.0 + tan * tan)
    }

    /// The arc tangent, radians.
    fn atan(self) -> Self {
        let v = self.value();
        self.chain(v.atan(), 1.0 / (1.0 + v * v))
    }

    /// The angle of the vector `(x, self)`, radians.
    fn atan2(self, x: Self) -> Self {
        let (a, b) = (self.value(), x.value());
        let square = a * a + b * b;
        // The derivative along each argument, on top of the value once.
        self.chain(a.atan2(b), b / square) + x.chain(0.0, -a / square)
    }

    /// The length of the vector `(self, y)`.
    fn hypot(self, y: Self) -> Self {
        let length = self.value().hypot(y.value());
        self.chain(length, self.value() / length) + y.chain(0.0, y.value() / length)
    }

    /// An integer power.
    fn powi(self, n: i32) -> Self {
        let v = self.value();
        // 0 times the infinite `0^-1` would be no number.
        let derivative = if n == 0 { 0.0 } else { f64::from(n) * v.powi(n - 1) };
        self.chain(v.powi(n), derivative)
    }

    /// The absolute value; at 0 its derivative is taken from the right.
    fn abs(self) -> Self {
        if self.value() < 0.0 { -self } else { self }
    }
}

impl Scalar for f64 {
    #[inline]
    fn constant(value: f64) -> f64 {
        value
    }

    #[inline]
    fn value(self) -> f64 {
        self
    }

    #[inline]
    fn chain(self, value: f64, _derivative: f64) -> f64 {
        value
    }
}

/// A number and its derivatives along `N` directions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dual<const N: usize> {
    /// The value.
    pub value: f64,
    /// The derivatives.
    pub derivatives: [f64; N],
}

impl<const N: usize> Dual<N> {
    /// `value` with derivative 1 along `direction` and 0 along the others.
    pub fn variable(value: f64, direction: usize) -> Dual<N> {
        let mut derivatives = [0.0; N];
        derivatives[direction] = 1.0;
        Dual { value, derivatives }
    }

    /// `value`, with derivatives `a self + b other`.
    #[inline(always)]
    fn combine(self, value: f64, a: f64, other: Dual<N>, b: f64) -> Dual<N> {
        let mut derivatives = [0.0; N];
        for k in 0..N {
            derivatives[k] = a * self.derivatives[k] + b * other.derivatives[k];
        }
        Dual { value, derivatives }
    }
}

impl<const N: usize> Scalar for Dual<N> {
    #[inline]
    fn constant(value: f64) -> Self {
        Dual { value, derivatives: [0.0; N] }
    }

    #[inline]
    fn value(self) -> f64 {
        self.value
    }

    #[inline]
    fn chain(self, value: f64, derivative: f64) -> Self {
        Dual { value, derivatives: self.derivatives.map(|d| derivative * d) }
    }
}

impl<const N: usize> Add for Dual<N> {
    type Output = Self;
    #[inline]
    fn add(self, other: Self) -> Self {
        self.combine(self.value + other.value, 1.0, other, 1.0)
    }
}

impl<const N: usize> Sub for Dual<N> {
    type Output = Self;
    #[inline]
    fn sub(self, other: Self) -> Self {
        self.combine(self.value - other.value, 1.0, other, -1.0)
    }
}

impl<const N: usize> Mul for Dual<N> {
    type Output = Self;
    #[inline]
    fn mul(self, other: Self) -> Self {
        self.combine(self.value * other.value, other.value, other, self.value)
    }
}

impl<const N: usize> Div for Dual<N> {
    type Output = Self;
    #[inline]
    fn div(self, other: Self) -> Self {
        let quotient = self.value / other.value;
        self.combine(quotient, 1.0 / other.value, other, -quotient / other.value)
    }
}

impl<const N: usize> Neg for Dual<N> {
    type Output = Self;
    #[inline]
    fn neg(self) -> Self {
        self.chain(-self.value, -1.0)
    }
}

impl<const N: usize> Add<f64> for Dual<N> {
    type Output = Self;
    #[inline]
    fn add(self, other: f64) -> Self {
        self.chain(self.value + other, 1.0)
    }
}

impl<const N: usize> Sub<f64> for Dual<N> {
    type Output = Self;
    #[inline]
    fn sub(self, other: f64) -> Self {
        self.chain(self.value - other, 1.0)
    }
}

impl<const N: usize> Mul<f64> for Dual<N> {
    type Output = Self;
    #[inline]
    fn mul(self, other: f64) -> Self {
        self.chain(self.value * other, other)
    }
}

impl<const N: usize> Div<f64> for Dual<N> {
    type Output = Self;
    #[inline]
    fn div(self, other: f64) -> Self {
        self.chain(self.value / other, 1.0 / other)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Every operation, each with its own weight.
    fn everything<T: Scalar>(x: T, y: T) -> [T; 8] {
        [
            (x * y - x / y) * 0.5 + y * 3.0 - 1.0,
            (x * x + y * y).sqrt() / 2.0,
            (x * 0.3).exp() + y.ln(),
            x.sin() * y.cos(),
            (x * 0.2).tan() + y.atan(),
            x.atan2(y),
            x.hypot(-y),
            x.powi(3) * y.powi(-2) + (x - y).abs(),
        ]
    }

    proptest! {
        #[test]
        fn derivatives_are_those_of_central_differences(x in 0.4..2.0f64, y in 2.1..4.0f64) {
            let dual = everything(Dual::<2>::variable(x, 0), Dual::<2>::variable(y, 1));
            let h = 1e-5;
            let by_x = [everything(x + h, y), everything(x - h, y)];
            let by_y = [everything(x, y + h), everything(x, y - h)];
            for (k, value) in everything(x, y).into_iter().enumerate() {
                prop_assert!((dual[k].value - value).abs() <= 1e-14 * value.abs().max(1.0));
                for (direction, [high, low]) in [by_x, by_y].into_iter().enumerate() {
                    let difference = (high[k] - low[k]) / (2.0 * h);
                    let found = dual[k].derivatives[direction];
                    prop_assert!((found - difference).abs() < 1e-8, "{k}: {found} {difference}");
                }
            }
        }
    }
}
