//! One random stream per (seed, stage), so that what one stage draws never moves another's.
//!
//! The generator of the fields has the same rule for its own stages; these are the streams of what
//! comes after it: starts of estimators, gross errors, random sweeps.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// What a stream decides. The numbers are part of what a seed means: they never change.
#[derive(Debug, Clone, Copy)]
#[repr(u64)]
pub(crate) enum Stream {
    /// Where an estimator starts.
    Start = 1,
    /// The draws of a random sweep.
    Sweep = 2,
    /// What a stage draws of its input before anything else: the error of a lens, the instance of a problem.
    Input = 3,
    /// The errors of surveyed control points.
    Control = 4,
    /// The errors of a satellite receiver.
    Receiver = 5,
    /// The seed of a field.
    Field = 6,
    /// The noise of the pixels of a map.
    Pixels = 7,
    /// The resamples of a bootstrap.
    Bootstrap = 8,
}

/// The stream of a stage under a seed.
pub(crate) fn stream(seed: u64, stream: Stream) -> ChaCha8Rng {
    drawn(seed, 0, stream)
}

/// As [`stream`], for one of several draws under a seed.
pub(crate) fn drawn(seed: u64, draw: u64, stream: Stream) -> ChaCha8Rng {
    let mut key = [0; 32];
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8..16].copy_from_slice(&(stream as u64).to_le_bytes());
    // Apart from the generator's streams, which leave these bytes at 0.
    key[16..24].copy_from_slice(b"measured");
    key[24..].copy_from_slice(&draw.to_le_bytes());
    ChaCha8Rng::from_seed(key)
}

#[cfg(test)]
mod tests {
    use super::*;
    use data_synth::scenario::{Preset, Scenario};
    use rand::RngExt;

    #[test]
    fn streams_repeat_and_differ() {
        let first = |seed, which| stream(seed, which).random::<u64>();
        assert_eq!(first(1, Stream::Start), first(1, Stream::Start));
        assert_ne!(first(1, Stream::Start), first(1, Stream::Sweep));
        assert_ne!(first(1, Stream::Start), first(2, Stream::Start));
        assert_ne!(drawn(1, 1, Stream::Start).random::<u64>(), first(1, Stream::Start));
    }

    #[test]
    fn a_corruption_does_not_move_the_truth() {
        let mut scenario = Scenario::preset(Preset::Early20);
        (scenario.field.rows, scenario.field.row_length_m) = (2, 2.0);
        let clean = scenario.build().unwrap();
        scenario.corruption.weeds_per_m2 = 5.0;
        scenario.corruption.missed_fraction = 0.2;
        let dirty = scenario.build().unwrap();
        assert_eq!(clean.field.plants, dirty.field.plants);
        assert!(dirty.weeds.len() > clean.weeds.len());
    }
}
