// The native executor as PyTorch operators: pure functions of tensors, with shapes for compilers and with gradients.
//
// rollout(state [*B, N, C], actions [*B, (T,) A], ...) returns the next state, or with `many` the states
// [*B, T + 1, N, C]. `structure` is the array of structure.h. pack() packs `weights` and `tables`, executor.py packs
// `sample_tables` and `numbers`. Gradients are of first order, in state, actions, weights and tables.
#include <ATen/EmptyTensor.h>
#include <ATen/Parallel.h>
#include <ATen/core/dispatch/Dispatcher.h>
#include <ATen/core/grad_mode.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <ATen/ops/zeros.h>
#include <ATen/ops/zeros_like.h>
#include <c10/core/impl/TorchDispatchModeTLS.h>
#include <torch/csrc/autograd/custom_function.h>
#include <torch/library.h>

#include <algorithm>
#include <mutex>
#include <new>
#include <stdexcept>
#include <tuple>
#include <unordered_map>
#include <utility>
#include <vector>

#include "engine.h"

namespace {

using at::Tensor;
using OptionalTensor = std::optional<Tensor>;
using torch::autograd::AutogradContext;
using torch::autograd::variable_list;

constexpr int64_t kMostThreads = 1024, kMostSteps = int64_t(1) << 32;
constexpr int64_t kMostStored = int64_t(1) << 28;  // most bytes to keep for a gradient; above, steps are recomputed

// Reuses the memory of large results: fresh pages cost as much as filling them.
class Pool {
 public:
  static Tensor take(int64_t count, at::ScalarType type) {
    const size_t bytes = count * c10::elementSize(type);
    if (bytes < (size_t(1) << 16)) return empty({count}, type);
    auto [data, size] = find(bytes);
    auto give_back = [data = data, size = size](void*) { add(data, size); };
    return at::from_blob(data, {count}, give_back, at::TensorOptions().dtype(type));
  }
  // at::empty that raises MemoryError instead of RuntimeError if there is no memory.
  static Tensor empty(at::IntArrayRef shape, at::ScalarType type) {
    try {
      return at::empty(shape, at::TensorOptions().dtype(type));
    } catch (const c10::Error&) {
      throw std::bad_alloc();
    }
  }

 private:
  struct Block {
    void* data;
    size_t size;
  };
  static std::mutex& lock() { static auto* one = new std::mutex; return *one; }
  static constexpr size_t kKept = 2;
  static std::vector<Block>& free() {
    static auto* blocks = [] {
      auto* none = new std::vector<Block>;
      none->reserve(kKept + 1);  // add() must not fail: deleters of tensors call it
      return none;
    }();
    return *blocks;
  }
  static std::pair<void*, size_t> find(size_t bytes) {
    {
      std::lock_guard<std::mutex> guard(lock());
      for (auto block = free().begin(); block != free().end(); ++block)
        if (bytes <= block->size && block->size <= 2 * bytes) {
          auto found = std::pair(block->data, block->size);
          free().erase(block);
          return found;
        }
    }
    const size_t size = (bytes + 63) / 64 * 64;
    void* data = std::aligned_alloc(64, size);
    if (!data) throw std::bad_alloc();
    return {data, size};
  }
  static void add(void* data, size_t size) {
    std::lock_guard<std::mutex> guard(lock());
    free().push_back({data, size});
    if (free().size() > kKept) {
      std::free(free().front().data);
      free().erase(free().begin());
    }
  }
};

// The inputs of all operators besides states and actions.
struct Model {
  const Tensor &structure, &weights, &tables;
  const OptionalTensor& sample_tables;
  const Tensor& numbers;
};

// Rejects a CPU tensor whose numbers do not all lie in its memory, as after resizing its storage.
void check_memory(const Tensor& tensor) {
  const size_t size = tensor.element_size(), offset = tensor.storage_offset(), count = tensor.numel();
  const c10::Storage& storage = tensor.unsafeGetTensorImpl()->unsafe_storage();
  const size_t bytes = tensor.is_contiguous()
                           ? (offset + count) * size
                           : at::detail::computeStorageNbytes(tensor.sizes(), tensor.strides(), size, offset);
  const bool aligned = (reinterpret_cast<uintptr_t>(storage.data()) & (size - 1)) == 0;  // sizes are powers of two
  TORCH_CHECK_VALUE(count == 0 || (bytes <= storage.nbytes() && aligned),
                    "A tensor of the shape ", tensor.sizes(), " has less memory than numbers, or none aligned to them.");
}

// Checked structures, as copies that nobody can change. A structure is checked again after a write that torch records.
// Other writes, for example by NumPy or in inference mode, have no effect: the copy is used.
class Structures {
 public:
  // Valid until the same thread asks for another structure.
  static gn::Structure of(const Tensor& structure) {
    TORCH_CHECK_VALUE(structure.is_cpu() && structure.scalar_type() == at::kLong && structure.is_contiguous() &&
                          structure.dim() == 1 && structure.numel() > 0,
                      "The structure of a native step must be contiguous int64 numbers on the processor.");
    check_memory(structure);
    static thread_local Known last;  // found without waiting for other threads
    const Known given{structure};
    if (!last.is(given)) last = find(given, structure.storage());
    return {last.words.const_data_ptr<int64_t>()};
  }

 private:
  struct Known {
    const int64_t* begin = nullptr;
    int64_t count = 0;
    uint32_t version = 0;
    const c10::StorageImpl* storage = nullptr;
    std::optional<c10::weak_intrusive_ptr<c10::StorageImpl>> kept;  // so that no other storage gets its address
    Tensor words;

    Known() = default;
    explicit Known(const Tensor& structure)
        : begin(structure.const_data_ptr<int64_t>()),
          count(structure.numel()),
          version(structure.is_inference() ? 0 : structure.unsafeGetTensorImpl()->version_counter().current_version()),
          storage(structure.unsafeGetTensorImpl()->unsafe_storage().unsafeGetStorageImpl()) {}
    bool is(const Known& other) const {
      return begin == other.begin && count == other.count && version == other.version && storage == other.storage;
    }
  };
  static Known find(Known given, const c10::Storage& storage) {
    {
      std::lock_guard<std::mutex> guard(lock());
      const auto found = known().find(given.begin);
      if (found != known().end() && found->second.is(given)) return found->second;
    }
    given.kept = storage.getWeakStorageImpl();
    given.words = Pool::empty({given.count}, at::kLong);
    std::copy_n(given.begin, given.count, given.words.data_ptr<int64_t>());
    try {
      gn::check(given.words.const_data_ptr<int64_t>(), given.count);
    } catch (const std::invalid_argument& part) {
      TORCH_CHECK_VALUE(false, "The structure of a native step is damaged (", part.what(),
                        "), or of another version: specialise the model again.");
    }
    std::lock_guard<std::mutex> guard(lock());
    for (auto each = known().begin(); each != known().end();)
      each = each->second.kept->expired() ? known().erase(each) : std::next(each);
    known().insert_or_assign(given.begin, given);
    return given;
  }
  static std::mutex& lock() { static auto* one = new std::mutex; return *one; }
  static std::unordered_map<const int64_t*, Known>& known() {
    static auto* all = new std::unordered_map<const int64_t*, Known>;
    return *all;
  }
};

bool needs(const Tensor& tensor) { return tensor.defined() && tensor.requires_grad(); }

bool is_number(const Tensor& tensor) { return tensor.scalar_type() == at::kFloat || tensor.scalar_type() == at::kDouble; }

void check_model(const gn::Structure& words, const Model& model, int64_t batch) {
  const gn::NetworkWords& network = words.network();
  const bool paired = model.weights.scalar_type() == at::kBFloat16;
  const int64_t count = paired ? 2 * network.paired_weights : network.weights;
  TORCH_CHECK_NOT_IMPLEMENTED((is_number(model.weights) || paired) && model.weights.is_cpu(),
                              "Native weights are of float32, float64 or bfloat16 on the processor.");
  TORCH_CHECK_VALUE(model.weights.numel() == count &&
                        model.tables.numel() == network.tables && model.weights.is_contiguous() &&
                        model.tables.is_contiguous() && model.tables.is_cpu() &&
                        model.tables.scalar_type() == (paired ? at::kFloat : model.weights.scalar_type()),
                    "The packed weights do not fit the structure of the native step.");
  const auto& own = model.sample_tables;
  const bool has_own = own.has_value() && own->defined();
  TORCH_CHECK_VALUE(has_own == (network.sample_tables > 0) &&
                        (!has_own || (own->numel() % batch == 0 && own->numel() / batch == network.sample_tables &&
                                      own->is_contiguous() && own->scalar_type() == model.tables.scalar_type())),
                    "There must be tables of each sample.");
  const Tensor& numbers = model.numbers;
  TORCH_CHECK_VALUE(numbers.scalar_type() == at::kDouble && numbers.is_contiguous() && numbers.dim() == 2 &&
                        (numbers.size(0) == 1 || numbers.size(0) == batch) && numbers.size(1) == words.maths(0)->numbers,
                    "The numbers of the native step have another shape than its structure.");
  TORCH_CHECK_NOT_IMPLEMENTED(!paired || gn::has_bfloat16(), "This processor multiplies no bfloat16.");
  for (const Tensor* each : {&model.weights, &model.tables, &numbers}) check_memory(*each);
  if (has_own) check_memory(*own);
}

gn::Array array(const Tensor& tensor) {
  return {const_cast<void*>(tensor.const_data_ptr()), tensor.scalar_type() == at::kDouble};
}

gn::Weights weights_of(const Model& model) {
  const auto type = model.weights.scalar_type();
  return {type == at::kDouble ? gn::kFloat64 : type == at::kBFloat16 ? gn::kBfloat16Pairs : gn::kFloat32,
          model.weights.const_data_ptr(), model.tables.const_data_ptr()};
}

int64_t thread_count(int64_t threads) { return std::min(threads > 0 ? threads : at::get_num_threads(), kMostThreads); }

// A call for contiguous states and actions. The states are one start state per sample, or all states of a rollout.
struct Prepared {
  gn::Structure words;
  const gn::MathsWords& maths;  // usual state maths; the general one has the same sizes
  gn::Weights weights;
  gn::Call call{};

  Prepared(const Tensor& states, const Tensor& actions, const Model& model, bool starts_alone, bool many, int64_t threads)
      : words(Structures::of(model.structure)), maths(*words.maths(0)), weights(weights_of(model)) {
    TORCH_CHECK_NOT_IMPLEMENTED(is_number(states) && is_number(actions) && states.numel() && states.is_cpu() &&
                                    actions.is_cpu(),
                                "A native step is of float32 or float64 on the processor.");
    const int64_t sample_dims = many && !starts_alone ? 3 : 2, batch_dims = states.dim() - sample_dims;
    TORCH_CHECK_VALUE(batch_dims >= 0 && states.size(-1) == maths.channels && actions.dim() == batch_dims + 1 + many &&
                          states.size(-2) * maths.channels == maths.size && actions.size(-1) == maths.actions &&
                          states.sizes().slice(0, batch_dims) == actions.sizes().slice(0, batch_dims),
                      "States or actions do not fit the native step: ", states.sizes(), " and ", actions.sizes(), ".");
    TORCH_CHECK_VALUE(maths.is_state || !many, "The change of a native step has no rollout.");
    call.steps = many ? actions.size(-2) : 1;
    TORCH_CHECK_NOT_IMPLEMENTED(call.steps, "A native rollout has a step.");
    TORCH_CHECK_VALUE(call.steps <= kMostSteps, "A native rollout has at most ", kMostSteps, " steps.");
    const int64_t rows = sample_dims == 3 ? states.size(-3) : 1;
    TORCH_CHECK_VALUE(sample_dims == 2 || rows == call.steps + 1, "States do not fit the native step: a gradient needs all.");
    call.batch = states.numel() / (maths.size * rows);
    check_model(words, model, call.batch);
    call.threads = thread_count(threads);
    call.tile = std::min(gn::kTile, (call.batch + call.threads - 1) / call.threads);  // so that all threads get samples
    call.states = array(states);
    call.state_stride = maths.size * rows;
    call.actions = array(actions);
    call.with_start = many;
    call.numbers = model.numbers.const_data_ptr<double>();
    call.number_stride = model.numbers.size(0) > 1 ? model.numbers.size(1) : 0;
    if (words.network().sample_tables) call.sample_tables = model.sample_tables->const_data_ptr();
  }
  int64_t channels() const { return maths.result_size / (maths.size / maths.channels); }  // of a node's result
  // One number more, the last, identifies the layout of the others.
  int64_t stored_count() const { return gn::stored_count(words, weights, call) + 1; }
  double stored_order() const { return double(call.tile + (call.keeps_all ? 2 * gn::kTile : 0)); }
  void run(bool adjoint) const {
    TORCH_CHECK_NOT_IMPLEMENTED(gn::run(words, weights, call, adjoint), "The native step has no maths for such states.");
  }
};

std::vector<int64_t> result_shape(const Tensor& state, const Tensor& actions, int64_t channels, bool many) {
  std::vector<int64_t> shape = state.sizes().vec();
  if (many) shape.insert(shape.end() - 2, actions.size(-2) + 1);
  shape.back() = channels;
  return shape;
}

enum Keep : int64_t { kNothing, kSlopes, kAll };

// Returns the result. `keep` selects numbers to store for a gradient. kSlopes: slopes, for a gradient in states. kAll:
// also the activations of a single step, for a gradient in weights.
Tensor run(const Tensor& state_, const Tensor& actions_, const Model& model, int64_t channels, bool many, int64_t threads,
           Keep keep, Tensor* stored) {
  check_memory(state_), check_memory(actions_);
  const Tensor state = state_.contiguous(), actions = actions_.contiguous();
  Prepared prepared(state, actions, model, true, many, threads);
  gn::Call& call = prepared.call;
  const int64_t size = prepared.maths.result_size;
  TORCH_CHECK_VALUE(0 < channels && channels <= size && state.size(-2) * channels == size, "The native step gives no ",
                    channels, " channels.");
  TORCH_CHECK_VALUE(kNothing <= keep && keep <= kAll, "A native step keeps nothing, slopes or all: 0, 1 or 2, not ",
                    int64_t(keep), ".");
  const Tensor out = many || channels != state.size(-1)
                         ? Pool::empty(result_shape(state, actions, channels, many), state.scalar_type())
                         : at::empty_like(state);
  call.out = array(out);
  TORCH_CHECK_VALUE(keep != kAll || !many, "Activations are kept of one step alone.");
  // With a tile size that ignores the threads, sums over samples do not depend on them either.
  if (keep == kAll) call.keeps_all = true, call.tile = std::min(gn::kTile, call.batch);
  if (keep != kNothing) {
    const int64_t count = prepared.stored_count();
    if (keep == kAll || count * model.tables.element_size() <= kMostStored)
      *stored = Pool::take(count, model.tables.scalar_type());
    call.stored = stored->numel() ? stored->data_ptr() : nullptr;
    if (stored->numel()) array(*stored).set(count - 1, prepared.stored_order());
  }
  prepared.run(false);
  return out;
}

std::tuple<Tensor, Tensor> rollout_keeping(const Tensor& state, const Tensor& actions, const Tensor& structure,
                                           const Tensor& weights, const Tensor& tables,
                                           const OptionalTensor& sample_tables, const Tensor& numbers, int64_t channels,
                                           bool many, int64_t threads, int64_t keep) {
  Tensor stored = at::empty({0}, tables.options());
  const Model model{structure, weights, tables, sample_tables, numbers};
  const Tensor out = run(state, actions, model, channels, many, threads, Keep(keep), &stored);
  return {out, stored};
}

Tensor rollout(const Tensor& state, const Tensor& actions, const Tensor& structure, const Tensor& weights,
               const Tensor& tables, const OptionalTensor& sample_tables, const Tensor& numbers, int64_t channels,
               bool many, int64_t threads) {
  const Model model{structure, weights, tables, sample_tables, numbers};
  return run(state, actions, model, channels, many, threads, kNothing, nullptr);
}

// Returns gradients in state and actions, empty without `of_inputs`, and in packed weights and tables, empty without
// `of_weights`. `states` is the start state, or with `many` the rollout's result.
std::tuple<Tensor, Tensor, Tensor, Tensor> rollout_adjoint(const Tensor& gradient_, const Tensor& states_,
                                                           const Tensor& actions_, const Tensor& structure,
                                                           const Tensor& weights, const Tensor& tables,
                                                           const OptionalTensor& sample_tables, const Tensor& numbers,
                                                           const Tensor& stored, bool many, int64_t threads,
                                                           bool of_weights, bool of_inputs) {
  for (const Tensor* each : {&gradient_, &states_, &actions_, &stored}) check_memory(*each);
  const Tensor gradient = gradient_.contiguous(), states = states_.contiguous(), actions = actions_.contiguous();
  const Model model{structure, weights, tables, sample_tables, numbers};
  Prepared prepared(states, actions, model, false, many, threads);
  std::vector<int64_t> wanted = states.sizes().vec();
  wanted.back() = prepared.channels();
  TORCH_CHECK_VALUE(is_number(gradient) && gradient.sizes() == wanted, "The gradient does not fit the native step: ",
                    gradient.sizes(), " of ", gradient.scalar_type(), ".");
  const Tensor nothing = at::empty({0}, tables.options());
  std::vector<int64_t> shape = states.sizes().vec();
  if (many) shape.erase(shape.end() - 3);
  gn::Call& call = prepared.call;
  const Tensor of_state = of_inputs ? Pool::empty(shape, states.scalar_type()) : at::empty_like(nothing);
  const Tensor of_actions = of_inputs ? at::empty_like(actions) : at::empty_like(nothing);
  const Tensor of_packed = of_weights ? at::zeros_like(weights) : nothing;
  const Tensor of_tables = of_weights ? at::zeros_like(tables) : at::empty_like(nothing);  // results share no memory
  call.out = array(gradient);
  if (of_inputs) call.grad_state = array(of_state), call.grad_actions = array(of_actions);
  if (of_weights) {
    TORCH_CHECK_VALUE(weights.scalar_type() == tables.scalar_type(), "There is no gradient of bfloat16 weights.");
    call.grad_weights = of_packed.data_ptr(), call.grad_tables = of_tables.data_ptr();
    call.keeps_all = stored.numel() > 0;
    call.tile = std::min(gn::kTile, call.batch);
  }
  TORCH_CHECK_VALUE(stored.numel() == 0 || (stored.numel() == prepared.stored_count() && !(call.keeps_all && many) &&
                                            stored.scalar_type() == tables.scalar_type() && stored.is_contiguous() &&
                                            array(stored).get(stored.numel() - 1) == prepared.stored_order()),
                    "What the native step kept for its gradient is of another call.");
  if (stored.numel()) call.stored = stored.data_ptr();
  prepared.run(true);
  return {of_state, of_actions, of_packed, of_tables};
}

int64_t panels(int64_t width) { return (width + gn::kPanel - 1) / gn::kPanel; }

// Counts the numbers of matrices [rows, columns] of `shapes`: plain, and packed.
std::pair<int64_t, int64_t> packed_counts(at::IntArrayRef shapes, bool weights) {
  constexpr int64_t kMost = int64_t(1) << 28;  // of rows or columns, so that products fit int64_t
  TORCH_CHECK_VALUE(shapes.size() % 2 == 0, "Shapes to pack are rows and columns of each matrix: not ", shapes.size(),
                    " numbers.");
  int64_t plain = 0, packed = 0;
  for (size_t i = 0; i < shapes.size(); i += 2) {
    const int64_t rows = shapes[i], columns = shapes[i + 1];
    TORCH_CHECK_VALUE(0 <= rows && rows <= kMost && 0 <= columns && columns <= kMost && packed <= int64_t(1) << 61,
                      "No matrix to pack has the shape [", rows, ", ", columns, "].");
    plain += rows * columns;
    packed += gn::kPanel * (weights ? panels(rows) * columns + panels(columns) * rows : rows * panels(columns));
  }
  return {plain, packed};
}

// Packs the numbers of consecutive matrices [rows, columns] of `shapes` in the engine's layout. Weights become panels
// of 16 rows, [rows / 16][columns][16], then panels of their transpose. Tables stay row by row. Both are padded with
// zeros to whole panels.
Tensor pack(const Tensor& numbers, at::IntArrayRef shapes, bool weights) {
  constexpr int64_t P = gn::kPanel;
  const auto [given, count] = packed_counts(shapes, weights);
  TORCH_CHECK_VALUE(is_number(numbers) && numbers.numel() == given, "Numbers to pack do not have the shapes given.");
  check_memory(numbers);
  const Tensor plain = numbers.contiguous(), packed = Pool::empty({count}, numbers.scalar_type()).zero_();
  auto fill = [&](auto zero) {
    using T = decltype(zero);
    const T* from = plain.const_data_ptr<T>();
    T* to = packed.data_ptr<T>();
    auto put = [&](int64_t rows, int64_t columns, int64_t row_step, int64_t column_step) {
      for (int64_t panel = 0; panel < panels(rows); panel++)
        for (int64_t c = 0; c < columns; c++, to += P)
          for (int64_t r = 0; r < std::min(P, rows - panel * P); r++)
            to[r] = from[(panel * P + r) * row_step + c * column_step];
    };
    for (size_t i = 0; i < shapes.size(); i += 2) {
      const int64_t rows = shapes[i], columns = shapes[i + 1];
      if (weights) {
        put(rows, columns, columns, 1);
        put(columns, rows, 1, columns);
      } else {
        for (int64_t r = 0; r < rows; r++, to += panels(columns) * P) std::copy_n(from + r * columns, columns, to);
      }
      from += rows * columns;
    }
  };
  if (numbers.scalar_type() == at::kDouble) fill(0.0);
  else fill(0.0f);
  return packed;
}

// The gradient of pack(). Transposed weights have no gradient.
Tensor unpack(const Tensor& packed, at::IntArrayRef shapes, bool weights) {
  constexpr int64_t P = gn::kPanel;
  std::vector<Tensor> parts;
  int64_t at = 0;
  for (size_t i = 0; i < shapes.size(); i += 2) {
    const int64_t rows = shapes[i], columns = shapes[i + 1];
    if (weights) {
      const Tensor own = packed.narrow(0, at, panels(rows) * P * columns).view({panels(rows), columns, P});
      parts.push_back(own.transpose(1, 2).flatten(0, 1).narrow(0, 0, rows).flatten());
      at += P * (panels(rows) * columns + panels(columns) * rows);
    } else {
      parts.push_back(packed.narrow(0, at, rows * panels(columns) * P).view({rows, -1}).narrow(1, 0, columns).flatten());
      at += rows * panels(columns) * P;
    }
  }
  return at::cat(parts);
}

// Updates matrices [rows, columns] and their momentum by Muon, in place; see training/muon.py.
void muon(at::TensorList parameters, at::TensorList gradients, at::TensorList moments, double momentum, double rate,
          at::ArrayRef<double> polynomials, int64_t threads) {
  TORCH_CHECK_VALUE(parameters.size() == gradients.size() && parameters.size() == moments.size() &&
                        polynomials.size() % 3 == 0,
                    "Muon needs a gradient and a moment of each parameter, and three coefficients a polynomial.");
  std::vector<gn::MuonMatrix> matrices;
  struct Span {
    const char *begin, *end;
    bool written;
  };
  std::vector<Span> spans;
  for (size_t i = 0; i < parameters.size(); ++i) {
    const Tensor& parameter = parameters[i];
    for (const Tensor* each : {&parameter, &gradients[i], &moments[i]}) {
      TORCH_CHECK_VALUE(each->is_cpu() && each->dim() == 2 && each->is_contiguous() &&
                            each->sizes() == parameter.sizes() &&
                            each->scalar_type() == parameters[0].scalar_type() && is_number(*each) && each->numel() > 0,
                        "Native Muon updates contiguous matrices of one dtype.");
      TORCH_CHECK(!(at::GradMode::is_enabled() && needs(*each)),
                  "Native Muon updates matrices in place, without gradients: call it under torch.no_grad().");
      check_memory(*each);
      const char* begin = static_cast<const char*>(each->const_data_ptr());
      spans.push_back({begin, begin + each->nbytes(), each != &gradients[i]});
    }
    matrices.push_back({parameter.data_ptr(), gradients[i].const_data_ptr(), moments[i].data_ptr(), parameter.size(0),
                        parameter.size(1)});
  }
  std::sort(spans.begin(), spans.end(), [](const Span& a, const Span& b) { return a.begin < b.begin; });
  Span last{nullptr, nullptr, false};  // earlier span with the last end; gradients may overlap each other
  const char* written = nullptr;       // last end of the earlier spans that are written
  for (const Span& each : spans) {
    TORCH_CHECK_VALUE(each.begin >= (each.written ? last.end : written),
                      "Matrices that native Muon updates share memory with others.");
    if (each.end > last.end) last = each;
    if (each.written) written = std::max(written, each.end);
  }
  for (const at::TensorList& some : {parameters, moments})
    for (const Tensor& each : some)
      if (!each.is_inference()) each.unsafeGetTensorImpl()->bump_version();
  const gn::MuonOptions options{momentum, rate, polynomials.data(), int64_t(polynomials.size() / 3)};
  const bool is_double = !parameters.empty() && parameters[0].scalar_type() == at::kDouble;
  gn::muon(is_double ? gn::kFloat64 : gn::kFloat32, matrices, options, thread_count(threads));
}

// Shape functions, for compilers.

// Rejects a mix of meta and other tensors, and states or actions of too few dimensions.
void check_shapes(const Tensor& states, int64_t state_dims, const Tensor& actions, int64_t action_dims,
                  std::initializer_list<const Tensor*> others, const OptionalTensor& sample_tables) {
  bool meta = states.is_meta() && actions.is_meta() && (!sample_tables.has_value() || sample_tables->is_meta());
  for (const Tensor* each : others) meta = meta && each->is_meta();
  TORCH_CHECK_NOT_IMPLEMENTED(meta, "Either all tensors of a native step are on the meta device, or none.");
  TORCH_CHECK_VALUE(states.dim() >= state_dims && actions.dim() == states.dim() - state_dims + action_dims,
                    "States or actions do not fit the native step: ", states.sym_sizes(), " and ",
                    actions.sym_sizes(), ".");
}

Tensor rollout_shape(const Tensor& state, const Tensor& actions, const Tensor& structure, const Tensor& weights,
                     const Tensor& tables, const OptionalTensor& sample_tables, const Tensor& numbers, int64_t channels,
                     bool many, int64_t) {
  check_shapes(state, 2, actions, 1 + many, {&structure, &weights, &tables, &numbers}, sample_tables);
  std::vector<c10::SymInt> shape = state.sym_sizes().vec();
  if (many) shape.insert(shape.end() - 2, actions.sym_size(-2) + 1);
  shape.back() = channels;
  return at::empty_symint(shape, state.options());
}

std::tuple<Tensor, Tensor> rollout_keeping_shape(const Tensor& state, const Tensor& actions, const Tensor& structure,
                                                 const Tensor& weights, const Tensor& tables,
                                                 const OptionalTensor& sample_tables, const Tensor& numbers,
                                                 int64_t channels, bool many, int64_t threads, int64_t) {
  return {rollout_shape(state, actions, structure, weights, tables, sample_tables, numbers, channels, many, threads),
          at::empty({0}, tables.options())};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> rollout_adjoint_shape(const Tensor& gradient, const Tensor& states,
                                                                 const Tensor& actions, const Tensor& structure,
                                                                 const Tensor& weights, const Tensor& tables,
                                                                 const OptionalTensor& sample_tables,
                                                                 const Tensor& numbers, const Tensor& stored, bool many,
                                                                 int64_t, bool of_weights, bool of_inputs) {
  check_shapes(states, 2 + many, actions, 1 + many, {&gradient, &structure, &weights, &tables, &numbers, &stored},
               sample_tables);
  std::vector<c10::SymInt> shape = states.sym_sizes().vec();
  if (many) shape.erase(shape.end() - 3);
  auto like = [&](const Tensor& tensor) {
    return of_weights ? at::empty_like(tensor) : at::empty({0}, tables.options());
  };
  if (!of_inputs) return {at::empty({0}, states.options()), at::empty({0}, actions.options()), like(weights), like(tables)};
  return {at::empty_symint(shape, states.options()), at::empty_symint(actions.sym_sizes(), actions.options()),
          like(weights), like(tables)};
}

Tensor pack_shape(const Tensor& numbers, at::IntArrayRef shapes, bool weights) {
  const auto [given, count] = packed_counts(shapes, weights);
  TORCH_CHECK_VALUE(numbers.sym_numel() == given, "Numbers to pack do not have the shapes given.");
  return at::empty({count}, numbers.options());
}

// Gradients.

template <class F>
auto typed(const char* name) {
  return c10::Dispatcher::singleton().findSchemaOrThrow(name, "").typed<F>();
}

// Identity whose gradient is an error.
struct FirstOrder : torch::autograd::Function<FirstOrder> {
  static variable_list forward(AutogradContext*, const Tensor& a, const Tensor& b, const Tensor& c, const Tensor& d,
                               const Tensor& gradient, const Tensor& states, const Tensor& actions,
                               const Tensor& weights, const Tensor& tables) {
    return {a.view_as(a), b.view_as(b), c.view_as(c), d.view_as(d)};
  }
  static variable_list backward(AutogradContext*, variable_list) {
    TORCH_CHECK(false, "Native gradients are of first order. For those of second, specialise with executor='eager', or",
                " bind the model with reference=True.");
  }
};

std::tuple<Tensor, Tensor, Tensor, Tensor> adjoint_autograd(const Tensor& gradient, const Tensor& states,
                                                            const Tensor& actions, const Tensor& structure,
                                                            const Tensor& weights, const Tensor& tables,
                                                            const OptionalTensor& sample_tables, const Tensor& numbers,
                                                            const Tensor& stored, bool many, int64_t threads,
                                                            bool of_weights, bool of_inputs) {
  static const auto op = typed<decltype(rollout_adjoint)>("torchrl_gn::rollout_adjoint");
  auto found = [&] {
    at::AutoDispatchBelowADInplaceOrView guard;
    return op.call(gradient, states, actions, structure, weights, tables, sample_tables, numbers, stored, many, threads,
                   of_weights, of_inputs);
  }();
  const bool differentiable = needs(gradient) || needs(states) || needs(actions) || needs(weights) || needs(tables);
  if (!at::GradMode::is_enabled() || !differentiable) return found;
  auto [a, b, c, d] = found;
  const variable_list out = FirstOrder::apply(a, b, c, d, gradient, states, actions, weights, tables);
  return {out[0], out[1], out[2], out[3]};
}

struct Rollout : torch::autograd::Function<Rollout> {
  static Tensor forward(AutogradContext* context, const Tensor& state, const Tensor& actions, const Tensor& structure,
                        const Tensor& weights, const Tensor& tables, const OptionalTensor& sample_tables,
                        const Tensor& numbers, int64_t channels, bool many, int64_t threads) {
    static const auto op = typed<decltype(rollout_keeping)>("torchrl_gn::rollout_keeping");
    const bool of_weights = needs(weights) || needs(tables);
    threads = thread_count(threads);  // the layout of the kept numbers depends on it
    TORCH_CHECK(!needs(numbers) && !(sample_tables.has_value() && needs(*sample_tables)),
                "There is no native gradient in physical parameters: use executor='eager'.");
    // Compiled code keeps nothing, because the kept size depends on the states. Its gradients recompute the steps.
    const bool traced = c10::impl::TorchDispatchModeTLS::any_modes_set();
    const int64_t keep = traced || (of_weights && many) ? kNothing : of_weights ? kAll : kSlopes;
    at::AutoDispatchBelowADInplaceOrView guard;
    auto [out, stored] = op.call(state, actions, structure, weights, tables, sample_tables, numbers, channels, many,
                                 threads, keep);
    const Tensor own = sample_tables.has_value() ? *sample_tables : Tensor();
    context->save_for_backward({many ? out : state, actions, structure, weights, tables, own, numbers});
    context->saved_data["stored"] = stored;
    context->saved_data["many"] = many;
    context->saved_data["threads"] = threads;
    context->saved_data["of_weights"] = of_weights;
    context->saved_data["of_inputs"] = needs(state) || needs(actions);
    return out;
  }
  static variable_list backward(AutogradContext* context, variable_list gradients) {
    static const auto op = typed<decltype(rollout_adjoint)>("torchrl_gn::rollout_adjoint");
    const variable_list saved = context->get_saved_variables();
    const OptionalTensor own = saved[5].defined() ? OptionalTensor(saved[5]) : std::nullopt;
    const bool many = context->saved_data["many"].toBool();
    const bool trained = context->saved_data["of_weights"].toBool(), moved = context->saved_data["of_inputs"].toBool();
    auto [of_state, of_actions, of_weights, of_tables] = [&] {
      try {
        return op.call(gradients[0], saved[0], saved[1], saved[2], saved[3], saved[4], own, saved[6],
                       context->saved_data["stored"].toTensor(), many, context->saved_data["threads"].toInt(), trained,
                       moved);
      } catch (const std::bad_alloc&) {  // autograd would turn it into a RuntimeError
        TORCH_CHECK_WITH(OutOfMemoryError, false, "There is not enough memory for the gradient of a native step.");
      }
    }();
    return {moved ? of_state : Tensor(), moved ? of_actions : Tensor(), Tensor(), trained ? of_weights : Tensor(), trained ? of_tables : Tensor(),
            Tensor(), Tensor(), Tensor(), Tensor(), Tensor()};
  }
};

Tensor rollout_autograd(const Tensor& state, const Tensor& actions, const Tensor& structure, const Tensor& weights,
                        const Tensor& tables, const OptionalTensor& sample_tables, const Tensor& numbers,
                        int64_t channels, bool many, int64_t threads) {
  static const auto op = typed<decltype(rollout)>("torchrl_gn::rollout");
  if (at::GradMode::is_enabled() && (needs(state) || needs(actions) || needs(weights) || needs(tables) ||
                                     needs(numbers) || (sample_tables.has_value() && needs(*sample_tables))))
    return Rollout::apply(state, actions, structure, weights, tables, sample_tables, numbers, channels, many, threads);
  at::AutoDispatchBelowADInplaceOrView guard;
  return op.call(state, actions, structure, weights, tables, sample_tables, numbers, channels, many, threads);
}

struct Pack : torch::autograd::Function<Pack> {
  static Tensor forward(AutogradContext* context, const Tensor& numbers, const std::vector<int64_t>& shapes, bool weights) {
    static const auto op = typed<decltype(pack)>("torchrl_gn::pack");
    context->saved_data["shapes"] = shapes;
    context->saved_data["weights"] = weights;
    at::AutoDispatchBelowADInplaceOrView guard;
    return op.call(numbers, shapes, weights);
  }
  static variable_list backward(AutogradContext* context, variable_list gradients) {
    const auto shapes = context->saved_data["shapes"].toIntVector();
    return {unpack(gradients[0], shapes, context->saved_data["weights"].toBool()), Tensor(), Tensor()};
  }
};

Tensor pack_autograd(const Tensor& numbers, at::IntArrayRef shapes, bool weights) {
  return Pack::apply(numbers, shapes.vec(), weights);
}

}  // namespace

TORCH_LIBRARY(torchrl_gn, library) {
  library.def(
      "rollout(Tensor state, Tensor actions, Tensor structure, Tensor weights, Tensor tables, Tensor? sample_tables,"
      " Tensor numbers, int channels, bool many, int threads) -> Tensor");
  library.def(
      "rollout_keeping(Tensor state, Tensor actions, Tensor structure, Tensor weights, Tensor tables,"
      " Tensor? sample_tables, Tensor numbers, int channels, bool many, int threads, int keep) -> (Tensor, Tensor)");
  library.def(
      "rollout_adjoint(Tensor gradient, Tensor states, Tensor actions, Tensor structure, Tensor weights, Tensor tables,"
      " Tensor? sample_tables, Tensor numbers, Tensor stored, bool many, int threads, bool of_weights, bool of_inputs)"
      " -> (Tensor, Tensor, Tensor, Tensor)");
  library.def("pack(Tensor numbers, int[] shapes, bool weights) -> Tensor");
  library.def(
      "muon_(Tensor(a!)[] parameters, Tensor[] gradients, Tensor(b!)[] moments, float momentum, float rate,"
      " float[] polynomials, int threads) -> ()");
  library.def("has_bfloat16() -> bool", gn::has_bfloat16);
}

TORCH_LIBRARY_IMPL(torchrl_gn, CPU, library) {
  library.impl("rollout", rollout);
  library.impl("rollout_keeping", rollout_keeping);
  library.impl("rollout_adjoint", rollout_adjoint);
  library.impl("pack", pack);
  library.impl("muon_", muon);
}

TORCH_LIBRARY_IMPL(torchrl_gn, Meta, library) {
  library.impl("rollout", rollout_shape);
  library.impl("rollout_keeping", rollout_keeping_shape);
  library.impl("rollout_adjoint", rollout_adjoint_shape);
  library.impl("pack", pack_shape);
}

TORCH_LIBRARY_IMPL(torchrl_gn, Autograd, library) {
  library.impl("rollout", rollout_autograd);
  library.impl("rollout_adjoint", adjoint_autograd);
  library.impl("pack", pack_autograd);
}
