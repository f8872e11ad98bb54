// Run a tape of scalar instructions (tape.py) on LANES samples at once, in float64.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

namespace gn {

struct Instruction {
  uint16_t code, out, a, b, c, padding;
  uint32_t k;
};

// In the order of OPERATIONS in expressions.py.
enum Operation : uint16_t {
  CONSTANT, INPUT,
  ADD_C, SUB_C, MUL_C, DIV_C, SQRT, SIN, COS, ABS, MAX_C, MIN_C, LESS_C, GREATER_C, EQUAL_C,
  ADD, SUB, MUL, DIV, ATAN2, MAX, MIN, LESS, MADD_C,
  WHERE, MADD, NMADD,
};

template <int W>
struct Lanes {
  typedef double Double __attribute__((vector_size(W * sizeof(double))));
  typedef int64_t Int __attribute__((vector_size(W * sizeof(int64_t))));
};

template <class V>
inline V select(decltype(V{} < V{}) condition, V a, V b) {
  return condition ? a : b;
}

template <class V, class F>
inline V each_lane(V x, F function) {
  for (unsigned i = 0; i < sizeof(V) / sizeof(double); ++i) x[i] = function(x[i]);
  return x;
}

// sin(x + quarter * pi / 2), to an ulp or two for |x| < 1e5; beyond, by libm.
template <int W>
inline typename Lanes<W>::Double sine(typename Lanes<W>::Double x, int64_t quarter) {
  using V = typename Lanes<W>::Double;
  using I = typename Lanes<W>::Int;
  for (int i = 0; i < W; ++i)
    if (!(x[i] < 1e5 && x[i] > -1e5))
      return each_lane(x, [quarter](double one) { return quarter ? std::cos(one) : std::sin(one); });
  // Adding and subtracting 1.5 * 2^52 rounds to the nearest integer, which then lies in the low bits.
  const V magic = V{} + 6755399441055744.0;
  V shifted = x * 0.63661977236758134308 + magic;
  I quadrant;
  std::memcpy(&quadrant, &shifted, sizeof quadrant);
  quadrant += quarter;
  V n = shifted - magic;
  V r = x - n * 1.57079632673412561417;  // pi / 2 in three parts
  r = r - n * 6.07710050630396597660e-11;
  r = r - n * 2.02226624879595063154e-21;
  V z = r * r;
  V s = 1.58962301576546568060e-10 * z - 2.50507477628578072866e-08;
  s = s * z + 2.75573136213857245213e-06;
  s = s * z - 1.98412698295895385996e-04;
  s = s * z + 8.33333333332211858878e-03;
  s = s * z - 1.66666666666666307295e-01;
  s = r + r * z * s;
  V c = -1.13585365213876817300e-11 * z + 2.08757008419747316778e-09;
  c = c * z - 2.75573141792967388112e-07;
  c = c * z + 2.48015872888517045348e-05;
  c = c * z - 1.38888888888730564116e-03;
  c = c * z + 4.16666666666665929218e-02;
  c = 1.0 - 0.5 * z + z * z * c;
  V out = select<V>((quadrant & 1) != 0, c, s);
  return select<V>((quadrant & 2) != 0, -out, out);
}

struct Tape {
  const Instruction* instructions;
  const double* constants;
  const int32_t* ends;  // where each phase ends
  int64_t registers;
  int64_t groups;
  const int32_t* const* inputs;  // registers of every group
  const int32_t* const* outputs;  // and of every phase's outputs
};

// r holds registers of C vectors of W lanes each.
template <int W, int C>
void run_tape(const Tape& tape, int phase, double* registers) {
  using V = typename Lanes<W>::Double;
  V* const r = reinterpret_cast<V*>(registers);
  const Instruction* at = tape.instructions + (phase ? tape.ends[phase - 1] : 0);
  const Instruction* const end = tape.instructions + tape.ends[phase];
  for (; at != end; ++at) {
    V* const out = r + C * at->out;
    const V* const a = r + C * at->a;
    const V* const b = r + C * at->b;
    const V* const c = r + C * at->c;
    const double k = tape.constants[at->k];
    const V kk = V{} + k;
#define EACH(expression)                        \
  for (int i = 0; i < C; ++i) out[i] = expression; \
  break
    switch (at->code) {
      case CONSTANT: EACH(kk);
      case INPUT: break;
      case ADD_C: EACH(a[i] + kk);
      case SUB_C: EACH(kk - a[i]);
      case MUL_C: EACH(a[i] * kk);
      case DIV_C: EACH(kk / a[i]);
      case SQRT: EACH(each_lane(a[i], [](double x) { return __builtin_sqrt(x); }));
      case SIN: EACH(sine<W>(a[i], 0));
      case COS: EACH(sine<W>(a[i], 1));
      case ABS: EACH(select<V>(a[i] < 0, -a[i], a[i]));
      case MAX_C: EACH(select<V>(a[i] < kk, kk, a[i]));
      case MIN_C: EACH(select<V>(a[i] > kk, kk, a[i]));
      case LESS_C: EACH(select<V>(a[i] < kk, V{} + 1.0, V{}));
      case GREATER_C: EACH(select<V>(a[i] > kk, V{} + 1.0, V{}));
      case EQUAL_C: EACH(select<V>(a[i] == kk, V{} + 1.0, V{}));
      case ADD: EACH(a[i] + b[i]);
      case SUB: EACH(a[i] - b[i]);
      case MUL: EACH(a[i] * b[i]);
      case DIV: EACH(a[i] / b[i]);
      case ATAN2:
        for (int i = 0; i < C; ++i) {
          V y = a[i], x = b[i];
          for (int lane = 0; lane < W; ++lane) y[lane] = std::atan2(y[lane], x[lane]);
          out[i] = y;
        }
        break;
      case MAX: EACH(select<V>(a[i] < b[i], b[i], a[i]));
      case MIN: EACH(select<V>(b[i] < a[i], b[i], a[i]));
      case LESS: EACH(select<V>(a[i] < b[i], V{} + 1.0, V{}));
      case MADD_C: EACH(a[i] * kk + b[i]);
      case WHERE: EACH(select<V>(a[i] != 0, b[i], c[i]));
      case MADD: EACH(a[i] * b[i] + c[i]);
      case NMADD: EACH(c[i] - a[i] * b[i]);
    }
#undef EACH
  }
}

}  // namespace gn
