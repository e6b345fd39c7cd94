// librcwm: policies and the robot's end of the link, for C and C++.
//
// Made by cbindgen of the sources in runtime/capi/src. Do not change it by hand.
//
// In one program a policy decides, without shared memory:
//
//     rcwm_policy *policy;
//     if (rcwm_policy_open("models/bundles/hammer", NULL, &policy) != RCWM_OK) { puts(rcwm_last_error()); return 1; }
//     rcwm_decision decision = {.size = sizeof decision};
//     rcwm_picture picture = {image, 64 * 64 * 3};
//     rcwm_policy_observe(policy, &picture, 1, NULL, 0, NULL, 0, &decision);       // an episode starts
//     rcwm_policy_observe(policy, &picture, 1, NULL, 0, executed, 4, &decision);   // and goes on
//     rcwm_policy_close(policy);
//
// In two programs the robot's driver serves callbacks, and `rcwm-runtime run` decides:
//
//     rcwm_robot_open, rcwm_robot_serve, rcwm_robot_close
//     rcwm_robot_open, { rcwm_robot_begin, rcwm_robot_publish, rcwm_robot_wait } in a loop, rcwm_robot_rest, rcwm_robot_close
//
// ERRORS. Every function that can fail gives an rcwm_code; rcwm_last_error() has the words, a text for each thread. Null pointers, wrong
// lengths, texts that are not UTF-8 and numbers that are not finite are found before anything is done. A handle may be used on after an
// error, but for RCWM_ERROR_PANIC and where a function says otherwise. No call ends the program, and no Rust panic leaves the library.
//
// THREADS. A handle is for one thread at a time, which may be another one each time; a second that comes meanwhile gets RCWM_ERROR_STATE.
// From any thread, at any time, and in callbacks: rcwm_robot_stop() (in signal handlers too), rcwm_policy_get_*, rcwm_robot_get_*,
// rcwm_robot_find_*, rcwm_last_error(), rcwm_code_name(), rcwm_version(), rcwm_fail(). To close a handle that another thread may still
// use, or to use one that is closed, is the program's fault and not found. Different handles do not know of each other.
//
// STRUCTS. Those with a `size` may grow at their end. Set it to sizeof the struct and all else to zeros, in C by
// `rcwm_decision decision = {.size = sizeof decision};`. Programs built before a struct has grown go on working.
//
// MEMORY. What a program hands over is read during the call only. Texts and pointers that it gets are the library's, good as long as it
// is said, never to be freed.
//
// SIGNALS. The library installs no handler and changes none; its second thread (of policies with two threads) takes no signals.


#ifndef RCWM_H
#define RCWM_H

#include <stddef.h>
#include <stdint.h>

// Version of this header. Programs built against another `MINOR` (from 1.0 on: another `MAJOR`) must be built again.
#define RCWM_VERSION_MAJOR 0

#define RCWM_VERSION_MINOR 1

#define RCWM_VERSION_PATCH 0

// Most numbers of an action.
#define RCWM_ACTION_NUMBERS_MAX 64

// rcwm_input.kind: a camera's picture, of bytes.
#define RCWM_INPUT_PICTURE 1

// rcwm_input.kind: a measured state, of floats.
#define RCWM_INPUT_STATE 2

// Most cameras of a robot.
#define RCWM_CAMERAS_MAX 8

// rcwm_observation.flags: first of its episode.
#define RCWM_FLAG_FIRST 1

// Last of its episode: it is answered, and the answer is not executed.
#define RCWM_FLAG_LAST 2

// The episode ended because the task did, not because its time was up.
#define RCWM_FLAG_TERMINAL 4

// The task counts as solved.
#define RCWM_FLAG_SUCCESS 8

// The masks of all cameras that have one are filled in.
#define RCWM_FLAG_MASK_VALID 16

// Nobody's answer was executed: the robot held or rested.
#define RCWM_FLAG_ACTION_HELD 32

// rcwm_answer.kind: the time was up, a signal to the process has cut the wait short, or the controller has left.
#define RCWM_ANSWER_NONE 0

// rcwm_answer.kind: an action.
#define RCWM_ANSWER_ACTION 1

// rcwm_answer.source: the policy, on what it saw.
#define RCWM_SOURCE_POLICY 0

// rcwm_answer.source: the policy, on what its world model has imagined.
#define RCWM_SOURCE_IMAGINED 1

// rcwm_answer.source: the controller's fallback.
#define RCWM_SOURCE_FALLBACK 2

// How a call ended. rcwm_last_error() has the words.
enum rcwm_code
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    RCWM_OK = 0,
    // What was handed over is wrong: a null pointer, a length, a text that is not UTF-8, a number that is not finite. Nothing was done.
    RCWM_ERROR_ARGUMENT = 1,
    // The handle cannot do this now: it is in use by another thread or by the callback that asks, or its link was closed.
    RCWM_ERROR_STATE = 2,
    // A robot.toml cannot be read or is no interface; the text names the line.
    RCWM_ERROR_INTERFACE = 3,
    // A bundle was refused: missing, damaged or of another version.
    RCWM_ERROR_BUNDLE = 4,
    // The engine could not load or run a part.
    RCWM_ERROR_ENGINE = 5,
    // A number that is not finite: of the policy, whose state is then that of the last good tick, or measured by the robot.
    RCWM_ERROR_NOT_FINITE = 6,
    // Shared memory: full, not permitted, of another version, or another robot is connected under this name.
    RCWM_ERROR_LINK = 7,
    // No controller has answered in time.
    RCWM_ERROR_NO_ANSWER = 8,
    // The robot's own: a callback has failed, or there is no safe action that is known.
    RCWM_ERROR_ROBOT = 9,
    // A fault of this library, which has caught it. The handle is of no further use: close it.
    RCWM_ERROR_PANIC = 10,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum rcwm_code rcwm_code;
#else
typedef int32_t rcwm_code;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// A loaded bundle, and what it carries from tick to tick. One thread at a time; it may be another one each time.
typedef struct rcwm_policy rcwm_policy;

// The robot's end of a link. One thread at a time; it may be another one each time.
typedef struct rcwm_robot rcwm_robot;

// How a bundle is loaded. Zeros, but for the size, are what is usual.
typedef struct rcwm_policy_options {
    // sizeof(rcwm_policy_options).
    size_t size;
    // Threads of a tick, 1 or 2; 0: 2 where there are two cores.
    uint32_t threads;
    // Not 0: the weights of layers are kept in 16 bits, which is faster where memory is slow.
    uint32_t half_weights;
} rcwm_policy_options;

// What a policy is.
typedef struct rcwm_policy_info {
    // sizeof(rcwm_policy_info).
    size_t size;
    // The interface that it was made for, a text as in robot.toml; valid until the policy is closed.
    const char *interface_text;
    // Decisions a second.
    double rate_hz;
    // How many inputs there are: see rcwm_policy_get_input().
    size_t inputs;
    // Of those, how many are pictures.
    size_t pictures;
    // Of those, how many are states.
    size_t states;
    // Numbers of an action.
    size_t action_numbers;
    // Not 0: there is a world model, which imagines what is not observed and says how surprised it is.
    uint32_t imagines;
} rcwm_policy_info;

// One thing that a policy reads.
typedef struct rcwm_input {
    // sizeof(rcwm_input).
    size_t size;
    // As in the interface; valid until the policy is closed.
    const char *name;
    // RCWM_INPUT_PICTURE or RCWM_INPUT_STATE.
    uint32_t kind;
    // Of a picture; each pixel is red, green and blue, a byte each.
    uint32_t rows;
    uint32_t columns;
    // Bytes of a picture, numbers of a state.
    size_t len;
} rcwm_input;

// A picture of the caller's: upright, row by row, red, green and blue.
typedef struct rcwm_picture {
    const uint8_t *bytes;
    size_t len;
} rcwm_picture;

// Numbers of the caller's, in the interface's units.
typedef struct rcwm_numbers {
    const float *values;
    size_t len;
} rcwm_numbers;

// What a policy decided.
typedef struct rcwm_decision {
    // sizeof(rcwm_decision).
    size_t size;
    // How many numbers each of the next three has.
    size_t numbers;
    // To be executed: in the interface's units and within the bundle's limits.
    float action[RCWM_ACTION_NUMBERS_MAX];
    // Mean of the distribution that it is from, which is over [-1, 1].
    float mean[RCWM_ACTION_NUMBERS_MAX];
    // Its standard deviation; zeros of a policy that gives one action.
    float deviation[RCWM_ACTION_NUMBERS_MAX];
    // How unexpected the picture was, in nats. Of two: the robot's branch, then the environment's.
    float surprise[2];
    // How many of those there are: 0 without a world model or a picture, 1, or 2.
    uint32_t surprises;
    // Not 0: what had been worked ahead was for another action, and was done again.
    uint32_t recomputed;
    // Not 0: the second thread was not there in time, and the first has done its share.
    uint32_t helper_late;
} rcwm_decision;

// Which link, and what the robot offers.
typedef struct rcwm_robot_options {
    // sizeof(rcwm_robot_options).
    size_t size;
    // Name of the link: the controller's --instance.
    const char *instance;
    // Path of the robot's robot.toml; null where interface_text is given.
    const char *interface_file;
    // The text of a robot.toml; null where interface_file is given.
    const char *interface_text;
    // Prefix of all files in shared memory; null: the variable RCWM_PREFIX, as all programs do.
    const char *prefix;
} rcwm_robot_options;

// What a robot offers.
typedef struct rcwm_robot_info {
    // sizeof(rcwm_robot_info).
    size_t size;
    // Its interface in one form only: equal interfaces have equal texts. Valid until the robot is closed.
    const char *interface_text;
    // Decisions a second.
    double rate_hz;
    // Numbers of all states together.
    size_t state_numbers;
    // Numbers of an action.
    size_t action_numbers;
    size_t cameras;
} rcwm_robot_info;

// One camera's place in an observation. The pointers are the library's: write what they point to, not them.
typedef struct rcwm_camera {
    // Upright, row by row, red, green and blue.
    uint8_t *image;
    size_t image_bytes;
    // A byte a pixel, 255 where the robot is, else 0; null where the camera has none.
    uint8_t *mask;
    size_t mask_bytes;
    // When the picture was taken: CLOCK_MONOTONIC in nanoseconds. Holds the present time; write over it where you know better.
    uint64_t captured_ns;
} rcwm_camera;

// What a robot sees, to be filled in place. Pictures and numbers hold what was there before.
typedef struct rcwm_observation {
    // sizeof(rcwm_observation): of the library's where it hands one to a callback, else of the program's.
    size_t size;
    // Counts observations, from 0.
    uint64_t sequence;
    // Counts episodes, from 0.
    uint64_t episode;
    // Counts observations of the episode, from 0.
    uint32_t step;
    // To be set: RCWM_FLAG_...
    uint32_t flags;
    // To be set: reward of the last step.
    float reward;
    // How many places of `cameras` are used.
    uint32_t camera_count;
    // To be filled: all measured numbers in the interface's order, see rcwm_robot_find_state().
    float *state;
    size_t state_numbers;
    // What was executed to get here, in the interface's units. Only a loop of your own fills it.
    float *executed;
    size_t executed_numbers;
    // In the interface's order, see rcwm_robot_find_camera().
    struct rcwm_camera cameras[RCWM_CAMERAS_MAX];
    // When the observation was due: CLOCK_MONOTONIC in nanoseconds. Only a loop of your own sets it, in real time.
    uint64_t scheduled_ns;
    // The control period in real time; 0 in lock-step, where every observation waits for its answer. Only a loop of your own sets it.
    uint64_t period_ns;
} rcwm_observation;

// What a wait has brought.
typedef struct rcwm_answer {
    // sizeof(rcwm_answer).
    size_t size;
    // RCWM_ANSWER_NONE or RCWM_ANSWER_ACTION.
    uint32_t kind;
    // Of an action, where it came from: RCWM_SOURCE_...
    uint32_t source;
    // Not 0: the controller has said that it leaves. Rest until another comes.
    uint32_t left;
    // Not 0: changes beyond the interface's rate_max were cut off.
    uint32_t slowed_down;
    // Answers that this wait has dropped: not finite, out of limits or of another length.
    uint64_t refused;
    // Answers that this wait has dropped: to an earlier observation.
    uint64_t stale;
    // Of an action, how many.
    size_t numbers;
    // To be executed: finite, in the interface's units and within its limits.
    float action[RCWM_ACTION_NUMBERS_MAX];
} rcwm_answer;

// The robot's own program. Each gives 0, or anything else where it fails: the robot then gets its safe action by one last `execute`, and
// rcwm_robot_serve() fails with RCWM_ERROR_ROBOT and the text of rcwm_fail() or of the last call that failed in the callback. They run in
// the thread that serves. They must return: no C++ exception and no longjmp may leave them (an exception ends the program; rcwm.hpp
// catches them).
typedef struct rcwm_robot_callbacks {
    // sizeof(rcwm_robot_callbacks).
    size_t size;
    // Handed to each of them.
    void *user;
    // Goes to where an episode starts. What was executed last may still be going on.
    int32_t (*reset)(void *user, uint64_t episode);
    // Fills in pictures, masks, states and capture stamps, the reward of the last step, and of the flags SUCCESS, MASK_VALID, LAST and
    // TERMINAL; all else is there already.
    int32_t (*observe)(void *user, struct rcwm_observation *observation);
    // Begins to execute an action, which is finite, in the interface's units and within its limits. `executed` holds the same numbers:
    // write over them where what is really executed is another action.
    int32_t (*execute)(void *user, const float *action, float *executed, size_t numbers);
} rcwm_robot_callbacks;

// How a robot is served. Zeros, but for the size, are what is usual.
typedef struct rcwm_serve_options {
    // sizeof(rcwm_serve_options).
    size_t size;
    // 0: until rcwm_robot_stop().
    uint64_t episodes;
    // Actions an episode, at most; 0: until `observe` sets RCWM_FLAG_LAST.
    uint32_t steps;
    // Not 0: at the interface's rate. 0: every observation waits for its answer, which only a simulator can.
    uint32_t realtime;
    // Longest wait for an answer where one is waited for; 0: 60 s.
    double timeout_s;
} rcwm_serve_options;

// What happened.
typedef struct rcwm_served {
    // sizeof(rcwm_served).
    size_t size;
    // Whole episodes.
    uint64_t episodes;
    // Episodes with RCWM_FLAG_SUCCESS anywhere.
    uint64_t successes;
    double total_reward;
    uint64_t observations;
    uint64_t answers;
    // Answers that were executed with changes beyond the interface's rate_max cut off.
    uint64_t slowed_down;
    // Answers that were not finite, out of limits or of another length; never executed.
    uint64_t refused;
    // Answers to an earlier observation; never executed.
    uint64_t stale_answers;
    // Safe actions.
    uint64_t rests;
    // Ticks without an answer in time.
    uint64_t missed_answers;
    uint64_t controllers_left;
    // Ticks that were left out because the robot was late.
    uint64_t overruns;
} rcwm_served;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// What went wrong in the last call of the calling thread that failed, on one line: what was found, what was expected, what to do. Empty
// where none has failed. Never null; valid until a call of the same thread fails. (A text for each thread, because a handle that could not
// be opened has no place for one.)
const char *rcwm_last_error(void);

// The name of a code, for example "RCWM_ERROR_BUNDLE"; "unknown" for what is none. Never null.
const char *rcwm_code_name(int32_t code);

// Version of the library that is running, for example "0.1.0".
const char *rcwm_version(void);

// Says in a callback why it fails: `return rcwm_fail("the brakes are on");`. The text becomes part of what rcwm_robot_serve() fails with.
// Gives RCWM_ERROR_ROBOT.
int32_t rcwm_fail(const char *text);

// Loads and checks the folder of a bundle (the engine is tract), and runs some ticks on a black picture so that the first real one finds
// memory and caches ready: takes some 100 ms.
//
// options: null for what is usual. policy: gets the handle, null where it fails.
// Fails with RCWM_ERROR_BUNDLE, RCWM_ERROR_ENGINE or RCWM_ERROR_ARGUMENT.
rcwm_code rcwm_policy_open(const char *folder,
                           const struct rcwm_policy_options *options,
                           struct rcwm_policy **policy);

// What the policy is. Any thread, at any time.
rcwm_code rcwm_policy_get_info(const struct rcwm_policy *policy, struct rcwm_policy_info *info);

// What the policy reads at a place of its inputs, counted from 0. Pictures and states are handed to rcwm_policy_observe() in this order.
// Any thread, at any time.
rcwm_code rcwm_policy_get_input(const struct rcwm_policy *policy,
                                size_t index,
                                struct rcwm_input *input);

// Decides on what is observed, and carries the state on.
//
// pictures, states: those of the policy's inputs, each in their order; what is handed over is read during the call only.
// executed: what was really executed since the last call, which may be another action than was decided; null and 0 at the first
// observation of an episode, which starts from the bundle's initial state.
//
// Fails with RCWM_ERROR_ARGUMENT, RCWM_ERROR_NOT_FINITE or RCWM_ERROR_ENGINE; the carried state is then that of the last good tick, and
// the next call goes on from there. Allocates nothing but what tract does inside (some ten small pieces).
rcwm_code rcwm_policy_observe(struct rcwm_policy *policy,
                              const struct rcwm_picture *pictures,
                              size_t picture_count,
                              const struct rcwm_numbers *states,
                              size_t state_count,
                              const float *executed,
                              size_t executed_count,
                              struct rcwm_decision *decision);

// Computes all of the next tick that needs only the action before it, as if `executed` had been executed: to be called in the idle time
// after the action was sent. When rcwm_policy_observe() then gets the same action, it has that much less to do; else it does it again.
// Null and 0: the next observation is the first of an episode. Fails as rcwm_policy_observe().
rcwm_code rcwm_policy_work_ahead(struct rcwm_policy *policy,
                                 const float *executed,
                                 size_t executed_count);

// Goes on without a picture: the world model imagines the missing frame. A policy without a world model decides on the executed action
// once more, and its state stays. Fails as rcwm_policy_observe().
rcwm_code rcwm_policy_imagine(struct rcwm_policy *policy,
                              const float *executed,
                              size_t executed_count,
                              struct rcwm_decision *decision);

// Gets ready for a picture that will come within a millisecond or so: what stands between picture and action is computed once more from
// the last picture and dropped, because others have used the caches since. Takes as long as a tick; results do not depend on it.
rcwm_code rcwm_policy_warm_caches(struct rcwm_policy *policy);

// Frees a policy; null does nothing. While another thread is in a call it fails with RCWM_ERROR_STATE, and nothing is freed.
rcwm_code rcwm_policy_close(struct rcwm_policy *policy);

// Opens the link in shared memory and says what the robot offers. Either side may start first.
//
// robot: gets the handle, null where it fails.
// Fails with RCWM_ERROR_INTERFACE, RCWM_ERROR_LINK or RCWM_ERROR_ARGUMENT.
rcwm_code rcwm_robot_open(const struct rcwm_robot_options *options, struct rcwm_robot **robot);

// What the robot offers. Any thread, at any time, in callbacks too.
rcwm_code rcwm_robot_get_info(const struct rcwm_robot *robot, struct rcwm_robot_info *info);

// Where among rcwm_observation.state the numbers of a state are. Any thread, at any time, in callbacks too.
rcwm_code rcwm_robot_find_state(const struct rcwm_robot *robot,
                                const char *name,
                                size_t *first,
                                size_t *count);

// Where among rcwm_observation.cameras a camera is. Any thread, at any time, in callbacks too.
rcwm_code rcwm_robot_find_camera(const struct rcwm_robot *robot, const char *name, size_t *index);

// Ends rcwm_robot_serve() within 100 ms: the controller is told, and the robot gets its safe action. From any thread, from a callback,
// and from a signal handler (it stores one atomic number); before rcwm_robot_serve(), that ends at once. Null does nothing. The robot
// must not be closed meanwhile.
void rcwm_robot_stop(const struct rcwm_robot *robot);

// Tells the controller that no further observation comes, and frees the robot; null does nothing. While another thread is in a call, or in
// a callback, it fails with RCWM_ERROR_STATE, and nothing is freed. RCWM_ERROR_LINK: it is freed, but the controller could not be told.
// A robot with a loop of its own must have come to rest before: see rcwm_robot_rest().
rcwm_code rcwm_robot_close(struct rcwm_robot *robot);

// Begins an observation in a loop of your own: gives the places to be filled, which are good until rcwm_robot_publish(). Sequence,
// episode and step are counted by the library; RCWM_FLAG_FIRST is set at the first observation, and after one with RCWM_FLAG_LAST.
//
// In each round: rcwm_robot_begin(); fill in pictures, states, flags, reward, and what was executed since; rcwm_robot_publish();
// rcwm_robot_wait(); execute the action, or what rcwm_robot_rest() gives where none has come.
//
// Fails with RCWM_ERROR_STATE or RCWM_ERROR_ARGUMENT.
rcwm_code rcwm_robot_begin(struct rcwm_robot *robot,
                           struct rcwm_observation *observation);

// Publishes what rcwm_robot_begin() gave to be filled, and wakes the controller. At the first observation of an episode, what was executed
// is filled in by the library: positions as they are measured, else zeros.
//
// Fails with RCWM_ERROR_ARGUMENT (what was executed is no action), RCWM_ERROR_NOT_FINITE (a state or the reward), RCWM_ERROR_STATE or
// RCWM_ERROR_LINK. But for the last, the observation may be corrected and published again.
rcwm_code rcwm_robot_publish(struct rcwm_robot *robot,
                             const struct rcwm_observation *observation);

// Waits for the answer to the observation that was published last; 0 only looks. An answer to an earlier one, one that is not finite, out
// of limits or of another length is never given; it is counted, and waited on. A controller that comes now gets the observation once more.
//
// Fails with RCWM_ERROR_LINK, RCWM_ERROR_STATE or RCWM_ERROR_ARGUMENT; that no answer comes is no failure: see rcwm_answer.kind.
rcwm_code rcwm_robot_wait(struct rcwm_robot *robot,
                          uint64_t timeout_ns,
                          struct rcwm_answer *answer);

// The interface's safe action for what was measured last: what to execute where no answer has come, and before the robot is closed.
//
// numbers: as many as an action has. Fails with RCWM_ERROR_ROBOT where the robot is to hold what is neither commanded nor measured,
// RCWM_ERROR_STATE or RCWM_ERROR_ARGUMENT.
rcwm_code rcwm_robot_rest(struct rcwm_robot *robot,
                          float *action,
                          size_t numbers);

// Serves whole episodes, or until rcwm_robot_stop(), in the calling thread. It keeps the interface's rate, waits for controllers and
// outlives them, and takes a last look at every answer: one that is not finite, out of limits or of another length is never executed,
// changes beyond rate_max are cut off, and a tick without an answer executes the interface's safe action. However it ends, the controller
// is told first and the robot gets its safe action. The link is then closed, and of the robot's functions only rcwm_robot_close() is left.
//
// options: null for what is usual. served: what happened, filled in where it succeeds; may be null.
// Fails with RCWM_ERROR_ROBOT, RCWM_ERROR_NOT_FINITE (the robot measured such a number), RCWM_ERROR_NO_ANSWER, RCWM_ERROR_LINK,
// RCWM_ERROR_STATE or RCWM_ERROR_ARGUMENT.
rcwm_code rcwm_robot_serve(struct rcwm_robot *robot,
                           const struct rcwm_robot_callbacks *callbacks,
                           const struct rcwm_serve_options *options,
                           struct rcwm_served *served);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* RCWM_H */
