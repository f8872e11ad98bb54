// Native engine of a folded network: a list of linear layers over items, described as data.
//
// The description is that of LayerList.code() in torchrl_gn/networks/layers.py. Buffers are [item][S][width] for a tile
// of S samples; a layer walks its I * S rows in chunks, gathers their inputs side by side, multiplies and activates.
#pragma once

#include <algorithm>
#include <cstdlib>
#include <memory>
#include <vector>

#include "kernels.h"

namespace gn __attribute__((visibility("hidden"))) {

// T: float or double. kBfloat16: factors of the products are rounded, sums stay float32; for float, if the compiler
// defines __AVX512BF16__. Methods touch only ws and stored: several threads may run one network.
template <class T, bool kBfloat16 = false>
class Network {
#ifndef __AVX512BF16__
  static_assert(!kBfloat16, "bfloat16 needs -mavx512bf16");
#endif
  static_assert(!kBfloat16 || sizeof(T) == 4, "bfloat16 is summed in float");

 public:
  using Number = T;

  // code: see above; weights[i] row-major [out, K] and tables[i] [I, out] or nullptr, of every layer i.
  Network(const int64_t* code, const T* const* weights, const T* const* tables) {
    add_buffer(code[0], code[1]);
    add_buffer(code[2], code[3]);
    layers_.resize(code[4]);
    code += 5;
    for (Layer& layer : layers_) {
      layer.items = code[0], layer.width = code[1], layer.activation = static_cast<Activation>(code[2]);
      layer.inputs.resize(code[3]), layer.added.resize(code[4]);
      code += 5;
      for (Gather& gather : layer.inputs) {
        read(code, layer.items, gather);
        gather.column = layer.depth;
        layer.depth += gather.width;
      }
      for (Gather& gather : layer.added) read(code, layer.items, gather);
      layer.slopes = stored_;
      if (layer.activation != kNone) stored_ += layer.items * layer.width;
      deepest_ = std::max({deepest_, padded(layer.depth), padded(layer.width)});
      add_buffer(layer.items, layer.width);
    }
    zeros_ = block(deepest_);
    plan_gradients();
    update(weights, tables);
  }

  // Same shapes, new numbers.
  void update(const T* const* weights, const T* const* tables) {
    for (size_t i = 0; i < layers_.size(); i++) {
      Layer& layer = layers_[i];
      int64_t out = layer.width, in = layer.depth;
      layer.forward = pack(weights[i], out, in, in, 1);
      layer.backward = pack(weights[i], in, out, 1, in);
      layer.has_table = tables[i] != nullptr;
      layer.table = block(padded(out) * (layer.has_table ? layer.items : 1));
      for (int64_t r = 0; r < layer.items && layer.has_table; r++)
        std::copy_n(tables[i] + r * out, out, layer.table.get() + r * padded(out));
    }
  }

  // Numbers of T, to lie at a 64-byte boundary, that a tile of S samples needs.
  size_t workspace(int S, bool gradient) const {
    return scratch() + (gradient ? 2 : 1) * S * total_ + kLanes<T>;
  }
  // The activations of a tile of S samples, which weight_gradients() reads: they may be moved to another ws.
  T* activations(T* ws) const { return ws + scratch(); }
  int64_t activation_count(int S) const { return S * total_; }
  // Numbers of every layer's weight and table; 0 of a table that is not there.
  std::vector<int64_t> weight_sizes() const {
    std::vector<int64_t> sizes;
    for (const Layer& layer : layers_) sizes.push_back(layer.width * layer.depth);
    return sizes;
  }
  std::vector<int64_t> table_sizes() const {
    std::vector<int64_t> sizes;
    for (const Layer& layer : layers_) sizes.push_back(layer.has_table ? layer.items * layer.width : 0);
    return sizes;
  }
  // Numbers per sample that backward() needs of forward(): slopes of the activations.
  size_t stored() const { return stored_; }

  T* nodes(T* ws, int S) const { return values(ws, S, 0); }
  T* edges(T* ws, int S) const { return values(ws, S, 1); }
  const T* output(T* ws, int S) const { return values(ws, S, layers_.size() + 1); }
  T* grad_nodes(T* ws, int S) const { return gradients(ws, S, 0); }
  T* grad_edges(T* ws, int S) const { return gradients(ws, S, 1); }
  T* grad_output(T* ws, int S) const { return gradients(ws, S, layers_.size() + 1); }

  // Tables of each sample beside the network's own: [I, batch, width padded to 16] of every layer, or nullptr.
  struct SampleTables {
    const void* const* tables;
    int64_t batch, first;  // first: the tile's first sample
  };

  // Reads nodes and edges, writes output and, if it is given, the block of S * stored() numbers.
  void forward(T* ws, int S, T* stored, const SampleTables& samples) const {
    for (size_t i = 0; i < layers_.size(); i++) {
      const Layer& layer = layers_[i];
      T* out = values(ws, S, i + 2);
      chunks(layer.items * S, [&](int64_t start, int rows) {
        const void* own = samples.tables ? samples.tables[i] : nullptr;
        run(layer, ws, S, start, rows, static_cast<const T*>(own), samples, out + start * layer.width);
        if (layer.activation == kNone) return;
        T* slopes = stored ? stored + layer.slopes * S + start * layer.width : nullptr;
        activate(layer.activation, out + start * layer.width, slopes, rows * layer.width);
      });
    }
  }

  // Reads grad_output and what forward() stored, writes grad_nodes and grad_edges.
  void backward(T* ws, int S, const T* stored) const {
    for (int64_t b : unread_) clear(ws, S, b);
    for (size_t i = layers_.size(); i-- > 0;) {
      const Layer& layer = layers_[i];
      for (auto* gathers : {&layer.inputs, &layer.added})
        for (const Gather& gather : *gathers)
          if (gather.clears) clear(ws, S, gather.source);
      pre_activations(i, ws, S, stored, [&](int64_t start, int rows, const T* grad, const T* slopes) {
        pull(layer, ws, S, start, rows, grad, slopes);
      });
    }
  }

  // Adds sums over samples to gradients of weights and, if not nullptr, tables, shaped as these. After forward() and
  // backward() of the same samples in the same workspace.
  void weight_gradients(T* ws, int S, const T* stored, T* const* grad_weights, T* const* grad_tables) const {
    for (size_t i = 0; i < layers_.size(); i++)
      pre_activations(i, ws, S, stored, [&](int64_t start, int rows, const T* grad, const T* slopes) {
        add_gradients(layers_[i], ws, S, start, rows, grad, slopes, grad_weights[i], grad_tables[i]);
      });
  }

 private:
  struct Free {
    void operator()(T* block) const { std::free(block); }
  };
  using Block = std::unique_ptr<T[], Free>;
  struct Buffer {
    int64_t items, width, start;  // start: in values of one sample
  };
  struct Gather {
    int64_t source, width, column = 0;
    bool in_order = true;                 // row i is one item, items[0] + i
    bool clears = false, writes = false;  // in backward(): zero the source's gradient first; or overwrite it
    bool apart = true;                    // no other gather of the layer has its source
    std::vector<int64_t> offsets, items;
  };
  struct Layer {
    int64_t items, width, depth = 0, slopes = 0;
    Activation activation;
    std::vector<Gather> inputs, added;
    bool has_table = false, direct = false;  // direct: backward() multiplies into the only input's gradient
    int64_t reads(int64_t source) const {
      int64_t count = 0;
      for (auto* gathers : {&inputs, &added})
        for (const Gather& gather : *gathers) count += gather.source == source;
      return count;
    }
    Block forward, backward, table;  // [out / L][in][L], [in / L][out][L], [I or 1][out], padded
  };

  static int64_t padded(int64_t width) { return (width + kLanes<T> - 1) / kLanes<T> * kLanes<T>; }

  // Numbers of T that hold a row of a product's factors.
  static int64_t steps(int64_t depth) { return kBfloat16 ? (depth + 1) / 2 : depth; }

  static Block block(int64_t count) {
    size_t bytes = (std::max<int64_t>(count, 1) * sizeof(T) + 63) / 64 * 64;
    T* data = static_cast<T*>(std::aligned_alloc(64, bytes));
    std::memset(data, 0, bytes);
    return Block(data);
  }

  static Block pack(const T* weight, int64_t columns, int64_t depth, int64_t column_step, int64_t depth_step) {
    constexpr int L = kLanes<T>;
    Block packed = block(padded(columns) * steps(depth));
    for (int64_t c = 0; c < columns; c++)
      for (int64_t k = 0; k < depth; k++) {
        T value = weight[c * column_step + k * depth_step];
        T& to = packed[(c / L * steps(depth) + steps(k + 1) - 1) * L + c % L];
        if constexpr (kBfloat16) {
          uint16_t half = bfloat16(value);
          std::memcpy(reinterpret_cast<char*>(&to) + 2 * (k % 2), &half, 2);
        } else {
          to = value;
        }
      }
    return packed;
  }

  void add_buffer(int64_t items, int64_t width) {
    buffers_.push_back({items, width, total_});
    total_ += (items * width + 15) / 16 * 16;
  }

  void read(const int64_t*& code, int64_t items, Gather& gather) const {
    gather.source = *code++;
    gather.width = buffers_[gather.source].width;
    gather.offsets.assign(code, code + items + 1);
    code += items + 1;
    gather.items.assign(code, code + gather.offsets.back());
    code += gather.offsets.back();
    for (int64_t i = 0; i < items && gather.in_order; i++)
      gather.in_order = gather.offsets[i + 1] == i + 1 && gather.items[i] == gather.items[0] + i;
  }

  // Which gather is the first in backward() to reach its source.
  void plan_gradients() {
    std::vector<bool> reached(buffers_.size());
    reached.back() = true;
    for (size_t i = layers_.size(); i-- > 0;)
      for (auto* gathers : {&layers_[i].inputs, &layers_[i].added})
        for (Gather& gather : *gathers) {
          gather.apart = layers_[i].reads(gather.source) == 1;
          if (reached[gather.source]) continue;
          reached[gather.source] = true;
          std::vector<int64_t> items = gather.items;
          std::sort(items.begin(), items.end());
          bool once = gather.apart && static_cast<int64_t>(items.size()) == buffers_[gather.source].items;
          for (size_t j = 0; once && j < items.size(); j++) once = items[j] == static_cast<int64_t>(j);
          (once ? gather.writes : gather.clears) = true;
          Layer& layer = layers_[i];
          bool only = gathers == &layer.inputs && layer.inputs.size() == 1 && layer.added.empty();
          layer.direct = only && once && gather.in_order && padded(layer.depth) == layer.depth;
        }
    for (size_t b = 0; b < buffers_.size(); b++)
      if (!reached[b]) unread_.push_back(b);
  }

  // Workspace: two left factors of a chunk, its results, its added rows; values of all buffers; their gradients.
  int64_t scratch() const { return kChunk * (2 * kStride + 2 * deepest_); }
  T* factors(T* ws) const { return ws + kChunk * kStride; }
  T* results(T* ws) const { return factors(ws) + kChunk * kStride; }
  T* sums(T* ws) const { return results(ws) + kChunk * deepest_; }
  T* values(T* ws, int S, size_t buffer) const { return ws + scratch() + S * buffers_[buffer].start; }
  T* gradients(T* ws, int S, size_t buffer) const { return values(ws, S, buffer) + S * total_; }
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
    const Layer& layer = layers_[i];
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

  const T* rows_of(const Gather& g, int64_t j, T* ws, int S, int64_t sample) const {
    return values(ws, S, g.source) + (g.items[j] * S + sample) * g.width;
  }

  // Columns [from, to) of gathered rows; up to a vector more is written after each.
  void gather(const Gather& g, T* ws, int S, int64_t start, int rows, int64_t from, int64_t to, T* x) const {
    if (g.in_order)
      return copy_rows(x, kStride, rows_of(g, 0, ws, S, start) + from, g.width, rows, to - from);
    runs(S, start, rows, [&](int64_t item, int sample, int row, int now) {
      T* out = x + row * kStride;
      int64_t j = g.offsets[item], last = g.offsets[item + 1];
      if (j == last) return copy_rows(out, kStride, zeros_.get(), 0, now, to - from);
      const T* base = rows_of(g, j, ws, S, sample) + from;
      if (++j == last) return copy_rows(out, kStride, base, g.width, now, to - from);
      for (int64_t step = g.width; j < last; j++, base = out, step = kStride)
        add_rows(out, kStride, base, step, rows_of(g, j, ws, S, sample) + from, g.width, now, to - from);
    });
  }

  // Columns [begin, end) of a chunk's left factor.
  void gather(const Layer& layer, T* ws, int S, int64_t start, int rows, int64_t begin, int64_t end) const {
    for (const Gather& g : layer.inputs) {
      int64_t from = std::max(begin, g.column), to = std::min(end, g.column + g.width);
      if (from < to) gather(g, ws, S, start, rows, from - g.column, to - g.column, ws + from - begin);
    }
  }

  // Adds the product of a chunk's left factor, columns [k, k + count) of depth, and packed weights to init.
  static void multiply(const T* packed, T* x, int rows, int64_t k, int64_t count, int64_t depth, int64_t width,
                       const T* const* init, T* out) {
    constexpr int L = kLanes<T>;
    if constexpr (kBfloat16) pair_up(x, rows, count);
    product<T, kBfloat16 ? kPairs : kPlain>(x, packed + steps(k) * L, rows, width / L, steps(count), steps(depth) * L,
                                            init, out, width);
  }

  // Pre-activations of a chunk.
  void run(const Layer& layer, T* ws, int S, int64_t start, int rows, const T* own, const SampleTables& samples,
           T* out) const {
    int64_t width = padded(layer.width), own_width = (layer.width + 15) / 16 * 16;
    const T* init[kChunk];
    runs(S, start, rows, [&](int64_t item, int sample, int row, int now) {
      const T* base = layer.table.get() + (layer.has_table ? item * width : 0);
      T* sum = sums(ws) + row * width;
      int64_t step = 0;
      if (own) base = own + (item * samples.batch + samples.first + sample) * own_width, step = own_width;
      for (const Gather& g : layer.added)
        for (int64_t j = g.offsets[item]; j < g.offsets[item + 1]; j++, base = sum, step = width)
          add_rows(sum, width, base, step, rows_of(g, j, ws, S, sample), g.width, now, width);
      for (int r = 0; r < now; r++, base += step) init[row + r] = base;
    });
    bool direct = width == layer.width;
    T* to = direct ? out : results(ws);
    for (int64_t k = 0; k == 0 || k < layer.depth; k += kDepth) {
      int64_t end = std::min<int64_t>(k + kDepth, layer.depth);
      gather(layer, ws, S, start, rows, k, end);
      multiply(layer.forward.get(), ws, rows, k, end - k, layer.depth, width, init, to);
      for (int r = 0; r < rows; r++) init[r] = to + r * width;
    }
    for (int r = 0; r < rows && !direct; r++) std::copy_n(to + r * width, layer.width, out + r * layer.width);
  }

  // Gradients of a chunk's pre-activations, some columns.
  static void multiply_slopes(const T* grad, const T* slopes, int64_t width, int rows, int64_t count, T* x) {
    for (int r = 0; r < rows; r++, x += kStride, grad += width)
      for (int64_t c = 0; c < count; c++) x[c] = slopes ? grad[c] * slopes[r * width + c] : grad[c];
  }

  // Adds a chunk's gradients of weight and table.
  void add_gradients(const Layer& layer, T* ws, int S, int64_t start, int rows, const T* grad, const T* slopes,
                     T* weight, T* table) const {
    int64_t width = layer.width, depth = layer.depth;
    T* dz = factors(ws);
    for (int64_t o = 0; o < width; o += kDepth) {
      int64_t count = std::min<int64_t>(kDepth, width - o);
      multiply_slopes(grad + o, slopes ? slopes + o : nullptr, width, rows, count, dz);
      runs(S, start, rows, [&](int64_t item, int, int row, int now) {
        if (table) accumulate_rows<T, true>(table + item * width + o, 0, dz + row * kStride, kStride, now, count);
      });
      for (int64_t k = 0; k < depth; k += kDepth) {
        int64_t columns = std::min<int64_t>(kDepth, depth - k), stride = padded(columns);
        bool whole = stride == columns;
        gather(layer, ws, S, start, rows, k, k + columns);
        for (int64_t p = 0; p < count; p += kChunk) {
          int outputs = static_cast<int>(std::min<int64_t>(kChunk, count - p));
          T* to = weight + (o + p) * depth + k;
          const T* init[kChunk];
          for (int r = 0; r < outputs; r++) init[r] = whole ? to + r * depth : zeros_.get();
          product<T, kOverRows>(dz + p, ws, outputs, stride / kLanes<T>, rows, kLanes<T>, init,
                                whole ? to : results(ws), whole ? depth : stride);
          if (!whole) accumulate_rows<T, true>(to, depth, results(ws), stride, outputs, columns);
        }
      }
    }
  }

  // Gradients of a chunk's inputs. Rows come in the order of items, for one order of sums whatever the chunks.
  void pull(const Layer& layer, T* ws, int S, int64_t start, int rows, const T* grad, const T* slopes) const {
    int64_t width = layer.width, depth = padded(layer.depth);
    T* results = layer.direct ? gradients(ws, S, layer.inputs[0].source) + start * depth : this->results(ws);
    const T* init[kChunk];
    std::fill_n(init, rows, zeros_.get());
    for (int64_t k = 0; k < width; k += kDepth) {
      int64_t count = std::min<int64_t>(kDepth, width - k);
      multiply_slopes(grad + k, slopes ? slopes + k : nullptr, width, rows, count, ws);
      multiply(layer.backward.get(), ws, rows, k, count, width, depth, init, results);
      for (int r = 0; r < rows; r++) init[r] = results + r * depth;
    }
    if (layer.direct) return;
    auto scatter = [&](const Gather& g, int64_t j, int64_t sample, int row, int now) {
      T* to = gradients(ws, S, g.source) + (g.items[j] * S + sample) * g.width;
      const T* from = results + row * depth + g.column;
      (g.writes ? accumulate_rows<T, false> : accumulate_rows<T, true>)(to, g.width, from, depth, now, g.width);
    };
    for (const Gather& g : layer.inputs)
      if (g.in_order && g.apart) scatter(g, 0, start, 0, rows);
    runs(S, start, rows, [&](int64_t item, int sample, int row, int now) {
      for (const Gather& g : layer.inputs)
        for (int64_t j = g.offsets[item]; j < g.offsets[item + 1] && !(g.in_order && g.apart); j++)
          scatter(g, j, sample, row, now);
      for (const Gather& g : layer.added)
        for (int64_t j = g.offsets[item]; j < g.offsets[item + 1]; j++) {
          T* to = gradients(ws, S, g.source) + (g.items[j] * S + sample) * g.width;
          const T *dz = grad + row * width, *slope = slopes + row * width;
          for (int64_t c = 0; c < now * width; c++) {
            T step = slopes ? dz[c] * slope[c] : dz[c];
            to[c] = g.writes ? step : to[c] + step;
          }
        }
    });
  }

  std::vector<Buffer> buffers_;  // nodes, edges, outputs of the layers
  std::vector<Layer> layers_;
  std::vector<int64_t> unread_;  // buffers whose gradient is zero
  Block zeros_;
  int64_t total_ = 0, stored_ = 0, deepest_ = 0;
};

}  // namespace gn
