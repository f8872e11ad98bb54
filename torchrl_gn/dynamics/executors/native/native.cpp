// The C interface of the native executor, which library.py calls.
#include "muon.h"
#include "rollout.h"

#define GN_API __attribute__((visibility("default")))

extern "C" {

// All functions may be called from several threads at once.

// Whether kind 2 is there.
GN_API int64_t gn_has_bfloat16() {
#ifdef __AVX512BF16__
  return 1;
#else
  return 0;
#endif
}

GN_API void* gn_network_new(int64_t kind, const int64_t* code, const void* const* weights, const void* const* tables) {
#ifdef __AVX512BF16__
  if (kind == 2) return gn::make<gn::Network<float, true>>(code, weights, tables);
#endif
  return kind == 1 ? gn::make<gn::Network<double>>(code, weights, tables)
                   : gn::make<gn::Network<float>>(code, weights, tables);
}

GN_API void gn_network_delete(void* network, int64_t kind) {
  gn::with_network(network, kind, [](const auto& known) { delete &known; });
}

// Numbers of the network's dtype that a training call keeps for its adjoint.
GN_API int64_t gn_stored(const void* network, int64_t kind, const gn::Call* call) {
  return gn::with_network(network, kind, [&](const auto& known) {
    return gn::tile_store(known, *call) * ((call->batch + call->tile - 1) / call->tile);
  });
}

// 1 if a start state's constant channels are not those that the tapes were made for: nothing was computed.
GN_API int64_t gn_rollout(const void* network, int64_t kind, const gn::Maths* maths, const gn::Call* call) {
  if (!gn::fits(*maths, *call)) return 1;
  gn::with_network(network, kind, [&](const auto& known) { gn::run(*maths, known, *call, false); });
  return 0;
}

GN_API void gn_rollout_adjoint(const void* network, int64_t kind, const gn::Maths* maths, const gn::Call* call) {
  gn::with_network(network, kind, [&](const auto& known) { gn::run(*maths, known, *call, true); });
}

// Updates matrices of float32 (kind 0) or float64 (1), each by one thread.
GN_API void gn_muon(int64_t kind, const gn::MuonMatrix* matrices, int64_t count, const gn::MuonOptions* options,
                    int64_t threads) {
  (kind == 1 ? gn::muon<double> : gn::muon<float>)(matrices, count, *options, threads);
}
}
