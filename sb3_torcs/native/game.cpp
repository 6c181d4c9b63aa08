#include "game.h"

#include <dlfcn.h>
#include <link.h>
#include <pthread.h>

#include "errors.h"

namespace torcs {

namespace {

// Of libtgf's GfParmReadFile and GfParmMergeHandles.
constexpr int READ_SHARED = 0x1;
constexpr int READ_AGAIN = 0x2;
constexpr int READ_PRIVATE = 0x8;
constexpr int MERGE_BOTH = 0x1 | 0x2;
constexpr int MERGE_RELEASES = 0x4 | 0x8;

constexpr const char* VECTORS = "libplibsg.so.1";

std::mutex opening;
std::unique_ptr<Game>* const opened = new std::unique_ptr<Game>;  // threads outlive statics

std::string with_slash(std::string folder) {
    if (folder.empty() || folder.back() != '/') folder += '/';
    return folder;
}

void preload(const std::string& path) {
    // The loader then finds this library when later ones need it by name.
    if (!dlopen(path.c_str(), RTLD_NOW | RTLD_LOCAL))
        throw Error("BackendUnavailable", path + " will not load: " + dlerror());
}

// Where the loader finds a library by its name; empty if it does not.
std::string file_of(const char* name) {
    void* handle = dlopen(name, RTLD_NOW | RTLD_LOCAL);
    link_map* map = nullptr;
    if (!handle || dlinfo(handle, RTLD_DI_LINKMAP, &map) != 0) return "";
    return map->l_name;
}

}  // namespace

void Game::watch_forks() {
    // Otherwise a child could inherit a lock that a thread of its parent holds, and nobody would
    // release it.
    static const auto lock = [] {
        opening.lock();
        if (*opened) (*opened)->mutex.lock();
    };
    static const auto unlock = [] {
        if (*opened) (*opened)->mutex.unlock();
        opening.unlock();
    };
    static const int watching = pthread_atfork([] { lock(); }, [] { unlock(); }, [] { unlock(); });
    (void)watching;
}

Game& Game::open(const std::string& data, const std::string& libraries, const std::string& plib) {
    std::lock_guard<std::mutex> lock(opening);
    if (!*opened) opened->reset(new Game(with_slash(data), with_slash(libraries), plib));
    if ((*opened)->libraries != with_slash(libraries) || (*opened)->data != with_slash(data))
        throw Error("BackendUnavailable", "this process has already loaded the game in " +
                                              (*opened)->libraries + ", it cannot load " +
                                              libraries + " too; start another process");
    return **opened;
}

Game::Game(const std::string& data, const std::string& libraries, const std::string& plib)
    : data(data), libraries(libraries) {
    if (!plib.empty()) {
        preload(with_slash(plib) + "libplibul.so.1");
        preload(with_slash(plib) + VECTORS);
    }
    // The vectors of the physics. Some builds of the game have them inside.
    const std::string vectors = file_of(VECTORS);
    if (!vectors.empty()) Library::share_copy(vectors);
    // The order matters: none of these libraries names those that it needs.
    Library::shared(libraries + "lib/libtxml.so", false);
    Library& params = Library::shared(libraries + "lib/libtgf.so", false);
    Library& tools = Library::shared(libraries + "lib/librobottools.so", false);
    Library::shared(libraries + "lib/liblearning.so", true);

    read_file_ = params.require<decltype(read_file_)>("_Z14GfParmReadFilePKci");
    release_ = params.require<decltype(release_)>("_Z19GfParmReleaseHandlePv");
    merge_ = params.require<decltype(merge_)>("_Z18GfParmMergeHandlesPvS_i");
    check_ = params.require<decltype(check_)>("_Z17GfParmCheckHandlePvS_");
    text_ = params.require<decltype(text_)>("_Z12GfParmGetStrPvPKcS1_S1_");
    number_ = params.require<decltype(number_)>("_Z12GfParmGetNumPvPKcS1_S1_f");
    elements_ = params.require<decltype(elements_)>("_Z14GfParmGetEltNbPvPKc");
    segment_under = tools.require<decltype(segment_under)>("_Z13RtTrackGetSegP10tTrkLocPos");
    road_height = tools.require<decltype(road_height)>("_Z14RtTrackHeightLP10tTrkLocPos");
    segment_width = tools.require<decltype(segment_width)>("_Z15RtTrackGetWidthP8trackSegf");
    to_global = tools.require<decltype(to_global)>("_Z19RtTrackLocal2GlobalP10tTrkLocPosPfS1_i");
    init_pit_setup =
        tools.require<decltype(init_pit_setup)>("_Z17RtInitCarPitSetupPvP12tCarPitSetupb");

    params.require<void (*)()>("_Z6GfInitv")();
    using SetFolder = void (*)(char*);
    std::string folder = this->data;
    params.require<SetFolder>("_Z10SetDataDirPc")(folder.data());
    folder = this->libraries;
    params.require<SetFolder>("_Z9SetLibDirPc")(folder.data());
    // The folder does not exist: no file of the user is read, and none is written.
    folder = "/nonexistent/";
    params.require<SetFolder>("_Z11SetLocalDirPc")(folder.data());
}

Params Params::read(Game& game, const std::string& path) {
    forget_printed();
    return {game, game.read_file_(path.c_str(), READ_SHARED | READ_AGAIN | READ_PRIVATE)};
}

Params& Params::operator=(Params&& other) noexcept {
    std::swap(game_, other.game_);
    std::swap(handle_, other.handle_);
    std::swap(owned_, other.owned_);
    return *this;
}

Params::~Params() {
    if (handle_ && owned_) game_->release_(handle_);
}

void* Params::release() {
    void* handle = handle_;
    handle_ = nullptr;
    return handle;
}

std::string Params::text(const char* section, const char* name, const char* fallback) const {
    return game_->text_(handle_, section, name, fallback);
}

float Params::number(const char* section, const char* name, float fallback) const {
    return game_->number_(handle_, section, name, nullptr, fallback);
}

int Params::elements(const char* section) const { return game_->elements_(handle_, section); }

int Params::misfits(const Params& reference) const {
    return game_->check_(reference.handle_, handle_);
}

Params Params::merge(Params reference, Params own) {
    Game& game = *reference.game_;
    void* merged = game.merge_(reference.release(), own.release(), MERGE_BOTH | MERGE_RELEASES);
    return {game, merged};
}

}  // namespace torcs
