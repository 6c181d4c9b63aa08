#include "arena.h"

#include <sys/mman.h>

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <cstring>

#include "errors.h"

namespace torcs {

namespace {

// Classes in steps of 16 bytes up to 512, then powers of two.
constexpr std::size_t SMALL = 512;
constexpr std::size_t SMALL_CLASSES = SMALL / 16 + 1;

std::size_t class_of(std::size_t size) {
    if (size <= SMALL) return (size + 15) / 16;
    std::size_t bits = 64 - static_cast<std::size_t>(__builtin_clzll(size - 1));
    return SMALL_CLASSES + bits - 10;
}

std::size_t class_size(std::size_t size_class) {
    if (size_class < SMALL_CLASSES) return std::max<std::size_t>(size_class, 1) * 16;
    return std::size_t{1} << (size_class - SMALL_CLASSES + 10);
}

// The collision library orders its objects by address: cars on the heap, walls among the module's
// variables. In the game the heap lies below the libraries, so arenas are reserved there, too.
constexpr std::uintptr_t FIRST_ARENA = 0x200000000000;

// Two for each race. With as many, the kernel runs out of mappings (vm.max_map_count), too.
constexpr int MOST_ARENAS = 16384;

struct Range {
    const char* begin;
    const char* end;
};

// It only grows, so that it can be read without a lock. It is never destroyed, because modules free
// memory while the process ends.
Range ranges[MOST_ARENAS];
std::atomic<int> ranges_number{0};
std::uintptr_t next_arena = FIRST_ARENA;

}  // namespace

Arena::Arena(std::size_t reserve) : reserve_(reserve) {
    const int number = ranges_number.load();
    void* memory = number == MOST_ARENAS
                       ? MAP_FAILED
                       : mmap(reinterpret_cast<void*>(next_arena), reserve, PROT_READ | PROT_WRITE,
                              MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
    if (memory == MAP_FAILED)
        throw Error("BackendUnavailable",
                    "no address space for another race; close environments that are not needed, "
                    "or raise the limit (ulimit -v)");
    base_ = static_cast<char*>(memory);
    next_arena += reserve;
    ranges[number] = {base_, base_ + reserve};
    ranges_number.store(number + 1);
    reset_head();
}

void Arena::reset_head() {
    std::memset(base_, 0, sizeof(Head));
    head().used = (sizeof(Head) + 15) / 16 * 16;
}

void* Arena::allocate(std::size_t size) {
    const std::size_t size_class = class_of(size);
    Head& top = head();
    if (void* memory = top.free[size_class]) {
        top.free[size_class] = (static_cast<Block*>(memory) - 1)->next_free;
        return memory;
    }
    const std::size_t whole = sizeof(Block) + class_size(size_class);
    if (top.used + whole > reserve_)
        throw Error("BackendUnavailable", "a race has used up its memory; take fewer opponents");
    Block* block = reinterpret_cast<Block*>(base_ + top.used);
    top.used += whole;
    block->size_class = size_class;
    return block + 1;
}

void Arena::release(void* memory) {
    Block* block = static_cast<Block*>(memory) - 1;
    block->next_free = head().free[block->size_class];
    head().free[block->size_class] = memory;
}

void* Arena::allocate_roomy(std::size_t size) {
    Head& top = head();
    if (top.roomy_number == MOST_ROOMY) return allocate(size);
    const std::size_t room = (size + 15) / 16 * 16;
    char* block = static_cast<char*>(allocate(room + size));
    top.roomy[top.roomy_number++] = {block + room, block};
    return block + room;
}

void Arena::release_roomy(void* memory) {
    Head& top = head();
    Roomy* end = top.roomy + top.roomy_number;
    Roomy* found = std::find_if(top.roomy, end,
                                [memory](const Roomy& roomy) { return roomy.memory == memory; });
    if (found == end) return release(memory);
    release(found->block);
    *found = end[-1];
    top.roomy_number--;
}

std::size_t Arena::size_of(const void* memory) const {
    return class_size((static_cast<const Block*>(memory) - 1)->size_class);
}

void Arena::clear() {
    madvise(base_, reserve_, MADV_DONTNEED);
    reset_head();
}

std::vector<char> Arena::save() const { return {base_, base_ + head().used}; }

void Arena::restore(const std::vector<char>& saved) {
    const std::size_t used = head().used;
    std::memcpy(base_, saved.data(), saved.size());
    // Memory that was allocated since the snapshot was zero then, and code that reads before it
    // writes must find zeros again.
    if (used > saved.size()) std::memset(base_ + saved.size(), 0, used - saved.size());
}

bool in_any_arena(const void* memory) {
    const char* address = static_cast<const char*>(memory);
    return std::any_of(ranges, ranges + ranges_number.load(), [address](const Range& range) {
        return address >= range.begin && address < range.end;
    });
}

}  // namespace torcs
