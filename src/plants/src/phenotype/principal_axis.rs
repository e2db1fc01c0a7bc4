//! Middle and main axis of points in the plane: `phi = atan2(2 S_uv, S_uu - S_vv) / 2` of their second moments about the middle.

/// The mean of points; the origin where there is none.
pub(super) fn middle(points: impl Iterator<Item = [f64; 2]>) -> [f64; 2] {
    let [u, v, count] = points.fold([0.0; 3], |s, p| [s[0] + p[0], s[1] + p[1], s[2] + 1.0]);
    [u, v].map(|sum| sum / f64::max(count, 1.0))
}

/// Direction of the main axis of what is left of each group of points about its own middle, radians within a quarter turn.
pub(super) fn main_axis_rad<I: Iterator<Item = [f64; 2]> + Clone>(
    groups: impl IntoIterator<Item = I>,
) -> f64 {
    let [mut uu, mut uv, mut vv] = [0.0; 3];
    for points in groups {
        let m = middle(points.clone());
        for [u, v] in points.map(|p| [p[0] - m[0], p[1] - m[1]]) {
            (uu, uv, vv) = (uu + u * u, uv + u * v, vv + v * v);
        }
    }
    0.5 * f64::atan2(2.0 * uv, uu - vv)
}
