//! Where on Earth the field lies: from the mapping frame to a UTM zone and to latitude and longitude.
//!
//! The local frame of the field is the grid of the zone moved to the field's middle: easting and northing
//! differ from X and Y, and the ellipsoidal height from Z, by a constant. Everything is true **in the grid**:
//! distances are grid distances, rows and flights have grid bearings.

use crate::check::{ConfigError, within};
use proj4rs::{proj::Proj, transform::transform};
use serde::{Deserialize, Serialize};

/// Where the middle of the field lies.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SiteConfig {
    /// EPSG code of the mapping frame: UTM on WGS84, 32601 to 32660 north or 32701 to 32760 south.
    pub epsg: u32,
    /// Easting of the field's middle, metres.
    pub easting_m: f64,
    /// Northing of the field's middle, metres.
    pub northing_m: f64,
    /// Height of the field's middle above the WGS84 ellipsoid, metres.
    pub height_m: f64,
    /// When the first photo is taken: local date and time, `YYYY-MM-DD HH:MM:SS`.
    pub start: String,
}

impl Default for SiteConfig {
    fn default() -> SiteConfig {
        SiteConfig {
            epsg: 32616,
            easting_m: 500_680.0,
            northing_m: 4_480_140.0,
            height_m: 182.0,
            start: "2015-06-24 11:30:00".to_owned(),
        }
    }
}

/// A site ready to convert.
pub struct Site {
    config: SiteConfig,
    grid: Proj,
    geographic: Proj,
}

impl SiteConfig {
    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter that cannot be used: its name, its value and what was expected.
    pub fn check(&self) -> Result<(), ConfigError> {
        let utm = (32601..=32660).contains(&self.epsg) || (32701..=32760).contains(&self.epsg);
        if !utm {
            let expected = "UTM on WGS84: 32601 to 32660 (north) or 32701 to 32760 (south)";
            return Err(ConfigError::new("site.epsg", self.epsg, expected));
        }
        within("site.easting_m", self.easting_m, 100_000.0..=900_000.0)?;
        within("site.northing_m", self.northing_m, 1_000.0..=9_999_000.0)?;
        within("site.height_m", self.height_m, -500.0..=9000.0)?;
        if self.start_seconds().is_none() {
            let expected = "a date and time like 2015-06-24 11:30:00";
            return Err(ConfigError::new("site.start", &self.start, expected));
        }
        Ok(())
    }

    /// Seconds from the day's midnight, and the date.
    fn start_seconds(&self) -> Option<(&str, u32)> {
        let (date, time) = self.start.split_once(' ')?;
        let numbers = |text: &str, by: char, widths: [usize; 3]| -> Option<[u32; 3]> {
            let parts: Vec<&str> = text.split(by).collect();
            let [a, b, c] = parts.try_into().ok()?;
            let read = |part: &str, width: usize| {
                let whole = part.len() == width && part.bytes().all(|b| b.is_ascii_digit());
                if whole { part.parse().ok() } else { None }
            };
            Some([read(a, widths[0])?, read(b, widths[1])?, read(c, widths[2])?])
        };
        let [_, month, day] = numbers(date, '-', [4, 2, 2])?;
        let [hours, minutes, seconds] = numbers(time, ':', [2, 2, 2])?;
        let valid = (1..=12).contains(&month)
            && (1..=31).contains(&day)
            && hours < 24
            && minutes < 60
            && seconds < 60;
        valid.then_some((date, 3600 * hours + 60 * minutes + seconds))
    }
}

impl Site {
    /// A site with these parameters.
    ///
    /// # Errors
    /// As [`SiteConfig::check`].
    pub fn new(config: &SiteConfig) -> Result<Site, ConfigError> {
        config.check()?;
        let south = if config.epsg > 32700 { " +south" } else { "" };
        let zone = config.epsg % 100;
        let refuse = |error: proj4rs::errors::Error| {
            ConfigError::new("site.epsg", config.epsg, format!("a UTM zone on WGS84 ({error})"))
        };
        let grid = format!("+proj=utm +zone={zone}{south} +datum=WGS84 +units=m +no_defs");
        let site = Site {
            config: config.clone(),
            grid: Proj::from_proj_string(&grid).map_err(refuse)?,
            geographic: Proj::from_proj_string("+proj=longlat +datum=WGS84 +no_defs")
                .map_err(refuse)?,
        };
        Ok(site)
    }

    /// What it was made from.
    pub fn config(&self) -> &SiteConfig {
        &self.config
    }

    /// Easting, northing and ellipsoidal height of a point of the local frame, metres.
    pub fn grid_m(&self, [x_m, y_m, z_m]: [f64; 3]) -> [f64; 3] {
        let SiteConfig { easting_m, northing_m, height_m, .. } = self.config;
        [easting_m + x_m, northing_m + y_m, height_m + z_m]
    }

    /// Latitude and longitude, degrees, and ellipsoidal height, metres, of a point of the local frame.
    ///
    /// # Errors
    /// Where the point lies outside what the projection can invert.
    pub fn geographic(&self, point_m: [f64; 3]) -> Result<[f64; 3], ConfigError> {
        let [easting_m, northing_m, height_m] = self.grid_m(point_m);
        let mut place = (easting_m, northing_m, height_m);
        transform(&self.grid, &self.geographic, &mut place).map_err(|error| {
            let expected = format!("a place inside its UTM zone ({error})");
            ConfigError::new("site.easting_m", easting_m, expected)
        })?;
        Ok([place.1.to_degrees(), place.0.to_degrees(), height_m])
    }

    /// The moment `time_s` after the start in EXIF's form, `YYYY:MM:DD HH:MM:SS`, and its thousandths of a second.
    /// A flight ends before midnight: later moments stay at the day's last second.
    pub fn moment(&self, time_s: f64) -> (String, u32) {
        let Some((date, start)) = self.config.start_seconds() else {
            return (String::new(), 0);
        };
        let milliseconds = ((f64::from(start) + time_s) * 1000.0).round() as u64;
        let milliseconds = milliseconds.min(86_399_999);
        let seconds = milliseconds / 1000;
        let clock = format!("{:02}:{:02}:{:02}", seconds / 3600, seconds / 60 % 60, seconds % 60);
        (format!("{} {clock}", date.replace('-', ":")), (milliseconds % 1000) as u32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `pyproj.Transformer.from_crs(EPSG, 4326, always_xy=True).transform(E, N)`, pyproj 3.7.2; the
    /// generator is `data-synth/scripts/utm.py`. 1e-9 degrees are a tenth of a millimetre.
    #[test]
    fn latitudes_and_longitudes_are_those_of_proj() {
        for (epsg, easting_m, northing_m, latitude, longitude) in GOLDEN {
            let config = SiteConfig { epsg, easting_m, northing_m, ..SiteConfig::default() };
            let [found_latitude, found_longitude, height_m] =
                Site::new(&config).unwrap().geographic([0.0, 0.0, 3.0]).unwrap();
            approx::assert_abs_diff_eq!(found_latitude, latitude, epsilon = 1e-9);
            approx::assert_abs_diff_eq!(found_longitude, longitude, epsilon = 1e-9);
            assert_eq!(height_m, 185.0);
        }
    }

    const GOLDEN: [(u32, f64, f64, f64, f64); 4] = [
        (32616, 500680.0, 4480140.0, 40.471938965480, -86.991978213979),
        (32616, 612345.678, 4412345.678, 39.853708295914, -85.686674945570),
        (32630, 351034.5909, 6042805.5356, 54.510921129660, -5.301029219059),
        (32721, 250000.0, 6200000.0, -34.311158966621, -59.716729217537),
    ];

    #[test]
    fn bad_sites_are_named() {
        for (config, parameter) in [
            (SiteConfig { epsg: 4326, ..SiteConfig::default() }, "site.epsg"),
            (SiteConfig { easting_m: 12.0, ..SiteConfig::default() }, "site.easting_m"),
            (SiteConfig { start: "noon".to_owned(), ..SiteConfig::default() }, "site.start"),
            (
                SiteConfig { start: "2015-06-24 25:00:00".to_owned(), ..SiteConfig::default() },
                "site.start",
            ),
        ] {
            assert_eq!(Site::new(&config).err().unwrap().parameter, parameter);
        }
    }

    #[test]
    fn moments_are_written_as_exif_has_them() {
        let site = Site::new(&SiteConfig::default()).unwrap();
        assert_eq!(site.moment(61.25), ("2015:06:24 11:31:01".to_owned(), 250));
    }
}
