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

// Calls work(room, next), which takes the numbers of tasks from next++ while they are below count, on up to so many
// threads. Each has a Room, which the calling thread makes by reserve(room), and keeps its own from call to call: a
// thread that allocates as it begins ends the process if there is no memory. An exception of one ends all, and is
// thrown again here.
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
  } catch (const std::exception&) {  // no more threads, or no memory for them: those that there are do all
  }
  careful(own);
  for (auto& other : others) other.join();
  if (failed) std::rethrow_exception(failed);
}

}  // namespace gn
