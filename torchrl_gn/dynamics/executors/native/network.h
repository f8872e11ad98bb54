// Native engine of a folded network: a list of linear layers over items, described as data.
//
// Buffers are [item][S][width] for a tile of S samples. A layer computes its I * S rows in chunks: it gathers and
// concatenates their inputs, multiplies and activates.
#pragma once

#include <algorithm>
#include <type_traits>
#include <vector>

#include "kernels.h"
#include "structure.h"

namespace gn __attribute__((visibility("hidden"))) {

// A view of a structure with its packed weights and tables. T: float or double. kBfloat16: round factors of products
// and sum in float32; needs T = float and __AVX512BF16__. Methods change only their arguments.
template <class T, bool kBfloat16 = false>
class Network {
#ifndef __AVX512BF16__
  static_assert(!kBfloat16, "bfloat16 needs -mavx512bf16");
#endif
  static_assert(!kBfloat16 || sizeof(T) == 4, "bfloat16 is summed in float");

 public:
  using Number = T;

  Network(const Structure& structure, const void* weights, const T* tables)
      : structure_(structure),
        words_(structure.network()),
        buffers_(structure.at<BufferWords>(words_.buffers)),
        layers_(structure.at<LayerWords>(words_.layers)),
        weights_(static_cast<const T*>(weights)),
        tables_(tables),
        zeros_(words_.deepest + kPanel, T(0)) {}

  // Size of ws for a tile of S samples, in numbers of T. Align ws to 64 bytes.
  size_t workspace(int S, bool gradient) const {
    return scratch() + (gradient ? 2 : 1) * S * words_.total + kLanes<T>;
  }
  // Activations of a tile of S samples, which weight_gradients() reads. They may be copied to another ws.
  T* activations(T* ws) const { return ws + scratch(); }
  int64_t activation_count(int64_t S) const { return S * words_.total; }
  // Numbers per sample that forward() stores for backward(): slopes of the activations.
  size_t stored() const { return words_.stored; }

  T* nodes(T* ws, int S) const { return values(ws, S, 0); }
  T* edges(T* ws, int S) const { return values(ws, S, 1); }
  const T* output(T* ws, int S) const { return values(ws, S, words_.layer_count + 1); }
  T* grad_nodes(T* ws, int S) const { return gradients(ws, S, 0); }
  T* grad_edges(T* ws, int S) const { return gradients(ws, S, 1); }
  T* grad_output(T* ws, int S) const { return gradients(ws, S, words_.layer_count + 1); }

  // Per-sample tables, beside the shared ones: [I, batch, width padded to kPanel] of every layer that has one.
  struct SampleTables {
    const void* tables;
    int64_t batch;
    const int64_t* samples;  // of the call; null: all
    int64_t first;           // first sample of the tile, among these
  };

  // Reads nodes and edges; writes output and, unless `stored` is null, S * stored() numbers.
  void forward(T* ws, int S, T* stored, const SampleTables& samples) const {
    for (int64_t i = 0; i < words_.layer_count; i++) {
      const LayerWords& layer = layers_[i];
      T* out = values(ws, S, i + 2);
      chunks(layer.items * S, [&](int64_t start, int rows) {
        run(layer, ws, S, start, rows, samples, out + start * layer.width);
        if (layer.activation == kNone) return;
        T* slopes = stored ? stored + layer.slopes * S + start * layer.width : nullptr;
        activate(static_cast<Activation>(layer.activation), out + start * layer.width, slopes, rows * layer.width);
      });
    }
  }

  // Reads grad_output and the numbers that forward() stored; with `of_inputs` writes grad_nodes and grad_edges.
  void backward(T* ws, int S, const T* stored, bool of_inputs) const {
    for (int64_t b = 0; b < words_.unread_count; b++) clear(ws, S, structure_.list(words_.unread)[b]);
    for (int64_t i = words_.layer_count; i-- > 0;) {
      const LayerWords& layer = layers_[i];
      for (const Gathers& gathers : {inputs(layer), added(layer)})
        for (const GatherWords& gather : gathers)
          if (gather.clears) clear(ws, S, gather.source);
      pre_activations(i, ws, S, stored, [&](int64_t start, int rows, const T* grad, const T* slopes) {
        vjp(layer, ws, S, start, rows, grad, slopes, of_inputs || !reads_inputs_alone(layer));
      });
    }
  }

  // Adds gradients, summed over samples, to those of all weights, row by row, and of shared tables, in their layout.
  // Call this after forward() and backward() of the same samples in the same workspace.
  void weight_gradients(T* ws, int S, const T* stored, T* grad_weights, T* grad_tables) const {
    for (int64_t i = 0; i < words_.layer_count; i++)
      pre_activations(i, ws, S, stored, [&](int64_t start, int rows, const T* grad, const T* slopes) {
        const LayerWords& layer = layers_[i];
        add_gradients(layer, ws, S, start, rows, grad, slopes, grad_weights + layer.plain,
                      layer.has_table ? grad_tables + layer.table : nullptr);
      });
  }

  // Adds gradients of all weights, given row by row, to `packed` in the layout of the packed weights.
  void add_packed(const T* plain, T* packed) const {
    for (int64_t i = 0; i < words_.layer_count; i++) {
      const LayerWords& layer = layers_[i];
      const T* from = plain + layer.plain;
      T* to = packed + layer.forward;
      for (int64_t c = 0; c < layer.width; c++)
        for (int64_t k = 0; k < layer.depth; k++)
          to[(c / kPanel * layer.depth + k) * kPanel + c % kPanel] += from[c * layer.depth + k];
    }
  }

 private:
  struct Gathers {
    const GatherWords* first;
    int64_t count;
    const GatherWords* begin() const { return first; }
    const GatherWords* end() const { return first + count; }
  };
  Gathers inputs(const LayerWords& layer) const {
    return {structure_.at<GatherWords>(layer.inputs), layer.input_count};
  }
  Gathers added(const LayerWords& layer) const { return {structure_.at<GatherWords>(layer.added), layer.added_count}; }
  const int64_t* offsets(const GatherWords& gather) const { return structure_.list(gather.offsets); }
  const int64_t* items(const GatherWords& gather) const { return structure_.list(gather.items); }

  static int64_t padded(int64_t width) { return (width + kLanes<T> - 1) / kLanes<T> * kLanes<T>; }

  // Columns of a table's padded row.
  static int64_t panels(int64_t width) { return (width + kPanel - 1) / kPanel * kPanel; }

  // Numbers of T that hold a row of a product's factors.
  static int64_t steps(int64_t depth) { return kBfloat16 ? (depth + 1) / 2 : depth; }

  // Workspace: two left factors of a chunk, its results, its added rows; values of all buffers; their gradients.
  int64_t scratch() const { return kChunk * (2 * kStride + 2 * words_.deepest); }
  T* factors(T* ws) const { return ws + kChunk * kStride; }
  T* results(T* ws) const { return factors(ws) + kChunk * kStride; }
  T* sums(T* ws) const { return results(ws) + kChunk * words_.deepest; }
  T* values(T* ws, int S, size_t buffer) const { return ws + scratch() + S * buffers_[buffer].start; }
  T* gradients(T* ws, int S, size_t buffer) const { return values(ws, S, buffer) + S * words_.total; }
  void clear(T* ws, int S, size_t buffer) const {
    std::fill_n(gradients(ws, S, buffer), buffers_[buffer].items * buffers_[buffer].width * S, T(0));
  }

  // Calls body(start, rows) for chunks of about the same size.
  template <class Body>
  static void chunks(int64_t total, const Body& body) {
    int64_t count = (total + kChunk - 1) / kChunk, size = count ? (total + count - 1) / count : 0;
    for (int64_t start = 0; start < total; start += size)
      body(start, static_cast<int>(std::min(size, total - start)));
  }

  // Calls body(start, rows, gradient, slopes or nullptr) for chunks of a layer's outputs.
  template <class Body>
  void pre_activations(size_t i, T* ws, int S, const T* stored, const Body& body) const {
    const LayerWords& layer = layers_[i];
    const T* grad = gradients(ws, S, i + 2);
    const T* slopes = layer.activation == kNone ? nullptr : stored + layer.slopes * S;
    chunks(layer.items * S, [&](int64_t start, int rows) {
      int64_t from = start * layer.width;
      body(start, rows, grad + from, slopes ? slopes + from : nullptr);
    });
  }

  // Calls body(item, sample, row, rows) for rows of one item; row counts from the chunk's start.
  template <class Body>
  static void runs(int S, int64_t start, int rows, const Body& body) {
    int64_t item = start / S;
    int sample = static_cast<int>(start % S);
    for (int row = 0; row < rows; item++, sample = 0) {
      int now = std::min(rows - row, S - sample);
      body(item, sample, row, now);
      row += now;
    }
  }

  const T* rows_of(const GatherWords& g, int64_t j, T* ws, int S, int64_t sample) const {
    return values(ws, S, g.source) + (items(g)[j] * S + sample) * g.width;
  }

  // Gathers columns [from, to) of rows; writes up to one vector more after each row.
  void gather(const GatherWords& g, T* ws, int S, int64_t start, int rows, int64_t from, int64_t to, T* x) const {
    if (g.in_order)
      return copy_rows(x, kStride, rows_of(g, 0, ws, S, start) + from, g.width, rows, to - from);
    runs(S, start, rows, [&](int64_t item, int sample, int row, int now) {
      T* out = x + row * kStride;
      int64_t j = offsets(g)[item], last = offsets(g)[item + 1];
      if (j == last) return copy_rows(out, kStride, zeros_.data(), 0, now, to - from);
      const T* base = rows_of(g, j, ws, S, sample) + from;
      if (++j == last) return copy_rows(out, kStride, base, g.width, now, to - from);
      for (int64_t step = g.width; j < last; j++, base = out, step = kStride)
        add_rows(out, kStride, base, step, rows_of(g, j, ws, S, sample) + from, g.width, now, to - from);
    });
  }

  // Gathers columns [begin, end) of a chunk's left factor.
  void gather(const LayerWords& layer, T* ws, int S, int64_t start, int rows, int64_t begin, int64_t end) const {
    for (const GatherWords& g : inputs(layer)) {
      int64_t from = std::max(begin, g.column), to = std::min(end, g.column + g.width);
      if (from < to) gather(g, ws, S, start, rows, from - g.column, to - g.column, ws + from - begin);
    }
  }

  // out = init + the product of columns [k, k + count) of a chunk's left factor with packed weights.
  static void multiply(const T* packed, T* x, int rows, int64_t k, int64_t count, int64_t depth, int64_t width,
                       const T* const* init, T* out) {
    if constexpr (kBfloat16) pair_up(x, rows, count);
    product<T, kBfloat16 ? kPairs : kPlain>(x, packed + steps(k) * kPanel, rows, width / kLanes<T>, steps(count),
                                            steps(depth) * kPanel, init, out, width);
  }

  // Computes the pre-activations of a chunk.
  void run(const LayerWords& layer, T* ws, int S, int64_t start, int rows, const SampleTables& samples, T* out) const {
    int64_t width = padded(layer.width), table_width = panels(layer.width);
    const T* own = layer.sampled ? static_cast<const T*>(samples.tables) + layer.table * samples.batch : nullptr;
    const T* init[kChunk];
    auto begin = [&](int64_t item, int sample, int row, int now) {
      const T* base = layer.has_table ? tables_ + layer.table + item * table_width : zeros_.data();
      T* sum = sums(ws) + row * width;
      int64_t step = 0;
      if (own) {
        const int64_t at = samples.first + sample;
        base = own + (item * samples.batch + (samples.samples ? samples.samples[at] : at)) * table_width;
        step = table_width;
      }
      for (const GatherWords& g : added(layer))
        for (int64_t j = offsets(g)[item]; j < offsets(g)[item + 1]; j++, base = sum, step = width)
          add_rows(sum, width, base, step, rows_of(g, j, ws, S, sample), g.width, now, width);
      for (int r = 0; r < now; r++, base += step) init[row + r] = base;
    };
    runs(S, start, rows, [&](int64_t item, int sample, int row, int now) {
      const int part = own && samples.samples ? 1 : now;  // tables of listed samples are not consecutive
      for (int r = 0; r < now; r += part) begin(item, sample + r, row + r, part);
    });
    bool direct = width == layer.width;
    T* to = direct ? out : results(ws);
    for (int64_t k = 0; k == 0 || k < layer.depth; k += kDepth) {
      int64_t end = std::min<int64_t>(k + kDepth, layer.depth);
      gather(layer, ws, S, start, rows, k, end);
      multiply(weights_ + (kBfloat16 ? layer.paired_forward : layer.forward), ws, rows, k, end - k, layer.depth, width, init, to);
      for (int r = 0; r < rows; r++) init[r] = to + r * width;
    }
    for (int r = 0; r < rows && !direct; r++) std::copy_n(to + r * width, layer.width, out + r * layer.width);
  }

  // Computes `count` columns of the gradients of a chunk's pre-activations.
  static void multiply_slopes(const T* grad, const T* slopes, int64_t width, int rows, int64_t count, T* x) {
    for (int r = 0; r < rows; r++, x += kStride, grad += width)
      for (int64_t c = 0; c < count; c++) x[c] = slopes ? grad[c] * slopes[r * width + c] : grad[c];
  }

  // Adds a chunk's gradients of weight and table.
  void add_gradients(const LayerWords& layer, T* ws, int S, int64_t start, int rows, const T* grad, const T* slopes,
                     T* weight, T* table) const {
    int64_t width = layer.width, depth = layer.depth;
    T* dz = factors(ws);
    for (int64_t o = 0; o < width; o += kDepth) {
      int64_t count = std::min<int64_t>(kDepth, width - o);
      multiply_slopes(grad + o, slopes ? slopes + o : nullptr, width, rows, count, dz);
      runs(S, start, rows, [&](int64_t item, int, int row, int now) {
        if (table) accumulate_rows<T, true>(table + item * panels(width) + o, 0, dz + row * kStride, kStride, now, count);
      });
      for (int64_t k = 0; k < depth; k += kDepth) {
        int64_t columns = std::min<int64_t>(kDepth, depth - k), stride = padded(columns);
        bool whole = stride == columns;
        gather(layer, ws, S, start, rows, k, k + columns);
        for (int64_t p = 0; p < count; p += kChunk) {
          int outputs = static_cast<int>(std::min<int64_t>(kChunk, count - p));
          T* to = weight + (o + p) * depth + k;
          const T* init[kChunk];
          for (int r = 0; r < outputs; r++) init[r] = whole ? to + r * depth : zeros_.data();
          product<T, kOverRows>(dz + p, ws, outputs, stride / kLanes<T>, rows, kLanes<T>, init,
                                whole ? to : results(ws), whole ? depth : stride);
          if (!whole) accumulate_rows<T, true>(to, depth, results(ws), stride, outputs, columns);
        }
      }
    }
  }

  // True if a layer multiplies only the network's nodes and edges.
  bool reads_inputs_alone(const LayerWords& layer) const {
    const Gathers all = inputs(layer);
    return std::all_of(all.begin(), all.end(), [](const GatherWords& g) { return g.source < 2; });
  }

  // Computes the gradients of a chunk's added rows and, with `of_products`, of its multiplied rows. Rows come in the
  // order of items, so that the order of sums does not depend on the chunks.
  void vjp(const LayerWords& layer, T* ws, int S, int64_t start, int rows, const T* grad, const T* slopes,
            bool of_products) const {
    int64_t width = layer.width, depth = padded(layer.depth);
    const bool direct = layer.direct && depth == layer.depth;
    T* results = direct ? gradients(ws, S, inputs(layer).first->source) + start * depth : this->results(ws);
    const T* init[kChunk];
    std::fill_n(init, rows, zeros_.data());
    for (int64_t k = 0; of_products && (k == 0 || k < width); k += kDepth) {  // zeros for a layer without outputs
      int64_t count = std::min<int64_t>(kDepth, width - k);
      multiply_slopes(grad + k, slopes ? slopes + k : nullptr, width, rows, count, ws);
      multiply(weights_ + (kBfloat16 ? layer.paired_backward : layer.backward), ws, rows, k, count, width, depth, init, results);
      for (int r = 0; r < rows; r++) init[r] = results + r * depth;
    }
    if (direct) return;
    auto scatter = [&](const GatherWords& g, int64_t j, int64_t sample, int row, int now) {
      T* to = gradients(ws, S, g.source) + (items(g)[j] * S + sample) * g.width;
      const T* from = results + row * depth + g.column;
      (g.writes ? accumulate_rows<T, false> : accumulate_rows<T, true>)(to, g.width, from, depth, now, g.width);
    };
    const Gathers multiplied{inputs(layer).first, of_products ? layer.input_count : 0};
    for (const GatherWords& g : multiplied)
      if (g.in_order && g.apart) scatter(g, 0, start, 0, rows);
    runs(S, start, rows, [&](int64_t item, int sample, int row, int now) {
      for (const GatherWords& g : multiplied)
        for (int64_t j = offsets(g)[item]; j < offsets(g)[item + 1] && !(g.in_order && g.apart); j++)
          scatter(g, j, sample, row, now);
      for (const GatherWords& g : added(layer))
        for (int64_t j = offsets(g)[item]; j < offsets(g)[item + 1]; j++) {
          T* to = gradients(ws, S, g.source) + (items(g)[j] * S + sample) * g.width;
          const T *dz = grad + row * width, *slope = slopes + row * width;
          for (int64_t c = 0; c < now * width; c++) {
            T step = slopes ? dz[c] * slope[c] : dz[c];
            to[c] = g.writes ? step : to[c] + step;
          }
        }
    });
  }

  Structure structure_;
  const NetworkWords& words_;
  const BufferWords* buffers_;
  const LayerWords* layers_;
  const T *weights_, *tables_;
  std::vector<T> zeros_;
};

}  // namespace gn
