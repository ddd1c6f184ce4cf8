// Plays what the option "play" names; Probe.java plays the same in Java.

#include <simenv.hpp>

#include <iostream>
#include <map>
#include <stdexcept>

using simenv::Client;
using simenv::Episode;
using simenv::Json;

namespace {

std::uint64_t seeded = 0;

/// Decides and reports while the model is unwound, and says on stderr what came of it.
struct Guard {
    explicit Guard(Client& asked) : client(asked) {}
    ~Guard() {
        const int decision = client.decide("b", "last", {}, [] { return 7; });
        client.update("b", "last", {{"i", 1}});
        client.remove("b", "last");
        std::cerr << "unwound by rule " << decision << std::endl;
    }
    Client& client;
};

Json echo(Client& client, const Episode& episode) {
    const Json value = episode.option<Json>("value", nullptr);
    return client.decide("a", "ä", {{"value", value}}, [&] { return value; }, 0.25);
}

Json types(Client& client) {
    const auto rule = [](auto value) { return [=] { return value; }; };
    const double number = client.decide("a", nullptr, {}, rule(0.5));
    const int whole = client.decide("a", nullptr, {}, rule(3));
    const bool flag = client.decide("a", nullptr, {}, rule(true));
    const std::string text = client.decide("a", nullptr, {}, rule(std::string("rule")));
    const auto vector = client.decide("a", nullptr, {}, rule(std::vector<double>{1.0, 2.0}));
    return Json::Array{number, whole, flag, text, Json::Array(vector.begin(), vector.end()),
                       client.decide("a", nullptr, {}, rule(Json()))};
}

void arguments(Client& client) {
    const std::map<std::string, double> map{{"x", 1.0}, {"y", 0.1f}};
    const std::vector<bool> flags{true, false};
    client.decide("a", nullptr, map, [] { return 0; });
    client.decide("a", 12, {{"flags", flags}, {"name", "b"}, {"half", 0.5f}, {"most", ~0ull}}, [] { return 0; });
}

void reports(Client& client) {
    client.update("a", 12, {{"level", 0.5}}, 1.5);
    client.remove("a", 12);
    client.remove("a", "\"b\"");
    client.update("a", nullptr, [] { return Json{{"level", 1}}; });
    client.expect("a", 12, {{"level", 0.5}}, 1.5);
    client.expect("b", nullptr, {});
}

int count(Client& client) {
    Guard guard(client);
    int sum = 0;
    for (int i = 0; i < 5; ++i) {
        try {
            sum += client.decide("a", "x", {{"sum", sum}}, [&] { return 1; });
        } catch (const std::exception&) {  // what is no decision is none
        }
    }
    return sum;
}

[[noreturn]] void deaf(Client& client) {
    for (;;) {
        try {
            client.decide("a", "x", {}, [] { return 0; });
        } catch (...) {  // not even Stop is heard
        }
    }
}

int nested(Client& client) {
    return client.decide("a", "x", {}, [&] { return 10 * client.decide("b", "y", {}, [] { return 1; }); });
}

/// A rule that fails, which the model survives.
int careless(Client& client) {
    try {
        client.decide("a", "x", {}, []() -> int { throw std::runtime_error("no rule"); });
    } catch (const std::runtime_error&) {
    }
    return client.decide("a", "x", {}, [] { return 1; });
}

[[noreturn]] void fail() {
    try {
        throw std::out_of_range("the cause");
    } catch (...) {
        std::throw_with_nested(std::runtime_error("the pump is broken \xff"));
    }
}

}  // namespace

int main(int argc, char** argv) {
    Client client({"a", "b"});
    client.report_rules(!std::getenv("NESTED"));
    client.on_reseed([](std::uint64_t seed) { seeded = seed; });
    Json result;
    const auto model = [&](const Episode& episode) -> Json {
        const std::string play = episode.option("play", "echo");
        if (play == "echo") return echo(client, episode);
        if (play == "types") return types(client);
        if (play == "arguments") arguments(client);
        if (play == "reports") reports(client);
        if (play == "count") return result = count(client);
        if (play == "deaf") deaf(client);
        if (play == "fail") fail();
        if (play == "number") throw 3;
        if (play == "seed") return episode.seed;
        if (play == "reseed") return client.decide("a", "x", {}, [&] { return seeded; });
        if (play == "optional") return client.ask<double>("a", "x", {}).value_or(-1.0);
        if (play == "reported") return client.ask<int>("a", "x", {}) ? 1 : (client.decided(7), 0);
        if (play == "nested") return nested(client);
        if (play == "careless") return careless(client);
        if (play == "objects") return {{"a", 1}, {"b", Json{{"c", "d"}}}, {"e", Json::Array{1, "f"}}};
        if (play == "huge") return std::string(std::size_t{17} << 20, 'x');
        if (play == "text") client.decide("a", "\xff", {}, [] { return 0; });
        if (play == "name") client.remove("a", "\xc0\x80");
        if (play == "truncated") client.end({{"reached", 3}}, true);
        if (play == "shell") return std::system(episode.option("command", "true").c_str());
        if (play == "leave") std::exit(episode.option("status", 0));
        return nullptr;
    };
    const int status = client.run(model, 7, Json::Object{{"play", argc > 1 ? argv[1] : "echo"}});
    if (!client.connected()) std::cout << result.text() << std::endl;
    return status;
}
