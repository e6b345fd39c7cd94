#include "common.h"

// LayerNorm over a row, then SiLU where n[4]: y = silu((x - mean) / sqrt(var + eps) * gain + shift).
// p: x, gain, shift, y, stats [rows, 2] (mean, 1 / sqrt(var + eps)). n: rows, width, stride of x, stride of y, silu, wide. f: eps.
KERNEL(norm_forward) {
    const float *x = (const float *)AT(0), *gain = (const float *)AT(1), *shift = (const float *)AT(2);
    float *y = (float *)AT(3), *stats = (float *)AT(4);
    int rows = a.n[0], width = a.n[1];
    Team t = team(a.n[5]);
    for (int r = t.first; r < rows; r += t.step) {
        const float *xr = x + r * a.n[2];
        float *yr = y + r * a.n[3];
        float sum = 0.0f, squares = 0.0f;
        for (int j = t.lane; j < width; j += t.lanes) sum += xr[j];
        float mean = team_sum(t, sum) / (float)width;
        for (int j = t.lane; j < width; j += t.lanes) squares += (xr[j] - mean) * (xr[j] - mean);
        float scale = 1.0f / sqrtf(team_sum(t, squares) / (float)width + a.f[0]);
        for (int j = t.lane; j < width; j += t.lanes) {
            float z = (xr[j] - mean) * scale * gain[j] + shift[j];
            yr[j] = a.n[4] ? z * sigmoid_of(z) : z;
        }
        if (t.lane == 0) {
            stats[2 * r] = mean;
            stats[2 * r + 1] = scale;
        }
    }
}

// The gradient before SiLU.
DEVICE float through_silu(float z, float d) {
    float s = sigmoid_of(z);
    return d * s * (1.0f + z * (1.0f - s));
}

// p: x, gain, shift, stats, dy, dx. n: rows, width, stride of x, of dy, of dx, silu, add to dx, wide.
KERNEL(norm_backward) {
    const float *x = (const float *)AT(0), *gain = (const float *)AT(1), *shift = (const float *)AT(2);
    const float *stats = (const float *)AT(3), *dy = (const float *)AT(4);
    float *dx = (float *)AT(5);
    int rows = a.n[0], width = a.n[1];
    Team t = team(a.n[7]);
    for (int r = t.first; r < rows; r += t.step) {
        const float *xr = x + r * a.n[2], *dyr = dy + r * a.n[3];
        float *dxr = dx + r * a.n[4];
        float mean = stats[2 * r], scale = stats[2 * r + 1], sum = 0.0f, product = 0.0f;
        for (int j = t.lane; j < width; j += t.lanes) {
            float normed = (xr[j] - mean) * scale, d = dyr[j];
            if (a.n[5]) d = through_silu(normed * gain[j] + shift[j], d);
            sum += d * gain[j];
            product += d * gain[j] * normed;
        }
        sum = team_sum(t, sum) / (float)width;
        product = team_sum(t, product) / (float)width;
        for (int j = t.lane; j < width; j += t.lanes) {
            float normed = (xr[j] - mean) * scale, d = dyr[j];
            if (a.n[5]) d = through_silu(normed * gain[j] + shift[j], d);
            put(dxr + j, a.n[6], scale * (d * gain[j] - sum - normed * product));
        }
    }
}

// Gradients of gain and shift over a chunk of rows: partial [chunks, 2, width].
// p: x, gain, shift, stats, dy, partial. n: rows, width, stride of x, of dy, silu, rows a chunk.
KERNEL(norm_parameters) {
    const float *x = (const float *)AT(0), *gain = (const float *)AT(1), *shift = (const float *)AT(2);
    const float *stats = (const float *)AT(3), *dy = (const float *)AT(4);
    float *partial = (float *)AT(5);
    int width = a.n[1], blocks = (width + 31) / 32, chunk = BLOCK / blocks, end = (chunk + 1) * a.n[5];
    if (end > a.n[0]) end = a.n[0];
    for (int lane = LANE; lane < 32; lane += LANES) {
        int j = BLOCK % blocks * 32 + lane;
        float of_gain = 0.0f, of_shift = 0.0f;
        if (j < width) {
            for (int r = chunk * a.n[5] + WARP; r < end; r += WARPS) {
                float normed = (x[r * a.n[2] + j] - stats[2 * r]) * stats[2 * r + 1], d = dy[r * a.n[3] + j];
                if (a.n[4]) d = through_silu(normed * gain[j] + shift[j], d);
                of_gain += d * normed;
                of_shift += d;
            }
        }
        of_gain = across_warps(of_gain);
        of_shift = across_warps(of_shift);
        if (WARP == 0 && j < width) {
            partial[2 * chunk * width + j] = of_gain;
            partial[(2 * chunk + 1) * width + j] = of_shift;
        }
    }
}

// Sums of columns over a chunk of rows: partial [chunks, width].
// p: x, partial. n: rows, width, stride of x, rows a chunk.
KERNEL(column_sums) {
    const float *x = (const float *)AT(0);
    float *partial = (float *)AT(1);
    int width = a.n[1], blocks = (width + 31) / 32, chunk = BLOCK / blocks, end = (chunk + 1) * a.n[3];
    if (end > a.n[0]) end = a.n[0];
    for (int lane = LANE; lane < 32; lane += LANES) {
        int j = BLOCK % blocks * 32 + lane;
        float sum = 0.0f;
        if (j < width)
            for (int r = chunk * a.n[3] + WARP; r < end; r += WARPS) sum += x[r * a.n[2] + j];
        sum = across_warps(sum);
        if (WARP == 0 && j < width) partial[chunk * width + j] = sum;
    }
}

// Adds the chunks' shares to a gradient: p: partial, out. n: chunks, width, distance of chunks, offset in a chunk.
KERNEL(sum_partials) {
    const float *partial = (const float *)AT(0);
    float *out = (float *)AT(1);
    for (int lane = LANE; lane < 32; lane += LANES) {
        int j = BLOCK * 32 + lane;
        float sum = 0.0f;
        if (j < a.n[1])
            for (int c = WARP; c < a.n[0]; c += WARPS) sum += partial[c * a.n[2] + a.n[3] + j];
        sum = across_warps(sum);
        if (WARP == 0 && j < a.n[1]) out[j] += sum;
    }
}

// The recurrent cell: LayerNorm of `pre` [rows, 3d], gates, h'. p: pre, gain, shift, h, next, stats, next again (or null).
// n: rows, d, stride of pre, of h, of next, wide, stride of next again. f: eps.
KERNEL(cell_forward) {
    const float *pre = (const float *)AT(0), *gain = (const float *)AT(1), *shift = (const float *)AT(2);
    const float *h = (const float *)AT(3);
    float *next = (float *)AT(4), *stats = (float *)AT(5), *again = (float *)OR_NULL(6);
    int d = a.n[1], width = 3 * d;
    Team t = team(a.n[5]);
    for (int r = t.first; r < a.n[0]; r += t.step) {
        const float *x = pre + r * a.n[2];
        float sum = 0.0f, squares = 0.0f;
        for (int j = t.lane; j < width; j += t.lanes) sum += x[j];
        float mean = team_sum(t, sum) / (float)width;
        for (int j = t.lane; j < width; j += t.lanes) squares += (x[j] - mean) * (x[j] - mean);
        float scale = 1.0f / sqrtf(team_sum(t, squares) / (float)width + a.f[0]);
        for (int j = t.lane; j < d; j += t.lanes) {
            float reset = sigmoid_of((x[j] - mean) * scale * gain[j] + shift[j]);
            float cand = tanhf(reset * ((x[d + j] - mean) * scale * gain[d + j] + shift[d + j]));
            float update = sigmoid_of((x[2 * d + j] - mean) * scale * gain[2 * d + j] + shift[2 * d + j] - 1.0f);
            float before = h[r * a.n[3] + j], after = before + update * (cand - before);
            next[r * a.n[4] + j] = after;
            if (again) again[r * a.n[6] + j] = after;
        }
        if (t.lane == 0) {
            stats[2 * r] = mean;
            stats[2 * r + 1] = scale;
        }
    }
}

// p: pre, gain, shift, h, stats, d_next, d_gates (after the LayerNorm), d_pre, d_h (added to), d_next again (or null).
// n: rows, d, stride of pre, of h, of d_next, of d_h, wide, stride of d_next again.
KERNEL(cell_backward) {
    const float *pre = (const float *)AT(0), *gain = (const float *)AT(1), *shift = (const float *)AT(2);
    const float *h = (const float *)AT(3), *stats = (const float *)AT(4), *d_next = (const float *)AT(5);
    float *d_gates = (float *)AT(6), *d_pre = (float *)AT(7), *d_h = (float *)AT(8);
    const float *again = (const float *)OR_NULL(9);
    int d = a.n[1], width = 3 * d;
    Team t = team(a.n[6]);
    for (int r = t.first; r < a.n[0]; r += t.step) {
        const float *x = pre + r * a.n[2];
        float *dz = d_gates + r * width, *dx = d_pre + r * width;
        float mean = stats[2 * r], scale = stats[2 * r + 1], sum = 0.0f, product = 0.0f;
        for (int j = t.lane; j < d; j += t.lanes) {
            float n0 = (x[j] - mean) * scale, n1 = (x[d + j] - mean) * scale, n2 = (x[2 * d + j] - mean) * scale;
            float reset = sigmoid_of(n0 * gain[j] + shift[j]), z1 = n1 * gain[d + j] + shift[d + j];
            float cand = tanhf(reset * z1), update = sigmoid_of(n2 * gain[2 * d + j] + shift[2 * d + j] - 1.0f);
            float before = h[r * a.n[3] + j], dy = d_next[r * a.n[4] + j];
            if (again) dy += again[r * a.n[7] + j];
            float d_arg = dy * update * (1.0f - cand * cand);
            float d0 = d_arg * z1 * reset * (1.0f - reset), d1 = d_arg * reset;
            float d2 = dy * (cand - before) * update * (1.0f - update);
            dz[j] = d0;
            dz[d + j] = d1;
            dz[2 * d + j] = d2;
            sum += d0 * gain[j] + d1 * gain[d + j] + d2 * gain[2 * d + j];
            product += d0 * gain[j] * n0 + d1 * gain[d + j] * n1 + d2 * gain[2 * d + j] * n2;
            d_h[r * a.n[5] + j] += dy * (1.0f - update);
        }
        sum = team_sum(t, sum) / (float)width;
        product = team_sum(t, product) / (float)width;
        for (int j = t.lane; j < d; j += t.lanes)
            for (int g = j; g < width; g += d)
                dx[g] = scale * (dz[g] * gain[g] - sum - (x[g] - mean) * scale * product);
    }
}
