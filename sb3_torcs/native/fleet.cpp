#include "fleet.h"

#include <algorithm>
#include <utility>

namespace torcs {

Fleet::Fleet(std::vector<std::shared_ptr<Engine>> engines, int threads)
    : tasks_(engines.size()), pool_(threads, tasks_.size(), [this](std::size_t i) { work(i); }) {
    for (std::size_t i = 0; i < engines.size(); i++) tasks_[i].engine = std::move(engines[i]);
}

void Fleet::put(std::size_t race, std::shared_ptr<Engine> engine) {
    Task& task = tasks_.at(race);
    pool_.wait(race);
    task.engine = std::move(engine);
}

std::vector<std::size_t> Fleet::step(const std::vector<Order>& orders) {
    for (const Order& order : orders) (void)tasks_.at(order.race);  // before any of them drives
    for (auto first = orders.begin(); first != orders.end();) {
        const auto last = std::find_if(
            first, orders.end(), [&](const Order& order) { return order.race != first->race; });
        pool_.wait(first->race);
        tasks_[first->race].orders = {first, last};
        pool_.begin(first->race);
        first = last;
    }
    std::vector<std::size_t> failed;
    for (std::size_t i = 0; i < orders.size(); i++) {
        pool_.wait(orders[i].race);
        if (tasks_[orders[i].race].failure) failed.push_back(i);
    }
    return failed;
}

void Fleet::check(std::size_t race) const {
    const Task& task = tasks_.at(race);
    if (task.failure) std::rethrow_exception(task.failure);
}

void Fleet::work(std::size_t index) {
    Task& task = tasks_[index];
    task.failure = nullptr;
    try {
        Engine::Access race(*task.engine);
        const int ticks = task.orders.front().ticks;
        for (const Order& order : task.orders) {
            if (order.ticks != ticks)
                throw Error("InvalidOption",
                            "the cars of one race are driven for equally many ticks, not for " +
                                std::to_string(ticks) + " and " + std::to_string(order.ticks));
            Engine::check_agent(*race, order.car);
            race->hold(order.car, order.controls);
        }
        race->drive(ticks);
        for (const Order& order : task.orders) *order.arrival = task.engine->read(*race, order.car);
    } catch (...) {
        task.failure = std::current_exception();
    }
}

}  // namespace torcs
