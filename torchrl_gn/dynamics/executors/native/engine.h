// Interface of engine.cpp for operators.cpp, without PyTorch: the engine for all types of numbers.
#pragma once

#include "call.h"

#include <vector>

namespace gn __attribute__((visibility("hidden"))) {

// Number types of a network's weights.
enum Type : int64_t { kFloat32, kFloat64, kBfloat16Pairs };

// A network: packed weights of some type, tables of float32 or, with float64 weights, float64.
struct Weights {
  Type type;
  const void *weights, *tables;
};

struct MuonMatrix {
  void* parameter;
  const void* gradient;
  void* moment;
  int64_t rows, columns;  // row-major
};

struct MuonOptions {
  double momentum, rate;
  const double* polynomials;  // linear, cubic and quintic coefficient of each
  int64_t count;
};

// Errors are C++ exceptions: std::bad_alloc without memory, std::invalid_argument if words are no structure.
bool has_bfloat16();
void check(const int64_t* words, int64_t count);
bool run(const Structure& structure, const Weights& weights, const Call& call, bool adjoint);
int64_t stored_count(const Structure& structure, const Weights& weights, const Call& call);
void muon(Type type, const std::vector<MuonMatrix>& matrices, const MuonOptions& options, int64_t threads);

}  // namespace gn
