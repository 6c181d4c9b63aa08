#include "client.h"

#include <arpa/inet.h>
#include <poll.h>
#include <sched.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>

#include "../owner.h"
#include "loop.h"

namespace torcs::scr {
namespace {

using namespace std::chrono_literals;

constexpr int FIRST_PORT = 3001;
constexpr auto DEADLINE = 10ms;  // the server's usual one
constexpr auto SILENCE = 2s;     // after which a client may be gone: most ask again every second
constexpr auto WATCH = 500ms;    // how often a wait looks for the game's owner
constexpr auto AWAKE = 100us;    // how long a wait looks for an answer before it sleeps
constexpr int MANY_NOTES = 100;  // for the user of the server; more would only fill the disk
// A wait begins by polling. Polls that find an answer add 1 to a score of at most FULL_LUCK, others
// take 2 off; when it is used up, the next -NO_LUCK waits sleep at once.
constexpr int FULL_LUCK = 8;
constexpr int NO_LUCK = -200;

Owner& owner() {
    static Owner owner;
    return owner;
}

[[noreturn]] void fail(int index, const char* what, const char* hint) {
    std::printf("scr_server %d: %s (%s); %s\n", index, what, std::strerror(errno), hint);
    std::fflush(stdout);
    std::exit(1);
}

// The k-th of the descriptors in the list "5,6"; -1 if there is none.
int inherited_socket(const char* list, int k) {
    while (k-- > 0 && list) {
        list = std::strchr(list, ',');
        if (list) list++;
    }
    return list && *list >= '0' && *list <= '9' ? std::atoi(list) : -1;
}

int bound_socket(int index) {
    const int bound = socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0);
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = htonl(INADDR_ANY);
    address.sin_port = htons(static_cast<std::uint16_t>(FIRST_PORT + index));
    if (bound < 0 || bind(bound, reinterpret_cast<sockaddr*>(&address), sizeof address) != 0)
        fail(index, ("UDP port " + std::to_string(FIRST_PORT + index) + " cannot be had").c_str(),
             "end the program that has it");
    std::printf("scr_server %d: waits for its client at UDP port %d\n", index, FIRST_PORT + index);
    std::fflush(stdout);
    return bound;
}

std::string text_of(const sockaddr_storage& address) {
    const auto& internet = reinterpret_cast<const sockaddr_in&>(address);
    char host[INET_ADDRSTRLEN] = "";
    inet_ntop(AF_INET, &internet.sin_addr, host, sizeof host);
    return std::string(host) + ":" + std::to_string(ntohs(internet.sin_port));
}

std::chrono::microseconds deadline_of(int index) {
    const char* text = std::getenv("SB3_TORCS_SCR_DEADLINE");
    if (!text) return DEADLINE;
    if (std::strcmp(text, "wait") == 0) return 0us;
    char* end;
    const long microseconds = std::strtol(text, &end, 10);
    if (*end != '\0' || microseconds <= 0)
        fail(index, "SB3_TORCS_SCR_DEADLINE is no time", "set it to wait or to microseconds");
    return std::chrono::microseconds(microseconds);
}

}  // namespace

void watch_owner() { owner().check(); }

Client::~Client() { dismiss(SHUTDOWN); }

void Client::open(int index) {
    if (opened_) return;
    opened_ = true;
    index_ = index;
    deadline_ = deadline_of(index);
    const char* inherited = std::getenv("SB3_TORCS_SCR_SOCKETS");
    socket_ = inherited ? inherited_socket(inherited, index) : bound_socket(index);
}

bool Client::await_introduction() {
    watch_owner();
    if (!identified_ && wait(Clock::now() + WATCH)) hear_introduction();
    return identified_;
}

void Client::hear_introduction() {
    const bool vacant = !identified_;
    bool introduced = false;
    // If several clients wait, the newest one is the one that still listens.
    while (const auto text = receive()) {
        if (is_init(*text)) {
            if ((vacant && !was_refused()) || is_admitted()) {
                adopt(*text);
                introduced = true;
            } else {
                refuse();
            }
        } else if (!is_from_client()) {
            hear_stranger(*text);
        } else {
            awaited_since_ = Clock::now();
            if (parse_action(*text).restart) send(RESTART);  // it missed that
        }
    }
    if (introduced) send(IDENTIFIED);
}

std::optional<Action> Client::ask(const State& state) {
    late_answer_.reset();
    answer_.reset();
    read_all(false);
    if (answer_) return answer_;
    tell(state);
    ticks_++;
    owed_++;
    const bool forever = deadline_ == Clock::duration::zero();
    const Clock::time_point until = Clock::now() + deadline_;
    // A late client answers the older states first. If these were taken as the answer to this
    // state, the client would stay behind for the rest of the race.
    while (!ending() && !wants_restart() && (!answer_ || (owed_ > 0 && !forever))) {
        watch_owner();
        const Clock::time_point next = Clock::now() + WATCH;
        if (wait(forever ? next : std::min(until, next))) read_all(true);
        if (!forever && Clock::now() >= until) break;
    }
    if (answer_) {
        owed_ = 0;
        return answer_;
    }
    if (!ending()) count_late();
    return late_answer_;
}

// A race is lost by late answers: who runs it hears of them while it goes on.
void Client::count_late() {
    late_++;
    if (late_ != next_report_) return;
    next_report_ *= 10;
    report(description() + " is too slow: " + std::to_string(late_) + " of " +
           std::to_string(ticks_) + " answers came late");
}

void Client::tell(const State& state) {
    state_size_ = format_state(state, init_.exact, state_);
    lap_time_ = as_written(state.lap_time, init_.exact);
    send_state();
}

void Client::dismiss(std::string_view reason) {
    if (identified_) send(reason);
    identified_ = awaited_ = false;
    await_client();
}

// ---- Datagrams ----------------------------------------------------------------------------------

// Waking up takes longer than many clients need for an answer. So the game polls for the answer a
// little while before it sleeps, unless polling does not help, as with more processes than
// processors.
bool Client::look(Clock::time_point until) {
    if (luck_ < 0) {
        ++luck_;
        return false;
    }
    pollfd looking{socket_, POLLIN, 0};
    const Clock::time_point end = std::min(until, Clock::now() + AWAKE);
    do {
        if (poll(&looking, 1, 0) > 0) {
            luck_ = std::min(luck_ + 1, FULL_LUCK);
            return true;
        }
        sched_yield();
    } while (Clock::now() < end);
    luck_ = luck_ >= 2 ? luck_ - 2 : NO_LUCK;
    return false;
}

bool Client::wait(Clock::time_point until) {
    if (look(until)) return true;
    const auto left = std::chrono::ceil<std::chrono::nanoseconds>(until - Clock::now());
    const auto nanoseconds = std::max<long>(left.count(), 0);
    const timespec timeout{nanoseconds / 1'000'000'000, nanoseconds % 1'000'000'000};
    pollfd waiting{socket_, POLLIN, 0};
    return ppoll(&waiting, 1, &timeout, nullptr) > 0;
}

std::optional<std::string_view> Client::receive() {
    sender_size_ = sizeof sender_;
    const ssize_t size = recvfrom(socket_, message_, sizeof message_, MSG_DONTWAIT,
                                  reinterpret_cast<sockaddr*>(&sender_), &sender_size_);
    if (size < 0) return {};
    return std::string_view(message_, static_cast<std::size_t>(size));
}

bool Client::is_from_client() const {
    return sender_size_ == client_size_ && std::memcmp(&sender_, &client_, client_size_) == 0;
}

bool Client::wants_restart() const { return answer_ && answer_->restart; }

// Datagrams after a wish for a restart are for the next race. Otherwise a client that introduces
// itself at once would join the race that ends.
void Client::read_all(bool answers) {
    while (!wants_restart()) {
        const auto text = receive();
        if (!text) return;
        read(*text, answers);
    }
}

void Client::read(std::string_view text, bool answers) {
    if (is_init(text)) {
        if (!is_admitted()) return refuse();
        adopt(text);
        send(IDENTIFIED);
        if (answers) send_state();
        return;
    }
    if (!is_from_client()) return hear_stranger(text);
    awaited_ = false;
    const Action action = parse_action(text);
    owed_ = action.lap_time ? 0 : std::max(owed_ - 1, 0L);
    if (action.restart || (answers && action.lap_time.value_or(lap_time_) == lap_time_)) {
        answer_ = action;
        return;
    }
    late_answer_ = action;
    if (answers && deadline_ == Clock::duration::zero()) send_state();
}

void Client::adopt(std::string_view text) {
    if (identified_ && !is_from_client() && is_silent())
        note("takes over from " + description() + ", who was silent for two seconds");
    init_ = parse_init(text);
    client_ = sender_;
    client_size_ = sender_size_;
    identified_ = true;
    owed_ = 0;
    refused_size_ = 0;
    awaited_ = false;
    await_client();
    const bool is_first = name_.empty();
    name_ = init_.name.empty() ? text_of(client_) : init_.name;
    if (is_first) note(init_.name.empty() ? "drives" : "drives, and calls itself " + name_);
}

bool Client::is_silent() const { return awaited_ && Clock::now() - awaited_since_ >= SILENCE; }

bool Client::was_refused() const {
    return sender_size_ == refused_size_ && std::memcmp(&sender_, &refused_, refused_size_) == 0;
}

bool Client::is_admitted() const {
    return is_from_client() || is_silent() || !(identified_ || was_refused());
}

void Client::await_client() {
    if (awaited_) return;
    awaited_ = true;
    awaited_since_ = Clock::now();
}

// ---- For who runs the server --------------------------------------------------------------------

std::string Client::description() const {
    if (name_.empty()) return {};
    return init_.name.empty() ? name_ : name_ + " at " + text_of(client_);
}

void Client::refuse() {
    refused_ = sender_;
    refused_size_ = sender_size_;
    note("wants to drive, but " + description() +
         " does; end one of them, or give it another port");
}

// A client of another server introduces itself by another word. Actions of a client that is gone,
// or that now has another socket, are not introductions.
void Client::hear_stranger(std::string_view text) {
    if (text.empty() || text.front() == '(') return;
    std::string said(text.substr(0, 20));
    for (char& c : said)
        if (c < ' ' || c > '~') c = '?';
    note("says '" + said + "', not SCR(init ...), and is not heard");
}

void Client::note(const std::string& what) {
    const std::string text = text_of(sender_) + " " + what;
    if (text == last_note_ || notes_ >= MANY_NOTES) return;
    last_note_ = text;
    ++notes_;
    report(text);
}

void Client::report(const std::string& text) const {
    std::printf("scr_server %d: %s\n", index_, text.c_str());
    std::fflush(stdout);
}

// ---- What is sent -------------------------------------------------------------------------------

void Client::send(std::string_view text) const {
    // The texts are literals, and are sent with their closing zero.
    sendto(socket_, text.data(), text.size() + 1, MSG_DONTWAIT,
           reinterpret_cast<const sockaddr*>(&client_), client_size_);
}

void Client::send_state() {
    await_client();
    sendto(socket_, state_, state_size_, MSG_DONTWAIT, reinterpret_cast<const sockaddr*>(&client_),
           client_size_);
}

}  // namespace torcs::scr
