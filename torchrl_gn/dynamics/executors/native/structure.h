// The structure of a step: its network's layers and the tapes of its state maths, as one array of int64 words.
//
// structure.py writes the array, in the order of the fields below. Places are indices of words from its start, so that
// it can lie anywhere in memory. It has no weights.
#pragma once

#include <cstdint>
#include <cstring>

namespace gn __attribute__((visibility("hidden"))) {  // libraries built for other processors may be loaded beside

constexpr int64_t kMagic = 0x676e5f73746570;  // "gn_step"
constexpr int64_t kFormat = 3;                // version of this format, as in structure.py
constexpr int kPanel = 16;  // columns of a panel of packed weights, whatever the processor's vectors hold

struct BufferWords {
  int64_t items, width, start;  // start: in numbers of one sample
};

// One row for each item of a layer: a sum of some items of a buffer.
struct GatherWords {
  int64_t source, width, column;
  int64_t in_order;        // row i is one item, items[0] + i
  int64_t clears, writes;  // backward pass: zero the source's gradient first; or overwrite it
  int64_t apart;           // no other gather of the layer has its source
  int64_t offsets, items;  // places of [I + 1] and [offsets[I]] words
};

struct LayerWords {
  int64_t items, width, depth, activation;
  int64_t slopes;       // place of the layer's slopes among a sample's, in numbers
  int64_t has_table;    // the layer has a shared table
  int64_t sampled;      // the layer has one table per sample
  int64_t direct;       // backward pass: write the only input's gradient in place, if its rows are whole vectors
  int64_t inputs, input_count, added, added_count;  // places of GatherWords
  int64_t forward, backward;                // places in the packed weights
  int64_t paired_forward, paired_backward;  // the same of bfloat16 pairs
  int64_t table;        // place in the shared tables, or in one sample's
  int64_t plain;        // place of the weight among all unpacked weights
};

struct NetworkWords {
  int64_t buffer_count, buffers;  // nodes, edges, outputs of the layers
  int64_t layer_count, layers;
  int64_t unread_count, unread;  // buffers whose gradient is zero
  int64_t total, stored;         // numbers of one sample: of all buffers, of all slopes
  int64_t deepest;               // longest row, padded to kPanel
  int64_t weights, paired_weights, plain_weights, tables, sample_tables;  // numbers of each
};

struct TapeWords {
  int64_t instructions, constants;  // places: instructions of two words each, float64 bits
  int64_t ends[2];                  // where each phase ends
  int64_t registers;
  int64_t inputs[6];   // places of every group's registers, or -1
  int64_t outputs[2];  // and of every phase's outputs
};

struct MathsWords {
  int64_t size;            // channels of a state, N * C
  int64_t channels;        // C
  int64_t varying_count;   // channels of a state that change
  int64_t result_size;     // numbers of a result: a state, or a change N * 12
  int64_t result_count;    // numbers of a result that are computed
  int64_t is_state;        // a result is a state: its other channels are copied, and rollouts are possible
  int64_t actions;
  int64_t numbers;         // of the model and of samples that the tapes read
  int64_t outputs;         // P * F_out
  int64_t node_inputs, edge_inputs;  // N * F_n, E * F_e
  int64_t node_width, edge_width, output_width;
  int64_t varying, constant, values, results;  // places; values: float64 bits of the constant channels
  TapeWords forward, adjoint;
};

struct HeaderWords {
  int64_t magic, format, words, operations;  // words: length of the array; operations: kOperations
  int64_t network;     // place of NetworkWords
  int64_t maths[2];    // places of MathsWords: for states with the usual constant channels, and for any; or -1
  int64_t sum;         // checksum: all other words, each times (2 * place + 1), modulo 2^64
};

// The array, with access to its parts by place.
struct Structure {
  const int64_t* words;

  template <class W>
  const W* at(int64_t place) const {
    return reinterpret_cast<const W*>(words + place);
  }
  const int64_t* list(int64_t place) const { return words + place; }
  const double* doubles(int64_t place) const { return reinterpret_cast<const double*>(words + place); }
  const HeaderWords& header() const { return *at<HeaderWords>(0); }
  const NetworkWords& network() const { return *at<NetworkWords>(header().network); }
  const MathsWords* maths(int which) const {
    int64_t place = header().maths[which];
    return place < 0 ? nullptr : at<MathsWords>(place);
  }
};

struct Instruction {
  uint16_t code, out, a, b, c, padding;
  uint32_t k;
};

constexpr int64_t kLookUp = 16;      // code of the operation with a table
constexpr int64_t kOperations = 29;  // length of OPERATIONS in expressions.py

// A tape in the memory of its structure.
struct Tape {
  Structure structure;
  const TapeWords& words;
  const Instruction* instructions;
  const double* constants;

  Tape(const Structure& of, const TapeWords& tape)
      : structure(of), words(tape), instructions(of.at<Instruction>(tape.instructions)),
        constants(of.doubles(tape.constants)) {}
  int64_t registers() const { return words.registers; }
  const int64_t* inputs(int group) const { return structure.list(words.inputs[group]); }
  const int64_t* outputs(int phase) const { return structure.list(words.outputs[phase]); }
};

}  // namespace gn
