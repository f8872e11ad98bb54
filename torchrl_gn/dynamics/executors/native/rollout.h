// Rollouts of a forward model for one scene and their gradients: the state maths by tapes, the network by network.h.
//
// One thread computes a tile of up to 24 samples from the first step to the last, with samples as the lanes of its
// tapes. The order of a sample's operations does not depend on the batch, the tile or the number of threads, so results
// do not depend on these either.
#pragma once

#include <algorithm>
#include <cstdlib>
#include <new>
#include <vector>

#include "call.h"
#include "network.h"
#include "tape.h"
#include "threads.h"

namespace gn __attribute__((visibility("hidden"))) {

// Memory of one thread that is kept from call to call: fresh pages would cost a small batch more than its steps.
class Arena {
 public:
  ~Arena() { std::free(data_); }
  // Allocates memory for all blocks.
  void reserve(size_t bytes) {
    if (bytes <= size_) return;
    std::free(data_);
    size_ = 0;
    bytes = padded(bytes) / 64 * 64;
    data_ = static_cast<char*>(std::aligned_alloc(64, bytes));
    if (!data_) throw std::bad_alloc();
    size_ = bytes, fresh_ = true;
  }
  // Called by the thread that uses the memory, before take().
  void begin() {
    if (fresh_) std::memset(data_, 0, size_);
    fresh_ = false, used_ = 0;
  }
  template <class N>
  N* take(size_t count) {
    N* block = reinterpret_cast<N*>(data_ + used_);
    used_ += padded(sizeof(N) * count);
    return block;
  }
  static size_t padded(size_t bytes) { return (bytes + 127) / 64 * 64; }

 private:
  char* data_ = nullptr;
  size_t size_ = 0, used_ = 0;
  bool fresh_ = false;
};

template <class Net, int W, int C>
struct Runner {
  using T = typename Net::Number;
  static constexpr int L = W * C;
  const Maths& m;
  const Net& network;
  const Call& call;
  int64_t first;  // first sample of this tile, among the call's
  int count;      // samples of this tile
  double* r;
  T* ws;
  T* whole;  // storage for slopes and activations of a single step; null: see kept()

  int64_t sample(int lane) const {
    const int64_t at = first + (lane < count ? lane : count - 1);
    return call.samples ? call.samples[at] : at;
  }

  // Loads number(sample, lane, i) for every lane and input i into the registers of a tape's group.
  template <class F>
  void load(const Tape& tape, int group, int64_t size, F number) const {
    const int64_t* registers = tape.inputs(group);
    for (int64_t i = 0; i < size; ++i)
      if (registers[i] >= 0)
        for (int lane = 0; lane < L; ++lane) r[registers[i] * L + lane] = number(sample(lane), lane, i);
  }
  const double* result(const Tape& tape, int phase, int64_t i) const { return r + tape.outputs(phase)[i] * L; }

  // Copy between lanes and the network's buffers [item][sample][feature].
  void to_network(const Tape& tape, int phase, int64_t skip, int64_t size, int64_t width, T* buffer) const {
    for (int64_t i = 0; i < size; ++i) {
      const double* from = result(tape, phase, skip + i);
      T* to = buffer + (i / width) * width * count + i % width;
      for (int lane = 0; lane < count; ++lane) to[lane * width] = static_cast<T>(from[lane]);
    }
  }
  void from_network(const Tape& tape, int group, int64_t skip, int64_t size, int64_t width, const T* buffer) const {
    for (int64_t i = 0; i < size; ++i) {
      const int64_t at = tape.inputs(group)[skip + i];
      if (at < 0) continue;
      const T* from = buffer + (i / width) * width * count + i % width;
      for (int lane = 0; lane < L; ++lane)
        r[at * L + lane] = static_cast<double>(from[(lane < count ? lane : count - 1) * width]);
    }
  }

  void load_numbers(const Tape& tape) const {
    load(tape, 3, m.numbers, [&](int64_t s, int, int64_t i) { return call.numbers[s * call.number_stride + i]; });
  }

  T* kept(int64_t step) const {
    if (!call.stored || whole) return whole;
    const int64_t block = network.stored() + m.outputs;
    return static_cast<T*>(call.stored) + (first * call.steps + step * count) * block;
  }

  // Computes the network inputs of the states in a tape's registers, and runs the network.
  void predict(const Tape& tape, T* derivatives) const {
    run_tape<W, C>(tape, 0, r);
    to_network(tape, 0, 0, m.node_inputs, m.node_width, network.nodes(ws, count));
    to_network(tape, 0, m.node_inputs, m.edge_inputs, m.edge_width, network.edges(ws, count));
    network.forward(ws, count, derivatives, {call.sample_tables, call.batch, call.samples, first});
  }

  void forward() const {
    const int64_t rows = call.steps + call.with_start, A = m.actions;
    if (call.with_start)
      for (int lane = 0; lane < count; ++lane)
        for (int64_t i = 0; i < m.size; ++i)
          call.out.set(sample(lane) * rows * m.size + i, call.states.get(sample(lane) * call.state_stride + i));
    load_numbers(m.forward);
    load(m.forward, 0, m.varying_count,
         [&](int64_t s, int, int64_t i) { return call.states.get(s * call.state_stride + m.varying[i]); });
    for (int64_t t = 0; t < call.steps; ++t) {
      load(m.forward, 1, A, [&](int64_t s, int, int64_t i) { return call.actions.get((s * call.steps + t) * A + i); });
      T* derivatives = kept(t);
      predict(m.forward, derivatives);
      const T* output = network.output(ws, count);
      if (whole)
        std::copy_n(network.activations(ws), network.activation_count(count), whole + count * network.stored());
      else if (derivatives)
        std::copy_n(output, count * m.outputs, derivatives + count * network.stored());
      from_network(m.forward, 2, 0, m.outputs, m.output_width, output);
      run_tape<W, C>(m.forward, 1, r);
      for (int lane = 0; lane < count; ++lane) {
        const int64_t to = (sample(lane) * rows + t + call.with_start) * m.result_size;
        const int64_t start = sample(lane) * call.state_stride;
        if (m.is_state)
          for (int64_t i = 0; i < m.size - m.varying_count; ++i)
            call.out.set(to + m.constant[i], call.states.get(start + m.constant[i]));
        else
          for (int64_t i = 0; i < m.result_size; ++i) call.out.set(to + i, 0.0);
        for (int64_t i = 0; i < m.result_count; ++i) call.out.set(to + m.results[i], result(m.forward, 1, i)[lane]);
      }
      if (t + 1 < call.steps) {
        // Results may share registers with inputs: copy all results before loading.
        double* next = r + m.forward.registers() * L;
        for (int64_t i = 0; i < m.varying_count; ++i) std::memcpy(next + i * L, result(m.forward, 1, i), sizeof(double) * L);
        load(m.forward, 0, m.varying_count, [&](int64_t, int lane, int64_t i) { return next[i * L + lane]; });
      }
    }
  }

  // Backpropagates through the steps. Varying channels get their gradient, if it is wanted; constant channels get the
  // sum of the gradients of their copies. again, room: memory for a recomputed step. gradient: memory for the gradient
  // of the varying channels. of_weights, of_tables: gradients are added to these, unless null.
  void vjp(double* again, T* room, double* gradient, T* of_weights, T* of_tables) const {
    const int64_t rows = call.steps + call.with_start, A = m.actions, n = m.varying_count;
    std::fill_n(gradient, n * L, 0.0);
    load_numbers(m.adjoint);
    auto incoming = [&](int64_t s, int64_t row, int64_t channel) {
      return call.out.get((s * rows + row) * m.result_size + channel);
    };
    for (int64_t t = call.steps - 1; t >= 0; --t) {
      auto state = [&](int64_t s, int, int64_t i) {
        return call.states.get(s * call.state_stride + t * m.size + m.varying[i]);
      };
      auto action = [&](int64_t s, int, int64_t i) { return call.actions.get((s * call.steps + t) * A + i); };
      const T* derivatives = kept(t);
      const T* output = network.output(ws, count);
      if (whole) {
        std::copy_n(derivatives + count * network.stored(), network.activation_count(count), network.activations(ws));
      } else if (derivatives) {
        output = derivatives + count * network.stored();
      } else {
        Runner forward{m, network, call, first, count, again, ws, nullptr};
        forward.load_numbers(m.forward);
        forward.load(m.forward, 0, n, state);
        forward.load(m.forward, 1, A, action);
        forward.predict(m.forward, room);
        derivatives = room;
      }
      load(m.adjoint, 0, n, state);
      load(m.adjoint, 1, A, action);
      from_network(m.adjoint, 2, 0, m.outputs, m.output_width, output);
      load(m.adjoint, 4, m.result_count, [&](int64_t s, int lane, int64_t i) {
        return incoming(s, t + call.with_start, m.results[i]) + (m.is_state ? gradient[i * L + lane] : 0.0);
      });
      run_tape<W, C>(m.adjoint, 0, r);
      to_network(m.adjoint, 0, 0, m.outputs, m.output_width, network.grad_output(ws, count));
      const bool of_inputs = call.grad_state.data || t > 0;
      network.backward(ws, count, derivatives, of_inputs);
      if (of_weights) network.weight_gradients(ws, count, derivatives, of_weights, of_tables);
      if (!of_inputs) return;
      from_network(m.adjoint, 5, 0, m.node_inputs, m.node_width, network.grad_nodes(ws, count));
      from_network(m.adjoint, 5, m.node_inputs, m.edge_inputs, m.edge_width, network.grad_edges(ws, count));
      run_tape<W, C>(m.adjoint, 1, r);
      for (int64_t i = 0; i < n; ++i) std::memcpy(&gradient[i * L], result(m.adjoint, 1, i), sizeof(double) * L);
      for (int64_t i = 0; i < A && call.grad_actions.data; ++i)
        for (int lane = 0; lane < count; ++lane)
          call.grad_actions.set((sample(lane) * call.steps + t) * A + i, result(m.adjoint, 1, n + i)[lane]);
    }
    for (int lane = 0; lane < count; ++lane) {
      const int64_t s = sample(lane);
      for (int64_t i = 0; i < n; ++i)
        call.grad_state.set(s * m.size + m.varying[i],
                            gradient[i * L + lane] + (call.with_start ? incoming(s, 0, m.varying[i]) : 0.0));
      for (int64_t i = 0; i < m.size - n; ++i) {
        double sum = 0;
        for (int64_t row = 0; row < rows && m.is_state; ++row) sum += incoming(s, row, m.constant[i]);
        call.grad_state.set(s * m.size + m.constant[i], sum);
      }
    }
  }
};

// Numbers of type T that a tile stores for its adjoint if it keeps all of a single step.
template <class Net>
int64_t tile_store(const Net& network, const Call& call) {
  return network.stored() * call.tile + network.activation_count(call.tile);
}

// Numbers of type T that `count` samples of a call store for the adjoint.
template <class Net>
int64_t kept_count(const Net& network, const MathsWords& m, const Call& call, int64_t count) {
  if (call.keeps_all) return tile_store(network, call) * ((count + call.tile - 1) / call.tile);
  return (network.stored() + m.outputs) * count * call.steps;
}

// The same for a whole call: each of the two groups in run() may end with a partial tile.
template <class Net>
int64_t stored_count(const Net& network, const MathsWords& m, const Call& call) {
  return kept_count(network, m, call, call.batch) + (call.keeps_all ? tile_store(network, call) : 0);
}

// Gradients of weights and tables, summed in a number of parts that does not depend on the threads.
template <class T>
struct WeightGradients {
  static constexpr int64_t kMostParts = 4;
  WeightGradients(const Call& call, const NetworkWords& words, int64_t tiles)
      : parts(call.grad_weights ? std::min(tiles, kMostParts) : 0), weights(words.plain_weights), tables(words.tables),
        numbers(parts * (weights + tables), T(0)) {}
  T* of_weights(int64_t part) { return parts ? numbers.data() + part * (weights + tables) : nullptr; }
  T* of_tables(int64_t part) { return parts ? of_weights(part) + weights : nullptr; }
  template <class Net>
  void write(const Call& call, const Net& network) {
    if (!parts) return;
    for (int64_t part = 1; part < parts; ++part)
      for (int64_t j = 0; j < weights + tables; ++j) numbers[j] += numbers[part * (weights + tables) + j];
    network.add_packed(of_weights(0), static_cast<T*>(call.grad_weights));
    for (int64_t j = 0; j < tables; ++j) static_cast<T*>(call.grad_tables)[j] += of_tables(0)[j];
  }

  int64_t parts, weights, tables;
  std::vector<T> numbers;
};

template <class Net, int W, int C>
void run_tiles(const Maths& m, const Net& network, const Call& call, bool adjoint) {
  using T = typename Net::Number;
  const int64_t tiles = (call.count + call.tile - 1) / call.tile;
  WeightGradients<T> gradients(call, m.structure.network(), adjoint ? tiles : 0);
  // One thread computes the tiles of a part in order; without parts, each tile is a part.
  const int64_t parts = gradients.parts ? gradients.parts : tiles;
  constexpr int L = W * C;
  const int64_t most = std::max(m.forward.registers(), adjoint ? m.adjoint.registers() : 0) + m.varying_count;
  const bool again = adjoint && !call.stored;
  const size_t registers = L * most, ws = network.workspace(call.tile, adjoint);
  const size_t derivatives = again ? network.stored() * call.tile : 0, gradient = adjoint ? L * m.varying_count : 0;
  auto reserve = [&](Arena& arena) {
    arena.reserve((again ? 2 : 1) * Arena::padded(sizeof(double) * registers) + Arena::padded(sizeof(T) * ws) +
                  Arena::padded(sizeof(T) * derivatives) + Arena::padded(sizeof(double) * gradient));
  };
  on_threads<Arena>(call.threads, parts, reserve, [&](Arena& arena, std::atomic<int64_t>& next) {
    arena.begin();
    double* const r = arena.take<double>(registers);
    double* const more = again ? arena.take<double>(registers) : nullptr;
    T* const scratch = arena.take<T>(ws);
    T* const room = arena.take<T>(derivatives);
    double* const sums = arena.take<double>(gradient);
    for (int64_t part; (part = next++) < parts;)
      for (int64_t tile = part; tile < tiles; tile += parts) {
        const int64_t first = tile * call.tile, count = std::min(call.tile, call.count - first);
        T* const whole =
            call.keeps_all && call.stored ? static_cast<T*>(call.stored) + tile * tile_store(network, call) : nullptr;
        Runner<Net, W, C> runner{m, network, call, first, static_cast<int>(count), r, scratch, whole};
        if (!adjoint) runner.forward();
        else runner.vjp(more, room, sums, gradients.of_weights(part), gradients.of_tables(part));
      }
  });
  if (adjoint) gradients.write(call, network);
}

template <class Net>
void run_group(const Maths& m, const Net& network, const Call& call, bool adjoint) {
  if (call.tile <= 1) run_tiles<Net, 1, 1>(m, network, call, adjoint);
  else if (call.tile <= 4) run_tiles<Net, 4, 1>(m, network, call, adjoint);
  else if (call.tile <= 8) run_tiles<Net, 8, 1>(m, network, call, adjoint);
  else if (call.tile <= 16) run_tiles<Net, 8, 2>(m, network, call, adjoint);
  else run_tiles<Net, 8, 3>(m, network, call, adjoint);
}

// Computes the samples that fit the usual state maths, then the others by the general one. Returns false and computes
// nothing if there are others and the structure lacks the general one.
template <class Net>
bool run(const Structure& structure, const Net& network, Call call, bool adjoint) {
  const Maths usual(structure, *structure.maths(0));
  std::vector<int64_t> groups[2];
  for (int64_t s = 0; s < call.batch; ++s) groups[fits(usual, call.states, s * call.state_stride) ? 0 : 1].push_back(s);
  if (!groups[1].empty() && !structure.maths(1)) return false;
  for (int which : {0, 1}) {
    const std::vector<int64_t>& group = groups[which];
    call.count = static_cast<int64_t>(group.size());
    call.samples = call.count == call.batch ? nullptr : group.data();
    if (group.empty()) continue;
    run_group(which ? Maths(structure, *structure.maths(1)) : usual, network, call, adjoint);
    if (call.stored)
      call.stored = static_cast<typename Net::Number*>(call.stored) + kept_count(network, usual, call, call.count);
  }
  return true;
}

}  // namespace gn
