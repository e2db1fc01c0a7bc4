//! Tables as they were written, and the statistics that figures, tables and findings are made of.

use crate::{fail::Fail, keys};
use statrs::distribution::{ContinuousCDF, StudentsT};
use std::{collections::BTreeMap, path::Path};

/// A table of a CSV file.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Frame {
    pub(crate) header: Vec<String>,
    pub(crate) rows: Vec<Vec<String>>,
}

/// Which rows: the label that each of some columns has to have.
pub(crate) type Conditions = BTreeMap<String, String>;

impl Frame {
    /// Reads a file.
    pub(crate) fn read(path: &Path) -> Result<Frame, Fail> {
        let fail = |e: csv::Error| Fail::Input(format!("{}: {e}", path.display()));
        let mut reader = csv::Reader::from_path(path).map_err(fail)?;
        let header = reader.headers().map_err(fail)?.iter().map(str::to_owned).collect();
        let mut rows = Vec::new();
        for record in reader.records() {
            rows.push(record.map_err(fail)?.iter().map(str::to_owned).collect());
        }
        Ok(Frame { header, rows })
    }

    /// The place of a column.
    pub(crate) fn column(&self, name: &str) -> Result<usize, String> {
        let names = self.header.iter().map(String::as_str);
        self.header
            .iter()
            .position(|column| column == name)
            .ok_or_else(|| keys::unknown("column", name, names))
    }

    /// The rows that meet the conditions.
    pub(crate) fn at(&self, conditions: &Conditions) -> Result<Frame, String> {
        let wanted = conditions
            .iter()
            .map(|(name, label)| Ok((self.column(name)?, label)))
            .collect::<Result<Vec<_>, String>>()?;
        let meets = |row: &&Vec<String>| wanted.iter().all(|&(c, label)| row[c] == *label);
        let rows: Vec<Vec<String>> = self.rows.iter().filter(meets).cloned().collect();
        if rows.is_empty() {
            return Err(format!("no row has {conditions:?}"));
        }
        Ok(Frame { header: self.header.clone(), rows })
    }

    /// The labels of a column in the order in which they appear; one empty label without a column.
    pub(crate) fn labels(&self, name: &str) -> Result<Vec<String>, String> {
        if name.is_empty() {
            return Ok(vec![String::new()]);
        }
        let column = self.column(name)?;
        let mut labels: Vec<String> = Vec::new();
        for row in &self.rows {
            if !labels.contains(&row[column]) {
                labels.push(row[column].clone());
            }
        }
        Ok(labels)
    }

    /// The rows with a label; all without a column.
    pub(crate) fn with(&self, name: &str, label: &str) -> Result<Frame, String> {
        if name.is_empty() {
            return Ok(self.clone());
        }
        let column = self.column(name)?;
        let rows = self.rows.iter().filter(|row| row[column] == label).cloned().collect();
        Ok(Frame { header: self.header.clone(), rows })
    }

    /// The numbers of a column; rows without one are left out.
    pub(crate) fn numbers(&self, name: &str) -> Result<Vec<f64>, String> {
        let column = self.column(name)?;
        Ok(self.rows.iter().filter_map(|row| row[column].parse().ok()).collect())
    }
}

/// A sample in a few numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Summary {
    pub(crate) count: usize,
    pub(crate) mean: f64,
    /// Half the 95 % confidence interval of the mean (Student); 0 for a single value.
    pub(crate) half: f64,
}

impl Summary {
    /// Nothing without values.
    pub(crate) fn of(values: &[f64]) -> Option<Summary> {
        let count = values.len();
        if count == 0 {
            return None;
        }
        let mean = values.iter().sum::<f64>() / count as f64;
        if count == 1 {
            return Some(Summary { count, mean, half: 0.0 });
        }
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let error = (squares / (count - 1) as f64 / count as f64).sqrt();
        let t = StudentsT::new(0.0, 1.0, (count - 1) as f64).ok()?.inverse_cdf(0.975);
        Some(Summary { count, mean, half: t * error })
    }
}

/// A quantile of sorted values, between neighbours.
pub(crate) fn quantile(sorted: &[f64], share: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else { return f64::NAN };
    let place = share.clamp(0.0, 1.0) * last as f64;
    let (low, high) = (place.floor() as usize, place.ceil() as usize);
    sorted[low] + (sorted[high] - sorted[low]) * (place - low as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_interval_is_students() {
        let found = Summary::of(&[1.0, 2.0, 4.0, 5.0]).unwrap();
        // scipy.stats.t.interval(0.95, 3, 3, scipy.stats.sem([1, 2, 4, 5]))
        assert!((found.mean - 3.0).abs() < 1e-12 && (found.half - 2.905_163).abs() < 1e-5);
        assert_eq!(Summary::of(&[]), None);
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.75), 3.0);
    }

    #[test]
    fn rows_are_picked_by_label() {
        let text = |cells: &[&str]| cells.iter().map(|&c| c.to_owned()).collect::<Vec<_>>();
        let rows = vec![text(&["x", "1"]), text(&["y", "2"]), text(&["x", ""])];
        let frame = Frame { header: text(&["a", "b"]), rows };
        assert_eq!(frame.labels("a").unwrap(), ["x", "y"]);
        let x = frame.at(&Conditions::from([("a".to_owned(), "x".to_owned())])).unwrap();
        assert_eq!((x.rows.len(), x.numbers("b").unwrap()), (2, vec![1.0]));
        assert!(frame.numbers("c").unwrap_err().contains("did you mean"));
        assert!(frame.at(&Conditions::from([("a".to_owned(), "z".to_owned())])).is_err());
    }
}
