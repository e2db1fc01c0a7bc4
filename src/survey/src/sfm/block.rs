//! A block under way: which images have a pose, which tracks a point, which of their positions
//! belong to it; and the adjustment of all of it or a part.

use super::{
    relative::{self, RelativePose},
    resection::Correspondence2d3d,
    tracks::Tracks,
    triangulate::{TriangulationOptions, View, error_px, triangulate, widest_angle_rad},
};
use crate::{
    camera::{Camera, Interior, Lens},
    scene::{Image, Observation, Pose, Reconstruction, RollingShutter, TiePoint},
};
use rayon::prelude::*;
use rowgram_optim::robust::sigma_of_distances;

/// What is found in one image.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Features {
    /// The image's name.
    pub name: String,
    /// Index of its camera.
    pub camera: usize,
    /// Where its features are, pixels.
    pub positions_px: Vec<[f64; 2]>,
    /// Their colours, red, green, blue.
    pub colours: Vec<[u8; 3]>,
}

/// Two images that see the same.
#[derive(Debug, Clone, PartialEq)]
pub struct Pair {
    /// Indices of the images.
    pub images: [u32; 2],
    /// Which features match, `[in the first, in the second]`.
    pub matches: Vec<[u32; 2]>,
    /// How the second camera stands to the first.
    pub pose: RelativePose,
    /// Which solver found it.
    pub solver: relative::Solver,
    /// Mean angle at which the rays of the matches meet, radians.
    pub angle_rad: f64,
}

/// A block under way. A world unit is whatever the start made it.
#[derive(Debug, Clone)]
pub struct Block<'a> {
    /// What was found in the images.
    pub features: &'a [Features],
    /// What belongs together.
    pub tracks: &'a Tracks,
    /// The cameras as far as they are known.
    pub cameras: Vec<Camera>,
    /// The pose of each image.
    pub poses: Vec<Option<Pose>>,
    /// The point of each track.
    pub points: Vec<Option<[f64; 3]>>,
    /// For each member of a track whether it belongs to its point.
    pub used: Vec<bool>,
    /// How each image moves while it is read, as in [`Image::motion`]; nothing but with a shutter.
    pub motions: Vec<[f64; 6]>,
    /// What is expected of that, as in [`Image::expected_motion`].
    pub expected_motions: Vec<[f64; 6]>,
    /// The shutter, where it rolls.
    pub shutter: Option<RollingShutter>,
}

impl<'a> Block<'a> {
    /// A block of which nothing is known yet but its cameras; what is known of these stays about the values that
    /// they come with, however often the block is adjusted.
    pub fn new(features: &'a [Features], tracks: &'a Tracks, cameras: &[Camera]) -> Block<'a> {
        let mut cameras = cameras.to_vec();
        for camera in &mut cameras {
            camera.expected.get_or_insert_with(|| camera.interior.values().to_vec());
        }
        Block {
            features,
            tracks,
            cameras,
            poses: vec![None; features.len()],
            points: vec![None; tracks.count()],
            used: vec![false; tracks.member_count()],
            motions: vec![[0.0; 6]; features.len()],
            expected_motions: vec![[0.0; 6]; features.len()],
            shutter: None,
        }
    }

    /// The block over other tracks; none of them has a point yet.
    pub fn over<'b>(&self, features: &'b [Features], tracks: &'b Tracks) -> Block<'b> {
        Block {
            poses: self.poses.clone(),
            motions: self.motions.clone(),
            expected_motions: self.expected_motions.clone(),
            shutter: self.shutter,
            ..Block::new(features, tracks, &self.cameras)
        }
    }

    /// The lens of an image.
    pub fn lens(&self, image: usize) -> &Interior {
        &self.cameras[self.features[image].camera].interior
    }

    /// The pose of an image while it read a row.
    pub fn pose_at(&self, image: usize, v_px: f64) -> Option<Pose> {
        let pose = (*self.poses.get(image)?)?;
        if self.shutter.is_none() {
            return Some(pose);
        }
        let height = f64::from(self.lens(image).size_px()[1]);
        let share = (v_px - 0.5 * (height - 1.0)) / height;
        Some(pose.moved(self.motions[image].map(|v| v * share)))
    }

    /// The ray of a position in an image that has a pose.
    pub(super) fn view(&self, image: u32, image_px: [f64; 2]) -> Option<View<'_>> {
        let image = image as usize;
        Some(View { pose: self.pose_at(image, image_px[1])?, lens: self.lens(image), image_px })
    }

    /// The names of the images that have a pose.
    pub fn image_names(&self) -> Vec<String> {
        let of = self.poses.iter().zip(self.features).filter(|(pose, _)| pose.is_some());
        of.map(|(_, image)| image.name.clone()).collect()
    }

    /// The robust standard deviation of an image coordinate, pixels. Most points are seen twice or three times, and
    /// residuals are shorter than errors by the root of the redundancy's share.
    pub fn robust_sigma_px(&self) -> f64 {
        let mut errors = Vec::new();
        let unknowns = 3 * self.points.iter().flatten().count() + 6 * self.registered();
        for (track, point) in self.points.iter().enumerate() {
            let Some(point) = *point else { continue };
            for index in self.tracks.places(track).filter(|&index| self.used[index]) {
                let image = self.tracks.member(index).image as usize;
                let at = self.position_px(index);
                let projected = self
                    .pose_at(image, at[1])
                    .and_then(|pose| self.lens(image).project(pose.to_camera(point)));
                errors.extend(projected.map(|[u, v]| (u - at[0]).hypot(v - at[1])));
            }
        }
        let share = 1.0 - unknowns as f64 / (2 * errors.len().max(1)) as f64;
        sigma_of_distances(errors).unwrap_or(1.0) / share.max(0.1).sqrt()
    }

    /// How many images have a pose.
    pub fn registered(&self) -> usize {
        self.poses.iter().flatten().count()
    }

    /// Where a member of a track is in its image, pixels.
    pub fn position_px(&self, place: usize) -> [f64; 2] {
        let member = self.tracks.member(place);
        self.features[member.image as usize].positions_px[member.feature as usize]
    }

    /// What an image sees of the points that are known.
    pub fn sights(&self, image: usize) -> Vec<Correspondence2d3d> {
        let lens = self.lens(image);
        self.tracks
            .in_image(image)
            .iter()
            .filter_map(|&(track, place)| {
                let point = self.points[track as usize]?;
                let image_px = self.position_px(place as usize);
                Some(Correspondence2d3d { point, image_px, ray: lens.unproject(image_px)? })
            })
            .collect()
    }

    /// How many known points an image sees.
    pub fn sight_count(&self, image: usize) -> usize {
        let seen = self.tracks.in_image(image).iter();
        seen.filter(|(track, _)| self.points[*track as usize].is_some()).count()
    }

    /// How many images with a pose see the point of a track.
    pub(super) fn rays(&self, track: usize) -> usize {
        let seen = |place: &usize| {
            self.used[*place] && self.poses[self.tracks.member(*place).image as usize].is_some()
        };
        self.tracks.places(track).filter(seen).count()
    }

    fn views(&self, track: usize, only_used: bool) -> (Vec<usize>, Vec<View<'_>>) {
        let mut places = Vec::new();
        let mut views = Vec::new();
        for place in self.tracks.places(track) {
            let view = self.view(self.tracks.member(place).image, self.position_px(place));
            if let (Some(view), true) = (view, !only_used || self.used[place]) {
                places.push(place);
                views.push(view);
            }
        }
        (places, views)
    }

    /// Goes through tracks: rays that have come too far from their point leave it, others that fit
    /// join it, and tracks without a point get one where their rays meet. Returns how many points
    /// there are among them afterwards.
    pub fn retriangulate(&mut self, tracks: &[u32], demands: &TriangulationOptions) -> usize {
        let found: Vec<(Option<[f64; 3]>, Vec<usize>)> = tracks
            .par_iter()
            .map(|&track| self.triangulate_track(track as usize, demands))
            .collect();
        let mut count = 0;
        for (&track, (point, places)) in tracks.iter().zip(found) {
            let track = track as usize;
            self.used[self.tracks.places(track)].fill(false);
            places.iter().for_each(|&place| self.used[place] = true);
            count += usize::from(point.is_some());
            self.points[track] = point;
        }
        count
    }

    /// All tracks, for [`Block::retriangulate`].
    pub fn all_tracks(&self) -> Vec<u32> {
        (0..self.tracks.count() as u32).collect()
    }

    /// The tracks that some images see.
    pub fn tracks_of(&self, images: &[usize]) -> Vec<u32> {
        let mut tracks: Vec<u32> = images
            .iter()
            .flat_map(|&image| self.tracks.in_image(image).iter().map(|(track, _)| *track))
            .collect();
        tracks.sort_unstable();
        tracks.dedup();
        tracks
    }

    fn triangulate_track(
        &self,
        track: usize,
        demands: &TriangulationOptions,
    ) -> (Option<[f64; 3]>, Vec<usize>) {
        let (places, views) = self.views(track, false);
        if let Some(point) = self.points[track] {
            let keep: Vec<usize> = (0..views.len())
                .filter(|&k| error_px(&views[k], point).is_some_and(|e| e <= demands.tolerance_px))
                .collect();
            let centres: Vec<[f64; 3]> = keep.iter().map(|&k| views[k].pose.centre_m()).collect();
            let wide = widest_angle_rad(&centres, point) >= 0.7 * demands.min_angle_rad;
            if keep.len() >= 2 && 2 * keep.len() >= views.len() && wide {
                return (Some(point), keep.into_iter().map(|k| places[k]).collect());
            }
        }
        match triangulate(&views, demands) {
            Some((point, fits)) => {
                let of = places.iter().zip(fits).filter(|(_, fits)| *fits);
                (Some(point), of.map(|(place, _)| *place).collect())
            }
            None => (None, Vec::new()),
        }
    }

    /// Root mean square distance between measured and projected positions, pixels, and how many.
    pub fn rms_px(&self) -> (f64, usize) {
        let (mut sum, mut count) = (0.0, 0);
        for track in 0..self.tracks.count() {
            let Some(point) = self.points[track] else { continue };
            for view in self.views(track, true).1 {
                if let Some(error) = error_px(&view, point) {
                    sum += error * error;
                    count += 1;
                }
            }
        }
        ((sum / f64::from(count.max(1) as u32)).sqrt(), count)
    }

    /// The block, or the part that some images see, as a survey, with the track of each of its
    /// points and the index of each of its images. Images that take part only because they see the
    /// same points come after those that were asked for.
    pub fn reconstruction(
        &self,
        images: Option<&[usize]>,
    ) -> (Reconstruction, Vec<u32>, Vec<usize>) {
        let asked: Vec<usize> = match images {
            Some(images) => images.to_vec(),
            None => (0..self.poses.len()).collect(),
        };
        let asked: Vec<usize> =
            asked.into_iter().filter(|&image| self.poses[image].is_some()).collect();
        let tracks: Vec<u32> = self
            .tracks_of(&asked)
            .into_iter()
            .filter(|&track| self.points[track as usize].is_some())
            .filter(|&track| self.rays(track as usize) >= 2)
            .collect();
        let mut order = asked.clone();
        let mut place = vec![u32::MAX; self.poses.len()];
        asked.iter().enumerate().for_each(|(k, &image)| place[image] = k as u32);
        let mut survey = Reconstruction {
            cameras: self.cameras.clone(),
            tie_sigma_px: 1.0,
            rolling_shutter: self.shutter,
            ..Reconstruction::default()
        };
        for &track in &tracks {
            let Some(position_m) = self.points[track as usize] else { continue };
            let point = survey.points.len() as u32;
            let mut colour = [[0u32; 3]; 1];
            let mut count = 0;
            for at in self.tracks.places(track as usize) {
                let member = self.tracks.member(at);
                let image = member.image as usize;
                if !self.used[at] || self.poses[image].is_none() {
                    continue;
                }
                if place[image] == u32::MAX {
                    place[image] = order.len() as u32;
                    order.push(image);
                }
                if let Some(seen) = self.features[image].colours.get(member.feature as usize) {
                    (0..3).for_each(|k| colour[0][k] += u32::from(seen[k]));
                    count += 1;
                }
                let image_px = self.position_px(at);
                survey.observations.push(Observation { image: place[image], point, image_px });
            }
            let colour = colour[0].map(|sum| (sum / count.max(1)) as u8);
            survey.points.push(TiePoint { id: u64::from(track) + 1, position_m, colour });
        }
        for &image in &order {
            if let Some(pose) = self.poses[image] {
                survey.images.push(Image {
                    name: self.features[image].name.clone(),
                    id: image as u32 + 1,
                    camera: self.features[image].camera,
                    pose,
                    motion: self.motions[image],
                    expected_motion: self.expected_motions[image],
                });
            }
        }
        (survey, tracks, order)
    }

    /// Takes an image out again.
    pub fn forget(&mut self, image: usize) {
        self.poses[image] = None;
        for &(_, place) in self.tracks.in_image(image) {
            self.used[place as usize] = false;
        }
    }
}
