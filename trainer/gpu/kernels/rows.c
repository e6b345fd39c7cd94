#include "common.h"

// Every row of y becomes `row`. p: row, y. n: rows, width, stride of y.
KERNEL(fill_rows) {
    const float *row = (const float *)AT(0);
    float *y = (float *)AT(1);
    FOR_ALL(i, a.n[0] * a.n[1]) y[i / a.n[1] * a.n[2] + i % a.n[1]] = row[i % a.n[1]];
}

// y = factor * x, or added to y. p: x, y. n: rows, width, stride of x, of y, add. f: factor.
KERNEL(copy_rows) {
    const float *x = (const float *)AT(0);
    float *y = (float *)AT(1);
    FOR_ALL(i, a.n[0] * a.n[1]) {
        int r = i / a.n[1], j = i % a.n[1];
        put(y + r * a.n[3] + j, a.n[4], a.f[0] * x[r * a.n[2] + j]);
    }
}

// Rows of x by index, or back: y[i] = x[index[i]], or x[index[i]] += y[i] where n[4] (each index at most once).
// p: x, y, index (u32). n: rows of y, width, stride of x, of y, back.
KERNEL(gather_rows) {
    float *x = (float *)AT(0), *y = (float *)AT(1);
    const u32 *index = (const u32 *)AT(2);
    FOR_ALL(i, a.n[0] * a.n[1]) {
        int r = i / a.n[1], j = i % a.n[1];
        float *from = x + (int)index[r] * a.n[2] + j, *to = y + r * a.n[3] + j;
        if (a.n[4]) *from += *to;
        else *to = *from;
    }
}

// x = 0. p: x. n: rows, width, stride.
KERNEL(zero) {
    float *x = (float *)AT(0);
    FOR_ALL(i, a.n[0] * a.n[1]) x[i / a.n[1] * a.n[2] + i % a.n[1]] = 0.0f;
}

// y = tanh(x), and dx += dy (1 - y^2) where n[1]. p: x, y; backward y, dy, dx. n: count, backward.
KERNEL(tanh_of) {
    if (a.n[1]) {
        const float *y = (const float *)AT(0), *dy = (const float *)AT(1);
        float *dx = (float *)AT(2);
        FOR_ALL(i, a.n[0]) dx[i] += dy[i] * (1.0f - y[i] * y[i]);
    } else {
        const float *x = (const float *)AT(0);
        float *y = (float *)AT(1);
        FOR_ALL(i, a.n[0]) y[i] = tanhf(x[i]);
    }
}

// The carried state of a step, z and h: `initial` [1, width] where an episode begins, else `carried`; without `carried` (the first step of a
// sequence) `initial` everywhere. p: first (u32) [rows], initial z, h, carried z, h, y of z, of h. n: rows, width of z, of h, stride of
// carried z, of carried h, of y of z, of h.
KERNEL(carry) {
    const u32 *first = (const u32 *)AT(0);
    u32 width = (u32)(a.n[1] + a.n[2]);
    FOR_ALL(i, a.n[0] * a.n[1] + a.n[0] * a.n[2]) {
        int r = (int)(i / width), j = (int)(i % width), of_h = j >= a.n[1];
        if (of_h) j -= a.n[1];
        const float *initial = (const float *)AT(1 + of_h), *carried = (const float *)OR_NULL(3 + of_h);
        float *y = (float *)AT(5 + of_h);
        int begins = !carried || first[r];
        y[r * a.n[5 + of_h] + j] = begins ? initial[j] : carried[r * a.n[3 + of_h] + j];
    }
}

// p: first, d_initial of z, of h (added to), d_carried of z, of h (added to), dy of z, of h. n as `carry`, of the gradients. 32 columns a turn.
KERNEL(carry_backward) {
    const u32 *first = (const u32 *)AT(0);
    int of_z = (a.n[1] + 31) / 32, turns = of_z + (a.n[2] + 31) / 32;
    for (int turn = BLOCK; turn < turns; turn += BLOCKS) {
        int of_h = turn >= of_z, width = a.n[1 + of_h], d_stride = a.n[3 + of_h], stride = a.n[5 + of_h];
        float *d_initial = (float *)AT(1 + of_h), *d_carried = (float *)OR_NULL(3 + of_h);
        const float *dy = (const float *)AT(5 + of_h);
        for (int lane = LANE; lane < 32; lane += LANES) {
            int j = (of_h ? turn - of_z : turn) * 32 + lane;
            float sum = 0.0f;
            if (j < width) {
                for (int r = WARP; r < a.n[0]; r += WARPS) {
                    float d = dy[r * stride + j];
                    if (!d_carried || first[r]) sum += d;
                    else d_carried[r * d_stride + j] += d;
                }
            }
            sum = across_warps(sum);
            if (WARP == 0 && j < width) d_initial[j] += sum;
        }
    }
}

// y [width, rows] = x^T, 32 by 32 numbers a turn. p: x, y. n: rows, width, stride of x.
KERNEL(transpose) {
    const float *x = (const float *)AT(0);
    float *y = (float *)AT(1);
    int rows = a.n[0], width = a.n[1], across = (width + 31) / 32, turns = across * ((rows + 31) / 32);
    for (int turn = BLOCK; turn < turns; turn += BLOCKS) {
        int from = turn / across * 32, left = turn % across * 32;
#ifdef __CUDACC__
        __shared__ float part[32][33];
        for (int r = WARP; r < 32; r += WARPS)
            if (from + r < rows && left + LANE < width) part[r][LANE] = x[(from + r) * a.n[2] + left + LANE];
        __syncthreads();
        for (int j = WARP; j < 32; j += WARPS)
            if (left + j < width && from + LANE < rows) y[(left + j) * rows + from + LANE] = part[LANE][j];
        __syncthreads();
#else
        for (int r = from; r < from + 32 && r < rows; r++)
            for (int j = left; j < left + 32 && j < width; j++) y[j * rows + r] = x[r * a.n[2] + j];
#endif
    }
}

// out = factor * sum of x [count], each number raised to `floor` where n[1], by one block. p: x, out. n: count, floored. f: factor, floor.
KERNEL(sum_of) {
    const float *x = (const float *)AT(0);
    float sum = 0.0f;
    for (int i = THREAD; i < a.n[0]; i += THREADS) sum += a.n[1] ? fmaxf(x[i], a.f[1]) : x[i];
    sum = block_sum(sum);
    if (THREAD == 0) *(float *)AT(1) = a.f[0] * sum;
}

#define ROTATED(x, by) (((x) << (by)) | ((x) >> (32 - (by))))
#define QUARTER(i, j, k, l)                                                                                  \
    x[i] += x[j]; x[l] = ROTATED(x[l] ^ x[i], 16); x[k] += x[l]; x[j] = ROTATED(x[j] ^ x[k], 12);            \
    x[i] += x[j]; x[l] = ROTATED(x[l] ^ x[i], 8); x[k] += x[l]; x[j] = ROTATED(x[j] ^ x[k], 7);

// A number between 0 and 1, both excluded, from the upper 23 bits of a word.
DEVICE float uniform_of(u32 word) { return ((float)(word >> 9) + 0.5f) * (1.0f / 8388608.0f); }

// Noise out of the ChaCha8 stream that the CPU draws from: words of `key` and `stream`, from word n[2] on. Gumbel, one number a word:
// -log(-log u); or normal (n[1]), one from two words (Box and Muller). The words are the CPU's; logarithms may round otherwise.
// p: control (u32: key 8, stream 2), out. n: count, normal, first word (even) as quotient and remainder of 2^24.
KERNEL(noise) {
    const u32 *control = (const u32 *)AT(0);
    float *out = (float *)AT(1);
    long words = (long)a.n[0] * (a.n[1] ? 2 : 1), from = ((long)a.n[2] << 24) + a.n[3];
    int blocks = (int)((from + words + 15) / 16 - from / 16);
    FOR_ALL(i, blocks) {
        unsigned long counter = (unsigned long)(from / 16) + i;
        u32 x[16], start[16];
        start[0] = 0x61707865; start[1] = 0x3320646e; start[2] = 0x79622d32; start[3] = 0x6b206574;
        for (int j = 0; j < 8; j++) start[4 + j] = control[j];
        start[12] = (u32)counter; start[13] = (u32)(counter >> 32);
        start[14] = control[8]; start[15] = control[9];
        for (int j = 0; j < 16; j++) x[j] = start[j];
        for (int round = 0; round < 4; round++) {
            QUARTER(0, 4, 8, 12) QUARTER(1, 5, 9, 13) QUARTER(2, 6, 10, 14) QUARTER(3, 7, 11, 15)
            QUARTER(0, 5, 10, 15) QUARTER(1, 6, 11, 12) QUARTER(2, 7, 8, 13) QUARTER(3, 4, 9, 14)
        }
        for (int j = 0; j < 16; j++) x[j] += start[j];
        long word = (long)counter * 16 - from;
        if (a.n[1]) {
            for (int j = 0; j < 16; j += 2) {
                if (word + j < 0 || word + j >= words) continue;
                float radius = sqrtf(-2.0f * logf(uniform_of(x[j])));
                out[(word + j) / 2] = radius * cosf(6.28318530717958647692f * uniform_of(x[j + 1]));
            }
        } else {
            for (int j = 0; j < 16; j++)
                if (word + j >= 0 && word + j < words) out[word + j] = -logf(-logf(uniform_of(x[j])));
        }
    }
}
