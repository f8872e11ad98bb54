// Vector kernels of the native network engine: small matrix products and activations.
//
// Every output is a sum of fused multiply-adds over k in order, whatever the tile, the batch or the vector length:
// results are equal bit for bit.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <utility>
#ifdef __AVX512BF16__
#include <immintrin.h>
#endif

#include "structure.h"

namespace gn __attribute__((visibility("hidden"))) {  // libraries built for other processors may be loaded beside

#if defined(__AVX512F__)
constexpr int kVectorBytes = 64, kAccumulators = 24, kRows = 12;
#elif defined(__AVX__)
constexpr int kVectorBytes = 32, kAccumulators = 12, kRows = 6;
#elif defined(__aarch64__)
constexpr int kVectorBytes = 16, kAccumulators = 24, kRows = 12;
#else
constexpr int kVectorBytes = 16, kAccumulators = 12, kRows = 6;
#endif
constexpr int kChunk = 24;   // rows that share a panel of weights in the nearest cache
constexpr int kDepth = 512;  // columns of a product's left factor that are gathered at once
constexpr int kStride = kDepth + 16;  // between its rows: not a power of two, which would collide in the cache

template <class T>
constexpr int kLanes = kVectorBytes / static_cast<int>(sizeof(T));

template <class T>
struct Vector {
  typedef T type __attribute__((vector_size(kVectorBytes)));
  typedef T loose __attribute__((vector_size(kVectorBytes), aligned(sizeof(T)), may_alias));  // at any address
  typedef std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t> integer;  // bits of a NaN may overflow
  typedef integer integers __attribute__((vector_size(kVectorBytes)));

  static type load(const T* from) { return *reinterpret_cast<const loose*>(from); }
  static void store(T* to, type value) { *reinterpret_cast<loose*>(to) = value; }
};

// Copies rows, to = from, rounded up to whole vectors.
template <class T>
void copy_rows(T* to, int64_t to_step, const T* from, int64_t step, int rows, int64_t count) {
  for (int r = 0; r < rows; r++, to += to_step, from += step)
    for (int64_t c = 0; c < count; c += kLanes<T>) Vector<T>::store(to + c, Vector<T>::load(from + c));
}

// Adds rows, to = base + from, rounded up to whole vectors.
template <class T>
void add_rows(T* to, int64_t to_step, const T* base, int64_t base_step, const T* from, int64_t step, int rows,
              int64_t count) {
  for (int r = 0; r < rows; r++, to += to_step, base += base_step, from += step)
    for (int64_t c = 0; c < count; c += kLanes<T>)
      Vector<T>::store(to + c, Vector<T>::load(base + c) + Vector<T>::load(from + c));
}

// Copies or adds rows, to = from or to += from; writes nothing beyond them.
template <class T, bool kAdd>
void accumulate_rows(T* to, int64_t to_step, const T* from, int64_t step, int rows, int64_t count) {
  typedef T Short __attribute__((vector_size(16), aligned(sizeof(T)), may_alias));
  constexpr int L = kLanes<T>, M = 16 / sizeof(T);
  for (int r = 0; r < rows; r++, to += to_step, from += step) {
    int64_t c = 0;
    for (; c + L <= count; c += L) {
      auto value = Vector<T>::load(from + c);
      Vector<T>::store(to + c, kAdd ? Vector<T>::load(to + c) + value : value);
    }
    for (; c + M <= count; c += M) {
      Short& out = *reinterpret_cast<Short*>(to + c);
      const Short& value = *reinterpret_cast<const Short*>(from + c);
      out = kAdd ? out + value : value;
    }
#pragma GCC unroll 1
    for (; c < count; c++) to[c] = kAdd ? to[c] + from[c] : from[c];
  }
}

// out[r][column] = init[r][column] + sum_k x[r][k] w[k][column] for R rows and N vectors of columns from `column` on.
// kPlain: x is [r][kStride] and w packed [panel][depth][kPanel]. kPairs: the same with pairs of bfloat16, summed in
// float32. kOverRows: sums over rows, for gradients of weights; x and w are [k][kStride].
enum Kind { kPlain, kPairs, kOverRows };

template <class T>
using Kernel = void (*)(const T* x, const T* w, int64_t depth, int64_t panel, const T* const* init, int64_t column,
                        T* out, int64_t stride);

template <class T, Kind kKind, int R, int N>
void multiply(const T* __restrict x, const T* __restrict w, int64_t depth, int64_t panel, const T* const* init,
              int64_t column, T* out, int64_t stride) {
  using V = Vector<T>;
  constexpr int L = kLanes<T>, row = kKind == kOverRows ? 1 : kStride, inside = kPanel / L;  // vectors of a panel
  constexpr int next_w = kKind == kOverRows ? kStride : kPanel, next_x = kKind == kOverRows ? kStride : 1;
  typename V::type sum[R][N];
#pragma GCC unroll 12
  for (int r = 0; r < R; r++)
#pragma GCC unroll 8
    for (int v = 0; v < N; v++) sum[r][v] = V::load(init[r] + column + v * L);
  for (int64_t k = 0; k < depth; k++, w += next_w, x += next_x) {
    typename V::type weights[N];
#pragma GCC unroll 8
    for (int v = 0; v < N; v++)
      weights[v] = V::load(w + (kKind == kOverRows ? v * L : v / inside * panel + v % inside * L));
#pragma GCC unroll 12
    for (int r = 0; r < R; r++) {
#pragma GCC unroll 8
      for (int v = 0; v < N; v++) {
#ifdef __AVX512BF16__
        if constexpr (kKind == kPairs)
          sum[r][v] = _mm512_dpbf16_ps(sum[r][v], (__m512bh)_mm512_set1_ps(x[r * row]), (__m512bh)weights[v]);
        else
#endif
          sum[r][v] += x[r * row] * weights[v];
      }
    }
  }
#pragma GCC unroll 12
  for (int r = 0; r < R; r++)
#pragma GCC unroll 8
    for (int v = 0; v < N; v++) V::store(out + r * stride + column + v * L, sum[r][v]);
}

template <class T, Kind kKind, int N, int... R>
Kernel<T> kernel_of_rows(int rows, std::integer_sequence<int, R...>) {
  static constexpr Kernel<T> kernels[] = {multiply<T, kKind, R + 1, N>...};
  return kernels[rows - 1];
}

template <class T, Kind kKind>
Kernel<T> kernel(int rows, int vectors) {
  if constexpr (kKind != kOverRows) {  // for few rows, more vectors at once give more independent sums
    if (vectors == 8) return kernel_of_rows<T, kKind, 8>(rows, std::make_integer_sequence<int, kAccumulators / 8>{});
    if (vectors == 4) return kernel_of_rows<T, kKind, 4>(rows, std::make_integer_sequence<int, kAccumulators / 4>{});
  }
  if (vectors == 2) return kernel_of_rows<T, kKind, 2>(rows, std::make_integer_sequence<int, kAccumulators / 2>{});
  return kernel_of_rows<T, kKind, 1>(rows, std::make_integer_sequence<int, kRows>{});
}

// out[rows][vectors * L] = init + x @ w, with panels of w `panel` numbers apart.
template <class T, Kind kKind>
void product(const T* x, const T* w, int rows, int64_t vectors, int64_t depth, int64_t panel, const T* const* init,
             T* out, int64_t stride) {
  constexpr int L = kLanes<T>, inside = kPanel / L;
  int blocks = (rows + kRows - 1) / kRows, block = (rows + blocks - 1) / blocks;
  int most = 2;
  while (kKind != kOverRows && most < 8 && block <= kAccumulators / (2 * most)) most *= 2;
  for (int64_t p = 0; p < vectors;) {  // powers of two, so that no kernel starts inside a panel and ends outside
    int taken = most;
    while (taken > vectors - p) taken /= 2;
    const T* right = w + (kKind == kOverRows ? p * L : p / inside * panel + p % inside * L);
    for (int r = 0; r < rows; r += block) {
      const T* left = x + r * (kKind == kOverRows ? 1 : kStride);
      kernel<T, kKind>(rows - r < block ? rows - r : block, taken)(left, right, depth, panel, init + r, p * L,
                                                                   out + r * stride, stride);
    }
    p += taken;
  }
}

// Rounds rows of x to bfloat16 in place, a pair of numbers in the place of one; an odd last number is paired with 0.
template <class T>
void pair_up(T* x, int rows, int64_t count) {
#ifdef __AVX512BF16__
  for (int r = 0; r < rows; r++, x += kStride) {
    if (count % 2) x[count] = 0;
    for (int64_t c = 0; c < count; c += 32) {
      auto pairs = _mm512_cvtne2ps_pbh(_mm512_loadu_ps(x + c + 16), _mm512_loadu_ps(x + c));
      _mm512_storeu_ps(x + c / 2, (__m512)pairs);
    }
  }
#endif
}

enum Activation : int64_t { kNone, kRelu, kSilu, kGelu, kTanh };

// 2^f for |f| <= 1/2 by a polynomial, for the logistic function of clamped inputs.
inline typename Vector<float>::type exp2_fraction(typename Vector<float>::type f) {
  // Minimax of degree 5, relative error 1e-7.
  auto p = f * 1.32644535e-3f + 9.67172552e-3f;
  p = p * f + 5.55073633e-2f;
  p = p * f + 2.40222388e-1f;
  p = p * f + 6.93146975e-1f;
  return p * f + 1.0f;
}

inline typename Vector<double>::type exp2_fraction(typename Vector<double>::type f) {
  // Taylor: ln(2)^k / k!, remainder below 1e-17 for |f| <= 1/2.
  auto p = f * 1.3691488853904128881e-12 + 2.5678435993488205142e-11;
  p = p * f + 4.4455382718708114976e-10;
  p = p * f + 7.0549116208011233299e-9;
  p = p * f + 1.0178086009239699727e-7;
  p = p * f + 1.3215486790144309489e-6;
  p = p * f + 1.5252733804059840280e-5;
  p = p * f + 1.5403530393381609954e-4;
  p = p * f + 1.3333558146428443423e-3;
  p = p * f + 9.6181291076284771620e-3;
  p = p * f + 5.5504108664821579953e-2;
  p = p * f + 2.4022650695910071233e-1;
  p = p * f + 6.9314718055994530942e-1;
  return p * f + 1.0;
}

template <class T>
void silu(typename Vector<T>::type& x, typename Vector<T>::type& slope) {
  using V = typename Vector<T>::type;
  using I = typename Vector<T>::integers;
  constexpr bool single = sizeof(T) == 4;
  constexpr T bound = single ? T(87) : T(708), magic = single ? T(12582912.0) : T(6755399441055744.0);
  constexpr T high = T(-1.4426950408889634074);  // -log2(e) in two parts
  constexpr T low = T(-1.4426950408889634074L - static_cast<long double>(high));
  // A NaN fails both comparisons and stays.
  V limit = V{} - bound, top = V{} + bound;
  x = limit > x ? limit : x;
  V c = top < x ? top : x;
  V shifted = c * high + magic, whole = shifted - magic;
  V fraction = c * low + (c * high - whole);
  I bits = reinterpret_cast<I>(exp2_fraction(fraction)) + (reinterpret_cast<I>(shifted) << (single ? 23 : 52));
  V e = reinterpret_cast<V>(bits), s = T(1) / (T(1) + e);
  x = x * s;
  slope = x * (e * s) + s;  // e * s is 1 - s, without cancellation
}

// Replaces `count` pre-activations by their activations; writes the slopes unless `slopes` is null.
template <class T>
void activate(Activation activation, T* values, T* slopes, int64_t count) {
  using V = Vector<T>;
  constexpr int L = kLanes<T>;
  if (activation == kSilu) {
    int64_t i = 0;
    typename V::type x, slope;
    for (; i + L <= count; i += L) {
      x = V::load(values + i);
      silu<T>(x, slope);
      V::store(values + i, x);
      if (slopes) V::store(slopes + i, slope);
    }
    if (i < count) {
      T rest[L] = {}, rest_slopes[L];
      std::memcpy(rest, values + i, (count - i) * sizeof(T));
      x = V::load(rest);
      silu<T>(x, slope);
      V::store(rest, x);
      V::store(rest_slopes, slope);
      std::memcpy(values + i, rest, (count - i) * sizeof(T));
      if (slopes) std::memcpy(slopes + i, rest_slopes, (count - i) * sizeof(T));
    }
    return;
  }
  auto each = [&](auto function) {
    for (int64_t i = 0; i < count; i++) {
      T slope = 0;
      values[i] = function(values[i], slope);
      if (slopes) slopes[i] = slope;
    }
  };
  if (activation == kRelu)
    each([](T x, T& slope) {
      slope = x <= T(0) ? T(0) : T(1);
      return x < T(0) ? T(0) : x;  // NaN stays
    });
  else if (activation == kGelu)
    each([](T x, T& slope) {
      T half = T(0.5) * (T(1) + std::erf(x * T(0.70710678118654752440)));
      slope = half + x * (T(0.39894228040143267794) * std::exp(T(-0.5) * x * x));
      return x * half;
    });
  else if (activation == kTanh)
    each([](T x, T& slope) {
      T y = std::tanh(x);
      slope = T(1) - y * y;
      return y;
    });
}

}  // namespace gn
