//! The flights of a season over one field: when, in which light, with which control.
//!
//! All flights see the same ground and the same plants ([`crate::season`]). Sun, wind, height, direction of the strips and weeds
//! differ from flight to flight by draws of the season's seed. The first flight has the ground control of the
//! configuration; later ones have none: their targets are plates too small to be seen, held back to judge the maps.

use crate::{
    camera::CameraConfig,
    check::{ConfigError, within},
    clutter::ClutterConfig,
    corrupt::Corruption,
    field::{FieldConfig, words},
    flight::{FlightConfig, GnssConfig},
    habit::PlotConfig,
    season::SeasonDay,
    streams::{Draw, Stage, stream},
    targets::TargetConfig,
    terrain::TerrainConfig,
    tie_points::TiePointConfig,
    twin::TwinConfig,
};
use serde::{Deserialize, Serialize};
use std::{fmt, str::FromStr};

/// Side of the plates that only judge a flight, metres: less than four pixels of a low flight.
const UNSEEN_M: f64 = 0.02;

/// Everything that decides a season.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SeasonConfig {
    /// When the field was sown, `YYYY-MM-DD`.
    pub sown: String,
    /// Days from sowing to each flight, rising.
    pub days: Vec<u32>,
    /// Standard deviation of the direction of the sun from flight to flight, degrees.
    pub sun_azimuth_deg: f64,
    /// Standard deviation of the height of the sun from flight to flight, degrees.
    pub sun_elevation_deg: f64,
    /// Standard deviation of the flying height from flight to flight, fraction.
    pub height_spread: f64,
    /// Standard deviation of the logarithm of the light from flight to flight.
    pub light_spread: f64,
    /// Standard deviation of the logarithm of its red and of its blue against green.
    pub cast_spread: f64,
    /// Weeds of the last flight, per square metre; they become more from sowing on.
    pub weeds_per_m2: f64,
    /// Field, camera and flight; of the flight's day only what its plants do counts.
    pub twin: TwinConfig,
}

impl Default for SeasonConfig {
    fn default() -> SeasonConfig {
        SeasonConfig::preset(SeasonPreset::Small)
    }
}

/// The usual seasons by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SeasonPreset {
    /// Six flights over eight plots.
    Small,
    /// Three flights over two plots, for tests.
    Tiny,
}

impl SeasonPreset {
    /// Every preset.
    pub const ALL: &'static [SeasonPreset] = &[SeasonPreset::Small, SeasonPreset::Tiny];
}

words!(SeasonPreset { "small" = Small, "tiny" = Tiny });

impl SeasonConfig {
    /// The configuration of a preset, with seed 1.
    pub fn preset(preset: SeasonPreset) -> SeasonConfig {
        let small = SeasonConfig {
            sown: "2015-05-20".to_owned(),
            days: vec![8, 10, 12, 16, 21, 28],
            sun_azimuth_deg: 25.0,
            sun_elevation_deg: 6.0,
            height_spread: 0.03,
            light_spread: 0.0,
            cast_spread: 0.0,
            weeds_per_m2: 0.6,
            twin: TwinConfig {
                field: FieldConfig {
                    rows: 12,
                    row_length_m: 9.0,
                    spacing_m: 0.25,
                    heading_deg: 12.0,
                    curve_m: 0.02,
                    doubles_fraction: 0.0,
                    plots: PlotConfig { rows: 3, length_m: 4.0, alley_m: 1.0 },
                    terrain: TerrainConfig {
                        slope_percent: 1.5,
                        slope_direction_deg: 70.0,
                        relief_m: 0.05,
                        relief_wavelength_m: 4.0,
                        furrow_m: 0.03,
                    },
                    season: Some(SeasonDay::default()),
                    ..FieldConfig::default()
                },
                corruption: Corruption { grass_share: 0.3, ..Corruption::default() },
                clutter: ClutterConfig { residue_per_m2: 1.0, stones_per_m2: 1.0 },
                camera: CameraConfig::compact(1000, 750, 800.0),
                flight: FlightConfig {
                    height_m: 6.0,
                    margin_m: -1.5,
                    forward_overlap: 0.65,
                    speed_m_s: 2.0,
                    position_m: 0.1,
                    height_drift_m: 0.1,
                    gnss: GnssConfig {
                        horizontal_m: 0.4,
                        vertical_m: 0.6,
                        ..GnssConfig::default()
                    },
                    ..FlightConfig::default()
                },
                targets: TargetConfig {
                    control: 4,
                    check: 4,
                    size_m: 0.25,
                    ..TargetConfig::default()
                },
                tie_points: TiePointConfig { per_photo: 0, ..TiePointConfig::default() },
                ..TwinConfig::default()
            },
        };
        match preset {
            SeasonPreset::Small => small,
            SeasonPreset::Tiny => {
                let mut tiny = small;
                tiny.days = vec![10, 15, 21];
                let twin = &mut tiny.twin;
                (twin.field.rows, twin.field.row_length_m) = (4, 5.0);
                twin.field.plots = PlotConfig { rows: 2, length_m: 0.0, alley_m: 0.0 };
                twin.camera = CameraConfig::compact(640, 480, 512.0);
                twin.flight.margin_m = -0.5;
                tiny
            }
        }
    }

    /// Checks every parameter that can be checked on its own.
    ///
    /// # Errors
    /// The first parameter that cannot be used.
    pub fn check(&self) -> Result<(), ConfigError> {
        self.twin.check()?;
        if self.twin.field.season.is_none() {
            return Err(ConfigError::new("twin.field.season", "nothing", "how the plants grow"));
        }
        if days_from_epoch(&self.sown).is_none() {
            return Err(ConfigError::new("sown", &self.sown, "a date like 2015-05-20"));
        }
        let rising = self.days.windows(2).all(|pair| pair[0] < pair[1]);
        if self.days.is_empty() || !rising || self.days.iter().any(|&day| day > 1000) {
            let expected = "rising numbers of days up to 1000, one or more";
            return Err(ConfigError::new("days", format!("{:?}", self.days), expected));
        }
        within("sun_azimuth_deg", self.sun_azimuth_deg, 0.0..=90.0)?;
        within("sun_elevation_deg", self.sun_elevation_deg, 0.0..=15.0)?;
        within("height_spread", self.height_spread, 0.0..=0.2)?;
        within("light_spread", self.light_spread, 0.0..=0.5)?;
        within("cast_spread", self.cast_spread, 0.0..=0.3)?;
        within("weeds_per_m2", self.weeds_per_m2, 0.0..=1000.0)
    }

    /// The date of flight `k`, `YYYY-MM-DD`.
    pub fn date(&self, k: usize) -> String {
        let sown = days_from_epoch(&self.sown).unwrap_or_default();
        date_of(sown + i64::from(self.days[k]))
    }

    /// The configuration of flight `k`.
    ///
    /// # Errors
    /// As [`SeasonConfig::check`].
    pub fn flight(&self, k: usize) -> Result<TwinConfig, ConfigError> {
        self.check()?;
        let mut twin = self.twin.clone();
        let mut rng = stream(twin.field.seed, Stage::Weather, k as u64);
        let day = f64::from(self.days[k]);
        if let Some(season) = &mut twin.field.season {
            (season.day, season.flight) = (day, k as u64);
        }
        let (image, flight) = (&mut twin.image, &mut twin.flight);
        image.sun_azimuth_deg += self.sun_azimuth_deg * rng.normal().clamp(-2.5, 2.5);
        let elevation_deg = image.sun_elevation_deg + self.sun_elevation_deg * rng.normal();
        image.sun_elevation_deg = elevation_deg.clamp(25.0, 75.0);
        // A stream of its own, as all else of a seed stays what it was.
        let mut colours = stream(twin.field.seed, Stage::Weather, (1 << 32) + k as u64);
        let [light, red, blue] = [self.light_spread, self.cast_spread, self.cast_spread]
            .map(|spread| (spread * colours.normal().clamp(-2.5, 2.5)).exp());
        image.light =
            [image.light[0] * light * red, image.light[1] * light, image.light[2] * light * blue];
        image.exposure_spread *= rng.between(0.5, 1.5);
        flight.height_m *= 1.0 + self.height_spread * rng.normal().clamp(-2.5, 2.5);
        flight.wind_m_s = (flight.wind_m_s * rng.between(0.3, 1.6)).min(0.8 * flight.speed_m_s);
        flight.wind_direction_deg = rng.between(-180.0, 180.0);
        flight.direction_deg += 1.5 * rng.normal().clamp(-2.5, 2.5);
        // Weeds come with the crop.
        let last = self.days.last().copied().map_or(1.0, f64::from).max(1.0);
        twin.corruption.weeds_per_m2 = self.weeds_per_m2 * day / last;
        let minutes = rng.between(0.0, 180.0) as u32;
        twin.site.start =
            format!("{} {:02}:{:02}:00", self.date(k), 10 + minutes / 60, minutes % 60);
        if k > 0 {
            twin.targets.check += std::mem::take(&mut twin.targets.control);
            twin.targets.size_m = UNSEEN_M;
            twin.targets.above_m = 0.0;
        }
        Ok(twin)
    }
}

/// Days from 1970-01-01 to a date, `YYYY-MM-DD`, of the Gregorian calendar.
///
/// Reference: H. Hinnant, *chrono-compatible low-level date algorithms*, 2013.
fn days_from_epoch(date: &str) -> Option<i64> {
    let parts: Vec<&str> = date.split('-').collect();
    let [year, month, day] = parts[..] else { return None };
    let digits =
        |part: &str, width| part.len() == width && part.bytes().all(|b| b.is_ascii_digit());
    if !(digits(year, 4) && digits(month, 2) && digits(day, 2)) {
        return None;
    }
    let (year, month, day): (i64, i64, i64) =
        (year.parse().ok()?, month.parse().ok()?, day.parse().ok()?);
    let y = if month <= 2 { year - 1 } else { year };
    let era = y.div_euclid(400);
    let of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
    let of_era = y.rem_euclid(400);
    let days = era * 146_097 + of_era * 365 + of_era / 4 - of_era / 100 + of_year - 719_468;
    (date_of(days) == date).then_some(days)
}

/// The date so many days after 1970-01-01.
fn date_of(days: i64) -> String {
    let z = days + 719_468;
    let era = z.div_euclid(146_097);
    let of_era = z.rem_euclid(146_097);
    let year = (of_era - of_era / 1460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year + year / 4 - year / 100);
    let m = (5 * of_year + 2) / 153;
    let day = of_year - (153 * m + 2) / 5 + 1;
    let month = if m < 10 { m + 3 } else { m - 9 };
    let year = year + era * 400 + i64::from(month <= 2);
    format!("{year:04}-{month:02}-{day:02}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_are_valid_and_read_their_own_names() {
        for &preset in SeasonPreset::ALL {
            let config = SeasonConfig::preset(preset);
            for k in 0..config.days.len() {
                config.flight(k).unwrap().check().unwrap();
            }
            assert_eq!(preset.to_string().parse(), Ok(preset));
        }
        assert!("large".parse::<SeasonPreset>().unwrap_err().contains("tiny"));
    }

    #[test]
    fn dates_are_counted_over_months_and_leap_years() {
        for (date, days) in [("1970-01-01", 0), ("2000-02-29", 11_016), ("2026-12-31", 20_818)] {
            assert_eq!(days_from_epoch(date), Some(days));
            assert_eq!(date_of(days), date);
        }
        for wrong in ["2015-02-29", "2015-13-01", "2015-5-1", "yesterday"] {
            assert_eq!(days_from_epoch(wrong), None, "{wrong}");
        }
        let config = SeasonConfig { days: vec![8, 12], ..SeasonConfig::default() };
        assert_eq!([config.date(0), config.date(1)], ["2015-05-28", "2015-06-01"]);
    }

    #[test]
    fn only_the_first_flight_has_control_and_all_have_the_same_places() {
        let config = SeasonConfig::preset(SeasonPreset::Tiny);
        let [first, second] = [0, 1].map(|k| config.flight(k).unwrap().build().unwrap());
        let place = |twin: &crate::twin::Twin, k: usize| {
            [twin.targets[k].place_m[0], twin.targets[k].place_m[1]]
        };
        assert_eq!((first.config.targets.control, second.config.targets.control), (4, 0));
        assert_eq!(first.targets.len(), second.targets.len());
        assert!((0..first.targets.len()).all(|k| place(&first, k) == place(&second, k)));
        assert_ne!(first.shots[0].centre_m, second.shots[0].centre_m);
        assert_ne!(first.config.image.sun_azimuth_deg, second.config.image.sun_azimuth_deg);
    }

    #[test]
    fn bad_seasons_are_named() {
        let parameter = |change: fn(&mut SeasonConfig)| {
            let mut config = SeasonConfig::default();
            change(&mut config);
            config.check().unwrap_err().parameter
        };
        assert_eq!(parameter(|config| config.days = vec![3, 3]), "days");
        assert_eq!(parameter(|config| config.days.clear()), "days");
        assert_eq!(parameter(|config| config.sown = "May".to_owned()), "sown");
        assert_eq!(parameter(|config| config.twin.field.season = None), "twin.field.season");
    }
}
