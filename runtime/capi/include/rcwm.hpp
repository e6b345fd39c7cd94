// rcwm.h for C++20: handles that close themselves, spans, exceptions from codes. Header only: nothing of C++ crosses the library's border,
// so that any compiler and standard library will do.
//
// Threads and memory are as rcwm.h says. A destructor of a handle that is in use by another thread ends the program: join it first.

#ifndef RCWM_HPP
#define RCWM_HPP

#include <cstdint>
#include <cstdlib>
#include <exception>
#include <memory>
#include <span>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "rcwm.h"

namespace rcwm {

/// What a call failed with.
class Error : public std::runtime_error {
public:
    Error(rcwm_code code, const std::string& text) : std::runtime_error(text), code_(code) {}
    [[nodiscard]] rcwm_code code() const noexcept { return code_; }
    /// For example "RCWM_ERROR_BUNDLE".
    [[nodiscard]] const char* name() const noexcept { return rcwm_code_name(code_); }

private:
    rcwm_code code_;
};

/// Throws where a call has failed.
inline void check(rcwm_code code) {
    if (code != RCWM_OK) throw Error(code, rcwm_last_error());
}

/// A struct of rcwm.h with its size set and all else zero.
template <class Struct>
[[nodiscard]] constexpr Struct sized() noexcept {
    Struct all{};
    all.size = sizeof(Struct);
    return all;
}

namespace detail {
template <auto close>
struct Close {
    // A handle that another thread is in cannot be freed, and must not be forgotten.
    template <class Handle>
    void operator()(Handle* handle) const noexcept {
        if (close(handle) == RCWM_ERROR_STATE) std::abort();
    }
};
}  // namespace detail

/// A bundle that decides.
class Policy {
public:
    explicit Policy(const std::string& folder, rcwm_policy_options options = sized<rcwm_policy_options>()) {
        rcwm_policy* opened = nullptr;
        check(rcwm_policy_open(folder.c_str(), &options, &opened));
        handle_.reset(opened);
    }

    [[nodiscard]] rcwm_policy_info info() const {
        auto info = sized<rcwm_policy_info>();
        check(rcwm_policy_get_info(handle_.get(), &info));
        return info;
    }

    /// What it reads, in the order in which pictures and states are handed over.
    [[nodiscard]] std::vector<rcwm_input> inputs() const {
        std::vector<rcwm_input> all(info().inputs, sized<rcwm_input>());
        for (std::size_t at = 0; at < all.size(); ++at) check(rcwm_policy_get_input(handle_.get(), at, &all[at]));
        return all;
    }

    /// Decides; nothing executed: an episode starts. What is given back is good until the next call.
    const rcwm_decision& observe(std::span<const rcwm_picture> pictures, std::span<const rcwm_numbers> states,
                                 std::span<const float> executed) {
        check(rcwm_policy_observe(handle_.get(), pictures.data(), pictures.size(), states.data(), states.size(),
                                  given(executed), executed.size(), &decision_));
        return decision_;
    }

    /// The same of a policy that reads one camera and nothing else.
    const rcwm_decision& observe(std::span<const std::uint8_t> picture, std::span<const float> executed) {
        const rcwm_picture only{picture.data(), picture.size()};
        return observe({&only, 1}, {}, executed);
    }

    void work_ahead(std::span<const float> executed) {
        check(rcwm_policy_work_ahead(handle_.get(), given(executed), executed.size()));
    }

    const rcwm_decision& imagine(std::span<const float> executed) {
        check(rcwm_policy_imagine(handle_.get(), executed.data(), executed.size(), &decision_));
        return decision_;
    }

    void warm_caches() { check(rcwm_policy_warm_caches(handle_.get())); }

    [[nodiscard]] rcwm_policy* get() const noexcept { return handle_.get(); }

private:
    // An empty span may point somewhere.
    static const float* given(std::span<const float> numbers) noexcept {
        return numbers.empty() ? nullptr : numbers.data();
    }

    std::unique_ptr<rcwm_policy, detail::Close<rcwm_policy_close>> handle_;
    rcwm_decision decision_ = sized<rcwm_decision>();
};

/// The action of a decision or an answer.
template <class Decided>
[[nodiscard]] std::span<const float> action(const Decided& decided) noexcept {
    return {decided.action, decided.numbers};
}

/// An observation that is being filled: a view of what rcwm.h gives.
class Observation {
public:
    explicit Observation(rcwm_observation& raw) noexcept : raw_(&raw) {}
    [[nodiscard]] std::span<float> state() const noexcept { return {raw_->state, raw_->state_numbers}; }
    [[nodiscard]] std::span<float> executed() const noexcept { return {raw_->executed, raw_->executed_numbers}; }
    [[nodiscard]] std::span<std::uint8_t> image(std::size_t camera = 0) const {
        return {at(camera).image, at(camera).image_bytes};
    }
    /// Empty where the camera has none.
    [[nodiscard]] std::span<std::uint8_t> mask(std::size_t camera = 0) const {
        return {at(camera).mask, at(camera).mask_bytes};
    }
    void captured(std::uint64_t monotonic_ns, std::size_t camera = 0) const { at(camera).captured_ns = monotonic_ns; }
    void reward(float reward) const noexcept { raw_->reward = reward; }
    void set(std::uint32_t flags) const noexcept { raw_->flags |= flags; }
    [[nodiscard]] rcwm_observation* operator->() const noexcept { return raw_; }

private:
    [[nodiscard]] rcwm_camera& at(std::size_t camera) const {
        if (camera >= raw_->camera_count) throw std::out_of_range("the robot has no camera of this number");
        return raw_->cameras[camera];
    }
    rcwm_observation* raw_;
};

/// A robot's program. What it throws brings the robot to rest and comes out of Robot::serve().
class Driver {
public:
    virtual ~Driver() = default;
    /// Goes to where an episode starts.
    virtual void reset(std::uint64_t episode) = 0;
    virtual void observe(const Observation& observation) = 0;
    /// Begins to execute an action; `executed` holds the same numbers, to be written over where another is executed.
    virtual void execute(std::span<const float> action, std::span<float> executed) = 0;
};

/// The robot's end of the link.
class Robot {
public:
    explicit Robot(const rcwm_robot_options& options) {
        rcwm_robot* opened = nullptr;
        check(rcwm_robot_open(&options, &opened));
        handle_.reset(opened);
    }

    Robot(const std::string& instance, const std::string& interface_file)
        : Robot(of(instance.c_str(), interface_file.c_str())) {}

    [[nodiscard]] rcwm_robot_info info() const {
        auto info = sized<rcwm_robot_info>();
        check(rcwm_robot_get_info(handle_.get(), &info));
        return info;
    }

    /// Where the numbers of a state begin, and how many they are.
    [[nodiscard]] std::pair<std::size_t, std::size_t> find_state(const std::string& name) const {
        std::pair<std::size_t, std::size_t> found;
        check(rcwm_robot_find_state(handle_.get(), name.c_str(), &found.first, &found.second));
        return found;
    }

    [[nodiscard]] std::size_t find_camera(const std::string& name) const {
        std::size_t found = 0;
        check(rcwm_robot_find_camera(handle_.get(), name.c_str(), &found));
        return found;
    }

    /// Serves a driver. What it throws is nested in the Error that this throws: std::rethrow_if_nested gives it back.
    rcwm_served serve(Driver& driver, rcwm_serve_options options = sized<rcwm_serve_options>()) {
        Served serving{driver, nullptr};
        auto callbacks = sized<rcwm_robot_callbacks>();
        callbacks.user = &serving;
        callbacks.reset = [](void* user, std::uint64_t episode) -> std::int32_t {
            return guarded(user, [&](Driver& own) { own.reset(episode); });
        };
        callbacks.observe = [](void* user, rcwm_observation* observation) -> std::int32_t {
            return guarded(user, [&](Driver& own) { own.observe(Observation(*observation)); });
        };
        callbacks.execute = [](void* user, const float* action, float* executed, std::size_t n) -> std::int32_t {
            return guarded(user, [&](Driver& own) { own.execute({action, n}, {executed, n}); });
        };
        auto served = sized<rcwm_served>();
        const rcwm_code code = rcwm_robot_serve(handle_.get(), &callbacks, &options, &served);
        if (code == RCWM_OK) return served;
        const Error error(code, rcwm_last_error());
        if (code == RCWM_ERROR_ROBOT && serving.thrown) {
            try {
                std::rethrow_exception(serving.thrown);
            } catch (...) {
                std::throw_with_nested(error);
            }
        }
        throw error;
    }

    /// Ends serve(), from any thread or a signal handler.
    void stop() const noexcept { rcwm_robot_stop(handle_.get()); }

    /// What follows is for a loop of your own.
    void begin(rcwm_observation& observation) { check(rcwm_robot_begin(handle_.get(), &observation)); }
    void publish(const rcwm_observation& observation) { check(rcwm_robot_publish(handle_.get(), &observation)); }
    [[nodiscard]] rcwm_answer wait(std::uint64_t timeout_ns) {
        auto answer = sized<rcwm_answer>();
        check(rcwm_robot_wait(handle_.get(), timeout_ns, &answer));
        return answer;
    }
    void rest(std::span<float> action) { check(rcwm_robot_rest(handle_.get(), action.data(), action.size())); }

    [[nodiscard]] rcwm_robot* get() const noexcept { return handle_.get(); }

private:
    struct Served {
        Driver& driver;
        /// The first that was thrown; resting may throw once more.
        std::exception_ptr thrown;
    };

    static rcwm_robot_options of(const char* instance, const char* interface_file) noexcept {
        auto options = sized<rcwm_robot_options>();
        options.instance = instance;
        options.interface_file = interface_file;
        return options;
    }

    /// No exception crosses the border.
    template <class Work>
    static std::int32_t guarded(void* user, Work&& work) noexcept {
        auto& serving = *static_cast<Served*>(user);
        try {
            work(serving.driver);
            return 0;
        } catch (const std::exception& error) {
            if (!serving.thrown) serving.thrown = std::current_exception();
            return rcwm_fail(error.what());
        } catch (...) {
            if (!serving.thrown) serving.thrown = std::current_exception();
            return rcwm_fail("an exception that is no std::exception");
        }
    }

    std::unique_ptr<rcwm_robot, detail::Close<rcwm_robot_close>> handle_;
};

}  // namespace rcwm

#endif  // RCWM_HPP
