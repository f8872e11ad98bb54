// Checks that words are a valid structure: code that follows them stays in their memory and that of a matching call.
#pragma once

#include <algorithm>
#include <stdexcept>
#include <vector>

#include "kernels.h"
#include "structure.h"

namespace gn __attribute__((visibility("hidden"))) {

// Recomputes the words of structure.py that follow from others, and compares. Runs once per structure and takes about
// as long as a step of one sample.
class StructureCheck {
 public:
  // Throws std::invalid_argument with the name of the invalid part.
  static void run(const int64_t* words, int64_t count) { StructureCheck(words, count).all(); }

 private:
  static constexpr int64_t kMost = int64_t(1) << 44;  // limit of any size, so that a size times a batch fits int64_t

  StructureCheck(const int64_t* words, int64_t count) : structure_{words}, count_(count) {}

  void require(bool condition) const {
    if (!condition) throw std::invalid_argument(part_);
  }

  int64_t times(int64_t a, int64_t b) const {
    int64_t product = 0;
    require(a >= 0 && b >= 0 && !__builtin_mul_overflow(a, b, &product) && product <= kMost);
    return product;
  }
  int64_t plus(int64_t a, int64_t b) const {
    require(a >= 0 && b >= 0 && a <= kMost && b <= kMost - a);
    return a + b;
  }
  int64_t padded(int64_t size) const { return plus(size, kPanel - 1) / kPanel * kPanel; }

  // `count` parts of type W, checked to lie within the words.
  template <class W = int64_t>
  const W* list(int64_t place, int64_t count = 1) const {
    const int64_t size = times(count, sizeof(W) / sizeof(int64_t));
    require(0 <= place && size <= count_ && place <= count_ - size);
    return structure_.at<W>(place);
  }
  // Indices, checked to lie within the words and in [low, high).
  const int64_t* indices(int64_t place, int64_t count, int64_t low, int64_t high) const {
    const int64_t* found = list(place, count);
    for (int64_t i = 0; i < count; ++i) require(low <= found[i] && found[i] < high);
    return found;
  }
  // True if the indices, all below size, are a permutation of all indices below size.
  static bool is_permutation(const int64_t* found, int64_t count, int64_t size) {
    if (count != size) return false;
    std::vector<bool> seen(size);
    for (int64_t i = 0; i < count; ++i) {
      if (seen[found[i]]) return false;
      seen[found[i]] = true;
    }
    return true;
  }

  void all() {
    part_ = "the header";
    list<HeaderWords>(0);
    const HeaderWords& header = structure_.header();
    require(header.magic == kMagic && header.format == kFormat && header.operations == kOperations &&
            header.words == count_);
    part_ = "the sum of all words";
    require(header.sum == sum());
    part_ = "the header";
    network(*list<NetworkWords>(header.network));
    part_ = "the state maths";
    const MathsWords& usual = *list<MathsWords>(header.maths[0]);
    maths(usual);
    if (header.maths[1] == -1) return;
    part_ = "the state maths";
    const MathsWords& general = *list<MathsWords>(header.maths[1]);
    maths(general);
    part_ = "the state maths";
    require(general.size == usual.size && general.channels == usual.channels && general.result_size == usual.result_size &&
            general.is_state == usual.is_state && general.actions == usual.actions && general.numbers == usual.numbers);
  }

  // The checksum of structure.py: a change of any one word changes it.
  int64_t sum() const {
    uint64_t sum = 0;
    const int64_t* own = &structure_.header().sum;
    for (int64_t i = 0; i < count_; ++i)
      if (structure_.words + i != own) sum += static_cast<uint64_t>(structure_.words[i]) * (2 * static_cast<uint64_t>(i) + 1);
    return static_cast<int64_t>(sum);
  }

  void network(const NetworkWords& network) {
    part_ = "the network";
    network_ = &network;
    require(network.layer_count >= 1 && network.layer_count <= count_ &&
            network.buffer_count == network.layer_count + 2);
    buffers_ = list<BufferWords>(network.buffers, network.buffer_count);
    layers_ = list<LayerWords>(network.layers, network.layer_count);
    int64_t total = 0;
    for (int64_t i = 0; i < network.buffer_count; ++i) {
      const BufferWords& buffer = buffers_[i];
      require(buffer.start == total);
      total = plus(total, padded(times(buffer.items, buffer.width)));
    }
    require(network.total == total);
    int64_t weights = 0, paired = 0, plain = 0, tables = 0, sample_tables = 0, stored = 0, deepest = 0;
    for (int64_t i = 0; i < network.layer_count; ++i) {
      const LayerWords& layer = layers_[i];
      part_ = "a layer";
      require(layer.items == buffers_[i + 2].items && layer.width == buffers_[i + 2].width && layer.input_count >= 1);
      require(is_flag(layer.has_table) && is_flag(layer.sampled) && !(layer.has_table && layer.sampled) &&
              kNone <= layer.activation && layer.activation <= kTanh);
      int64_t depth = 0;
      for (const GatherWords& gather : gathers(layer.inputs, layer.input_count)) {
        check(gather, layer, i + 2);
        require(gather.column == depth);
        depth = plus(depth, gather.width);
      }
      int64_t column = depth;
      for (const GatherWords& gather : gathers(layer.added, layer.added_count)) {
        check(gather, layer, i + 2);
        require(gather.width == layer.width && gather.column == column);
        column = plus(column, gather.width);
      }
      part_ = "a layer";
      require(layer.depth == depth && layer.slopes == stored && layer.forward == weights &&
              layer.paired_forward == paired && layer.plain == plain &&
              layer.table == (layer.sampled ? sample_tables : tables));
      const int64_t out = padded(layer.width), in = padded(depth);
      weights = plus(weights, times(out, depth));
      require(layer.backward == weights);
      weights = plus(weights, times(in, layer.width));
      paired = plus(paired, times(out, (depth + 1) / 2));
      require(layer.paired_backward == paired);
      paired = plus(paired, times(in, (layer.width + 1) / 2));
      plain = plus(plain, times(layer.width, depth));
      if (layer.has_table) tables = plus(tables, times(layer.items, out));
      if (layer.sampled) sample_tables = plus(sample_tables, times(layer.items, out));
      if (layer.activation) stored = plus(stored, times(layer.items, layer.width));
      deepest = std::max({deepest, out, in});
    }
    part_ = "the network";
    require(network.weights == weights && network.paired_weights == paired && network.plain_weights == plain &&
            network.tables == tables && network.sample_tables == sample_tables && network.stored == stored &&
            network.deepest == deepest);
    backward_order();
  }

  static bool is_flag(int64_t word) { return word == 0 || word == 1; }

  struct Gathers {
    const GatherWords* first;
    int64_t count;
    const GatherWords* begin() const { return first; }
    const GatherWords* end() const { return first + count; }
  };
  Gathers gathers(int64_t place, int64_t count) const { return {list<GatherWords>(place, count), count}; }

  // Checks a gather of the layer that writes the buffer `own`.
  void check(const GatherWords& gather, const LayerWords& layer, int64_t own) {
    part_ = "a gather";
    require(0 <= gather.source && gather.source < own && gather.width == buffers_[gather.source].width);
    const int64_t* offsets = list(gather.offsets, plus(layer.items, 1));
    require(offsets[0] == 0);
    bool alone = true;
    for (int64_t i = 0; i < layer.items; ++i) {
      require(offsets[i] <= offsets[i + 1]);
      alone &= offsets[i + 1] == i + 1;
    }
    const int64_t count = offsets[layer.items];
    const int64_t* items = indices(gather.items, count, 0, buffers_[gather.source].items);
    for (int64_t i = 0; i < count && alone; ++i) alone = items[i] == items[0] + i;
    require(gather.in_order == alone);
  }

  // Checks that the first gather that reaches a buffer in the backward pass initialises its gradient, and that buffers
  // that no gather reaches are listed as unread.
  void backward_order() {
    part_ = "the order of gradients";
    std::vector<bool> reached(network_->buffer_count);
    reached.back() = true;
    for (int64_t i = network_->layer_count; i-- > 0;) {
      const LayerWords& layer = layers_[i];
      const Gathers both[] = {gathers(layer.inputs, layer.input_count), gathers(layer.added, layer.added_count)};
      bool direct = false;
      for (const Gathers& some : both)
        for (const GatherWords& gather : some) {
          int64_t same = 0;
          for (const Gathers& others : both)
            for (const GatherWords& other : others) same += other.source == gather.source;
          const bool first = !reached[gather.source], apart = same == 1;
          reached[gather.source] = true;
          const bool once = first && apart &&
                            is_permutation(structure_.list(gather.items), structure_.list(gather.offsets)[layer.items],
                                           buffers_[gather.source].items);
          require(gather.clears == (first && !once) && gather.writes == once && gather.apart == apart);
          direct |= once && gather.in_order && layer.input_count == 1 && layer.added_count == 0;
        }
      require(layer.direct == direct);
    }
    const int64_t* unread = indices(network_->unread, network_->unread_count, 0, network_->buffer_count);
    for (int64_t i = 0; i < network_->unread_count; ++i) {
      require(!reached[unread[i]]);
      reached[unread[i]] = true;
    }
    require(std::find(reached.begin(), reached.end(), false) == reached.end());
  }

  void maths(const MathsWords& maths) {
    part_ = "the state maths";
    const BufferWords &nodes = buffers_[0], &edges = buffers_[1], &output = buffers_[network_->layer_count + 1];
    require(maths.channels >= 1 && maths.size >= 1 && maths.size <= count_ && maths.size % maths.channels == 0);
    require(0 <= maths.varying_count && maths.varying_count <= maths.size && 0 <= maths.result_count &&
            maths.result_count <= maths.result_size && 0 <= maths.actions && maths.actions <= count_ &&
            0 <= maths.numbers && maths.numbers <= count_ && is_flag(maths.is_state));
    require(maths.node_width == nodes.width && maths.edge_width == edges.width && maths.output_width == output.width &&
            maths.node_inputs == nodes.items * nodes.width && maths.edge_inputs == edges.items * edges.width &&
            maths.outputs == output.items * output.width);
    const int64_t constants = maths.size - maths.varying_count;
    const int64_t* varying = indices(maths.varying, maths.varying_count, 0, maths.size);
    const int64_t* constant = indices(maths.constant, constants, 0, maths.size);
    std::vector<int64_t> both(varying, varying + maths.varying_count);
    both.insert(both.end(), constant, constant + constants);
    require(is_permutation(both.data(), maths.size, maths.size));
    list(maths.values, constants);
    const int64_t* results = indices(maths.results, maths.result_count, 0, maths.result_size);
    if (maths.is_state)
      require(maths.result_size == maths.size && maths.result_count == maths.varying_count &&
              std::equal(results, results + maths.result_count, varying));
    else
      require(maths.result_size % (maths.size / maths.channels) == 0 && maths.result_size <= kMost);
    const int64_t inputs = plus(maths.node_inputs, maths.edge_inputs), varies = maths.varying_count;
    tape(maths.forward, {varies, maths.actions, maths.outputs, maths.numbers}, {inputs, maths.result_count});
    tape(maths.adjoint, {varies, maths.actions, maths.outputs, maths.numbers, maths.result_count, inputs},
         {maths.outputs, plus(varies, maths.actions)});
  }

  void tape(const TapeWords& tape, const std::vector<int64_t>& inputs, const std::vector<int64_t>& outputs) {
    part_ = "a tape";
    require(0 <= tape.ends[0] && tape.ends[0] <= tape.ends[1] && 1 <= tape.registers && tape.registers <= 0xffff);
    const Instruction* instructions = list<Instruction>(tape.instructions, tape.ends[1]);
    int64_t constants = 0;
    for (int64_t i = 0; i < tape.ends[1]; ++i) {
      const Instruction& each = instructions[i];
      require(each.code < kOperations && std::max({each.out, each.a, each.b, each.c}) < tape.registers);
      constants = std::max<int64_t>(constants, each.k);
    }
    list(tape.constants, constants + 1);
    for (int64_t i = 0; i < tape.ends[1]; ++i) {
      if (instructions[i].code != kLookUp) continue;
      const double size = structure_.doubles(tape.constants)[instructions[i].k];
      require(1 <= size && size <= kMost && size == static_cast<double>(static_cast<int64_t>(size)));
      list(tape.constants, instructions[i].k + 1 + static_cast<int64_t>(size));
    }
    for (size_t group = 0; group < inputs.size(); ++group) indices(tape.inputs[group], inputs[group], -1, tape.registers);
    for (int phase : {0, 1}) indices(tape.outputs[phase], outputs[phase], 0, tape.registers);
  }

  Structure structure_;
  int64_t count_;
  const char* part_ = "";
  const NetworkWords* network_ = nullptr;
  const BufferWords* buffers_ = nullptr;
  const LayerWords* layers_ = nullptr;
};

}  // namespace gn
