//! Weights in memory: where they begin, in how many bits, and how a vector of them is read.

use half::f16;
use pulp::Simd;

/// How weights are kept. Arithmetic is in f32 either way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Precision {
    /// As exported.
    #[default]
    F32,
    /// Half the bytes; rounded to 11 bits.
    F16,
}

#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(64))]
struct Line([u8; 64]);

/// Numbers that begin at a cache line.
#[derive(Debug, Clone, PartialEq)]
pub struct Lines<T = f32> {
    lines: Vec<Line>,
    len: usize,
    kind: std::marker::PhantomData<T>,
}

impl<T: bytemuck::Pod> Lines<T> {
    /// A copy.
    #[must_use]
    pub fn new(values: &[T]) -> Self {
        let bytes: &[u8] = bytemuck::cast_slice(values);
        let mut lines = vec![Line([0; 64]); bytes.len().div_ceil(64)];
        bytemuck::cast_slice_mut::<Line, u8>(&mut lines)[..bytes.len()].copy_from_slice(bytes);
        Self { lines, len: values.len(), kind: std::marker::PhantomData }
    }

    /// The numbers.
    #[must_use]
    pub fn as_slice(&self) -> &[T] {
        &bytemuck::cast_slice(&self.lines)[..self.len]
    }
}

#[derive(Debug, Clone, PartialEq)]
pub(super) enum Weights {
    F32(Lines<f32>),
    F16(Lines<u16>),
}

impl Weights {
    pub(super) fn new(values: &[f32], precision: Precision) -> Self {
        match precision {
            Precision::F32 => Self::F32(Lines::new(values)),
            Precision::F16 => {
                let values: Vec<u16> = values.iter().map(|x| f16::from_f32(*x).to_bits()).collect();
                Self::F16(Lines::new(&values))
            }
        }
    }
}

/// How a vector of weights is read.
pub(super) trait Read {
    /// How a number is kept.
    type Number: Copy;
    /// Reads a vector.
    ///
    /// # Safety
    /// As many numbers as a vector has lanes must be readable at `from`.
    unsafe fn read<S: Simd>(simd: S, from: *const Self::Number) -> S::f32s;
}

/// f32.
pub(super) struct Full;

impl Read for Full {
    type Number = f32;
    #[inline(always)]
    unsafe fn read<S: Simd>(_: S, from: *const f32) -> S::f32s {
        // SAFETY: the caller's; a pulp vector is plain lanes of f32, read unaligned.
        unsafe { from.cast::<S::f32s>().read_unaligned() }
    }
}

/// 16 bits.
pub(super) struct Half;

impl Read for Half {
    type Number = u16;
    #[inline(always)]
    unsafe fn read<S: Simd>(simd: S, from: *const u16) -> S::f32s {
        #[cfg(target_arch = "x86_64")]
        if S::F32_LANES == 16 {
            use std::arch::x86_64::{__m256i, _mm256_loadu_si256, _mm512_cvtph_ps};
            // SAFETY: the caller's for the read; pulp has vectors of 16 lanes on this architecture only where it found AVX-512.
            unsafe {
                let lanes = _mm512_cvtph_ps(_mm256_loadu_si256(from.cast::<__m256i>()));
                return std::mem::transmute_copy(&lanes);
            }
        }
        let mut lanes = [0.0; 16];
        for (index, lane) in lanes.iter_mut().enumerate().take(S::F32_LANES) {
            // SAFETY: the caller's.
            *lane = f16::from_bits(unsafe { *from.add(index) }).to_f32();
        }
        simd.partial_load_f32s(&lanes[..S::F32_LANES])
    }
}
