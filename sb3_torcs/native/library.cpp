#include "library.h"

#include <dlfcn.h>
#include <elf.h>
#include <link.h>
#include <locale.h>
#include <sys/mman.h>
#include <unistd.h>

#include <cerrno>
#include <cstdarg>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <map>
#include <new>
#include <unordered_map>

#include "arena.h"
#include "errors.h"
#include "maths/maths.h"

namespace torcs {

// glibc's rand() is its random(), which a process begins with seed 1.
struct Random {
    random_data state;
    char words[128];
};

namespace {

const char* const REINSTALL = "; install the game again with: sb3-torcs install-torcs";

thread_local Host* current = nullptr;
thread_local std::string messages;  // what was printed since they were forgotten

// ---- What the modules' imports become -----------------------------------------------------------

void* allocate(std::size_t size) { return current ? current->arena->allocate(size) : malloc(size); }

void release(void* memory) {
    if (!memory) return;
    if (current && current->arena->owns(memory))
        current->arena->release(memory);
    else if (!in_any_arena(memory))
        free(memory);
}

// Some robots (inferno, lliaw, tita) plan in ring buffers of 25 kB. When the car is pushed back
// over the ring's beginning, the index is the remainder of a negative number, and so negative. In
// the game the robot then overwrites the memory before the buffer, which crashes the game sooner or
// later. Here that memory is unused room.
constexpr std::size_t SMALLEST_RING = 4 << 10, LARGEST_RING = 64 << 10;

void* allocate_array(std::size_t size) {
    if (!current || size < SMALLEST_RING || size > LARGEST_RING) return allocate(size);
    return current->arena->allocate_roomy(size);
}

void release_array(void* memory) {
    if (memory && current && current->arena->owns(memory))
        current->arena->release_roomy(memory);
    else
        release(memory);
}

void* allocate_zeroed(std::size_t number, std::size_t size) {
    if (!current) return calloc(number, size);
    void* memory = allocate(number * size);
    return std::memset(memory, 0, number * size);
}

void* reallocate(void* memory, std::size_t size) {
    if (!memory) return allocate(size);
    if (!current || !current->arena->owns(memory)) return realloc(memory, size);
    const std::size_t had = current->arena->size_of(memory);
    if (size <= had) return memory;
    void* larger = std::memcpy(allocate(size), memory, had);
    release(memory);
    return larger;
}

char* duplicate(const char* text) {
    const std::size_t size = std::strlen(text) + 1;
    return static_cast<char*>(std::memcpy(allocate(size), text, size));
}

int random_number() {
    std::int32_t number = 0;
    if (!current) return rand();
    random_r(&current->random->state, &number);
    return number;
}

void seed_random(unsigned seed) {
    if (current) srandom_r(seed, &current->random->state);
}

// Names of functions of the robots that plan by splines, as the compiler writes them.
const char* const SPLINE = "_Z6splineidPKdS0_S0_";
const char* const SPLINE_FAMILY = "_Z17parametricslopespiPKdS0_PdS1_S1_";

// Some robots (berniw, inferno, lliaw, tita) plan how to pass by splines. They seek the interval of
// a number by halving, which never ends for one before the first of two knots: the game hangs. Here
// the only interval is the answer. For all other numbers this is what the robots compute, to the
// bit.
double spline(int knots, double at, const double* x, const double* y, const double* slopes) {
    int i = 0, last = knots - 1;
    while (i + 1 < last) {
        const int middle = (i + last) / 2;
        (x[middle] <= at ? i : last) = middle;
    }
    const double width = x[i + 1] - x[i], part = (at - x[i]) / width, rise = y[i + 1] - y[i];
    const double bend = rise - width * slopes[i];
    const double change = width * slopes[i + 1] - rise - bend;
    return y[i] + (rise + (bend + change * part) * (part - 1.0)) * part;
}

// One robot stops planning after a time by the clock. With a clock that stands still, it plans to
// the end on every machine.
long no_time_passes() { return 0; }

// Robots name files relative to the game's data. What they learn is not kept: with it, a second run
// would differ from the first.
FILE* open_file(const char* path, const char* mode) {
    if (std::strpbrk(mode, "wa+")) return fopen("/dev/null", mode);
    if (!current) return fopen(path, mode);
    if (path[0] != '/') return fopen((current->data + path).c_str(), mode);
    FILE* file = fopen(path, mode);
    if (file) return file;
    // A track names the files that all tracks share relative to itself, and it may lie outside of
    // the game's folder. Its own folders may have that name, too.
    const std::string name = path;
    const std::size_t common = name.rfind("/data/tracks/");
    return common == std::string::npos
               ? nullptr
               : fopen((current->data + name.substr(common + 1)).c_str(), mode);
}

int make_directory(const char*, unsigned) {
    errno = EROFS;
    return -1;
}

int keep_message(const char* format, va_list arguments) {
    constexpr std::size_t ENOUGH = 600;  // the first ones tell the cause
    char line[512];
    const int length = vsnprintf(line, sizeof line, format, arguments);
    std::string text = line;
    while (!text.empty() && (text.back() == '\n' || text.back() == ' ')) text.pop_back();
    if (!text.empty() && messages.size() < ENOUGH)
        messages += (messages.empty() ? "" : "; ") + text;
    return length;
}

int print(const char* format, ...) {
    va_list arguments;
    va_start(arguments, format);
    const int length = keep_message(format, arguments);
    va_end(arguments);
    return length;
}

int print_checked(int, const char* format, ...) {
    va_list arguments;
    va_start(arguments, format);
    const int length = keep_message(format, arguments);
    va_end(arguments);
    return length;
}

int print_list(const char* format, va_list arguments) { return keep_message(format, arguments); }

int print_list_checked(FILE*, int, const char* format, va_list arguments) {
    return keep_message(format, arguments);
}

int print_list_to(FILE*, const char* format, va_list arguments) {
    return keep_message(format, arguments);
}

int print_to(FILE*, const char* format, ...) {
    va_list arguments;
    va_start(arguments, format);
    const int length = keep_message(format, arguments);
    va_end(arguments);
    return length;
}

int print_to_checked(FILE*, int, const char* format, ...) {
    va_list arguments;
    va_start(arguments, format);
    const int length = keep_message(format, arguments);
    va_end(arguments);
    return length;
}

int print_line(const char* text) { return print("%s", text); }
int print_character(int character) { return character; }
void print_error(const char* text) { print("%s: %s", text, strerror(errno)); }

[[noreturn]] void leave(int) {
    const std::string reason = printed();
    throw Error("BackendUnavailable",
                "the game gave up: " +
                    (reason.empty() ? "its code, or a robot's, ended without a message" : reason));
}

[[noreturn]] void leave_by_abort() { leave(1); }

[[noreturn]] void fail_assertion(const char* expression, const char* file, unsigned line,
                                 const char*) {
    print("%s:%u: %s does not hold", file, line, expression);
    leave(1);
}

template <typename Function>
void* address(Function function) {
    return reinterpret_cast<void*>(function);
}

const std::unordered_map<std::string, void*>& replacements() {
    static const auto* table = new std::unordered_map<std::string, void*>{
        {"malloc", address(allocate)},
        {"calloc", address(allocate_zeroed)},
        {"realloc", address(reallocate)},
        {"free", address(release)},
        {"strdup", address(duplicate)},
        {"_Znwm", address(allocate)},
        {"_Znam", address(allocate_array)},
        {"_ZdlPv", address(release)},
        {"_ZdlPvm", address(release)},
        {"_ZdaPv", address(release_array)},
        {"_ZdaPvm", address(release_array)},
        {"rand", address(random_number)},
        {"srand", address(seed_random)},
        {"clock", address(no_time_passes)},
        {"fopen", address(open_file)},
        {"mkdir", address(make_directory)},
        {"printf", address(print)},
        {"__printf_chk", address(print_checked)},
        {"vprintf", address(print_list)},
        {"vfprintf", address(print_list_to)},
        {"__vfprintf_chk", address(print_list_checked)},
        {"fprintf", address(print_to)},
        {"__fprintf_chk", address(print_to_checked)},
        {"puts", address(print_line)},
        {"putchar", address(print_character)},
        {"perror", address(print_error)},
        {"exit", address(leave)},
        {"abort", address(leave_by_abort)},
        {"__assert_fail", address(fail_assertion)},
        {"sinf", address(maths::sinf)},
        {"cosf", address(maths::cosf)},
        {"sincosf", address(maths::sincosf)},
        {"expf", address(maths::expf)},
        {"logf", address(maths::logf)},
        {"tanf", address(maths::tanf)},
        {"atanf", address(maths::atanf)},
        {"asinf", address(maths::asinf)},
        {"acosf", address(maths::acosf)},
        {"tanhf", address(maths::tanhf)},
        {"atan2f", address(maths::atan2f)},
    };
    return *table;
}

// ---- Loading ------------------------------------------------------------------------------------

std::string loader_message() {
    const char* text = dlerror();
    return text ? text : "unknown reason";
}

// The loader trusts the headers of a file: one that ends too early would kill the process.
void check_whole(const std::vector<char>& bytes, const std::string& path, const char* error) {
    const auto* header = reinterpret_cast<const ElfW(Ehdr)*>(bytes.data());
    bool whole = bytes.size() >= sizeof(ElfW(Ehdr)) &&
                 std::memcmp(header->e_ident, ELFMAG, SELFMAG) == 0 &&
                 header->e_phoff + header->e_phnum * sizeof(ElfW(Phdr)) <= bytes.size();
    for (int i = 0; whole && i < header->e_phnum; i++) {
        const auto* part = reinterpret_cast<const ElfW(Phdr)*>(bytes.data() + header->e_phoff) + i;
        whole = part->p_offset <= bytes.size() && part->p_filesz <= bytes.size() - part->p_offset;
    }
    if (!whole) throw Error(error, path + " is no library, or only a part of one" + REINSTALL);
}

std::vector<char> read_library(const std::string& path, const char* error) {
    std::ifstream file(path, std::ios::binary);
    std::vector<char> bytes{std::istreambuf_iterator<char>(file), {}};
    if (!file || bytes.empty())
        throw Error(error, path + " cannot be read or is empty" + REINSTALL);
    check_whole(bytes, path, error);
    return bytes;
}

// A module may need one of the game's own libraries, by a name that only the game's wrapper script
// lets the loader find. Those are already loaded with global symbols, so the need is removed from
// the copy.
void forget_needs(std::vector<char>& bytes, const std::string& folder) {
    const auto at = [&bytes](std::size_t offset, std::size_t size) -> char* {
        return offset + size <= bytes.size() ? bytes.data() + offset : nullptr;
    };
    const auto* header = reinterpret_cast<ElfW(Ehdr)*>(at(0, sizeof(ElfW(Ehdr))));
    if (!header || std::memcmp(header->e_ident, ELFMAG, SELFMAG) != 0) return;
    const auto* parts =
        reinterpret_cast<ElfW(Phdr)*>(at(header->e_phoff, header->e_phnum * sizeof(ElfW(Phdr))));
    if (!parts) return;
    ElfW(Dyn)* first = nullptr;
    std::size_t number = 0;
    for (int i = 0; i < header->e_phnum; i++) {
        if (parts[i].p_type != PT_DYNAMIC) continue;
        first = reinterpret_cast<ElfW(Dyn)*>(at(parts[i].p_offset, parts[i].p_filesz));
        number = parts[i].p_filesz / sizeof(ElfW(Dyn));
    }
    if (!first) return;
    ElfW(Addr) names = 0;
    for (std::size_t i = 0; i < number; i++)
        if (first[i].d_tag == DT_STRTAB) names = first[i].d_un.d_ptr;
    for (int i = 0; i < header->e_phnum; i++) {
        const ElfW(Phdr) & part = parts[i];
        if (part.p_type != PT_LOAD || names < part.p_vaddr || names >= part.p_vaddr + part.p_filesz)
            continue;
        const std::size_t begin = names - part.p_vaddr + part.p_offset;
        for (std::size_t j = 0; j < number && first[j].d_tag != DT_NULL; j++) {
            const char* name = at(begin + first[j].d_un.d_val, 1);
            if (first[j].d_tag == DT_NEEDED && name && access((folder + name).c_str(), F_OK) == 0)
                first[j].d_tag = DT_DEBUG;  // has no meaning in a library
        }
    }
}

constexpr const char* NO_MAP = "failed to map segment";  // as the loader says it

[[noreturn]] void refuse_copy(const std::string& path, const char* error,
                              const std::string& reason) {
    std::string remedy = REINSTALL;
    if (reason.find(strerror(EMFILE)) != std::string::npos) {
        error = "BackendUnavailable";
        remedy = MORE_FILES;
    } else if (reason.find(NO_MAP) != std::string::npos ||
               reason.find(strerror(ENOMEM)) != std::string::npos) {
        error = "BackendUnavailable";
        remedy = MORE_MAPS;
    } else if (access("/proc/self/fd", F_OK) != 0) {
        error = "BackendUnavailable";
        remedy = "; the loader finds copies of modules in /proc, which is not mounted";
    }
    throw Error(error, path + " will not load: " + reason + remedy);
}

// The loader takes libraries of one name for one library, and a descriptor's number is used again.
// So the copies are counted, in binary digits that mean nothing in a path.
std::string name_of_copy(int descriptor) {
    static std::uint32_t copies = 0;
    std::string name = "/proc/self/fd";
    for (std::uint32_t rest = ++copies; rest > 0; rest /= 2) name += rest % 2 ? "/./" : "/";
    return name + "/" + std::to_string(descriptor);
}

void* open_copy(const std::string& path, const std::string& folder, const char* error) {
    std::vector<char> bytes = read_library(path, error);
    forget_needs(bytes, folder);
    const int copy = memfd_create("torcs-module", MFD_CLOEXEC);
    if (copy < 0) refuse_copy(path, error, strerror(errno));
    for (std::size_t done = 0; done < bytes.size();) {
        const ssize_t written = write(copy, bytes.data() + done, bytes.size() - done);
        if (written < 0) {
            close(copy);
            throw Error("BackendUnavailable", "no memory for a copy of " + path);
        }
        done += static_cast<std::size_t>(written);
    }
    void* handle = dlopen(name_of_copy(copy).c_str(), RTLD_NOW | RTLD_LOCAL);
    const std::string reason = handle ? "" : loader_message();
    close(copy);  // what is loaded stays
    if (!handle) refuse_copy(path, error, reason);
    return handle;
}

// Both are guarded by the game's lock.
std::map<std::string, std::vector<std::unique_ptr<Library>>>& pool() {
    static auto* libraries = new std::map<std::string, std::vector<std::unique_ptr<Library>>>;
    return *libraries;
}

std::map<std::string, std::unique_ptr<Library>>& shared_libraries() {
    static auto* libraries = new std::map<std::string, std::unique_ptr<Library>>;
    return *libraries;
}

bool defines(void* handle, void* symbol) {
    link_map* map = nullptr;
    Dl_info info;
    return symbol && dlinfo(handle, RTLD_DI_LINKMAP, &map) == 0 && dladdr(symbol, &info) &&
           reinterpret_cast<ElfW(Addr)>(info.dli_fbase) == map->l_addr;
}

// All races share the parameter files and their parser. These outlive each race, so they use the
// process's own heap.
bool is_memory(const std::string& import) {
    return import == "malloc" || import == "calloc" || import == "realloc" || import == "free" ||
           import == "strdup" || import.compare(0, 4, "_Zna") == 0 ||
           import.compare(0, 4, "_Znw") == 0 || import.compare(0, 4, "_Zdl") == 0 ||
           import.compare(0, 4, "_Zda") == 0;
}

struct Relocations {
    const ElfW(Rela) * first = nullptr;
    std::size_t number = 0;

    const ElfW(Rela) * begin() const { return first; }
    const ElfW(Rela) * end() const { return first + number; }
};

// What the loader knows of a loaded library.
struct Linked {
    ElfW(Addr) base = 0;
    const ElfW(Sym) * symbols = nullptr;
    const char* names = nullptr;
    Relocations data, calls;

    explicit Linked(void* handle) {
        link_map* map = nullptr;
        dlinfo(handle, RTLD_DI_LINKMAP, &map);
        base = map->l_addr;
        for (const ElfW(Dyn)* entry = map->l_ld; entry->d_tag != DT_NULL; entry++) {
            const ElfW(Addr) address = entry->d_un.d_ptr;
            switch (entry->d_tag) {
                case DT_SYMTAB:
                    symbols = reinterpret_cast<const ElfW(Sym)*>(address);
                    break;
                case DT_STRTAB:
                    names = reinterpret_cast<const char*>(address);
                    break;
                case DT_RELA:
                    data.first = reinterpret_cast<const ElfW(Rela)*>(address);
                    break;
                case DT_RELASZ:
                    data.number = entry->d_un.d_val / sizeof(ElfW(Rela));
                    break;
                case DT_JMPREL:
                    calls.first = reinterpret_cast<const ElfW(Rela)*>(address);
                    break;
                case DT_PLTRELSZ:
                    calls.number = entry->d_un.d_val / sizeof(ElfW(Rela));
                    break;
                default:
                    break;
            }
        }
    }

    const ElfW(Sym) & symbol(const ElfW(Rela) & relocation) const {
        return symbols[ELF64_R_SYM(relocation.r_info)];
    }

    void write(const ElfW(Rela) & relocation, void* target) const {
        static const auto page = static_cast<std::uintptr_t>(sysconf(_SC_PAGESIZE));
        const auto slot = static_cast<std::uintptr_t>(base + relocation.r_offset);
        // The loader has made these pages read-only. The copy is ours, so they become writable
        // again.
        mprotect(reinterpret_cast<void*>(slot - slot % page), page, PROT_READ | PROT_WRITE);
        std::memcpy(reinterpret_cast<void*>(slot), &target, sizeof target);
    }
};

}  // namespace

std::unique_ptr<Library> Library::take(const std::string& path, const std::string& folder,
                                       const char* error) {
    auto& spare = pool()[path];
    if (spare.empty())
        return std::unique_ptr<Library>(new Library(path, open_copy(path, folder, error), true));
    std::unique_ptr<Library> library = std::move(spare.back());
    spare.pop_back();
    return library;
}

void Library::give_back(std::unique_ptr<Library> library) {
    if (!library) return;
    library->restore(library->pristine_);
    pool()[library->path_].push_back(std::move(library));
}

Library& Library::shared(const std::string& path, bool race_memory) {
    auto& library = shared_libraries()[path];
    if (!library) {
        read_library(path, "GameIncomplete");
        void* handle = dlopen(path.c_str(), RTLD_NOW | RTLD_GLOBAL);
        if (!handle)
            throw Error("GameIncomplete", path + " will not load: " + loader_message() + REINSTALL);
        library.reset(new Library(path, handle, race_memory));
        library->keep_own_calls();
    }
    return *library;
}

void Library::share_copy(const std::string& path) {
    auto& library = shared_libraries()[path];
    if (library) return;
    library.reset(new Library(path, open_copy(path, "", "GameIncomplete"), false));
    library->keep_own_calls();
}

void* Library::find(const char* symbol) const { return dlsym(handle_, symbol); }

void* Library::require_address(const char* symbol) const {
    if (void* found = find(symbol)) return found;
    throw Error("LayoutMismatch",
                path_ + " has no symbol " + symbol + ", which that of TORCS 1.3.7 has" + REINSTALL);
}

Library::Library(std::string path, void* handle, bool race_memory)
    : path_(std::move(path)), handle_(handle) {
    redirect_imports(race_memory);
    link_map* map = nullptr;
    dlinfo(handle_, RTLD_DI_LINKMAP, &map);
    struct Search {
        ElfW(Addr) base;
        std::vector<Range>* ranges;
    } search{map->l_addr, &variables_};
    dl_iterate_phdr(
        [](dl_phdr_info* info, std::size_t, void* data) {
            auto* search = static_cast<Search*>(data);
            if (info->dlpi_addr != search->base) return 0;
            // Relocated data are read-only after loading; only what follows them can change.
            ElfW(Addr) sealed_end = 0;
            for (int i = 0; i < info->dlpi_phnum; i++) {
                const auto& part = info->dlpi_phdr[i];
                if (part.p_type == PT_GNU_RELRO) sealed_end = part.p_vaddr + part.p_memsz;
            }
            for (int i = 0; i < info->dlpi_phnum; i++) {
                const auto& part = info->dlpi_phdr[i];
                if (part.p_type != PT_LOAD || !(part.p_flags & PF_W)) continue;
                const ElfW(Addr) end = part.p_vaddr + part.p_memsz;
                ElfW(Addr) begin = part.p_vaddr;
                if (sealed_end > begin && sealed_end <= end) begin = sealed_end;
                search->ranges->push_back(
                    {reinterpret_cast<char*>(info->dlpi_addr + begin), end - begin});
            }
            return 1;
        },
        &search);
    pristine_ = save();
}

void Library::redirect_imports(bool race_memory) const {
    const auto replacement = [race_memory](const std::string& import) -> void* {
        const auto ours = replacements().find(import);
        if (ours != replacements().end())
            return is_memory(import) && !race_memory ? nullptr : ours->second;
        // The game's own libraries come before others of the process with the same symbols; many
        // Pythons, for example, contain the same XML parser.
        for (const auto& [path, library] : shared_libraries()) {
            void* found = library ? library->find(import.c_str()) : nullptr;
            if (found && defines(library->handle_, found)) return found;
        }
        return nullptr;
    };
    // A robot of another family may have a spline that is another function.
    const bool has_splines = find(SPLINE) && find(SPLINE_FAMILY);
    const Linked linked(handle_);
    for (const Relocations& table : {linked.data, linked.calls}) {
        for (const ElfW(Rela) & relocation : table) {
            const ElfW(Sym) & symbol = linked.symbol(relocation);
            if (symbol.st_name == 0) continue;
            const std::string name = linked.names + symbol.st_name;
            if (has_splines && name == SPLINE) linked.write(relocation, address(spline));
            if (symbol.st_shndx != SHN_UNDEF) continue;
            if (void* target = replacement(name)) linked.write(relocation, target);
        }
    }
}

void Library::keep_own_calls() const {
    const Linked linked(handle_);
    for (const ElfW(Rela) & relocation : linked.calls) {
        const ElfW(Sym) & symbol = linked.symbol(relocation);
        if (symbol.st_shndx == SHN_UNDEF) continue;
        linked.write(relocation, reinterpret_cast<void*>(linked.base + symbol.st_value));
    }
}

Variables Library::save() const {
    Variables saved;
    for (const Range& range : variables_) saved.emplace_back(range.begin, range.begin + range.size);
    return saved;
}

void Library::restore(const Variables& saved) {
    for (std::size_t i = 0; i < variables_.size(); i++)
        std::memcpy(variables_[i].begin, saved[i].data(), saved[i].size());
}

// ---- Driving ------------------------------------------------------------------------------------

Hosted::Hosted(Host& host) : previous_(current) {
    static const locale_t plain = newlocale(LC_ALL_MASK, "C", nullptr);
    locale_ = uselocale(plain);
    current = &host;
}

Hosted::~Hosted() {
    current = previous_;
    uselocale(static_cast<locale_t>(locale_));
}

Random* new_random(Arena& arena) {
    auto* random = static_cast<Random*>(arena.allocate(sizeof(Random)));
    std::memset(random, 0, sizeof *random);
    initstate_r(1, random->words, sizeof random->words, &random->state);
    return random;
}

std::string printed() { return messages; }

void forget_printed() { messages.clear(); }

}  // namespace torcs
