// Plays what the option "play" names, so that tests see each side of the client.

#include <simenv.hpp>

#include <cstdio>
#include <iostream>
#include <map>
#include <stdexcept>

using simenv::Client;
using simenv::Episode;
using simenv::Json;

namespace {

std::uint64_t reseeded = 0;

/// Tells on stderr that it was unwound; asks once more while it is.
struct Guard {
    explicit Guard(Client& asked) : client(asked) {}
    ~Guard() {
        const int decision = client.decide("probe.last", "a", {}, [] { return 7; });
        client.remove("probe.last", "a");
        std::cerr << "unwound by rule " << decision << std::endl;
    }
    Client& client;
};

Json echo(Client& client, const Episode& episode) {
    Json value = episode.option<Json>("value", nullptr);
    for (int i = 0, n = episode.option("times", 1); i < n; ++i)
        value = client.decide("probe.echo", "ä", {{"value", value}}, [&] { return value; }, 0.25 * i);
    return value;
}

Json types(Client& client) {
    const std::map<std::string, double> arguments{{"x", 1.0}, {"y", 0.1f}};
    const std::vector<bool> flags{true, false};
    const auto rule = [](auto value) { return [=] { return value; }; };
    return Json::Object{
        {"double", client.decide("probe.types", "a", arguments, rule(0.5))},
        {"int", client.decide("probe.types", "a", {{"flags", flags}, {"name", "b"}}, rule(3))},
        {"bool", client.decide("probe.types", "a", {{"half", 0.5f}, {"most", ~0ull}}, rule(true))},
        {"string", client.decide("probe.types", "a", {}, rule(std::string("rule")))},
        {"vector", client.decide("probe.types", "a", {}, rule(std::vector<double>{1.0, 2.0}))},
        {"json", client.decide("probe.types", "a", {}, rule(Json()))},
    };
}

int count(Client& client, const Episode& episode) {
    Guard guard(client);
    int sum = 0;
    for (int i = 0, n = episode.option("times", 5); i < n; ++i) {
        try {
            sum += client.decide("probe.count", "a", {{"sum", sum}}, [&] { return 1; });
        } catch (const std::exception&) {  // what is no decision is none
        }
    }
    return sum;
}

int deaf(Client& client, const Episode& episode) {
    for (int most = episode.option("times", 3), heard = 0;;) {
        try {
            client.decide("probe.deaf", "a", {}, [] { return 0; });
        } catch (...) {
            if (++heard == most) throw;
        }
    }
}

[[noreturn]] void fail(const std::string& how) {
    if (how == "number") throw 3;
    try {
        throw std::out_of_range("the cause");
    } catch (...) {
        std::throw_with_nested(std::runtime_error("the pump is broken \xff"));
    }
}

}  // namespace

int main(int argc, char** argv) {
    Client client({"probe.echo", "probe.count", "probe.types", "probe.deaf", "probe.last"});
    if (argc <= 3) client.on_reseed([](std::uint64_t seed) { reseeded = seed; });
    Json result;
    const auto model = [&](const Episode& episode) -> Json {
        const std::string play = episode.option("play", "echo");
        if (play == "echo") return result = echo(client, episode);
        if (play == "types") return result = types(client);
        if (play == "count") return result = count(client, episode);
        if (play == "deaf") return deaf(client, episode);
        if (play == "fail") fail(episode.option("how", "nested"));
        if (play == "seed") return episode.seed;
        if (play == "reseed") return client.decide("probe.echo", "a", {}, [&] { return reseeded; });
        if (play == "optional") return client.ask<double>("probe.echo", "a", {}).value_or(-1.0);
        if (play == "huge") return std::string(std::size_t{17} << 20, 'x');
        if (play == "large") return std::string(std::size_t{15} << 20, 'x');
        if (play == "text") client.decide("probe.echo", "\xff", {}, [] { return 0; });
        if (play == "name") client.remove("probe.echo", "\xc0\x80");
        if (play == "truncated") client.end({{"reached", 3}}, true);
        if (play == "shell") return std::system(episode.option("command", "true").c_str());
        if (play == "crash") [&]() noexcept { fail("nested"); }();
        if (play == "leave") std::exit(episode.option("status", 0));
        if (play == "remove") {
            client.decide("probe.echo", 12, {}, [] { return 0; });
            client.update("probe.echo", 12, {{"level", 0.5}}, 1.5);
            client.remove("probe.echo", 12);
            client.remove("probe.echo", "\"b\"");
            client.update("probe.echo", nullptr, [] { return Json::Object{{"level", 1}}; });
        }
        return nullptr;
    };
    const int status = client.run(model, argc > 1 ? std::strtoull(argv[1], nullptr, 10) : 0,
                                  argc > 2 ? Json::parse(argv[2]) : Json::Object());
    if (!client.connected()) std::cout << result.text() << std::endl;
    return status;
}
