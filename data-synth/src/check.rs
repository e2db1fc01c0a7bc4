//! Parameters that cannot be used: which one, what it is, what was expected.

use std::{fmt::Display, ops::RangeInclusive};

/// A parameter of a configuration that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{parameter} = {found}: expected {expected}")]
pub struct ConfigError {
    /// The parameter, as it is spelled in the configuration.
    pub parameter: &'static str,
    /// Its value.
    pub found: String,
    /// What was expected.
    pub expected: String,
}

impl ConfigError {
    pub(crate) fn new(
        parameter: &'static str,
        found: impl Display,
        expected: impl Into<String>,
    ) -> ConfigError {
        ConfigError { parameter, found: found.to_string(), expected: expected.into() }
    }
}

/// Refuses a value outside `range`; NaN is outside every range.
pub(crate) fn within<T: PartialOrd + Display>(
    parameter: &'static str,
    found: T,
    range: RangeInclusive<T>,
) -> Result<(), ConfigError> {
    if range.contains(&found) {
        return Ok(());
    }
    let expected = format!("a number from {} to {}", range.start(), range.end());
    Err(ConfigError::new(parameter, found, expected))
}

/// Refuses a seed that a TOML file cannot hold (its integers are signed).
pub(crate) fn seed(found: u64) -> Result<(), ConfigError> {
    within("seed", found, 0..=i64::MAX.unsigned_abs())
}
