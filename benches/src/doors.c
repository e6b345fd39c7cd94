/* The door to a policy in C, for the bench `doors` (doors.rs says what BUNDLE, INPUTS and OUT are). */

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include <rcwm.h>

enum { INPUTS_MAX = 64 };

static uint64_t now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

static void check(rcwm_code code) {
    if (code == RCWM_OK) return;
    fprintf(stderr, "doors.c: %s\n", rcwm_last_error());
    exit(1);
}

static void need(int is_there, const char *what) {
    if (is_there) return;
    fprintf(stderr, "doors.c: %s\n", what);
    exit(1);
}

int main(int count, char **words) {
    need(count == 4, "usage: doors BUNDLE INPUTS OUT");
    rcwm_policy *policy = NULL;
    const rcwm_policy_options options = {.size = sizeof options, .threads = 1};
    check(rcwm_policy_open(words[1], &options, &policy));
    rcwm_policy_info info = {.size = sizeof info};
    check(rcwm_policy_get_info(policy, &info));
    need(info.inputs <= INPUTS_MAX, "too many inputs");

    /* All pictures of a tick, then all states. */
    size_t picture_bytes[INPUTS_MAX], state_numbers[INPUTS_MAX], pictures = 0, states = 0, tick_bytes = 0;
    for (size_t at = 0; at < info.inputs; ++at) {
        rcwm_input input = {.size = sizeof input};
        check(rcwm_policy_get_input(policy, at, &input));
        const int is_picture = input.kind == RCWM_INPUT_PICTURE;
        if (is_picture) picture_bytes[pictures++] = input.len;
        else state_numbers[states++] = input.len;
        tick_bytes += is_picture ? input.len : input.len * sizeof(float);
    }
    FILE *in = fopen(words[2], "rb");
    need(in != NULL, "INPUTS cannot be read");
    fseek(in, 0, SEEK_END);
    const size_t ticks = (size_t)ftell(in) / tick_bytes;
    rewind(in);
    uint8_t *all = malloc(ticks * tick_bytes);
    float *actions = malloc(ticks * info.action_numbers * sizeof *actions);
    uint64_t *times = malloc(ticks * sizeof *times);
    need(ticks > 0 && all && actions && times && fread(all, tick_bytes, ticks, in) == ticks, "INPUTS cannot be read");
    fclose(in);

    rcwm_decision decision = {.size = sizeof decision};
    for (size_t tick = 0; tick < ticks; ++tick) {
        uint8_t *from = all + tick * tick_bytes;
        rcwm_picture seen[INPUTS_MAX];
        rcwm_numbers measured[INPUTS_MAX];
        for (size_t at = 0; at < pictures; from += picture_bytes[at++]) seen[at] = (rcwm_picture){from, picture_bytes[at]};
        for (size_t at = 0; at < states; from += state_numbers[at++] * sizeof(float))
            measured[at] = (rcwm_numbers){(const float *)(const void *)from, state_numbers[at]};
        const float *executed = tick > 0 ? decision.action : NULL;
        const uint64_t start = now_ns();
        check(rcwm_policy_observe(policy, seen, pictures, measured, states, executed, tick > 0 ? info.action_numbers : 0,
                                  &decision));
        times[tick] = now_ns() - start;
        for (size_t at = 0; at < decision.numbers; ++at) actions[tick * info.action_numbers + at] = decision.action[at];
        check(rcwm_policy_work_ahead(policy, decision.action, decision.numbers));
    }
    check(rcwm_policy_close(policy));

    FILE *out = fopen(words[3], "wb");
    need(out != NULL, "OUT cannot be written");
    const int written = fwrite(actions, sizeof *actions, ticks * info.action_numbers, out) == ticks * info.action_numbers &&
                        fwrite(times, sizeof *times, ticks, out) == ticks;
    need(fclose(out) == 0 && written, "OUT cannot be written");
    free(all), free(actions), free(times);
    return 0;
}
