#include "common.h"

// Many kernels by one launch: lists of tasks, each list by one cluster of blocks, which meet after every phase of their list. A launch costs
// microseconds and so does every kernel of a graph; a cluster meets in a fraction of one.

#if defined(__CUDACC__) && __CUDA_ARCH__ >= 900

// A kernel by some of the blocks of a cluster; as `lists.rs` has it.
typedef struct {
    Args a;
    int kernel, first, blocks, unused;
} Task;

// What must be reached by the other list before a phase, and what this one has reached after it (0: nothing).
typedef struct {
    int wait, reach;
} Phase;

#define LIST_THREADS 512
#define TASK_WORDS (int)(sizeof(Task) / 4)

// Everything that any thread of the cluster wrote before is seen by all of them afterwards.
#define CLUSTER_SYNC()                                               \
    __syncwarp();                                                    \
    asm volatile("barrier.cluster.arrive.release.aligned;\n"         \
                 "barrier.cluster.wait.acquire.aligned;" ::: "memory")

DEVICE int special_register_rank(void) {
    int rank;
    asm volatile("mov.u32 %0, %%cluster_ctarank;" : "=r"(rank));
    return rank;
}

DEVICE int load_acquire(const int *at) {
    int x;
    asm volatile("ld.acquire.gpu.global.s32 %0, [%1];" : "=r"(x) : "l"(at) : "memory");
    return x;
}

DEVICE void store_release(int *at, int x) { asm volatile("st.release.gpu.global.s32 [%0], %1;" ::"l"(at), "r"(x) : "memory"); }

// The kernels that tasks may be, numbered as `LISTED` in `lists.rs`.
DEVICE void perform(const Task *task, int block) {
    const Args &a = task->a;
    int blocks = task->blocks;
    switch (task->kernel) {
        case 0: copy_rows_in(a, block, blocks); break;
        case 1: zero_in(a, block, blocks); break;
        case 2: carry_in(a, block, blocks); break;
        case 3: carry_backward_in(a, block, blocks); break;
        case 4: product_listed_in(a, block, blocks); break;
        case 5: norm_forward_in(a, block, blocks); break;
        case 6: norm_backward_in(a, block, blocks); break;
        case 7: cell_forward_in(a, block, blocks); break;
        case 8: cell_backward_in(a, block, blocks); break;
        case 9: draw_in(a, block, blocks); break;
        case 10: draw_backward_in(a, block, blocks); break;
        case 11: interaction_forward_in(a, block, blocks); break;
        case 12: interaction_backward_in(a, block, blocks); break;
    }
}

// One list, or two of which the second waits for the first but never the other way round: the cluster that comes first takes the first, so
// that nothing waits for what cannot begin. p: tasks, table (int: which task each block of a cluster has in each phase), phases, control
// (int [8], all zero, and so again at the end). n: phases of the first list, of the second, blocks of a cluster.
extern "C" __global__ void __launch_bounds__(LIST_THREADS, 1) run_lists(const __grid_constant__ Args a) {
    __shared__ Task tasks[2];
    const int *table = (const int *)a.p[1];
    const Phase *phases = (const Phase *)a.p[2];
    int *control = (int *)a.p[3], rank = special_register_rank(), width = a.n[2], cluster = (int)blockIdx.x / width;
    // control: clusters that have begun, that have ended, what the first list has reached, -, and which list each cluster has.
    if (rank == 0 && THREAD == 0) control[4 + cluster] = atomicAdd(control, 1);
    CLUSTER_SYNC();
    int second = *(volatile int *)(control + 4 + cluster), count = second ? a.n[1] : a.n[0], reached = 0;
    phases += second ? a.n[0] : 0;
    table += rank + (second ? a.n[0] * width : 0);
    if (THREAD < TASK_WORDS) ((int *)tasks)[THREAD] = ((const int *)a.p[0])[table[0] * TASK_WORDS + THREAD];
    __syncthreads();
    for (int at = 0; at < count; at++) {
        // The next task comes while this one is done.
        int word = 0, following = at + 1 < count;
        if (following && THREAD < TASK_WORDS) word = ((const int *)a.p[0])[table[(at + 1) * width] * TASK_WORDS + THREAD];
        int wait = phases[at].wait, reach = phases[at].reach;
        if (wait > reached) {
            if (THREAD == 0)
                while (load_acquire(control + 2) < wait) __nanosleep(100);
            __syncthreads();
            reached = wait;
        }
        const Task *task = tasks + at % 2;
        perform(task, rank - task->first);
        if (following && THREAD < TASK_WORDS) ((int *)(tasks + (at + 1) % 2))[THREAD] = word;
        CLUSTER_SYNC();
        if (reach && rank == 0 && THREAD == 0) store_release(control + 2, reach);
    }
    if (rank == 0 && THREAD == 0) {
        __threadfence();
        int lists = a.n[1] > 0 ? 2 : 1;
        if (atomicAdd(control + 1, 1) == lists - 1)
            for (int i = 0; i < 3; i++) control[i] = 0;
    }
}

#endif
