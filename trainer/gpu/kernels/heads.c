#include "common.h"

// log of the sum of exponentials of a row, and its largest entry, by a warp.
typedef struct {
    float largest, sum;
} Row;

DEVICE Row row_of(const float *x, int width, int lane, int lanes) {
    Row s;
    float largest = -INFINITY, sum = 0.0f;
    for (int j = lane; j < width; j += lanes) largest = fmaxf(largest, x[j]);
    s.largest = warp_max(largest);
    for (int j = lane; j < width; j += lanes) sum += expf(x[j] - s.largest);
    s.sum = warp_sum(sum);
    return s;
}

// Cross-entropy of logits [rows, bins] with the two-hot distribution of symlog(value), times weight [rows] (null: 1), with its gradient
// (factor * weight * (softmax - target)), added to loss and gradient where n[3].
// p: logits, value, weight, bins, loss, d_logits. n: rows, bins, stride of value, add. f: factor.
KERNEL(two_hot_loss) {
    const float *logits = (const float *)AT(0), *values = (const float *)AT(1), *weights = (const float *)OR_NULL(2);
    const float *bins = (const float *)AT(3);
    float *loss = (float *)AT(4), *dx = (float *)AT(5);
    int width = a.n[1];
    float spacing = bins[1] - bins[0];
    Team t = team(0);
    for (int r = t.first; r < a.n[0]; r += t.step) {
        const float *x = logits + r * width;
        float target = fminf(fmaxf(symlog_of(values[r * a.n[2]]), bins[0]), bins[width - 1]), weight = weights ? weights[r] : 1.0f;
        Row s = row_of(x, width, t.lane, t.lanes);
        float log_sum = logf(s.sum) + s.largest, found = 0.0f;
        for (int j = t.lane; j < width; j += t.lanes) {
            float hot = fmaxf(0.0f, 1.0f - fabsf(target - bins[j]) / spacing);
            found += hot * (log_sum - x[j]);
            put(dx + r * width + j, a.n[3], a.f[0] * weight * (expf(x[j] - s.largest) / s.sum - hot));
        }
        found = warp_sum(found);
        if (t.lane == 0) put(loss + r, a.n[3], weight * found);
    }
}

// Mean of the distribution over bins as a value, symexp(sum p_j bins_j), summed in pairs around the middle; or its gradient (n[2]).
// p: logits, bins, value [rows]; backward also d_value, d_logits. n: rows, bins, backward.
KERNEL(two_hot_mean) {
    const float *logits = (const float *)AT(0), *bins = (const float *)AT(1), *d_value = (const float *)AT(3);
    float *value = (float *)AT(2), *dx = (float *)AT(4);
    int width = a.n[1], half = width / 2;
    Team t = team(0);
    for (int r = t.first; r < a.n[0]; r += t.step) {
        const float *x = logits + r * width;
        Row s = row_of(x, width, t.lane, t.lanes);
        float mean = 0.0f;
        for (int j = t.lane; j < half; j += t.lanes) {
            float above = expf(x[half + 1 + j] - s.largest), below = expf(x[half - 1 - j] - s.largest);
            mean += (above - below) / s.sum * bins[half + 1 + j];
        }
        mean = warp_sum(mean);
        if (a.n[2]) {
            float d = d_value[r] * expf(fabsf(mean));
            for (int j = t.lane; j < width; j += t.lanes)
                dx[r * width + j] = d * expf(x[j] - s.largest) / s.sum * (bins[j] - mean);
        } else if (t.lane == 0) {
            value[r] = symexp_of(mean);
        }
    }
}

// Binary cross-entropy of logits against going on where not `terminal`, with its gradient. p: logits, terminal, loss, d_logits. n: rows.
// f: factor of the gradient.
KERNEL(continue_loss) {
    const float *logits = (const float *)AT(0), *terminal = (const float *)AT(1);
    FOR_ALL(r, a.n[0]) {
        float x = logits[r], goes_on = 1.0f - terminal[r];
        // log(1 + exp(x)) - goes_on x
        ((float *)AT(2))[r] = fmaxf(x, 0.0f) + log1pf(expf(-fabsf(x))) - goes_on * x;
        ((float *)AT(3))[r] = a.f[0] * (sigmoid_of(x) - goes_on);
    }
}

// factor * sigmoid(x), or its gradient (n[1]). p: x, y; backward x, dy, dx. n: count, backward. f: factor.
KERNEL(scaled_sigmoid) {
    const float *x = (const float *)AT(0);
    FOR_ALL(i, a.n[0]) {
        float s = sigmoid_of(x[i]);
        if (a.n[1]) ((float *)AT(2))[i] = ((const float *)AT(1))[i] * a.f[0] * s * (1.0f - s);
        else ((float *)AT(1))[i] = a.f[0] * s;
    }
}

// The actor's distribution, a sample divided back into [-1, 1], and the entropy: mean = tanh(.), std = 0.9 sigmoid(. + 2) + 0.1.
// p: out [rows, 2 actions], normal noise [rows, actions] (null: the mean), action (stride n[2]), entropy [rows].
// n: rows, actions, stride of action, T, B: noise of row t * B + b is that of b * T + t (T 0: as it is).
KERNEL(actor_draw) {
    const float *out = (const float *)AT(0), *noise = (const float *)OR_NULL(1);
    FOR_ALL(r, a.n[0]) {
        float entropy = 0.0f;
        int from = a.n[3] > 0 ? r % a.n[4] * a.n[3] + r / a.n[4] : r;
        for (int j = 0; j < a.n[1]; j++) {
            float mean = tanhf(out[2 * r * a.n[1] + j]);
            float std = 0.9f * sigmoid_of(out[(2 * r + 1) * a.n[1] + j] + 2.0f) + 0.1f;
            float action = noise ? mean + std * noise[from * a.n[1] + j] : mean;
            ((float *)AT(2))[r * a.n[2] + j] = action / fmaxf(1.0f, fabsf(action));
            entropy += logf(std) + 1.41893853320467274178f;
        }
        ((float *)AT(3))[r] = entropy;
    }
}

// The distance of the actor's distribution from actions that were demonstrated, with its gradient: squared error of the mean, or the negative
// log-likelihood in nats where n[2]. p: out [rows, 2 actions], demonstrated [rows, actions], weight [rows], loss [rows] (weighted), d_out.
// n: rows, actions, likelihood. f: factor of the gradient.
KERNEL(cloning_loss) {
    const float *out = (const float *)AT(0), *wanted = (const float *)AT(1), *weight = (const float *)AT(2);
    float *loss = (float *)AT(3), *dx = (float *)AT(4);
    FOR_ALL(r, a.n[0]) {
        float sum = 0.0f, factor = a.f[0] * weight[r];
        for (int j = 0; j < a.n[1]; j++) {
            float mean = tanhf(out[2 * r * a.n[1] + j]), error = mean - wanted[r * a.n[1] + j], d_mean, d_spread = 0.0f;
            if (a.n[2]) {
                float s = sigmoid_of(out[(2 * r + 1) * a.n[1] + j] + 2.0f), std = 0.9f * s + 0.1f, scaled = error / std;
                sum += 0.5f * scaled * scaled + 0.91893853320467274178f + logf(std);
                d_mean = scaled / std;
                d_spread = (1.0f - scaled * scaled) / std * 0.9f * s * (1.0f - s);
            } else {
                sum += error * error;
                d_mean = 2.0f * error;
            }
            dx[2 * r * a.n[1] + j] = factor * d_mean * (1.0f - mean * mean);
            dx[(2 * r + 1) * a.n[1] + j] = factor * d_spread;
        }
        loss[r] = weight[r] * sum;
    }
}

// p: out, noise, d_action (stride n[2]), d_entropy [rows], d_out (written). n as above. The divisor gets no gradient.
KERNEL(actor_backward) {
    const float *out = (const float *)AT(0), *noise = (const float *)OR_NULL(1), *d_action = (const float *)AT(2);
    const float *d_entropy = (const float *)AT(3);
    float *dx = (float *)AT(4);
    FOR_ALL(r, a.n[0]) {
        int from = a.n[3] > 0 ? r % a.n[4] * a.n[3] + r / a.n[4] : r;
        for (int j = 0; j < a.n[1]; j++) {
            float mean = tanhf(out[2 * r * a.n[1] + j]), s = sigmoid_of(out[(2 * r + 1) * a.n[1] + j] + 2.0f), std = 0.9f * s + 0.1f;
            float drawn = noise ? noise[from * a.n[1] + j] : 0.0f, action = mean + std * drawn;
            float d = d_action[r * a.n[2] + j] / fmaxf(1.0f, fabsf(action));
            dx[2 * r * a.n[1] + j] = d * (1.0f - mean * mean);
            dx[(2 * r + 1) * a.n[1] + j] = (d * drawn + d_entropy[r] / std) * 0.9f * s * (1.0f - s);
        }
    }
}

// Lambda returns (eq. 10) and step weights of N imaginations of L states, a thread each.
// p: reward [L, N], value [L, N], discount [L, N], returns [L-1, N], weights [L, N]. n: L, N. f: lambda.
KERNEL(lambda_returns) {
    const float *reward = (const float *)AT(0), *value = (const float *)AT(1), *discount = (const float *)AT(2);
    float *returns = (float *)AT(3), *weights = (float *)AT(4);
    int length = a.n[0], rows = a.n[1];
    FOR_ALL(i, rows) {
        float next = value[(length - 1) * rows + i], weight = 1.0f;
        for (int t = length - 1; t >= 1; t--) {
            float beyond = value[t * rows + i] * (1.0f - a.f[0]) + next * a.f[0];
            next = reward[t * rows + i] + discount[t * rows + i] * beyond;
            returns[(t - 1) * rows + i] = next;
        }
        for (int t = 0; t < length; t++) {
            weights[t * rows + i] = weight;
            weight *= discount[t * rows + i];
        }
    }
}

// The actor's loss (eq. 11) and its gradients, which pass through returns, values and discounts but not through the weights.
// p: reward, value, discount, returns, weights, entropy [L-1, N], range [low, high], loss [L-1, N], d_reward, d_value, d_discount [L, N],
// d_entropy [L-1, N]. n: L, N. f: lambda, eta, 1 / ((L-1) N).
KERNEL(actor_loss) {
    const float *value = (const float *)AT(1), *discount = (const float *)AT(2), *returns = (const float *)AT(3);
    const float *weights = (const float *)AT(4), *entropy = (const float *)AT(5), *range = (const float *)AT(6);
    float *loss = (float *)AT(7), *d_reward = (float *)AT(8), *d_value = (float *)AT(9), *d_discount = (float *)AT(10);
    float *d_entropy = (float *)AT(11);
    int length = a.n[0], rows = a.n[1];
    float lambda = a.f[0], scale = fmaxf(1.0f, range[1] - range[0]);
    FOR_ALL(i, rows) {
        float carried = 0.0f;  // gradient of the return at t - 1 by way of those before it
        d_reward[i] = 0.0f;
        d_discount[i] = 0.0f;
        d_value[i] = 0.0f;
        for (int t = 1; t < length; t++) {
            int here = t * rows + i, before = here - rows;
            float weight = weights[before] * a.f[2];
            loss[before] = -weights[before] * ((returns[before] - value[before]) / scale + a.f[1] * entropy[before]);
            d_entropy[before] = -weight * a.f[1];
            d_value[before] += weight / scale;
            float d = carried - weight / scale;  // of returns[t - 1]
            float next = t + 1 < length ? returns[here] : value[here];
            d_reward[here] = d;
            d_discount[here] = d * (value[here] * (1.0f - lambda) + next * lambda);
            d_value[here] = d * discount[here] * (1.0f - lambda);
            carried = d * discount[here] * lambda;
        }
        d_value[(length - 1) * rows + i] += carried;
    }
}

#ifdef __CUDACC__
#define ORDERED(x) (__float_as_uint(x) & 0x80000000u ? ~__float_as_uint(x) : __float_as_uint(x) | 0x80000000u)
#define UNORDERED(u) __uint_as_float((u) & 0x80000000u ? (u) ^ 0x80000000u : ~(u))
#else
#include <string.h>
static inline u32 ORDERED(float x) {
    u32 u;
    memcpy(&u, &x, 4);
    return u & 0x80000000u ? ~u : u | 0x80000000u;
}
static inline float UNORDERED(u32 u) {
    u = u & 0x80000000u ? u ^ 0x80000000u : ~u;
    float x;
    memcpy(&x, &u, 4);
    return x;
}
#endif

// Takes two quantiles of x into a running range, by one block: range = (1 - share) range + share quantile. Between neighbours it is linear.
// p: x, range [low, high], whether this run takes part. n: count. f: low, high, share.
KERNEL(return_range) {
    const float *x = (const float *)AT(0);
    float *range = (float *)AT(1);
    for (int which = 0; which < 2; which++) {
        double place = (double)a.f[which] * (double)(a.n[0] - 1);
        int below = (int)place;
        // The number at place `below` of the sorted ones: the largest u such that fewer than below + 1 numbers lie under it, bit by bit.
        u32 found = 0;
        for (int bit = 31; bit >= 0; bit--) {
            u32 tried = found | 1u << bit;
            float count = 0.0f;  // exact up to 2^24 numbers
            for (int i = THREAD; i < a.n[0]; i += THREADS) count += ORDERED(x[i]) < tried ? 1.0f : 0.0f;
            if ((int)block_sum(count) <= below) found = tried;
        }
        float low = UNORDERED(found), upto = 0.0f, next = INFINITY;
        for (int i = THREAD; i < a.n[0]; i += THREADS) {
            upto += ORDERED(x[i]) <= found ? 1.0f : 0.0f;
            if (ORDERED(x[i]) > found) next = fminf(next, x[i]);
        }
        upto = block_sum(upto);
        next = -warp_max(-next);
#ifdef __CUDACC__
        __shared__ float smallest[32];
        __syncthreads();
        if (LANE == 0) smallest[WARP] = next;
        __syncthreads();
        next = -warp_max(LANE < WARPS ? -smallest[LANE] : -INFINITY);
#endif
        float high = (int)upto > below + 1 || below + 1 >= a.n[0] ? low : next;
        float quantile = low + (high - low) * (float)(place - (double)below);
        if (THREAD == 0 && *(const u32 *)AT(2)) range[which] = (1.0f - a.f[2]) * range[which] + a.f[2] * quantile;
    }
}
