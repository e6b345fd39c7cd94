// One source, two compilers. NVRTC reads it as CUDA; a C compiler reads it with one thread a block, block after block, so that the
// arithmetic, the indices and the order of every kernel are tested where there is no GPU.
//
// A kernel works on rows by teams: a team is a warp, or a whole block where rows are few and wide (`wide`). On the host a team is one thread.
#ifndef RCWM_COMMON_H
#define RCWM_COMMON_H

// Arguments of every kernel: addresses, counts and factors, in the order that the kernel's comment names. Counts are 32 bits wide, which GPUs
// divide by quickly; no buffer holds 2^31 numbers. Runs that learn together have memory of their own, `apart` times 256 bytes from one to the
// next (0: the same for all), and blocks of their own.
typedef struct {
    void *p[16];
    unsigned int apart[16];
    int n[16];
    float f[8];
} Args;

typedef unsigned int u32;
typedef unsigned char u8;

#ifdef __CUDACC__
// A kernel is its body, with the number of its block and of all, and its launch.
#define KERNEL(name)                                                                                          \
    DEVICE void name##_in(const Args &a, int BLOCK, int BLOCKS);                                              \
    extern "C" __global__ void name(const __grid_constant__ Args a) { name##_in(a, (int)blockIdx.x, (int)gridDim.x); } \
    DEVICE void name##_in(const Args &a, int BLOCK, int BLOCKS)
#define DEVICE static __device__ __forceinline__
// A function of its own: what is called from many places and runs a few times from each would take long to load as instructions.
#define DEVICE_CALL static __device__ __noinline__
#define IN_SHARED(at) __builtin_assume(__isShared(at))
#define AT(i) in_global(of_this_run(a, i))
#define OR_NULL(i) (a.p[i] ? of_this_run(a, i) : 0)
#define THREAD ((int)threadIdx.x)
#define THREADS ((int)blockDim.x)
#define LANES 32
#define SYNC() __syncthreads()
#define UNROLL _Pragma("unroll")
#define UNROLL_TWICE _Pragma("unroll 2")
#define NO_UNROLL _Pragma("unroll 1")
#define SHARED(name) extern __shared__ float name[]
#define INFINITY __int_as_float(0x7f800000)
#else
#include <math.h>
#define KERNEL(name) void name(Args a, int BLOCK, int BLOCKS)
#define DEVICE static inline
#define DEVICE_CALL static inline
#define IN_SHARED(at)
#define AT(i) (a.p[i])
#define OR_NULL(i) (a.p[i])
#define THREAD 0
#define THREADS 1
#define LANES 1
#define SYNC()
#define UNROLL
#define UNROLL_TWICE
#define NO_UNROLL
#define SHARED(name) static float name[1 << 17]

#endif

#ifdef __CUDACC__
typedef float4 Four;
#else
typedef struct {
    float x, y, z, w;
} Four;
#endif

#ifdef __CUDACC__
DEVICE void *of_this_run(const Args &a, int i) { return (u8 *)a.p[i] + 256ul * a.apart[i] * blockIdx.y; }

// An address that kernels are given, also where the compiler does not see by whom.
DEVICE void *in_global(void *at) {
    __builtin_assume(__isGlobal(at));
    return at;
}
#endif

#define LANE (THREAD % LANES)
#define WARP (THREAD / LANES)
#define WARPS (THREADS / LANES)
#define FOR_ALL(i, count) for (u32 i = (u32)(BLOCK * THREADS + THREAD); i < (u32)(count); i += (u32)(BLOCKS * THREADS))

typedef struct {
    int first, step;  // rows of this team
    int lane, lanes;   // this thread in it
    int wide;
} Team;

#ifdef __CUDACC__
#define team(wide) team_of(wide, BLOCK, BLOCKS)
DEVICE Team team_of(int wide, int BLOCK, int BLOCKS) {
    Team t;
    t.wide = wide;
    t.first = wide ? BLOCK : WARP * BLOCKS + BLOCK;
    t.step = wide ? BLOCKS : BLOCKS * WARPS;
    t.lane = wide ? THREAD : LANE;
    t.lanes = wide ? THREADS : LANES;
    return t;
}

DEVICE float warp_sum(float x) {
    for (int o = 16; o > 0; o /= 2) x += __shfl_xor_sync(0xffffffffu, x, o);
    return x;
}

// The sum over a block, for every thread of it.
DEVICE float block_sum(float x) {
    __shared__ float sums[32];
    x = warp_sum(x);
    __syncthreads();
    if (LANE == 0) sums[WARP] = x;
    __syncthreads();
    return warp_sum(LANE < WARPS ? sums[LANE] : 0.0f);
}

DEVICE float team_sum(Team t, float x) { return t.wide ? block_sum(x) : warp_sum(x); }

DEVICE float warp_max(float x) {
    for (int o = 16; o > 0; o /= 2) x = fmaxf(x, __shfl_xor_sync(0xffffffffu, x, o));
    return x;
}

// The index of the largest value of a warp; of equals the smallest index.
DEVICE int warp_best(float x, int index) {
    for (int o = 16; o > 0; o /= 2) {
        float other = __shfl_xor_sync(0xffffffffu, x, o);
        int other_index = __shfl_xor_sync(0xffffffffu, index, o);
        if (other > x || (other == x && other_index < index)) {
            x = other;
            index = other_index;
        }
    }
    return index;
}

// The sum over the warps of a block of what the threads of one lane hold, for the first warp.
DEVICE float across_warps(float x) {
    __shared__ float sums[32][33];
    __syncthreads();
    sums[WARP][LANE] = x;
    __syncthreads();
    float sum = 0.0f;
    if (WARP == 0)
        for (int w = 0; w < WARPS; w++) sum += sums[w][LANE];
    return sum;
}
#else
static inline Team team_of(int BLOCK, int BLOCKS) {
    Team t = {BLOCK, BLOCKS, 0, 1, 0};
    return t;
}
#define team(wide) team_of(BLOCK, BLOCKS)
#define warp_sum(x) (x)
#define block_sum(x) (x)
#define team_sum(t, x) (x)
#define warp_max(x) (x)
#define warp_best(x, index) (index)
#define across_warps(x) (x)
#endif

DEVICE float sigmoid_of(float x) { return 0.5f * tanhf(0.5f * x) + 0.5f; }
DEVICE float symlog_of(float x) { return x < 0.0f ? -log1pf(-x) : log1pf(x); }
DEVICE float symexp_of(float x) { return x < 0.0f ? -expm1f(-x) : expm1f(x); }

// What an output becomes: `found`, added to what is there where `add` says so.
DEVICE void put(float *at, int add, float found) { *at = add ? *at + found : found; }

#endif
