#include "fleet.h"

namespace torcs {

Fleet::Fleet(const std::vector<Engine*>& engines, int threads)
    : tasks_(engines.size()), pool_(threads, tasks_.size(), [this](std::size_t i) { work(i); }) {
    for (std::size_t i = 0; i < engines.size(); i++) tasks_[i].engine = engines[i];
}

void Fleet::begin(std::size_t index, const Controls& controls, int ticks) {
    Task& task = tasks_.at(index);
    pool_.wait(index);
    task.controls = controls;
    task.ticks = ticks;
    pool_.begin(index);
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
        task.reading = task.engine->read(*race, race->agent());
    } catch (...) {
        task.failure = std::current_exception();
    }
}

}  // namespace torcs
