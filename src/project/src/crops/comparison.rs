//! The orthomosaic against the photos: the traits of a plot from both.
//!
//! Both see the same plot. What they differ by in the mean is what drawing the map did to a trait (colours that were balanced,
//! seams, blur); how the differences scatter over plots is what a single look is worth.

use super::{
    PlotCrop,
    traits::{COLUMNS, mean_and_deviation},
};
use rowgram_base::error::Error;
use rowgram_files::csv_table::CsvWriter;
use rowgram_optim::output;
use rowgram_plants::phenotype::{
    plots::Measured,
    traits::{PlotTraits, TRAITS},
};
use rowgram_raster::spectral::Index;
use serde::{Deserialize, Serialize};
use std::{collections::BTreeMap, path::Path};

/// A trait of all plots, from the orthomosaic and from photos.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TraitComparison {
    /// Name of the trait.
    #[serde(rename = "trait")]
    pub name: String,
    /// Plots that have it from both.
    pub plots: usize,
    /// Mean over these plots in the orthomosaic.
    pub orthomosaic: f64,
    /// Mean over these plots of the means over photos.
    pub photos: f64,
    /// Standard deviation over plots of the differences; `None` of a single plot.
    pub difference_sd: Option<f64>,
    /// Mean standard deviation between the photos of a plot; `None` where every plot is in one photo.
    pub between_photos_sd: Option<f64>,
}

/// A trait of a plot from both.
pub(super) struct PairedTrait {
    plot: String,
    name: &'static str,
    orthomosaic: Measured,
    photos: usize,
    of_photos: Measured,
}

/// The traits that plots have from both. An index of the orthomosaic by the name of a colour index is none of these.
pub(super) fn pairs(
    crops: &[PlotCrop],
    plots: &[PlotTraits],
    indices: &[Index],
) -> Vec<PairedTrait> {
    let of_map: BTreeMap<&str, &PlotTraits> =
        plots.iter().map(|traits| (traits.plot.as_str(), traits)).collect();
    let mut found = Vec::new();
    for crops in crops.chunk_by(|a, b| a.plot == b.plot) {
        let Some(map) = of_map.get(crops[0].plot.as_str()) else { continue };
        let is_index = |name: &str| indices.iter().any(|index| index.name == name);
        for (name, value) in COLUMNS.into_iter().filter(|(name, _)| !is_index(name)) {
            let own = TRAITS.iter().find(|of| of.name == name);
            let Some((of, on_map)) = own.and_then(|of| Some((of, of.value(map)?))) else {
                continue;
            };
            let (mean, sd) = mean_and_deviation(crops.iter().map(|crop| value(&crop.traits)));
            let Some(mean) = mean else { continue };
            found.push(PairedTrait {
                plot: crops[0].plot.clone(),
                name,
                orthomosaic: Measured { value: on_map, sd: of.standard_deviation(map) },
                photos: crops.iter().filter(|crop| value(&crop.traits).is_some()).count(),
                of_photos: Measured { value: mean, sd },
            });
        }
    }
    found
}

/// One line for each trait.
pub(super) fn summary(pairs: &[PairedTrait]) -> Vec<TraitComparison> {
    let of = |name: &str| {
        let mine: Vec<&PairedTrait> = pairs.iter().filter(|pair| pair.name == name).collect();
        let mean = |value: fn(&PairedTrait) -> Option<f64>| {
            mean_and_deviation(mine.iter().map(|pair| value(pair)))
        };
        let difference = |pair: &PairedTrait| Some(pair.of_photos.value - pair.orthomosaic.value);
        Some(TraitComparison {
            name: name.to_owned(),
            plots: mine.len(),
            orthomosaic: mean(|pair| Some(pair.orthomosaic.value)).0?,
            photos: mean(|pair| Some(pair.of_photos.value)).0?,
            difference_sd: mean(difference).1,
            between_photos_sd: mean(|pair| pair.of_photos.sd).0,
        })
    };
    COLUMNS.iter().filter_map(|(name, _)| of(name)).collect()
}

/// Writes `comparison.csv`: one line for each plot and trait.
pub(super) fn write(pairs: &[PairedTrait], folder: &Path) -> Result<(), Error> {
    let number = |value: Option<f64>| value.map(|x| format!("{x:.6}")).unwrap_or_default();
    output::write(&folder.join("comparison.csv"), false, |out| {
        let mut csv = CsvWriter::new(out);
        csv.write_record([
            "plot",
            "trait",
            "orthomosaic",
            "orthomosaic_sd",
            "photos",
            "photos_mean",
            "photos_sd",
            "difference",
        ])?;
        for pair in pairs {
            csv.write_record([
                pair.plot.clone(),
                pair.name.to_owned(),
                number(Some(pair.orthomosaic.value)),
                number(pair.orthomosaic.sd),
                pair.photos.to_string(),
                number(Some(pair.of_photos.value)),
                number(pair.of_photos.sd),
                number(Some(pair.of_photos.value - pair.orthomosaic.value)),
            ])?;
        }
        csv.flush()
    })?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::{super::PhotoTraits, *};
    use approx::assert_abs_diff_eq;

    fn crop(plot: &str, rank: usize, exg: Option<f64>) -> PlotCrop {
        PlotCrop {
            plot: plot.to_owned(),
            image: format!("{rank}.jpg"),
            rank,
            file: "x.png".into(),
            as_taken: None,
            size_px: [1, 1],
            polygon_px: Vec::new(),
            photo_polygon_px: Vec::new(),
            as_taken_from_px: None,
            view_angle_deg: 0.0,
            traits: PhotoTraits { exg, ..PhotoTraits::default() },
        }
    }

    #[test]
    fn plots_are_compared_trait_by_trait() {
        let crops = [
            crop("A", 1, Some(0.5)),
            crop("A", 2, Some(0.7)),
            crop("B", 1, Some(0.2)),
            crop("B", 2, None),
            crop("C", 1, Some(0.9)),
        ];
        let plot = |name: &str, exg| PlotTraits {
            plot: name.to_owned(),
            exg: Some(exg),
            ..PlotTraits::default()
        };
        let pairs = pairs(&crops, &[plot("A", 0.5), plot("B", 0.3)], &[]);
        // C has no traits on the map, and no plot has anything but excess green.
        assert_eq!(pairs.len(), 2);
        assert_eq!((pairs[0].photos, pairs[1].photos), (2, 1));
        let found = summary(&pairs);
        assert_eq!((found.len(), found[0].plots, found[0].name.as_str()), (1, 2, "exg"));
        assert_abs_diff_eq!(found[0].orthomosaic, 0.4, epsilon = 1e-12);
        assert_abs_diff_eq!(found[0].photos, 0.4, epsilon = 1e-12);
        // Differences +.1 and -.1; only A has two photos.
        assert_abs_diff_eq!(found[0].difference_sd.unwrap(), 0.02f64.sqrt(), epsilon = 1e-12);
        assert_abs_diff_eq!(found[0].between_photos_sd.unwrap(), 0.02f64.sqrt(), epsilon = 1e-12);
        let folder = tempfile::tempdir().unwrap();
        write(&pairs, folder.path()).unwrap();
        let text = std::fs::read_to_string(folder.path().join("comparison.csv")).unwrap();
        assert!(text.contains("\nB,exg,0.300000,,1,0.200000,,-0.100000\n"), "{text}");
    }
}
