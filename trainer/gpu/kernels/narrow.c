#include "common.h"

// LayerNorm and SiLU of contiguous rows that are no wider than four numbers a lane: several rows a warp. Widths are multiples of 4 up to 128.

#ifdef __CUDACC__
#define GROUP_SUM(x, lanes)                                                                        \
    for (int o = (int)(lanes) / 2; o > 0; o /= 2) x += __shfl_xor_sync(0xffffffffu, x, o);
#else
#define GROUP_SUM(x, lanes) (void)(lanes);
#endif

DEVICE float of_silu(float z) { return z * sigmoid_of(z); }

DEVICE float back_through_silu(float z, float d) {
    float s = sigmoid_of(z);
    return d * s * (1.0f + z * (1.0f - s));
}

// As `norm_forward`, always with SiLU. p: x, gain, shift, y, stats. n: rows, width (4, 8, 16, 32, 64 or 128). f: eps.
KERNEL(narrow_forward) {
    const Four *x = (const Four *)AT(0), *gain = (const Four *)AT(1), *shift = (const Four *)AT(2);
    Four *y = (Four *)AT(3);
    float *stats = (float *)AT(4);
    int fours = (int)(a.n[1] / 4), lanes = LANES == 1 ? 1 : fours, each = fours / lanes;
    int in_grid = BLOCKS * (THREADS / lanes), rows = (a.n[0] + in_grid - 1) / in_grid * in_grid;
    for (int r = BLOCK * (THREADS / lanes) + THREAD / lanes; r < rows; r += in_grid) {
        int row = r < a.n[0] ? r : a.n[0] - 1;
        float sum = 0.0f, squares = 0.0f;
        const Four *from = x + row * fours + THREAD % lanes;
        for (int i = 0; i < each; i++) sum += from[i].x + from[i].y + from[i].z + from[i].w;
        GROUP_SUM(sum, lanes)
        float mean = sum / (float)a.n[1];
        for (int i = 0; i < each; i++) {
            Four v = from[i];
            squares += (v.x - mean) * (v.x - mean) + (v.y - mean) * (v.y - mean) + (v.z - mean) * (v.z - mean) + (v.w - mean) * (v.w - mean);
        }
        GROUP_SUM(squares, lanes)
        float scale = 1.0f / sqrtf(squares / (float)a.n[1] + a.f[0]);
        if (r >= a.n[0]) continue;
        for (int i = 0; i < each; i++) {
            int at = THREAD % lanes + i;
            Four v = from[i], g = gain[at], s = shift[at], out;
            out.x = of_silu((v.x - mean) * scale * g.x + s.x);
            out.y = of_silu((v.y - mean) * scale * g.y + s.y);
            out.z = of_silu((v.z - mean) * scale * g.z + s.z);
            out.w = of_silu((v.w - mean) * scale * g.w + s.w);
            y[row * fours + at] = out;
        }
        if (THREAD % lanes == 0) {
            stats[2 * row] = mean;
            stats[2 * row + 1] = scale;
        }
    }
}

// As `norm_backward`, and the gradients of gain and shift over the rows of a block: partial [blocks, 2, width].
// p: x, gain, shift, stats, dy, dx, partial (null where the gain is frozen). n: rows, width, add to dx. Shared: 8 floats a thread.
KERNEL(narrow_backward) {
    SHARED(shared);
    const Four *x = (const Four *)AT(0), *gain = (const Four *)AT(1), *shift = (const Four *)AT(2);
    const float *stats = (const float *)AT(3);
    const Four *dy = (const Four *)AT(4);
    Four *dx = (Four *)AT(5);
    float *partial = (float *)OR_NULL(6);
    int fours = (int)(a.n[1] / 4), lanes = LANES == 1 ? 1 : fours, each = fours / lanes;
    int in_grid = BLOCKS * (THREADS / lanes), rows = (a.n[0] + in_grid - 1) / in_grid * in_grid;
#ifdef __CUDACC__
    float of_gain[4] = {0.0f, 0.0f, 0.0f, 0.0f}, of_shift[4] = {0.0f, 0.0f, 0.0f, 0.0f};
#else
    float of_gain[128] = {0}, of_shift[128] = {0};
#endif
    for (int r = BLOCK * (THREADS / lanes) + THREAD / lanes; r < rows; r += in_grid) {
        int row = r < a.n[0] ? r : a.n[0] - 1;
        float mean = stats[2 * row], scale = stats[2 * row + 1], sum = 0.0f, product = 0.0f;
        for (int pass = 0; pass < 2; pass++) {
            for (int i = 0; i < each; i++) {
                int at = THREAD % lanes + i;
                Four v = x[row * fours + at], g = gain[at], s = shift[at], d = dy[row * fours + at];
                v.x = (v.x - mean) * scale;
                v.y = (v.y - mean) * scale;
                v.z = (v.z - mean) * scale;
                v.w = (v.w - mean) * scale;
                d.x = back_through_silu(v.x * g.x + s.x, d.x);
                d.y = back_through_silu(v.y * g.y + s.y, d.y);
                d.z = back_through_silu(v.z * g.z + s.z, d.z);
                d.w = back_through_silu(v.w * g.w + s.w, d.w);
                if (pass == 0) {
                    sum += d.x * g.x + d.y * g.y + d.z * g.z + d.w * g.w;
                    product += d.x * g.x * v.x + d.y * g.y * v.y + d.z * g.z * v.z + d.w * g.w * v.w;
                } else if (r < a.n[0]) {
                    Four out;
                    out.x = scale * (d.x * g.x - sum - v.x * product);
                    out.y = scale * (d.y * g.y - sum - v.y * product);
                    out.z = scale * (d.z * g.z - sum - v.z * product);
                    out.w = scale * (d.w * g.w - sum - v.w * product);
                    if (a.n[2]) {
                        Four old = dx[row * fours + at];
                        out.x += old.x;
                        out.y += old.y;
                        out.z += old.z;
                        out.w += old.w;
                    }
                    dx[row * fours + at] = out;
                    of_gain[4 * i] += d.x * v.x;
                    of_gain[4 * i + 1] += d.y * v.y;
                    of_gain[4 * i + 2] += d.z * v.z;
                    of_gain[4 * i + 3] += d.w * v.w;
                    of_shift[4 * i] += d.x;
                    of_shift[4 * i + 1] += d.y;
                    of_shift[4 * i + 2] += d.z;
                    of_shift[4 * i + 3] += d.w;
                }
            }
            if (pass == 0) {
                GROUP_SUM(sum, lanes)
                GROUP_SUM(product, lanes)
                sum /= (float)a.n[1];
                product /= (float)a.n[1];
            }
        }
    }
    if (!partial) return;
    float *out = partial + BLOCK * 2 * a.n[1];
#ifdef __CUDACC__
    for (int i = 0; i < 4; i++) {
        shared[8 * THREAD + i] = of_gain[i];
        shared[8 * THREAD + 4 + i] = of_shift[i];
    }
    __syncthreads();
    for (int j = THREAD; j < a.n[1]; j += THREADS) {
        float gains = 0.0f, shifts = 0.0f;
        for (int t = j / 4; t < THREADS; t += fours) {
            gains += shared[8 * t + j % 4];
            shifts += shared[8 * t + 4 + j % 4];
        }
        out[j] = gains;
        out[a.n[1] + j] = shifts;
    }
#else
    (void)shared;
    for (int j = 0; j < a.n[1]; j++) {
        out[j] = of_gain[j];
        out[a.n[1] + j] = of_shift[j];
    }
#endif
}
