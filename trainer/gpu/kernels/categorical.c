#include "common.h"

// Softmax of the classes of one categorical by a warp: the largest logit and the sum of exponentials.
typedef struct {
    float largest, sum;
} Softmax;

DEVICE Softmax softmax_of(const float *x, int classes, int lane, int lanes) {
    Softmax s;
    float largest = x[lane < classes ? lane : 0], sum = 0.0f;
NO_UNROLL
    for (int j = lane; j < classes; j += lanes) largest = fmaxf(largest, x[j]);
    s.largest = warp_max(largest);
NO_UNROLL
    for (int j = lane; j < classes; j += lanes) sum += expf(x[j] - s.largest);
    s.sum = warp_sum(sum);
    return s;
}

// One-hot draws from categoricals: argmax of log p + noise, p with its uniform share; without noise (p[1] null) the mode.
// p: logits, gumbel, z. n: rows, categoricals, classes, stride of logits, of z, T, B: noise of row t * B + b is that of b * T + t. f: unimix.
KERNEL(draw) {
    const float *logits = (const float *)AT(0), *gumbel = (const float *)OR_NULL(1);
    float *z = (float *)AT(2);
    int n = a.n[1], m = a.n[2];
    Team t = team(0);
    for (int g = t.first; g < a.n[0] * n; g += t.step) {
        int row = g / n, at = g % n * m;
        const float *x = logits + row * a.n[3] + at;
        int from = a.n[5] > 0 ? row % a.n[6] * a.n[5] + row / a.n[6] : row;
        const float *noise = gumbel ? gumbel + from * n * m + at : 0;
        Softmax s = softmax_of(x, m, t.lane, t.lanes);
        float best = -INFINITY;
        int index = 0x7fffffff;
NO_UNROLL
        for (int j = t.lane; j < m; j += t.lanes) {
            float p = (1.0f - a.f[0]) * (expf(x[j] - s.largest) / s.sum) + a.f[0] / (float)m;
            float score = noise ? logf(p) + noise[j] : p;
            if (score > best) {
                best = score;
                index = (int)j;
            }
        }
        index = warp_best(best, index);
NO_UNROLL
        for (int j = t.lane; j < m; j += t.lanes) z[row * a.n[4] + at + j] = j == index ? 1.0f : 0.0f;
    }
}

// The straight-through gradient: dz reaches p (of a draw), or log p (of a mode, n[6]).
// p: logits, dz, d_logits. n: rows, categoricals, classes, stride of logits, of dz, of d_logits, of a mode, add. f: unimix.
KERNEL(draw_backward) {
    const float *logits = (const float *)AT(0), *dz = (const float *)AT(1);
    float *dx = (float *)AT(2);
    int n = a.n[1], m = a.n[2];
    Team t = team(0);
    for (int g = t.first; g < a.n[0] * n; g += t.step) {
        int row = g / n, at = g % n * m;
        const float *x = logits + row * a.n[3] + at, *d = dz + row * a.n[4] + at;
        Softmax s = softmax_of(x, m, t.lane, t.lanes);
        float sum = 0.0f;
NO_UNROLL
        for (int j = t.lane; j < m; j += t.lanes) {
            float y = expf(x[j] - s.largest) / s.sum, p = (1.0f - a.f[0]) * y + a.f[0] / (float)m;
            sum += y * (a.n[6] ? d[j] / p : d[j]);
        }
        sum = warp_sum(sum);
NO_UNROLL
        for (int j = t.lane; j < m; j += t.lanes) {
            float y = expf(x[j] - s.largest) / s.sum, p = (1.0f - a.f[0]) * y + a.f[0] / (float)m;
            put(dx + row * a.n[5] + at + j, a.n[7], (1.0f - a.f[0]) * y * ((a.n[6] ? d[j] / p : d[j]) - sum));
        }
    }
}

// KL[q || p] summed over the categoricals of a row, clipped from below and differentiated both ways (eq. 3):
// d_p = prior_scale dKL/dp where KL >= free, d_q = posterior_scale dKL/dq likewise, each times `weight`.
// p: q logits, p logits, kl [rows], d_q, d_p. n: rows, categoricals, classes, stride of q, of p, of d_q, of d_p.
// f: unimix, free, prior_scale * weight, posterior_scale * weight.
KERNEL(balanced_kl) {
    const float *q = (const float *)AT(0), *p = (const float *)AT(1);
    float *kl = (float *)AT(2), *dq = (float *)AT(3), *dp = (float *)AT(4);
    int n = a.n[1], m = a.n[2];
    float share = 1.0f - a.f[0], mixed = a.f[0] / (float)m;
    Team t = team(0);
    for (int r = t.first; r < a.n[0]; r += t.step) {
        float total = 0.0f;
        for (int pass = 0; pass < 2; pass++) {
            float counts = total >= a.f[1] ? 1.0f : 0.0f, found = 0.0f;
            for (int g = 0; g < n; g++) {
                const float *x = q + r * a.n[3] + g * m, *y = p + r * a.n[4] + g * m;
                Softmax sq = softmax_of(x, m, t.lane, t.lanes), sp = softmax_of(y, m, t.lane, t.lanes);
                float mean_q = 0.0f, mean_p = 0.0f;
                for (int j = t.lane; j < m; j += t.lanes) {
                    float eq = expf(x[j] - sq.largest) / sq.sum, ep = expf(y[j] - sp.largest) / sp.sum;
                    float cq = share * eq + mixed, cp = share * ep + mixed, ratio = logf(cq) - logf(cp);
                    if (pass == 0) found += cq * ratio;
                    mean_q += eq * (ratio + 1.0f);
                    mean_p += ep * (cq / cp);
                }
                if (pass == 0) continue;
                mean_q = warp_sum(mean_q);
                mean_p = warp_sum(mean_p);
                for (int j = t.lane; j < m; j += t.lanes) {
                    float eq = expf(x[j] - sq.largest) / sq.sum, ep = expf(y[j] - sp.largest) / sp.sum;
                    float cq = share * eq + mixed, cp = share * ep + mixed, ratio = logf(cq) - logf(cp);
                    dq[r * a.n[5] + g * m + j] = counts * a.f[3] * share * eq * (ratio + 1.0f - mean_q);
                    dp[r * a.n[6] + g * m + j] = counts * a.f[2] * share * ep * (mean_p - cq / cp);
                }
            }
            if (pass == 0) total = warp_sum(found);
        }
        if (t.lane == 0) kl[r] = total;
    }
}
