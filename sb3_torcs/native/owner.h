// The process that started the game, for the libraries of ours inside it.
#pragma once

#include <chrono>
#include <cstdlib>
#include <filesystem>
#include <string>
#include <system_error>
#include <thread>
#include <unistd.h>

namespace torcs {

// Ends the game when its owner is gone, and removes its private folder: nobody else would.
// A game that a user started has no owner, and is left alone.
class Owner {
public:
    Owner() {
        if (const char* owner = std::getenv("SB3_TORCS_OWNER")) owner_ = std::atoi(owner);
        if (const char* folder = std::getenv("SB3_TORCS_FOLDER")) folder_ = folder;
    }

    bool gone() const { return owner_ > 0 && getppid() != owner_; }

    // To be called often: it looks only now and then.
    void check() {
        const auto now = std::chrono::steady_clock::now();
        if (now - checked_ < std::chrono::milliseconds(500)) return;
        checked_ = now;
        if (gone()) end();
    }

    // The other end of a pipe or socket was closed. Of a process that is killed these go first,
    // its children notice a little later.
    [[noreturn]] void lost_contact() {
        for (int tries = 0; tries < 200 && owner_ > 0 && !gone(); ++tries) {
            std::this_thread::sleep_for(std::chrono::milliseconds(10));
        }
        if (gone()) end();
        _exit(1);
    }

private:
    [[noreturn]] void end() {
        std::error_code ignored;
        if (!folder_.empty()) std::filesystem::remove_all(folder_, ignored);
        _exit(1);
    }

    int owner_ = 0;
    std::string folder_;
    std::chrono::steady_clock::time_point checked_{};
};

}  // namespace torcs
