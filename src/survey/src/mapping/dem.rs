//! A surface from scattered points.
//!
//! ```text
//! Z(P) = sum_i w_i(P) z_i,    sigma_Z(P)^2 = sum_i w_i(P)^2 sigma_i^2
//! ```
//!
//! `w_i` are Sibson's natural neighbour coordinates: the share of `P`'s Voronoi cell that it takes away from
//! that of point `i`. They are continuous, reproduce planes and never leave the range of the neighbours.
//! `sigma_Z` is what the points' own standard deviations leave; it does not know of relief between
//! the points.
//!
//! Where `P` lies outside the points' hull, or in a Delaunay triangle with a side longer than the largest gap,
//! there is no height. Outliers are points far off the plane through their neighbours.
//!
//! References: R. Sibson, *A brief description of natural neighbour interpolation*, 1981; the triangulation is
//! the crate `spade`.

use super::{MapError, Surface};
use crate::scene::Reconstruction;
use rayon::prelude::*;
use rowgram_optim::robust;
use rowgram_raster::georeference::Georeference;
use serde::{Deserialize, Serialize};
use spade::{
    DelaunayTriangulation, HasPosition, HierarchyHintGenerator, Point2, PositionInTriangulation,
    Triangulation,
};

/// A point of a cloud.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfacePoint {
    /// Where it is, metres.
    pub position_m: [f64; 3],
    /// Standard deviation of its height, metres; NaN where not known.
    pub sigma_z_m: f64,
}

impl SurfacePoint {
    /// The tie points of a reconstruction, with their standard deviations where an adjustment found them.
    pub fn of(reconstruction: &Reconstruction) -> Vec<SurfacePoint> {
        let known = reconstruction.accuracy.as_ref().map(|accuracy| &accuracy.points_m);
        let sigma_z_m =
            |k: usize| known.and_then(|known| known.get(k)).map_or(f64::NAN, |sigma| sigma[2]);
        let points = reconstruction.points.iter().enumerate();
        points
            .map(|(k, point)| SurfacePoint {
                position_m: point.position_m,
                sigma_z_m: sigma_z_m(k),
            })
            .collect()
    }
}

/// How a surface is made of points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CloudOptions {
    /// A point further from the plane of its neighbours than so many times the usual (robust) distance
    /// is left out; infinite: none is.
    pub outlier_ratio: f64,
    /// The longest side of a triangle that is filled, metres; `None`: [`DEFAULT_GAP_SPACINGS`] times the median side.
    pub largest_gap_m: Option<f64>,
}

impl Default for CloudOptions {
    fn default() -> CloudOptions {
        CloudOptions { outlier_ratio: 5.0, largest_gap_m: None }
    }
}

/// Longest side of a triangle that is filled, in median sides.
pub const DEFAULT_GAP_SPACINGS: f64 = 30.0;
/// Outliers are looked for at most so often: behind one there may be another.
const MAX_OUTLIER_ROUNDS: usize = 4;

/// A vertex relative to the middle of the cloud.
#[derive(Debug, Clone, Copy)]
struct Vertex {
    position: Point2<f64>,
    z: f64,
    sigma: f64,
    index: usize,
}

impl HasPosition for Vertex {
    type Scalar = f64;
    fn position(&self) -> Point2<f64> {
        self.position
    }
}

// The place from which this hint generator starts depends on nothing but the position, so the order in which
// neighbours are summed does not depend on what other threads asked before.
type Mesh = DelaunayTriangulation<Vertex, (), (), (), HierarchyHintGenerator<f64>>;

/// What became of the points.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CloudStatistics {
    /// Points given.
    pub points: usize,
    /// Points at the place of another.
    pub duplicates: usize,
    /// Indices of the points left out.
    pub outliers: Vec<usize>,
    /// Usual distance of a point from the plane of its neighbours, metres.
    pub roughness_m: f64,
    /// Median distance of neighbours, metres.
    pub spacing_m: f64,
    /// The longest side of a triangle that is filled, metres.
    pub largest_gap_m: f64,
}

/// A triangulated cloud without its outliers.
pub struct TriangulatedCloud {
    mesh: Mesh,
    origin_m: [f64; 2],
    /// What became of the points.
    pub statistics: CloudStatistics,
}

impl TriangulatedCloud {
    /// Triangulates points and leaves out what does not fit.
    ///
    /// # Errors
    /// Where there are fewer than three places, all on one line, or a number is not finite.
    pub fn new(
        points: &[SurfacePoint],
        options: &CloudOptions,
    ) -> Result<TriangulatedCloud, MapError> {
        if let Some(k) = points.iter().position(|p| p.position_m.iter().any(|x| !x.is_finite())) {
            return Err(MapError(format!("point {k} has a coordinate that is no finite number")));
        }
        let n = points.len().max(1) as f64;
        let origin_m =
            [0, 1].map(|k| (points.iter().map(|p| p.position_m[k]).sum::<f64>() / n).round());
        let mut vertices: Vec<Vertex> = points
            .iter()
            .enumerate()
            .map(|(index, p)| Vertex {
                position: Point2::new(p.position_m[0] - origin_m[0], p.position_m[1] - origin_m[1]),
                z: p.position_m[2],
                sigma: p.sigma_z_m,
                index,
            })
            .collect();
        vertices.sort_by(|a, b| {
            let (p, q) = (a.position, b.position);
            p.x.total_cmp(&q.x).then(p.y.total_cmp(&q.y)).then(a.z.total_cmp(&b.z))
        });
        vertices.dedup_by(|a, b| a.position == b.position);
        let duplicates = points.len() - vertices.len();
        let mut outliers = Vec::new();
        let mut mesh = triangulate(&vertices)?;
        let mut roughness_m = 0.0;
        for _ in 0..MAX_OUTLIER_ROUNDS {
            let residuals = residuals(&mesh);
            roughness_m = robust_sigma(&residuals);
            let limit = options.outlier_ratio * roughness_m.max(1e-6);
            let wrong: Vec<usize> = local_maxima(&mesh, &residuals, limit);
            if wrong.is_empty() {
                break;
            }
            outliers.extend(wrong.iter().map(|&k| vertices[k].index));
            let mut k = 0;
            vertices.retain(|_| {
                k += 1;
                wrong.binary_search(&(k - 1)).is_err()
            });
            mesh = triangulate(&vertices)?;
        }
        outliers.sort_unstable();
        let sides = mesh.undirected_edges().map(|edge| edge.length_2().sqrt());
        let spacing_m = robust::median(sides).unwrap_or(0.0);
        let statistics = CloudStatistics {
            points: points.len(),
            duplicates,
            outliers,
            roughness_m,
            spacing_m,
            largest_gap_m: options.largest_gap_m.unwrap_or(DEFAULT_GAP_SPACINGS * spacing_m),
        };
        Ok(TriangulatedCloud { mesh, origin_m, statistics })
    }

    /// The points that are left.
    pub fn points_m(&self) -> impl Iterator<Item = [f64; 3]> + '_ {
        self.mesh.vertices().map(|vertex| {
            let v = vertex.data();
            [v.position.x + self.origin_m[0], v.position.y + self.origin_m[1], v.z]
        })
    }

    /// Least and greatest x and y of the points, metres.
    pub fn bounds_m(&self) -> [[f64; 2]; 2] {
        let mut bounds = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
        for p in self.points_m() {
            for (k, [low, high]) in bounds.iter_mut().enumerate() {
                (*low, *high) = (low.min(p[k]), high.max(p[k]));
            }
        }
        bounds
    }

    /// Heights and their standard deviations at the centres of a grid, metres; NaN where there are none.
    pub fn grid(&self, place: &Georeference, [width, height]: [usize; 2]) -> (Vec<f32>, Vec<f32>) {
        let mut heights = vec![f32::NAN; width * height];
        let mut sigmas = vec![f32::NAN; width * height];
        heights.par_chunks_mut(width).zip(sigmas.par_chunks_mut(width)).enumerate().for_each(
            |(v, (heights, sigmas))| {
                let natural = self.mesh.natural_neighbor();
                let mut weights = Vec::new();
                for u in 0..width {
                    let at = place.map([u as f64, v as f64]);
                    let at = Point2::new(at[0] - self.origin_m[0], at[1] - self.origin_m[1]);
                    if !self.is_filled(at) {
                        continue;
                    }
                    natural.get_weights(at, &mut weights);
                    if weights.is_empty() {
                        continue;
                    }
                    let (mut z, mut variance) = (0.0, 0.0);
                    for &(vertex, weight) in &weights {
                        let vertex = self.mesh.vertex(vertex);
                        let vertex = vertex.data();
                        z += weight * vertex.z;
                        variance += (weight * vertex.sigma).powi(2);
                    }
                    heights[u] = z as f32;
                    sigmas[u] = variance.sqrt() as f32;
                }
            },
        );
        (heights, sigmas)
    }

    /// The surface on a grid.
    ///
    /// # Errors
    /// As [`Surface::new`].
    pub fn surface(
        &self,
        place: Georeference,
        size: [usize; 2],
    ) -> Result<(Surface, Vec<f32>), MapError> {
        let (heights, sigmas) = self.grid(&place, size);
        Ok((Surface::new(place, size, heights)?, sigmas))
    }

    fn is_filled(&self, at: Point2<f64>) -> bool {
        let limit = self.statistics.largest_gap_m.powi(2);
        match self.mesh.locate(at) {
            PositionInTriangulation::OnVertex(_) => true,
            PositionInTriangulation::OnEdge(edge) => {
                self.mesh.directed_edge(edge).length_2() <= limit
            }
            PositionInTriangulation::OnFace(face) => {
                let sides = self.mesh.face(face).adjacent_edges();
                sides.iter().all(|edge| edge.length_2() <= limit)
            }
            _ => false,
        }
    }
}

fn triangulate(vertices: &[Vertex]) -> Result<Mesh, MapError> {
    let mesh = Mesh::bulk_load_stable(vertices.to_vec())
        .map_err(|error| MapError(format!("the points cannot be triangulated: {error}")))?;
    if mesh.num_inner_faces() == 0 {
        return Err(MapError(format!(
            "{} points at different places that are not on one line are needed, found {}",
            3,
            vertices.len()
        )));
    }
    Ok(mesh)
}

/// How far each vertex lies above the plane of its neighbours and theirs, without itself, metres.
fn residuals(mesh: &Mesh) -> Vec<f64> {
    let of = |k: usize| {
        let vertex = mesh.vertex(spade::handles::FixedVertexHandle::from_index(k));
        let own = vertex.data();
        let mut near: Vec<usize> = Vec::with_capacity(32);
        for edge in vertex.out_edges() {
            near.push(edge.to().fix().index());
            near.extend(edge.to().out_edges().map(|next| next.to().fix().index()));
        }
        near.sort_unstable();
        near.dedup();
        let near = near.into_iter().filter(|&other| other != k).map(|other| {
            let handle = spade::handles::FixedVertexHandle::from_index(other);
            let data = *mesh.vertex(handle).data();
            [data.position.x - own.position.x, data.position.y - own.position.y, data.z - own.z]
        });
        -plane(&near.collect::<Vec<_>>())
    };
    (0..mesh.num_vertices()).into_par_iter().map(of).collect()
}

/// The height at the origin of the plane with the least sum of distances, by repeated weighting.
fn plane(points: &[[f64; 3]]) -> f64 {
    let median = |values: Vec<f64>| robust::median(values).unwrap_or(0.0);
    if points.len() < 5 {
        return median(points.iter().map(|p| p[2]).collect());
    }
    let mut weights = vec![1.0; points.len()];
    let mut level = 0.0;
    for _ in 0..8 {
        let mut normal = nalgebra::Matrix3::<f64>::zeros();
        let mut right = nalgebra::Vector3::<f64>::zeros();
        for (p, w) in points.iter().zip(&weights) {
            let row = nalgebra::Vector3::new(1.0, p[0], p[1]);
            normal += *w * row * row.transpose();
            right += *w * p[2] * row;
        }
        let Some(factor) = normal.cholesky() else {
            return median(points.iter().map(|p| p[2]).collect());
        };
        let solution = factor.solve(&right);
        level = solution[0];
        let distance =
            |p: &[f64; 3]| (p[2] - solution[0] - solution[1] * p[0] - solution[2] * p[1]).abs();
        let usual = median(points.iter().map(distance).collect()).max(1e-6);
        for (weight, p) in weights.iter_mut().zip(points) {
            *weight = 1.0 / distance(p).max(0.1 * usual);
        }
    }
    level
}

/// Robust standard deviation about zero: from the median or from the size that four of five do not exceed,
/// whichever gives more. Plants on a third of the points are no outliers of a level ground.
fn robust_sigma(residuals: &[f64]) -> f64 {
    let mut sizes: Vec<f64> = residuals.iter().map(|r| r.abs()).collect();
    sizes.sort_by(f64::total_cmp);
    let at = |share: f64| sizes[((sizes.len() - 1) as f64 * share) as usize];
    // Of a normal distribution half lies within 0.6745 and 80 % within 1.2816 standard deviations.
    (at(0.5) / 0.6745).max(at(0.8) / 1.2816)
}

/// The vertices beyond the limit that are further off than all their neighbours: beside a wild point others
/// look wrong too.
fn local_maxima(mesh: &Mesh, residuals: &[f64], limit: f64) -> Vec<usize> {
    let wrong = |k: &usize| {
        let own = residuals[*k].abs();
        own > limit
            && mesh
                .vertex(spade::handles::FixedVertexHandle::from_index(*k))
                .out_edges()
                .all(|edge| residuals[edge.to().fix().index()].abs() <= own)
    };
    (0..residuals.len()).filter(wrong).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_raster::georeference::Crs;

    /// A slope of scattered points in UTM.
    fn slope(count: usize) -> Vec<SurfacePoint> {
        (0..count)
            .map(|k| {
                let golden = 0.618_033_988_749_895 * k as f64;
                let (x, y) = (20.0 * k as f64 / count as f64, 20.0 * golden.fract());
                let position_m = [500_000.0 + x, 4_475_000.0 + y, 100.0 + 0.1 * x - 0.05 * y];
                SurfacePoint { position_m, sigma_z_m: 0.02 }
            })
            .collect()
    }

    fn grid() -> Georeference {
        Georeference::north_up([500_000.0, 4_475_020.0], 0.5, Crs::projected(32616))
    }

    #[test]
    fn planes_are_kept_and_what_is_outside_is_not_invented() {
        let cloud = TriangulatedCloud::new(&slope(400), &CloudOptions::default()).unwrap();
        let (heights, sigmas) = cloud.grid(&grid(), [60, 41]);
        let mut known = 0;
        for (k, &z) in heights.iter().enumerate() {
            let (x, y) = ((k % 60) as f64 * 0.5, 20.0 - (k / 60) as f64 * 0.5);
            if z.is_finite() {
                known += 1;
                // Heights are stored in 32 bits: 8e-6 m at 100 m.
                approx::assert_abs_diff_eq!(
                    f64::from(z),
                    100.0 + 0.1 * x - 0.05 * y,
                    epsilon = 2e-5
                );
                assert!(sigmas[k] <= 0.02 + 1e-6 && sigmas[k] > 0.004, "{}", sigmas[k]);
            }
            assert!(x < 20.1 || z.is_nan(), "{x} {y}");
        }
        assert!(known > 1400, "{known}");
    }

    #[test]
    fn wild_points_are_left_out_and_doubles_counted() {
        let mut points = slope(400);
        points[100].position_m[2] += 3.0;
        points[101].position_m[2] -= 2.0;
        points[300].position_m[2] += 1.0;
        for (k, point) in points.iter_mut().enumerate() {
            point.position_m[2] += 0.01 * ((k * 7919 % 13) as f64 - 6.0) / 6.0;
        }
        points.push(points[7]);
        let cloud = TriangulatedCloud::new(&points, &CloudOptions::default()).unwrap();
        assert_eq!(
            (cloud.statistics.outliers.as_slice(), cloud.statistics.duplicates),
            (&[100, 101, 300][..], 1)
        );
    }

    #[test]
    fn a_gap_stays_a_gap() {
        let far = |p: &SurfacePoint| {
            let (x, y) = (p.position_m[0] - 500_010.0, p.position_m[1] - 4_475_010.0);
            x.hypot(y) > 6.0
        };
        let points: Vec<SurfacePoint> = slope(900).into_iter().filter(far).collect();
        let options = CloudOptions { largest_gap_m: Some(3.0), ..CloudOptions::default() };
        let cloud = TriangulatedCloud::new(&points, &options).unwrap();
        let (heights, _) = cloud.grid(&grid(), [41, 41]);
        assert!(heights[20 * 41 + 20].is_nan() && heights[20 * 41 + 3].is_finite());
        let line: Vec<SurfacePoint> = (0..9)
            .map(|k| SurfacePoint { position_m: [f64::from(k), 0.0, 0.0], sigma_z_m: 0.1 })
            .collect();
        assert!(TriangulatedCloud::new(&line, &options).is_err());
    }
}
