// A loop of the author's own in place of `run`.

#include <simenv.hpp>

int main() {
    simenv::Client client({"loop.go"});
    int episodes = 0;
    while (const auto episode = client.next_episode(3)) {
        ++episodes;
        try {
            const int steps = client.decide("loop.go", "a", {{"seed", episode->seed}, {"episodes", episodes}}, [] { return 2; });
            for (int i = 0; i < steps; ++i) client.decide("loop.go", "a", {}, [] { return 0; });
            if (steps) client.end(steps);  // else it ends as the next one begins
        } catch (const simenv::Stop&) {
        } catch (const std::exception& error) {
            client.error(error);
        }
    }
    return episodes;
}
