// Tasks on several threads.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

namespace gn __attribute__((visibility("hidden"))) {

// Calls work(next), which takes the numbers of tasks from next++ while they are below count, on up to so many threads.
// An exception of one ends all, and is thrown again here: one that left its thread would end the process.
template <class Work>
void on_threads(int64_t threads, int64_t count, const Work& work) {
  std::atomic<int64_t> next{0};
  std::mutex lock;
  std::exception_ptr failed;
  auto careful = [&]() {
    try {
      work(next);
    } catch (...) {
      std::lock_guard<std::mutex> guard(lock);
      failed = std::current_exception();
      next = count;
    }
  };
  std::vector<std::thread> others;
  try {
    for (int64_t i = 1; i < std::min(threads, count); ++i) others.emplace_back(careful);
  } catch (const std::exception&) {  // the system has no more: those that there are do all
  }
  careful();
  for (auto& other : others) other.join();
  if (failed) std::rethrow_exception(failed);
}

}  // namespace gn
