// The pictures of a race, sent to whoever records it.

#include <algorithm>
#include <cerrno>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <utility>
#include <vector>

#include "window.h"

// Of the game's libraries and of OpenGL.
void GfScrGetSize(int* width, int* height, int* view_width, int* view_height);
void GfuiDisplay();
extern "C" void glPixelStorei(unsigned name, int value);
extern "C" void glReadBuffer(unsigned buffer);
extern "C" void glReadPixels(int, int, int, int, unsigned format, unsigned type, void* pixels);

namespace window {
namespace {

constexpr unsigned PACK_ROW_LENGTH = 0x0D02, PACK_ALIGNMENT = 0x0D05;
constexpr unsigned BACK = 0x0405, RGB = 0x1907, UNSIGNED_BYTE = 0x1401;

// Before the pixels of each frame: 8 bits each of red, green and blue, from the top left.
struct Header {
    char mark[4] = {'S', 'B', '3', 'F'};
    std::uint32_t width = 0, height = 0;
    std::uint32_t number = 0;
    double time = 0;   // [s] simulated
    double share = 0;  // [0, 1] of the race that the first car on the grid has driven
};
static_assert(sizeof(Header) == 32);

int (*draw)(torcs::Situation*) = nullptr;
bool drawn = false;  // the picture in the making is that of the race, complete
Header header;

double share_driven(const torcs::Situation& situation) {
    const double whole = static_cast<double>(situation.laps) * ReInfo->track->length;
    return std::clamp(ReInfo->cars[0].race.distance_raced / whole, 0.0, 1.0);
}

int frames_descriptor() {
    static const char* text = std::getenv("SB3_TORCS_FRAMES");
    static const int number = text ? std::atoi(text) : -1;
    return number;
}

void send(const void* data, std::size_t size) {
    const char* rest = static_cast<const char*>(data);
    while (size > 0) {
        const ssize_t written = write(frames_descriptor(), rest, size);
        if (written < 0 && errno == EINTR) continue;
        if (written <= 0) owner().lost_contact();
        rest += written;
        size -= static_cast<std::size_t>(written);
    }
}

// OpenGL's first row is the lowest.
void send_picture() {
    static std::vector<char> pixels, flipped;
    int window_width, window_height, width, height;
    GfScrGetSize(&window_width, &window_height, &width, &height);
    const std::size_t row = static_cast<std::size_t>(width) * 3;
    pixels.resize(row * static_cast<std::size_t>(height));
    flipped.resize(pixels.size());
    glPixelStorei(PACK_ROW_LENGTH, 0);
    glPixelStorei(PACK_ALIGNMENT, 1);
    glReadBuffer(BACK);
    glReadPixels((window_width - width) / 2, (window_height - height) / 2, width, height, RGB,
                 UNSIGNED_BYTE, pixels.data());
    for (std::size_t from = 0, to = pixels.size(); to > 0; from += row) {
        to -= row;
        std::memcpy(&flipped[to], &pixels[from], row);
    }
    header.width = static_cast<std::uint32_t>(width);
    header.height = static_cast<std::uint32_t>(height);
    send(&header, sizeof header);
    send(flipped.data(), flipped.size());
    ++header.number;
}

// The game draws its messages over this picture only just before the next one. Here it draws them
// at once, so that a frame shows one moment.
int draw_and_send(torcs::Situation* situation) {
    const int result = draw(situation);
    header.time = situation->time;
    header.share = share_driven(*situation);
    drawn = rolling();
    GfuiDisplay();
    drawn = false;
    return result;
}

}  // namespace

bool recording() { return frames_descriptor() >= 0; }

void send_frames() { draw = std::exchange(ReInfo->graphics.refresh, draw_and_send); }

}  // namespace window

// The window of a video is not shown: nobody looks at it, and showing takes time.
extern "C" INSTEAD void glutSwapBuffers() {
    static auto* const real = window::original<void()>("glutSwapBuffers");
    if (!window::recording()) {
        real();
    } else if (window::drawn) {
        window::send_picture();
    }
}
