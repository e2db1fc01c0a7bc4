//! The cost volume of a block of the dense surface: a cost for every pixel and layer of heights, laid out for SIMD over the columns of a row.

/// Columns that are computed together: one register of AVX2.
pub(super) const LANES: usize = 32;

/// One byte for every pixel and layer: row by row, of each row 32 columns after the other, of these the layers.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CostVolume {
    values: Vec<[u8; LANES]>,
    width: usize,
    height: usize,
    layers: usize,
    /// Layers with one that is not used where their number is even: what is as far apart as a large power of two shares few places of a cache.
    pitch: usize,
    chunks: usize,
}

impl CostVolume {
    /// All 0.
    pub fn new(size: [usize; 2], layers: usize) -> CostVolume {
        let mut volume = CostVolume::default();
        volume.begin(size, layers);
        volume
    }

    /// All 0 again, of another size, in the same memory where there is enough.
    pub(super) fn begin(&mut self, [width, height]: [usize; 2], layers: usize) {
        let (chunks, pitch) = (width.div_ceil(LANES), layers | 1);
        let mut values = std::mem::take(&mut self.values);
        values.clear();
        values.resize(chunks * height * pitch, [0; LANES]);
        *self = CostVolume { values, width, height, layers, pitch, chunks };
    }

    /// Columns and rows.
    pub fn size(&self) -> [usize; 2] {
        [self.width, self.height]
    }

    /// Number of layers.
    pub fn layers(&self) -> usize {
        self.layers
    }

    /// How often 32 columns go into a row, the last time in part.
    pub(super) fn chunks(&self) -> usize {
        self.chunks
    }

    /// The layers of 32 columns.
    #[inline(always)]
    pub(super) fn chunk(&self, row: usize, chunk: usize) -> &[[u8; LANES]] {
        &self.values[(row * self.chunks + chunk) * self.pitch..][..self.layers]
    }

    /// The layers of 32 columns.
    #[inline(always)]
    pub(super) fn chunk_mut(&mut self, row: usize, chunk: usize) -> &mut [[u8; LANES]] {
        &mut self.values[(row * self.chunks + chunk) * self.pitch..][..self.layers]
    }

    /// A pixel and layer.
    #[inline(always)]
    pub fn at(&self, [column, row]: [usize; 2], layer: usize) -> u8 {
        self.chunk(row, column / LANES)[layer][column % LANES]
    }

    /// A pixel and layer.
    #[inline(always)]
    pub fn at_mut(&mut self, [column, row]: [usize; 2], layer: usize) -> &mut u8 {
        &mut self.chunk_mut(row, column / LANES)[layer][column % LANES]
    }
}

/// Transposes eight by eight bytes in four places: `rows[r]` has bytes `8 k + c` before and `8 k + r` of row `c` afterwards. Swaps of halves, in
/// numbers of eight bytes, which are as fast in any SIMD.
#[inline(always)]
pub(super) fn transpose_8x8(rows: &mut [[u64; 4]; 8]) {
    #[inline(always)]
    fn swap<const SHIFT: u32, const MASK: u64>(rows: &mut [[u64; 4]; 8], low: usize, high: usize) {
        let (mut a, mut b) = (rows[low], rows[high]);
        for k in 0..4 {
            let other = ((a[k] >> SHIFT) ^ b[k]) & MASK;
            b[k] ^= other;
            a[k] ^= other << SHIFT;
        }
        (rows[low], rows[high]) = (a, b);
    }
    for row in 0..4 {
        swap::<32, 0x0000_0000_ffff_ffff>(rows, row, row + 4);
    }
    for row in [0, 1, 4, 5] {
        swap::<16, 0x0000_ffff_0000_ffff>(rows, row, row + 2);
    }
    for row in [0, 2, 4, 6] {
        swap::<8, 0x00ff_00ff_00ff_00ff>(rows, row, row + 1);
    }
}

/// 32 bytes as four little-endian words.
#[inline(always)]
pub(super) fn words(bytes: &[u8; LANES]) -> [u64; 4] {
    let mut out = [0; 4];
    for (out, bytes) in out.iter_mut().zip(bytes.as_chunks::<8>().0) {
        *out = u64::from_le_bytes(*bytes);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_of_eight_are_transposed() {
        let byte = |row: usize, at: usize| (row * 37 + at * 11) as u8;
        let mut rows: [[u64; 4]; 8] =
            std::array::from_fn(|row| words(&std::array::from_fn(|at| byte(row, at))));
        transpose_8x8(&mut rows);
        for (row, found) in rows.iter().enumerate() {
            for (k, found) in found.iter().enumerate() {
                let expected: [u8; 8] = std::array::from_fn(|c| byte(c, 8 * k + row));
                assert_eq!(found.to_le_bytes(), expected);
            }
        }
    }
}
