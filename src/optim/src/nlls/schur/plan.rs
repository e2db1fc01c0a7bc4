//! The plan of the fused path: observations sorted by point, cameras counted, chunks laid out.

use super::{
    FusionRequest,
    lanes::CameraCache,
    layout::{
        Camera, ChunkSums, Layout, MAX_CAMERA_RECORD, MAX_RECORD, MAX_RETAINED, MAX_SHARED, PointAt,
    },
    prior::Priors,
    product::whole,
};
use crate::nlls::{
    problem::Problem,
    projection::{Measurement, SizedFactor},
    structure::{NONE, Structure},
};
use rayon::prelude::*;
use std::marker::PhantomData;

/// A batch of pairs, ready to be reduced.
pub(super) struct FusedPlan<
    F,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
> {
    pub(super) layout: Layout<K, S, D>,
    pub(super) chunks: Vec<ChunkSums<P>>,
    /// What the factor prepares of each camera, `Q` numbers; then the steps of the camera and of its
    /// shared block.
    pub(super) prepared: CameraCache,
    /// What it prepares at the trial values.
    pub(super) trial_prepared: CameraCache,
    pub(super) priors: Priors<P>,
    /// A vector over the cameras, for products with the reduced system.
    pub(super) directions: Vec<f64>,
    factor: PhantomData<F>,
}

impl<
    F,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
> std::fmt::Debug for FusedPlan<F, R, K, S, P, Q, D>
{
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "FusedPlan({} observations)", self.layout.data.len())
    }
}

impl<
    F: SizedFactor<R, K, S, P, Q, D>,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
> FusedPlan<F, R, K, S, P, Q, D>
{
    /// The plan, or why the batch does not have the shape for it.
    pub(super) fn new(
        pairs: &[Measurement<D>],
        request: FusionRequest<'_>,
    ) -> Result<Self, String> {
        let FusionRequest { problem, structure, matrix, batch, implicit } = request;
        if K > MAX_RETAINED || R * (P + 1) > MAX_RECORD || Q + K + S > MAX_CAMERA_RECORD {
            return Err(format!(
                "blocks of {K} and {P} degrees of freedom with {Q} prepared numbers are too large"
            ));
        }
        let values = problem.offsets.last().copied().unwrap_or(0);
        if u32::try_from(pairs.len().max(values)).is_err() {
            return Err("there are more than 2^32 values or observations".into());
        }
        if structure.camera_only_factors.iter().any(|&(other, _)| other as usize == batch) {
            return Err("some of its factors depend on no eliminated block".into());
        }
        let (points, priors) = find_points(problem, structure, batch)?;
        let (cameras, shared_blocks) = find_cameras::<D, S>(pairs, structure)?;
        let mut ordinal = vec![NONE; problem.blocks.len()];
        for (k, camera) in cameras.iter().enumerate() {
            ordinal[camera.block as usize] = k as u32;
        }
        let (observed_by, data) = collect(pairs, structure, batch, &points, &ordinal);
        let free = |block: usize, k: usize| problem.blocks[block].frozen >> k & 1 == 0;
        let mask = |block: usize, k: usize| f64::from(u8::from(free(block, k)));
        let held = cameras.iter().any(|c| (0..K).any(|k| !free(c.block as usize, k)));
        let moves = |block: usize| structure.retained_index[block] != NONE;
        let lens_columns: Vec<usize> = (0..S)
            .filter(|&k| shared_blocks.iter().any(|&block| moves(block) && free(block, k)))
            .collect();
        let differ = lens_columns.iter().any(|&k| shared_blocks.iter().any(|&b| !free(b, k)));
        if implicit && !lens_columns.is_empty() {
            return Err("a block is shared by cameras".into());
        }
        let layout = Layout {
            camera_mask: (0..if held { cameras.len() } else { 0 })
                .map(|c| std::array::from_fn(|k| mask(cameras[c].block as usize, k)))
                .collect(),
            lens_mask: (0..if differ { shared_blocks.len() } else { 0 })
                .map(|l| {
                    let mut masks = [0.0; S];
                    for (to, &k) in masks.iter_mut().zip(&lens_columns) {
                        *to = mask(shared_blocks[l], k);
                    }
                    masks
                })
                .collect(),
            lens_columns,
            shared: shared_blocks.iter().map(|&block| structure.retained_index[block]).collect(),
            points,
            tangents: structure.retained.iter().map(|&k| problem.blocks[k].tangent).collect(),
            observed_by,
            data,
            cameras,
        };
        let sights = find_sights::<P>(problem, structure)?;
        let mut chunks = structure
            .chunks
            .par_iter()
            .map(|chunk| ChunkSums::new(chunk, &layout, matrix, R, implicit))
            .collect::<Option<Vec<_>>>()
            .ok_or("the reduced system lacks one of its blocks")?;
        if !sights.is_empty() {
            for chunk in &mut chunks {
                chunk.sights = sights[chunk.range.clone()].to_vec();
            }
        }
        let count = layout.cameras.len();
        Ok(FusedPlan {
            chunks,
            priors,
            prepared: CameraCache::new(count, Q + K + S),
            trial_prepared: CameraCache::new(count, Q),
            directions: vec![0.0; if implicit { count * whole(K) } else { 0 }],
            factor: PhantomData,
            layout,
        })
    }

    pub(super) fn prepare(&mut self, problem: &Problem, x: &[f64]) {
        prepare_cameras::<F, R, K, S, P, Q, D>(&self.layout, problem, x, &mut self.prepared);
    }

    pub(super) fn prepare_trial(&mut self, problem: &Problem, x: &[f64]) {
        prepare_cameras::<F, R, K, S, P, Q, D>(&self.layout, problem, x, &mut self.trial_prepared);
    }

    /// Takes the retained blocks' steps, zero for those that are fixed.
    pub(super) fn prepare_steps(&mut self, problem: &Problem, step: &[f64]) {
        for (camera, record) in self.layout.cameras.iter().zip(self.prepared.each()) {
            let (retained, shared) = record[Q..Q + K + S].split_at_mut(K);
            retained.fill(0.0);
            shared.fill(0.0);
            if camera.place != NONE {
                let at = problem.blocks[camera.block as usize].tangent;
                retained.copy_from_slice(&step[at..at + K]);
            }
            if S > 0 && self.layout.shared[camera.lens as usize] != NONE {
                let at = problem.blocks[camera.shared as usize].tangent;
                shared.copy_from_slice(&step[at..at + S]);
            }
        }
    }
}

fn prepare_cameras<
    F: SizedFactor<R, K, S, P, Q, D>,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
>(
    layout: &Layout<K, S, D>,
    problem: &Problem,
    x: &[f64],
    out: &mut CameraCache,
) {
    let point = problem.all_values(x);
    for (camera, out) in layout.cameras.iter().zip(out.each()) {
        let retained = point.block(Problem::id(camera.block as usize));
        let shared =
            if S == 0 { &[][..] } else { point.block(Problem::id(camera.shared as usize)) };
        out[..Q].copy_from_slice(&F::prepare(retained, shared));
    }
}

/// The eliminated blocks with the numbers of their observations, and their priors; an error where one is not a
/// vector, or a factor of another batch joins it with a retained block: that sum would be missing.
fn find_points<const P: usize>(
    problem: &Problem,
    structure: &Structure,
    batch: usize,
) -> Result<(Vec<PointAt>, Priors<P>), String> {
    let mut points = Vec::with_capacity(structure.eliminated.len() + 1);
    let mut priors = Priors::default();
    let mut first = 0;
    for (e, &block) in structure.eliminated.iter().enumerate() {
        let id = Problem::id(block);
        if !problem.manifold(id).is_euclidean() {
            return Err(format!("{} is eliminated and not Euclidean", problem.describe(id)));
        }
        let mut point = PointAt {
            at: problem.offsets[block] as u32,
            first,
            block: block as u32,
            frozen: problem.blocks[block].frozen as u32,
            prior: NONE,
        };
        for &(b, f) in structure.factors(e) {
            if b as usize == batch {
                first += 1;
                continue;
            }
            let named = &problem.batches[b as usize];
            let blocks = named.batch.blocks(f as usize);
            if blocks.iter().any(|other| structure.retained_index[other.index()] != NONE) {
                return Err(format!(
                    "{} is eliminated, and batch {:?} joins it with another block as well; do not eliminate it",
                    problem.describe(id),
                    named.name
                ));
            }
            let own = blocks.iter().position(|other| *other == id).unwrap_or(0);
            let column = named.dims[..own].iter().sum();
            priors.push((b, f), column, point.prior == NONE);
            point.prior = priors.sums.len() as u32 - 1;
        }
        points.push(point);
    }
    points.push(PointAt { at: 0, first, block: NONE, frozen: 0, prior: NONE });
    Ok((points, priors))
}

/// Where each eliminated block is seen from; nothing where none is known, an error where some are.
fn find_sights<const P: usize>(
    problem: &Problem,
    structure: &Structure,
) -> Result<Vec<[f64; P]>, String> {
    let mut sights = Vec::new();
    for &block in &structure.eliminated {
        if let Some(from) = problem.sight(block) {
            let mut own = [0.0; P];
            own.iter_mut().zip(from).for_each(|(to, from)| *to = *from);
            sights.push(own);
        }
    }
    if sights.is_empty() || sights.len() == structure.eliminated.len() {
        Ok(sights)
    } else {
        Err("of some eliminated blocks it is not known where they are seen from".into())
    }
}

/// Camera and data of each observation, those of one point in the order of their cameras.
fn collect<const D: usize>(
    pairs: &[Measurement<D>],
    structure: &Structure,
    batch: usize,
    points: &[PointAt],
    ordinal: &[u32],
) -> (Vec<u32>, Vec<[f64; D]>) {
    let total = points.last().map_or(0, |end| end.first as usize);
    let (mut observed_by, mut data) = (vec![0; total], vec![[0.0; D]; total]);
    let (mut cameras_left, mut data_left) = (&mut observed_by[..], &mut data[..]);
    let mut parts = Vec::with_capacity(structure.chunks.len());
    for chunk in &structure.chunks {
        let ends = (points[chunk.eliminated.start].first, points[chunk.eliminated.end].first);
        let count = (ends.1 - ends.0) as usize;
        let cameras = cameras_left.split_off_mut(..count).unwrap_or_default();
        let data = data_left.split_off_mut(..count).unwrap_or_default();
        parts.push((chunk.eliminated.clone(), cameras, data));
    }
    parts.into_par_iter().with_max_len(1).for_each(|(range, cameras, data)| {
        let (mut one, mut at) = (Vec::new(), 0);
        for e in range {
            one.clear();
            for &(_, f) in structure.factors(e).iter().filter(|(b, _)| *b as usize == batch) {
                one.push((ordinal[pairs[f as usize].retained().index()], f));
            }
            one.sort_unstable();
            for &(camera, f) in &one {
                cameras[at] = camera;
                data[at] = pairs[f as usize].data;
                at += 1;
            }
        }
    });
    (observed_by, data)
}

/// The retained blocks of the batch and the shared ones; an error where one retained block goes with several
/// shared ones, or there are too many of those.
fn find_cameras<const D: usize, const S: usize>(
    pairs: &[Measurement<D>],
    structure: &Structure,
) -> Result<(Vec<Camera>, Vec<usize>), String> {
    let mut ordinal = vec![NONE; structure.retained_index.len()];
    let mut cameras: Vec<Camera> = Vec::new();
    let mut shared: Vec<usize> = Vec::new();
    for pair in pairs {
        let block = pair.retained().index();
        let lens_block = if S == 0 { 0 } else { pair.shared().index() };
        if ordinal[block] == NONE {
            let lens = match shared.iter().position(|&other| other == lens_block) {
                _ if S == 0 => 0,
                Some(lens) => lens,
                None if shared.len() == MAX_SHARED => {
                    return Err(format!("more than {MAX_SHARED} blocks are shared by cameras"));
                }
                None => {
                    shared.push(lens_block);
                    shared.len() - 1
                }
            };
            ordinal[block] = cameras.len() as u32;
            cameras.push(Camera {
                block: block as u32,
                shared: lens_block as u32,
                place: structure.retained_index[block],
                lens: lens as u32,
            });
        } else if S > 0 && cameras[ordinal[block] as usize].shared as usize != lens_block {
            return Err("one camera has several shared blocks".into());
        }
    }
    // In the order of the reduced system, fixed ones last.
    cameras.sort_by_key(|camera| camera.place);
    Ok((cameras, shared))
}
