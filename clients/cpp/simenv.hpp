// simenv.hpp: the client of simenv_marl for simulators in C++. One header, C++17, POSIX, no dependencies.
//
// The simulator keeps its own main loop, and asks for a decision where it would make one:
//
//     simenv::Client client({"sender.rate"});
//     return client.run([&](const simenv::Episode& episode) {
//         Model model(episode.seed, episode.option("senders", 4));
//         model.run(client);   // which calls client.decide("sender.rate", name, {{"queue", queue}}, rule, now)
//         return model.sent();
//     });
//
// Inside an environment (the variable SIMENV_MARL_FDS names a pair of pipes), the environment decides. Without one,
// `decide` runs the rule; the overhead is one test. Use a client from one thread only.

#ifndef SIMENV_HPP
#define SIMENV_HPP

#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <charconv>
#include <cmath>
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <exception>
#include <functional>
#include <initializer_list>
#include <limits>
#include <locale>
#include <optional>
#include <random>
#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>
#include <memory>
#include <type_traits>
#include <typeinfo>
#include <utility>
#include <variant>
#include <vector>
#if defined(__GNUG__)
#include <cxxabi.h>
#endif

namespace simenv {

/// The maximum length of a line in bytes, including its end.
constexpr std::size_t LONGEST = std::size_t{16} << 20;

/// The time of a simulation without a clock.
constexpr double NO_TIME = std::numeric_limits<double>::quiet_NaN();

/// Thrown by `decide` to unwind the model when the environment stops its episode. It is no std::exception, so that the
/// model's error handling does not catch it; a `catch (...)` must rethrow it.
struct Stop {};

// -- JSON ------------------------------------------------------------------------------------------------------------

/// Invalid JSON, or a value that does not have the requested type.
struct JsonError : std::invalid_argument {
    using std::invalid_argument::invalid_argument;
};

namespace detail {

template <class T, class = void> struct IsMap : std::false_type {};
template <class T> struct IsMap<T, std::void_t<typename T::mapped_type>> : std::true_type {};
template <class T> struct IsVector : std::false_type {};
template <class T> struct IsVector<std::vector<T>> : std::true_type {};

/// The length of the UTF-8 sequence at the begin of a text; 0 if it is invalid.
inline std::size_t utf8_length(std::string_view text) {
    const auto byte = [&](std::size_t i) { return static_cast<unsigned char>(text[i]); };
    const unsigned char first = byte(0);
    if (first < 0x80) return 1;
    const std::size_t length = first < 0xC2 ? 0 : first < 0xE0 ? 2 : first < 0xF0 ? 3 : first < 0xF5 ? 4 : 0;
    if (length == 0 || length > text.size()) return 0;
    for (std::size_t i = 1; i < length; ++i)
        if ((byte(i) & 0xC0) != 0x80) return 0;
    if (length > 2) {  // neither overlong, nor a surrogate, nor beyond the last character
        const unsigned char second = byte(1);
        if ((first == 0xE0 && second < 0xA0) || (first == 0xED && second > 0x9F)) return 0;
        if ((first == 0xF0 && second < 0x90) || (first == 0xF4 && second > 0x8F)) return 0;
    }
    return length;
}

/// The same text with U+FFFD in place of invalid UTF-8.
inline std::string repaired(std::string_view text) {
    std::string out;
    for (std::size_t i = 0; i < text.size();) {
        const std::size_t length = utf8_length(text.substr(i));
        out += length ? text.substr(i, length) : std::string_view("\xEF\xBF\xBD");
        i += length ? length : 1;
    }
    return out;
}

inline void write_text(std::string& out, std::string_view text) {
    out += '"';
    for (std::size_t i = 0; i < text.size();) {
        const char c = text[i];
        const std::size_t length = utf8_length(text.substr(i));
        if (length == 0) throw JsonError("a text that is not UTF-8: " + repaired(text.substr(0, 200)));
        if (c == '"' || c == '\\') {
            (out += '\\') += c;
        } else if (static_cast<unsigned char>(c) < 0x20) {
            char escape[8];
            std::snprintf(escape, sizeof escape, "\\u%04x", c);
            out += escape;
        } else {
            out += text.substr(i, length);
        }
        i += length;
    }
    out += '"';
}

/// The shortest text that parses to the same double; always with a point or an exponent, so that it stays a float.
inline void write_double(std::string& out, double value) {
    if (!std::isfinite(value)) {
        const char* name = std::isnan(value) ? "nan" : value > 0 ? "inf" : "-inf";
        out.append("{\"float\":\"").append(name).append("\"}");
        return;
    }
    const std::size_t before = out.size();
#if defined(__cpp_lib_to_chars) && !defined(SIMENV_NO_TO_CHARS)
    char digits[32];
    out.append(digits, std::to_chars(digits, digits + sizeof digits, value).ptr);
#else
    std::ostringstream digits;
    digits.imbue(std::locale::classic());
    digits.precision(17);
    digits << value;
    out += digits.str();
#endif
    if (out.find_first_of(".e", before) == std::string::npos) out += ".0";
}

}  // namespace detail

/// A JSON value. Pairs in braces are always an object, `Json{{"level", 3}}`; an array is a `Json::Array{1, 2}` or a
/// std::vector. Integers have 64 bits; {"float": "nan"} and the like are read as doubles.
class Json {
  public:
    using Array = std::vector<Json>;
    using Object = std::vector<std::pair<std::string, Json>>;

    Json() = default;
    Json(std::initializer_list<std::pair<std::string_view, Json>> members);
    Json(std::nullptr_t) {}
    template <class T, std::enable_if_t<std::is_arithmetic_v<T>, int> = 0> Json(T value) {
        if constexpr (std::is_same_v<T, bool>) value_ = value;
        else if constexpr (std::is_floating_point_v<T>) value_ = static_cast<double>(value);
        else if (value > 0 && static_cast<std::uint64_t>(value) >> 63) value_ = static_cast<std::uint64_t>(value);
        else value_ = static_cast<std::int64_t>(value);
    }
    Json(const char* text) : value_(std::string(text)) {}
    Json(std::string text) : value_(std::move(text)) {}
    Json(Array values) : value_(std::move(values)) {}
    Json(Object members) : value_(std::move(members)) {}
    template <class T> Json(const std::vector<T>& values) : value_(Array(values.begin(), values.end())) {}

    /// Parses one value. Throws JsonError.
    static Json parse(std::string_view text);

    bool is_null() const { return std::holds_alternative<std::monostate>(value_); }
    bool is_object() const { return std::holds_alternative<Object>(value_); }
    bool is_true() const { return std::holds_alternative<bool>(value_) && std::get<bool>(value_); }

    /// A pointer to the member of that name, or null. It is valid as long as this value.
    const Json* find(std::string_view name) const {
        const Object* members = std::get_if<Object>(&value_);
        if (members)
            for (auto member = members->rbegin(); member != members->rend(); ++member)
                if (member->first == name) return &member->second;
        return nullptr;
    }

    /// The member of that name. Throws JsonError if there is none.
    const Json& operator[](std::string_view name) const {
        if (const Json* member = find(name)) return *member;
        throw JsonError("no member \"" + std::string(name) + "\" in " + shown());
    }

    /// The value as an integer of that type, if it is an integer that fits.
    template <class T> std::optional<T> integer() const {
        const auto kept = [](auto number) -> std::optional<T> {
            const T cast = static_cast<T>(number);
            if (static_cast<decltype(number)>(cast) != number || (cast < 0) != (number < 0)) return std::nullopt;
            return cast;
        };
        if (const std::int64_t* number = std::get_if<std::int64_t>(&value_)) return kept(*number);
        if (const std::uint64_t* number = std::get_if<std::uint64_t>(&value_)) return kept(*number);
        const double* number = std::get_if<double>(&value_);
        if (number && std::fabs(*number) <= 9007199254740992.0 && std::floor(*number) == *number)
            return kept(static_cast<std::int64_t>(*number));
        return std::nullopt;
    }

    /// The value as a bool, a number, a std::string, a std::vector of these, an Array, an Object, or a Json. A number
    /// without a fraction is an integer, and 0 and 1 are bools. Throws JsonError.
    template <class T> T as() const {
        if constexpr (std::is_same_v<T, Json>) return *this;
        else if constexpr (std::is_same_v<T, bool>) {
            if (const bool* value = std::get_if<bool>(&value_)) return *value;
            if (const auto number = integer<int>(); number == 0 || number == 1) return number == 1;
        } else if constexpr (std::is_integral_v<T>) {
            if (const auto number = integer<T>()) return *number;
        } else if constexpr (std::is_floating_point_v<T>) {
            if (const double* number = std::get_if<double>(&value_)) return static_cast<T>(*number);
            if (const std::int64_t* number = std::get_if<std::int64_t>(&value_)) return static_cast<T>(*number);
            if (const std::uint64_t* number = std::get_if<std::uint64_t>(&value_)) return static_cast<T>(*number);
        } else if constexpr (detail::IsVector<T>::value && !std::is_same_v<T, Array> && !std::is_same_v<T, Object>) {
            if (const Array* values = std::get_if<Array>(&value_)) {
                T out;
                for (const Json& value : *values) out.push_back(value.as<typename T::value_type>());
                return out;
            }
        } else {
            static_assert(std::is_same_v<T, std::string> || std::is_same_v<T, Array> || std::is_same_v<T, Object>,
                          "a decision is a bool, a number, a std::string, a std::vector of these, or a simenv::Json");
            if (const T* value = std::get_if<T>(&value_)) return *value;
        }
        throw JsonError(shown() + " is not of the type that the model takes");
    }

    void write(std::string& out) const;
    std::string text() const {
        std::string out;
        write(out);
        return out;
    }

  private:
    std::string shown() const {
        const std::string all = text();
        return all.size() <= 200 ? all : detail::repaired(all.substr(0, 200)) + "...";
    }

    std::variant<std::monostate, bool, std::int64_t, std::uint64_t, double, std::string, Array, Object> value_;
};

namespace detail {

template <class Range, class Each>
void write_many(std::string& out, char open, const Range& items, char close, Each&& each) {
    out += open;
    const std::size_t before = out.size();
    for (const auto& item : items) {
        if (out.size() != before) out += ',';
        each(item);
    }
    out += close;
}

/// Writes a value as JSON: any value that a Json can hold, ranges and maps of such values, and results of functions.
/// Throws JsonError for invalid UTF-8.
template <class T> void write(std::string& out, const T& value) {
    if constexpr (std::is_same_v<T, Json>) {
        value.write(out);
    } else if constexpr (std::is_invocable_v<const T&>) {
        write(out, value());
    } else if constexpr (std::is_same_v<T, std::nullptr_t> || std::is_same_v<T, std::monostate>) {
        out += "null";
    } else if constexpr (std::is_same_v<T, bool>) {
        out += value ? "true" : "false";
    } else if constexpr (std::is_floating_point_v<T>) {
        write_double(out, static_cast<double>(value));
    } else if constexpr (std::is_integral_v<T>) {
        char digits[24];
        out.append(digits, std::to_chars(digits, digits + sizeof digits, value).ptr);
    } else if constexpr (std::is_convertible_v<const T&, std::string_view>) {
        write_text(out, value);
    } else if constexpr (IsMap<T>::value || std::is_same_v<T, Json::Object>) {
        write_many(out, '{', value, '}', [&](const auto& member) {
            write_text(out, member.first);
            out += ':';
            write(out, member.second);
        });
    } else {
        write_many(out, '[', value, ']', [&](const auto& item) { write(out, item); });
    }
}

/// A value converted to the model's type; the text of an error begins with the name of the value.
template <class T, class About> T taken(const Json& value, About&& about) {
    try {
        return value.as<T>();
    } catch (const JsonError& error) {
        throw JsonError(about() + ": " + error.what());
    }
}

/// Parses JSON (RFC 8259).
class Reader {
  public:
    explicit Reader(std::string_view text) : text_(text) {}

    Json all() {
        Json out = value(0);
        space();
        if (at_ != text_.size()) fail("more than one value");
        return out;
    }

  private:
    [[noreturn]] void fail(const char* what) const {
        throw JsonError(std::string("no JSON: ") + what + " at byte " + std::to_string(at_) + " of " +
                        repaired(text_.substr(0, 200)));
    }
    char peek() const { return at_ < text_.size() ? text_[at_] : '\0'; }
    void space() {
        while (at_ < text_.size() && std::strchr(" \t\r\n", text_[at_]) && text_[at_]) ++at_;
    }
    bool skip(char c) {
        space();
        if (peek() != c) return false;
        ++at_;
        return true;
    }
    bool word(std::string_view word) {
        if (text_.substr(at_, word.size()) != word) return false;
        at_ += word.size();
        return true;
    }

    Json value(int depth) {
        if (depth > 500) fail("nested too deeply");
        space();
        if (peek() == '"') return text();
        if (skip('{')) return object(depth);
        if (skip('[')) return array(depth);
        if (word("true")) return true;
        if (word("false")) return false;
        if (word("null")) return nullptr;
        return number();
    }
    Json array(int depth) {
        Json::Array out;
        if (skip(']')) return out;
        do out.push_back(value(depth + 1));
        while (skip(','));
        if (!skip(']')) fail("no end of an array");
        return out;
    }
    Json object(int depth) {
        Json::Object out;
        if (skip('}')) return out;
        do {
            space();
            if (peek() != '"') fail("no name of a member");
            std::string name = text();
            if (!skip(':')) fail("no colon");
            out.emplace_back(std::move(name), value(depth + 1));
        } while (skip(','));
        if (!skip('}')) fail("no end of an object");
        if (out.size() == 1 && out[0].first == "float") return not_finite(out);
        return out;
    }
    static Json not_finite(const Json::Object& out) {
        constexpr double infinity = std::numeric_limits<double>::infinity();
        const std::string value = out[0].second.text();
        if (value == "\"nan\"") return std::numeric_limits<double>::quiet_NaN();
        if (value == "\"inf\"") return infinity;
        if (value == "\"-inf\"") return -infinity;
        return out;
    }
    Json number() {
        const std::size_t begin = at_;
        const auto digits = [&] {
            const std::size_t first = at_;
            while (peek() >= '0' && peek() <= '9') ++at_;
            if (at_ == first) fail("no value");
            return at_ - first;
        };
        bool whole = true;
        if (peek() == '-') ++at_;
        const bool zero = peek() == '0';
        if (digits() > 1 && zero) fail("a number that begins with 0");
        if (peek() == '.') whole = false, ++at_, digits();
        if (peek() == 'e' || peek() == 'E') {
            whole = false, ++at_;
            if (peek() == '+' || peek() == '-') ++at_;
            digits();
        }
        const std::string_view found = text_.substr(begin, at_ - begin);
        if (!whole) return real(found);
        if (found[0] == '-') return integer<std::int64_t>(found);
        return integer<std::uint64_t>(found);
    }
    template <class T> Json integer(std::string_view digits) const {
        T out{};
        if (std::from_chars(digits.data(), digits.data() + digits.size(), out).ec == std::errc()) return out;
        fail("an integer of more than 64 bits");
    }
    Json real(std::string_view digits) const {
        double out = 0;
#if defined(__cpp_lib_to_chars) && !defined(SIMENV_NO_TO_CHARS)
        if (std::from_chars(digits.data(), digits.data() + digits.size(), out).ec == std::errc()) return out;
#else
        std::istringstream stream{std::string(digits)};
        stream.imbue(std::locale::classic());
        if (stream >> out) return out;
#endif
        fail("a number beyond doubles");
    }
    unsigned unit() {
        unsigned out = 0;
        const std::string_view digits = text_.substr(at_, 4);
        const auto found = std::from_chars(digits.data(), digits.data() + digits.size(), out, 16);
        if (digits.size() != 4 || found.ptr != digits.data() + 4) fail("no four digits after \\u");
        at_ += 4;
        return out;
    }
    void character(std::string& out) {
        unsigned code = unit();
        if (code >= 0xD800 && code < 0xE000) {
            if (code >= 0xDC00 || !word("\\u")) fail("half a pair of surrogates");
            const unsigned low = unit();
            if (low < 0xDC00 || low >= 0xE000) fail("half a pair of surrogates");
            code = 0x10000 + ((code - 0xD800) << 10) + (low - 0xDC00);
        }
        const auto tail = [&](int shift) { out += static_cast<char>(0x80 | ((code >> shift) & 0x3F)); };
        if (code < 0x80) out += static_cast<char>(code);
        else if (code < 0x800) out += static_cast<char>(0xC0 | (code >> 6)), tail(0);
        else if (code < 0x10000) out += static_cast<char>(0xE0 | (code >> 12)), tail(6), tail(0);
        else out += static_cast<char>(0xF0 | (code >> 18)), tail(12), tail(6), tail(0);
    }
    std::string text() {
        std::string out;
        for (++at_;;) {
            if (at_ >= text_.size()) fail("no end of a text");
            const char c = text_[at_];
            if (c == '"') return ++at_, out;
            if (static_cast<unsigned char>(c) < 0x20) fail("a control character in a text");
            if (c == '\\') {
                constexpr std::string_view letters = "\"\\/bfnrt", meant = "\"\\/\b\f\n\r\t";
                ++at_;
                const std::size_t letter = at_ < text_.size() ? letters.find(text_[at_]) : std::string_view::npos;
                if (word("u")) character(out);
                else if (letter != std::string_view::npos) out += meant[letter], ++at_;
                else fail("an unknown escape");
                continue;
            }
            const std::size_t length = utf8_length(text_.substr(at_));
            if (length == 0) fail("no UTF-8");
            out += text_.substr(at_, length);
            at_ += length;
        }
    }

    std::string_view text_;
    std::size_t at_ = 0;
};

}  // namespace detail

inline Json::Json(std::initializer_list<std::pair<std::string_view, Json>> members)
    : value_(Object(members.begin(), members.end())) {}
inline Json Json::parse(std::string_view text) { return detail::Reader(text).all(); }
inline void Json::write(std::string& out) const {
    std::visit([&](const auto& value) { detail::write(out, value); }, value_);
}

// -- the client ------------------------------------------------------------------------------------------------------

/// A reference to anything that can be written as JSON, valid during the call that gets it.
class Value {
  public:
    template <class T, std::enable_if_t<!std::is_same_v<T, Value>, int> = 0>
    Value(const T& value)
        : value_(std::addressof(value)),
          write_([](std::string& out, const void* it) { detail::write(out, *static_cast<const T*>(it)); }) {}
    void write(std::string& out) const { write_(out, value_); }

  private:
    const void* value_;
    void (*write_)(std::string&, const void*);
};

/// The arguments of a call, as in {{"queue", 3.0}, {"rtt", rtt}}, or an object: a Json, a map by name, or a function
/// that returns one, which is called only if there is an environment. Create it in the call: it holds references.
class Arguments {
  public:
    Arguments(std::initializer_list<std::pair<std::string_view, Value>> arguments) : arguments_(arguments) {}
    template <class T, std::enable_if_t<!std::is_same_v<T, Arguments>, int> = 0>
    Arguments(const T& object) : object_(object) {}
    void write(std::string& out) const {
        if (object_) return object_->write(out);
        out += '{';
        for (const auto& [name, value] : arguments_) {
            if (out.back() != '{') out += ',';
            detail::write_text(out, name);
            out += ':';
            value.write(out);
        }
        out += '}';
    }

  private:
    std::initializer_list<std::pair<std::string_view, Value>> arguments_;
    std::optional<Value> object_;
};

/// The parameters of an episode.
struct Episode {
    std::uint64_t seed;
    Json options;

    /// The option of that name, or its default. Throws JsonError if it has another type.
    template <class T> T option(std::string_view name, T otherwise) const {
        const Json* found = options.find(name);
        return found ? detail::taken<T>(*found, [&] { return "option " + std::string(name); }) : otherwise;
    }
    std::string option(std::string_view name, const char* otherwise) const {
        return option<std::string>(name, otherwise);
    }
};

/// The simulator's side of the wire. A process has one client.
class Client {
  public:
    /// Takes the names of the model's decision points, which the environment uses as well.
    explicit Client(std::vector<std::string> points) : points_(std::move(points)) {
        const char* found = std::getenv("SIMENV_MARL_FDS");
        if (!found) return;
        int length = 0;
        if (std::sscanf(found, "%d,%d%n", &in_, &out_, &length) != 2 || found[length])
            throw std::invalid_argument(std::string("SIMENV_MARL_FDS must be two descriptors, R,W, and is ") + found);
        for (const int descriptor : {in_, out_})
            if (fcntl(descriptor, F_SETFD, FD_CLOEXEC) == -1)  // child processes must not keep the pipes open
                throw std::invalid_argument(std::string("SIMENV_MARL_FDS=") + found + ": " + std::strerror(errno));
        unsetenv("SIMENV_MARL_FDS");
        struct sigaction action {};
        if (sigaction(SIGPIPE, nullptr, &action) == 0 && action.sa_handler == SIG_DFL)
            std::signal(SIGPIPE, [](int) {});  // not SIG_IGN, which child processes would inherit
        connected_ = true;
    }
    Client(const Client&) = delete;
    Client& operator=(const Client&) = delete;

    /// Whether there is an environment.
    bool connected() const { return connected_; }

    /// Whether the environment has stopped the episode: the model should end, and gets no more decisions.
    bool stopped() const { return state_ == State::stopped || state_ == State::closed; }

    /// Sets the function that reseeds the model's generators during an episode. Call it before the first episode.
    void on_reseed(std::function<void(std::uint64_t)> reseed) { reseed_ = std::move(reseed); }

    /// Whether the environment is told what rules decide, as it is by default. Rules that ask for other decisions need
    /// false. Call it before the first episode.
    void report_rules(bool reports) { reports_ = reports; }

    /// Runs the model once for each episode, and returns the exit status for main(). The model's return value is the
    /// result of the episode; its exceptions are reported. Without an environment, the model runs once, with this seed
    /// and these options.
    template <class Model> int run(Model&& model, std::uint64_t seed = 0, Json options = Json::Object()) {
        while (const std::optional<Episode> episode = next_episode(seed, options)) {
            if (!connected_) return play(model, *episode), 0;
            try {
                play(model, *episode);
            } catch (const Stop&) {
            } catch (const std::exception& caught) {
                error(caught);
            } catch (...) {
                error("unknown", "the model has thrown an exception that is not a std::exception");
            }
        }
        return failed_ ? 1 : 0;
    }

    /// Waits for the next episode; returns nothing after the last one. For loops of your own, which have to catch Stop.
    std::optional<Episode> next_episode(std::uint64_t seed = 0, Json options = Json::Object()) {
        if (!connected_ && std::exchange(alone_, true)) return std::nullopt;
        if (!connected_) return Episode{seed, std::move(options)};
        end();
        if (!std::exchange(greeted_, true)) greet();
        if (state_ != State::closed) state_ = State::idle;
        const std::optional<Json> frame = receive();
        if (!frame) return std::nullopt;
        const Json *start = frame->find("start"), *number = start ? start->find("seed") : nullptr;
        const bool seeded = number && !number->is_null();
        const std::optional<std::uint64_t> sent = seeded ? number->integer<std::uint64_t>() : drawn();
        if (!start || !start->is_object() || !sent)
            return fail("expected the start of an episode with a 64-bit seed, got: " + frame->text()), std::nullopt;
        const Json* given = start->find("options");
        calls_ = 0, refused_ = 0, due_ = 0;
        state_ = State::running;
        return Episode{*sent, given && !given->is_null() ? *given : Json::Object()};
    }

    /// Returns the environment's decision or the result of `rule()`, in the type of the latter. `time` is the time of
    /// the simulation's clock.
    template <class Rule>
    auto decide(std::string_view point, Value entity, const Arguments& arguments, Rule&& rule,
                double time = NO_TIME) -> std::decay_t<decltype(rule())> {
        if (!connected_) return rule();
        auto decision = ask<std::decay_t<decltype(rule())>>(point, entity, arguments, time);
        if (decision) return *std::move(decision);
        if (!due_) return rule();
        std::decay_t<decltype(rule())> value = ruled(point, rule);
        decided(value);
        return value;
    }

    /// Returns the environment's decision; nothing if the model's rule should decide. Report that to `decided`.
    template <class T>
    std::optional<T> ask(std::string_view point, Value entity, const Arguments& arguments, double time = NO_TIME) {
        if (!connected_) return std::nullopt;
        const std::optional<Json> value = call(point, entity, arguments, time);
        if (!value) return std::nullopt;
        return detail::taken<T>(
            *value, [&] { return "decision " + std::to_string(calls_) + ", at " + std::string(point); });
    }

    /// Reports what the rule has decided after `ask` returned nothing. If that is not reported, it is null.
    template <class T> void decided(const T& value) {
        if (!due_) return;
        append([&](std::string& out) {
            out += "{\"decided\":";
            detail::write(out, due_);
            out += ",\"value\":";
            detail::write(out, value);
            out += '}';
        });
        due_ = 0;
    }

    /// Reports that an entity is going to decide, with the arguments that it has now. So agents that are born together
    /// act in one round of the parallel view. Call it for all of them before the first of them decides.
    void expect(std::string_view point, Value entity, const Arguments& arguments, double time = NO_TIME) {
        if (state_ != State::running) return;
        add([&](std::string& out) {
            named(out, "{\"expect\":[{\"entity\":", entity, point, &arguments, time);
            out += "]}";
        });
    }

    /// Reports the current arguments of an entity, for its last observation and reward. Call it before the entity is
    /// removed, or before the end.
    void update(std::string_view point, Value entity, const Arguments& arguments, double time = NO_TIME) {
        if (state_ != State::running) return;
        add([&](std::string& out) { named(out, "{\"update\":", entity, point, &arguments, time); });
    }

    /// Reports that an entity is gone and makes no more decisions.
    void remove(std::string_view point, Value entity) {
        if (state_ != State::running) return;
        add([&](std::string& out) { named(out, "{\"remove\":", entity, point, nullptr, NO_TIME); });
    }

    /// Ends the episode with a result. `truncated`: it ended by a time limit, not by the end of the task.
    template <class T> void end(const T& result, bool truncated = false) {
        finish([&](std::string& out) { detail::write(out, result); }, truncated);
    }
    void end(const Arguments& result, bool truncated = false) {
        finish([&](std::string& out) { result.write(out); }, truncated);
    }
    void end() { end(nullptr); }

    /// Ends the episode with an error of the model.
    void error(std::string_view type, std::string_view text, std::string_view trace = {}) {
        if (state_ != State::running) return;
        report(type, text, trace);
        state_ = State::idle;
    }
    void error(const std::exception& caught) { error(type_of(caught), caught.what(), causes(caught)); }

  private:
    enum class State { idle, running, stopped, closed };

    template <class Model> void play(Model& model, const Episode& episode) {
        if constexpr (std::is_void_v<std::invoke_result_t<Model&, const Episode&>>) {
            model(episode);
            end();
        } else {
            end(model(episode));
        }
    }

    /// A random seed for an episode without a seed.
    static std::uint64_t drawn() {
        std::random_device device;
        return std::uint64_t{device()} << 32 | device();
    }

    /// Writes the common part of frames about an entity. They are sent together with the next frame.
    static void named(std::string& out, const char* begin, const Value& entity, std::string_view point,
                      const Arguments* arguments, double time) {
        out += begin;
        entity.write(out);
        out += ",\"point\":";
        detail::write_text(out, point);
        if (!std::isnan(time)) out += ",\"time\":", detail::write_double(out, time);
        if (arguments) out += ",\"args\":", arguments->write(out);
        out += '}';
    }

    /// Asks for a decision; returns its value, or nothing if the rule should decide.
    std::optional<Json> call(std::string_view point, const Value& entity, const Arguments& arguments, double time) {
        if (state_ == State::idle) throw std::logic_error("a decision outside of an episode, at " + std::string(point));
        if (state_ != State::running) return unwind();
        add([&](std::string& out) {
            out += "{\"decide\":";
            detail::write(out, calls_ + 1);
            named(out, ",\"entity\":", entity, point, &arguments, time);
        });
        ++calls_;
        while (const std::optional<Json> frame = receive()) {
            const Json *act = frame->find("act"), *seed = frame->find("reseed"), *value = frame->find("value");
            const Json *rule = frame->find("rule"), *stop = frame->find("stop");
            const bool answered = act && act->integer<std::uint64_t>() == calls_;
            if (answered && value) return *value;
            if (answered && rule && rule->is_true()) {
                due_ = reports_ ? calls_ : 0;
                return std::nullopt;
            }
            if (seed && reseed_ && seed->integer<std::uint64_t>()) {
                reseed_(*seed->integer<std::uint64_t>());
            } else if (stop && stop->is_true()) {
                state_ = State::stopped;
                break;
            } else {
                fail("no answer to call " + std::to_string(calls_) + ": " + frame->text());
            }
        }
        return unwind();
    }

    /// The rule's decision. Meanwhile, nothing else can be sent.
    template <class Rule> auto ruled(std::string_view point, Rule& rule) {
        struct Ruling {
            Client& client;
            ~Ruling() { client.ruling_ = {}; }
        } ruling{*this};
        ruling_ = point;
        return rule();
    }

    /// Unwinds the model. During another exception, the rule decides instead: a second exception would end the process.
    std::optional<Json> unwind() {
        if (std::uncaught_exceptions() != 0) return std::nullopt;
        if (++refused_ <= 1000) throw Stop();
        std::fputs("simenv: the model catches simenv::Stop again and again, and does not unwind\n", stderr);
        std::_Exit(EXIT_FAILURE);
    }

    template <class Write> void finish(Write&& write, bool truncated) {
        if (state_ != State::running) return;
        add([&](std::string& out) {
            out += "{\"end\":{\"truncated\":";
            detail::write(out, truncated);
            out += ",\"result\":";
            write(out);
            out += "}}";
        });
        state_ = State::idle;
        flush();
    }

    void greet() {
        add([&](std::string& out) {
            out += "{\"hello\":1,\"points\":";
            detail::write(out, points_);
            out += ",\"can\":[\"expect\"";
            if (reports_) out += ",\"decided\"";
            if (reseed_) out += ",\"reseed\"";
            out += "]}";
        });
    }

    void report(std::string_view type, std::string_view text, std::string_view trace) {
        due_ = 0;
        add([&](std::string& out) {
            constexpr std::size_t most = std::size_t{1} << 16;
            out += "{\"error\":{\"type\":";
            detail::write_text(out, detail::repaired(type.substr(0, most)));
            out += ",\"text\":";
            detail::write_text(out, detail::repaired(text.substr(0, most)));
            out += ",\"trace\":";
            detail::write_text(out, detail::repaired(trace.substr(0, most)));
            out += "}}";
        });
        flush();
    }

    /// A protocol error, which ends the communication.
    void fail(const std::string& text) {
        if (state_ == State::closed) return;
        report("simenv::WireError", text, {});
        failed_ = true;
        state_ = State::closed;
    }

    static std::string type_of(const std::exception& error) {
        const char* name = typeid(error).name();
#if defined(__GNUG__)
        int status = 0;
        if (char* demangled = abi::__cxa_demangle(name, nullptr, nullptr, &status)) {
            std::string out(demangled);
            std::free(demangled);
            return out;
        }
#endif
        return name;
    }

    /// The nested exceptions, one per line.
    static std::string causes(const std::exception& error) {
        try {
            std::rethrow_if_nested(error);
        } catch (const std::exception& cause) {
            return "caused by " + type_of(cause) + ": " + cause.what() + "\n" + causes(cause);
        } catch (...) {
        }
        return {};
    }

    /// Adds a line to those that are sent before the next wait.
    template <class Write> void add(Write&& write) {
        if (!ruling_.empty())
            throw std::logic_error("the rule of " + std::string(ruling_) + " has asked for a decision, or reported on " +
                                   "an entity; it must only decide, or call client.report_rules(false) before");
        decided(nullptr);
        append(write);
    }

    /// Appends a line to the send buffer: the whole line, or nothing if writing it throws.
    template <class Write> void append(Write&& write) {
        const std::size_t before = sending_.size();
        try {
            write(sending_);
            if (sending_.size() - before >= LONGEST) throw std::length_error("a line of more than 16 MiB");
        } catch (...) {
            sending_.resize(before);
            throw;
        }
        sending_ += '\n';
    }

    void flush() {
        for (std::size_t sent = 0; sent < sending_.size() && state_ != State::closed;) {
            const ssize_t some = ::write(out_, sending_.data() + sent, sending_.size() - sent);
            if (some >= 0) sent += static_cast<std::size_t>(some);
            else if (errno != EINTR) state_ = State::closed;
        }
        sending_.clear();
    }

    /// Returns the next frame, an object; nothing after the end of the wire or a protocol error.
    std::optional<Json> receive() {
        flush();
        received_.erase(0, std::exchange(line_, 0));
        for (std::size_t seen = 0; state_ != State::closed;) {
            const std::size_t end = received_.find('\n', seen);
            if (std::min(end, received_.size()) >= LONGEST) return fail("a line of more than 16 MiB"), std::nullopt;
            if (end != std::string::npos) {
                line_ = end + 1;
                try {
                    return Json(Json::parse(std::string_view(received_).substr(0, end)).as<Json::Object>());
                } catch (const JsonError& error) {
                    return fail(error.what()), std::nullopt;
                }
            }
            seen = received_.size();
            char some[1 << 16];
            const ssize_t got = ::read(in_, some, sizeof some);
            if (got > 0) received_.append(some, static_cast<std::size_t>(got));
            else if (got == 0 || errno != EINTR) state_ = State::closed;
        }
        return std::nullopt;
    }

    std::vector<std::string> points_;
    std::function<void(std::uint64_t)> reseed_;
    bool connected_ = false, greeted_ = false, alone_ = false, failed_ = false, reports_ = true;
    State state_ = State::idle;
    int in_ = -1, out_ = -1;
    std::uint64_t calls_ = 0;
    std::uint64_t due_ = 0;  ///< The call whose rule has not reported its decision.
    std::string_view ruling_;  ///< The point whose rule is running.
    int refused_ = 0;  ///< How often `decide` has thrown Stop in this episode.
    std::string sending_, received_;
    std::size_t line_ = 0;  ///< How many received bytes have been read.
};

}  // namespace simenv

#endif
