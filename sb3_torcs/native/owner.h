// The process that started the game, for the libraries of ours inside it.
#pragma once

#include <unistd.h>

#include <chrono>
#include <cstdlib>
#include <filesystem>
#include <string>
#include <system_error>
#include <thread>

namespace torcs {

// Ends the game when its owner is gone, and removes its private folder, which nobody else would do.
// A game that a user started has no owner, and goes on.
class Owner {
public:
    Owner() {
        if (const char* owner = std::getenv("SB3_TORCS_OWNER")) owner_ = std::atoi(owner);
        if (const char* folder = std::getenv("SB3_TORCS_FOLDER")) folder_ = folder;
    }

    bool gone() const { return owner_ > 0 && getppid() != owner_; }

    // Call it often; it checks only now and then.
    void check() {
        const auto now = std::chrono::steady_clock::now();
        if (now - checked_ < std::chrono::milliseconds(500)) return;
        checked_ = now;
        if (gone()) end();
    }

    // Call it when something is lost that is often lost together with the owner, such as the
    // display of a session that ends. The owner may end a little later.
    void await_end(std::chrono::milliseconds patience) {
        constexpr auto pause = std::chrono::milliseconds(10);
        for (; patience.count() > 0 && owner_ > 0 && !gone(); patience -= pause)
            std::this_thread::sleep_for(pause);
        if (gone()) end();
    }

    // The other end of a pipe or socket was closed. When a process is killed, these close first,
    // and its children notice its end a little later.
    [[noreturn]] void lost_contact() {
        await_end(std::chrono::seconds(2));
        _exit(1);
    }

private:
    // As torcs/process.py names them: whatever else the variable says, nothing else is removed.
    static constexpr const char* FOLDER_PREFIX = "sb3-torcs-game-";

    [[noreturn]] void end() {
        std::error_code ignored;
        const bool is_private = folder_.filename().string().rfind(FOLDER_PREFIX, 0) == 0;
        if (is_private) std::filesystem::remove_all(folder_, ignored);
        _exit(1);
    }

    int owner_ = 0;
    std::filesystem::path folder_;
    std::chrono::steady_clock::time_point checked_{};
};

}  // namespace torcs
