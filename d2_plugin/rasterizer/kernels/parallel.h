// A pool of threads that outlives the calls. The calling thread works too; tasks are handed out one by one, so a result
// must not depend on who runs a task or when. Workers that are still asleep when the work is done are not waited for.
#pragma once

#include <sched.h>
#include <unistd.h>

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <new>
#include <system_error>
#include <thread>

namespace d2 {

class Pool {
 public:
  typedef void (*Task)(void* context, int64_t index);

  // Run task(context, i) for i in 0..count-1 on up to `threads` threads; returns when all are done, or throws where a
  // task found no memory.
  static void run(int threads, int64_t count, Task task, void* context) {
    Pool& pool = instance();
    // A second caller at the same time works alone rather than waiting.
    if (threads <= 1 || count <= 1 || !pool.owner_.try_lock()) {
      for (int64_t i = 0; i < count; i++) task(context, i);
      return;
    }
    const bool done = pool.work(threads, count, task, context);
    pool.owner_.unlock();
    if (!done) throw std::bad_alloc();
  }

 private:
  static constexpr int SPINS = 2000;  // some tens of microseconds: the phases of one call follow each other closely

  // Never destroyed: its threads may outlive every static object. A forked child has none of the threads, so it
  // starts a pool of its own.
  static Pool& instance() {
    static std::atomic<Pool*> pool{nullptr};
    Pool* current = pool.load(std::memory_order_acquire);
    if (current && current->process_ == getpid()) return *current;
    Pool* fresh = new Pool;
    if (pool.compare_exchange_strong(current, fresh)) return *fresh;
    delete fresh;
    return *current;
  }

  bool work(int threads, int64_t count, Task task, void* context) {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      try {
        for (; workers_ < threads - 1; workers_++) std::thread([this] { serve(); }).detach();
      } catch (const std::system_error&) {
        // The system grants no more threads: fewer do the same work.
      }
      task_ = task, context_ = context, count_ = count, places_ = threads - 1;
      next_.store(0, std::memory_order_relaxed);
      generation_.fetch_add(1, std::memory_order_release);
    }
    wake_.notify_all();
    take_tasks(task, context, count);
    {
      std::lock_guard<std::mutex> lock(mutex_);
      places_ = 0;
    }
    while (busy_.load(std::memory_order_acquire)) sched_yield();
    return !failed_.exchange(false);
  }

  void take_tasks(Task task, void* context, int64_t count) {
    try {
      for (int64_t i; (i = next_.fetch_add(1, std::memory_order_relaxed)) < count;) task(context, i);
    } catch (const std::bad_alloc&) {
      failed_.store(true);
    }
  }

  void serve() {
    unsigned seen = 0;
    for (;;) {
      for (int spin = 0; spin < SPINS && generation_.load(std::memory_order_acquire) == seen; spin++) pause();
      std::unique_lock<std::mutex> lock(mutex_);
      wake_.wait(lock, [&] { return generation_.load(std::memory_order_relaxed) != seen; });
      seen = generation_.load(std::memory_order_relaxed);
      if (places_ == 0) continue;
      places_--;
      busy_.fetch_add(1, std::memory_order_relaxed);
      const Task task = task_;
      void* const context = context_;
      const int64_t count = count_;
      lock.unlock();
      take_tasks(task, context, count);
      busy_.fetch_sub(1, std::memory_order_release);
    }
  }

  static void pause() {
#if defined(__x86_64__) || defined(__i386__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    asm volatile("yield");
#endif
  }

  const pid_t process_ = getpid();
  std::mutex owner_, mutex_;
  std::condition_variable wake_;
  std::atomic<unsigned> generation_{0};
  std::atomic<int64_t> next_{0};
  std::atomic<int> busy_{0};
  std::atomic<bool> failed_{false};
  int workers_ = 0, places_ = 0;
  Task task_ = nullptr;
  void* context_ = nullptr;
  int64_t count_ = 0;
};

// Call body(i) for i in 0..count-1 on up to `threads` threads.
template <class Body>
void parallel_for(int threads, int64_t count, Body body) {
  Pool::run(threads, count, [](void* context, int64_t i) { (*static_cast<Body*>(context))(i); }, &body);
}

}  // namespace d2
