//! Keys: one digest of everything that decides a result.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::fmt;

/// SHA-256 of everything that decides a result: the build of the program, contents of inputs, options, results of the steps
/// before. Two results with one key are the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub(crate) struct Key([u8; 32]);

impl Key {
    /// A key to be filled; it holds the build of the program.
    pub(crate) fn begin() -> KeyBuilder {
        KeyBuilder(Sha256::new()).text(crate::BUILD)
    }

    /// The key of some bytes alone, whatever program reads them.
    pub(crate) fn of_bytes(bytes: &[u8]) -> Key {
        Key(Sha256::digest(bytes).into())
    }

    /// As it stands in files.
    pub(crate) fn bytes(&self) -> &[u8; 32] {
        &self.0
    }
}

impl fmt::Display for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&digits(&self.0))
    }
}

/// A key that is not complete yet. Every part says how long it is, so that no two lists of parts are the same bytes.
#[derive(Debug, Clone)]
pub(crate) struct KeyBuilder(Sha256);

impl KeyBuilder {
    fn part(mut self, kind: u8, bytes: &[u8]) -> KeyBuilder {
        self.0.update([kind]);
        self.0.update((bytes.len() as u64).to_le_bytes());
        self.0.update(bytes);
        self
    }

    /// Adds words, such as options as they are written.
    pub(crate) fn text(self, text: &str) -> KeyBuilder {
        self.part(b't', text.as_bytes())
    }

    /// Adds a whole number.
    pub(crate) fn count(self, count: u64) -> KeyBuilder {
        self.part(b'c', &count.to_le_bytes())
    }

    /// Adds numbers, bit by bit.
    pub(crate) fn numbers(self, numbers: &[f64]) -> KeyBuilder {
        let bytes: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
        self.part(b'n', &bytes)
    }

    /// Adds the key of a content or of a step before.
    pub(crate) fn key(self, key: Key) -> KeyBuilder {
        self.part(b'k', key.bytes())
    }

    /// The key.
    pub(crate) fn finish(self) -> Key {
        Key(self.0.finalize().into())
    }
}

/// Hexadecimal digits of a digest.
pub(super) fn digits(digest: &[u8]) -> String {
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_part_and_its_place_matter() {
        let key =
            |parts: &[&str]| parts.iter().fold(Key::begin(), |key, part| key.text(part)).finish();
        assert_eq!(key(&["ab", "c"]), key(&["ab", "c"]));
        for other in [&["a", "bc"][..], &["abc"], &["c", "ab"], &["ab", "c", ""]] {
            assert_ne!(key(&["ab", "c"]), key(other), "{other:?}");
        }
        assert_ne!(
            Key::begin().count(1).finish(),
            Key::begin().numbers(&[f64::from_bits(1)]).finish()
        );
        assert_ne!(Key::begin().numbers(&[0.0]).finish(), Key::begin().numbers(&[-0.0]).finish());
        let one = Key::of_bytes(b"one");
        assert_ne!(Key::begin().key(one).finish(), Key::begin().text(&one.to_string()).finish());
        // The build is part of it.
        assert_ne!(Key::begin().finish(), KeyBuilder(Sha256::new()).finish());
    }
}
