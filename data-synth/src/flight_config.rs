//! What a flight is asked to be, and the bounds of it.

use crate::check::{ConfigError, within};
use serde::{Deserialize, Serialize};

/// How the field is flown over.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FlightConfig {
    /// Height above the middle of the field, metres.
    pub height_m: f64,
    /// Overlap of neighbouring photos of a strip, fraction of what a photo sees along the flight.
    pub forward_overlap: f64,
    /// Overlap of neighbouring strips, fraction of what a photo sees across the flight.
    pub side_overlap: f64,
    /// Speed over ground, metres per second.
    pub speed_m_s: f64,
    /// Direction of the first strip, degrees counter-clockwise from the rows' direction.
    pub direction_deg: f64,
    /// Number of strips; 0 takes as many as cover the field.
    pub strips: usize,
    /// Photos of a strip; 0 takes as many as cover the field.
    pub photos_per_strip: usize,
    /// How far beyond the outermost rows the field is covered, metres.
    pub margin_m: f64,
    /// Standard deviation of roll and pitch, degrees.
    pub gimbal_deg: f64,
    /// Standard deviation of the heading of single photos, degrees.
    pub heading_deg: f64,
    /// Standard deviation of the place of single photos along and across the strip, metres.
    pub position_m: f64,
    /// Standard deviation of the slow drift of the height along the flight, metres.
    pub height_drift_m: f64,
    /// Wind speed, metres per second; the aircraft crabs into it.
    pub wind_m_s: f64,
    /// Where the wind blows to, degrees counter-clockwise from east.
    pub wind_direction_deg: f64,
    /// Time to turn from one strip to the next, seconds.
    pub turn_seconds: f64,
    /// Time from the first to the last row of a photo, seconds; 0 is a global shutter.
    pub readout_seconds: f64,
    /// Standard deviation of the rate at which the camera turns about each axis during a photo,
    /// degrees per second.
    pub turn_rate_deg_s: f64,
    /// Exposure time, seconds.
    pub exposure_seconds: f64,
    /// How far the camera is tilted in its mount, degrees: its upper edge looks that much ahead of where the gimbal points.
    pub mount_tilt_deg: f64,
    /// The satellite receiver.
    pub gnss: GnssConfig,
    /// What the gimbal says of its angles in the photos; nothing where there is no record.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gimbal_record: Option<GimbalRecordConfig>,
}

/// The record of the gimbal's angles in the photos' XMP.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GimbalRecordConfig {
    /// Standard deviation of the angles about east and north, degrees.
    pub level_sigma_deg: f64,
    /// Standard deviation of the heading, degrees.
    pub heading_sigma_deg: f64,
    /// How far all headings are off, degrees clockwise, as those of a compass whose declination is not known.
    pub heading_offset_deg: f64,
}

impl GimbalRecordConfig {
    /// A record whose angles about east and north have this standard deviation; a compass is three times as bad.
    pub fn of_sigma_deg(level_sigma_deg: f64) -> GimbalRecordConfig {
        let heading_sigma_deg = 3.0 * level_sigma_deg;
        GimbalRecordConfig { level_sigma_deg, heading_sigma_deg, heading_offset_deg: 0.0 }
    }
}

impl Default for GimbalRecordConfig {
    fn default() -> GimbalRecordConfig {
        GimbalRecordConfig::of_sigma_deg(0.5)
    }
}

/// The satellite receiver whose positions are in the photos' EXIF.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GnssConfig {
    /// Standard deviation of easting and northing, each, metres.
    pub horizontal_m: f64,
    /// Standard deviation of the height, metres.
    pub vertical_m: f64,
    /// Share of the variance that is common to neighbouring photos and drifts slowly.
    pub drift_share: f64,
    /// From the camera to the antenna in the camera frame (right, forward, up), metres.
    pub lever_arm_m: [f64; 3],
    /// Standard deviation that the receiver states of each coordinate where its ambiguities are fixed, metres, whatever the
    /// true ones are; with it the photos' XMP has what a receiver with corrections writes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stated_sigma_m: Option<f64>,
}

impl Default for GnssConfig {
    fn default() -> GnssConfig {
        GnssConfig {
            horizontal_m: 1.2,
            vertical_m: 2.5,
            drift_share: 0.7,
            lever_arm_m: [0.0, -0.05, 0.12],
            stated_sigma_m: None,
        }
    }
}

impl Default for FlightConfig {
    fn default() -> FlightConfig {
        FlightConfig {
            height_m: 15.0,
            forward_overlap: 0.6,
            side_overlap: 0.6,
            speed_m_s: 8.0,
            direction_deg: 0.0,
            strips: 0,
            photos_per_strip: 0,
            margin_m: 0.0,
            gimbal_deg: 2.0,
            heading_deg: 2.0,
            position_m: 0.4,
            height_drift_m: 0.3,
            wind_m_s: 1.5,
            wind_direction_deg: 60.0,
            turn_seconds: 8.0,
            readout_seconds: 0.0,
            turn_rate_deg_s: 0.0,
            exposure_seconds: 0.0005,
            mount_tilt_deg: 0.0,
            gnss: GnssConfig::default(),
            gimbal_record: None,
        }
    }
}

impl FlightConfig {
    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter that cannot be used: its name, its value and what was expected.
    pub fn check(&self) -> Result<(), ConfigError> {
        within("flight.height_m", self.height_m, 1.0..=2000.0)?;
        within("flight.forward_overlap", self.forward_overlap, 0.0..=0.98)?;
        within("flight.side_overlap", self.side_overlap, 0.0..=0.98)?;
        within("flight.speed_m_s", self.speed_m_s, 0.0..=100.0)?;
        within("flight.direction_deg", self.direction_deg, -360.0..=360.0)?;
        within("flight.strips", self.strips, 0..=1000)?;
        within("flight.photos_per_strip", self.photos_per_strip, 0..=10_000)?;
        within("flight.margin_m", self.margin_m, -1000.0..=1000.0)?;
        within("flight.gimbal_deg", self.gimbal_deg, 0.0..=10.0)?;
        within("flight.heading_deg", self.heading_deg, 0.0..=30.0)?;
        within("flight.position_m", self.position_m, 0.0..=0.3 * self.height_m)?;
        within("flight.height_drift_m", self.height_drift_m, 0.0..=0.1 * self.height_m)?;
        within("flight.wind_m_s", self.wind_m_s, 0.0..=0.9 * self.speed_m_s.max(1e-9))?;
        within("flight.wind_direction_deg", self.wind_direction_deg, -360.0..=360.0)?;
        within("flight.turn_seconds", self.turn_seconds, 0.0..=3600.0)?;
        within("flight.readout_seconds", self.readout_seconds, 0.0..=0.2)?;
        within("flight.turn_rate_deg_s", self.turn_rate_deg_s, 0.0..=60.0)?;
        within("flight.exposure_seconds", self.exposure_seconds, 0.0..=0.1)?;
        within("flight.gnss.horizontal_m", self.gnss.horizontal_m, 0.0..=100.0)?;
        within("flight.gnss.vertical_m", self.gnss.vertical_m, 0.0..=100.0)?;
        within("flight.gnss.drift_share", self.gnss.drift_share, 0.0..=1.0)?;
        for part in self.gnss.lever_arm_m {
            within("flight.gnss.lever_arm_m", part, -10.0..=10.0)?;
        }
        if let Some(sigma_m) = self.gnss.stated_sigma_m {
            within("flight.gnss.stated_sigma_m", sigma_m, 0.001..=100.0)?;
        }
        within("flight.mount_tilt_deg", self.mount_tilt_deg, 0.0..=8.0)?;
        if let Some(record) = &self.gimbal_record {
            within("flight.gimbal_record.level_sigma_deg", record.level_sigma_deg, 0.0..=20.0)?;
            within("flight.gimbal_record.heading_sigma_deg", record.heading_sigma_deg, 0.0..=60.0)?;
            let offset_deg = record.heading_offset_deg;
            within("flight.gimbal_record.heading_offset_deg", offset_deg, -180.0..=180.0)?;
        }
        Ok(())
    }
}
