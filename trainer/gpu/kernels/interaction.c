#include "common.h"

// out [rows, cols] = scale * (A B) + bias, or added to out, by a block, all of it in shared memory but the bias: A(i, k) = a[i ar + k ac], B(k, j) = b[k br + j bc]. Rows and depth are
// multiples of 4; a thread does four rows of a column. Arrays that are read as A have a pitch that is a multiple of 4, those that are read as B
// along k an odd one, which spreads them over the banks. Products that do not wait for each other begin at different threads (`TURNED`), so
// that those without work in one have some in the next.
typedef struct {
    const float *at;
    int row, column;
} View;

DEVICE_CALL void tile(View a, View b, const float *bias, float scale, float *out, int pitch, int add, int rows, int cols, int depth,
                      int thread, int threads) {
    IN_SHARED(a.at);
    IN_SHARED(b.at);
    IN_SHARED(out);
NO_UNROLL
    for (int item = thread; item < rows / 4 * cols; item += threads) {
        int j = item % cols, i = item / cols * 4;
        const float *x = a.at + i * a.row, *y = b.at + j * b.column;
        float s0 = 0.0f, s1 = 0.0f, s2 = 0.0f, s3 = 0.0f;
        if (a.column == 1) {
UNROLL_TWICE
            for (int k = 0; k < depth; k += 4) {
                Four x0 = *(const Four *)(x + k), x1 = *(const Four *)(x + a.row + k);
                Four x2 = *(const Four *)(x + 2 * a.row + k), x3 = *(const Four *)(x + 3 * a.row + k);
                float y0 = y[k * b.row], y1 = y[(k + 1) * b.row], y2 = y[(k + 2) * b.row], y3 = y[(k + 3) * b.row];
                s0 += x0.x * y0 + x0.y * y1 + x0.z * y2 + x0.w * y3;
                s1 += x1.x * y0 + x1.y * y1 + x1.z * y2 + x1.w * y3;
                s2 += x2.x * y0 + x2.y * y1 + x2.z * y2 + x2.w * y3;
                s3 += x3.x * y0 + x3.y * y1 + x3.z * y2 + x3.w * y3;
            }
        } else {
            // Rows follow each other: four at once.
UNROLL_TWICE
            for (int k = 0; k < depth; k++) {
                Four xk = *(const Four *)(x + k * a.column);
                float yk = y[k * b.row];
                s0 += xk.x * yk;
                s1 += xk.y * yk;
                s2 += xk.z * yk;
                s3 += xk.w * yk;
            }
        }
        float shift = bias ? bias[j] : 0.0f, *to = out + i * pitch + j;
        put(to, add, scale * s0 + shift);
        put(to + pitch, add, scale * s1 + shift);
        put(to + 2 * pitch, add, scale * s2 + shift);
        put(to + 3 * pitch, add, scale * s3 + shift);
    }
}

// Shared memory of forward and backward. Pitches: `even` of what is read as A along k, `odd` of what is read as B along k, `across` of maps.
typedef struct {
    int n, r, m, even, odd, across;
    float *wq, *wk, *wv, *wo, *z, *u, *q, *k, *v, *map, *mix, *end;
} Work;

DEVICE Work layout(float *at, int n, int r, int m) {
    Work s;
    s.n = n; s.r = r; s.m = m;
    s.even = m + 4; s.odd = m + 1; s.across = r + 4;
    s.z = at; s.u = s.z + n * s.even; s.q = s.u + r * s.even; s.mix = s.q + n * s.even; s.map = s.mix + n * s.even;
    s.wq = s.map + n * s.across;
    s.wk = s.wq + m * s.odd; s.wv = s.wk + m * s.odd; s.wo = s.wv + m * s.odd;
    s.k = s.wo + m * s.odd; s.v = s.k + r * s.odd;
    s.end = s.v + r * s.odd;
    s.end += (4 - (s.end - at) % 4) % 4;
    return s;
}

DEVICE View view(const float *at, int row, int column) {
    View v = {at, row, column};
    return v;
}

// This thread's number where the first `taken` threads have work already.
#define TURNED(taken) ((thread + threads - (taken) % threads) % threads)

// The inputs of a row of the batch; weights once a block.
typedef struct {
    const float *z, *u, *wq, *bq, *wk, *bk, *wv, *bv, *wo, *bo;
} Inputs;

#define AT_ONCE 4

// z and u of a row of the batch, and the weights where `weights`, to shared memory: by four, and several loads of a thread under way.
DEVICE void load(Work s, Inputs in, int weights, int thread, int threads) {
    u32 m = (u32)s.m, fours = m / 4, rows = (u32)(s.n + s.r) + (weights ? 4 * m : 0), count = rows * fours;
    for (u32 base = (u32)thread; base < count; base += AT_ONCE * (u32)threads) {
        Four held[AT_ONCE];
        float *to[AT_ONCE];
UNROLL
        for (int c = 0; c < AT_ONCE; c++) {
            u32 i = base + (u32)(c * threads), y = i / fours, x = i % fours * 4, which;
            Four none = {0.0f, 0.0f, 0.0f, 0.0f};
            to[c] = 0;
            held[c] = none;
            if (i >= count) continue;
            const float *from;
            if (y < (u32)s.n) {
                from = in.z;
                to[c] = s.z + y * (u32)s.even;
            } else if ((y -= (u32)s.n) < (u32)s.r) {
                from = in.u;
                to[c] = s.u + y * (u32)s.even;
            } else {
                y -= (u32)s.r;
                which = y / m;
                y %= m;
                from = which < 2 ? which < 1 ? in.wq : in.wk : which < 3 ? in.wv : in.wo;
                to[c] = s.wq + (which * m + y) * (u32)s.odd;  // the weights follow each other
            }
            to[c] += x;
            held[c] = *(const Four *)(from + y * m + x);
        }
UNROLL
        for (int c = 0; c < AT_ONCE; c++) {
            if (!to[c]) continue;
            to[c][0] = held[c].x;
            to[c][1] = held[c].y;
            to[c][2] = held[c].z;
            to[c][3] = held[c].w;
        }
    }
}

// Projections, attention and mixture of one row of the batch.
DEVICE void attend(Work s, Inputs in, int thread, int threads) {
    int of_z = s.n / 4 * s.m, of_u = s.r / 4 * s.m;
    SYNC();
    tile(view(s.z, s.even, 1), view(s.wq, 1, s.odd), in.bq, 1.0f, s.q, s.even, 0, s.n, s.m, s.m, thread, threads);
    tile(view(s.u, s.even, 1), view(s.wk, 1, s.odd), in.bk, 1.0f, s.k, s.odd, 0, s.r, s.m, s.m, TURNED(of_z), threads);
    tile(view(s.u, s.even, 1), view(s.wv, 1, s.odd), in.bv, 1.0f, s.v, s.odd, 0, s.r, s.m, s.m, TURNED(of_z + of_u), threads);
    SYNC();
    tile(view(s.q, s.even, 1), view(s.k, 1, s.odd), 0, 1.0f / sqrtf((float)s.m), s.map, s.across, 0, s.n, s.r, s.m, thread, threads);
    SYNC();
    for (int row = thread / LANES; row < s.n; row += threads / LANES) {
        float *x = s.map + row * s.across, largest = -INFINITY, sum = 0.0f;
        for (int j = thread % LANES; j < s.r; j += LANES) largest = fmaxf(largest, x[j]);
        largest = warp_max(largest);
        for (int j = thread % LANES; j < s.r; j += LANES) sum += x[j] = expf(x[j] - largest);
        sum = warp_sum(sum);
        for (int j = thread % LANES; j < s.r; j += LANES) x[j] /= sum;
    }
    SYNC();
    tile(view(s.map, s.across, 1), view(s.v, s.odd, 1), 0, 1.0f, s.mix, s.even, 0, s.n, s.m, s.r, thread, threads);
    SYNC();
}

#define INPUTS(z_stride, u_stride)                                                                                             \
    {(const float *)AT(0) + row * (z_stride), (const float *)AT(1) + row * (u_stride), (const float *)AT(2), (const float *)AT(3), \
     (const float *)AT(4), (const float *)AT(5), (const float *)AT(6), (const float *)AT(7), (const float *)AT(8), (const float *)AT(9)}

// The interaction (eq. 7, A.2) of one row of the batch a block: e = LayerNorm(z + W_o softmax(q k^T / sqrt(m)) v + b_o).
// p: z [rows, n m], u [rows, (n+k) m], wq, bq, wk, bk, wv, bv, wo, bo, gain, shift, e, mix (or null), sum before the norm (or null), stats.
// n: rows, n, n+k, m, stride of z, of u, of e. f: eps.
KERNEL(interaction_forward) {
    SHARED(shared);
    Work s = layout(shared, a.n[1], a.n[2], a.n[3]);
    const float *gain = (const float *)AT(10), *shift = (const float *)AT(11);
    int thread = THREAD, threads = THREADS;
    for (int row = BLOCK; row < a.n[0]; row += BLOCKS) {
        Inputs in = INPUTS(a.n[4], a.n[5]);
        SYNC();
        load(s, in, row == BLOCK, thread, threads);
        attend(s, in, thread, threads);
        if (OR_NULL(13))
            for (int i = THREAD; i < s.n * s.m; i += THREADS)
                ((float *)AT(13))[row * s.n * s.m + i] = s.mix[i / s.m * s.even + i % s.m];
        // z becomes the sum before the norm.
        tile(view(s.mix, s.even, 1), view(s.wo, 1, s.odd), in.bo, 1.0f, s.z, s.even, 1, s.n, s.m, s.m, thread, threads);
        SYNC();
        for (int y = WARP; y < s.n; y += WARPS) {
            const float *x = s.z + y * s.even;
            float mean = 0.0f, squares = 0.0f;
            for (int j = LANE; j < s.m; j += LANES) mean += x[j];
            mean = warp_sum(mean) / (float)s.m;
            for (int j = LANE; j < s.m; j += LANES) squares += (x[j] - mean) * (x[j] - mean);
            float scale = 1.0f / sqrtf(warp_sum(squares) / (float)s.m + a.f[0]);
            for (int j = LANE; j < s.m; j += LANES) {
                if (OR_NULL(14)) ((float *)AT(14))[(row * s.n + y) * s.m + j] = x[j];
                ((float *)AT(12))[row * a.n[6] + y * s.m + j] = (x[j] - mean) * scale * gain[j] + shift[j];
            }
            if (LANE == 0) {
                float *stats = (float *)AT(15) + 2 * (row * s.n + y);
                stats[0] = mean;
                stats[1] = scale;
            }
        }
    }
}

// p: z, u, wq, bq, wk, bk, wv, bv, wo, bo, gain, stats, de, dz (added to), du (written), store (null where the weights are frozen).
// `store` [rows, 2 n m + 2 (n+k) m]: gradients of the sum before the norm and of q, then those of k and v; for the weights' gradients.
// n: rows, n, n+k, m, stride of z, of u, of de, of dz, of du, distance of q's, of k's and of v's part in `store`.
KERNEL(interaction_backward) {
    SHARED(shared);
    Work s = layout(shared, a.n[1], a.n[2], a.n[3]);
    int n = s.n, r = s.r, m = s.m, even = s.even;
    float *d_sum = s.end, *d_mix = d_sum + n * even, *d_map = d_mix + n * even, *dq = d_map + n * s.across;
    float *dk = dq + n * even, *dv = dk + r * even;
    const float *gain = (const float *)AT(10), *stats = (const float *)AT(11);
    int thread = THREAD, threads = THREADS;
    for (int row = BLOCK; row < a.n[0]; row += BLOCKS) {
        Inputs in = INPUTS(a.n[4], a.n[5]);
        SYNC();
        load(s, in, row == BLOCK, thread, threads);
        attend(s, in, thread, threads);
        const float *de = (const float *)AT(12) + row * a.n[6];
        float *dz = (float *)AT(13) + row * a.n[7], *du = (float *)AT(14) + row * a.n[8];
        // The sum before the norm, again.
        tile(view(s.mix, even, 1), view(s.wo, 1, s.odd), in.bo, 1.0f, d_mix, even, 0, n, m, m, thread, threads);
        SYNC();
        for (int y = WARP; y < n; y += WARPS) {
            float mean = stats[2 * (row * n + y)], scale = stats[2 * (row * n + y) + 1], sum = 0.0f, product = 0.0f;
            for (int j = LANE; j < m; j += LANES) {
                float normed = (s.z[y * even + j] + d_mix[y * even + j] - mean) * scale, d = de[y * m + j] * gain[j];
                sum += d;
                product += d * normed;
            }
            sum = warp_sum(sum) / (float)m;
            product = warp_sum(product) / (float)m;
            for (int j = LANE; j < m; j += LANES) {
                float normed = (s.z[y * even + j] + d_mix[y * even + j] - mean) * scale, d = de[y * m + j] * gain[j];
                d_sum[y * even + j] = scale * (d - sum - normed * product);
            }
        }
        SYNC();
        tile(view(d_sum, even, 1), view(s.wo, s.odd, 1), 0, 1.0f, d_mix, even, 0, n, m, m, thread, threads);
        SYNC();
        tile(view(d_mix, even, 1), view(s.v, 1, s.odd), 0, 1.0f, d_map, s.across, 0, n, r, m, thread, threads);
        tile(view(s.map, 1, s.across), view(d_mix, even, 1), 0, 1.0f, dv, even, 0, r, m, n, TURNED(n / 4 * r), threads);
        SYNC();
        float factor = 1.0f / sqrtf((float)m);
        for (int y = WARP; y < n; y += WARPS) {
            float sum = 0.0f, *d = d_map + y * s.across, *map = s.map + y * s.across;
            for (int j = LANE; j < r; j += LANES) sum += d[j] * map[j];
            sum = warp_sum(sum);
            for (int j = LANE; j < r; j += LANES) d[j] = map[j] * (d[j] - sum) * factor;
        }
        SYNC();
        tile(view(d_map, s.across, 1), view(s.k, s.odd, 1), 0, 1.0f, dq, even, 0, n, m, r, thread, threads);
        tile(view(d_map, 1, s.across), view(s.q, even, 1), 0, 1.0f, dk, even, 0, r, m, n, TURNED(n / 4 * m), threads);
        SYNC();
        tile(view(dq, even, 1), view(s.wq, s.odd, 1), 0, 1.0f, s.z, even, 0, n, m, m, thread, threads);
        tile(view(dk, even, 1), view(s.wk, s.odd, 1), 0, 1.0f, s.u, even, 0, r, m, m, TURNED(n / 4 * m), threads);
        SYNC();
        tile(view(dv, even, 1), view(s.wv, s.odd, 1), 0, 1.0f, s.u, even, 1, r, m, m, thread, threads);
        SYNC();
        for (int i = THREAD; i < n * m; i += THREADS) dz[i] += d_sum[i / m * even + i % m] + s.z[i / m * even + i % m];
        for (int i = THREAD; i < r * m; i += THREADS) du[i] = s.u[i / m * even + i % m];
        if (OR_NULL(15)) {
            float *store = (float *)AT(15);
            for (int i = THREAD; i < n * m; i += THREADS) {
                store[row * n * m + i] = d_sum[i / m * even + i % m];
                store[a.n[9] + row * n * m + i] = dq[i / m * even + i % m];
            }
            for (int i = THREAD; i < r * m; i += THREADS) {
                store[a.n[10] + row * r * m + i] = dk[i / m * even + i % m];
                store[a.n[11] + row * r * m + i] = dv[i / m * even + i % m];
            }
        }
    }
}
