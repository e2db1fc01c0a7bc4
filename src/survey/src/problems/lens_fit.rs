//! One lens model by another: a least-squares fit over the sensor.
//!
//! ```text
//! min  1/2 sum_i | u(target; d_i) - p_i |^2,   d_i: ray of pixel p_i in the source
//! ```
//!
//! over the free parameters of the target, for a grid of pixels `p_i` over the whole image. Models differ in
//! shape, so what remains is part of the answer: its root mean square and its largest value, pixels.

use crate::camera::{CameraError, Interior, Lens, Model};
use nalgebra::{Matrix3, Vector3};
use rowgram_optim::nlls::{
    self, BlockId, Euclidean, Factor, Factors, Infeasible, Jacobian, Loss, Options, Problem,
};
use serde::Serialize;

/// A fitted lens and what the fit leaves.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Fit {
    /// The lens.
    #[serde(skip)]
    pub interior: Interior,
    /// Pixels of the grid that took part.
    pub points: usize,
    /// Pixels of the grid for which the source has no ray, or the target's model no place.
    pub left_out: usize,
    /// Root mean square of the distances, pixels.
    pub rms_px: f64,
    /// The largest distance, pixels.
    pub largest_px: f64,
    /// Where it is, pixels.
    pub largest_at_px: [f64; 2],
}

/// Pixels along the longer side of the grid.
const GRID: u32 = 48;
/// A flat image plane has no place for rays further from the axis than this.
const WIDEST_RAD: f64 = 1.45;

/// A pixel of the source as a factor of the target.
#[derive(Debug, Clone, Copy)]
struct Ray {
    blocks: [BlockId; 1],
    model: Model,
    size_px: [u32; 2],
    direction: [f64; 3],
    image_px: [f64; 2],
}

impl Factor for Ray {
    fn rows(&self) -> usize {
        2
    }

    fn blocks(&self) -> &[BlockId] {
        &self.blocks
    }

    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        jacobian: Option<&mut Jacobian<'_>>,
    ) -> Result<(), Infeasible> {
        let centre = self.size_px.map(|n| 0.5 * (f64::from(n) - 1.0));
        let lens = Interior::unchecked(self.model, self.size_px, centre, x[0]);
        let found = lens.project_with_derivatives(self.direction).ok_or(Infeasible)?;
        for row in 0..2 {
            residual[row] = found.image_px[row] - self.image_px[row];
        }
        if let Some(jacobian) = jacobian {
            for row in 0..2 {
                jacobian.row(row).copy_from_slice(&found.by_parameters[row][..x[0].len()]);
            }
        }
        Ok(())
    }
}

/// What a lens does at its axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Axis {
    /// Principal distance along the rows, pixels.
    pub f_px: f64,
    /// That along the columns over it.
    pub aspect: f64,
    /// Where the axis meets the image, pixels.
    pub at_px: [f64; 2],
}

/// The lens of `model` with the parameters `free` that is nearest to `source`.
///
/// # Errors
/// Where the source shows too little for it, or no lens of the model is near.
pub fn fit(source: &Interior, model: Model, free: &[&str]) -> Result<Fit, CameraError> {
    let axis = source
        .project_with_derivatives([0.0, 0.0, -1.0])
        .ok_or_else(|| CameraError("the lens has no image of its own axis".into()))?;
    let f_px = axis.by_point[0][0].abs();
    let aspect = axis.by_point[1][1].abs() / f_px;
    let axis = Axis { f_px, aspect, at_px: axis.image_px };
    fit_rays(source.size_px(), |at| source.unproject(at), &axis, model, free)
}

/// As [`fit`], of any lens by the rays of its pixels.
///
/// # Errors
/// As [`fit`].
pub fn fit_rays(
    size_px: [u32; 2],
    ray: impl Fn([f64; 2]) -> Option<[f64; 3]>,
    axis: &Axis,
    model: Model,
    free: &[&str],
) -> Result<Fit, CameraError> {
    let [width, height] = size_px.map(|n| f64::from(n) - 1.0);
    let step = width.max(height) / f64::from(GRID - 1);
    let flat = model != Model::Fisheye;
    let mut rays = Vec::new();
    let mut left_out = 0;
    let (columns, rows) = ((width / step).round() as u32, (height / step).round() as u32);
    let is_seen = |ray: &[f64; 3]| {
        let length = ray.iter().map(|v| v * v).sum::<f64>().sqrt();
        !flat || -ray[2] > WIDEST_RAD.cos() * length
    };
    for j in 0..=rows {
        for i in 0..=columns {
            let at = [
                width * f64::from(i) / f64::from(columns.max(1)),
                height * f64::from(j) / f64::from(rows.max(1)),
            ];
            match ray(at).filter(is_seen) {
                Some(ray) => rays.push((ray, at)),
                None => left_out += 1,
            }
        }
    }
    let mut start = start(axis, model, size_px);
    let parameters = model.parameters();
    if rays.len() < parameters.len() {
        return Err(CameraError("the camera has next to no rays to fit a lens to".into()));
    }
    // From the middle outwards: a model that turns over far outside can be approached from within.
    let centre = [0.5 * width, 0.5 * height];
    let radius = |at: [f64; 2]| (at[0] - centre[0]).hypot(at[1] - centre[1]);
    let furthest = rays.iter().map(|ray| radius(ray.1)).fold(0.0, f64::max);
    let mut used = Vec::new();
    let shares: &[f64] = match rational(&rays, model, size_px, &start, free) {
        Some(near) => {
            start = near;
            &[1.0]
        }
        None => &[0.3, 0.5, 0.7, 0.85, 1.0],
    };
    for share in shares {
        let lens = Interior::new(model, size_px, &start)?;
        let inside: Vec<_> = rays
            .iter()
            .filter(|ray| radius(ray.1) <= share * furthest * (1.0 + 1e-9))
            .filter(|ray| lens.project(ray.0).is_some())
            .copied()
            .collect();
        if inside.len() < parameters.len() {
            continue;
        }
        start = adjust(&inside, model, size_px, &start, free)?;
        used = inside;
    }
    let interior = Interior::new(model, size_px, &start)?;
    let (mut squares, mut largest, mut largest_at) = (0.0, 0.0, [0.0; 2]);
    let mut points = 0;
    for (ray, at) in &rays {
        let Some(found) = interior.project(*ray) else {
            left_out += 1;
            continue;
        };
        let off = (found[0] - at[0]).hypot(found[1] - at[1]);
        points += 1;
        squares += off * off;
        if off > largest {
            (largest, largest_at) = (off, *at);
        }
    }
    if used.is_empty() || points == 0 {
        return Err(CameraError(format!("no {} lens is near this camera", model.word())));
    }
    Ok(Fit {
        interior,
        points,
        left_out,
        rms_px: (squares / points as f64).sqrt(),
        largest_px: largest,
        largest_at_px: largest_at,
    })
}

/// A lens without distortion that agrees with the source on its axis.
fn start(axis: &Axis, model: Model, size_px: [u32; 2]) -> Vec<f64> {
    let centre = size_px.map(|n| 0.5 * (f64::from(n) - 1.0));
    let parameters = model.parameters().iter().enumerate();
    parameters
        .map(|(k, parameter)| match parameter.name {
            "c_px" | "f_px" => axis.f_px,
            "aspect" => axis.aspect,
            "cx_px" => axis.at_px[0],
            "cy_px" => axis.at_px[1],
            "xp_px" => axis.at_px[0] - centre[0],
            "yp_px" => centre[1] - axis.at_px[1],
            _ => model.default_value(k, size_px).unwrap_or(0.0),
        })
        .collect()
}

/// Brown's rational lens by a linear fit of its denominator alone, `1/q = 1 + k4 s + k5 s^2 + k6 s^3`: near enough that all
/// rays have an image from the beginning. In the middle of the picture six terms say next to nothing, and a lens grown
/// from there turns over. `None` where the six are not asked for, or rays have no image even so.
fn rational(
    rays: &[([f64; 3], [f64; 2])],
    model: Model,
    size_px: [u32; 2],
    start: &[f64],
    free: &[&str],
) -> Option<Vec<f64>> {
    let mut places = [0; 3];
    for (place, name) in places.iter_mut().zip(["k4", "k5", "k6"]) {
        *place = model.place(name).filter(|_| free.contains(&name))?;
    }
    let [f, aspect, cx, cy] =
        ["f_px", "aspect", "cx_px", "cy_px"].map(|name| model.place(name).map(|at| start[at]));
    let (f, aspect, cx, cy) = (f?, aspect?, cx?, cy?);
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for (d, at) in rays {
        let ideal = d[0].hypot(d[1]) / -d[2];
        let measured = ((at[0] - cx) / f).hypot((at[1] - cy) / (f * aspect));
        let s = ideal * ideal;
        let row = Vector3::new(s, s * s, s * s * s);
        // Ideal radii have weight by how long they are measured, or the axis would divide by nothing.
        normal += measured * measured * row * row.transpose();
        right += measured * (ideal - measured) * row;
    }
    let found = normal.cholesky()?.solve(&right);
    let mut values = start.to_vec();
    for (value, &place) in found.iter().zip(&places) {
        values[place] = *value;
    }
    let lens = Interior::new(model, size_px, &values).ok()?;
    rays.iter().all(|(ray, _)| lens.project(*ray).is_some()).then_some(values)
}

fn adjust(
    rays: &[([f64; 3], [f64; 2])],
    model: Model,
    size_px: [u32; 2],
    start: &[f64],
    free: &[&str],
) -> Result<Vec<f64>, CameraError> {
    let failed = |error: rowgram_optim::engine::SolveError| CameraError(error.to_string());
    let mut problem = Problem::new();
    let lens = problem.block("lens", Euclidean(start.len()), start).map_err(failed)?;
    let held: Vec<usize> = model
        .parameters()
        .iter()
        .enumerate()
        .filter(|(_, p)| !(p.estimable && free.contains(&p.name)))
        .map(|(k, _)| k)
        .collect();
    problem.fix_entries(lens, &held).map_err(failed)?;
    let factors = rays.iter().map(|&(direction, image_px)| Ray {
        blocks: [lens],
        model,
        size_px,
        direction,
        image_px,
    });
    problem.add("pixels", Loss::Trivial, Factors(factors.collect())).map_err(failed)?;
    let mut x = problem.start();
    let options =
        Options { linear: nlls::LinearSolver::Dense, cost_tolerance: 1e-12, ..Options::default() };
    nlls::solve(&problem, &mut x, &options, 200).map_err(failed)?;
    Ok(x)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [u32; 2] = [1280, 960];

    fn brown(values: &[f64]) -> Interior {
        let mut all = vec![0.0; 12];
        all[..values.len()].copy_from_slice(values);
        Interior::new(Model::Brown, SIZE, &all).unwrap()
    }

    #[test]
    fn a_model_fits_itself_exactly() {
        let source = brown(&[900.0, 1.001, 650.0, 470.0, -0.2, 0.05, 1e-3, -5e-4, -0.01]);
        let names = ["f_px", "aspect", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3"];
        let found = fit(&source, Model::Brown, &names).unwrap();
        assert!(found.largest_px < 1e-6, "{found:?}");
        for (a, b) in found.interior.values().iter().zip(source.values()) {
            assert!((a - b).abs() < 1e-6 * b.abs().max(1.0), "{a} {b}");
        }
    }

    #[test]
    fn smac_and_brown_describe_a_mild_lens_alike_and_say_how_well() {
        let source = brown(&[1500.0, 1.0, 640.0, 480.0, -0.12, 0.03, 2e-4, -3e-4, 0.0]);
        let names = ["c_px", "xp_px", "yp_px", "K1", "K2", "K3", "P1", "P2"];
        let there = fit(&source, Model::Smac, &names).unwrap();
        assert!(there.rms_px < 5e-3 && there.largest_px < 0.05, "{there:?}");
        // Fewer terms leave more.
        let poor = fit(&source, Model::Smac, &["c_px", "xp_px", "yp_px", "K1"]).unwrap();
        assert!(poor.rms_px > 10.0 * there.rms_px, "{poor:?}");
        let at = poor.interior.unproject(poor.largest_at_px);
        assert!(at.is_some());
    }

    #[test]
    fn an_action_camera_has_its_lens_in_the_rational_form() {
        // A quarter of its radius is distortion in the corners.
        let values = [1000.0, 3.1, -2.4, 0.0, 2.6e-7, 6e-14, 2e-20, 6e-7, -4e-7, 0.0];
        let names = Model::Smac.parameters().iter().map(|p| p.name);
        let named = |name: &str| match name {
            "c_px" => values[0],
            "xp_px" => values[1],
            "yp_px" => values[2],
            "K1" => values[4],
            "K2" => values[5],
            "K3" => values[6],
            "P1" => values[7],
            "P2" => values[8],
            _ => 0.0,
        };
        let values: Vec<f64> = names.map(named).collect();
        let source = Interior::new(Model::Smac, [2288, 1716], &values).unwrap();
        let mut names = vec!["f_px", "aspect", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3"];
        let three = fit(&source, Model::Brown, &names).unwrap();
        names.extend(["k4", "k5", "k6"]);
        let six = fit(&source, Model::Brown, &names).unwrap();
        assert_eq!(six.left_out, 0, "{six:?}");
        assert!(six.rms_px < 0.3, "{six:?}");
        assert!(three.rms_px > 5.0 * six.rms_px, "{three:?}");
    }

    #[test]
    fn rays_a_flat_picture_has_no_place_for_are_counted() {
        let values = [400.0, 1.0, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0];
        let source = Interior::new(Model::Fisheye, SIZE, &values).unwrap();
        let names = ["f_px", "cx_px", "cy_px", "k1", "k2", "k3", "k4", "k5", "k6"];
        let found = fit(&source, Model::Brown, &names).unwrap();
        assert!(found.left_out > 0, "{found:?}");
        assert!(found.rms_px < 5.0, "{found:?}");
    }
}
