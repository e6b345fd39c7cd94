#include "common.h"

// Products with few rows, in f32: what a scan over time is made of. General products leave most of a GPU idle at such sizes.

#define ROWS_AT_ONCE 16
#define COLUMNS_AT_ONCE 4

typedef struct {
    const float *x, *w;
    float *y;
    int m, n, k, of_x, of_w, of_y, add;
} Product;

#ifdef __CUDACC__
// The sums over a warp of 2 h numbers a lane, first step: each lane keeps h of them, the other lane's share added.
#define HALVE(o, h)                                                                      \
    for (int i = 0; i < h; i++) {                                                        \
        float sent = LANE & o ? sums[i] : sums[i + h], kept = LANE & o ? sums[i + h] : sums[i]; \
        sums[i] = kept + __shfl_xor_sync(0xffffffffu, sent, o);                          \
    }

// The sums over a warp of 32 `each` numbers a lane: lane i ends with numbers `each` i and on.
DEVICE void scatter_sums(float *sums, const int each) {
UNROLL
    HALVE(16, 16 * each)
UNROLL
    HALVE(8, 8 * each)
UNROLL
    HALVE(4, 4 * each)
UNROLL
    HALVE(2, 2 * each)
UNROLL
    HALVE(1, each)
}
#endif

// Four columns of `rows` rows (8 or 16) by `shares` warps, which share k; as many fours at a time as a block has warps for. Where `staged`, x [at
// most `rows`, k] is brought to shared memory first, all of it at once: every warp of a block reads it.
DEVICE void few_rows(Product p, const int rows, const int staged, int shares, float *shared, int BLOCK, int BLOCKS) {
    int columns = (p.n + COLUMNS_AT_ONCE - 1) / COLUMNS_AT_ONCE, tasks = columns * ((p.m + rows - 1) / rows);
    int at_once = WARPS / shares, share = WARP % shares, step = 4 * LANES * shares;
#ifdef __CUDACC__
    if (staged && BLOCK * at_once < tasks) {
        for (int r = WARP; r < p.m; r += WARPS)
            for (int at = 4 * LANE; at < p.k; at += 4 * LANES)
                asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"((u32)__cvta_generic_to_shared(shared + r * p.k + at)),
                             "l"(p.x + r * p.of_x + at) : "memory");
    }
#endif
    for (int task = BLOCK * at_once + WARP / shares; task - WARP / shares < tasks; task += BLOCKS * at_once) {
        int first = task % columns * COLUMNS_AT_ONCE, from = task / columns * rows, at = 4 * (share * LANES + LANE);
        float sums[ROWS_AT_ONCE * COLUMNS_AT_ONCE];
        Four w[COLUMNS_AT_ONCE];
        const float *of_w[COLUMNS_AT_ONCE];
UNROLL
        for (int i = 0; i < rows * COLUMNS_AT_ONCE; i++) sums[i] = 0.0f;
UNROLL
        for (int c = 0; c < COLUMNS_AT_ONCE; c++) {
            of_w[c] = p.w + (first + c < p.n ? first + c : p.n - 1) * p.of_w;
            if (at < p.k) w[c] = *(const Four *)(of_w[c] + at);
        }
#ifdef __CUDACC__
        if (staged && task - WARP / shares == BLOCK * at_once) {
            asm volatile("cp.async.wait_all;" ::: "memory");
            __syncthreads();
        }
#endif
        if (task < tasks) {
NO_UNROLL
            for (; at < p.k; at += step) {
                int of_x = staged ? at : from * p.of_x + at;
UNROLL
                for (int r = 0; r < rows; r++) {
                    Four x = *(const Four *)((staged ? shared : p.x) + of_x);
                    if (staged) of_x += r + 1 < p.m ? p.k : 0;
                    else of_x += from + r + 1 < p.m ? p.of_x : 0;
UNROLL
                    for (int c = 0; c < COLUMNS_AT_ONCE; c++)
                        sums[r * COLUMNS_AT_ONCE + c] += x.x * w[c].x + x.y * w[c].y + x.z * w[c].z + x.w * w[c].w;
                }
UNROLL
                for (int c = 0; c < COLUMNS_AT_ONCE; c++)
                    if (at + step < p.k) w[c] = *(const Four *)(of_w[c] + at + step);
            }
        }
#ifdef __CUDACC__
        const int each = rows * COLUMNS_AT_ONCE / 32;
        scatter_sums(sums, each);
        if (shares > 1) {
            __shared__ float parts[16][ROWS_AT_ONCE * COLUMNS_AT_ONCE];
UNROLL
            for (int i = 0; i < each; i++) parts[WARP][each * LANE + i] = sums[i];
            __syncthreads();
            if (share == 0)
                for (int other = 1; other < shares; other++)
UNROLL
                    for (int i = 0; i < each; i++) sums[i] += parts[WARP + other][each * LANE + i];
            __syncthreads();
        }
        if (share > 0 || task >= tasks) continue;
UNROLL
        for (int i = 0; i < each; i++) {
            int row = from + (each * LANE + i) / COLUMNS_AT_ONCE, column = first + (each * LANE + i) % COLUMNS_AT_ONCE;
#else
        for (int i = 0; i < rows * COLUMNS_AT_ONCE; i++) {
            int row = from + i / COLUMNS_AT_ONCE, column = first + i % COLUMNS_AT_ONCE;
#endif
            if (row < p.m && column < p.n) put(p.y + row * p.of_y + column, p.add, sums[i]);
        }
    }
}

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
    scatter_sums(sums, 2);
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

// The same in a list, by blocks of any number of warps.
// p: x, w, y. n: m, n, k, stride of x, of w, of y, add, warps that share k, whether x [at most 16, k] goes to shared memory.
KERNEL(product_listed) {
    SHARED(shared);
    Product p = {(const float *)AT(0), (const float *)AT(1), (float *)AT(2), a.n[0], a.n[1], a.n[2], a.n[3], a.n[4], a.n[5], a.n[6]};
    int shares = LANES == 1 ? 1 : a.n[7], staged = LANES == 1 ? 0 : a.n[8];
    if (staged && p.m <= 8) few_rows(p, 8, 1, shares, shared, BLOCK, BLOCKS);
    else if (staged) few_rows(p, 16, 1, shares, shared, BLOCK, BLOCKS);
    else if (p.m <= 8) few_rows(p, 8, 0, shares, 0, BLOCK, BLOCKS);
    else few_rows(p, 16, 0, shares, 0, BLOCK, BLOCKS);
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
