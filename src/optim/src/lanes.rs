//! Arithmetic written once for one number or for several at a time.
//!
//! A [`Lane`] is an `f64` or a SIMD register of them; the instruction set is chosen when the program
//! runs (AVX-512, AVX2 with FMA, or none of these), so a plain release build is fast everywhere.

mod transpose;

use pulp::Simd;
use std::ops::{Add, Div, Mul, Neg, Sub};

pub(crate) use transpose::{gather, scatter};

/// The most numbers that one lane holds.
pub(crate) const MAX_WIDTH: usize = 8;

/// One or several numbers with the arithmetic of one.
///
/// Mixed operations with `f64` are there because a register cannot be made from nothing: write
/// `x * 2.0 + 1.0`, or [`Lane::like`] where a constant stands alone.
pub trait Lane:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + Add<f64, Output = Self>
    + Mul<f64, Output = Self>
{
    /// `value` in every place.
    fn like(self, value: f64) -> Self;

    /// `self * a + b`, rounded once where the machine can.
    fn mul_add(self, a: Self, b: Self) -> Self;

    /// The square root.
    fn sqrt(self) -> Self;

    /// `f` of each number by itself: for what cannot be written without branches. `inputs` must
    /// not be empty.
    fn each<const I: usize, const O: usize>(
        inputs: &[Self; I],
        f: impl Fn(&[f64; I]) -> [f64; O],
    ) -> [Self; O];
}

impl Lane for f64 {
    #[inline(always)]
    fn like(self, value: f64) -> f64 {
        value
    }

    #[inline(always)]
    fn mul_add(self, a: f64, b: f64) -> f64 {
        self * a + b
    }

    #[inline(always)]
    fn sqrt(self) -> f64 {
        f64::sqrt(self)
    }

    #[inline(always)]
    fn each<const I: usize, const O: usize>(
        inputs: &[f64; I],
        f: impl Fn(&[f64; I]) -> [f64; O],
    ) -> [f64; O] {
        f(inputs)
    }
}

/// A register of the instruction set `S`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Register<S: Simd> {
    simd: S,
    value: S::f64s,
}

impl<S: Simd> Register<S> {
    /// How many numbers it holds.
    pub(crate) const WIDTH: usize = S::F64_LANES;

    /// The first [`Register::WIDTH`] of `values`.
    #[inline(always)]
    pub(crate) fn load(simd: S, values: &[f64; MAX_WIDTH]) -> Self {
        Register { simd, value: S::as_simd_f64s(values).0[0] }
    }

    /// Writes to the first [`Register::WIDTH`] of `values`.
    #[inline(always)]
    pub(crate) fn store(self, values: &mut [f64; MAX_WIDTH]) {
        S::as_mut_simd_f64s(values).0[0] = self.value;
    }
}

macro_rules! operator {
    ($trait:ident, $method:ident, $simd:ident) => {
        impl<S: Simd> $trait for Register<S> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Register { simd: self.simd, value: self.simd.$simd(self.value, other.value) }
            }
        }
    };
}

operator!(Add, add, add_f64s);
operator!(Sub, sub, sub_f64s);
operator!(Mul, mul, mul_f64s);
operator!(Div, div, div_f64s);

impl<S: Simd> Neg for Register<S> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Register { simd: self.simd, value: self.simd.neg_f64s(self.value) }
    }
}

impl<S: Simd> Add<f64> for Register<S> {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: f64) -> Self {
        self + self.like(other)
    }
}

impl<S: Simd> Mul<f64> for Register<S> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: f64) -> Self {
        self * self.like(other)
    }
}

impl<S: Simd> Lane for Register<S> {
    #[inline(always)]
    fn like(self, value: f64) -> Self {
        Register { simd: self.simd, value: self.simd.splat_f64s(value) }
    }

    #[inline(always)]
    fn mul_add(self, a: Self, b: Self) -> Self {
        let value = self.simd.mul_add_e_f64s(self.value, a.value, b.value);
        Register { simd: self.simd, value }
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        Register { simd: self.simd, value: self.simd.sqrt_f64s(self.value) }
    }

    #[inline(always)]
    fn each<const I: usize, const O: usize>(
        inputs: &[Self; I],
        f: impl Fn(&[f64; I]) -> [f64; O],
    ) -> [Self; O] {
        let mut columns = [[0.0; MAX_WIDTH]; I];
        for k in 0..I {
            inputs[k].store(&mut columns[k]);
        }
        let mut results = [[0.0; MAX_WIDTH]; O];
        // Loops throughout: a closure would be compiled without the instruction set.
        for lane in 0..Self::WIDTH {
            let mut asked = [0.0; I];
            for k in 0..I {
                asked[k] = columns[k][lane];
            }
            let found = f(&asked);
            for k in 0..O {
                results[k][lane] = found[k];
            }
        }
        let simd = inputs[0].simd;
        let mut out = [inputs[0]; O];
        for k in 0..O {
            out[k] = Register::load(simd, &results[k]);
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Try;

    impl pulp::WithSimd for Try {
        type Output = ();
        fn with_simd<S: Simd>(self, simd: S) {
            let a: [f64; MAX_WIDTH] = std::array::from_fn(|k| 1.5 + k as f64);
            let b: [f64; MAX_WIDTH] = std::array::from_fn(|k| 0.25 - k as f64);
            let mut out = [0.0; MAX_WIDTH];
            let (x, y) = (Register::load(simd, &a), Register::load(simd, &b));
            fn formula<L: Lane>(x: L, y: L) -> L {
                ((x * y + 2.0) / x - (-y)).mul_add(x * 0.5, y.like(3.0)).sqrt()
            }
            // Where the root is of a negative number both must be NaN.
            formula(x, y).store(&mut out);
            for k in 0..Register::<S>::WIDTH {
                let one = formula(a[k], b[k]);
                assert!((one - out[k]).abs() < 1e-14 || (one.is_nan() && out[k].is_nan()));
            }
            let [sum, product] = Lane::each(&[x, y], |&[x, y]| [x + y, x * y]);
            let mut outs = [[0.0; MAX_WIDTH]; 2];
            sum.store(&mut outs[0]);
            product.store(&mut outs[1]);
            for k in 0..Register::<S>::WIDTH {
                assert_eq!([outs[0][k], outs[1][k]], [a[k] + b[k], a[k] * b[k]]);
            }
        }
    }

    #[test]
    fn registers_compute_what_numbers_compute() {
        pulp::Arch::new().dispatch(Try);
        pulp::Arch::Scalar.dispatch(Try);
    }
}
