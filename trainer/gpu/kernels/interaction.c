#include "common.h"

// y [rows, m] (stride `pitch`) = x [rows, m] w^T + b, by a block; `pitch` is m + 1, which spreads rows over the banks.
DEVICE void projected(const float *x, long pitch_x, const float *w, const float *b, float *y, long rows, long m, int THREAD_, int THREADS_) {
    for (long i = THREAD_; i < rows * m; i += THREADS_) {
        long r = i / m, j = i % m;
        float sum = b[j];
        for (long k = 0; k < m; k++) sum += x[r * pitch_x + k] * w[j * (m + 1) + k];
        y[r * (m + 1) + j] = sum;
    }
}

// What forward and backward have in common: weights and inputs into shared memory, projections, attention, mixture.
typedef struct {
    float *wq, *wk, *wv, *wo, *z, *u, *q, *k, *v, *map, *mix, *end;
} Work;

DEVICE Work layout(float *at, long n, long r, long m) {
    Work s;
    long w = m * (m + 1);
    s.wq = at; s.wk = s.wq + w; s.wv = s.wk + w; s.wo = s.wv + w;
    s.z = s.wo + w; s.u = s.z + n * (m + 1);
    s.q = s.u + r * (m + 1); s.k = s.q + n * (m + 1); s.v = s.k + r * (m + 1);
    s.map = s.v + r * (m + 1); s.mix = s.map + n * (r + 1); s.end = s.mix + n * (m + 1);
    return s;
}

DEVICE void spread(const float *from, float *to, long rows, long m, int THREAD_, int THREADS_) {
    for (long i = THREAD_; i < rows * m; i += THREADS_) to[i / m * (m + 1) + i % m] = from[i];
}

DEVICE void attend(Work s, const float *z, const float *u, const float *wq, const float *bq, const float *wk, const float *bk,
                   const float *wv, const float *bv, const float *wo, long n, long r, long m, int THREAD_, int THREADS_) {
    spread(wq, s.wq, m, m, THREAD_, THREADS_);
    spread(wk, s.wk, m, m, THREAD_, THREADS_);
    spread(wv, s.wv, m, m, THREAD_, THREADS_);
    spread(wo, s.wo, m, m, THREAD_, THREADS_);
    spread(z, s.z, n, m, THREAD_, THREADS_);
    spread(u, s.u, r, m, THREAD_, THREADS_);
    SYNC();
    projected(s.z, m + 1, s.wq, bq, s.q, n, m, THREAD_, THREADS_);
    projected(s.u, m + 1, s.wk, bk, s.k, r, m, THREAD_, THREADS_);
    projected(s.u, m + 1, s.wv, bv, s.v, r, m, THREAD_, THREADS_);
    SYNC();
    float scale = 1.0f / sqrtf((float)m);
    for (long i = THREAD_; i < n * r; i += THREADS_) {
        long row = i / r, j = i % r;
        float sum = 0.0f;
        for (long k = 0; k < m; k++) sum += s.q[row * (m + 1) + k] * s.k[j * (m + 1) + k];
        s.map[row * (r + 1) + j] = sum * scale;
    }
    SYNC();
    for (long row = THREAD_; row < n; row += THREADS_) {
        float *x = s.map + row * (r + 1), largest = x[0], sum = 0.0f;
        for (long j = 1; j < r; j++) largest = fmaxf(largest, x[j]);
        for (long j = 0; j < r; j++) sum += x[j] = expf(x[j] - largest);
        for (long j = 0; j < r; j++) x[j] /= sum;
    }
    SYNC();
    for (long i = THREAD_; i < n * m; i += THREADS_) {
        long row = i / m, j = i % m;
        float sum = 0.0f;
        for (long k = 0; k < r; k++) sum += s.map[row * (r + 1) + k] * s.v[k * (m + 1) + j];
        s.mix[row * (m + 1) + j] = sum;
    }
    SYNC();
}

// The interaction (eq. 7, A.2) of one row of the batch a block: e = LayerNorm(z + W_o softmax(q k^T / sqrt(m)) v + b_o).
// p: z [rows, n m], u [rows, (n+k) m], wq, bq, wk, bk, wv, bv, wo, bo, gain, shift, e, mix (or null), sum before the norm (or null), stats.
// n: rows, n, n+k, m, stride of z, of u, of e. f: eps.
KERNEL(interaction_forward) {
    SHARED(shared);
    long n = a.n[1], r = a.n[2], m = a.n[3];
    Work s = layout(shared, n, r, m);
    const float *bo = (const float *)a.p[9], *gain = (const float *)a.p[10], *shift = (const float *)a.p[11];
    for (long row = BLOCK; row < a.n[0]; row += BLOCKS) {
        SYNC();
        attend(s, (const float *)a.p[0] + row * a.n[4], (const float *)a.p[1] + row * a.n[5], (const float *)a.p[2],
               (const float *)a.p[3], (const float *)a.p[4], (const float *)a.p[5], (const float *)a.p[6],
               (const float *)a.p[7], (const float *)a.p[8], n, r, m, THREAD, THREADS);
        // The sum before the norm takes the place of q.
        for (long i = THREAD; i < n * m; i += THREADS) {
            long y = i / m, j = i % m;
            float sum = bo[j];
            for (long k = 0; k < m; k++) sum += s.mix[y * (m + 1) + k] * s.wo[j * (m + 1) + k];
            s.q[y * (m + 1) + j] = s.z[y * (m + 1) + j] + sum;
            if (a.p[13]) ((float *)a.p[13])[row * n * m + i] = s.mix[y * (m + 1) + j];
            if (a.p[14]) ((float *)a.p[14])[row * n * m + i] = s.q[y * (m + 1) + j];
        }
        SYNC();
        for (long y = THREAD; y < n; y += THREADS) {
            const float *x = s.q + y * (m + 1);
            float mean = 0.0f, squares = 0.0f;
            for (long j = 0; j < m; j++) mean += x[j];
            mean /= (float)m;
            for (long j = 0; j < m; j++) squares += (x[j] - mean) * (x[j] - mean);
            float *stats = (float *)a.p[15] + 2 * (row * n + y);
            stats[0] = mean;
            stats[1] = 1.0f / sqrtf(squares / (float)m + a.f[0]);
            s.map[y] = mean;
            s.map[n + y] = stats[1];
        }
        SYNC();
        for (long i = THREAD; i < n * m; i += THREADS) {
            long y = i / m, j = i % m;
            ((float *)a.p[12])[row * a.n[6] + i] = (s.q[y * (m + 1) + j] - s.map[y]) * s.map[n + y] * gain[j] + shift[j];
        }
    }
}

// p: z, u, wq, bq, wk, bk, wv, bv, wo, gain, stats, de, dz (added to), du (written), store (null where the weights are frozen), bo.
// `store` [rows, 2 n m + 2 (n+k) m]: gradients of the sum before the norm and of q, then those of k and v; for the weights' gradients.
// n: rows, n, n+k, m, stride of z, of u, of de, of dz, of du, distance of q's, of k's and of v's part in `store`.
KERNEL(interaction_backward) {
    SHARED(shared);
    long n = a.n[1], r = a.n[2], m = a.n[3], pitch = m + 1;
    Work s = layout(shared, n, r, m);
    float *d_sum = s.end, *d_mix = d_sum + n * pitch, *d_map = d_mix + n * pitch, *dq = d_map + n * (r + 1);
    float *dk = dq + n * pitch, *dv = dk + r * pitch;
    const float *gain = (const float *)a.p[9], *stats = (const float *)a.p[10], *bo = (const float *)a.p[15];
    float scale = 1.0f / sqrtf((float)m);
    for (long row = BLOCK; row < a.n[0]; row += BLOCKS) {
        SYNC();
        attend(s, (const float *)a.p[0] + row * a.n[4], (const float *)a.p[1] + row * a.n[5], (const float *)a.p[2],
               (const float *)a.p[3], (const float *)a.p[4], (const float *)a.p[5], (const float *)a.p[6],
               (const float *)a.p[7], (const float *)a.p[8], n, r, m, THREAD, THREADS);
        const float *de = (const float *)a.p[11] + row * a.n[6];
        float *dz = (float *)a.p[12] + row * a.n[7], *du = (float *)a.p[13] + row * a.n[8];
        for (long i = THREAD; i < n * m; i += THREADS) {
            long y = i / m, j = i % m;
            float sum = bo[j];
            for (long k = 0; k < m; k++) sum += s.mix[y * pitch + k] * s.wo[j * pitch + k];
            float before = s.z[y * pitch + j] + sum;
            d_mix[y * pitch + j] = (before - stats[2 * (row * n + y)]) * stats[2 * (row * n + y) + 1];  // normed, for now
            d_sum[y * pitch + j] = de[i] * gain[j];
        }
        SYNC();
        for (long y = THREAD; y < n; y += THREADS) {
            float sum = 0.0f, product = 0.0f, *d = d_sum + y * pitch, *normed = d_mix + y * pitch;
            for (long j = 0; j < m; j++) {
                sum += d[j];
                product += d[j] * normed[j];
            }
            for (long j = 0; j < m; j++)
                d[j] = stats[2 * (row * n + y) + 1] * (d[j] - sum / (float)m - normed[j] * product / (float)m);
        }
        SYNC();
        for (long i = THREAD; i < n * m; i += THREADS) {
            long y = i / m, j = i % m;
            float sum = 0.0f;
            for (long k = 0; k < m; k++) sum += d_sum[y * pitch + k] * s.wo[k * pitch + j];
            d_mix[y * pitch + j] = sum;
        }
        SYNC();
        for (long i = THREAD; i < n * r; i += THREADS) {
            long y = i / r, j = i % r;
            float sum = 0.0f;
            for (long k = 0; k < m; k++) sum += d_mix[y * pitch + k] * s.v[j * pitch + k];
            d_map[y * (r + 1) + j] = sum;
        }
        for (long i = THREAD; i < r * m; i += THREADS) {
            long y = i / m, j = i % m;
            float sum = 0.0f;
            for (long k = 0; k < n; k++) sum += s.map[k * (r + 1) + y] * d_mix[k * pitch + j];
            dv[y * pitch + j] = sum;
        }
        SYNC();
        for (long y = THREAD; y < n; y += THREADS) {
            float sum = 0.0f, *d = d_map + y * (r + 1), *map = s.map + y * (r + 1);
            for (long j = 0; j < r; j++) sum += d[j] * map[j];
            for (long j = 0; j < r; j++) d[j] = map[j] * (d[j] - sum) * scale;
        }
        SYNC();
        for (long i = THREAD; i < n * m; i += THREADS) {
            long y = i / m, j = i % m;
            float sum = 0.0f;
            for (long k = 0; k < r; k++) sum += d_map[y * (r + 1) + k] * s.k[k * pitch + j];
            dq[y * pitch + j] = sum;
        }
        for (long i = THREAD; i < r * m; i += THREADS) {
            long y = i / m, j = i % m;
            float sum = 0.0f;
            for (long k = 0; k < n; k++) sum += d_map[k * (r + 1) + y] * s.q[k * pitch + j];
            dk[y * pitch + j] = sum;
        }
        SYNC();
        for (long i = THREAD; i < n * m; i += THREADS) {
            long y = i / m, j = i % m;
            float sum = d_sum[y * pitch + j];
            for (long k = 0; k < m; k++) sum += dq[y * pitch + k] * s.wq[k * pitch + j];
            dz[i] += sum;
        }
        for (long i = THREAD; i < r * m; i += THREADS) {
            long y = i / m, j = i % m;
            float sum = 0.0f;
            for (long k = 0; k < m; k++)
                sum += dk[y * pitch + k] * s.wk[k * pitch + j] + dv[y * pitch + k] * s.wv[k * pitch + j];
            du[i] = sum;
        }
        if (a.p[14]) {
            float *store = (float *)a.p[14];
            for (long i = THREAD; i < n * m; i += THREADS) {
                store[row * n * m + i] = d_sum[i / m * pitch + i % m];
                store[a.n[9] + row * n * m + i] = dq[i / m * pitch + i % m];
            }
            for (long i = THREAD; i < r * m; i += THREADS) {
                store[a.n[10] + row * r * m + i] = dk[i / m * pitch + i % m];
                store[a.n[11] + row * r * m + i] = dv[i / m * pitch + i % m];
            }
        }
    }
}
