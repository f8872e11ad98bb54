// Rollouts of a specialised forward model and their gradients: the state maths by tapes, the network by network.h.
//
// Samples are handled in tiles of up to 24, each from its first step to its last by one thread, with samples as the
// lanes of its tapes. Every sample is computed in the same order whatever the batch, the tile and the number of
// threads, so results do not depend on them.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <system_error>
#include <thread>
#include <vector>

#include "call.h"
#include "network.h"
#include "tape.h"

namespace gn __attribute__((visibility("hidden"))) {

// What library.py fills in; all memory is Python's.
struct Maths {
  int64_t size;            // channels of a state, N * C
  int64_t varying_count;   // of them change
  int64_t result_size;     // numbers of a result: a state, or a change N * 12
  int64_t result_count;    // of them are computed
  int64_t is_state;        // a result is a state: its other channels are copied, and steps follow each other
  int64_t actions;
  int64_t parameters;      // physical parameters that differ between samples
  int64_t outputs;         // P * F_out
  int64_t node_inputs, edge_inputs;  // N * F_n, E * F_e
  int64_t node_width, edge_width, output_width;
  const int32_t* varying;
  const int32_t* constant;
  const double* values;    // of the constant channels
  const int32_t* results;  // channels of a result that are computed
  Tape forward, adjoint;
};

constexpr double TOLERANCE = 1e-9;

// Memory of one thread that is kept from call to call: fresh pages would cost a small batch more than its steps.
class Arena {
 public:
  ~Arena() { std::free(data_); }
  // Room for all blocks, which take() then hands out.
  void reserve(size_t bytes) {
    if (bytes > size_) {
      std::free(data_);
      data_ = static_cast<char*>(std::aligned_alloc(64, bytes));
      size_ = bytes;
      std::memset(data_, 0, bytes);
    }
    used_ = 0;
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
};

template <class Net, int W, int C>
struct Runner {
  using T = typename Net::Number;
  static constexpr int L = W * C;
  const Maths& m;
  const Net& network;
  const Call& call;
  int64_t first;
  int count;  // samples of this tile
  double* r;
  T* ws;
  T* whole;  // where the only step keeps its slopes and activations; null: as stored() says

  int64_t sample(int lane) const { return first + (lane < count ? lane : count - 1); }

  // Numbers at[index] of every sample into a group of a tape's registers.
  template <class F>
  void load(const Tape& tape, int group, int64_t size, F number) const {
    const int32_t* registers = tape.inputs[group];
    for (int64_t i = 0; i < size; ++i)
      if (registers[i] >= 0)
        for (int lane = 0; lane < L; ++lane) r[registers[i] * int64_t(L) + lane] = number(sample(lane), lane, i);
  }
  const double* result(const Tape& tape, int phase, int64_t i) const { return r + tape.outputs[phase][i] * int64_t(L); }

  // Between lanes and the network's buffers [item][sample][feature].
  void to_network(const Tape& tape, int phase, int64_t skip, int64_t size, int64_t width, T* buffer) const {
    for (int64_t i = 0; i < size; ++i) {
      const double* from = result(tape, phase, skip + i);
      T* to = buffer + (i / width) * width * count + i % width;
      for (int lane = 0; lane < count; ++lane) to[lane * width] = static_cast<T>(from[lane]);
    }
  }
  void from_network(const Tape& tape, int group, int64_t skip, int64_t size, int64_t width, const T* buffer) const {
    for (int64_t i = 0; i < size; ++i) {
      const int32_t at = tape.inputs[group][skip + i];
      if (at < 0) continue;
      const T* from = buffer + (i / width) * width * count + i % width;
      for (int lane = 0; lane < L; ++lane)
        r[at * int64_t(L) + lane] = static_cast<double>(from[(lane < count ? lane : count - 1) * width]);
    }
  }

  void load_parameters(const Tape& tape) const {
    load(tape, 3, m.parameters, [&](int64_t s, int, int64_t i) { return call.parameters[s * call.parameter_stride + i]; });
  }

  T* stored(int64_t step) const {
    if (!call.stored || whole) return whole;
    const int64_t block = network.stored() + m.outputs;
    return static_cast<T*>(call.stored) + (first * call.steps + step * count) * block;
  }

  // Network inputs of the states in a tape's registers, and the network.
  void predict(const Tape& tape, T* derivatives) const {
    run_tape<W, C>(tape, 0, r);
    to_network(tape, 0, 0, m.node_inputs, m.node_width, network.nodes(ws, count));
    to_network(tape, 0, m.node_inputs, m.edge_inputs, m.edge_width, network.edges(ws, count));
    network.forward(ws, count, derivatives, {call.sample_tables, call.batch, first});
  }

  void forward() const {
    const int64_t rows = call.steps + call.with_start, A = m.actions;
    if (call.with_start)
      for (int lane = 0; lane < count; ++lane)
        for (int64_t i = 0; i < m.size; ++i)
          call.out.set((first + lane) * rows * m.size + i, call.states.get((first + lane) * call.state_stride + i));
    load_parameters(m.forward);
    load(m.forward, 0, m.varying_count,
         [&](int64_t s, int, int64_t i) { return call.states.get(s * call.state_stride + m.varying[i]); });
    for (int64_t t = 0; t < call.steps; ++t) {
      load(m.forward, 1, A, [&](int64_t s, int, int64_t i) { return call.actions.get((s * call.steps + t) * A + i); });
      T* derivatives = stored(t);
      predict(m.forward, derivatives);
      const T* output = network.output(ws, count);
      if (whole)
        std::copy_n(network.activations(ws), network.activation_count(count), whole + count * network.stored());
      else if (derivatives)
        std::copy_n(output, count * m.outputs, derivatives + count * network.stored());
      from_network(m.forward, 2, 0, m.outputs, m.output_width, output);
      run_tape<W, C>(m.forward, 1, r);
      for (int lane = 0; lane < count; ++lane) {
        const int64_t to = ((first + lane) * rows + t + call.with_start) * m.result_size;
        const int64_t start = (first + lane) * call.state_stride;
        if (m.is_state)
          for (int64_t i = 0; i < m.size - m.varying_count; ++i)
            call.out.set(to + m.constant[i], call.states.get(start + m.constant[i]));
        else
          for (int64_t i = 0; i < m.result_size; ++i) call.out.set(to + i, 0.0);
        for (int64_t i = 0; i < m.result_count; ++i) call.out.set(to + m.results[i], result(m.forward, 1, i)[lane]);
      }
      if (t + 1 < call.steps) {
        // Results may lie in the registers of inputs: move all at once.
        double* next = r + m.forward.registers * L;
        for (int64_t i = 0; i < m.varying_count; ++i) std::memcpy(next + i * L, result(m.forward, 1, i), sizeof(double) * L);
        load(m.forward, 0, m.varying_count, [&](int64_t, int lane, int64_t i) { return next[i * L + lane]; });
      }
    }
  }

  // Gradient of the varying channels; that of the constant ones is what their copies receive.
  // again, derivatives: room for the step that is computed again; gradient: of the varying channels.
  void adjoint(double* again, T* derivatives, double* gradient, T* const* of_weights, T* const* of_tables) const {
    const int64_t rows = call.steps + call.with_start, A = m.actions, n = m.varying_count;
    std::fill_n(gradient, n * L, 0.0);
    load_parameters(m.adjoint);
    auto incoming = [&](int64_t s, int64_t row, int64_t channel) {
      return call.out.get((s * rows + row) * m.result_size + channel);
    };
    for (int64_t t = call.steps - 1; t >= 0; --t) {
      auto state = [&](int64_t s, int, int64_t i) {
        return call.states.get(s * call.state_stride + t * m.size + m.varying[i]);
      };
      auto action = [&](int64_t s, int, int64_t i) { return call.actions.get((s * call.steps + t) * A + i); };
      const T* kept = stored(t);
      const T* output = network.output(ws, count);
      if (whole) {
        std::copy_n(kept + count * network.stored(), network.activation_count(count), network.activations(ws));
      } else if (kept) {
        output = kept + count * network.stored();
      } else {
        Runner forward{m, network, call, first, count, again, ws, nullptr};
        forward.load_parameters(m.forward);
        forward.load(m.forward, 0, n, state);
        forward.load(m.forward, 1, A, action);
        forward.predict(m.forward, derivatives);
        kept = derivatives;
      }
      load(m.adjoint, 0, n, state);
      load(m.adjoint, 1, A, action);
      from_network(m.adjoint, 2, 0, m.outputs, m.output_width, output);
      load(m.adjoint, 4, m.result_count, [&](int64_t s, int lane, int64_t i) {
        return incoming(s, t + call.with_start, m.results[i]) + (m.is_state ? gradient[i * L + lane] : 0.0);
      });
      run_tape<W, C>(m.adjoint, 0, r);
      to_network(m.adjoint, 0, 0, m.outputs, m.output_width, network.grad_output(ws, count));
      network.backward(ws, count, kept);
      if (of_weights) network.weight_gradients(ws, count, kept, of_weights, of_tables);
      from_network(m.adjoint, 5, 0, m.node_inputs, m.node_width, network.grad_nodes(ws, count));
      from_network(m.adjoint, 5, m.node_inputs, m.edge_inputs, m.edge_width, network.grad_edges(ws, count));
      run_tape<W, C>(m.adjoint, 1, r);
      for (int64_t i = 0; i < n; ++i) std::memcpy(&gradient[i * L], result(m.adjoint, 1, i), sizeof(double) * L);
      for (int64_t i = 0; i < A; ++i)
        for (int lane = 0; lane < count; ++lane)
          call.grad_actions.set(((first + lane) * call.steps + t) * A + i, result(m.adjoint, 1, n + i)[lane]);
    }
    for (int lane = 0; lane < count; ++lane) {
      const int64_t s = first + lane;
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

// T's that a tile of a training call keeps for its adjoint.
template <class Net>
int64_t tile_store(const Net& network, const Call& call) {
  return network.stored() * call.tile + network.activation_count(call.tile);
}

// Gradients of the weights, added up in as many parts as do not depend on the threads.
template <class T>
struct WeightGradients {
  static constexpr int64_t kMostParts = 4;
  WeightGradients(const Call& call, const std::vector<int64_t>& weights, const std::vector<int64_t>& tables, int64_t tiles)
      : parts(call.train ? std::min(tiles, kMostParts) : 0), numbers(parts), of_weights(parts), of_tables(parts) {
    for (int64_t part = 0; part < parts; ++part) {
      int64_t total = 0;
      for (size_t i = 0; i < weights.size(); ++i) total += weights[i] + tables[i];
      numbers[part].assign(total, T(0));
      T* at = numbers[part].data();
      for (size_t i = 0; i < weights.size(); ++i) {
        of_weights[part].push_back(at);
        of_tables[part].push_back(call.grad_tables[i] ? at + weights[i] : nullptr);
        at += weights[i] + tables[i];
      }
    }
  }
  void write(const Call& call, const std::vector<int64_t>& weights, const std::vector<int64_t>& tables) const {
    if (!parts) return;
    for (size_t i = 0; i < weights.size(); ++i) {
      sum(static_cast<T*>(call.grad_weights[i]), of_weights, i, weights[i]);
      if (call.grad_tables[i]) sum(static_cast<T*>(call.grad_tables[i]), of_tables, i, tables[i]);
    }
  }
  void sum(T* to, const std::vector<std::vector<T*>>& from, size_t i, int64_t size) const {
    std::copy_n(from[0][i], size, to);
    for (int64_t part = 1; part < parts; ++part)
      for (int64_t j = 0; j < size; ++j) to[j] += from[part][i][j];
  }

  int64_t parts;
  std::vector<std::vector<T>> numbers;
  std::vector<std::vector<T*>> of_weights, of_tables;
};

template <class Net, int W, int C>
void run_tiles(const Maths& m, const Net& network, const Call& call, bool adjoint) {
  using T = typename Net::Number;
  const int64_t tiles = (call.batch + call.tile - 1) / call.tile;
  const bool trains = adjoint && call.train;
  const std::vector<int64_t> none;
  const auto weights = trains ? network.weight_sizes() : none, tables = trains ? network.table_sizes() : none;
  WeightGradients<T> gradients(call, weights, tables, trains ? tiles : 0);
  // Each part's tiles are handled in order by one thread; without parts, a tile is a part.
  const int64_t parts = gradients.parts ? gradients.parts : tiles;
  std::atomic<int64_t> next{0};
  auto work = [&]() {
    constexpr int L = W * C;
    const int64_t most = std::max(m.forward.registers, adjoint ? m.adjoint.registers : 0) + m.varying_count;
    const bool again = adjoint && !call.stored;
    const size_t registers = L * most, ws = network.workspace(call.tile, adjoint);
    const size_t derivatives = again ? network.stored() * call.tile : 0, gradient = adjoint ? L * m.varying_count : 0;
    static thread_local Arena arena;
    arena.reserve((again ? 2 : 1) * Arena::padded(sizeof(double) * registers) + Arena::padded(sizeof(T) * ws) +
                  Arena::padded(sizeof(T) * derivatives) + Arena::padded(sizeof(double) * gradient));
    double* const r = arena.take<double>(registers);
    double* const more = again ? arena.take<double>(registers) : nullptr;
    T* const scratch = arena.take<T>(ws);
    T* const kept = arena.take<T>(derivatives);
    double* const sums = arena.take<double>(gradient);
    for (int64_t part; (part = next++) < parts;)
      for (int64_t tile = part; tile < tiles; tile += parts) {
        const int64_t first = tile * call.tile, count = std::min(call.tile, call.batch - first);
        T* const whole =
            call.train ? static_cast<T*>(call.stored) + tile * tile_store(network, call) : nullptr;
        Runner<Net, W, C> runner{m, network, call, first, static_cast<int>(count), r, scratch, whole};
        if (!adjoint) runner.forward();
        else if (!call.train) runner.adjoint(more, kept, sums, nullptr, nullptr);
        else runner.adjoint(more, kept, sums, gradients.of_weights[part].data(), gradients.of_tables[part].data());
      }
  };
  std::vector<std::thread> others;
  try {
    for (int64_t i = 1; i < std::min(call.threads, parts); ++i) others.emplace_back(work);
  } catch (const std::system_error&) {  // the system has no more: those that there are do all tiles
  }
  work();
  for (auto& other : others) other.join();
  gradients.write(call, weights, tables);
}

template <class Net>
void run(const Maths& m, const Net& network, const Call& call, bool adjoint) {
  if (call.tile <= 1) run_tiles<Net, 1, 1>(m, network, call, adjoint);
  else if (call.tile <= 4) run_tiles<Net, 4, 1>(m, network, call, adjoint);
  else if (call.tile <= 8) run_tiles<Net, 8, 1>(m, network, call, adjoint);
  else if (call.tile <= 16) run_tiles<Net, 8, 2>(m, network, call, adjoint);
  else run_tiles<Net, 8, 3>(m, network, call, adjoint);
}

// Calls a function with the network of a kind: 0 float32, 1 float64, 2 bfloat16 products summed in float32.
template <class F>
auto with_network(const void* network, int64_t kind, F function) {
  if (kind == 1) return function(*static_cast<const Network<double>*>(network));
#ifdef __AVX512BF16__
  if (kind == 2) return function(*static_cast<const Network<float, true>*>(network));
#endif
  return function(*static_cast<const Network<float>*>(network));
}

template <class Net>
void* make(const int64_t* code, const void* const* weights, const void* const* tables) {
  using T = typename Net::Number;
  return new Net(code, reinterpret_cast<const T* const*>(weights), reinterpret_cast<const T* const*>(tables));
}

// Whether the start states' constant channels are those that the tapes were made for.
inline bool fits(const Maths& m, const Call& call) {
  for (int64_t s = 0; s < call.batch; ++s)
    for (int64_t i = 0; i < m.size - m.varying_count; ++i) {
      const double difference = call.states.get(s * call.state_stride + m.constant[i]) - m.values[i];
      if (!(std::fabs(difference) <= TOLERANCE * (1 + std::fabs(m.values[i])))) return false;
    }
  return true;
}

}  // namespace gn
