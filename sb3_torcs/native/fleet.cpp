#include "fleet.h"

namespace torcs {

Fleet::Fleet(const std::vector<Engine*>& engines, int threads)
    : tasks_(engines.size()), pool_(threads, tasks_.size(), [this](std::size_t i) { work(i); }) {
    for (std::size_t i = 0; i < engines.size(); i++) tasks_[i].engine = engines[i];
}

void Fleet::begin(std::size_t index, const Controls& controls, int ticks) {
    begin({index, controls, ticks, &tasks_.at(index).reading});
}

void Fleet::begin(const Order& order) {
    pool_.wait(order.index);
    Task& task = tasks_[order.index];
    task.controls = order.controls;
    task.ticks = order.ticks;
    task.arrival = order.arrival;
    pool_.begin(order.index);
}

std::vector<std::size_t> Fleet::step(const std::vector<Order>& orders) {
    for (const Order& order : orders) (void)tasks_.at(order.index);  // before any of them drives
    for (const Order& order : orders) begin(order);
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
        Engine::check_agent(*race);
        race->drive(task.controls, task.ticks);
        *task.arrival = task.engine->read(*race, race->agent());
    } catch (...) {
        task.failure = std::current_exception();
    }
}

}  // namespace torcs
