//! One lens model put in place of another: what a fit over the sensor leaves.

use crate::stage::{Measured, Metric, Stage, Trace, metric};
use data_synth::camera::CameraConfig;
use rowgram::{
    camera::{Interior, Lens, Model},
    problems::lens_fit,
};
use serde::{Deserialize, Serialize};

/// What can be varied.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Parameters {
    /// The true lens (SMAC).
    camera: CameraConfig,
    /// All its distortion is multiplied with this.
    strength: f64,
    /// The model that takes its place.
    model: Model,
    /// Parameters of that model that are held at their defaults.
    held: Vec<String>,
    /// Whether the differences over the sensor are kept.
    trace: bool,
}

impl Default for Parameters {
    fn default() -> Parameters {
        Parameters {
            camera: CameraConfig::default(),
            strength: 1.0,
            model: Model::Brown,
            held: Vec::new(),
            trace: false,
        }
    }
}

/// Pixels between the places of the differences.
const STEP_PX: u32 = 250;

/// The stage.
pub(crate) struct LensFit;

impl Stage for LensFit {
    type Parameters = Parameters;
    const NAME: &'static str = "lens";
    const ABOUT: &'static str = "one lens model fitted to another over the sensor";
    const METRICS: &'static [Metric] = &[
        metric("rms_px", "root mean square distance of the fit"),
        metric("largest_px", "largest distance"),
        metric("left_out", "share of the sensor for which a model has no place"),
        metric("corner_px", "distortion of the true lens at the corner"),
    ];

    fn check(p: &Parameters) -> Result<(), String> {
        let unknown = |name: &&String| p.model.place(name).is_none();
        if let Some(name) = p.held.iter().find(unknown) {
            let known = p.model.parameters().iter().map(|parameter| parameter.name);
            return Err(crate::keys::unknown("parameter", name, known));
        }
        source(p).map(drop)
    }

    fn run(p: &Parameters, _seed: u64) -> Result<Measured, String> {
        let source = source(p)?;
        // The scale of SMAC's radius is the principal distance once more.
        let free: Vec<&str> = p
            .model
            .parameters()
            .iter()
            .filter(|parameter| parameter.estimable && parameter.name != "K0")
            .map(|parameter| parameter.name)
            .filter(|name| !p.held.iter().any(|held| held == name))
            .collect();
        let fit = lens_fit::fit(&source, p.model, &free).map_err(|e| e.to_string())?;
        let mut measured = Measured::default();
        measured.put("rms_px", fit.rms_px);
        measured.put("largest_px", fit.largest_px);
        measured.put("left_out", fit.left_out as f64 / (fit.points + fit.left_out) as f64);
        measured.put_some("corner_px", corner(&source));
        if p.trace {
            let mut field = Trace::new("differences", &["u_px", "v_px", "du_px", "dv_px"]);
            let [width, height] = source.size_px();
            for v in (0..height).step_by(STEP_PX as usize) {
                for u in (0..width).step_by(STEP_PX as usize) {
                    let at = [f64::from(u), f64::from(v)];
                    let again = source.unproject(at).and_then(|ray| fit.interior.project(ray));
                    if let Some([x, y]) = again {
                        field.rows.push(vec![at[0], at[1], x - at[0], y - at[1]]);
                    }
                }
            }
            measured.traces.push(field);
        }
        Ok(measured)
    }
}

fn source(p: &Parameters) -> Result<Interior, String> {
    let c = &p.camera;
    c.check().map_err(|e| e.to_string())?;
    let s = p.strength;
    let [k1, k2, k3] = [c.k1, c.k2, c.k3].map(|value| s * value);
    let values = [c.c_px, c.xp_px, c.yp_px, s * c.k0, k1, k2, k3, s * c.p1, s * c.p2, c.r0_px];
    Interior::new(Model::Smac, [c.width_px, c.height_px], &values).map_err(|e| e.to_string())
}

/// How far the lens puts the corner's ray from where a lens without distortion would.
fn corner(lens: &Interior) -> Option<f64> {
    let [x, y, z] = lens.unproject([0.0, 0.0])?;
    let c = lens.principal_distance_px();
    let centre = lens.centre_px();
    let (xp, yp) = (lens.value("xp_px")?, lens.value("yp_px")?);
    let ideal = [centre[0] + xp - c * x / z, centre[1] - yp + c * y / z];
    Some(ideal[0].hypot(ideal[1]))
}
