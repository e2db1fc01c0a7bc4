//! The tables of earlier stages that plots are measured from.

use crate::{Project, Stage, surface};
use rowgram_base::error::Error;
use rowgram_files::{csv_table::CsvTable, plants::ROW_ENDS};
use rowgram_plants::phenotype::{
    field_measurements::{FieldMeasurements, LeavesByArea, MeasuredLeaf, RowGap},
    stand::Weed,
};
use std::{collections::BTreeMap, path::PathBuf};

/// The tables of earlier stages that are there.
pub(super) struct Tables {
    pub(super) plants: Option<PathBuf>,
    pub(super) gaps: Option<PathBuf>,
    pub(super) weeds: Option<PathBuf>,
    pub(super) rows: Option<PathBuf>,
    pub(super) leaves: Option<PathBuf>,
    pub(super) counts: Option<PathBuf>,
    /// Heights of the canopy, a raster.
    pub(super) canopy: Option<PathBuf>,
}

impl Tables {
    pub(super) fn of(project: &Project) -> Tables {
        Tables {
            plants: project.finished(Stage::Locate, "plants.csv"),
            gaps: project.finished(Stage::Locate, "gaps.csv"),
            weeds: project.finished(Stage::Locate, "weeds.csv"),
            rows: project.finished(Stage::Locate, "rows.csv"),
            leaves: project.finished(Stage::Leaves, "leaves.csv"),
            counts: project.finished(Stage::LeafCount, "counts.csv"),
            canopy: project.finished(Stage::Surface, surface::CANOPY),
        }
    }

    /// What they tell of the field; not of leaf along its rows.
    pub(super) fn measurements(&self, gsd_m: Option<f64>) -> Result<FieldMeasurements, Error> {
        let read = |path: &Option<PathBuf>| path.as_deref().map(CsvTable::read).transpose();
        let gaps = read(&self.gaps)?.and_then(|table| {
            let (places, plants) = (table.pairs("u_px", "v_px")?, table.numbers("plants")?);
            let probability =
                table.numbers("probability").unwrap_or_else(|| vec![f64::NAN; plants.len()]);
            let gap = |k: usize| RowGap {
                at_px: places[k],
                plants: plants[k],
                probability: probability[k],
            };
            Some((0..places.len()).map(gap).collect())
        });
        let weeds = read(&self.weeds)?.and_then(|table| {
            let (places, leaf_px) = (table.pairs("u_px", "v_px")?, table.numbers("leaf_px")?);
            let weeds = places.into_iter().zip(leaf_px);
            Some(weeds.map(|(position_px, leaf_px)| Weed { position_px, leaf_px }).collect())
        });
        let by_area = read(&self.counts)?.and_then(|table| {
            let columns = [table.numbers("leaves")?, table.numbers("low")?, table.numbers("high")?];
            let plots = table.texts("plot")?.into_iter().enumerate();
            let row = |(k, plot): (usize, &str)| LeavesByArea {
                plot: plot.to_owned(),
                leaves: [0, 1, 2].map(|column| columns[column][k]),
            };
            Some(plots.map(row).collect())
        });
        let plants = read(&self.plants)?;
        let column = |name: &str| plants.as_ref().and_then(|table| table.numbers(name));
        let row_of = column("row").unwrap_or_default();
        let confidence = column("confidence").unwrap_or_default();
        let rows = read(&self.rows)?.map(|table| row_variances(&table)).unwrap_or_default();
        Ok(FieldMeasurements {
            gsd_m,
            plants: plants.as_ref().and_then(|table| table.pairs("u_px", "v_px")),
            count_variance: count_variances(&confidence, &row_of, &rows),
            along_sigma_px: column("sigma_along_px").unwrap_or_default(),
            row_of,
            gaps,
            weeds,
            rows: None,
            leaves: read(&self.leaves)?.as_ref().and_then(single_leaves),
            by_area,
        })
    }

    /// The ends of the rows.
    pub(super) fn rows_px(&self) -> Result<Vec<[[f64; 2]; 2]>, Error> {
        let Some(table) = self.rows.as_deref().map(CsvTable::read).transpose()? else {
            return Ok(Vec::new());
        };
        let columns = ROW_ENDS.map(|name| table.numbers(name));
        let [Some(u0), Some(v0), Some(u1), Some(v1)] = columns else { return Ok(Vec::new()) };
        Ok((0..u0.len()).map(|k| [[u0[k], v0[k]], [u1[k], v1[k]]]).collect())
    }
}

/// What each plant of a row adds to the variance of a number of plants: that of the row, in equal shares.
fn row_variances(table: &CsvTable) -> BTreeMap<u64, f64> {
    let columns = ["row", "plants", "low", "high"].map(|name| table.numbers(name));
    let [Some(rows), Some(plants), Some(low), Some(high)] = columns else { return BTreeMap::new() };
    let share = |k: usize| {
        // The interval of 95 % reaches two standard deviations to either side.
        let variance = ((high[k] - low[k]) / 4.0).powi(2);
        (rows[k] >= 0.0 && plants[k] > 0.0 && variance.is_finite())
            .then(|| (rows[k] as u64, variance / plants[k]))
    };
    (0..rows.len()).filter_map(share).collect()
}

/// What each plant adds to the variance of a number of plants; of a plant in no row, what the probability that it is one says.
fn count_variances(confidence: &[f64], row_of: &[f64], rows: &BTreeMap<u64, f64>) -> Vec<f64> {
    let variance = |(k, confidence): (usize, &f64)| {
        let row = row_of.get(k).filter(|row| row.is_finite());
        let of_row = row.and_then(|&row| rows.get(&(row as u64)));
        of_row.copied().unwrap_or(confidence * (1.0 - confidence))
    };
    confidence.iter().enumerate().map(variance).collect()
}

fn single_leaves(table: &CsvTable) -> Option<Vec<MeasuredLeaf>> {
    let places = table.pairs("u_px", "v_px")?;
    let unknown = || vec![f64::NAN; places.len()];
    let [lengths, widths, hues] = ["length_m", "mean_width_m", "hue_deg"]
        .map(|name| table.numbers(name).unwrap_or_else(unknown));
    let leaf = |k: usize| MeasuredLeaf {
        at_px: places[k],
        length_m: lengths[k],
        width_m: widths[k],
        hue_deg: hues[k],
    };
    // None at all: none could be told apart.
    (!places.is_empty()).then(|| (0..places.len()).map(leaf).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_share_their_variance_among_their_plants() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rows.csv");
        let text = "row,plants,expected,low,high,length_px\n0,10,10.5,8,12,90\n1,0,0.2,0,1,90\n";
        std::fs::write(&path, text).unwrap();
        let rows = row_variances(&CsvTable::read(&path).unwrap());
        // The row has a standard deviation of 1.
        assert_eq!(rows, BTreeMap::from([(0, 0.1)]));
        let found = count_variances(&[0.5, 0.5, 1.0], &[0.0, f64::NAN, 1.0], &rows);
        assert_eq!(found, [0.1, 0.25, 0.0]);
    }
}
