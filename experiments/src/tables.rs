//! Tables of means with their intervals, as LaTeX, Markdown and CSV.

use crate::{
    data::{Conditions, Frame, Summary},
    fail::Fail,
    keys,
};
use rowgram::io::output;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// A table as a spec asks for it.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct TableSpec {
    /// Names the files.
    pub(crate) name: String,
    /// The axis whose labels are the rows.
    pub(crate) rows: String,
    /// The axis whose labels are the columns; none makes the metrics the columns.
    #[serde(default)]
    pub(crate) columns: String,
    /// The metrics; a single one where there is an axis of columns.
    pub(crate) values: Vec<String>,
    /// Which runs.
    #[serde(default, rename = "where")]
    pub(crate) conditions: Conditions,
    /// Digits after the point.
    #[serde(default = "two")]
    pub(crate) digits: usize,
    /// What the numbers are multiplied with, such as 100 for centimetres from metres.
    #[serde(default = "crate::figures::unity")]
    pub(crate) scale: f64,
    /// What it shows.
    #[serde(default)]
    pub(crate) caption: String,
}

fn two() -> usize {
    2
}

impl TableSpec {
    /// Refuses columns and metrics that there are not.
    pub(crate) fn check(&self, axes: &[&str], metrics: &[&str]) -> Result<(), String> {
        let place = |e: String| format!("table {}: {e}", self.name);
        let asked = [self.rows.as_str(), self.columns.as_str()];
        let conditions = self.conditions.keys().map(String::as_str);
        for axis in asked.into_iter().filter(|axis| !axis.is_empty()).chain(conditions) {
            if !axes.contains(&axis) {
                return Err(place(keys::unknown("axis", axis, axes.iter().copied())));
            }
        }
        for value in &self.values {
            if !metrics.contains(&value.as_str()) {
                return Err(place(keys::unknown("metric", value, metrics.iter().copied())));
            }
        }
        match (self.values.len(), self.columns.is_empty()) {
            (0, _) => Err(place("expected at least one metric in values".to_owned())),
            (2.., false) => Err(place("an axis of columns goes with a single metric".to_owned())),
            _ => Ok(()),
        }
    }

    /// Writes `NAME.md`, `NAME.tex` and `NAME.csv`.
    pub(crate) fn write(&self, runs: &Frame, folder: &Path) -> Result<(), Fail> {
        let cells =
            self.cells(runs).map_err(|e| Fail::Failed(format!("table {}: {e}", self.name)))?;
        for (end, text) in [("md", self.markdown(&cells)), ("tex", self.latex(&cells))] {
            let path = folder.join(format!("{}.{end}", self.name));
            output::write(&path, true, |out| out.write_all(text.as_bytes()))?;
        }
        output::write(&folder.join(format!("{}.csv", self.name)), true, |out| {
            let mut writer = csv::Writer::from_writer(out);
            writer.write_record(["row", "column", "count", "mean", "half_interval"])?;
            for (row, column, summary) in cells.entries() {
                let (count, mean, half) = summary
                    .map(|s| (s.count.to_string(), s.mean.to_string(), s.half.to_string()))
                    .unwrap_or_default();
                writer.write_record([row, column, count.as_str(), mean.as_str(), half.as_str()])?;
            }
            writer.flush()
        })?;
        Ok(())
    }

    /// The table as text: a row of heads, then the rows with theirs in front.
    pub(crate) fn shown_rows(&self, runs: &Frame) -> Result<Vec<Vec<String>>, String> {
        let cells = self.cells(runs)?;
        let mut rows = vec![vec![self.rows.clone()]];
        rows[0].extend(cells.columns.iter().cloned());
        for (r, head) in cells.rows.iter().enumerate() {
            let shown = cells.row(r).iter().map(|&cell| self.shown(cell, " ± "));
            rows.push(std::iter::once(head.clone()).chain(shown).collect());
        }
        Ok(rows)
    }

    /// The caption and what the numbers of a cell are.
    pub(crate) fn caption_with_intervals(&self) -> String {
        format!("{} Mean ± half the 95 % interval.", self.caption).trim().to_owned()
    }

    fn cells(&self, runs: &Frame) -> Result<Cells, String> {
        let runs = runs.at(&self.conditions)?;
        let rows = runs.labels(&self.rows)?;
        let columns =
            if self.columns.is_empty() { self.values.clone() } else { runs.labels(&self.columns)? };
        let mut values = Vec::new();
        for row in &rows {
            let mine = runs.with(&self.rows, row)?;
            for column in &columns {
                let numbers = if self.columns.is_empty() {
                    mine.numbers(column)?
                } else {
                    mine.with(&self.columns, column)?.numbers(&self.values[0])?
                };
                let scaled: Vec<f64> = numbers.iter().map(|value| value * self.scale).collect();
                values.push(Summary::of(&scaled));
            }
        }
        Ok(Cells { rows, columns, values })
    }

    fn shown(&self, summary: Option<Summary>, between: &str) -> String {
        let digits = self.digits;
        match summary {
            None => "-".to_owned(),
            Some(s) if s.count == 1 => format!("{:.digits$}", s.mean),
            Some(s) => format!("{:.digits$}{between}{:.digits$}", s.mean, s.half),
        }
    }

    fn markdown(&self, cells: &Cells) -> String {
        let mut text = format!("| {} | {} |\n", self.rows, cells.columns.join(" | "));
        text += &format!("|---|{}\n", "---|".repeat(cells.columns.len()));
        for (r, row) in cells.rows.iter().enumerate() {
            let shown: Vec<String> =
                cells.row(r).iter().map(|&cell| self.shown(cell, " ± ")).collect();
            text += &format!("| {row} | {} |\n", shown.join(" | "));
        }
        if !self.caption.is_empty() {
            text += &format!("\n{}\n", self.caption_with_intervals());
        }
        text
    }

    fn latex(&self, cells: &Cells) -> String {
        let mut text = String::from("\\begin{table}\n\\centering\n");
        text += &format!("\\begin{{tabular}}{{l{}}}\n\\hline\n", "r".repeat(cells.columns.len()));
        let heads: Vec<String> = cells.columns.iter().map(|column| escaped(column)).collect();
        text += &format!("{} & {} \\\\\n\\hline\n", escaped(&self.rows), heads.join(" & "));
        for (r, row) in cells.rows.iter().enumerate() {
            let shown: Vec<String> = cells
                .row(r)
                .iter()
                .map(|&cell| format!("${}$", self.shown(cell, " \\pm ")))
                .collect();
            text += &format!("{} & {} \\\\\n", escaped(row), shown.join(" & "));
        }
        text += "\\hline\n\\end{tabular}\n";
        text += &format!("\\caption{{{}}}\n", escaped(&self.caption));
        text + &format!("\\label{{tab:{}}}\n\\end{{table}}\n", self.name)
    }
}

/// The numbers of a table, row by row.
struct Cells {
    rows: Vec<String>,
    columns: Vec<String>,
    values: Vec<Option<Summary>>,
}

impl Cells {
    fn row(&self, row: usize) -> &[Option<Summary>] {
        &self.values[row * self.columns.len()..(row + 1) * self.columns.len()]
    }

    fn entries(&self) -> impl Iterator<Item = (&str, &str, Option<Summary>)> {
        let count = self.columns.len();
        self.values.iter().enumerate().map(move |(k, &summary)| {
            (self.rows[k / count].as_str(), self.columns[k % count].as_str(), summary)
        })
    }
}

/// Text with what LaTeX takes for commands made harmless.
pub(crate) fn escaped(text: &str) -> String {
    let mut found = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '\\' => found += "\\textbackslash{}",
            '_' | '%' | '&' | '#' | '$' | '{' | '}' => {
                found.push('\\');
                found.push(c);
            }
            '~' => found += "\\textasciitilde{}",
            '^' => found += "\\textasciicircum{}",
            '<' | '>' => found += &format!("${c}$"),
            _ => found.push(c),
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_is_written_three_ways() {
        let text = |cells: &[&str]| cells.iter().map(|&c| c.to_owned()).collect::<Vec<_>>();
        let frame = Frame {
            header: text(&["method", "seed", "f1_5cm"]),
            rows: vec![
                text(&["a_b", "1", "0.5"]),
                text(&["a_b", "2", "0.7"]),
                text(&["c", "1", ""]),
            ],
        };
        let spec: TableSpec = toml::from_str(
            "name = 't'\n rows = 'method'\n values = ['f1_5cm']\n caption = '100 % sure.'",
        )
        .unwrap();
        spec.check(&["method", "seed"], &["f1_5cm"]).unwrap();
        assert!(spec.check(&["methods"], &["f1_5cm"]).unwrap_err().contains("`methods`"));
        let cells = spec.cells(&frame).unwrap();
        assert!(spec.markdown(&cells).contains("| a_b | 0.60 ± 1.27 |\n| c | - |"));
        let latex = spec.latex(&cells);
        assert!(latex.contains("a\\_b & $0.60 \\pm 1.27$ \\\\"), "{latex}");
        assert!(latex.contains("\\caption{100 \\% sure.}"), "{latex}");
    }
}
