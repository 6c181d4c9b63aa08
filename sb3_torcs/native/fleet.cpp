#include "fleet.h"

#include <algorithm>
#include <utility>

namespace torcs {

Fleet::Fleet(const std::vector<Engine*>& engines, int threads)
    : tasks_(engines.size()), pool_(threads, tasks_.size(), [this](std::size_t i) { work(i); }) {
    for (std::size_t i = 0; i < engines.size(); i++) tasks_[i].engine = engines[i];
}

void Fleet::begin(std::size_t index, const Controls& controls, int ticks) {
    begin({{index, FIRST_AGENT, controls, ticks, &tasks_.at(index).reading}});
}

void Fleet::begin(std::vector<Order> orders) {
    const std::size_t index = orders.front().index;
    pool_.wait(index);
    tasks_[index].orders = std::move(orders);
    pool_.begin(index);
}

std::vector<std::size_t> Fleet::step(const std::vector<Order>& orders) {
    for (const Order& order : orders) (void)tasks_.at(order.index);  // before any of them drives
    for (auto first = orders.begin(); first != orders.end();) {
        const auto last = std::find_if(
            first, orders.end(), [&](const Order& order) { return order.index != first->index; });
        begin({first, last});
        first = last;
    }
    std::vector<std::size_t> failed;
    for (std::size_t i = 0; i < orders.size(); i++) {
        pool_.wait(orders[i].index);
        if (tasks_[orders[i].index].failure) failed.push_back(i);
    }
    return failed;
}

const Reading& Fleet::wait(std::size_t index) {
    const Task& task = tasks_.at(index);
    pool_.wait(index);
    if (task.failure) std::rethrow_exception(task.failure);
    return task.reading;
}

void Fleet::work(std::size_t index) {
    Task& task = tasks_[index];
    task.failure = nullptr;
    try {
        Engine::Access race(*task.engine);
        for (Order& order : task.orders) {
            if (order.car == FIRST_AGENT) order.car = Engine::first_agent(*race);
            Engine::check_agent(*race, order.car);
            race->hold(order.car, order.controls);
        }
        race->drive(task.orders.front().ticks);
        for (const Order& order : task.orders) *order.arrival = task.engine->read(*race, order.car);
    } catch (...) {
        task.failure = std::current_exception();
    }
}

}  // namespace torcs
