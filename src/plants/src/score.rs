//! The judge of plant locations, the same for tests, program and experiments.
//!
//! Found plants and true plants are matched one to one: as many pairs as possible no further apart
//! than a radius `r`, and among those matchings the one with the least sum of distances
//! ([`matching`]). With `m` pairs,
//!
//! ```text
//! precision = m / found,   recall = m / truth,   F1 = 2 m / (found + truth).
//! ```
//!
//! Nothing found has no precision, no truth has no recall, and neither has no F1: these are
//! `None`, `null` in JSON. All distances are in pixels.

pub mod matching;
pub(crate) mod tree;

use rowgram_base::error::Error;
use serde::{Deserialize, Serialize};

/// How well plants were found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Number of true plants.
    pub truth: usize,
    /// Number of plants found.
    pub found: usize,
    /// `found - truth`.
    pub count_error: i64,
    /// Median distance of the pairs matched at the largest radius (the mean of the middle two where
    /// their number is even); `None` without a pair.
    pub median_error_px: Option<f64>,
    /// Root of the mean squared distance of the pairs matched at the largest radius; `None`
    /// without a pair.
    pub rms_error_px: Option<f64>,
    /// One entry for each radius, in the order asked for.
    pub radii: Vec<RadiusScore>,
}

/// How well plants were found, within one radius.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RadiusScore {
    /// Largest distance at which a found plant may stand for a true one.
    pub radius_px: f64,
    /// Share of the found plants that are true; `None` where none was found.
    pub precision: Option<f64>,
    /// Share of the true plants that were found; `None` where there is none.
    pub recall: Option<f64>,
    /// Harmonic mean of the two; `None` where nothing was found and nothing is there.
    pub f1: Option<f64>,
}

impl Score {
    /// Scores the positions `found` against `truth`, in pixels, at each of `radii_px`.
    ///
    /// ```
    /// use rowgram_plants::score::Score;
    /// let truth = [[0.0, 0.0], [10.0, 0.0]];
    /// let found = [[1.0, 0.0], [10.0, 2.0], [50.0, 0.0]];
    /// let score = Score::new(&found, &truth, &[1.5, 4.0])?;
    /// assert_eq!((score.count_error, score.median_error_px), (1, Some(1.5)));
    /// assert_eq!((score.radii[0].recall, score.radii[1].recall), (Some(0.5), Some(1.0)));
    /// # Ok::<(), rowgram_base::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::Argument`] where there is no radius, or one is not a positive finite number, or a
    /// position is not finite.
    pub fn new(found: &[[f64; 2]], truth: &[[f64; 2]], radii_px: &[f64]) -> Result<Score, Error> {
        let Some(largest) = radii_px.iter().copied().max_by(f64::total_cmp) else {
            return Err(Error::Argument("expected at least one radius".to_owned()));
        };
        for radius in radii_px {
            if !(radius.is_finite() && *radius > 0.0) {
                return Err(Error::Argument(format!(
                    "radius {radius}: expected a positive number of pixels"
                )));
            }
        }
        if !found.iter().chain(truth).flatten().all(|x| x.is_finite()) {
            return Err(Error::Argument("a position is not a finite number".to_owned()));
        }
        let mut distances: Vec<f64> = Vec::new();
        let mut radii = Vec::with_capacity(radii_px.len());
        for &radius_px in radii_px {
            let pairs = matching::within(found, truth, radius_px);
            radii.push(RadiusScore::new(radius_px, pairs.len(), found.len(), truth.len()));
            if radius_px == largest {
                distances = pairs.iter().map(|pair| pair.distance_px).collect();
            }
        }
        distances.sort_unstable_by(f64::total_cmp);
        Ok(Score {
            truth: truth.len(),
            found: found.len(),
            count_error: found.len() as i64 - truth.len() as i64,
            median_error_px: median(&distances),
            rms_error_px: root_mean_square(&distances),
            radii,
        })
    }
}

impl RadiusScore {
    fn new(radius_px: f64, pairs: usize, found: usize, truth: usize) -> RadiusScore {
        let share = |part: usize, whole: usize| (whole > 0).then(|| part as f64 / whole as f64);
        RadiusScore {
            radius_px,
            precision: share(pairs, found),
            recall: share(pairs, truth),
            f1: share(2 * pairs, found + truth),
        }
    }
}

fn median(sorted: &[f64]) -> Option<f64> {
    let upper = *sorted.get(sorted.len() / 2)?;
    let lower = sorted[(sorted.len() - 1) / 2];
    Some(0.5 * (lower + upper))
}

fn root_mean_square(values: &[f64]) -> Option<f64> {
    let sum: f64 = values.iter().map(|value| value * value).sum();
    (!values.is_empty()).then(|| (sum / values.len() as f64).sqrt())
}

impl std::fmt::Display for Score {
    /// A table for a person.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let pixels =
            |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.2} px"));
        let share =
            |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.4}"));
        writeln!(f, "truth {}, found {} ({:+})", self.truth, self.found, self.count_error)?;
        writeln!(
            f,
            "error of the matched at the largest radius: median {}, RMS {}",
            pixels(self.median_error_px),
            pixels(self.rms_error_px)
        )?;
        write!(f, "{:>9}  {:>9}  {:>6}  {:>6}", "radius px", "precision", "recall", "F1")?;
        for radius in &self.radii {
            let (precision, recall) = (share(radius.precision), share(radius.recall));
            let f1 = share(radius.f1);
            write!(f, "\n{:>9}  {precision:>9}  {recall:>6}  {f1:>6}", radius.radius_px)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn empty_sets_have_no_shares() {
        let point = [[1.0, 2.0]];
        let shares = |found: &[[f64; 2]], truth: &[[f64; 2]]| {
            let score = Score::new(found, truth, &[5.0]).unwrap();
            let radius = score.radii[0];
            (score.count_error, score.rms_error_px, radius.precision, radius.recall, radius.f1)
        };
        assert_eq!(shares(&[], &[]), (0, None, None, None, None));
        assert_eq!(shares(&[], &point), (-1, None, None, Some(0.0), Some(0.0)));
        assert_eq!(shares(&point, &[]), (1, None, Some(0.0), None, Some(0.0)));
        assert_eq!(shares(&point, &point), (0, Some(0.0), Some(1.0), Some(1.0), Some(1.0)));
    }

    #[test]
    fn errors_are_those_at_the_largest_radius() {
        let truth = [[0.0, 0.0], [100.0, 0.0], [200.0, 0.0], [300.0, 0.0]];
        let found = [[1.0, 0.0], [100.0, 3.0], [205.0, 0.0], [309.0, 0.0]];
        let score = Score::new(&found, &truth, &[10.0, 4.0]).unwrap();
        assert_eq!(score.median_error_px, Some(4.0));
        assert_eq!(score.rms_error_px, Some((116.0_f64 / 4.0).sqrt()));
        assert_eq!(score.radii[1].f1, Some(0.5));
        insta::assert_snapshot!(score.to_string(), @r"
        truth 4, found 4 (+0)
        error of the matched at the largest radius: median 4.00 px, RMS 5.39 px
        radius px  precision  recall      F1
               10     1.0000  1.0000  1.0000
                4     0.5000  0.5000  0.5000
        ");
    }

    #[test]
    fn misuse_is_refused() {
        for radii in [&[][..], &[0.0], &[-1.0], &[f64::NAN], &[1.0, f64::INFINITY]] {
            let error = Score::new(&[], &[], radii).unwrap_err();
            assert_eq!(error.kind(), rowgram_base::Kind::BadInput, "{radii:?}");
        }
        assert!(Score::new(&[[f64::NAN, 0.0]], &[], &[1.0]).is_err());
    }

    #[test]
    fn json_has_the_agreed_keys() {
        let score = Score::new(&[], &[[0.0, 0.0]], &[2.5]).unwrap();
        insta::assert_snapshot!(serde_json::to_string(&score).unwrap(), @r#"{"truth":1,"found":0,"count_error":-1,"median_error_px":null,"rms_error_px":null,"radii":[{"radius_px":2.5,"precision":null,"recall":0.0,"f1":0.0}]}"#);
    }
}
