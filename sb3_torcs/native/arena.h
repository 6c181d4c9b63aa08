// The heap of one race: everything its modules allocate lies in one range of memory.
//
// This is what makes a race a value. Copying the range (and the modules' global variables) is a
// snapshot of cars, collision library and robots alike; copying it back continues bit for bit; and
// closing a race gives back everything, whatever the game's code forgot to free.
#pragma once

#include <cstddef>
#include <vector>

namespace torcs {

class Arena {
public:
    // Memory is only reserved, and used page by page. Construct it under the game's lock.
    explicit Arena(std::size_t reserve);
    Arena(const Arena&) = delete;
    Arena& operator=(const Arena&) = delete;

    void* allocate(std::size_t size);
    void release(void* memory);

    // The same, with as much unused room before it as the block is large.
    void* allocate_roomy(std::size_t size);
    void release_roomy(void* memory);  // takes any block

    std::size_t size_of(const void* memory) const;
    bool owns(const void* memory) const { return memory >= base_ && memory < base_ + reserve_; }

    // Free everything and give the pages back. Later allocations get the same addresses as the
    // first.
    void clear();

    std::vector<char> save() const;
    void restore(const std::vector<char>& saved);

private:
    static constexpr int MOST_ROOMY = 512;
    struct Roomy {
        void* memory;
        void* block;  // with the room
    };
    // This lies in the arena itself, so that a snapshot holds it.
    struct Head {
        std::size_t used;
        void* free[64];  // lists of released blocks, by size class
        int roomy_number;
        Roomy roomy[MOST_ROOMY];
    };
    struct Block {
        std::size_t size_class;
        void* next_free;  // also keeps what follows aligned to 16 bytes
    };
    Head& head() const { return *reinterpret_cast<Head*>(base_); }
    void reset_head();

    char* base_;
    std::size_t reserve_;
};

// Whether some arena owns this address: for memory that is freed when no race is being driven.
bool in_any_arena(const void* memory);

}  // namespace torcs
