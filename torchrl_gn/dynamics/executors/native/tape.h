// Runs a tape of scalar instructions (tape.py) on several samples at once, in float64.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#include "structure.h"

namespace gn {

template <int W>
struct Lanes {
  typedef double Double __attribute__((vector_size(W * sizeof(double))));
  typedef uint64_t Int __attribute__((vector_size(W * sizeof(uint64_t))));  // bits of a NaN may overflow
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

template <class V, class F>
inline V each_pair(V y, V x, F function) {
  for (unsigned i = 0; i < sizeof(V) / sizeof(double); ++i) y[i] = function(y[i], x[i]);
  return y;
}

// sin(x + quarter * pi / 2), within [-1, 1]. Accurate to an ulp or two for |x| < 1e5, less beyond.
template <int W>
inline typename Lanes<W>::Double sine(typename Lanes<W>::Double x, int64_t quarter) {
  using V = typename Lanes<W>::Double;
  using I = typename Lanes<W>::Int;
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
  out = select<V>((quadrant & 2) != 0, -out, out);
  out = select<V>(out > 1, V{} + 1.0, out);
  return select<V>(out < -1, V{} - 1.0, out);
}

// Entry x of a table, which starts with its size; the nearest entry beyond its ends, the first for NaN.
inline double look_up(const double* table, double x) {
  const double last = *table - 1, place = x < last ? x : last;
  return table[1 + (place > 0 ? static_cast<int64_t>(place) : 0)];
}

// Registers are C vectors of W lanes each.
template <int W, int C>
void run_tape(const Tape& tape, int phase, double* registers) {
  using V = typename Lanes<W>::Double;
  V* const r = reinterpret_cast<V*>(registers);
  const double* const constants = tape.constants;
  const Instruction* at = tape.instructions + (phase ? tape.words.ends[phase - 1] : 0);
  const Instruction* const end = tape.instructions + tape.words.ends[phase];
  // In the order of OPERATIONS in expressions.py. Every instruction ends with a jump of its own, so that the processor
  // learns which instruction follows which.
  static const void* const labels[] = {
      &&CONSTANT, &&INPUT, &&ADD_C, &&SUB_C, &&MUL_C, &&DIV_C, &&SQRT, &&SIN, &&COS, &&ABS, &&MAX_C, &&MIN_C, &&LESS_C,
      &&GREATER_C, &&EQUAL_C, &&FLOOR, &&LOOK_UP, &&ADD, &&SUB, &&MUL, &&DIV, &&ATAN2, &&MAX, &&MIN, &&LESS, &&MADD_C, &&WHERE, &&MADD, &&NMADD,
  };
#define NEXT                   \
  if (at == end) return;       \
  goto* labels[at->code]
#define INSTRUCTION(name, expression)                 \
  name : {                                            \
    V* const out = r + C * at->out;                   \
    const V* const a = r + C * at->a;                 \
    const V* const b = r + C * at->b;                 \
    const V* const c = r + C * at->c;                 \
    const double* const table = constants + at->k;    \
    const V k = V{} + *table;                         \
    (void)a, (void)b, (void)c, (void)k;               \
    ++at;                                             \
    for (int i = 0; i < C; ++i) out[i] = expression;  \
    NEXT;                                             \
  }
  static_assert(sizeof labels / sizeof *labels == kOperations, "one label an operation");
  const V one = V{} + 1.0, zero = V{};
  NEXT;
  INSTRUCTION(CONSTANT, k)
  INSTRUCTION(INPUT, out[i])
  INSTRUCTION(ADD_C, a[i] + k)
  INSTRUCTION(SUB_C, k - a[i])
  INSTRUCTION(MUL_C, a[i] * k)
  INSTRUCTION(DIV_C, k / a[i])
  INSTRUCTION(SQRT, each_lane(a[i], [](double x) { return __builtin_sqrt(x); }))
  INSTRUCTION(SIN, sine<W>(a[i], 0))
  INSTRUCTION(COS, sine<W>(a[i], 1))
  INSTRUCTION(ABS, select<V>(a[i] < 0, -a[i], a[i]))
  INSTRUCTION(MAX_C, select<V>(a[i] < k, k, a[i]))
  INSTRUCTION(MIN_C, select<V>(a[i] > k, k, a[i]))
  INSTRUCTION(LESS_C, select<V>(a[i] < k, one, zero))
  INSTRUCTION(GREATER_C, select<V>(a[i] > k, one, zero))
  INSTRUCTION(EQUAL_C, select<V>(a[i] == k, one, zero))
  INSTRUCTION(FLOOR, each_lane(a[i], [](double x) { return __builtin_floor(x); }))
  INSTRUCTION(LOOK_UP, each_lane(a[i], [table](double x) { return look_up(table, x); }))
  INSTRUCTION(ADD, a[i] + b[i])
  INSTRUCTION(SUB, a[i] - b[i])
  INSTRUCTION(MUL, a[i] * b[i])
  INSTRUCTION(DIV, a[i] / b[i])
  INSTRUCTION(ATAN2, (each_pair(a[i], b[i], [](double y, double x) { return std::atan2(y, x); })))
  INSTRUCTION(MAX, select<V>((a[i] < b[i]) | (b[i] != b[i]), b[i], a[i]))  // NaN if either is
  INSTRUCTION(MIN, select<V>((b[i] < a[i]) | (b[i] != b[i]), b[i], a[i]))
  INSTRUCTION(LESS, select<V>(a[i] < b[i], one, zero))
  INSTRUCTION(MADD_C, a[i] * k + b[i])
  INSTRUCTION(WHERE, select<V>(a[i] != 0, b[i], c[i]))
  INSTRUCTION(MADD, a[i] * b[i] + c[i])
  INSTRUCTION(NMADD, c[i] - a[i] * b[i])
#undef INSTRUCTION
#undef NEXT
}

}  // namespace gn
