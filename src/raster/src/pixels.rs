//! Something done to every pixel of a photo, by all threads and with the machine's SIMD.
//!
//! The photo is cut into tasks and these into blocks, of fixed sizes, so that the work is cut in the same
//! way for any number of threads. Within a block the loops are plain loops over arrays, which the
//! compiler turns into SIMD; they are compiled once for each instruction set, and the best one that
//! the machine has is chosen when the program runs. For that everything below [`Blocks::with_simd`]
//! must be inlined into it, so these are traits and not closures.

use rayon::prelude::*;

/// Pixels of one task.
const TASK: usize = 1 << 15;

/// Pixels of one block; enough for any SIMD width.
pub(super) const BLOCK: usize = 64;

/// One channel of a block.
pub(super) type Channel = [i16; BLOCK];

/// What is done to the pixels of a block.
pub(super) trait PerBlock: Sync {
    /// To be marked `#[inline(always)]`, its loops free of branches.
    fn block(&self, red: &Channel, green: &Channel, blue: &Channel, out: &mut [u8; BLOCK]);
}

/// Writes what each pixel (three bytes) of `rgb` becomes, as far as both slices reach.
pub(super) fn map<P: PerBlock>(per_block: &P, rgb: &[u8], out: &mut [u8]) {
    let pixels = (rgb.len() / 3).min(out.len());
    let (rgb, out) = (&rgb[..3 * pixels], &mut out[..pixels]);
    out.par_chunks_mut(TASK).zip(rgb.par_chunks(3 * TASK)).for_each(|(out, rgb)| {
        pulp::Arch::new().dispatch(Blocks { per_block, rgb, out });
    });
}

/// The blocks of one task; three bytes of `rgb` for each place of `out`.
struct Blocks<'a, P: PerBlock> {
    per_block: &'a P,
    rgb: &'a [u8],
    out: &'a mut [u8],
}

impl<P: PerBlock> pulp::WithSimd for Blocks<'_, P> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let (rgb_blocks, rgb_rest) = self.rgb.as_chunks::<{ 3 * BLOCK }>();
        let (out_blocks, out_rest) = self.out.as_chunks_mut::<BLOCK>();
        for (rgb, out) in rgb_blocks.iter().zip(out_blocks) {
            map_block(self.per_block, rgb, out);
        }
        let (mut rgb, mut out) = ([0; 3 * BLOCK], [0; BLOCK]);
        rgb[..rgb_rest.len()].copy_from_slice(rgb_rest);
        map_block(self.per_block, &rgb, &mut out);
        out_rest.copy_from_slice(&out[..out_rest.len()]);
    }
}

#[inline(always)]
fn map_block<P: PerBlock>(per_block: &P, rgb: &[u8; 3 * BLOCK], out: &mut [u8; BLOCK]) {
    let (mut red, mut green, mut blue) = ([0; BLOCK], [0; BLOCK], [0; BLOCK]);
    for i in 0..BLOCK {
        red[i] = i16::from(rgb[3 * i]);
        green[i] = i16::from(rgb[3 * i + 1]);
        blue[i] = i16::from(rgb[3 * i + 2]);
    }
    per_block.block(&red, &green, &blue, out);
}
