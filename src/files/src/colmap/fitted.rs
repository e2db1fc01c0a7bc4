//! COLMAP's lens models that are none of ours: the nearest of ours stands for them, and the camera's name says how near.
//!
//! ```text
//! FOV               r = atan(2 R tan(w/2)) / w                          R: distance of the ideal image point from the axis
//! EUCM              m = X / (a sqrt(b (X^2 + Y^2) + Z^2) + (1 - a) Z)
//! DIVISION          R = r / (1 + k r^2)
//! THIN_PRISM_FISHEYE  equidistant, then radial, tangential and thin-prism terms of the angle's image
//! ```
//!
//! References: F. Devernay and O. Faugeras, *Straight lines have to be straight*, 2001; B. Khomutenko et al., *An enhanced
//! unified camera model*, 2016; A. Fitzgibbon, *Simultaneous linear estimation of multiple view geometry and lens
//! distortion*, 2001; J. Weng et al., *Camera calibration with distortion models and accuracy evaluation*, 1992.

use super::HALF_PX;
use rowgram_survey::{
    camera::{Interior, Model},
    problems::lens_fit::{Axis, fit_rays},
};

/// A lens model of COLMAP that is fitted by one of ours.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Fitted {
    Fov,
    Eucm,
    SimpleDivision,
    Division,
    ThinPrismFisheye,
}

/// A model with its name, its number in binary files where that is known, and how many parameters it has.
const ALL: [(Fitted, &str, Option<i32>, usize); 5] = [
    (Fitted::Fov, "FOV", Some(7), 5),
    (Fitted::Eucm, "EUCM", None, 6),
    (Fitted::SimpleDivision, "SIMPLE_DIVISION", None, 4),
    (Fitted::Division, "DIVISION", None, 5),
    (Fitted::ThinPrismFisheye, "THIN_PRISM_FISHEYE", Some(10), 12),
];
/// A lens that is farther from it than this stands for nothing, root mean square, pixels.
const MOST_RMS_PX: f64 = 0.5;
/// Terms of ours that are free.
const BROWN: [&str; 9] = ["f_px", "aspect", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3"];
const FISHEYE: [&str; 8] = ["f_px", "aspect", "cx_px", "cy_px", "k1", "k2", "k3", "k4"];

impl Fitted {
    pub(super) fn named(name: &str) -> Option<Fitted> {
        ALL.iter().find(|(_, other, ..)| *other == name).map(|of| of.0)
    }

    pub(super) fn numbered(number: i32) -> Option<Fitted> {
        ALL.iter().find(|(_, _, other, _)| *other == Some(number)).map(|of| of.0)
    }

    fn row(self) -> &'static (Fitted, &'static str, Option<i32>, usize) {
        // Every model is in the table, in its own place.
        &ALL[self as usize]
    }

    pub(super) fn name(self) -> &'static str {
        self.row().1
    }

    pub(super) fn count(self) -> usize {
        self.row().3
    }

    /// Principal distances along both axes, then the principal point, our pixels; and the rest.
    fn parts(self, p: &[f64]) -> ([f64; 4], &[f64]) {
        match self {
            Fitted::SimpleDivision => ([p[0], p[0], p[1] - HALF_PX, p[2] - HALF_PX], &p[3..]),
            _ => ([p[0], p[1], p[2] - HALF_PX, p[3] - HALF_PX], &p[4..]),
        }
    }

    /// The ray of a place in the image plane, `y` down, looking along `+z`; `None` where there is none.
    fn ray(self, [x, y]: [f64; 2], rest: &[f64]) -> Option<[f64; 3]> {
        let r = x.hypot(y);
        let ray = match self {
            Fitted::Fov => {
                let w = rest[0];
                let ideal = (r * w).tan() / (2.0 * (0.5 * w).tan());
                let scale = if r > 1e-12 { ideal / r } else { 1.0 };
                (r * w < std::f64::consts::FRAC_PI_2).then_some([x * scale, y * scale, 1.0])?
            }
            Fitted::Eucm => {
                let (a, b) = (rest[0], rest[1]);
                let root = 1.0 - (2.0 * a - 1.0) * b * r * r;
                let z = (1.0 - b * a * a * r * r) / (a * root.max(0.0).sqrt() + 1.0 - a);
                (root >= 0.0).then_some([x, y, z])?
            }
            Fitted::SimpleDivision | Fitted::Division => [x, y, 1.0 + rest[0] * r * r],
            Fitted::ThinPrismFisheye => {
                let [tx, ty] = undistorted([x, y], rest)?;
                let angle = tx.hypot(ty);
                let scale = if angle > 1e-12 { angle.sin() / angle } else { 1.0 };
                [tx * scale, ty * scale, angle.cos()]
            }
        };
        ray.iter().all(|v| v.is_finite()).then_some(ray)
    }

    /// The nearest lens of ours, and the root mean square of what is between, pixels.
    pub(super) fn fit(
        self,
        size_px: [u32; 2],
        parameters: &[f64],
    ) -> Result<(Interior, f64), String> {
        let ([fx, fy, cx, cy], rest) = self.parts(parameters);
        if !(fx > 0.0 && fy > 0.0) {
            return Err(format!(
                "{}: focal lengths {fx}, {fy}, expected positive ones",
                self.name()
            ));
        }
        let ray = |[u, v]: [f64; 2]| {
            let [x, y, z] = self.ray([(u - cx) / fx, (v - cy) / fy], rest)?;
            Some([x, -y, -z])
        };
        let axis = Axis { f_px: fx, aspect: fy / fx, at_px: [cx, cy] };
        let fits = [(Model::Brown, BROWN.as_slice()), (Model::Fisheye, FISHEYE.as_slice())];
        let found = fits
            .into_iter()
            .filter_map(|(model, free)| fit_rays(size_px, ray, &axis, model, free).ok())
            .filter(|fit| fit.left_out == 0)
            .min_by(|a, b| a.rms_px.total_cmp(&b.rms_px));
        match found {
            Some(fit) if fit.rms_px <= MOST_RMS_PX => Ok((fit.interior, fit.rms_px)),
            Some(fit) => Err(format!(
                "the lens model {} with these parameters is {:.1} px (rms) from the nearest that is supported",
                self.name(),
                fit.rms_px
            )),
            None => Err(format!(
                "the lens model {} with these parameters is far from all that are supported",
                self.name()
            )),
        }
    }
}

/// Takes off the terms of the thin-prism fisheye: k1, k2, p1, p2, k3, k4, sx1, sy1.
fn undistorted(at: [f64; 2], k: &[f64]) -> Option<[f64; 2]> {
    let mut t = at;
    for _ in 0..100 {
        let [x, y] = t;
        let s = x * x + y * y;
        let radial = s * (k[0] + s * (k[1] + s * (k[4] + s * k[5])));
        let dx = x * radial + 2.0 * k[2] * x * y + k[3] * (s + 2.0 * x * x) + k[6] * s;
        let dy = y * radial + 2.0 * k[3] * x * y + k[2] * (s + 2.0 * y * y) + k[7] * s;
        let next = [at[0] - dx, at[1] - dy];
        let moved = (next[0] - x).hypot(next[1] - y);
        t = next;
        if moved < 1e-13 {
            return Some(t);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_survey::camera::Lens;

    const SIZE: [u32; 2] = [1000, 750];

    #[test]
    fn lenses_are_stood_for_by_ours() {
        for (model, parameters) in [
            (Fitted::Fov, vec![798.0, 798.0, 502.4, 377.0, 0.4]),
            (Fitted::Eucm, vec![798.0, 798.0, 502.4, 377.0, 0.02, 1.0]),
            (Fitted::Eucm, vec![600.0, 601.0, 502.4, 377.0, 0.6, 1.1]),
            (Fitted::SimpleDivision, vec![798.0, 502.4, 377.0, -0.05]),
            (Fitted::Division, vec![798.0, 799.0, 502.4, 377.0, 0.03]),
            (
                Fitted::ThinPrismFisheye,
                vec![798.0, 798.0, 502.4, 377.0, -0.01, 0.002, 1e-5, -2e-5, 0.0, 0.0, 1e-5, 2e-5],
            ),
        ] {
            let (lens, rms_px) = model.fit(SIZE, &parameters).unwrap();
            assert!(rms_px < 0.1, "{}: {rms_px}", model.name());
            // A ray goes where COLMAP's model has it.
            let ([fx, fy, cx, cy], rest) = model.parts(&parameters);
            for at in [[100.0, 80.0], [502.0, 376.0], [900.0, 700.0]] {
                let [x, y, z] = model.ray([(at[0] - cx) / fx, (at[1] - cy) / fy], rest).unwrap();
                let found = lens.project([x, -y, -z]).unwrap();
                let off = (found[0] - at[0]).hypot(found[1] - at[1]);
                assert!(off < 0.3, "{}: {off}", model.name());
            }
        }
    }

    #[test]
    fn a_lens_without_a_likeness_is_refused() {
        // Its corners have no ray.
        let error = Fitted::Fov.fit(SIZE, &[400.0, 400.0, 500.0, 375.0, 1.2]).unwrap_err();
        assert!(error.contains("FOV"), "{error}");
        assert!(Fitted::Eucm.fit(SIZE, &[-1.0; 6]).unwrap_err().contains("focal"));
        for (k, (model, ..)) in ALL.iter().enumerate() {
            assert_eq!(*model as usize, k);
        }
    }
}
