//! The field twin: a field, a flight over it, and everything that is true of both, under one seed.

use crate::{
    ConfigError,
    camera::{Camera, CameraConfig},
    clutter::ClutterConfig,
    corrupt::{Corruption, Weed},
    field::{Field, FieldConfig, GrowthStage, words},
    flight::{self, FlightConfig, GnssConfig, Shot},
    habit::{Habit, PlotConfig},
    panels::PanelConfig,
    photo::{ImageConfig, Studio},
    scenario::{Scenario, Scene},
    site::{Site, SiteConfig},
    targets::{self, Mark, Target, TargetConfig},
    terrain::TerrainConfig,
    tie_points::{self, TiePoint, TiePointConfig},
};
use serde::{Deserialize, Serialize};
use std::{fmt, str::FromStr};

/// Everything that decides a twin. Written out it is the `field.toml` of a project folder.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TwinConfig {
    /// What exists; its seed decides everything random.
    pub field: FieldConfig,
    /// Weeds, and what spoils the mask from straight above.
    pub corruption: Corruption,
    /// What lies on the ground.
    pub clutter: ClutterConfig,
    /// Where on Earth it is.
    pub site: SiteConfig,
    /// The true camera.
    pub camera: CameraConfig,
    /// The flight.
    pub flight: FlightConfig,
    /// Ground control.
    pub targets: TargetConfig,
    /// Panels of known reflectance.
    #[serde(skip_serializing_if = "PanelConfig::is_empty")]
    pub panels: PanelConfig,
    /// Light and sensor.
    pub image: ImageConfig,
    /// Tie points made without photos.
    pub tie_points: TiePointConfig,
}

/// A field and a flight over it.
pub struct Twin {
    /// What it was made from.
    pub config: TwinConfig,
    /// The field with its weeds.
    pub scene: Scene,
    /// Targets on the ground.
    pub targets: Vec<Target>,
    /// The true camera.
    pub camera: Camera,
    /// Where on Earth it is.
    pub site: Site,
    /// Every photo's exterior orientation.
    pub shots: Vec<Shot>,
    /// The targets in the photos.
    pub marks: Vec<Mark>,
}

impl TwinConfig {
    /// Checks every parameter that can be checked on its own.
    ///
    /// # Errors
    /// The first parameter that cannot be used.
    pub fn check(&self) -> Result<(), ConfigError> {
        self.field.check()?;
        self.corruption.check()?;
        self.clutter.check()?;
        self.site.check()?;
        self.camera.check()?;
        self.flight.check()?;
        self.targets.check()?;
        self.panels.check()?;
        self.image.check()?;
        self.tie_points.check()
    }

    /// Plants the field, sets out the targets, flies, and marks the targets in the photos.
    ///
    /// # Errors
    /// As [`TwinConfig::check`], and where the flight cannot be flown over this ground.
    pub fn build(&self) -> Result<Twin, ConfigError> {
        self.check()?;
        let scenario = Scenario { field: self.field.clone(), corruption: self.corruption.clone() };
        let mut scene = scenario.build()?;
        let targets = targets::set_out(&self.targets, &mut scene.field)?;
        scene.field.panels = self.panels.lay_out(&scene.field);
        let is_near =
            |weed: &Weed| scene.field.panels.iter().any(|of| of.is_near([weed.x_m, weed.y_m]));
        scene.weeds.retain(|weed| !is_near(weed));
        let camera = Camera::new(&self.camera)?;
        let site = Site::new(&self.site)?;
        let mut shots = flight::fly(&self.flight, &scene.field, &camera)?;
        let (drift, follow) = (self.image.light_drift, self.image.auto_exposure);
        flight::light_up(&mut shots, self.field.seed, drift, follow);
        for shot in &shots {
            site.geographic(shot.gnss_m)?;
        }
        let marks = targets::mark(&self.targets, &scene.field, &targets, &shots, &camera);
        Ok(Twin { config: self.clone(), scene, targets, camera, site, shots, marks })
    }
}

impl Twin {
    /// The field.
    pub fn field(&self) -> &Field {
        &self.scene.field
    }

    /// The weeds.
    pub fn weeds(&self) -> &[Weed] {
        &self.scene.weeds
    }

    /// A studio to take the photos in.
    pub fn studio(&self) -> Studio<'_> {
        Studio::new(
            &self.scene.field,
            &self.scene.weeds,
            &self.config.clutter,
            &self.targets,
            &self.camera,
            &self.config.image,
        )
    }

    /// The tie points of the flight.
    pub fn tie_points(&self) -> Vec<TiePoint> {
        tie_points::measure(&self.config.tie_points, self.field(), &self.shots, &self.camera)
    }
}

/// The usual flights by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FlightPreset {
    /// A dozen small photos of 20 rows.
    Small,
    /// As in the paper: a wide-angle action camera with SMAC distortion at 15 m, 1.5 cm/px, 60 % overlap both ways,
    /// 8 m/s, 18 control and 10 check points.
    Paper,
    /// Repetitive and of low texture: a fixed wing without gimbal over dense seedlings on even soil, one strip.
    Seneca,
}

impl FlightPreset {
    /// Every preset.
    pub const ALL: &'static [FlightPreset] =
        &[FlightPreset::Small, FlightPreset::Paper, FlightPreset::Seneca];
}

words!(FlightPreset { "small" = Small, "paper" = Paper, "seneca" = Seneca });

impl TwinConfig {
    /// The configuration of a preset, with seed 1.
    pub fn preset(preset: FlightPreset) -> TwinConfig {
        match preset {
            FlightPreset::Small => small(),
            FlightPreset::Paper => paper(),
            FlightPreset::Seneca => seneca(),
        }
    }
}

fn small() -> TwinConfig {
    TwinConfig {
        field: FieldConfig {
            rows: 20,
            row_length_m: 18.0,
            heading_deg: 12.0,
            curve_m: 0.05,
            tilt_m: 0.01,
            plots: PlotConfig { rows: 5, length_m: 8.25, alley_m: 1.5 },
            terrain: TerrainConfig {
                slope_percent: 2.0,
                slope_direction_deg: 70.0,
                relief_m: 0.15,
                relief_wavelength_m: 6.0,
                furrow_m: 0.05,
            },
            habit: Habit { senescent_fraction: 0.05, ..Habit::default() },
            ..FieldConfig::default()
        },
        corruption: Corruption { weeds_per_m2: 0.5, grass_share: 0.3, ..Corruption::default() },
        camera: CameraConfig::compact(1000, 750, 800.0),
        flight: FlightConfig {
            height_m: 12.0,
            margin_m: -3.0,
            speed_m_s: 4.0,
            position_m: 0.2,
            gnss: GnssConfig { horizontal_m: 0.5, vertical_m: 0.8, ..GnssConfig::default() },
            ..FlightConfig::default()
        },
        targets: TargetConfig { control: 6, check: 3, size_m: 0.4, ..TargetConfig::default() },
        tie_points: TiePointConfig { per_photo: 200, ..TiePointConfig::default() },
        ..TwinConfig::default()
    }
}

fn paper() -> TwinConfig {
    TwinConfig {
        field: FieldConfig {
            rows: 130,
            row_length_m: 75.0,
            spacing_m: 0.194,
            heading_deg: -3.0,
            curve_m: 0.10,
            tilt_m: 0.01,
            plots: PlotConfig { rows: 10, length_m: 23.5, alley_m: 2.0 },
            terrain: TerrainConfig {
                slope_percent: 1.0,
                slope_direction_deg: 30.0,
                relief_m: 0.25,
                relief_wavelength_m: 20.0,
                furrow_m: 0.03,
            },
            habit: Habit {
                azimuth_preference: 0.3,
                tiller_fraction: 0.05,
                senescent_fraction: 0.05,
                ..Habit::default()
            },
            ..FieldConfig::default()
        },
        corruption: Corruption { weeds_per_m2: 0.3, grass_share: 0.3, ..Corruption::default() },
        camera: CameraConfig::wide(2288, 1716, 1000.0),
        flight: FlightConfig { readout_seconds: 0.03, ..FlightConfig::default() },
        ..TwinConfig::default()
    }
}

fn seneca() -> TwinConfig {
    TwinConfig {
        field: FieldConfig {
            rows: 78,
            row_length_m: 170.0,
            spacing_m: 0.15,
            jitter_along: 0.08,
            jitter_across_m: 0.006,
            missing_fraction: 0.02,
            doubles_fraction: 0.0,
            stage: GrowthStage::Early,
            grid: true,
            terrain: TerrainConfig {
                slope_percent: 0.5,
                relief_m: 0.1,
                relief_wavelength_m: 25.0,
                furrow_m: 0.06,
                ..TerrainConfig::default()
            },
            ..FieldConfig::default()
        },
        clutter: ClutterConfig { residue_per_m2: 0.5, stones_per_m2: 0.5 },
        camera: CameraConfig::compact(2000, 1500, 1450.0),
        flight: FlightConfig {
            height_m: 40.0,
            forward_overlap: 0.75,
            speed_m_s: 14.0,
            strips: 1,
            photos_per_strip: 16,
            gimbal_deg: 4.0,
            heading_deg: 3.0,
            position_m: 1.0,
            height_drift_m: 1.5,
            wind_m_s: 4.0,
            ..FlightConfig::default()
        },
        targets: TargetConfig { control: 6, check: 4, size_m: 0.8, ..TargetConfig::default() },
        image: ImageConfig { soil_contrast: 1.1, ..ImageConfig::default() },
        ..TwinConfig::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_preset_is_valid_and_reads_its_own_name() {
        for &preset in FlightPreset::ALL {
            TwinConfig::preset(preset).check().unwrap();
            assert_eq!(preset.to_string().parse(), Ok(preset));
        }
        assert!("papr".parse::<FlightPreset>().unwrap_err().contains("seneca"));
    }
}
