//! Bundle adjustment as photogrammetrists need it: many cameras with lenses that are held, free or
//! known beforehand; control, check and tie points on the ground; camera positions, distances, a
//! rolling shutter; and the statistics that a surveyor signs.
//!
//! ```text
//! min 1/2 [ sum |u(P_ij; interior) - u_ij|^2 / s_tie^2       tie points, P_ij = R_i X_j + t_i
//!         + sum |u(P_ik; interior) - u_ik|^2 / s_ik^2        marks of ground points
//!         + sum |X_k - X_k0|^2 / s_k^2                       coordinates of control points
//!         + sum |C_i + R_i^T l + o - C_i0|^2 / s_i^2         camera positions, lever arm l, offset o from control
//!         + sum |log(R_i^T exp(-b) R_i0 exp(-w))|^2 / s_i^2  orientations of a gimbal, errors w and b common to a camera's
//!         + sum (|X_a - X_b| - d_ab)^2 / s_ab^2              scale bars
//!         + (p - p_0)^T C_p^-1 (p - p_0) + ... ]             interior orientation, motion
//! ```
//!
//! Residuals are in measured pixels. Check points take no part. A [`Reconstruction`](crate::scene::Reconstruction) is validated
//! ([`validate`]), posed as a problem ([`AdjustmentProblem`]), solved by [`rowgram_optim::nlls`], and evaluated ([`Statistics`]);
//! [`adjust()`] does all of it, [`snoop`] again and again until no observation is suspect.
//!
//! References: W. Foerstner and B. P. Wrobel, *Photogrammetric Computer Vision*, 2016, chapters 4 and
//! 15; W. Baarda, *A testing procedure for use in geodetic networks*, 1968; A. J. Pope, *The statistics
//! of residuals and the detection of outliers*, 1976.

mod accuracy;
mod align;
mod analysis;
mod check_points;
mod cluster_robust;
mod consistency;
mod factors;
mod inverse;
mod orientations;
mod problem;
mod rank;
mod rays;
mod reprojection;
mod settings;
mod snooping;
mod statistics;
mod tested;
mod validation;

pub use accuracy::{ImageAccuracy, InteriorAccuracy, PointAccuracy};
pub use align::{Alignment, align};
pub use analysis::{
    AdjustError, Adjusted, LeaveOneOut, VarianceComponents, adjust, leave_one_out,
    variance_components,
};
pub(crate) use check_points::nearest_to_rays;
pub use check_points::{AxisError, CheckPoint, check_points, rmse};
pub use orientations::{ATTITUDE_BIAS_SIGMA_RAD, BORESIGHT_SIGMA_RAD};
pub use problem::{AdjustmentProblem, ScaleDatum};
pub use rank::{Undetermined, undetermined};
pub use settings::{Group, Settings};
pub use snooping::{DataSnooping, DataSnoopingOptions, Removed, retained_suspects, snoop};
pub use statistics::{GroupStatistics, ObservationRef, OutlierTest, Statistics, TestedObservation};
pub use validation::{InvalidReconstruction, Validated, validate};
