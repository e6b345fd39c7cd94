// Robots that are driven by a real controller, and what becomes of them: robots MODE INSTANCE ROBOT.toml

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <limits>
#include <thread>
#include <vector>

#include <rcwm.hpp>

namespace {

int failures = 0;

void holds_at(int line, const char* what, bool holds) {
    if (holds) return;
    ++failures;
    std::fprintf(stderr, "robots.cpp:%d: %s\n", line, what);
}
#define HOLDS(what) holds_at(__LINE__, #what, what)

struct Brakes : std::runtime_error {
    using std::runtime_error::runtime_error;
};

/// A robot that does one thing wrong, in its third action or observation.
class Faulty : public rcwm::Driver {
public:
    Faulty(const char* mode, const rcwm::Robot& robot) : mode_(mode), robot_(&robot) {}

    void reset(std::uint64_t) override { pictures_ = 0; }

    void observe(const rcwm::Observation& observation) override {
        ++pictures_;
        std::ranges::fill(observation.image(), std::uint8_t{77});
        observation.reward(1.0F);
        if (is("nan") && pictures_ == 3) observation.state()[0] = std::numeric_limits<float>::quiet_NaN();
        if (is("no-camera") && pictures_ == 3) static_cast<void>(observation.image(1));
    }

    void execute(std::span<const float> action, std::span<float>) override {
        executed.emplace_back(action.begin(), action.end());
        if (executed.size() == 3) act();
    }

    std::vector<std::vector<float>> executed;

private:
    [[nodiscard]] bool is(const char* mode) const { return std::strcmp(mode_, mode) == 0; }

    void act() {
        if (is("throws")) throw Brakes("the brakes are on");
        if (is("throws-a-number")) throw 7;
        if (is("stops")) std::jthread([this] { robot_->stop(); }).join();
        if (is("reenters")) {
            // Facts may be read, all else is refused.
            HOLDS(robot_->find_camera("image") == 0);
            float rest[4];
            HOLDS(rcwm_robot_rest(robot_->get(), rest, 4) == RCWM_ERROR_STATE);
            HOLDS(rcwm_robot_close(robot_->get()) == RCWM_ERROR_STATE);
            HOLDS(std::strstr(rcwm_last_error(), "in use") != nullptr);
            // What failed last is what the callback fails with.
            rcwm::check(rcwm_robot_find_camera(robot_->get(), "top", nullptr));
        }
    }

    const char* mode_;
    const rcwm::Robot* robot_;
    int pictures_ = 0;
};

void serve(const char* mode, rcwm::Robot& robot) {
    Faulty faulty(mode, robot);
    auto options = rcwm::sized<rcwm_serve_options>();
    options.episodes = 2;
    options.steps = 6;
    const auto is = [mode](const char* other) { return std::strcmp(mode, other) == 0; };
    try {
        const rcwm_served served = robot.serve(faulty, options);
        HOLDS(is("stops") && served.episodes == 0 && served.observations == 3);
    } catch (const rcwm::Error& error) {
        std::printf("%s: %s\n", error.name(), error.what());
        HOLDS(error.code() == (is("nan") ? RCWM_ERROR_NOT_FINITE : RCWM_ERROR_ROBOT));
        bool nested = false;
        try {
            std::rethrow_if_nested(error);
        } catch (const Brakes&) {
            nested = is("throws");
        } catch (int number) {
            nested = is("throws-a-number") && number == 7;
        } catch (const std::out_of_range&) {
            nested = is("no-camera");
        } catch (const rcwm::Error& inner) {
            nested = is("reenters") && inner.code() == RCWM_ERROR_ARGUMENT;
        }
        HOLDS(nested || is("nan"));
    }
    // However it ended: at rest.
    HOLDS(faulty.executed.size() >= 3 && faulty.executed.back() == std::vector<float>(4, 0.0F));
    try {
        static_cast<void>(robot.serve(faulty, options));
        HOLDS(!"a robot is served once");
    } catch (const rcwm::Error& error) {
        HOLDS(error.code() == RCWM_ERROR_STATE);
    }
}

/// Two episodes of five actions in a loop of its own; the second ends by the first observation of a third.
void own_loop(rcwm::Robot& robot) {
    constexpr std::uint64_t kSecond = 1'000'000'000;
    auto seen = rcwm::sized<rcwm_observation>();
    float executed[4] = {};
    int answers = 0;
    for (int tick = 0; tick < 12; ++tick) {
        robot.begin(seen);
        const rcwm::Observation observation(seen);
        std::ranges::fill(observation.image(), static_cast<std::uint8_t>(tick));
        std::ranges::copy(executed, observation.executed().begin());
        observation.reward(0.5F);
        HOLDS(seen.sequence == static_cast<std::uint64_t>(tick) && seen.episode == static_cast<std::uint64_t>(tick / 6));
        HOLDS(seen.step == static_cast<std::uint32_t>(tick % 6));
        if (tick % 6 == 5) observation.set(RCWM_FLAG_LAST);
        robot.publish(seen);
        rcwm_answer answer = robot.wait(60 * kSecond);
        HOLDS(answer.kind == RCWM_ANSWER_ACTION && answer.source == RCWM_SOURCE_POLICY && answer.refused == 0);
        answers += answer.kind == RCWM_ANSWER_ACTION;
        HOLDS(rcwm::action(answer).size() == 4);
        std::ranges::copy(rcwm::action(answer), executed);
    }
    robot.rest(executed);
    HOLDS(executed[0] == 0.0F && executed[3] == 0.0F);
    std::printf("answers %d\n", answers);
}

}  // namespace

int main(int count, char** words) try {
    if (count != 4) return 2;
    rcwm::Robot robot(words[2], words[3]);
    // A handle may change its thread.
    std::jthread([&] {
        if (std::strcmp(words[1], "own-loop") == 0) own_loop(robot);
        else serve(words[1], robot);
    }).join();
    if (failures == 0) std::puts("all as expected");
    return failures != 0;
} catch (const std::exception& error) {
    return std::fprintf(stderr, "robots: %s\n", error.what()), 1;
}
