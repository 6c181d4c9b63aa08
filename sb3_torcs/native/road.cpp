#include "road.h"

#include <algorithm>

namespace torcs {

namespace {

struct Widths {
    double start = 0.0, end = 0.0;  // [m]
};

// Border and side together; a negative width is none.
Widths ground(const Segment& segment, Side side) {
    Widths widths;
    for (const Segment* part = segment.side[side]; part; part = part->side[side]) {
        widths.start += std::max(part->start_width, 0.0f);
        widths.end += std::max(part->end_width, 0.0f);
    }
    return widths;
}

// Of the axis, between two corners of a segment.
double height(const Segment& segment, Vertex left, Vertex right) {
    return 0.5 * (double(segment.vertex[left].z) + segment.vertex[right].z);
}

// By how much the left edge lies higher.
double banking(const Segment& segment, Vertex left, Vertex right) {
    return double(segment.vertex[left].z) - segment.vertex[right].z;
}

double curvature(const Segment& segment) {
    if (segment.type == STRAIGHT) return 0.0;
    return (segment.type == LEFT_TURN ? segment.arc : -segment.arc) / segment.length;
}

}  // namespace

std::vector<RoadSegment> road_of(const TrackData& track,
                                 const std::map<Surface*, float>& friction) {
    std::vector<RoadSegment> road;
    const Segment* segment = track.last;
    for (int i = 0; i < track.segments_number; i++) {
        segment = segment->next;
        const Widths left = ground(*segment, LEFT), right = ground(*segment, RIGHT);
        road.push_back(
            {segment->length, curvature(*segment), segment->start_width, segment->end_width,
             left.start, left.end, right.start, right.end, friction.at(segment->surface),
             segment->surface->rolling_resistance, segment->barrier[LEFT]->surface->friction,
             segment->barrier[RIGHT]->surface->friction,
             double(segment->from_start) + segment->length,
             height(*segment, START_LEFT, START_RIGHT), height(*segment, END_LEFT, END_RIGHT),
             banking(*segment, START_LEFT, START_RIGHT), banking(*segment, END_LEFT, END_RIGHT)});
    }
    return road;
}

}  // namespace torcs
