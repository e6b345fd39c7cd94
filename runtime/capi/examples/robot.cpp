// A robot's driver in C++: it says what it sees, and executes what the controller answers.
//
//     c++ -std=c++20 robot.cpp -o robot $(pkg-config --cflags --libs rcwm)
//     rcwm-runtime run --bundle models/bundles/untrained --instance table &
//     ./robot table table.toml 2 50 --realtime
//
// Replace Table by your robot, and table.toml by your robot.toml.

#include <algorithm>
#include <cmath>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <cstring>

#include <rcwm.hpp>

constexpr std::size_t kSide = 64;  // pixels

class Table : public rcwm::Driver {
public:
    void reset(std::uint64_t episode) override {
        const float turn = 2.4F * static_cast<float>(episode);
        hand_[0] = hand_[1] = 0.5F;
        goal_[0] = 0.5F + 0.35F * std::cos(turn);
        goal_[1] = 0.5F + 0.35F * std::sin(turn);
    }

    void observe(const rcwm::Observation& observation) override {
        std::ranges::copy(hand_, observation.state().begin());
        const auto image = observation.image();
        std::ranges::fill(image, std::uint8_t{150});
        draw(image, goal_, 0);
        draw(image, hand_, 2);
        observation.reward(-std::hypot(hand_[0] - goal_[0], hand_[1] - goal_[1]));
    }

    void execute(std::span<const float> action, std::span<float> executed) override {
        for (int axis = 0; axis < 2; ++axis) hand_[axis] = std::clamp(hand_[axis] + 0.02F * action[axis], 0.0F, 1.0F);
        executed[2] = executed[3] = 0.0F;  // this hand has no height and no fingers
    }

private:
    static void draw(std::span<std::uint8_t> image, const float (&at)[2], std::size_t channel) {
        const auto column = static_cast<std::size_t>(at[0] * (kSide - 4)), row = static_cast<std::size_t>(at[1] * (kSide - 4));
        for (std::size_t pixel = 0; pixel < 16; ++pixel)
            image[3 * ((row + pixel / 4) * kSide + column + pixel % 4) + channel] = 250;
    }

    float hand_[2] = {}, goal_[2] = {};
};

namespace {
const rcwm::Robot* serving = nullptr;  // for the signal handler
}

int main(int count, char** words) try {
    if (count < 5) return std::fprintf(stderr, "usage: robot INSTANCE ROBOT.toml EPISODES STEPS [--realtime]\n"), 2;
    rcwm::Robot robot(words[1], words[2]);
    serving = &robot;
    std::signal(SIGINT, [](int) { serving->stop(); });  // the controller is told, and the robot rests
    auto options = rcwm::sized<rcwm_serve_options>();
    options.episodes = std::strtoull(words[3], nullptr, 10);
    options.steps = static_cast<std::uint32_t>(std::strtoul(words[4], nullptr, 10));
    options.realtime = count > 5 && std::strcmp(words[5], "--realtime") == 0;
    Table table;
    const rcwm_served served = robot.serve(table, options);
    std::printf("episodes %llu, observations %llu, answers %llu, rests %llu, missed %llu, reward %.3f\n",
                static_cast<unsigned long long>(served.episodes), static_cast<unsigned long long>(served.observations),
                static_cast<unsigned long long>(served.answers), static_cast<unsigned long long>(served.rests),
                static_cast<unsigned long long>(served.missed_answers), served.total_reward);
    return 0;
} catch (const rcwm::Error& error) {
    return std::fprintf(stderr, "robot: %s: %s\n", error.name(), error.what()), 1;
}
