// Rollouts of a specialised forward model, and their gradients, without Python: the C interface of library.py.
//
// Samples are handled in tiles of up to 24, each from its first step to its last by one thread: the state maths by
// tapes (tape.h, samples as lanes), the network by network.h. Every sample is computed in the same order whatever the
// batch, the tile and the number of threads, so results do not depend on them.
#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <system_error>
#include <thread>
#include <vector>

#include "network.h"
#include "tape.h"

namespace gn {

// A number array in float32 or float64.
struct Array {
  void* data;
  int64_t is_double;
  double get(int64_t i) const {
    return is_double ? static_cast<double*>(data)[i] : static_cast<double>(static_cast<float*>(data)[i]);
  }
  void set(int64_t i, double value) const {
    if (is_double) static_cast<double*>(data)[i] = value;
    else static_cast<float*>(data)[i] = static_cast<float>(value);
  }
};

// What library.py fills in; all memory is Python's.
struct Maths {
  int64_t size;            // channels of a state, N * C
  int64_t varying_count;   // of them change
  int64_t actions;
  int64_t outputs;         // P * F_out
  int64_t node_inputs, edge_inputs;  // N * F_n, E * F_e
  int64_t node_width, edge_width, output_width;
  const int32_t* varying;
  const int32_t* constant;
  const double* values;    // of the constant channels
  Tape forward, adjoint;
};

struct Call {
  int64_t batch, steps, tile, threads;
  Array states;            // forward: start states [B, size]; adjoint: all states, sample stride below
  int64_t state_stride;    // from sample to sample, in numbers
  Array actions;           // [B, T, A]
  Array out;               // forward: [B, T + with_start, size]; adjoint: gradient of those
  int64_t with_start;
  Array grad_state;        // adjoint: [B, size]
  Array grad_actions;      // adjoint: [B, T, A]
  void* stored;            // [B * T * stored()] network numbers, or null: compute the steps again
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

template <class T, int W, int C>
struct Runner {
  static constexpr int L = W * C;
  const Maths& m;
  const Network<T>& network;
  const Call& call;
  int64_t first;
  int count;  // samples of this tile
  double* r;
  T* ws;

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

  T* stored(int64_t step) const {
    if (!call.stored) return nullptr;
    const int64_t block = network.stored() + m.outputs;
    return static_cast<T*>(call.stored) + (first * call.steps + step * count) * block;
  }

  // Network inputs of the states in a tape's registers, and the network.
  void predict(const Tape& tape, T* derivatives) const {
    run_tape<W, C>(tape, 0, r);
    to_network(tape, 0, 0, m.node_inputs, m.node_width, network.nodes(ws, count));
    to_network(tape, 0, m.node_inputs, m.edge_inputs, m.edge_width, network.edges(ws, count));
    network.forward(ws, count, derivatives);
  }

  void forward() const {
    const int64_t rows = call.steps + call.with_start, A = m.actions;
    if (call.with_start)
      for (int lane = 0; lane < count; ++lane)
        for (int64_t i = 0; i < m.size; ++i)
          call.out.set((first + lane) * rows * m.size + i, call.states.get((first + lane) * call.state_stride + i));
    load(m.forward, 0, m.varying_count,
         [&](int64_t s, int, int64_t i) { return call.states.get(s * call.state_stride + m.varying[i]); });
    for (int64_t t = 0; t < call.steps; ++t) {
      load(m.forward, 1, A, [&](int64_t s, int, int64_t i) { return call.actions.get((s * call.steps + t) * A + i); });
      T* derivatives = stored(t);
      predict(m.forward, derivatives);
      const T* output = network.output(ws, count);
      if (derivatives) std::memcpy(derivatives + count * network.stored(), output, sizeof(T) * count * m.outputs);
      from_network(m.forward, 2, 0, m.outputs, m.output_width, output);
      run_tape<W, C>(m.forward, 1, r);
      for (int lane = 0; lane < count; ++lane) {
        const int64_t to = ((first + lane) * rows + t + call.with_start) * m.size, start = (first + lane) * call.state_stride;
        for (int64_t i = 0; i < m.varying_count; ++i) call.out.set(to + m.varying[i], result(m.forward, 1, i)[lane]);
        for (int64_t i = 0; i < m.size - m.varying_count; ++i)
          call.out.set(to + m.constant[i], call.states.get(start + m.constant[i]));
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
  void adjoint(double* again, T* derivatives, double* gradient) const {
    const int64_t rows = call.steps + call.with_start, A = m.actions, n = m.varying_count;
    std::fill_n(gradient, n * L, 0.0);
    auto incoming = [&](int64_t s, int64_t row, int64_t channel) {
      return call.out.get((s * rows + row) * m.size + channel);
    };
    for (int64_t t = call.steps - 1; t >= 0; --t) {
      for (int64_t i = 0; i < n; ++i)
        for (int lane = 0; lane < L; ++lane)
          gradient[i * L + lane] += incoming(sample(lane), t + call.with_start, m.varying[i]);
      auto state = [&](int64_t s, int, int64_t i) {
        return call.states.get(s * call.state_stride + t * m.size + m.varying[i]);
      };
      auto action = [&](int64_t s, int, int64_t i) { return call.actions.get((s * call.steps + t) * A + i); };
      const T* kept = stored(t);
      const T* output;
      if (kept) {
        output = kept + count * network.stored();
      } else {
        Runner forward{m, network, call, first, count, again, ws};
        forward.load(m.forward, 0, n, state);
        forward.load(m.forward, 1, A, action);
        forward.predict(m.forward, derivatives);
        kept = derivatives;
        output = network.output(ws, count);
      }
      load(m.adjoint, 0, n, state);
      load(m.adjoint, 1, A, action);
      from_network(m.adjoint, 2, 0, m.outputs, m.output_width, output);
      load(m.adjoint, 3, n, [&](int64_t, int lane, int64_t i) { return gradient[i * L + lane]; });
      run_tape<W, C>(m.adjoint, 0, r);
      to_network(m.adjoint, 0, 0, m.outputs, m.output_width, network.grad_output(ws, count));
      network.backward(ws, count, kept);
      from_network(m.adjoint, 4, 0, m.node_inputs, m.node_width, network.grad_nodes(ws, count));
      from_network(m.adjoint, 4, m.node_inputs, m.edge_inputs, m.edge_width, network.grad_edges(ws, count));
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
        for (int64_t row = 0; row < rows; ++row) sum += incoming(s, row, m.constant[i]);
        call.grad_state.set(s * m.size + m.constant[i], sum);
      }
    }
  }
};

template <class T, int W, int C>
void run_tiles(const Maths& m, const Network<T>& network, const Call& call, bool adjoint) {
  const int64_t tiles = (call.batch + call.tile - 1) / call.tile;
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
    for (int64_t tile; (tile = next++) < tiles;) {
      const int64_t first = tile * call.tile, count = std::min(call.tile, call.batch - first);
      Runner<T, W, C> runner{m, network, call, first, static_cast<int>(count), r, scratch};
      if (adjoint) runner.adjoint(more, kept, sums);
      else runner.forward();
    }
  };
  std::vector<std::thread> others;
  try {
    for (int64_t i = 1; i < std::min(call.threads, tiles); ++i) others.emplace_back(work);
  } catch (const std::system_error&) {  // the system has no more: those that there are do all tiles
  }
  work();
  for (auto& other : others) other.join();
}

template <class T>
void run(const Maths& m, const Network<T>& network, const Call& call, bool adjoint) {
  if (call.tile <= 1) run_tiles<T, 1, 1>(m, network, call, adjoint);
  else if (call.tile <= 4) run_tiles<T, 4, 1>(m, network, call, adjoint);
  else if (call.tile <= 8) run_tiles<T, 8, 1>(m, network, call, adjoint);
  else if (call.tile <= 16) run_tiles<T, 8, 2>(m, network, call, adjoint);
  else run_tiles<T, 8, 3>(m, network, call, adjoint);
}

}  // namespace gn

extern "C" {

// All functions may be called from several threads at once.
int64_t gn_version() { return 1; }

void* gn_network_new(int64_t is_double, const int64_t* code, const void* const* weights, const void* const* tables) {
  if (is_double)
    return new gn::Network<double>(code, reinterpret_cast<const double* const*>(weights),
                                   reinterpret_cast<const double* const*>(tables));
  return new gn::Network<float>(code, reinterpret_cast<const float* const*>(weights),
                                reinterpret_cast<const float* const*>(tables));
}

void gn_network_delete(void* network, int64_t is_double) {
  if (is_double) delete static_cast<gn::Network<double>*>(network);
  else delete static_cast<gn::Network<float>*>(network);
}

int64_t gn_network_stored(const void* network, int64_t is_double) {
  return is_double ? static_cast<const gn::Network<double>*>(network)->stored()
                   : static_cast<const gn::Network<float>*>(network)->stored();
}

// 1 if a start state's constant channels are not those that the tapes were made for: nothing was computed.
int64_t gn_rollout(const void* network, int64_t is_double, const gn::Maths* maths, const gn::Call* call) {
  for (int64_t s = 0; s < call->batch; ++s)
    for (int64_t i = 0; i < maths->size - maths->varying_count; ++i) {
      const double expected = maths->values[i];
      const double difference = call->states.get(s * call->state_stride + maths->constant[i]) - expected;
      if (!(std::fabs(difference) <= gn::TOLERANCE * (1 + std::fabs(expected)))) return 1;
    }
  if (is_double) gn::run(*maths, *static_cast<const gn::Network<double>*>(network), *call, false);
  else gn::run(*maths, *static_cast<const gn::Network<float>*>(network), *call, false);
  return 0;
}

void gn_rollout_adjoint(const void* network, int64_t is_double, const gn::Maths* maths, const gn::Call* call) {
  if (is_double) gn::run(*maths, *static_cast<const gn::Network<double>*>(network), *call, true);
  else gn::run(*maths, *static_cast<const gn::Network<float>*>(network), *call, true);
}
}
