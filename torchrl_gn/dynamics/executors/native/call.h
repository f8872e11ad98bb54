// What a call of the native executor reads: shared by its library and the binding of single steps.
#pragma once

#include <cstdint>

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

// As library.py fills it in.
struct Call {
  int64_t batch, steps, tile, threads;
  Array states;            // forward: start states [B, size]; adjoint: all states, sample stride below
  int64_t state_stride;    // from sample to sample, in numbers
  Array actions;           // [B, T, A]
  Array out;               // forward: [B, T + with_start, result_size]; adjoint: gradient of those
  int64_t with_start;
  Array grad_state;        // adjoint: [B, size]
  Array grad_actions;      // adjoint: [B, T, A]
  void* stored;            // what the adjoint needs: [B * T] slopes and outputs, or if train gn_stored(); null: nothing
  int64_t train;           // of one step all is stored, and the adjoint adds gradients of the weights
  void* const* grad_weights;  // of every layer [out, K]
  void* const* grad_tables;   // and [I, out], or null
  const void* const* sample_tables;  // of every layer [I, B, out padded to 16], or null; null: none has one
  const double* parameters;          // [B, P] physical parameters that the tapes read, sample stride below
  int64_t parameter_stride;
};

}  // namespace gn
