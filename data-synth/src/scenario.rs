//! A field and what corrupts its picture, in one configuration; and the usual ones by name.

use crate::{
    ConfigError,
    corrupt::{Corruption, Weed},
    field::{Field, FieldConfig, GrowthStage, words},
    picture, render,
};
use image::{GrayImage, RgbImage};
use serde::{Deserialize, Serialize};
use std::{fmt, str::FromStr};

/// What exists and what corrupts it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Scenario {
    /// What exists.
    pub field: FieldConfig,
    /// What corrupts it.
    pub corruption: Corruption,
}

/// A field with its weeds, ready to be looked at.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// The truth.
    pub field: Field,
    /// The weeds.
    pub weeds: Vec<Weed>,
    corruption: Corruption,
}

impl Scenario {
    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter that cannot be used.
    pub fn check(&self) -> Result<(), ConfigError> {
        self.field.check()?;
        self.corruption.check()
    }

    /// Plants the field and sows the weeds.
    ///
    /// # Errors
    /// As [`Scenario::check`].
    pub fn build(&self) -> Result<Scene, ConfigError> {
        self.check()?;
        let field = Field::plant(&self.field)?;
        let weeds = self.corruption.weeds(&field);
        Ok(Scene { field, weeds, corruption: self.corruption.clone() })
    }
}

impl Scene {
    /// The mask with its false and missed pixels: 255 where a pixel passes for leaf, else 0.
    pub fn mask(&self) -> GrayImage {
        let mut mask = render::mask(&self.field, &self.weeds);
        self.corruption.spoil_pixels(self.field.config.seed, &mut mask, None);
        mask
    }

    /// The mask and the picture that segments into exactly that mask.
    pub fn mask_and_picture(&self) -> (GrayImage, RgbImage) {
        let mut mask = render::mask(&self.field, &self.weeds);
        let mut picture = picture::picture(&self.field, &self.weeds);
        self.corruption.spoil_pixels(self.field.config.seed, &mut mask, Some(&mut picture));
        (mask, picture)
    }
}

macro_rules! presets {
    ($($(#[$doc:meta])* $name:literal = $variant:ident $set:expr),+ $(,)?) => {
        /// The usual scenarios: growth stage and spacing in centimetres, and variations of `mid20`.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum Preset { $($(#[$doc])* $variant),+ }

        impl Preset {
            /// Every preset.
            pub const ALL: &'static [Preset] = &[$(Preset::$variant),+];
        }

        impl Scenario {
            /// The scenario of a preset, with seed 1.
            pub fn preset(preset: Preset) -> Scenario {
                let mut scenario = Scenario::default();
                let change: fn(&mut FieldConfig, &mut Corruption) = match preset {
                    $(Preset::$variant => $set),+
                };
                change(&mut scenario.field, &mut scenario.corruption);
                scenario
            }
        }

        words!(Preset { $($name = $variant),+ });
    };
}

presets! {
    /// Seedlings, 20 cm apart.
    "early20" = Early20 |field, _| plant(field, GrowthStage::Early, 0.20),
    /// Seedlings, 10 cm apart.
    "early10" = Early10 |field, _| plant(field, GrowthStage::Early, 0.10),
    /// Leaves begin to overlap, 30 cm apart.
    "mid30" = Mid30 |field, _| plant(field, GrowthStage::Mid, 0.30),
    /// Leaves overlap, 20 cm apart.
    "mid20" = Mid20 |_, _| {},
    /// Leaves overlap, 12 cm apart.
    "mid12" = Mid12 |field, _| plant(field, GrowthStage::Mid, 0.12),
    /// The canopy closes, 30 cm apart.
    "late30" = Late30 |field, _| plant(field, GrowthStage::Late, 0.30),
    /// The canopy closes, 15 cm apart.
    "late15" = Late15 |field, _| plant(field, GrowthStage::Late, 0.15),
    /// Sown with precision: little jitter, nothing missing.
    "mid20_precise" = Mid20Precise |field, _| {
        field.jitter_along = 0.05;
        field.missing_fraction = 0.0;
        field.doubles_fraction = 0.0;
    },
    /// Sown badly: much jitter, many missing, many doubles.
    "mid20_rough" = Mid20Rough |field, _| {
        field.jitter_along = 0.3;
        field.missing_fraction = 0.15;
        field.doubles_fraction = 0.08;
    },
    /// Rows turned by 17 degrees and curved, stalks leaning a little.
    "mid20_turned" = Mid20Turned |field, _| {
        field.heading_deg = -17.0;
        field.curve_m = 0.10;
        field.tilt_m = 0.02;
    },
    /// A few weeds, false and missed pixels.
    "mid20_dirty" = Mid20Dirty |_, corruption| {
        corruption.weeds_per_m2 = 2.0;
        corruption.false_fraction = 0.002;
        corruption.missed_fraction = 0.05;
    },
    /// Sites side by side in all rows.
    "mid20_grid" = Mid20Grid |field, _| field.grid = true,
    /// Stalks leaning by 5 cm.
    "mid20_tilt5" = Mid20Tilt5 |field, _| field.tilt_m = 0.05,
    /// Plants 4 cm to either side of their rows.
    "mid20_cross4" = Mid20Cross4 |field, _| field.jitter_across_m = 0.04,
    /// Weeds everywhere.
    "mid20_weedy" = Mid20Weedy |_, corruption| corruption.weeds_per_m2 = 20.0,
    /// Three sites in ten are empty.
    "mid20_gaps" = Mid20Gaps |field, _| field.missing_fraction = 0.3,
    /// Fifty thousand plants: 130 rows of 75 m, nearly along the picture.
    "whole_field" = WholeField |field, _| {
        field.rows = 130;
        field.row_length_m = 75.0;
        field.spacing_m = 0.194;
        field.heading_deg = -3.0;
        field.curve_m = 0.10;
    },
}

fn plant(field: &mut FieldConfig, stage: GrowthStage, spacing_m: f64) {
    field.stage = stage;
    field.spacing_m = spacing_m;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_preset_is_valid_and_reads_its_own_name() {
        for &preset in Preset::ALL {
            Scenario::preset(preset).check().unwrap();
            assert_eq!(preset.to_string().parse(), Ok(preset));
        }
        let message = "mid21".parse::<Preset>().unwrap_err();
        assert!(message.contains("mid20_gaps"), "{message}");
    }
}
