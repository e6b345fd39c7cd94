#include "common.h"

// Products with few rows, in f32: what a scan over time is made of. General products leave most of a GPU idle at such sizes.

#define ROWS_AT_ONCE 16
#define COLUMNS_AT_ONCE 4

#ifdef __CUDACC__
// The sum over a warp of 64 numbers a lane: lane i ends with numbers 2 i and 2 i + 1.
#define HALVE(o, h)                                                                      \
    for (int i = 0; i < h; i++) {                                                        \
        float sent = LANE & o ? sums[i] : sums[i + h], kept = LANE & o ? sums[i + h] : sums[i]; \
        sums[i] = kept + __shfl_xor_sync(0xffffffffu, sent, o);                          \
    }

DEVICE void scatter_sums(float *sums) {
UNROLL
    HALVE(16, 32)
UNROLL
    HALVE(8, 16)
UNROLL
    HALVE(4, 8)
UNROLL
    HALVE(2, 4)
UNROLL
    HALVE(1, 2)
}
#endif

// y [m, n] = x [m, k] w^T, w [n, k], or added to y: 4 columns of 16 rows a block, whose threads share k. k and all strides are multiples of 4.
// p: x, w, y. n: m, n, k, stride of x, of w, of y, add.
KERNEL(product_few_rows) {
    const float *x = (const float *)AT(0), *w = (const float *)AT(1);
    float *y = (float *)AT(2);
    // Places in 64 bits: with 32 the compiler brings fewer rows at a time, and the kernel took 5.7 us in place of 3.3.
    long m = a.n[0], n = a.n[1], k = a.n[2], columns = (n + COLUMNS_AT_ONCE - 1) / COLUMNS_AT_ONCE;
    long first = BLOCK % columns * COLUMNS_AT_ONCE, from = BLOCK / columns * ROWS_AT_ONCE;
    float sums[ROWS_AT_ONCE * COLUMNS_AT_ONCE];
UNROLL
    for (int i = 0; i < ROWS_AT_ONCE * COLUMNS_AT_ONCE; i++) sums[i] = 0.0f;
    for (long at = 4 * THREAD; at < k; at += 4 * THREADS) {
        Four of_w[COLUMNS_AT_ONCE];
UNROLL
        for (int c = 0; c < COLUMNS_AT_ONCE; c++) {
            long column = first + c < n ? first + c : n - 1;
            of_w[c] = *(const Four *)(w + column * a.n[4] + at);
        }
UNROLL
        for (int r = 0; r < ROWS_AT_ONCE; r++) {
            long row = from + r < m ? from + r : m - 1;
            Four of_x = *(const Four *)(x + row * a.n[3] + at);
UNROLL
            for (int c = 0; c < COLUMNS_AT_ONCE; c++)
                sums[r * COLUMNS_AT_ONCE + c] +=
                    of_x.x * of_w[c].x + of_x.y * of_w[c].y + of_x.z * of_w[c].z + of_x.w * of_w[c].w;
        }
    }
#ifdef __CUDACC__
    __shared__ float shares[8][ROWS_AT_ONCE * COLUMNS_AT_ONCE];
    scatter_sums(sums);
    shares[WARP][2 * LANE] = sums[0];
    shares[WARP][2 * LANE + 1] = sums[1];
    __syncthreads();
    for (int i = THREAD; i < ROWS_AT_ONCE * COLUMNS_AT_ONCE; i += THREADS) {
        float sum = 0.0f;
        for (int share = 0; share < WARPS; share++) sum += shares[share][i];
#else
    for (int i = 0; i < ROWS_AT_ONCE * COLUMNS_AT_ONCE; i++) {
        float sum = sums[i];
#endif
        long row = from + i / COLUMNS_AT_ONCE, column = first + i % COLUMNS_AT_ONCE;
        if (row < m && column < n) put(y + row * a.n[5] + column, a.n[6], sum);
    }
}

// y [m, n] = x [m, k] w, w [k, n], or added to y: 32 columns of 16 rows a block, whose warps share k. k and the stride of x are multiples of 4.
// p: x, w, y. n: m, n, k, stride of x, of w, of y, add.
KERNEL(product_few_rows_back) {
    SHARED(shared);
    const float *x = (const float *)AT(0), *w = (const float *)AT(1);
    float *y = (float *)AT(2);
    int m = a.n[0], n = a.n[1], k = a.n[2], columns = (n + 31) / 32, from = BLOCK / columns * ROWS_AT_ONCE;
    for (int lane = LANE; lane < 32; lane += LANES) {
        int column = BLOCK % columns * 32 + lane, inside = column < n ? column : n - 1;
        float sums[ROWS_AT_ONCE];
UNROLL
        for (int r = 0; r < ROWS_AT_ONCE; r++) sums[r] = 0.0f;
        for (int at = 4 * WARP; at < k; at += 4 * WARPS) {
            const float *of_w = w + at * a.n[4] + inside;
            float w0 = of_w[0], w1 = of_w[a.n[4]], w2 = of_w[2 * a.n[4]], w3 = of_w[3 * a.n[4]];
UNROLL
            for (int r = 0; r < ROWS_AT_ONCE; r++) {
                int row = from + r < m ? from + r : m - 1;
                Four of_x = *(const Four *)(x + row * a.n[3] + at);
                sums[r] += of_x.x * w0 + of_x.y * w1 + of_x.z * w2 + of_x.w * w3;
            }
        }
#ifdef __CUDACC__
UNROLL
        for (int r = 0; r < ROWS_AT_ONCE; r++) shared[(WARP * ROWS_AT_ONCE + r) * 32 + lane] = sums[r];
        __syncthreads();
        for (int r = WARP; r < ROWS_AT_ONCE; r += WARPS) {
            float sum = 0.0f;
            for (int share = 0; share < WARPS; share++) sum += shared[(share * ROWS_AT_ONCE + r) * 32 + lane];
#else
        (void)shared;
        for (int r = 0; r < ROWS_AT_ONCE; r++) {
            float sum = sums[r];
#endif
            if (from + r < m && column < n) put(y + (from + r) * a.n[5] + column, a.n[6], sum);
        }
    }
}
