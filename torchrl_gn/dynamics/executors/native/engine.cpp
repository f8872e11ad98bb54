#include "engine.h"

#include "muon.h"
#include "rollout.h"
#include "structure_check.h"

namespace gn {

// Calls a function with the network of a structure.
template <class F>
auto with_network(const Structure& structure, const Weights& given, F function) {
  if (given.type == kFloat64)
    return function(Network<double>(structure, given.weights, static_cast<const double*>(given.tables)));
#ifdef __AVX512BF16__
  if (given.type == kBfloat16Pairs)
    return function(Network<float, true>(structure, given.weights, static_cast<const float*>(given.tables)));
#endif
  return function(Network<float>(structure, given.weights, static_cast<const float*>(given.tables)));
}

bool has_bfloat16() {
#ifdef __AVX512BF16__
  return true;
#else
  return false;
#endif
}

void check(const int64_t* words, int64_t count) { StructureCheck::run(words, count); }

bool run(const Structure& structure, const Weights& weights, const Call& call, bool adjoint) {
  return with_network(structure, weights, [&](const auto& network) { return run(structure, network, call, adjoint); });
}

int64_t stored_count(const Structure& structure, const Weights& weights, const Call& call) {
  return with_network(structure, weights,
                      [&](const auto& network) { return stored_count(network, *structure.maths(0), call); });
}

void muon(Type type, const std::vector<MuonMatrix>& matrices, const MuonOptions& options, int64_t threads) {
  (type == kFloat64 ? muon<double> : muon<float>)(matrices.data(), matrices.size(), options, threads);
}

}  // namespace gn
