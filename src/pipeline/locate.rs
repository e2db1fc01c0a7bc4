//! The place of every plant.

use crate::options::Auto;
use serde::{Deserialize, Serialize};

/// A named way to locate plants.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LocateMethod {
    /// Votes along leaf axes, dynamic programming along curved rows.
    RowModel,
    /// `RowModel`, then the tempered descent from its plants.
    Refined,
    /// The tempered descent from regular spacing: row prior, truncated distances.
    Tempered,
    /// The paper: row prior of the other plants, mean distance as scale, from k-means++.
    Paper,
    /// k-means from k-means++.
    Kmeans,
    /// Detected rows and regular spacing; nothing is fitted.
    Rows,
}

crate::choices!(LocateMethod: RowModel, Refined, Tempered, Paper, Kmeans, Rows);

crate::options! {
    /// The place of every plant.
    pub struct LocateOptions in "locate" {
        /// Number of plants; auto finds as many as there seem to be.
        pub plants: Auto<usize> = Auto::Auto, limits at_least(1.0);
        /// How plants are located.
        pub method: LocateMethod = LocateMethod::RowModel;
    }
}
