//! Matrix products by cuBLAS.

use std::ffi::c_void;

use cudarc::cublas::{result as blas, sys as blas_sys};

use super::super::{GpuError, Precision, Runs, begin};
use super::{Nvidia, failed};
use crate::commands::{Lane, Product};

/// Terms of a sum up to which the products of several runs are one call.
const LONGEST_TOGETHER: i32 = 2048;

impl Nvidia {
    pub(super) fn multiply(&self, p: &Product, lane: Lane, runs: Runs<'_>) -> Result<(), GpuError> {
        use blas_sys::cublasOperation_t::{CUBLAS_OP_N, CUBLAS_OP_T};
        let (m, n, k) = p.sizes();
        let operation = |transposed: bool| if transposed { CUBLAS_OP_T } else { CUBLAS_OP_N };
        let compute = match self.precision {
            Precision::F32 => blas_sys::cublasComputeType_t::CUBLAS_COMPUTE_32F,
            Precision::Tf32 => blas_sys::cublasComputeType_t::CUBLAS_COMPUTE_32F_FAST_TF32,
        };
        let (one, beta) = (1f32, if p.add { 1f32 } else { 0f32 });
        let (one, beta) = ((&raw const one).cast(), (&raw const beta).cast());
        let kind = blas_sys::cudaDataType_t::CUDA_R_32F;
        let (a, b, c) = (begin(p.a), begin(p.b), begin(p.c));
        let (a_at, b_at, c_at) = (a as *const c_void, b as *const c_void, c as *mut c_void);
        let (a_row, b_row, c_row) = (p.a.stride as i32, p.b.stride as i32, p.c.stride as i32);
        let of_a = operation(p.a_transposed);
        let of_b = operation(p.b_transposed);
        let (m, n, k) = (m as i32, n as i32, k as i32);
        let handle = *self.lane(lane).1.handle();
        let best = blas_sys::cublasGemmAlgo_t::CUBLAS_GEMM_DEFAULT;
        // cuBLAS counts columns first: the transposed product of the transposes.
        // SAFETY: the matrices' sizes were checked when the product was added, and they lie in this machine's memory, for each run.
        unsafe {
            if runs.count == 1 || k > LONGEST_TOGETHER {
                // Several at once are not split along a long sum, which leaves most of the GPU idle.
                (0..runs.count).try_for_each(|run| {
                    let of_run = |address: u64| address + (run * runs.apart(address)) as u64;
                    let (a_at, b_at) = (of_run(a) as *const c_void, of_run(b) as *const c_void);
                    blas::gemm_ex(
                        handle,
                        of_b,
                        of_a,
                        n,
                        m,
                        k,
                        one,
                        b_at,
                        kind,
                        b_row,
                        a_at,
                        kind,
                        a_row,
                        beta,
                        of_run(c) as *mut c_void,
                        kind,
                        c_row,
                        compute,
                        best,
                    )
                })
            } else {
                let apart = |address| (runs.apart(address) / 4) as i64;
                let (a_apart, b_apart, c_apart) = (apart(a), apart(b), apart(c));
                blas::gemm_strided_batched_ex(
                    handle,
                    of_b,
                    of_a,
                    n,
                    m,
                    k,
                    one,
                    b_at,
                    kind,
                    b_row,
                    b_apart,
                    a_at,
                    kind,
                    a_row,
                    a_apart,
                    beta,
                    c_at,
                    kind,
                    c_row,
                    c_apart,
                    runs.count as i32,
                    compute,
                    best,
                )
            }
        }
        .map_err(failed("a matrix product"))
    }
}
