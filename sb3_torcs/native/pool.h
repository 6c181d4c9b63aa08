// Threads that stay, and share a queue of jobs with the thread that waits for the results.
#pragma once

#include <unistd.h>

#include <atomic>
#include <condition_variable>
#include <deque>
#include <functional>
#include <memory>
#include <mutex>
#include <string>
#include <system_error>
#include <thread>
#include <vector>

#include "errors.h"

namespace torcs {

class Pool {
public:
    static constexpr int MOST_THREADS = 1024;

    // Jobs have numbers below `jobs`, and must not throw. The calling thread is one of the threads:
    // it works while it waits.
    Pool(int threads, std::size_t jobs, std::function<void(std::size_t)> work)
        : shared_(std::make_unique<Shared>(jobs, std::move(work))), process_(getpid()) {
        if (threads < 1 || threads > MOST_THREADS)
            throw Error("InvalidOption", "threads is " + std::to_string(threads) +
                                             "; expected 1 to " + std::to_string(MOST_THREADS));
        try {
            for (int i = 1; i < threads; i++)
                shared_->threads.emplace_back(&Shared::serve, shared_.get());
        } catch (const std::system_error&) {
            shared_->stop();
            throw Error("InvalidOption", "the system gives no " + std::to_string(threads) +
                                             " threads; take fewer, one per core is enough");
        }
    }
    ~Pool() {
        if (forked())
            (void)shared_.release();  // its threads exist only in the parent, perhaps locking
        else
            shared_->stop();
    }
    Pool(const Pool&) = delete;
    Pool& operator=(const Pool&) = delete;

    // Queue a job. Wait for it before you begin it again.
    void begin(std::size_t job) {
        check();
        {
            std::lock_guard<std::mutex> lock(shared_->mutex);
            shared_->pending[job] = true;
            shared_->queue.push_back(job);
        }
        shared_->added.notify_one();
    }

    // Work until a job is done, on whichever thread.
    void wait(std::size_t job) {
        check();
        std::unique_lock<std::mutex> lock(shared_->mutex);
        while (shared_->pending[job])
            if (!shared_->do_next(lock)) shared_->await(lock, job);
    }

    // Work until all jobs are done.
    void finish() {
        for (std::size_t job = 0; job < shared_->pending.size(); job++) wait(job);
    }

private:
    // Poll a job before sleeping: most jobs end within the time that sleeping and waking take.
    static constexpr int PATIENCE = 200;

    struct Shared {
        Shared(std::size_t jobs, std::function<void(std::size_t)> what)
            : work(std::move(what)), pending(jobs) {}

        bool do_next(std::unique_lock<std::mutex>& lock) {
            if (queue.empty()) return false;
            const std::size_t job = queue.front();
            queue.pop_front();
            lock.unlock();
            work(job);
            lock.lock();
            pending[job] = false;
            done.notify_all();
            return true;
        }

        void await(std::unique_lock<std::mutex>& lock, std::size_t job) {
            lock.unlock();
            for (int i = 0; i < PATIENCE && pending[job]; i++) std::this_thread::yield();
            lock.lock();
            if (pending[job]) done.wait(lock);
        }

        void serve() {
            std::unique_lock<std::mutex> lock(mutex);
            while (!stopped) {
                if (!do_next(lock)) added.wait(lock);
            }
        }

        void stop() {
            {
                std::lock_guard<std::mutex> lock(mutex);
                stopped = true;
            }
            added.notify_all();
            for (std::thread& thread : threads) thread.join();
        }

        std::mutex mutex;
        std::condition_variable added, done;
        std::function<void(std::size_t)> work;
        std::deque<std::size_t> queue;
        std::vector<std::atomic<bool>> pending;
        std::vector<std::thread> threads;
        bool stopped = false;
    };

    bool forked() const { return getpid() != process_; }
    void check() const {
        if (forked())
            throw Error("EngineForked",
                        "these engines belong to the parent process; make the environment after "
                        "the fork");
    }

    std::unique_ptr<Shared> shared_;
    pid_t process_;
};

}  // namespace torcs
