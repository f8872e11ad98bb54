// Tasks on several threads.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <exception>
#include <functional>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

namespace gn __attribute__((visibility("hidden"))) {

// Calls work(room, next) on up to `threads` threads; work takes task numbers from next++ while they are below count.
// The calling thread prepares a Room for each thread by reserve(room), because a new thread that failed to allocate
// would end the process. The calling thread keeps its own Room from call to call. An exception in one thread stops all
// and is rethrown here.
template <class Room, class Reserve, class Work>
void on_threads(int64_t threads, int64_t count, const Reserve& reserve, const Work& work) {
  std::atomic<int64_t> next{0};
  std::mutex lock;
  std::exception_ptr failed;
  auto careful = [&](Room& room) {
    try {
      work(room, next);
    } catch (...) {
      std::lock_guard<std::mutex> guard(lock);
      failed = std::current_exception();
      next = count;
    }
  };
  static thread_local Room own;
  reserve(own);
  const int64_t more = std::min(threads, count) - 1;
  std::unique_ptr<Room[]> rooms;
  std::vector<std::thread> others;
  try {
    if (more > 0) rooms.reset(new Room[more]);
    for (int64_t i = 0; i < more; ++i) {
      reserve(rooms[i]);
      others.emplace_back(careful, std::ref(rooms[i]));
    }
  } catch (const std::exception&) {  // no more threads or memory: the threads so far do all tasks
  }
  careful(own);
  for (auto& other : others) other.join();
  if (failed) std::rethrow_exception(failed);
}

}  // namespace gn
