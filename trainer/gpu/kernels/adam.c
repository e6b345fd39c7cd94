#include "common.h"

// Sums of squares over runs of n[1] numbers, one a block: partial [blocks]. p: x, partial. n: count, run.
KERNEL(squares) {
    const float *x = (const float *)AT(0);
    int from = BLOCK * a.n[1], to = from + a.n[1] < a.n[0] ? from + a.n[1] : a.n[0];
    float sum = 0.0f;
    for (int i = from + THREAD; i < to; i += THREADS) sum += x[i] * x[i];
    sum = block_sum(sum);
    if (THREAD == 0) ((float *)AT(1))[BLOCK] = sum;
}

// The norm of the gradients and what they are multiplied with (0 where anything is not finite: nothing moves then).
// p: partial, scalars of the losses, out [norm, factor], whether this run takes part. n: partials, scalars. f: largest norm.
KERNEL(clip) {
    const float *partial = (const float *)AT(0), *scalars = (const float *)AT(1);
    float *out = (float *)AT(2);
    float sum = 0.0f;
    for (int i = THREAD; i < a.n[0]; i += THREADS) sum += partial[i];
    float norm = sqrtf(block_sum(sum)), finite = norm - norm;
    for (int i = 0; i < a.n[1]; i++) finite += scalars[i] - scalars[i];
    if (THREAD == 0) {
        out[0] = norm;
        out[1] = finite == 0.0f && *(const u32 *)AT(3) ? fminf(1.0f, a.f[0] / (norm + 1e-6f)) : 0.0f;
    }
}

// One step of Adam on all parameters of an optimiser: w -= rate * m / (1 - b1^t) / (sqrt(v / (1 - b2^t)) + eps).
// Each parameter begins at a multiple of 256, and `owner` says whose each run of 256 is.
// Nothing moves where the factor of any of the program's optimisers is 0.
// p: w, m, v, gradient, clip [norm, factor], owner (u32), table [parameters, 2] (rate / (1 - b1^t), 1 / (1 - b2^t)), average or null,
// keep [1], clips of all optimisers. n: count, optimisers. f: b1, b2, eps.
KERNEL(adam) {
    float *w = (float *)AT(0), *m = (float *)AT(1), *v = (float *)AT(2), *average = (float *)OR_NULL(7);
    const float *gradient = (const float *)AT(3), *clip = (const float *)AT(4), *table = (const float *)AT(6);
    const u32 *owner = (const u32 *)AT(5);
    float factor = clip[1];
    for (int i = 0; i < a.n[1]; i++)
        if (((const float *)AT(9))[2 * i + 1] == 0.0f) return;
    FOR_ALL(i, a.n[0]) {
        const float *rates = table + 2 * owner[i / 256];
        float g = gradient[i] * factor;
        float mean = a.f[0] * m[i] + (1.0f - a.f[0]) * g, square = a.f[1] * v[i] + (1.0f - a.f[1]) * g * g;
        m[i] = mean;
        v[i] = square;
        float now = w[i] - rates[0] * mean / (sqrtf(square * rates[1]) + a.f[2]);
        w[i] = now;
        if (average) {
            float keep = *(const float *)AT(8);
            average[i] = keep * average[i] + (1.0f - keep) * now;
        }
    }
}

// y += share * (x - y), as share * x + (1 - share) * y. p: x, y, whether this run takes part. n: count. f: share.
KERNEL(mix) {
    if (!*(const u32 *)AT(2)) return;
    const float *x = (const float *)AT(0);
    float *y = (float *)AT(1);
    FOR_ALL(i, a.n[0]) y[i] = a.f[0] * x[i] + (1.0f - a.f[0]) * y[i];
}
