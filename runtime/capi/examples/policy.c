/* A policy inside a program in C, without shared memory.
 *
 *     cc -std=c11 policy.c -o policy $(pkg-config --cflags --libs rcwm)
 *     ./policy models/bundles/untrained
 *
 * Replace `draw` and `step` by your robot: an upright 64 x 64 RGB picture, and four numbers in [-1, 1]. */

#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include <rcwm.h>

enum { SIDE = 64, NUMBERS = 4, STEPS = 50 };

/* A hand that slides over a table. */
static float hand[2] = {0.5f, 0.5f};
static uint8_t image[SIDE * SIDE * 3];

static void draw(void) {
    memset(image, 150, sizeof image);
    const size_t column = (size_t)(hand[0] * (SIDE - 4)), row = (size_t)(hand[1] * (SIDE - 4));
    for (size_t pixel = 0; pixel < 16; ++pixel) image[3 * ((row + pixel / 4) * SIDE + column + pixel % 4) + 2] = 250;
}

/* Moves, and says what was really executed. */
static void step(const float *action, float *executed) {
    for (int axis = 0; axis < 2; ++axis) {
        hand[axis] += 0.02f * action[axis];
        hand[axis] = hand[axis] < 0 ? 0 : hand[axis] > 1 ? 1 : hand[axis];
    }
    executed[0] = action[0], executed[1] = action[1], executed[2] = executed[3] = 0;
}

static int failed(const char *what, rcwm_code code) {
    fprintf(stderr, "%s: %s: %s\n", what, rcwm_code_name(code), rcwm_last_error());
    return 1;
}

int main(int count, char **words) {
    rcwm_policy *policy = NULL;
    rcwm_code code = rcwm_policy_open(count > 1 ? words[1] : "models/bundles/untrained", NULL, &policy);
    if (code != RCWM_OK) return failed("open", code);
    rcwm_policy_info info = {.size = sizeof info};
    rcwm_policy_get_info(policy, &info);
    if (info.pictures != 1 || info.states != 0 || info.action_numbers != NUMBERS)
        return fprintf(stderr, "a bundle of one camera and four numbers is needed\n"), 1;

    const rcwm_picture picture = {image, sizeof image};
    rcwm_decision decision = {.size = sizeof decision};
    float executed[NUMBERS];
    for (int at = 0; at < STEPS; ++at) {
        draw();
        const size_t numbers = at > 0 ? NUMBERS : 0; /* nothing yet: an episode starts */
        code = rcwm_policy_observe(policy, &picture, 1, NULL, 0, at > 0 ? executed : NULL, numbers, &decision);
        if (code != RCWM_OK) return failed("observe", code);
        step(decision.action, executed);
        /* Idle time until the next picture: what needs only the action is computed now. */
        code = rcwm_policy_work_ahead(policy, executed, NUMBERS);
        if (code != RCWM_OK) return failed("work_ahead", code);
        printf("step %2d: action %6.3f %6.3f %6.3f %6.3f  surprise of the robot %6.2f nats, of its environment %6.2f\n", at,
               (double)decision.action[0], (double)decision.action[1], (double)decision.action[2],
               (double)decision.action[3], (double)decision.surprise[0], (double)decision.surprise[1]);
    }
    return rcwm_policy_close(policy) == RCWM_OK ? 0 : 1;
}
