// A simulator that only asks for decisions, alternately for two entities, without an end. Without an environment, it
// prints the microseconds per decision.

#include <simenv.hpp>

#include <chrono>
#include <cstdio>

int main() {
    simenv::Client client({"noop.turn"});
    return client.run([&](const simenv::Episode& episode) {
        const int times = episode.option("times", 50'000'000);
        const auto start = std::chrono::steady_clock::now();
        int sum = 0;
        for (int i = 0; client.connected() || i < times; ++i) {
            const double values[] = {0.1, 0.2, 0.3, 0.4};
            sum += client.decide("noop.turn", i % 2 ? "agent_1" : "agent_0", {{"values", values}}, [&] { return i & 1; });
        }
        const std::chrono::duration<double, std::micro> took = std::chrono::steady_clock::now() - start;
        std::printf("%.9f %d\n", took.count() / times, sum);
    });
}
