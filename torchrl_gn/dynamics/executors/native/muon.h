// Muon's update of weight matrices, as torchrl_gn/training/muon.py computes it by torch operations.
//
// The iteration's matrices are polynomials of the first Gram matrix, so half of each symmetric product is computed.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <memory>
#include <new>
#include <utility>

#include "engine.h"
#include "kernels.h"
#include "threads.h"

namespace gn __attribute__((visibility("hidden"))) {

template <class T>
class Muon {
  using V = Vector<T>;
  static constexpr int L = kLanes<T>;

 public:
  void update(const MuonMatrix& matrix, const MuonOptions& options) {
    const int64_t rows = matrix.rows, columns = matrix.columns;
    const bool tall = rows > columns;
    const int64_t m = tall ? columns : rows, n = tall ? rows : columns;
    const int64_t wide = step_of(n), narrow = step_of(m);
    reserve(m * wide + n * narrow + 5 * m * narrow);
    T *matrix_ = buffer_.get(), *transposed = matrix_ + m * wide, *gram = transposed + n * narrow;
    T *higher = gram + m * narrow, *half = higher + m * narrow, *factor = half + m * narrow;
    T* next = factor + m * narrow;

    T *stored = tall ? transposed : matrix_, *other = tall ? matrix_ : transposed;
    const int64_t step = tall ? narrow : wide;
    const double norm = nesterov(matrix, T(options.momentum), stored, step);
    const T scale = T(1 / std::max(norm, 1e-7));
    for (int64_t r = 0; r < rows; r++)
      for (int64_t c = 0; c < columns; c++) stored[r * step + c] *= scale;
    transpose(stored, step, rows, columns, other, tall ? wide : narrow);

    product(transposed, narrow, transposed, narrow, n, m, m, T(0), nullptr, gram, narrow, true);
    for (int64_t i = 0; i < options.count; i++) {
      const T linear = T(options.polynomials[3 * i]), cubic = T(options.polynomials[3 * i + 1]);
      const T quintic = T(options.polynomials[3 * i + 2]);
      product(gram, narrow, gram, narrow, m, m, m, cubic, gram, higher, narrow, true, quintic);
      if (i + 1 < options.count) {
        product(higher, narrow, gram, narrow, m, m, m, linear, gram, half, narrow, true);
        product(half, narrow, higher, narrow, m, m, m, linear, half, gram, narrow, true);
      }
      if (i == 0) {
        std::copy_n(higher, m * narrow, factor);
        for (int64_t r = 0; r < m; r++) factor[r * narrow + r] += linear;
      } else {
        product(factor, narrow, higher, narrow, m, m, m, linear, factor, next, narrow, true);
        std::swap(factor, next);
      }
    }
    // Write the update over the transposed matrix, which is no longer read, or to a buffer of its own.
    const T rate = T(options.rate * std::sqrt(std::max(1.0, double(rows) / columns)));
    T* parameter = static_cast<T*>(matrix.parameter);
    if (tall) {
      // [n, m] = matrix @ factor
      product(matrix_, wide, factor, narrow, m, n, m, T(0), nullptr, transposed, narrow, false);
    } else {
      T* out = result(m * wide);
      product(factor, narrow, matrix_, wide, m, m, n, T(0), nullptr, out, wide, false);
      stored = out;
    }
    for (int64_t r = 0; r < rows; r++)
      for (int64_t c = 0; c < columns; c++) parameter[r * columns + c] -= rate * stored[r * step + c];
  }

 private:
  struct Free {
    void operator()(T* block) const { std::free(block); }
  };
  using Block = std::unique_ptr<T[], Free>;

  // Row stride in numbers: whole vectors, not a power of two.
  static int64_t step_of(int64_t columns) { return (columns + L - 1) / L * L + L; }

  static T* grown(Block& block, size_t& size, size_t wanted) {
    if (wanted > size) {
      size = 0;
      block.reset(static_cast<T*>(std::aligned_alloc(64, (wanted * sizeof(T) + 63) / 64 * 64)));
      if (!block) throw std::bad_alloc();
      size = wanted;
    }
    std::fill_n(block.get(), wanted, T(0));  // including the padding of rows
    return block.get();
  }
  void reserve(size_t wanted) { grown(buffer_, size_, wanted); }
  T* result(size_t wanted) { return grown(result_, result_size_, wanted); }

  // Updates the momentum, writes the Nesterov momentum to `out` and returns its norm.
  static double nesterov(const MuonMatrix& matrix, T momentum, T* out, int64_t step) {
    const T* gradient = static_cast<const T*>(matrix.gradient);
    T* moment = static_cast<T*>(matrix.moment);
    double squares = 0;
    for (int64_t r = 0; r < matrix.rows; r++) {
      for (int64_t c = 0; c < matrix.columns; c++) {
        const T g = gradient[r * matrix.columns + c];
        T& m = moment[r * matrix.columns + c];
        m += (T(1) - momentum) * (g - m);
        out[r * step + c] = g + momentum * (m - g);
      }
      for (int64_t c = 0; c < matrix.columns; c++) squares += double(out[r * step + c]) * double(out[r * step + c]);
    }
    return std::sqrt(squares);
  }

  static void transpose(const T* from, int64_t step, int64_t rows, int64_t columns, T* to, int64_t to_step) {
    constexpr int64_t kBlock = 16;
    for (int64_t r = 0; r < rows; r += kBlock)
      for (int64_t c = 0; c < columns; c += kBlock)
        for (int64_t j = c; j < std::min(c + kBlock, columns); j++)
          for (int64_t i = r; i < std::min(r + kBlock, rows); i++) to[j * to_step + i] = from[i * step + j];
  }

  // out = alpha * x^T w + beta * add for R rows and N vectors of columns.
  template <int R, int N>
  static void tile(const T* x, int64_t x_step, const T* w, int64_t w_step, int64_t depth, T alpha, T beta, const T* add,
                   T* out, int64_t step) {
    typename V::type sum[R][N] = {};
    for (int64_t k = 0; k < depth; k++, x += x_step, w += w_step) {
      typename V::type right[N];
#pragma GCC unroll 2
      for (int v = 0; v < N; v++) right[v] = V::load(w + v * L);
#pragma GCC unroll 12
      for (int r = 0; r < R; r++)
#pragma GCC unroll 2
        for (int v = 0; v < N; v++) sum[r][v] += x[r] * right[v];
    }
#pragma GCC unroll 12
    for (int r = 0; r < R; r++)
#pragma GCC unroll 2
      for (int v = 0; v < N; v++) {
        typename V::type value = alpha * sum[r][v];
        if (add) value += beta * V::load(add + r * step + v * L);
        V::store(out + r * step + v * L, value);
      }
  }

  template <int N, int... R>
  static auto tile_of(int rows, std::integer_sequence<int, R...>) {
    static constexpr decltype(&tile<1, N>) tiles[] = {tile<R + 1, N>...};
    return tiles[rows - 1];
  }

  // out [rows, columns] = alpha * x^T w + beta * add, of x [depth, rows] and w [depth, columns].
  static void product(const T* x, int64_t x_step, const T* w, int64_t w_step, int64_t depth, int64_t rows,
                      int64_t columns, T beta, const T* add, T* out, int64_t step, bool symmetric, T alpha = T(1)) {
    constexpr auto sizes = std::make_integer_sequence<int, kRows>{};
    const int64_t blocks = (rows + kRows - 1) / kRows, block = (rows + blocks - 1) / blocks;
    for (int64_t c = 0; c < columns; c += 2 * L) {
      const bool two = columns - c > L;
      for (int64_t r = symmetric ? c / block * block : 0; r < rows; r += block) {
        const int now = static_cast<int>(std::min(block, rows - r));
        const auto function = two ? tile_of<2>(now, sizes) : tile_of<1>(now, sizes);
        function(x + r, x_step, w + c, w_step, depth, alpha, beta, add ? add + r * step + c : nullptr,
                 out + r * step + c, step);
      }
    }
    if (!symmetric) return;
    constexpr int64_t kBlock = 16;
    for (int64_t r = 0; r < rows; r += kBlock)
      for (int64_t c = r; c < columns; c += kBlock)
        for (int64_t i = r; i < std::min(r + kBlock, rows); i++)
          for (int64_t j = std::max(c, i + 1); j < std::min(c + kBlock, columns); j++)
            out[i * step + j] = out[j * step + i];
  }

  Block buffer_, result_;
  size_t size_ = 0, result_size_ = 0;
};

template <class T>
void muon(const MuonMatrix* matrices, int64_t count, const MuonOptions& options, int64_t threads) {
  auto reserve = [](Muon<T>&) {};  // update() reserves: matrices differ in size
  on_threads<Muon<T>>(threads, count, reserve, [&](Muon<T>& worker, std::atomic<int64_t>& next) {
    for (int64_t i; (i = next++) < count;) worker.update(matrices[i], options);
  });
}

}  // namespace gn
