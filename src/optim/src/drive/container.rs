//! The checkpoint container: one line of JSON that a person can read, then the bytes of a run.
//!
//! ```text
//! {"format":"rowgram-checkpoint","version":2,"engine":"...","fingerprint":"...","iteration":40,
//!  "bytes":8112,"checksum":"..."}          (one line, ended by \n)
//! <exactly `bytes` bytes of CBOR>
//! ```
//! CBOR holds every `f64` to the last bit, NaN and infinities among them, which JSON cannot; the
//! length and the checksum tell a truncated or damaged file from a whole one before anything in it
//! is believed.

use crate::output::{self, FileError};
use serde::{Deserialize, Serialize};
use std::{
    fs::File,
    io::{BufRead, BufReader, Read},
    path::Path,
};

const FORMAT: &str = "rowgram-checkpoint";
const VERSION: u32 = 2;
/// No header is longer; a file without a line end before it is not a checkpoint.
const LONGEST_HEADER_BYTES: u64 = 4096;

/// A 64-bit mark of some numbers (FNV-1a), the same on every machine and in every release.
///
/// Tells problems apart so that a checkpoint is not resumed on another one; it is no defence
/// against somebody who wants two to collide.
///
/// ```
/// use rowgram_optim::drive::Fingerprint;
/// let mark = Fingerprint::new().count(3).numbers(&[0.5, 1.5]).text("huber:1.0").finish();
/// assert_ne!(mark, Fingerprint::new().count(3).numbers(&[0.5, -1.5]).text("huber:1.0").finish());
/// ```
#[derive(Debug, Clone, Copy)]
#[must_use]
pub struct Fingerprint(u64);

impl Default for Fingerprint {
    fn default() -> Self {
        Fingerprint::new()
    }
}

impl Fingerprint {
    /// The mark of nothing.
    pub fn new() -> Fingerprint {
        Fingerprint(0xcbf2_9ce4_8422_2325)
    }

    /// Adds bytes, without their number.
    pub fn bytes(mut self, bytes: &[u8]) -> Fingerprint {
        for byte in bytes {
            self.0 = (self.0 ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
        self
    }

    /// Adds a whole number.
    pub fn count(self, count: u64) -> Fingerprint {
        self.bytes(&count.to_le_bytes())
    }

    /// Adds the number and the bits of `numbers`.
    pub fn numbers(self, numbers: &[f64]) -> Fingerprint {
        let counted = self.count(numbers.len() as u64);
        numbers.iter().fold(counted, |mark, number| mark.bytes(&number.to_bits().to_le_bytes()))
    }

    /// Adds a word or a sentence.
    pub fn text(self, text: &str) -> Fingerprint {
        self.count(text.len() as u64).bytes(text.as_bytes())
    }

    /// The mark.
    pub fn finish(self) -> u64 {
        self.0
    }
}

/// What a checkpoint says about itself before its content is read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Header {
    /// Name of the engine that wrote it.
    pub engine: String,
    /// Mark of the problem it belongs to.
    pub fingerprint: u64,
    /// How many iterations had been made.
    pub iteration: u64,
}

/// Format and version first: they say whether the other fields can be understood.
#[derive(Deserialize)]
struct Kind {
    format: String,
    version: u32,
}

#[derive(Serialize, Deserialize)]
struct Line {
    format: String,
    version: u32,
    engine: String,
    fingerprint: String,
    iteration: u64,
    bytes: u64,
    checksum: String,
}

/// Writes a checkpoint atomically.
///
/// # Errors
/// As [`output::write`].
pub(super) fn write(
    path: &Path,
    force: bool,
    header: &Header,
    body: &[u8],
) -> Result<(), FileError> {
    let line = Line {
        format: FORMAT.to_owned(),
        version: VERSION,
        engine: header.engine.clone(),
        fingerprint: hexadecimal(header.fingerprint),
        iteration: header.iteration,
        bytes: body.len() as u64,
        checksum: hexadecimal(Fingerprint::new().bytes(body).finish()),
    };
    output::write(path, force, |file| {
        serde_json::to_writer(&mut *file, &line)?;
        file.write_all(b"\n")?;
        file.write_all(body)
    })
}

/// Reads a checkpoint back, whole or not at all.
///
/// # Errors
/// [`FileError::Read`] where it cannot be read; [`FileError::Malformed`] where it is no checkpoint,
/// of another version, truncated or damaged.
pub(super) fn read(path: &Path) -> Result<(Header, Vec<u8>), FileError> {
    let unreadable = |source| FileError::read(path, source);
    let malformed = |message: String| FileError::malformed(path, None, message);
    let mut file = BufReader::new(File::open(path).map_err(unreadable)?);

    let mut text = Vec::new();
    (&mut file).take(LONGEST_HEADER_BYTES).read_until(b'\n', &mut text).map_err(unreadable)?;
    let kind: Kind = serde_json::from_slice(&text)
        .ok()
        .filter(|kind: &Kind| kind.format == FORMAT)
        .ok_or_else(|| malformed("this is not a rowgram checkpoint".to_owned()))?;
    if kind.version != VERSION {
        return Err(malformed(format!(
            "checkpoint format {} cannot be read, only format {VERSION}",
            kind.version
        )));
    }
    let line: Line = serde_json::from_slice(&text)
        .map_err(|error| malformed(format!("the checkpoint's first line: {error}")))?;
    let fingerprint = u64::from_str_radix(&line.fingerprint, 16).map_err(|_| {
        malformed(format!("fingerprint is not a hexadecimal number: {}", line.fingerprint))
    })?;

    let mut body = Vec::new();
    file.take(line.bytes.saturating_add(1)).read_to_end(&mut body).map_err(unreadable)?;
    if body.len() as u64 != line.bytes {
        let what = if (body.len() as u64) < line.bytes { "truncated" } else { "too long" };
        return Err(malformed(format!(
            "the checkpoint is {what}: {} bytes were announced, {} are there",
            line.bytes,
            if what == "truncated" { body.len().to_string() } else { "more".to_owned() },
        )));
    }
    if hexadecimal(Fingerprint::new().bytes(&body).finish()) != line.checksum {
        return Err(malformed("the checkpoint is damaged: its checksum differs".to_owned()));
    }
    Ok((Header { engine: line.engine, fingerprint, iteration: line.iteration }, body))
}

fn hexadecimal(number: u64) -> String {
    format!("{number:016x}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn header() -> Header {
        Header { engine: "toy".to_owned(), fingerprint: 0xfeed, iteration: 7 }
    }

    #[test]
    fn what_is_written_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.checkpoint");
        write(&path, false, &header(), b"\n\x00body").unwrap();
        assert_eq!(read(&path).unwrap(), (header(), b"\n\x00body".to_vec()));
    }

    #[test]
    fn the_mark_never_changes() {
        assert_eq!(Fingerprint::new().bytes(b"foobar").finish(), 0x8594_4171_f739_67e8);
        assert_eq!(Fingerprint::new().bytes(b"a").finish(), 0xaf63_dc4c_8601_ec8c);
    }

    #[test]
    fn another_version_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.checkpoint");
        std::fs::write(&path, "{\"format\":\"rowgram-checkpoint\",\"version\":9}\n").unwrap();
        let message = read(&path).unwrap_err().to_string();
        assert!(message.contains("format 9 cannot be read"), "{message}");
    }

    proptest! {
        /// Whatever happens to the file, it is read whole or refused.
        #[test]
        fn damage_is_refused(
            body in proptest::collection::vec(any::<u8>(), 0..64),
            place in any::<proptest::sample::Index>(),
            value in any::<u8>(),
            cut in any::<bool>(),
        ) {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("run.checkpoint");
            write(&path, false, &header(), &body).unwrap();
            let mut bytes = std::fs::read(&path).unwrap();
            let place = place.index(bytes.len());
            if cut { bytes.truncate(place) } else { bytes[place] = value }
            std::fs::write(&path, &bytes).unwrap();
            if let Ok((_, read)) = read(&path) {
                prop_assert_eq!(read, body);
            }
        }
    }
}
