// The conversation with one client, over UDP.
//
// Datagrams get lost, doubled and late. A client that comes back introduces itself again and is
// taken up where the race is; but not while another one drives, see `is_admitted`. One that missed
// a state says its last action again; if it tells which state that was for (see Action::lap_time),
// the newest state is sent once more.
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

    // As that, without waiting: for the others, who want an answer, too.
    void hear_introduction();

    // Sends a state and waits for what the client answers. Past the deadline that is nothing, or
    // its late answer to an older state. Who wants a restart gets no more states before.
    std::optional<Action> ask(const State& state);

    // Sends a state that needs no answer.
    void tell(const State& state);

    // Says why no more states come. Only the first time after it was identified.
    void dismiss(std::string_view reason);

    // How the client that is there now introduced itself.
    const Init& init() const { return init_; }

    // What it calls itself, else its address; empty before there was one.
    const std::string& name() const { return name_; }

    // Name and address, where both are known.
    std::string description() const;

    long timesteps() const { return timesteps_; }  // states that were sent
    long late() const { return late_; }            // of them, answered too late

private:
    using Clock = std::chrono::steady_clock;

    bool look(Clock::time_point until);
    bool wait(Clock::time_point until);         // whether a datagram came
    std::optional<std::string_view> receive();  // the next one that has come
    bool is_from_client() const;
    bool wants_restart() const;
    // Whether the client has owed an answer for so long that it may be gone; or its introduction,
    // since it was dismissed.
    bool is_silent() const;
    // Whether the sender wanted to drive while the client did.
    bool was_refused() const;
    // Whether who introduces itself now may drive: it is the same one, or that one may be gone, or
    // nobody drives. A restart is no chance for who was refused: the client comes back.
    bool is_admitted() const;
    void refuse();
    void hear_stranger(std::string_view text);
    void note(const std::string& what);  // for who runs the server
    void await_client();
    // Everything that has come, up to the wish for a restart; `answers` is whether to the state
    // that was sent last.
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
    long timesteps_ = 0, late_ = 0;
};

// Ends the game when nobody is left for whom it runs. Looks only now and then.
void watch_owner();

}  // namespace torcs::scr
