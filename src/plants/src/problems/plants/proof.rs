//! Certificates: every plant against the exact optimum of its convex inner problem.

use super::{Field, LeafDensity as _, PlantPrior, PlantUpdate, Plants};
use rowgram_optim::{convex, engine::SolveError};
use serde::{Deserialize, Serialize};
use std::fmt;

/// How far the plants are from the optima of their inner problems, by an interior-point method that
/// shares no code with the descent.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Proof {
    /// Plants that have pixels, all of which were certified.
    pub plants: usize,
    /// Largest cost of a plant above the lower bound, as a share of that cost.
    pub worst_gap: f64,
    /// Farthest that a plant is from the certified optimum, in pixels.
    pub worst_offset_px: f64,
}

impl fmt::Display for Proof {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} plants certified: at most {:.1e} of its cost above the bound, {:.3} px from the optimum",
            self.plants, self.worst_gap, self.worst_offset_px
        )
    }
}

impl<P: PlantPrior> Plants<P> {
    /// Certifies the place of one plant for the pixels it has: the convex optimum, as an offset
    /// from where the plant is.
    ///
    /// # Errors
    /// As [`convex::plant`]; also for the mean update, which needs no certificate.
    pub fn certify(
        &self,
        x: &mut Field<P::Latent>,
        plant: usize,
    ) -> Result<convex::Certificate, SolveError> {
        if self.density == PlantUpdate::Mean || plant >= self.plants {
            return Err(SolveError::Misuse("only a plant placed by medians is certified".into()));
        }
        self.gather(x, plant);
        let prior = self.prior_of(x, plant);
        convex::plant(&x.work.u, &x.work.v, self.weight(x), prior.hessian, prior.pull)
    }

    /// Certifies every plant that has pixels ([`Plants::certify`]).
    ///
    /// # Errors
    /// As [`Plants::certify`].
    pub fn prove(&self, x: &mut Field<P::Latent>) -> Result<Proof, SolveError> {
        let mut proof = Proof::default();
        for plant in 0..self.plants {
            self.gather(x, plant);
            if x.work.u.is_empty() {
                continue;
            }
            let here = self.density.cost_at(&self.held(x, plant), [0.0; 2]);
            let certificate = self.certify(x, plant)?;
            let [u, v] = certificate.offset_px;
            proof.plants += 1;
            proof.worst_gap = proof.worst_gap.max((here - certificate.dual) / here.abs().max(1.0));
            proof.worst_offset_px = proof.worst_offset_px.max(u.hypot(v));
        }
        Ok(proof)
    }
}
