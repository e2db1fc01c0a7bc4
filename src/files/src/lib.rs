//! Files, one format per module; the only part of the library that opens any.

pub mod bal;
pub mod bundler;
pub mod camera;
pub mod camera_positions;
pub mod cloud;
pub mod cloud_points;
pub mod colmap;
mod columns;
pub mod control;
pub mod corners;
pub mod csv_table;
pub mod features;
pub mod field_design;
pub mod gcp_list;
pub mod geoparquet;
pub mod geotiff;
pub mod gpkg;
pub mod image_names;
pub mod images;
pub mod labels;
pub mod leaf_counts;
pub mod leaves;
pub mod model;
pub mod opensfm;
pub mod orientation;
pub mod orthority;
pub mod photo;
pub mod plants;
pub mod points;
pub mod polygons;
pub mod poses;
pub mod qgis;
pub mod rasters;
pub mod reconstruction;
mod table;

pub use rowgram_optim::output::{self, FileError};
