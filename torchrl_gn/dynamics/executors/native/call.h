// Inputs and outputs of a call of the native executor.
#pragma once

#include <cmath>
#include <cstdint>

#include "structure.h"

namespace gn __attribute__((visibility("hidden"))) {

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

// Inputs and outputs of a rollout, or of its adjoint.
struct Call {
  int64_t batch, steps, tile, threads;
  int64_t count;           // samples to compute; run() sets it
  const int64_t* samples;  // [count] their places in the batch; null: all
  Array states;            // forward: start states [B, size]; adjoint: all states, sample stride below
  int64_t state_stride;    // numbers from one sample to the next
  Array actions;           // [B, T, A]
  Array out;               // forward: [B, T + with_start, result_size]; adjoint: the gradient in these
  int64_t with_start;
  const double* numbers;   // [B, numbers] of the model and of each sample, sample stride below
  int64_t number_stride;
  const void* sample_tables;  // every layer's [I, B, out padded to kPanel], one after the other; null: none has any
  Array grad_state;        // adjoint: [B, size]; null: no gradient in states and actions
  Array grad_actions;      // adjoint: [B, T, A]
  void* stored;            // stored_count() numbers for the adjoint; null: it recomputes the steps
  int64_t keeps_all;       // also keep the activations of a single step, for gradients of the weights
  void* grad_weights;      // adjoint: laid out like the packed weights, initially 0; null: no gradient of weights
  void* grad_tables;       // adjoint: laid out like the shared tables, initially 0
};

// State maths of a structure: its words, and the lists that they point to.
struct Maths : MathsWords {
  Structure structure;
  Tape forward, adjoint;
  const int64_t *varying, *constant, *results;
  const double* values;

  Maths(const Structure& of, const MathsWords& words)
      : MathsWords(words),
        structure(of),
        forward(of, words.forward),
        adjoint(of, words.adjoint),
        varying(of.list(words.varying)),
        constant(of.list(words.constant)),
        results(of.list(words.results)),
        values(of.doubles(words.values)) {}
};

constexpr int64_t kTile = 24;  // samples that stay in a processor's cache from layer to layer

// True if a start state's constant channels have the values that the tapes assume.
inline bool fits(const Maths& m, const Array& states, int64_t start) {
  const double tolerance = states.is_double ? 1e-9 : 2e-7;  // the latter for rounding to float32
  for (int64_t i = 0; i < m.size - m.varying_count; ++i) {
    const double difference = states.get(start + m.constant[i]) - m.values[i];
    if (!(std::fabs(difference) <= tolerance * (1 + std::fabs(m.values[i])))) return false;
  }
  return true;
}

}  // namespace gn
