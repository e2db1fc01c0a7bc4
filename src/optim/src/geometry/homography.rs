//! The projective map of a plane, `s (u, v, 1)^T = H (x, y, 1)^T`, from four or more points.

use nalgebra::{Matrix3, SMatrix, SymmetricEigen};

/// `H` with `|H| = 1` from pairs of plane points and their images, by the linear method with both
/// sides normalised; `None` where there are fewer than four pairs or they lie on a line.
///
/// Reference: R. Hartley, *In defense of the eight-point algorithm*, PAMI 19(6), 1997.
pub fn homography(pairs: &[([f64; 2], [f64; 2])]) -> Option<Matrix3<f64>> {
    if pairs.len() < 4 {
        return None;
    }
    let plane = normalisation(pairs.iter().map(|pair| pair.0))?;
    let image = normalisation(pairs.iter().map(|pair| pair.1))?;
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for (from, to) in pairs {
        let [x, y] = apply(&plane, *from);
        let [u, v] = apply(&image, *to);
        let rows = [
            [x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y, -u],
            [0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y, -v],
        ];
        for row in rows {
            for i in 0..9 {
                for j in 0..9 {
                    normal[(i, j)] += row[i] * row[j];
                }
            }
        }
    }
    let eigen = SymmetricEigen::new(normal);
    let mut order: Vec<usize> = (0..9).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    // A second vanishing eigenvalue: the points do not determine it.
    if eigen.eigenvalues[order[1]] <= 1e-10 * eigen.eigenvalues[order[8]] {
        return None;
    }
    let h = eigen.eigenvectors.column(order[0]);
    let h = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], h[8]);
    let found = image.try_inverse()? * h * plane;
    let norm = found.norm();
    (norm.is_finite() && norm > 0.0).then(|| found / norm)
}

/// Where a map takes a point of the plane.
pub fn apply(h: &Matrix3<f64>, [x, y]: [f64; 2]) -> [f64; 2] {
    let p = h * nalgebra::Vector3::new(x, y, 1.0);
    [p[0] / p[2], p[1] / p[2]]
}

/// Takes points to mean 0 and mean squared distance 2.
fn normalisation(points: impl Iterator<Item = [f64; 2]> + Clone) -> Option<Matrix3<f64>> {
    let count = points.clone().count() as f64;
    let (mut u, mut v) = (0.0, 0.0);
    for p in points.clone() {
        u += p[0] / count;
        v += p[1] / count;
    }
    let square: f64 = points.map(|p| (p[0] - u).powi(2) + (p[1] - v).powi(2)).sum::<f64>() / count;
    let scale = (2.0 / square).sqrt();
    scale
        .is_finite()
        .then(|| Matrix3::new(scale, 0.0, -scale * u, 0.0, scale, -scale * v, 0.0, 0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_found_from_its_points() {
        let truth = Matrix3::new(900.0, 40.0, 320.0, -30.0, 870.0, 250.0, 0.2, -0.1, 1.0);
        let plane = [[0.0, 0.0], [0.3, 0.01], [0.31, 0.2], [-0.01, 0.22], [0.15, 0.1]];
        let pairs: Vec<_> = plane.iter().map(|&p| (p, apply(&truth, p))).collect();
        let found = homography(&pairs).unwrap();
        for p in [[0.05, 0.17], [0.4, -0.2]] {
            let (a, b) = (apply(&truth, p), apply(&found, p));
            assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 1e-7, "{a:?} {b:?}");
        }
    }

    #[test]
    fn points_on_a_line_give_none() {
        let pairs: Vec<_> = (0..6)
            .map(|k| f64::from(k) * 0.1)
            .map(|x| ([x, 2.0 * x], [10.0 * x + 3.0, 4.0 * x - 1.0]))
            .collect();
        assert!(homography(&pairs).is_none());
        assert!(homography(&pairs[..3]).is_none());
    }
}
