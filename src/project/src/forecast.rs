//! What a flight will take, before hours are spent on it: memory, processor time and disk of `align`; memory and processor time of the stages
//! that make and read maps.
//!
//! ```text
//! memory = photos in work + bytes a feature * F * N + max(descriptors in use, bytes a measurement * measurements)
//! measurements = min(F * share * N, M)
//! time = seconds a photo * N,   disk = bytes of a feature * F * N
//! ```
//!
//! with `N` photos, at most `F` features in each, and at most `M` measurements that are adjusted; descriptors are released before the adjustment. The numbers come from `rowgram align` on
//! synthetic flights of 135 to 2,108 photos with 6,000 features (`docs/optimisation.md`); other flights are extrapolation. Those with 75 % and 65 % of
//! overlap have 4,700 measurements a photo, one with 70 % and 65 % 2,850, 12 real photos of a meadow 570.

use super::align::DESCRIPTORS_IN_MEMORY_BYTES;
use rowgram_base::monitor::Diagnostic;
use rowgram_files::memory;
use rowgram_optim::output::FileError;
use std::path::Path;

/// Memory of photos in work and of the program itself: six photos of 9 and 12 megapixels took 180 MB with one thread, 190 with two.
/// More threads were not measured.
const WORK_BYTES: f64 = 200e6;
/// Memory for each measurement of the adjusted block and its statistics, and for each feature of a photo with its matches and tracks. Two flights with
/// at most a million measurements (`docs/optimisation.md`): with large blocks of memory returned as soon as they are freed, 252 and 984 photos took 0.85 and
/// 1.33 GB, 110 bytes for each further feature; as the program is, 252 photos took 0.94 and 0.98 GB. A fifth is added to the 110 bytes,
/// since 984 photos were not measured like that.
const MEASUREMENT_BYTES: f64 = 580.0;
const MATCHED_BYTES: f64 = 130.0;
/// Share of the features that become measurements of tie points: 639,000 of 135 times 6,000.
const MEASURED: f64 = 0.79;
/// Disk for a feature, its matches included: the cache of 1,056 photos has 1.18 GB. Of that 128 bytes are the descriptor in memory.
const FEATURE_BYTES: f64 = 190.0;
/// Processor time for a photo, seconds: 2.8 on that flight, 2.3 on 12 photos of 3 megapixels.
const PHOTO_S: f64 = 3.0;

/// Memory of `locate`, which of all stages after the orthomosaic takes most: so much for decoded tiles that are kept, at most, and so much for
/// each pixel of the map. A map of 450 million pixels with closed rows took 2.15 GB, one of 247 million in a project 1.15 (`docs/optimisation.md`), one of 3.2 million 59 MB in all; a mask that is
/// filtered is held with its posterior, which are 2 bytes a pixel more.
const LOCATE_BYTES: f64 = 4e8;
const PIXEL_BYTES: f64 = 6.5;

/// A stage on a map: its name, processor time for a million pixels, seconds, and memory: at least, and for each pixel, bytes. The tables of
/// `docs/optimisation.md`; leaves take what the larger of the two maps took.
const MAP_STAGES: [(&str, f64, f64, f64); 6] = [
    ("surface", 3.9, 1.1e9, 0.0),
    ("orthomosaic", 0.25, 0.75e9, 0.0),
    ("leaf mask", 0.11, 0.4e9, 0.6),
    ("plants", 0.55, LOCATE_BYTES, PIXEL_BYTES),
    ("leaves", 0.53, LOCATE_BYTES, 6.0),
    ("plots", 0.12, LOCATE_BYTES, 2.3),
];

/// What the stages after `align` take for a map of so many pixels: processor time of all threads together in seconds, and memory of the stage
/// that takes most, with its name.
fn map_need(pixels: f64) -> (f64, &'static str, f64) {
    let processor_s = MAP_STAGES.iter().map(|(_, s, ..)| s * pixels / 1e6).sum();
    let memory = MAP_STAGES.iter().map(|&(name, _, base, each)| (name, base + each * pixels));
    let (name, most) =
        memory.fold(("", 0.0), |most, next| if next.1 > most.1 { next } else { most });
    (processor_s, name, most)
}

/// What the stages after `align` will take for a map of about so many pixels; a warning where this machine has less memory.
pub fn maps_diagnostic(pixels: f64, threads: usize, available_bytes: Option<f64>) -> Diagnostic {
    let (processor_s, stage, most) = map_need(pixels);
    let minutes = (processor_s / 60.0 / threads.max(1) as f64).ceil();
    let message = format!(
        "surface, orthomosaic and traits of a map of about {:.0} million pixels take about {minutes:.0} min on {threads} threads and up to {} of memory ({stage})",
        (pixels / 1e6).ceil(),
        size(most)
    );
    match available_bytes.filter(|&available| available < most) {
        Some(available) => {
            let message = format!("{message}; {} of memory are free", size(available));
            Diagnostic::warning("map-memory-short", "maps", message).with_remedy(COARSER)
        }
        None => Diagnostic::info("maps-forecast", "maps", message),
    }
}

/// What to do about a map that is too large.
const COARSER: &str = "make the map coarser or of parts of the field ([ortho] gsd_m, bounds_m; of an orthomosaic that is given, resample or cut the file)";

/// Refuses a map of so many columns and rows whose plants take more memory to be located than there is.
///
/// # Errors
/// Both numbers.
pub fn require_map(path: &Path, (width, height): (usize, usize)) -> Result<(), FileError> {
    let what = format!("locating plants on {width} x {height} pixels");
    memory::require(path, &what, (PIXEL_BYTES * width as f64 * height as f64) as u64)
}

/// A warning where this machine has less memory than plants of a map of so many columns and rows take to be located.
pub fn map_diagnostic(
    subject: &str,
    (width, height): (usize, usize),
    available_bytes: Option<f64>,
) -> Option<Diagnostic> {
    let needed = LOCATE_BYTES + PIXEL_BYTES * width as f64 * height as f64;
    let available = available_bytes.filter(|&available| available < needed)?;
    let message = format!(
        "locating plants on a map of {width} x {height} pixels takes up to {} of memory; {} are free",
        size(needed),
        size(available)
    );
    Some(Diagnostic::warning("map-memory-short", subject, message).with_remedy(COARSER))
}

/// What `align` will take.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Forecast {
    /// Photos.
    pub photos: usize,
    /// Memory at most, bytes.
    pub memory_bytes: f64,
    /// Processor time of all threads together, seconds.
    pub processor_s: f64,
    /// Disk for what is kept between the steps, bytes.
    pub disk_bytes: f64,
}

impl Forecast {
    /// Of a flight of `photos` with at most `max_features` in each, and at most `max_tie_observations` that are adjusted.
    pub fn new(photos: usize, max_features: usize, max_tie_observations: usize) -> Forecast {
        let features = photos as f64 * max_features as f64;
        let measurements = (MEASURED * features).min(max_tie_observations as f64);
        let descriptors = (FEATURE_BYTES * features).min(DESCRIPTORS_IN_MEMORY_BYTES as f64);
        Forecast {
            photos,
            memory_bytes: WORK_BYTES
                + MATCHED_BYTES * features
                + descriptors.max(MEASUREMENT_BYTES * measurements),
            processor_s: PHOTO_S * photos as f64,
            disk_bytes: FEATURE_BYTES * features,
        }
    }

    /// A warning where less disk is free than that.
    pub fn disk_diagnostic(&self, free_bytes: Option<f64>) -> Option<Diagnostic> {
        let free = free_bytes.filter(|&free| free < self.disk_bytes)?;
        let message = format!(
            "align of {} photos keeps {} between its steps; {} are free where results go",
            self.photos,
            size(self.disk_bytes),
            size(free)
        );
        let remedy = "make room, or choose another folder for the results (--output)";
        Some(Diagnostic::warning("disk-short", "align", message).with_remedy(remedy))
    }

    /// In words; a warning where this machine has less memory than that.
    pub fn diagnostic(&self, threads: usize, available_bytes: Option<f64>) -> Diagnostic {
        let minutes = self.processor_s / 60.0 / threads.max(1) as f64;
        let message = format!(
            "align of {} photos takes up to {} of memory, {} of disk and about {:.0} min on {threads} threads",
            self.photos,
            size(self.memory_bytes),
            size(self.disk_bytes),
            minutes.ceil()
        );
        match available_bytes {
            Some(available) if available < self.memory_bytes => {
                let message = format!("{message}; {} of memory are free", size(available));
                Diagnostic::warning("memory-short", "align", message)
                    .with_remedy("lower max_features or max_tie_observations in [align], or align parts of the flight")
            }
            _ => Diagnostic::info("align-forecast", "align", message),
        }
    }
}

fn size(bytes: f64) -> String {
    match bytes {
        bytes if bytes < 1e9 => format!("{:.0} MB", bytes / 1e6),
        bytes => format!("{:.1} GB", bytes / 1e9),
    }
}

/// Disk that is free for a folder, which need not be there yet, bytes; `None` where the system does not say (Unix does).
#[cfg(unix)]
pub fn free_disk_bytes(folder: &Path) -> Option<f64> {
    let folder = folder.ancestors().find(|folder| folder.is_dir())?;
    let found = rustix::fs::statvfs(folder).ok()?;
    Some(found.f_bavail as f64 * found.f_frsize as f64)
}

/// Disk that is free for a folder, bytes: this system is not asked.
#[cfg(not(unix))]
pub fn free_disk_bytes(_: &Path) -> Option<f64> {
    None
}

/// Memory that can be had, bytes; `None` where the system does not say (Linux does).
pub fn available_bytes() -> Option<f64> {
    memory::available_bytes().map(|bytes| bytes as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flights_that_were_measured_take_what_is_said() {
        // docs/optimisation.md; of 984 photos the memory where freed blocks are returned at once.
        for (photos, memory_bytes, disk_bytes) in [(252, 0.96e9, 0.26e9), (984, 1.33e9, 0.99e9)] {
            let said = Forecast::new(photos, 6000, 1_000_000);
            assert!((memory_bytes..1.25 * memory_bytes).contains(&said.memory_bytes), "{said:?}");
            assert!((0.95 * disk_bytes..1.25 * disk_bytes).contains(&said.disk_bytes), "{said:?}");
        }
        let small = Forecast::new(135, 6000, 1_000_000);
        assert!((357.0..1.25 * 357.0).contains(&small.processor_s), "{small:?}");
    }

    #[test]
    fn a_map_that_does_not_fit_is_told_before() {
        let map = |available| map_diagnostic("mask.tif", (21_848, 20_685), available);
        // Measured: 2.15 GB as a file of its own, and 2 bytes a pixel for a mask that is filtered.
        assert_eq!(map(Some(3.05e9)).unwrap().code, "map-memory-short");
        assert_eq!(map(Some(3.5e9)), None);
        assert_eq!(map(None), None);
    }

    #[test]
    fn maps_that_were_measured_take_what_is_said() {
        // docs/optimisation.md: a surface in 139 s, one of photos of 12 megapixels in 3.9 s for each million cells, maps of 452 million pixels in 555 s from the leaf mask on, with 2.2 GB at most where the mask is not filtered, and 3.1 else.
        let (seconds, _, memory) = map_need(6505.0 * 6864.0);
        assert!((150.0..250.0).contains(&seconds) && memory < 1.2e9, "{seconds} {memory}");
        let (seconds, stage, memory) = map_need(21_848.0 * 20_685.0);
        let surface_and_mosaic = 4.15 * 21.848 * 20.685;
        assert!((0.9..1.2).contains(&((seconds - surface_and_mosaic) / 555.0)), "{seconds}");
        assert!(stage == "plants" && (3.1e9..3.5e9).contains(&memory), "{stage} {memory}");
        assert_eq!(maps_diagnostic(45e6, 2, Some(1e12)).code, "maps-forecast");
        assert_eq!(maps_diagnostic(45e8, 2, Some(1e9)).code, "map-memory-short");
    }

    #[test]
    fn a_full_disk_is_told_before() {
        let large = Forecast::new(5000, 6000, 1_000_000);
        assert_eq!(large.disk_diagnostic(Some(1e9)).unwrap().code, "disk-short");
        assert_eq!(large.disk_diagnostic(Some(1e12)), None);
        assert_eq!(large.disk_diagnostic(None), None);
        if cfg!(unix) {
            let there = std::env::temp_dir();
            let free = free_disk_bytes(&there).unwrap();
            let below = free_disk_bytes(&there.join("not/yet/there")).unwrap();
            // Others write meanwhile.
            assert!(free > 0.0 && (below / free - 1.0).abs() < 0.5, "{free} {below}");
        }
    }

    #[test]
    fn short_memory_is_a_warning() {
        let large = Forecast::new(5000, 6000, 1_000_000);
        assert_eq!(large.diagnostic(8, Some(3e9)).code, "memory-short");
        assert_eq!(large.diagnostic(8, Some(1e12)).code, "align-forecast");
        assert_eq!(large.diagnostic(8, None).code, "align-forecast");
        let fewer = Forecast::new(5000, 6000, 200_000);
        assert!(fewer.memory_bytes < large.memory_bytes);
        assert!(Forecast::new(5000, 2000, 1_000_000).memory_bytes < large.memory_bytes);
    }
}
