#include "options.h"

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <string_view>

#include "engine.h"

namespace torcs::scr {
namespace {

Options read_options() {
    Options options;
    const char* text = std::getenv("SB3_TORCS_SCR_OPTIONS");
    std::string_view rest = text ? text : "";
    while (!rest.empty()) {
        const std::string_view word = rest.substr(0, rest.find(','));
        rest.remove_prefix(std::min(word.size() + 1, rest.size()));
        if (word == "nofuel") {
            options.no_fuel = true;
        } else if (word == "nodamage") {
            options.no_damage = true;
        } else if (word == "nolaptime") {
            options.no_lap_limit = true;
        } else if (word == "noisy") {
            options.noisy = true;
        } else {
            std::printf(
                "scr_server: SB3_TORCS_SCR_OPTIONS names '%s'; it may name nofuel, "
                "nodamage, nolaptime and noisy\n",
                std::string(word).c_str());
            std::fflush(stdout);
            std::exit(1);
        }
    }
    return options;
}

// The rule of the race engine: ten metres a second, and time for a pit stop.
bool is_slow(const CarElement& car) {
    return car.race.lap_time > 84.5 + ReInfo->track->length / 10.0;
}

}  // namespace

const Options& options() {
    static const Options options = read_options();
    return options;
}

Mercy& mercy() {
    static Mercy mercy;
    return mercy;
}

void Mercy::begin(const Simulation& simulation) {
    simulated_ = simulated_cars(simulation);
    kept_.clear();
}

void Mercy::before(const Situation& situation) {
    kept_.resize(static_cast<std::size_t>(situation.cars_number));
    for (int i = 0; i < situation.cars_number; i++) {
        CarElement& car = *situation.cars[i];
        Kept& kept = kept_[static_cast<std::size_t>(car.index)];
        if (const SimulatedCar* own = simulated(car)) kept.fuel = own->fuel;
        // The engine judges by the lap time of the previous step, also at the end of a slow lap.
        const bool was_slow = kept.slow;
        kept.slow = is_slow(car);
        if (options().no_lap_limit && (was_slow || kept.slow)) car.pub.status &= ~ELIMINATED;
    }
}

void Mercy::after(const Situation& situation) {
    for (int i = 0; i < situation.cars_number; i++) {
        CarElement& car = *situation.cars[i];
        SimulatedCar* own = simulated(car);
        if (!own) continue;
        Kept& kept = kept_[static_cast<std::size_t>(car.index)];
        if (options().no_fuel && own->fuel < kept.fuel) own->fuel = car.priv.fuel = kept.fuel;
        if (!options().no_damage) continue;
        kept.damage += own->damage;
        own->damage = car.priv.damage = 0;
    }
}

int Mercy::damage_of(const CarElement& car) const {
    const auto place = static_cast<std::size_t>(car.index);
    return car.priv.damage + (place < kept_.size() ? kept_[place].damage : 0);
}

SimulatedCar* Mercy::simulated(const CarElement& car) const {
    return simulated_ && *simulated_ ? *simulated_ + car.index : nullptr;
}

}  // namespace torcs::scr
