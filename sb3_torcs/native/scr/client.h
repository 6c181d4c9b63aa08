// The conversation with one client, over UDP.
//
// Datagrams get lost, doubled and late. A client that comes back introduces itself again and joins
// the race as it is, unless another client drives; see `is_admitted`. A client that missed a state
// repeats its last action. If it says which state that action was for (see Action::lap_time), the
// newest state is sent again.
#pragma once

#include <netinet/in.h>

#include <chrono>
#include <optional>
#include <string>
#include <string_view>

#include "messages.h"

namespace torcs::scr {

class Client {
public:
    ~Client();  // tells it that the game ends

    // Takes the socket that was handed to this process for a driver, or binds one. Calling it
    // again does no harm. Ends the game if the port is taken.
    void open(int index);
    bool has_network() const { return socket_ >= 0; }

    // Waits a little while for a client to introduce itself. Returns whether it has, since the
    // last one was dismissed.
    bool await_introduction();

    // The same without waiting, for the other clients, which want an answer, too.
    void hear_introduction();

    // Sends a state and waits for the client's answer. After the deadline the result is nothing, or
    // the late answer to an older state. A client that wants a restart gets no more states before
    // it.
    std::optional<Action> ask(const State& state);

    // Sends a state that needs no answer.
    void tell(const State& state);

    // Tells the client why no more states come. Only the first call after it was identified does
    // so.
    void dismiss(std::string_view reason);

    // How the present client introduced itself.
    const Init& init() const { return init_; }

    // The name it gave itself, else its address; empty before the first client.
    const std::string& name() const { return name_; }

    // Name and address, where both are known.
    std::string description() const;

    long ticks() const { return ticks_; }  // states that were sent
    long late() const { return late_; }    // of them, answered too late

    // Prints a line for who runs the server.
    void report(const std::string& text) const;

private:
    using Clock = std::chrono::steady_clock;

    bool look(Clock::time_point until);
    bool wait(Clock::time_point until);         // whether a datagram came
    std::optional<std::string_view> receive();  // the next one that has come
    bool is_from_client() const;
    bool wants_restart() const;
    // Whether the client may be gone: it has owed an answer, or its introduction since it was
    // dismissed, for too long.
    bool is_silent() const;
    // Whether the sender wanted to drive while the client did.
    bool was_refused() const;
    // Whether the client that introduces itself now may drive: it is the one that drives, or that
    // one may be gone, or nobody drives. A refused client does not get in at a restart, because the
    // driving one comes back.
    bool is_admitted() const;
    void refuse();
    void hear_stranger(std::string_view text);
    void note(const std::string& what);  // reports what its sender does, once
    void count_late();
    void await_client();
    // Reads all datagrams up to a wish for a restart; `answers` tells whether one answers the last
    // state.
    void read_all(bool answers);
    void read(std::string_view text, bool answers);
    void adopt(std::string_view text);
    void send(std::string_view text) const;
    void send_state();

    int socket_ = -1;
    int luck_ = 0;  // with looking for answers; below zero it does not
    int index_ = 0;
    bool opened_ = false, identified_ = false;
    Clock::duration deadline_{};  // zero waits for ever
    sockaddr_storage client_{}, sender_{}, refused_{};
    socklen_t client_size_ = 0, sender_size_ = 0, refused_size_ = 0;
    Init init_{};
    std::string name_, last_note_;
    int notes_ = 0;
    bool awaited_ = false;             // the client owes an answer
    Clock::time_point awaited_since_;  // ... since then
    char state_[LONGEST_STATE];
    std::size_t state_size_ = 0;
    double lap_time_ = 0.0;  // [s] of that state, as it was written
    std::optional<Action> answer_, late_answer_;
    long owed_ = 0;  // states that may still be answered, by who does not say which one he answers
    char message_[LONGEST_MESSAGE];
    long ticks_ = 0, late_ = 0;
    long next_report_ = 10;  // when so many answers were late
};

// Ends the game when its owner is gone. Checks only now and then.
void watch_owner();

}  // namespace torcs::scr
