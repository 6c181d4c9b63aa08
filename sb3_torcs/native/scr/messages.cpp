#include "messages.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstring>
#include <iterator>

namespace torcs::scr {
namespace {

constexpr double RADIANS = M_PI / 180.0;  // per degree
constexpr double KM_PER_HOUR = 3.6;       // per m/s
// The server calls revolutions what is ten times the angular speed.
constexpr double RPM = 10.0;
constexpr int DIGITS = 6;
constexpr int HIGHEST_GEAR = 8;  // the game's cars have room for ten, with reverse and neutral

struct Tag {
    const char* name;
    int numbers;
    double scale;  // of the text's unit per SI
};

// In the order of the members of State.
constexpr Tag STATE_TAGS[] = {
    {"angle", 1, 1.0},
    {"curLapTime", 1, 1.0},
    {"damage", 1, 1.0},
    {"distFromStart", 1, 1.0},
    {"distRaced", 1, 1.0},
    {"fuel", 1, 1.0},
    {"gear", 1, 1.0},
    {"lastLapTime", 1, 1.0},
    {"opponents", 36, 1.0},
    {"racePos", 1, 1.0},
    {"rpm", 1, RPM},
    {"speedX", 1, KM_PER_HOUR},
    {"speedY", 1, KM_PER_HOUR},
    {"speedZ", 1, KM_PER_HOUR},
    {"track", 19, 1.0},
    {"trackPos", 1, 1.0},
    {"wheelSpinVel", 4, 1.0},
    {"z", 1, 1.0},
    {"focus", FOCUS_BEAMS, 1.0},
    {"yawRate", 1, 1.0},
};
constexpr std::size_t PROTOCOL_TAGS = 19;  // all but our extensions
static_assert(std::size(STATE_TAGS) == PROTOCOL_TAGS + 1);

bool is_space(char c) { return c == ' ' || (c >= '\t' && c <= '\r'); }

std::string_view trimmed(std::string_view text) {
    while (!text.empty() && is_space(text.front())) text.remove_prefix(1);
    while (!text.empty() && is_space(text.back())) text.remove_suffix(1);
    return text;
}

// Takes the first word off.
std::string_view next_word(std::string_view& text) {
    text = trimmed(text);
    const auto end = std::find_if(text.begin(), text.end(), is_space);
    const std::string_view word = text.substr(0, static_cast<std::size_t>(end - text.begin()));
    text.remove_prefix(word.size());
    return word;
}

std::optional<double> number(std::string_view word) {
    if (!word.empty() && word.front() == '+') word.remove_prefix(1);
    double value = 0.0;
    // Numbers that begin a longer word count, as they do for C++ streams: "1," is 1.
    const auto result = std::from_chars(word.data(), word.data() + word.size(), value);
    if (result.ec != std::errc() || !std::isfinite(value)) return {};
    return value;
}

// Reads numbers until there is something else; returns how many.
template <std::size_t n>
std::size_t numbers(std::string_view text, std::array<double, n>& values) {
    for (std::size_t i = 0; i < n; i++) {
        const auto value = number(next_word(text));
        if (!value) return i;
        values[i] = *value;
    }
    return n;
}

// Calls `use(tag, rest)` for each "(tag rest)" of a message. Brackets do not nest: a second opening
// bracket begins a new tag.
template <typename Use>
void for_each_tag(std::string_view text, Use use) {
    text = text.substr(0, text.find('\0'));
    for (std::size_t open = text.find('('); open != text.npos; open = text.find('(')) {
        text.remove_prefix(open + 1);
        const std::size_t end = text.find_first_of("()");
        std::string_view rest = text.substr(0, end);
        const std::string_view tag = next_word(rest);
        use(tag, rest);
    }
}

// Keeps the characters that the game can draw and write to its files.
std::string plain(std::string_view text) {
    std::string name(text.substr(0, NAME_LENGTH - 1));
    for (char& c : name) {
        const bool is_letter = (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z');
        const bool is_digit = c >= '0' && c <= '9';
        if (!is_letter && !is_digit && !std::strchr(" -_.:+@", c)) c = '_';
    }
    return name;
}

char* write(double number, bool exact, char* begin, char* end) {
    const auto general = std::chars_format::general;
    return exact ? std::to_chars(begin, end, number, general).ptr
                 : std::to_chars(begin, end, number, general, DIGITS).ptr;
}

}  // namespace

double as_written(double number, bool exact) {
    char text[32];
    std::from_chars(text, write(number, exact, text, text + sizeof text), number);
    return number;
}

std::size_t format_state(const State& state, bool exact, char (&text)[LONGEST_STATE]) {
    char* end = text;
    const auto value = reinterpret_cast<const char*>(&state);
    std::size_t offset = 0;
    for (std::size_t place = 0; place < (exact ? std::size(STATE_TAGS) : PROTOCOL_TAGS); place++) {
        const Tag& tag = STATE_TAGS[place];
        *end++ = '(';
        const std::size_t length = std::strlen(tag.name);
        end = std::copy_n(tag.name, length, end);
        for (int i = 0; i < tag.numbers; i++, offset += sizeof(double)) {
            double number;
            std::memcpy(&number, value + offset, sizeof number);
            *end++ = ' ';
            end = write(number * tag.scale, exact, end, text + LONGEST_STATE);
        }
        *end++ = ')';
    }
    *end++ = '\0';
    return static_cast<std::size_t>(end - text);
}

Action parse_action(std::string_view text) {
    Action action;
    for_each_tag(text, [&](std::string_view tag, std::string_view rest) {
        const auto value = number(next_word(rest));
        if (!value) return;
        if (tag == "accel") action.throttle = std::clamp(*value, 0.0, 1.0);
        if (tag == "brake") action.brake = std::clamp(*value, 0.0, 1.0);
        if (tag == "clutch") action.clutch = std::clamp(*value, 0.0, 1.0);
        if (tag == "steer") action.steering = std::clamp(*value, -1.0, 1.0);
        if (tag == "gear")
            action.gear = static_cast<int>(std::clamp(*value, -1.0, double{HIGHEST_GEAR}));
        if (tag == "meta") action.restart = *value == 1.0;
        if (tag == "focus") {
            action.focus.reset();
            if (std::abs(*value) <= 90.0) action.focus = *value * RADIANS;
        }
        if (tag == "curLapTime") action.lap_time = value;
    });
    return action;
}

Init parse_init(std::string_view text) {
    Init init;
    std::array<double, 19> degrees;
    for (std::size_t i = 0; i < degrees.size(); i++) degrees[i] = -90.0 + 10.0 * double(i);
    for_each_tag(text, [&](std::string_view tag, std::string_view rest) {
        std::array<double, 19> angles;
        std::array<double, 4> start;
        if (tag == "init" && numbers(rest, angles) == angles.size()) degrees = angles;
        if (tag == "start" && numbers(rest, start) == start.size())
            init.start = Start{start[0], start[1], start[2], start[3]};
        if (tag == "digits") init.exact = number(next_word(rest)).value_or(DIGITS) > DIGITS;
        if (tag == "name") init.name = plain(trimmed(rest));
    });
    for (std::size_t i = 0; i < degrees.size(); i++) init.angles[i] = degrees[i] * RADIANS;
    return init;
}

}  // namespace torcs::scr
