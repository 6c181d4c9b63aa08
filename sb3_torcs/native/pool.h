// Threads that stay, and share the jobs of a batch with the thread that waits for the results.
#pragma once

#include <unistd.h>

#include <cfenv>
#include <condition_variable>
#include <functional>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

#include "errors.h"

namespace torcs {

class Pool {
public:
    // With the thread that calls, which works while it waits.
    explicit Pool(int threads) : shared_(std::make_unique<Shared>()), process_(getpid()) {
        for (int i = 1; i < threads; i++) shared_->threads.emplace_back(work, shared_.get());
    }
    ~Pool() {
        if (forked()) {
            // The threads were left behind in the parent, perhaps with the lock.
            (void)shared_.release();
            return;
        }
        {
            std::lock_guard<std::mutex> lock(shared_->mutex);
            shared_->stopped = true;
        }
        shared_->begun.notify_all();
        for (std::thread& thread : shared_->threads) thread.join();
    }
    Pool(const Pool&) = delete;
    Pool& operator=(const Pool&) = delete;

    // Begin jobs 0 to number - 1, in this order. They must not throw.
    void begin(std::size_t number, std::function<void(std::size_t)> job) {
        finish();
        {
            std::lock_guard<std::mutex> lock(shared_->mutex);
            // Libraries set how small numbers are rounded, thread by thread.
            std::fegetenv(&shared_->rounding);
            shared_->job = std::move(job);
            shared_->next = shared_->finished = 0;
            shared_->done.assign(number, false);
        }
        shared_->begun.notify_all();
    }

    // Do jobs until this one is done, by whomever.
    void wait(std::size_t index) {
        check();
        std::unique_lock<std::mutex> lock(shared_->mutex);
        while (!shared_->done.at(index))
            if (!shared_->do_next(lock)) shared_->ended.wait(lock);
    }

    // Do jobs until all are done.
    void finish() {
        check();
        std::unique_lock<std::mutex> lock(shared_->mutex);
        while (shared_->finished < shared_->done.size())
            if (!shared_->do_next(lock)) shared_->ended.wait(lock);
    }

private:
    struct Shared {
        std::mutex mutex;
        std::condition_variable begun, ended;
        std::vector<std::thread> threads;
        std::function<void(std::size_t)> job;
        std::fenv_t rounding;
        std::vector<bool> done;
        std::size_t next = 0, finished = 0;
        bool stopped = false;

        bool do_next(std::unique_lock<std::mutex>& lock) {
            if (next == done.size()) return false;
            const std::size_t index = next++;
            lock.unlock();
            job(index);
            lock.lock();
            done[index] = true;
            finished++;
            ended.notify_all();
            return true;
        }
    };

    static void work(Shared* shared) {
        std::unique_lock<std::mutex> lock(shared->mutex);
        while (!shared->stopped) {
            if (shared->next == shared->done.size()) {
                shared->begun.wait(lock);
                continue;
            }
            std::fesetenv(&shared->rounding);
            shared->do_next(lock);
        }
    }

    bool forked() const { return getpid() != process_; }
    void check() const {
        if (forked())
            throw Error("EngineForked",
                        "these threads belong to the parent process; make the environment after "
                        "the fork");
    }

    std::unique_ptr<Shared> shared_;
    pid_t process_;
};

}  // namespace torcs
