// What the race engine watches at every physics step: laps, pits, penalties, the standings.
#include <algorithm>
#include <cmath>
#include <cstring>

#include "maths/maths.h"
#include "race.h"

namespace torcs {

namespace {

constexpr int DRIVE_THROUGH = 1;
constexpr int STOP_AND_GO = 2;
constexpr int LAPS_TO_CLEAR = 5;
constexpr int PROFESSIONAL = 3;  // only they are watched in the pit lane

// States of a car in the pit lane.
enum LaneState : int {
    CLEARS_DRIVE_THROUGH = 0x1,
    CLEARS_STOP_AND_GO = 0x2,
    HAS_STOPPED = 0x4,
    WAS_TOO_FAST = 0x10000,
    WAS_IN_ILLEGALLY = 0x20000,
};

bool is_touching(const CarElement& car) {
    return car.priv.collision & COLLISION_WITH_BODY && !(car.pub.status & NOT_SIMULATED);
}

double diagonal(const CarElement& car) {
    return maths::hypot(car.info.dimension.x, car.info.dimension.y);
}

bool near(const CarElement& a, const CarElement& b) {
    constexpr double SLACK = 0.5;  // [m] that cars are moved apart in a step
    const Pose &here = a.pub.local.pos, &there = b.pub.local.pos;
    const double apart = maths::hypot(there.x - here.x, there.y - here.y);
    return apart < 0.5 * (diagonal(a) + diagonal(b)) + SLACK;
}

bool lies_before(const CarElement& car, const CarElement& other) {
    constexpr double FRONT = 0.25 * M_PI;  // [rad] to either side
    const Pose &here = car.pub.local.pos, &there = other.pub.local.pos;
    const double direction = maths::atan2f(there.y - here.y, there.x - here.x);
    return std::fabs(std::remainder(direction - here.az, 2.0 * M_PI)) < FRONT;
}

}  // namespace

void Race::manage(CarElement& car) {
    Record& record = world_->records[car.index];
    const float speed = car.pub.local.vel.x;
    car.race.top_speed = std::max(car.race.top_speed, speed);
    record.top_speed = std::max(record.top_speed, speed);
    if (speed < record.lowest_speed) record.lowest_speed = car.race.lowest_speed = speed;
    if (car.race.pit) manage_pit(car, record);
    const Segment* before = record.previous.segment;
    const Segment* now = car.pub.track.segment;
    if (before != now) {
        if (before->race_info & BEFORE_LINE && now->race_info & AFTER_LINE &&
            !cross_line(car, record))
            return;
        if (before->race_info & AFTER_LINE && now->race_info & BEFORE_LINE) record.backwards++;
    }
    apply_rules(car, record);
    record.previous = car.pub.track;
    car.race.lap_time = world_->situation.time - record.lap_began;
    measure_distance(car);
}

void Race::measure_distance(CarElement& car) {
    const TrackPosition& position = car.pub.track;
    const Segment& segment = *position.segment;
    car.race.distance_from_start =
        segment.from_start +
        (segment.type == STRAIGHT ? position.to_start : position.to_start * segment.radius);
    const int whole = car.race.crossings - (world_->records[car.index].backwards + 1);
    car.race.distance_raced =
        static_cast<float>(whole) * track_->length + car.race.distance_from_start;
}

// ---- Laps ---------------------------------------------------------------------------------------

// Returns whether the car still takes part.
bool Race::cross_line(CarElement& car, Record& record) {
    if (record.backwards > 0) {
        record.backwards--;
        return true;
    }
    Situation& situation = world_->situation;
    CarRace& race = car.race;
    if (car.pub.status & FINISHED) {
        // One lap after the finish is enough.
        for (int i = 0; i < situation.cars_number; i++) world_->order[i]->pub.status |= FINISHED;
        return false;
    }
    race.crossings++;
    race.remaining_laps--;
    if (race.crossings > 1) {
        race.last_lap_time = situation.time - record.lap_began;
        race.total_time += race.last_lap_time;
        if (race.best_lap_time != 0.0)
            race.delta_best_lap_time = race.last_lap_time - race.best_lap_time;
        if (race.best_lap_counts &&
            (race.last_lap_time < race.best_lap_time || race.best_lap_time == 0.0))
            race.best_lap_time = race.last_lap_time;
        race.best_lap_counts = true;
        if (race.position != 1) {
            CarRace& leader = world_->order[0]->race;
            CarRace& previous = world_->order[race.position - 2]->race;
            race.behind_leader = race.total_time - leader.total_time;
            race.laps_behind_leader = leader.crossings - race.crossings;
            race.behind_previous = race.total_time - previous.total_time;
            previous.before_next = race.behind_previous;
        } else {
            race.behind_leader = 0.0;
            race.laps_behind_leader = 0;
            race.behind_previous = 0.0;
        }
        record.lap_began = static_cast<float>(situation.time);
        record_lap(car, record);
    } else if (record.flying) {
        record.lap_began = static_cast<float>(situation.time);
        race.best_lap_counts = true;  // whatever was hit on the way here
    }
    record.top_speed = record.lowest_speed = race.lowest_speed = car.pub.local.vel.x;
    // In a race without a flag, environments decide when it is over.
    if (has_flag() && (race.remaining_laps < 0 || situation.state == FINISHING)) {
        car.pub.status |= FINISHED;
        situation.state = FINISHING;
        record.finished = true;
    }
    return true;
}

void Race::record_lap(const CarElement& car, Record& record) {
    if (record.laps_number == record.laps_room) {
        record.laps_room = std::max(16, 2 * record.laps_room);
        LapRecord* laps = make<LapRecord>(record.laps_room);
        std::copy_n(record.laps, record.laps_number, laps);
        if (record.laps) arena_.release(record.laps);
        record.laps = laps;
    }
    record.laps[record.laps_number++] = {car.race.last_lap_time, car.priv.damage, record.top_speed,
                                         record.lowest_speed};
}

void Race::sort() {
    Situation& situation = world_->situation;
    CarElement** order = world_->order;
    bool all_finished = order[0]->pub.status & FINISHED;
    for (int i = 1; i < situation.cars_number; i++) {
        for (int j = i; j > 0; j--) {
            if (order[j]->pub.status & FINISHED) break;
            all_finished = false;
            if (order[j]->race.distance_raced <= order[j - 1]->race.distance_raced) break;
            std::swap(order[j], order[j - 1]);
            order[j]->race.position = j + 1;
            order[j - 1]->race.position = j;
        }
    }
    if (all_finished) situation.state = ENDED;
}

// ---- Contacts -----------------------------------------------------------------------------------

// The simulation says which cars have hit something in this step; who is near has hit each other.
void Race::watch_contacts() {
    for (int i = 0; i < cars_number(); i++) {
        if (!is_touching(car(i))) continue;
        for (int j = 0; j < cars_number(); j++)
            if (j != i && is_touching(car(j)) && near(car(i), car(j))) note_contact(car(i), car(j));
    }
}

// Cars that rub against each other for a while have one contact. It is the fault of a car that hits
// the other with its front.
void Race::note_contact(const CarElement& car, const CarElement& other) {
    constexpr double PAUSE = 0.5;  // [s] without a touch, after which it is another contact
    Record& record = world_->records[car.index];
    const double now = world_->situation.time;
    if (record.contacts == 0 || now - record.contact_time > PAUSE) {
        record.contacts++;
        if (lies_before(car, other)) record.faults++;
    }
    record.contact_time = now;
}

// ---- Pits ---------------------------------------------------------------------------------------

void Race::manage_pit(CarElement& car, Record& record) {
    Pit& pit = *car.race.pit;
    const Situation& situation = world_->situation;
    if (car.pub.status & IN_PIT) {
        car.control.race_command &= ~PIT_ASKED;
        if (car.race.event_time < situation.time) {
            car.pub.status &= ~IN_PIT;
            pit.occupied_by = -1;
        }
        return;
    }
    if (!(car.control.race_command & PIT_ASKED) || pit.occupied_by != -1) return;
    if (situation.max_damage != 0 && car.priv.damage > situation.max_damage) return;
    if (!stands_in_pit(car)) return;
    car.pub.status |= IN_PIT;
    car.race.pit_stops++;
    for (int i = 0; i < pit.cars_number; i++)
        if (pit.cars[i] == &car) pit.occupied_by = i;
    car.robot->pit(car.robot->index, &car, &world_->situation);
    stop_in_pit(car, record);
}

bool Race::stands_in_pit(const CarElement& car) const {
    const TrackPosition& position = car.pub.track;
    float along = position.segment->from_start;
    along += position.segment->type == STRAIGHT ? position.to_start
                                                : position.to_start * position.segment->radius;
    if (along <= car.race.pit->from || along >= car.race.pit->to) return false;
    const bool right = track_->pits.side == RIGHT_TURN;
    const int side = right ? RIGHT : LEFT;
    Segment* beside = position.segment->side[side];
    float width = game_.segment_width(beside, position.to_start);
    if (beside->side[side]) {
        beside = beside->side[side];
        width += game_.segment_width(beside, position.to_start);
    }
    return (right ? position.to_right : position.to_left) + width <
               track_->pits.width - car.info.dimension.y / 2.0 &&
           std::fabs(car.pub.local.vel.x) < 1.0 && std::fabs(car.pub.local.vel.y) < 1.0;
}

void Race::stop_in_pit(CarElement& car, Record& record) {
    const PitCommand& command = car.pit_command;
    const double now = world_->situation.time;
    if (command.stop_type == 0) {
        record.pit_time =
            rules_.pit_base_time + std::fabs(double(command.fuel)) / rules_.fuel_flow +
            float(std::fabs(double(command.repair))) * rules_.repair_factor + car.race.penalty_time;
        const bool free_setup = world_->situation.type != RACE;
        game_.init_pit_setup(car.priv.car_params, car.pit_command.setup, free_setup);
    } else {
        record.pit_time = car.race.penalty_time;
    }
    car.race.event_time = now + record.pit_time;
    car.race.penalty_time = 0.0f;
    if (command.stop_type != 0) return;
    simulation_.reconfig(&car);
    for (WheelState& wheel : car.priv.wheel) {
        wheel.condition = 1.01f;
        wheel.temperature_inner = wheel.temperature_middle = wheel.temperature_outer = 50.0f;
    }
}

// ---- Rules --------------------------------------------------------------------------------------

void Race::apply_rules(CarElement& car, Record& record) {
    // Takes out who is too slow: a lap may take its length at 10 m/s, and a long pit stop.
    if (car.race.lap_time > 84.5 + track_->length / 10.0) {
        car.pub.status |= ELIMINATED;
        return;
    }
    if (!(car.pub.status & FINISHED)) {
        if (rules_.wall_voids_lap && car.priv.collision & COLLISION_WITH_WALL)
            car.race.best_lap_counts = false;
        check_cut(car);
    }
    if (car.info.skill >= PROFESSIONAL) check_pit_lane(car, record);
}

// A corner is cut when the mass centre is more than 0.7 widths of the car inside of it.
void Race::check_cut(CarElement& car) {
    const Segment& segment = *car.pub.track.segment;
    if (segment.type == STRAIGHT) return;
    const Pits& pits = track_->pits;
    if (pits.type == 1 && pits.side == segment.type) {
        const int entry = pits.entry->id, exit = pits.exit->id;
        const bool after_entry = segment.id >= entry, before_exit = segment.id <= exit;
        if (entry < exit ? after_entry && before_exit : after_entry || before_exit) return;
    }
    const bool left = segment.type == LEFT_TURN;
    const float to_border = left ? car.pub.track.to_left : car.pub.track.to_right;
    const float limit = car.info.dimension.y * 0.7f;
    if (!(to_border < -limit)) return;
    if (rules_.cut_voids_lap) car.race.best_lap_counts = false;
    const float radius = (left ? segment.radius_left : segment.radius_right) - limit;
    if (world_->situation.type == RACE && rules_.cut_costs_time && radius > 1.0f)
        car.race.penalty_time += car.pub.speed * PHYSICS_STEP * (-to_border - limit) / radius;
}

void Race::add_penalty(CarElement& car, int kind) {
    auto* penalty = make<Penalty>();
    penalty->kind = kind;
    penalty->lap_to_clear = car.race.crossings + LAPS_TO_CLEAR;
    PenaltyList& list = car.race.penalties;
    penalty->prev = list.last;
    *list.last = penalty;
    list.last = &penalty->next;
}

void Race::check_pit_lane(CarElement& car, Record& record) {
    Segment* before = game_.segment_under(&record.previous);
    Segment* now = game_.segment_under(&car.pub.track);
    PenaltyList& list = car.race.penalties;
    Penalty* penalty = list.first;
    if (penalty && car.race.crossings > penalty->lap_to_clear) {
        car.pub.status |= ELIMINATED;
        return;
    }
    int& state = record.lane_state;
    if (before->race_info & PIT_START) {
        if (now->race_info & PIT && penalty)
            state |= penalty->kind == DRIVE_THROUGH ? CLEARS_DRIVE_THROUGH : CLEARS_STOP_AND_GO;
    } else if (before->race_info & PIT) {
        if (now->race_info & PIT) {
            if (car.pub.status & IN_PIT) {
                if (state & CLEARS_DRIVE_THROUGH)
                    state &= ~CLEARS_DRIVE_THROUGH;  // it stopped
                else if (state & CLEARS_STOP_AND_GO)
                    state |= HAS_STOPPED;
            } else if (state & HAS_STOPPED && car.pit_command.stop_type != 1) {
                state &= ~(CLEARS_STOP_AND_GO | HAS_STOPPED);
            }
        } else if (now->race_info & PIT_END) {
            if (state & (CLEARS_DRIVE_THROUGH | HAS_STOPPED) && penalty) {
                if (penalty->next)
                    penalty->next->prev = penalty->prev;
                else
                    list.last = penalty->prev;
                *penalty->prev = penalty->next;
            }
            state = 0;
        } else if (!(state & WAS_IN_ILLEGALLY)) {
            add_penalty(car, STOP_AND_GO);
            state = WAS_IN_ILLEGALLY;
        }
    } else if (now->race_info & PIT_END) {
        state = 0;
    } else if (now->race_info & PIT && !(state & WAS_IN_ILLEGALLY)) {
        add_penalty(car, STOP_AND_GO);
        state = WAS_IN_ILLEGALLY;
    }
    if (now->race_info & SPEED_LIMIT && !(state & (WAS_TOO_FAST | WAS_IN_ILLEGALLY)) &&
        car.pub.local.vel.x > track_->pits.speed_limit) {
        state |= WAS_TOO_FAST;
        add_penalty(car, DRIVE_THROUGH);
    }
}

// ---- Results ------------------------------------------------------------------------------------

namespace {

// A penalty that was not served costs the time that serving it would have cost: the stop, and the
// time lost at the speed limit along the pits.
float unserved(const CarElement& car, const Pits& pits) {
    if (pits.type != 1) return 0.0f;
    constexpr float FAST = 84.0f, LANE = 10.0f, STOP = 6.0f + LANE;
    const float slow = pits.speed_limit;
    float lost = 0.0f;
    if (FAST - slow > 1.0f && slow > 1.0f)
        lost = static_cast<float>(pits.number) * pits.length * (FAST - slow) / (FAST * slow);
    float time = 0.0f;
    for (const Penalty* penalty = car.race.penalties.first; penalty; penalty = penalty->next)
        time += lost + (penalty->kind == DRIVE_THROUGH ? LANE : STOP);
    return time;
}

}  // namespace

std::vector<Result> Race::results() const {
    const Situation& situation = world_->situation;
    struct Standing {
        const CarElement* car;
        float penalty;
    };
    std::vector<Standing> standings;
    for (int i = 0; i < situation.cars_number; i++) {
        const CarElement& car = *world_->order[i];
        const float extra = situation.type == RACE ? unserved(car, track_->pits) : 0.0f;
        standings.push_back({&car, car.race.penalty_time + extra});
    }
    const auto laps_of = [&](const CarElement& car) {
        return std::min(car.race.crossings, situation.laps + 1) - 1;
    };
    // A penalty moves a car down behind the cars whose time is less, scaled to its number of laps.
    bool comparable = situation.type == RACE;
    for (std::size_t i = 1; comparable && i < standings.size(); i++) {
        for (std::size_t j = i; j > 0; j--) {
            Standing &ahead = standings[j - 1], &behind = standings[j];
            if (!(ahead.penalty > 0.0f)) break;
            const int laps = laps_of(*ahead.car), others = laps_of(*behind.car);
            comparable =
                laps >= 1 && others >= 1 &&
                std::max(ahead.car->priv.damage, behind.car->priv.damage) <= situation.max_damage;
            if (!comparable) break;
            const float time = ahead.car->race.total_time + ahead.penalty;
            const float other =
                behind.car->race.total_time * float(laps) / float(others) + behind.penalty;
            if (!(time > other)) break;
            std::swap(ahead, behind);
        }
    }
    std::vector<Result> results;
    for (const Standing& standing : standings) {
        const CarElement& car = *standing.car;
        results.push_back({car.index, std::max(laps_of(car), 0),
                           car.race.total_time + standing.penalty, car.race.best_lap_time,
                           car.priv.damage,
                           !world_->records[car.index].finished &&
                               (car.pub.status & (BROKEN | OUT_OF_FUEL | ELIMINATED)) != 0});
    }
    return results;
}

}  // namespace torcs
