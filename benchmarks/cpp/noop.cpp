// A simulator that only asks for decisions, alternately for two entities, without an end.

#include <simenv.hpp>

int main() {
    simenv::Client client({"noop.turn"});
    return client.run([&](const simenv::Episode&) {
        for (int i = 0;; ++i) {
            const double values[] = {0.1, 0.2, 0.3, 0.4};
            client.decide("noop.turn", i % 2 ? "agent_1" : "agent_0", {{"values", values}}, [&] { return i & 1; });
        }
    });
}
