/* What is wrong is found, told in one line and a code, and changes nothing: misuse BUNDLE INSTANCE ROBOT.toml BROKEN.toml */

#include <dirent.h>
#include <math.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <rcwm.h>

static int failures = 0;

/* The call must fail with this code, and its text must hold these words. */
static void expect_at(int line, const char *call, rcwm_code code, rcwm_code wanted, const char *words) {
    const char *text = code == RCWM_OK ? "" : rcwm_last_error();
    if (code == wanted && strstr(text, words) != NULL && strchr(text, '\n') == NULL) return;
    ++failures;
    fprintf(stderr, "misuse.c:%d: %s: %s \"%s\", expected %s \"%s\"\n", line, call, rcwm_code_name(code), text,
            rcwm_code_name(wanted), words);
}
#define EXPECT(call, wanted, words) expect_at(__LINE__, #call, call, wanted, words)
#define SUCCEED(call) expect_at(__LINE__, #call, call, RCWM_OK, "")

static void holds_at(int line, const char *what, int holds) {
    if (holds) return;
    ++failures;
    fprintf(stderr, "misuse.c:%d: %s\n", line, what);
}
#define HOLDS(what) holds_at(__LINE__, #what, what)

enum { BYTES = 64 * 64 * 3, NUMBERS = 4 };
static uint8_t image[BYTES];

/* A line of a file in /proc, for example the signals that are handled. */
static void proc_line(const char *file, const char *key, char *to, size_t size) {
    FILE *from = fopen(file, "r");
    to[0] = 0;
    while (from && fgets(to, (int)size, from) && strncmp(to, key, strlen(key)) != 0) to[0] = 0;
    if (from) fclose(from);
}

/* The signals that this process handles, but for the C library's own two, which come with its first thread. */
static unsigned long long handled(void) {
    char line[256];
    proc_line("/proc/self/status", "SigCgt:", line, sizeof line);
    HOLDS(line[0] != 0);
    return strtoull(line + strlen("SigCgt:"), NULL, 16) & ~(3ull << 31);
}

/* Threads of this process with this name, and whether each takes SIGINT. */
static int threads_named(const char *name, int *that_take_signals) {
    int found = 0;
    DIR *tasks = opendir("/proc/self/task");
    for (struct dirent *task; tasks && (task = readdir(tasks)) != NULL;) {
        char file[600], line[256];
        snprintf(file, sizeof file, "/proc/self/task/%s/comm", task->d_name);
        proc_line(file, name, line, sizeof line);
        if (line[0] == 0) continue;
        ++found;
        snprintf(file, sizeof file, "/proc/self/task/%s/status", task->d_name);
        proc_line(file, "SigBlk:", line, sizeof line);
        const unsigned long long blocked = strtoull(line + strlen("SigBlk:"), NULL, 16);
        *that_take_signals += !(blocked >> (SIGINT - 1) & 1);
    }
    if (tasks) closedir(tasks);
    return found;
}

static void policies(const char *bundle) {
    char blocked[256];
    rcwm_policy *policy = (rcwm_policy *)image;
    EXPECT(rcwm_policy_open(bundle, NULL, NULL), RCWM_ERROR_ARGUMENT, "policy is null");
    EXPECT(rcwm_policy_open(NULL, NULL, &policy), RCWM_ERROR_ARGUMENT, "folder is null");
    HOLDS(policy == NULL);
    EXPECT(rcwm_policy_open("no/such/folder", NULL, &policy), RCWM_ERROR_BUNDLE, "no/such/folder");
    EXPECT(rcwm_policy_open("\xff\xfe", NULL, &policy), RCWM_ERROR_ARGUMENT, "UTF-8");
    rcwm_policy_options options = {.size = sizeof options, .threads = 3};
    EXPECT(rcwm_policy_open(bundle, &options, &policy), RCWM_ERROR_ARGUMENT, "threads = 3");
    options.size = 0;
    EXPECT(rcwm_policy_open(bundle, &options, &policy), RCWM_ERROR_ARGUMENT, "rcwm_policy_options.size is 0");
    /* A newer program that asks for what this library does not have, and one that does not. */
    struct { rcwm_policy_options known; uint64_t more; } newer = {{.size = sizeof newer, .threads = 1}, 1};
    EXPECT(rcwm_policy_open(bundle, &newer.known, &policy), RCWM_ERROR_ARGUMENT, "does not have");
    newer.more = 0;
    SUCCEED(rcwm_policy_open(bundle, &newer.known, &policy));
    SUCCEED(rcwm_policy_close(policy));

    const unsigned long long before = handled();
    options = (rcwm_policy_options){.size = sizeof options, .threads = 2};
    SUCCEED(rcwm_policy_open(bundle, &options, &policy));
    HOLDS(handled() == before);
    int that_take_signals = 0;
    HOLDS(threads_named("rcwm-tick", &that_take_signals) == 1 && that_take_signals == 0);
    proc_line("/proc/self/status", "SigBlk:", blocked, sizeof blocked);
    HOLDS(strtoull(blocked + strlen("SigBlk:"), NULL, 16) == 0);

    rcwm_policy_info info = {.size = sizeof info};
    SUCCEED(rcwm_policy_get_info(policy, &info));
    HOLDS(info.inputs == 1 && info.pictures == 1 && info.states == 0 && info.action_numbers == NUMBERS && info.imagines);
    HOLDS(strstr(info.interface_text, "name = \"metaworld\"") != NULL && info.rate_hz == 40);
    EXPECT(rcwm_policy_get_info(NULL, &info), RCWM_ERROR_ARGUMENT, "policy is null");
    EXPECT(rcwm_policy_get_info(policy, NULL), RCWM_ERROR_ARGUMENT, "rcwm_policy_info is null");
    rcwm_input input = {.size = sizeof input};
    SUCCEED(rcwm_policy_get_input(policy, 0, &input));
    HOLDS(strcmp(input.name, "image") == 0 && input.kind == RCWM_INPUT_PICTURE && input.len == BYTES && input.rows == 64);
    EXPECT(rcwm_policy_get_input(policy, 1, &input), RCWM_ERROR_ARGUMENT, "input 1");

    rcwm_policy *other = NULL;
    SUCCEED(rcwm_policy_open(bundle, &options, &other));
    rcwm_decision decision = {.size = sizeof decision}, expected = decision;
    rcwm_picture picture = {image, BYTES}, none = {NULL, BYTES}, shorter = {image, BYTES - 1}, both[2] = {picture, picture};
    const rcwm_numbers state = {decision.mean, 2};
    float executed[NUMBERS] = {0.25f, -0.5f, 0, 1}, infinite[NUMBERS] = {0};
    infinite[2] = INFINITY;
    SUCCEED(rcwm_policy_observe(policy, &picture, 1, NULL, 0, NULL, 0, &decision));
    SUCCEED(rcwm_policy_observe(other, &picture, 1, NULL, 0, NULL, 0, &expected));
    HOLDS(decision.numbers == NUMBERS && decision.surprises == 2);
    const rcwm_decision untouched = decision;
#define OBSERVE(...) rcwm_policy_observe(policy, __VA_ARGS__)
    EXPECT(rcwm_policy_observe(NULL, &picture, 1, NULL, 0, executed, 4, &decision), RCWM_ERROR_ARGUMENT, "policy is null");
    EXPECT(OBSERVE(&picture, 1, NULL, 0, executed, 4, NULL), RCWM_ERROR_ARGUMENT, "rcwm_decision is null");
    EXPECT(OBSERVE(NULL, 0, NULL, 0, executed, 4, &decision), RCWM_ERROR_ARGUMENT, "0 pictures, expected 1 (image)");
    EXPECT(OBSERVE(NULL, 1, NULL, 0, executed, 4, &decision), RCWM_ERROR_ARGUMENT, "pictures is null");
    EXPECT(OBSERVE(both, 2, NULL, 0, executed, 4, &decision), RCWM_ERROR_ARGUMENT, "2 pictures, expected 1");
    EXPECT(OBSERVE(&none, 1, NULL, 0, executed, 4, &decision), RCWM_ERROR_ARGUMENT, "pictures[0].bytes is null");
    EXPECT(OBSERVE(&shorter, 1, NULL, 0, executed, 4, &decision), RCWM_ERROR_ARGUMENT, "image has 12287 bytes, expected 12288");
    EXPECT(OBSERVE(&picture, 1, &state, 1, executed, 4, &decision), RCWM_ERROR_ARGUMENT, "1 states, expected 0");
    EXPECT(OBSERVE(&picture, 1, NULL, 0, executed, 3, &decision), RCWM_ERROR_ARGUMENT, "expected 4 finite numbers");
    EXPECT(OBSERVE(&picture, 1, NULL, 0, NULL, 4, &decision), RCWM_ERROR_ARGUMENT, "executed is null");
    EXPECT(OBSERVE(&picture, 1, NULL, 0, infinite, 4, &decision), RCWM_ERROR_ARGUMENT, "expected 4 finite numbers");
    EXPECT(OBSERVE(&picture, 1, NULL, 0, executed, 65, &decision), RCWM_ERROR_ARGUMENT, "65 numbers, at most 64");
    EXPECT(rcwm_policy_work_ahead(policy, infinite, 4), RCWM_ERROR_ARGUMENT, "finite");
    EXPECT(rcwm_policy_work_ahead(NULL, executed, 4), RCWM_ERROR_ARGUMENT, "policy is null");
    EXPECT(rcwm_policy_imagine(policy, NULL, 0, &decision), RCWM_ERROR_ARGUMENT, "cannot be imagined");
    EXPECT(rcwm_policy_warm_caches(NULL), RCWM_ERROR_ARGUMENT, "policy is null");
    HOLDS(memcmp(&decision, &untouched, sizeof decision) == 0);

    /* After all of that it goes on as one that was never asked for such things; imagined frames too. */
    SUCCEED(rcwm_policy_warm_caches(policy));
    SUCCEED(OBSERVE(&picture, 1, NULL, 0, executed, 4, &decision));
    SUCCEED(rcwm_policy_observe(other, &picture, 1, NULL, 0, executed, 4, &expected));
    HOLDS(memcmp(decision.action, expected.action, sizeof decision.action) == 0);
    SUCCEED(rcwm_policy_work_ahead(policy, executed, 4));
    SUCCEED(rcwm_policy_imagine(policy, decision.action, 4, &decision));
    HOLDS(decision.recomputed && decision.surprises == 0);
    SUCCEED(rcwm_policy_imagine(other, expected.action, 4, &expected));
    HOLDS(memcmp(decision.action, expected.action, sizeof decision.action) == 0);
    /* An older program, whose struct ends earlier, keeps what lies behind it. */
    rcwm_decision early = {.size = offsetof(rcwm_decision, helper_late) + 4};
    SUCCEED(OBSERVE(&picture, 1, NULL, 0, NULL, 0, &early));
    early.size = offsetof(rcwm_decision, helper_late);
    EXPECT(OBSERVE(&picture, 1, NULL, 0, NULL, 0, &early), RCWM_ERROR_ARGUMENT, "rcwm_decision.size");

    SUCCEED(rcwm_policy_close(policy));
    SUCCEED(rcwm_policy_close(other));
    SUCCEED(rcwm_policy_close(NULL));
    HOLDS(threads_named("rcwm-tick", &that_take_signals) == 0);
}

static int32_t reset(void *user, uint64_t episode) { return (void)user, (void)episode, 0; }
static int32_t observe(void *user, rcwm_observation *observation) { return (void)user, (void)observation, 0; }
static int32_t execute(void *user, const float *action, float *executed, size_t n) {
    return (void)user, (void)action, (void)executed, (void)n, 0;
}

static void robots(const char *instance, const char *file, const char *broken) {
    rcwm_robot *robot = (rcwm_robot *)image, *second = NULL;
    rcwm_robot_options options = {.size = sizeof options, .instance = instance};
    EXPECT(rcwm_robot_open(&options, NULL), RCWM_ERROR_ARGUMENT, "robot is null");
    EXPECT(rcwm_robot_open(NULL, &robot), RCWM_ERROR_ARGUMENT, "instance is null");
    HOLDS(robot == NULL);
    EXPECT(rcwm_robot_open(&options, &robot), RCWM_ERROR_ARGUMENT, "neither");
    options.interface_file = "no/such/robot.toml";
    EXPECT(rcwm_robot_open(&options, &robot), RCWM_ERROR_INTERFACE, "no/such/robot.toml");
    options.interface_file = broken;
    EXPECT(rcwm_robot_open(&options, &robot), RCWM_ERROR_INTERFACE, "line 2");
    options.interface_text = "no toml";
    EXPECT(rcwm_robot_open(&options, &robot), RCWM_ERROR_ARGUMENT, "both");
    options.interface_file = NULL;
    EXPECT(rcwm_robot_open(&options, &robot), RCWM_ERROR_INTERFACE, "line 1");
    options.interface_text = NULL, options.interface_file = file, options.instance = "a/b";
    EXPECT(rcwm_robot_open(&options, &robot), RCWM_ERROR_ARGUMENT, "a/b");
    options.instance = instance, options.prefix = "no prefix";
    EXPECT(rcwm_robot_open(&options, &robot), RCWM_ERROR_ARGUMENT, "no prefix");
    options.prefix = NULL;

    const unsigned long long before = handled();
    SUCCEED(rcwm_robot_open(&options, &robot));
    HOLDS(handled() == before);
    EXPECT(rcwm_robot_open(&options, &second), RCWM_ERROR_LINK, "another simulator");
    HOLDS(second == NULL);

    rcwm_robot_info info = {.size = sizeof info};
    SUCCEED(rcwm_robot_get_info(robot, &info));
    HOLDS(info.state_numbers == 2 && info.action_numbers == NUMBERS && info.cameras == 1 && info.rate_hz == 40);
    size_t first = 9, number = 9;
    SUCCEED(rcwm_robot_find_state(robot, "hand_pos", &first, &number));
    HOLDS(first == 0 && number == 2);
    EXPECT(rcwm_robot_find_state(robot, "arm", &first, &number), RCWM_ERROR_ARGUMENT, "the robot has hand_pos");
    EXPECT(rcwm_robot_find_state(robot, "hand_pos", NULL, &number), RCWM_ERROR_ARGUMENT, "first is null");
    SUCCEED(rcwm_robot_find_camera(robot, "image", &first));
    EXPECT(rcwm_robot_find_camera(robot, "top", &first), RCWM_ERROR_ARGUMENT, "the robot has image");

    /* A loop of its own, out of order. */
    rcwm_observation seen = {.size = sizeof seen};
    rcwm_answer answer = {.size = sizeof answer};
    float rest[NUMBERS] = {1, 1, 1, 1};
    EXPECT(rcwm_robot_publish(robot, &seen), RCWM_ERROR_STATE, "rcwm_robot_begin");
    EXPECT(rcwm_robot_wait(robot, 0, &answer), RCWM_ERROR_STATE, "publish an observation first");
    SUCCEED(rcwm_robot_begin(robot, &seen));
    HOLDS(seen.flags == RCWM_FLAG_FIRST && seen.camera_count == 1 && seen.cameras[0].image_bytes == BYTES);
    HOLDS(seen.cameras[0].mask == NULL && seen.cameras[0].captured_ns > 0 && seen.state_numbers == 2);
    EXPECT(rcwm_robot_publish(robot, NULL), RCWM_ERROR_ARGUMENT, "observation is null");
    seen.flags = 0;
    EXPECT(rcwm_robot_publish(robot, &seen), RCWM_ERROR_ARGUMENT, "without RCWM_FLAG_FIRST");
    seen.flags = RCWM_FLAG_FIRST, seen.state[1] = INFINITY;
    EXPECT(rcwm_robot_publish(robot, &seen), RCWM_ERROR_NOT_FINITE, "not finite");
    seen.state[1] = 0;
    SUCCEED(rcwm_robot_publish(robot, &seen));
    EXPECT(rcwm_robot_publish(robot, &seen), RCWM_ERROR_STATE, "rcwm_robot_begin");
    SUCCEED(rcwm_robot_wait(robot, 1000000, &answer));
    HOLDS(answer.kind == RCWM_ANSWER_NONE && !answer.left);
    SUCCEED(rcwm_robot_begin(robot, &seen));
    HOLDS(seen.sequence == 1 && seen.step == 1 && seen.episode == 0 && seen.flags == 0);
    seen.executed[0] = 1.5f;
    EXPECT(rcwm_robot_publish(robot, &seen), RCWM_ERROR_ARGUMENT, "beyond the interface's limits");
    EXPECT(rcwm_robot_rest(robot, rest, 3), RCWM_ERROR_ARGUMENT, "3 numbers, expected 4");
    SUCCEED(rcwm_robot_rest(robot, rest, NUMBERS));
    HOLDS(rest[0] == 0 && rest[3] == 0);

    rcwm_robot_callbacks callbacks = {.size = sizeof callbacks, .reset = reset, .observe = observe};
    rcwm_serve_options serve = {.size = sizeof serve, .episodes = 1, .steps = 2, .timeout_s = 0.05};
    rcwm_served served = {.size = sizeof served};
    EXPECT(rcwm_robot_serve(NULL, &callbacks, &serve, &served), RCWM_ERROR_ARGUMENT, "robot is null");
    EXPECT(rcwm_robot_serve(robot, &callbacks, &serve, &served), RCWM_ERROR_ARGUMENT, "callbacks.execute is null");
    callbacks.execute = execute, serve.timeout_s = -1;
    EXPECT(rcwm_robot_serve(robot, &callbacks, &serve, &served), RCWM_ERROR_ARGUMENT, "timeout_s");
    serve.timeout_s = 0.05;
    EXPECT(rcwm_robot_serve(robot, &callbacks, &serve, &served), RCWM_ERROR_NO_ANSWER, "is a controller running");
    /* It was served once: the link is closed. */
    EXPECT(rcwm_robot_serve(robot, &callbacks, &serve, &served), RCWM_ERROR_STATE, "the link is closed");
    EXPECT(rcwm_robot_begin(robot, &seen), RCWM_ERROR_STATE, "the link is closed");
    EXPECT(rcwm_robot_rest(robot, rest, NUMBERS), RCWM_ERROR_STATE, "the link is closed");
    SUCCEED(rcwm_robot_get_info(robot, &info));
    rcwm_robot_stop(robot);
    rcwm_robot_stop(NULL);
    SUCCEED(rcwm_robot_close(robot));
    SUCCEED(rcwm_robot_close(NULL));
    /* Its place is free again. */
    SUCCEED(rcwm_robot_open(&options, &second));
    rcwm_robot_stop(second);
    SUCCEED(rcwm_robot_serve(second, &callbacks, &serve, &served));
    HOLDS(served.size == sizeof served && served.observations == 0);
    SUCCEED(rcwm_robot_close(second));
}

int main(int count, char **words) {
    if (count != 5) return 2;
    HOLDS(strcmp(rcwm_last_error(), "") == 0);
    HOLDS(strcmp(rcwm_code_name(RCWM_ERROR_NO_ANSWER), "RCWM_ERROR_NO_ANSWER") == 0);
    HOLDS(strcmp(rcwm_code_name(-1), "unknown") == 0);
    HOLDS(rcwm_fail(NULL) == RCWM_ERROR_ROBOT && rcwm_version()[0] == '0' + RCWM_VERSION_MAJOR);
    policies(words[1]);
    robots(words[2], words[3], words[4]);
    if (failures == 0) puts("all as expected");
    return failures != 0;
}
