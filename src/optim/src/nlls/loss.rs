//! Robust losses.
//!
//! A factor with residual `r` contributes `1/2 rho(s)`, `s = |r|^2`, to the cost. Each loss has one
//! scale `a > 0` in the unit of the residual, and `rho(s) = s + O(s^2)` near 0 so that small
//! residuals keep their meaning.
//!
//! | loss | `rho(s)` |
//! |---|---|
//! | `Trivial` | `s` |
//! | `Huber` | `s` up to `a^2`, then `2 a sqrt(s) - a^2` |
//! | `SoftL1` | `2 a^2 (sqrt(1 + s/a^2) - 1)` |
//! | `Cauchy` | `a^2 ln(1 + s/a^2)` |
//! | `GemanMcClure` | `s / (1 + s/a^2)` |
//! | `Tukey` | `a^2/3 (1 - (1 - s/a^2)^3)` up to `a^2`, then `a^2/3` |
//!
//! Reference: B. Triggs et al., *Bundle Adjustment - A Modern Synthesis*, 2000, section 4.3.

use serde::{Deserialize, Serialize};
use std::{any::Any, fmt::Debug};

/// A robust loss with its scale.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Loss {
    /// Least squares.
    #[default]
    Trivial,
    /// Quadratic, then linear in the length of the residual.
    Huber(f64),
    /// A smooth Huber.
    SoftL1(f64),
    /// Grows with the logarithm.
    Cauchy(f64),
    /// Bounded by `a^2`.
    GemanMcClure(f64),
    /// Bounded by `a^2/3`; without influence beyond `a`.
    Tukey(f64),
}

/// `rho` and its first two derivatives at one `s`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rho {
    /// `rho(s)`.
    pub value: f64,
    /// `rho'(s)`, at least 0.
    pub first: f64,
    /// `rho''(s)`, at most 0.
    pub second: f64,
}

/// A function `rho` of `s = |r|^2`, applied to every factor of a batch.
///
/// The set is open: [`Loss`] holds the built-in ones, and [`super::check::check_loss`] tests one of
/// your own. It must be concave with `rho(0) = 0` and `rho'(0) = 1`.
pub trait LossFunction: Any + Debug + Send + Sync {
    /// `rho`, `rho'` and `rho''` at `s >= 0`.
    fn evaluate(&self, s: f64) -> Rho;

    /// What is wrong with its parameters, if anything.
    fn defect(&self) -> Option<String> {
        None
    }
}

impl LossFunction for Loss {
    #[inline]
    fn evaluate(&self, s: f64) -> Rho {
        Loss::evaluate(*self, s)
    }

    fn defect(&self) -> Option<String> {
        Loss::defect(*self)
    }
}

/// The loss of a batch: the built-in ones are evaluated without a virtual call.
#[derive(Debug)]
pub(super) enum BatchLoss {
    BuiltIn(Loss),
    Custom(Box<dyn LossFunction>),
}

impl BatchLoss {
    pub(super) fn new(loss: impl LossFunction) -> BatchLoss {
        let any: &dyn Any = &loss;
        match any.downcast_ref::<Loss>() {
            Some(built_in) => BatchLoss::BuiltIn(*built_in),
            None => BatchLoss::Custom(Box::new(loss)),
        }
    }

    /// Whether it is plain least squares.
    #[inline]
    pub(super) fn is_trivial(&self) -> bool {
        matches!(self, BatchLoss::BuiltIn(Loss::Trivial))
    }

    #[inline]
    pub(super) fn evaluate(&self, s: f64) -> Rho {
        match self {
            BatchLoss::BuiltIn(loss) => loss.evaluate(s),
            BatchLoss::Custom(loss) => call(loss.as_ref(), s),
        }
    }
}

/// Out of line, so that the loops over built-in losses stay small.
#[cold]
#[inline(never)]
fn call(loss: &dyn LossFunction, s: f64) -> Rho {
    loss.evaluate(s)
}

impl Loss {
    /// `rho`, `rho'` and `rho''` at `s = |r|^2 >= 0`.
    #[inline]
    pub fn evaluate(self, s: f64) -> Rho {
        match self {
            Loss::Trivial => Rho { value: s, first: 1.0, second: 0.0 },
            Loss::Huber(a) => {
                if s <= a * a {
                    Rho { value: s, first: 1.0, second: 0.0 }
                } else {
                    let root = s.sqrt();
                    let first = a / root;
                    Rho { value: 2.0 * a * root - a * a, first, second: -first / (2.0 * s) }
                }
            }
            Loss::SoftL1(a) => {
                let (square, sum) = (a * a, 1.0 + s / (a * a));
                let root = sum.sqrt();
                Rho {
                    // (root - 1), without its cancellation for small s
                    value: 2.0 * s / (root + 1.0),
                    first: 1.0 / root,
                    second: -1.0 / (2.0 * square * sum * root),
                }
            }
            Loss::Cauchy(a) => {
                let square = a * a;
                let first = 1.0 / (1.0 + s / square);
                Rho { value: square * (s / square).ln_1p(), first, second: -first * first / square }
            }
            Loss::GemanMcClure(a) => {
                let square = a * a;
                let inverse = 1.0 / (1.0 + s / square);
                Rho {
                    value: s * inverse,
                    first: inverse * inverse,
                    second: -2.0 * inverse.powi(3) / square,
                }
            }
            Loss::Tukey(a) => {
                let square = a * a;
                if s >= square {
                    return Rho { value: square / 3.0, first: 0.0, second: 0.0 };
                }
                let t = s / square;
                let rest = 1.0 - t;
                Rho {
                    // (1 - (1 - t)^3) / 3, multiplied out so that small t keeps its digits
                    value: s * (1.0 - t + t * t / 3.0),
                    first: rest * rest,
                    second: -2.0 * rest / square,
                }
            }
        }
    }

    /// What is wrong with the scale, if anything.
    pub fn defect(self) -> Option<String> {
        let a = self.scale()?;
        (!(a.is_finite() && a > 0.0)).then(|| {
            format!("the scale of the {} loss is {a}, it must be a positive number", self.name())
        })
    }

    fn scale(self) -> Option<f64> {
        match self {
            Loss::Trivial => None,
            Loss::Huber(a)
            | Loss::SoftL1(a)
            | Loss::Cauchy(a)
            | Loss::GemanMcClure(a)
            | Loss::Tukey(a) => Some(a),
        }
    }

    fn name(self) -> &'static str {
        match self {
            Loss::Trivial => "trivial",
            Loss::Huber(_) => "huber",
            Loss::SoftL1(_) => "soft-l1",
            Loss::Cauchy(_) => "cauchy",
            Loss::GemanMcClure(_) => "geman-mcclure",
            Loss::Tukey(_) => "tukey",
        }
    }
}

impl std::fmt::Display for Loss {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.scale() {
            None => f.write_str(self.name()),
            Some(a) => write!(f, "{}:{a}", self.name()),
        }
    }
}

impl std::str::FromStr for Loss {
    type Err = String;

    /// Reads `trivial`, `huber:1.0`, `cauchy:2` and so on.
    fn from_str(text: &str) -> Result<Loss, String> {
        let (word, scale) = match text.split_once(':') {
            Some((word, scale)) => (word, Some(scale)),
            None => (text, None),
        };
        let with_scale = |make: fn(f64) -> Loss| {
            let scale = scale.ok_or_else(|| format!("{word} needs a scale, e.g. {word}:1.0"))?;
            let a = scale.parse().map_err(|_| format!("{scale:?} is not a number"))?;
            let loss = make(a);
            loss.defect().map_or(Ok(loss), Err)
        };
        match word {
            "trivial" | "none" if scale.is_none() => Ok(Loss::Trivial),
            "huber" => with_scale(Loss::Huber),
            "soft-l1" => with_scale(Loss::SoftL1),
            "cauchy" => with_scale(Loss::Cauchy),
            "geman-mcclure" => with_scale(Loss::GemanMcClure),
            "tukey" => with_scale(Loss::Tukey),
            _ => Err(format!(
                "unknown loss {text:?}; expected trivial, huber:A, soft-l1:A, cauchy:A, geman-mcclure:A or tukey:A"
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn losses(a: f64) -> [Loss; 6] {
        [
            Loss::Trivial,
            Loss::Huber(a),
            Loss::SoftL1(a),
            Loss::Cauchy(a),
            Loss::GemanMcClure(a),
            Loss::Tukey(a),
        ]
    }

    proptest! {
        #[test]
        fn derivatives_match_differences(a in 0.3..4.0f64, s in 0.001..40.0f64) {
            for loss in losses(a) {
                // Where rho'' jumps a difference across the corner means nothing.
                prop_assume!((s - a * a).abs() > 1e-3);
                let found = crate::nlls::check::check_loss(&loss, s);
                prop_assert!(found.is_ok(), "{found:?}");
            }
        }

        #[test]
        fn small_residuals_keep_their_meaning(a in 0.3..4.0f64, exponent in 3..15i32) {
            let s = 10f64.powi(-exponent);
            for loss in losses(a) {
                let value = loss.evaluate(s).value;
                prop_assert!((value / s - 1.0).abs() < 2.0 * s / (a * a) + 1e-14, "{loss}: {value}");
            }
        }

        #[test]
        fn words_are_read_back(a in 0.001..1e3f64) {
            for loss in losses(a) {
                prop_assert_eq!(loss.to_string().parse::<Loss>().unwrap(), loss);
            }
        }
    }

    #[test]
    fn bad_words_are_named() {
        for text in ["huber", "huber:-1", "huber:NaN", "huber:x", "absolute:1", "trivial:2", ""] {
            assert!(text.parse::<Loss>().is_err(), "{text}");
        }
    }
}
