//! From photos to traits: the stages over a project on disk.
//!
//! Every stage is one function, `stage(&Project, &Options, &mut dyn Monitor) -> Result<Outcome, Error>`. It reads what
//! earlier stages wrote, writes its own folder below `Project::results`, and gives typed results. A record of what was
//! read and written decides whether a stage has to be done again ([`stage`]).

pub mod adjust;
pub mod align;
pub mod batches;
pub mod calibrate;
pub mod camera;
mod checks;
mod config;
pub mod convert;
pub mod crops;
pub mod dem;
pub mod doctor;
pub mod evaluate;
pub mod features;
pub mod figures;
pub mod forecast;
pub mod import;
mod layers;
pub mod leaf_count;
pub mod leaf_density;
pub mod leaf_mask;
pub mod leaves;
pub mod locate;
mod map_figures;
mod options_page;
pub mod ortho;
mod orthomosaic;
mod photo_folder;
mod photo_names;
pub mod plan;
pub mod plots;
mod project;
pub mod query;
mod reconstruction;
pub mod record;
#[cfg(feature = "report")]
pub mod report;
pub mod run;
pub mod season;
pub mod segment;
mod stac;
pub mod stage;
pub mod surface;
#[cfg(feature = "synth")]
pub mod synth;
pub mod targets;
pub mod thresholds;
pub mod undistort;
pub mod verify;

pub use checks::ChecksOptions;
pub use config::{Config, NAME as SETTINGS, ProjectOptions, StagesOptions, environment};
pub use options_page::reference_page;
pub use photo_folder::{photos_in, unusable_names_in};
pub use project::{PHOTO_ENDINGS, Project};
pub use stage::{Stage, State, Task};

/// The most memory that this process has used since it began or the count did, in megabytes, where the system tells.
pub fn peak_memory_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kilobytes: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kilobytes / 1024.0)
}

/// Begins to count the most memory anew; `false` where the system cannot.
fn reset_peak_memory() -> bool {
    std::fs::write("/proc/self/clear_refs", "5").is_ok()
}

/// Digest of the sources that this library was built from; results of another build are told by it.
pub const BUILD: &str = env!("ROWGRAM_BUILD");
