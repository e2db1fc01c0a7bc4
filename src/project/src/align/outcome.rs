//! What came of the stage, typed.

use super::{Step, inputs::Inputs};
use rowgram_base::options::Choice;
use rowgram_survey::{
    camera::{Camera, Lens},
    problems::adjustment::Group,
    scene::Role,
    sfm::{
        adjust_block::{AdjustedBlock, gsd_m},
        flight::FlightSummary,
        orientation_review::OrientationSummary,
    },
};
use serde::{Deserialize, Serialize};
use std::{collections::BTreeMap, fmt};

/// Errors of control or check points: root mean squares along X, Y, Z, metres.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct PointErrors {
    /// How many points there are.
    pub count: usize,
    /// Along X, where a point has that coordinate.
    pub rmse_x_m: Option<f64>,
    /// Along Y.
    pub rmse_y_m: Option<f64>,
    /// Along Z.
    pub rmse_z_m: Option<f64>,
}

impl PointErrors {
    /// The largest of the three.
    pub fn worst_m(&self) -> Option<f64> {
        [self.rmse_x_m, self.rmse_y_m, self.rmse_z_m].into_iter().flatten().reduce(f64::max)
    }
}

/// Images that are tied to each other.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fragment {
    /// Their names.
    pub images: Vec<String>,
    /// Whether they are in the block.
    pub joined: bool,
}

/// What came of an alignment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AlignOutcome {
    /// How many photos the project has.
    pub images: usize,
    /// How many of them are oriented.
    pub registered: usize,
    /// Groups of images that nothing ties to each other: 1 where all that is registered is one block.
    pub fragments: usize,
    /// Whether coordinates are in a mapping frame.
    pub georeferenced: bool,
    /// Its name.
    pub crs: String,
    /// Ground sample distance, metres per pixel; `None` without a scale.
    pub gsd_m: Option<f64>,
    /// Root mean square distance of measured and projected tie points, pixels.
    pub reprojection_rms_px: f64,
    /// How many tie points there are.
    pub tie_points: usize,
    /// How many measurements of tie points there are.
    pub observations: usize,
    /// How many pairs of photos are oriented.
    pub pairs: usize,
    /// Where the adjustment puts the control points against their coordinates.
    pub control_points: PointErrors,
    /// Standard deviation of unit weight of the coordinates of control points: how many times larger their residuals are than assumed; absent where nothing is redundant.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub control_sigma0: Option<f64>,
    /// Where the adjustment puts the check points against their coordinates.
    pub check_points: PointErrors,
    /// How many times larger residuals are than assumed.
    pub sigma0: f64,
    /// Whether the adjustment has converged and nothing is suspect any more.
    pub converged: bool,
    /// Angles of a gimbal that took part; absent without.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gimbal: Option<OrientationSummary>,
    /// Height, overlap, times.
    pub flight: FlightSummary,
    /// The lens parameters of every camera by name.
    pub cameras: Vec<BTreeMap<String, f64>>,
    /// Names of photos that are not oriented.
    pub unregistered: Vec<String>,
    /// The groups of images.
    pub fragment_images: Vec<Fragment>,
}

fn errors(rows: &[([f64; 3], &[usize])]) -> PointErrors {
    let rmse = |axis: usize| {
        let of: Vec<f64> = rows
            .iter()
            .filter(|(_, axes)| axes.contains(&axis))
            .map(|(error, _)| error[axis] * error[axis])
            .collect();
        (!of.is_empty()).then(|| (of.iter().sum::<f64>() / of.len() as f64).sqrt())
    };
    PointErrors { count: rows.len(), rmse_x_m: rmse(0), rmse_y_m: rmse(1), rmse_z_m: rmse(2) }
}

fn described(camera: &Camera) -> BTreeMap<String, f64> {
    let parameters = camera.interior.parameters().iter();
    parameters.zip(camera.interior.values()).map(|(p, v)| (p.name.to_owned(), *v)).collect()
}

impl AlignOutcome {
    pub(super) fn new(found: &AdjustedBlock, inputs: &Inputs, pairs: usize) -> AlignOutcome {
        let adjusted = &found.adjusted;
        let block = &adjusted.reconstruction;
        let mut control = Vec::new();
        for (k, point) in block.ground.iter().enumerate() {
            if let (Role::Control, Some(at)) = (point.role, adjusted.ground_m[k]) {
                let error = std::array::from_fn(|axis| at[axis] - point.position_m[axis]);
                control.push((error, point.axes.indices()));
            }
        }
        let checks: Vec<([f64; 3], &[usize])> = adjusted
            .check_points
            .iter()
            .map(|check| (check, &block.ground[check.ground]))
            .filter(|(_, point)| found.checks.contains(&point.name))
            .map(|(check, point)| (check.error_m, point.axes.indices()))
            .collect();
        let ties = adjusted.statistics.groups.iter().find(|group| group.group == Group::TiePoints);
        // Squares of whitened coordinates; two make a distance.
        let reprojection_rms_px = ties.map_or(0.0, |group| {
            (group.squares / (0.5 * group.observations as f64)).sqrt() * block.tie_sigma_px
        });
        let control_group =
            adjusted.statistics.groups.iter().find(|group| group.group == Group::Control);
        let control_sigma0 = control_group.filter(|group| group.redundancy >= 1.0);
        let registered: Vec<&str> = block.images.iter().map(|image| image.name.as_str()).collect();
        let is_left = |name: &&str| !registered.contains(name);
        let mut unregistered: Vec<String> =
            inputs.names().into_iter().filter(is_left).map(str::to_owned).collect();
        unregistered.extend(inputs.left_out.iter().map(|(name, _)| name.clone()));
        unregistered.sort();
        let times: Vec<String> = (inputs.photos.iter())
            .filter(|photo| registered.contains(&photo.name.as_str()))
            .filter_map(|photo| photo.metadata.time())
            .collect();
        let apart = found.fragments.iter().filter(|(_, joined)| !joined).count();
        AlignOutcome {
            images: inputs.photos.len() + inputs.left_out.len(),
            registered: registered.len(),
            fragments: apart + usize::from(!registered.is_empty()),
            georeferenced: found.georeferenced,
            crs: inputs.reference(found).name(),
            gsd_m: found.georeferenced.then(|| gsd_m(block)),
            reprojection_rms_px,
            tie_points: block.points.len(),
            observations: block.observations.len(),
            pairs,
            control_points: errors(&control),
            control_sigma0: control_sigma0.map(|group| (group.squares / group.redundancy).sqrt()),
            check_points: errors(&checks),
            sigma0: adjusted.statistics.sigma0,
            converged: adjusted.converged() && found.complete,
            gimbal: found.orientations.clone(),
            flight: FlightSummary::of(block, &times),
            cameras: block.cameras.iter().map(described).collect(),
            unregistered,
            fragment_images: found
                .fragments
                .iter()
                .map(|(images, joined)| Fragment { images: images.clone(), joined: *joined })
                .collect(),
        }
    }
}

impl fmt::Display for AlignOutcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let groups = if self.fragments == 1 { "block" } else { "blocks" };
        writeln!(
            f,
            "{} of {} images oriented in {} {groups}; frame: {}",
            self.registered, self.images, self.fragments, self.crs
        )?;
        let gsd = self.gsd_m.map_or(String::new(), |gsd| format!(", {gsd:.4} m per pixel"));
        writeln!(
            f,
            "{} tie points, {} observations, reprojection rms {:.3} px{gsd}",
            self.tie_points, self.observations, self.reprojection_rms_px
        )?;
        // Those of the check points are in the summary of the adjustment.
        let errors = &self.control_points;
        if let (Some(x), Some(y), Some(z)) = (errors.rmse_x_m, errors.rmse_y_m, errors.rmse_z_m) {
            writeln!(f, "{} control points: rmse {x:.4} {y:.4} {z:.4} m", errors.count)?;
        }
        if !self.unregistered.is_empty() {
            writeln!(f, "not oriented: {}", self.unregistered.join(", "))?;
        }
        Ok(())
    }
}

/// What is known where an alignment ends before its last step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PartialReport {
    /// The last step that was done.
    pub until: Step,
    /// How many photos the project has.
    pub images: usize,
    /// Features of all photos.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub features: Option<usize>,
    /// Pairs of photos that match, and are oriented from the step verify on.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pairs: Option<usize>,
    /// Matches of those pairs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub matches: Option<usize>,
    /// Images of the largest block.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub registered: Option<usize>,
    /// Blocks.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fragments: Option<usize>,
}

impl PartialReport {
    pub(super) fn new(inputs: &Inputs, until: Step) -> PartialReport {
        PartialReport {
            until,
            images: inputs.photos.len() + inputs.left_out.len(),
            features: None,
            pairs: None,
            matches: None,
            registered: None,
            fragments: None,
        }
    }
}

impl fmt::Display for PartialReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "until {}: {} images", self.until.word(), self.images)?;
        for (count, what) in [
            (self.features, "features"),
            (self.pairs, "pairs"),
            (self.matches, "matches"),
            (self.registered, "images in the largest block"),
            (self.fragments, "blocks"),
        ] {
            if let Some(count) = count {
                write!(f, ", {count} {what}")?;
            }
        }
        writeln!(f)
    }
}
