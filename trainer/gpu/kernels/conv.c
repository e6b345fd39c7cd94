#include "common.h"

// Convolutions of kernel 4, stride 2, padding 1 on maps [images, side, side, channels], as one matrix product with their windows.

// Windows [images (side/2)^2, 16 channels], (row, column, channel) of the kernel in this order. p: x, windows. n: images, side, channels.
// Counts must stay below 2^32: long batches are done in parts. Channels are read by four where they come by four.
KERNEL(windows) {
    u32 channels = (u32)a.n[2];
    if (channels % 4 == 0) {
        const Four *x = (const Four *)AT(0);
        Four *y = (Four *)AT(1);
        u32 side = (u32)a.n[1], half = side / 2, fours = channels / 4, width = 16 * fours;
        u32 at_once = THREADS > (int)width ? (u32)THREADS / width : 1;
        for (int group = BLOCK; (u32)group * at_once < (u32)a.n[0] * half * half; group += BLOCKS) {
            u32 place = (u32)group * at_once + (u32)THREAD / width, top, left;
            if (place >= a.n[0] * half * half || (u32)THREAD / width >= at_once) continue;
            top = 2 * (place / half % half);
            left = 2 * (place % half);
            int image = (int)(place / (half * half) * side);
            for (u32 k = (u32)THREAD % width; k < width; k += (u32)THREADS) {
                u32 tap = k / fours, row = top + tap / 4, column = left + tap % 4;
                Four value = {0.0f, 0.0f, 0.0f, 0.0f};
                if (row >= 1 && row <= side && column >= 1 && column <= side)
                    value = x[((image + row - 1) * side + column - 1) * fours + k % fours];
                y[(long)place * width + k] = value;
            }
        }
        return;
    }
    const float *x = (const float *)AT(0);
    float *y = (float *)AT(1);
    u32 side = (u32)a.n[1], half = side / 2;
    FOR_ALL(at, a.n[0] * half * half * 16) {
        u32 i = (u32)at, tap = i % 16, place = i / 16;
        u32 column = 2 * (place % half) + tap % 4, row = 2 * (place / half % half) + tap / 4;
        int inside = row >= 1 && row <= side && column >= 1 && column <= side;
        const float *from = x + (((long)(place / (half * half)) * side + row - 1) * side + column - 1) * channels;
        for (u32 c = 0; c < channels; c++) y[(long)i * channels + c] = inside ? from[c] : 0.0f;
    }
}

// The sum of windows over the places they were cut from: x [images, side, side, channels] of windows of its half-sized map.
// p: windows, x, bias [channels] or null. n: images, side, channels (a multiple of 4), add.
KERNEL(from_windows) {
    const Four *windows = (const Four *)AT(0), *bias = (const Four *)OR_NULL(2);
    Four *x = (Four *)AT(1);
    u32 side = (u32)a.n[1], half = side / 2, fours = (u32)a.n[2] / 4;
    FOR_ALL(at, a.n[0] * side * side * fours) {
        u32 i = (u32)at, c = i % fours, place = i / fours, column = place % side, row = place / side % side;
        u32 image = place / (side * side);
        Four sum = {0.0f, 0.0f, 0.0f, 0.0f};
        if (bias) sum = bias[c];
        // Of each four kernel rows two fall on this row: 2 p + tap - 1 = row.
        for (u32 ty = (row + 1) % 2; ty < 4; ty += 2) {
            u32 py = (row + 1 - ty) / 2;
            if (row + 1 < ty || py >= half) continue;
            for (u32 tx = (column + 1) % 2; tx < 4; tx += 2) {
                u32 px = (column + 1 - tx) / 2;
                if (column + 1 < tx || px >= half) continue;
                Four term = windows[((long)((image * half + py) * half + px) * 16 + ty * 4 + tx) * fours + c];
                sum.x += term.x;
                sum.y += term.y;
                sum.z += term.z;
                sum.w += term.w;
            }
        }
        if (a.n[3]) {
            sum.x += x[i].x;
            sum.y += x[i].y;
            sum.z += x[i].z;
            sum.w += x[i].w;
        }
        x[i] = sum;
    }
}

// Where a pixel comes from that is at `at` [64, 64, channels] of a picture that was moved by `by` (right, down; null: not at all).
DEVICE int moved_from(int at, int channels, const int *by) {
    int column = at / channels % 64, row = at / channels / 64;
    if (by) {
        column -= by[0];
        row -= by[1];
        column = column < 0 ? 0 : column > 63 ? 63 : column;
        row = row < 0 ? 0 : row > 63 ? 63 : row;
    }
    return row * 64 + column;
}

// Images of a store of u8 [.., 64, 64, 3] by index, shifted by row of the batch, as x / 255 - 0.5.
// p: store, index (u32) [count], shift (int: right, down) [B, 2] or null, out. n: count, B, channels.
// Where n[3] a mask is copied: u8 to u8.
KERNEL(gather_images) {
    const u8 *store = (const u8 *)AT(0);
    const u32 *index = (const u32 *)AT(1);
    const int *shift = (const int *)OR_NULL(2);
    u32 channels = (u32)a.n[2], pixels = 64 * 64 * channels;
    FOR_ALL(i, a.n[0] * pixels) {
        u32 image = (u32)(i / pixels), at = (u32)(i % pixels), c = at % channels;
        u32 from = (u32)moved_from((int)at, (int)channels, shift ? shift + 2 * (image % a.n[1]) : 0);
        u8 value = store[(long)index[image] * pixels + from * channels + c];
        if (a.n[3]) ((u8 *)AT(3))[i] = value;
        else ((float *)AT(3))[i] = (float)value / 255.0f - 0.5f;
    }
}

// The same with other colours by row of the batch, rounded to what a byte holds: gain * (x + grey * (mean of the colours - x)) + offset.
// p: store, index (u32) [count], shift [B, 2], colours [B, 8] (gain [3], offset [3], grey, whether any changes), out. n: count, B.
KERNEL(gather_seen) {
    const u8 *store = (const u8 *)AT(0);
    const u32 *index = (const u32 *)AT(1);
    const int *shift = (const int *)AT(2);
    const float *colours = (const float *)AT(3);
    float *out = (float *)AT(4);
    FOR_ALL(i, a.n[0] * 4096) {
        u32 image = i / 4096, sequence = image % (u32)a.n[1];
        const u8 *pixel = store + 3 * ((long)index[image] * 4096 + moved_from((int)(i % 4096), 1, shift + 2 * sequence));
        const float *of = colours + 8 * sequence;
        float mean = ((float)pixel[0] + (float)pixel[1] + (float)pixel[2]) / 3.0f;
        for (int c = 0; c < 3; c++) {
            float x = (float)pixel[c];
            if (of[7] != 0.0f) x = fminf(fmaxf(roundf(of[c] * (x + of[6] * (mean - x)) + of[3 + c]), 0.0f), 255.0f);
            out[3 * i + c] = x / 255.0f - 0.5f;
        }
    }
}

// Squared error of the picture (eq. 8, 9) and of the robot's mask, with gradients, an image a block.
// p: raw robot [count, 64, 64, 4], raw environment (or null: one branch), image (float), mask (u8, or null), row (u32 [count]: which image; or
// null), loss [count], mask loss [count], d robot, d environment. n: count. f: weight, mask weight.
KERNEL(picture_loss) {
    const float *raw[2] = {(const float *)AT(0), (const float *)OR_NULL(1)}, *image = (const float *)AT(2);
    const u8 *mask = (const u8 *)OR_NULL(3);
    const u32 *rows = (const u32 *)OR_NULL(4);
    float *d[2] = {(float *)AT(7), (float *)OR_NULL(8)};
    for (int at = BLOCK; at < a.n[0]; at += BLOCKS) {
        int source = (rows ? (int)rows[at] : at) * 4096;
        float loss = 0.0f, mask_loss = 0.0f;
        for (int i = THREAD; i < 4096; i += THREADS) {
            const float *x = raw[0] + 4 * (at * 4096 + i), *truth = image + 3 * (source + i);
            float *dx = d[0] + 4 * (at * 4096 + i), alpha = sigmoid_of(x[3]), d_alpha = 0.0f;
            if (raw[1]) {
                const float *y = raw[1] + 4 * (at * 4096 + i);
                float *dy = d[1] + 4 * (at * 4096 + i), beta = sigmoid_of(y[3]), d_beta = 0.0f;
                for (int c = 0; c < 3; c++) {
                    float error = x[c] * alpha + y[c] * beta - truth[c], g = 2.0f * a.f[0] * error;
                    loss += error * error;
                    dx[c] = g * alpha;
                    dy[c] = g * beta;
                    d_alpha += g * x[c];
                    d_beta += g * y[c];
                }
                dy[3] = d_beta * beta * (1.0f - beta);
            } else {
                for (int c = 0; c < 3; c++) {
                    float error = x[c] - truth[c];
                    loss += error * error;
                    dx[c] = 2.0f * a.f[0] * error;
                }
            }
            if (mask) {
                float error = alpha - (float)mask[source + i];
                mask_loss += error * error;
                d_alpha += 2.0f * a.f[1] * error;
            }
            dx[3] = d_alpha * alpha * (1.0f - alpha);
        }
        loss = block_sum(loss);
        mask_loss = block_sum(mask_loss);
        if (THREAD == 0) {
            ((float *)AT(5))[at] = loss;
            if (mask) ((float *)AT(6))[at] = mask_loss;
        }
    }
}
