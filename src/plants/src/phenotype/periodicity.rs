//! Whether a profile across the rows repeats itself, and at what distance. Profiles are leaf pixels by position,
//! one strip a pixel; distances in pixels.

/// Two rows at the borders of a profile are too few to repeat themselves: where the best cut in two leaves
/// this share of the variance between the parts (a single row leaves 0.6 to 0.75), they are two rows.
const TWO_ROWS: f64 = 0.9;

/// How far the autocorrelation of rows rises from its valleys to its peaks, of the variance.
const MIN_RISE: f64 = 0.1;

/// The distance between two rows, if a profile is nothing but two rows.
pub(super) fn two_rows(profile: &[f64]) -> Option<f64> {
    let all: f64 = profile.iter().sum();
    let moment = |power: i32| -> f64 {
        profile.iter().enumerate().map(|(k, n)| n * (k as f64).powi(power)).sum::<f64>() / all
    };
    let mean = moment(1);
    let variance = moment(2) - mean * mean;
    let (mut below, mut first) = (0.0, 0.0);
    let mut best = (0.0, 0.0);
    for (k, n) in profile.iter().enumerate() {
        below += n;
        first += n * k as f64;
        let above = all - below;
        if below <= 0.0 || above <= 0.0 {
            continue;
        }
        let apart = (all * mean - first) / above - first / below;
        let between = below / all * (above / all) * apart * apart;
        if between > best.0 {
            best = (between, apart);
        }
    }
    (best.0 > TWO_ROWS * variance).then_some(best.1)
}

/// The lag at which a profile repeats itself, if it does.
pub(super) fn period(profile: &[f64]) -> Option<f64> {
    let profile = blur(profile, 2.0);
    let mean = profile.iter().sum::<f64>() / profile.len() as f64;
    let centred: Vec<f64> = profile.iter().map(|x| x - mean).collect();
    // Rows more than 4000 pixels apart are not looked for.
    let lags = (profile.len() * 3 / 4).min(4000);
    let correlation: Vec<f64> = (0..lags)
        .map(|lag| {
            let sum: f64 = centred.iter().zip(&centred[lag..]).map(|(a, b)| a * b).sum();
            // Per overlap, but not so that a handful of strips decides.
            sum / (profile.len() - lag) as f64
        })
        .collect();
    let variance = correlation.first().copied().filter(|&v| v > 0.0)?;
    let correlation = blur(&correlation, 1.5);
    // What changes slowly over the field keeps the valleys between peaks from falling below zero; a peak is what rises
    // above a valley before it.
    let mut lowest = f64::INFINITY;
    let mut peaks: Vec<usize> = Vec::new();
    // Smoothing takes something from the first lags.
    for k in 4..correlation.len().saturating_sub(1) {
        lowest = lowest.min(correlation[k - 1]);
        let is_peak = correlation[k] > correlation[k - 1] && correlation[k] >= correlation[k + 1];
        if is_peak && correlation[k] - lowest >= MIN_RISE * variance {
            peaks.push(k);
        }
    }
    let best = peaks.iter().map(|&k| correlation[k]).fold(0.0, f64::max);
    if best < 0.15 * variance {
        return None;
    }
    // The first that is nearly as high as the highest: later ones are its multiples.
    peaks.into_iter().find(|&k| correlation[k] >= 0.6 * best).map(|k| k as f64)
}

/// Three box filters in a row, nearly a Gaussian; the ends are repeated as zero.
pub(super) fn blur(values: &[f64], sigma: f64) -> Vec<f64> {
    let radius = ((sigma * sigma * 4.0 + 1.0).sqrt() / 2.0 - 0.5).round().max(0.0) as usize;
    let mut values = values.to_vec();
    for _ in 0..3 {
        let mut sums = vec![0.0; values.len() + 1];
        for (k, value) in values.iter().enumerate() {
            sums[k + 1] = sums[k] + value;
        }
        for (k, value) in values.iter_mut().enumerate() {
            let (first, last) = (k.saturating_sub(radius), (k + radius + 1).min(sums.len() - 1));
            *value = (sums[last] - sums[first]) / (2 * radius + 1) as f64;
        }
    }
    values
}
