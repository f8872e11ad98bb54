// A device "fakegpu" that computes as the CPU does, and mixes with it as little as a GPU.
//
// It is PyTorch's PrivateUse1, with memory, devices and generators of its own. The CPU runs its operations on copies,
// once they have passed the checks of CUDA: all tensors on one device, generators of that device. Where a host would
// wait for a GPU is counted, or refused.

#include <ATen/ATen.h>
#include <ATen/CPUGeneratorImpl.h>
#include <ATen/EmptyTensor.h>
#include <ATen/core/enum_tag.h>
#include <ATen/detail/PrivateUse1HooksInterface.h>
#include <ATen/native/CPUFallback.h>
#include <ATen/ops/_reshape_alias_native.h>
#include <ATen/ops/as_strided_native.h>
#include <ATen/ops/resize_native.h>
#include <ATen/ops/set_native.h>
#include <ATen/ops/unfold_native.h>
#include <ATen/ops/view_native.h>
#include <c10/core/impl/DeviceGuardImplInterface.h>
#include <torch/library.h>

#include <atomic>
#include <cstdlib>
#include <cstring>
#include <string>
#include <unordered_set>

namespace {

using at::Tensor;
using Sizes = c10::IntArrayRef;
using Bias = std::optional<Tensor>;

constexpr auto kType = c10::DeviceType::PrivateUse1;
constexpr c10::DispatchKeySet kKeys(c10::DispatchKey::PrivateUse1);
constexpr c10::DeviceIndex kCount = 2;
thread_local c10::DeviceIndex current = 0;

// ---- where the host waits

std::atomic<int64_t> refusing{0}, waits{0};

void waiting(const std::string& why) {
  ++waits;
  TORCH_CHECK(!refusing, "The host waits for the device: ", why);
}

// ---- memory, devices, streams, generators

struct Memory final : c10::Allocator {
  c10::DataPtr allocate(size_t bytes) override {
    void* data = bytes ? std::malloc(bytes) : nullptr;
    TORCH_CHECK(data || !bytes, "The device has no memory left.");
    return {data, data, &std::free, c10::Device(kType, current)};
  }
  c10::DeleterFnPtr raw_deleter() const override { return &std::free; }
  void copy_data(void* to, const void* from, std::size_t bytes) const final { default_copy_data(to, from, bytes); }
};
Memory memory;
REGISTER_ALLOCATOR(kType, &memory);

struct Guard final : c10::impl::DeviceGuardImplInterface {
  c10::DeviceType type() const override { return kType; }
  c10::Device getDevice() const override { return {kType, current}; }
  c10::Device exchangeDevice(c10::Device device) const override {
    const auto before = getDevice();
    setDevice(device);
    return before;
  }
  void setDevice(c10::Device device) const override {
    if (device.has_index()) current = device.index();
  }
  void uncheckedSetDevice(c10::Device device) const noexcept override { setDevice(device); }
  c10::Stream getStream(c10::Device device) const override { return c10::Stream(c10::Stream::DEFAULT, device); }
  c10::Stream getDefaultStream(c10::Device device) const override { return getStream(device); }
  c10::Stream exchangeStream(c10::Stream stream) const override { return stream; }
  c10::DeviceIndex deviceCount() const noexcept override { return kCount; }
  bool queryStream(const c10::Stream&) const override { return true; }
  void synchronizeStream(const c10::Stream&) const override {}
  void synchronizeDevice(const c10::DeviceIndex) const override {}
  void record(void**, const c10::Stream&, const c10::DeviceIndex, const c10::EventFlag) const override {}
  void block(void*, const c10::Stream&) const override {}
  bool queryEvent(void*) const override { return true; }
};
C10_REGISTER_GUARD_IMPL(PrivateUse1, Guard);

struct Random final : at::CPUGeneratorImpl {  // draws what the CPU's draws from the same seed
  explicit Random(c10::DeviceIndex index) {
    device_ = c10::Device(kType, index);
    key_set_ = kKeys;
  }
};

struct Hooks final : at::PrivateUse1HooksInterface {
  bool isBuilt() const override { return true; }
  bool isAvailable() const override { return true; }
  bool hasPrimaryContext(c10::DeviceIndex) const override { return true; }
  c10::DeviceIndex deviceCount() const override { return kCount; }
  c10::DeviceIndex getCurrentDevice() const override { return current; }
  void setCurrentDevice(c10::DeviceIndex index) const override { current = index; }
  const at::Generator& getDefaultGenerator(c10::DeviceIndex) const override {
    return at::detail::getDefaultCPUGenerator();
  }
  at::Generator getNewGenerator(c10::DeviceIndex index) const override {
    return at::make_generator<Random>(index < 0 ? current : index);
  }
  c10::Allocator* getPinnedMemoryAllocator() const override { return c10::GetAllocator(c10::kCPU); }
  void resizePrivateUse1Bytes(const c10::Storage& storage, size_t bytes) const override {
    auto fresh = memory.allocate(bytes);
    std::memcpy(fresh.get(), storage.data(), std::min(bytes, storage.nbytes()));
    storage.set_data_ptr_noswap(std::move(fresh));
    storage.unsafeGetStorageImpl()->set_nbytes(bytes);
  }
};

// ---- tensors

thread_local bool inside = false;  // copies for the CPU that computes are none that a GPU would make

template <typename Function>
auto within(const Function& function) {
  struct Scope {
    bool before = std::exchange(inside, true);
    ~Scope() { inside = before; }
  } scope;
  return function();
}

Tensor on_cpu(const Tensor& tensor) {  // of the same memory
  if (tensor.is_cpu()) return tensor;
  return at::from_blob(tensor.data_ptr(), tensor.sizes(), tensor.strides(), tensor.options().device(at::kCPU));
}

Tensor empty(Sizes size, std::optional<c10::ScalarType> dtype, std::optional<c10::Layout>,
             std::optional<c10::Device> device, std::optional<bool>, std::optional<c10::MemoryFormat> format) {
  const c10::DeviceGuard guard(c10::device_or_default(device));
  return at::detail::empty_generic(size, &memory, kKeys, c10::dtype_or_default(dtype), format);
}

Tensor empty_strided(Sizes size, Sizes stride, std::optional<c10::ScalarType> dtype, std::optional<c10::Layout>,
                     std::optional<c10::Device> device, std::optional<bool>) {
  const c10::DeviceGuard guard(c10::device_or_default(device));
  return at::detail::empty_strided_generic(size, stride, &memory, kKeys, c10::dtype_or_default(dtype));
}

Tensor copy_from(const Tensor& from, const Tensor& to, bool non_blocking) {
  if (!inside && !non_blocking && from.is_cpu() != to.is_cpu())
    waiting(from.is_cpu() ? "a copy to it" : "a copy from it");
  on_cpu(to).copy_(on_cpu(from));
  return to;
}

Tensor copy_and_resize(const Tensor& from, const Tensor& to) {
  at::native::resize_(to, from.sizes(), std::nullopt);
  return copy_from(from, to, false);
}

at::Scalar item(const Tensor& tensor) {
  waiting("item()");
  return on_cpu(tensor).item();
}

Tensor as_strided(const Tensor& self, Sizes size, Sizes stride, std::optional<int64_t> offset) {
  return at::native::as_strided_tensorimpl(self, size, stride, offset);
}

Tensor& set_storage(Tensor& self, c10::Storage storage, int64_t offset, Sizes size, Sizes stride) {
  return at::native::set_storage_cpu_(self, storage, offset, size, stride);
}

// ---- operations

void check_devices(const c10::OperatorHandle& op, const torch::jit::Stack& stack, std::size_t count) {
  const auto& name = op.schema().name();
  const auto has = [&](const char* part) { return name.find(part) != std::string::npos; };
  const bool indexes = has("index") && !has("index_select");
  std::optional<c10::Device> device;
  std::vector<Tensor> from_cpu;
  int tensors = 0;
  const auto see = [&](const Tensor& tensor, bool index) {
    if (!tensor.defined()) return;
    ++tensors;
    if (index && tensor.is_cpu()) return waiting("indices of the host");  // which CUDA takes, as a copy
    if (index && tensor.scalar_type() == at::kBool) waiting("indexing by a mask");
    if (tensor.is_cpu()) return from_cpu.push_back(tensor);
    TORCH_CHECK(device.value_or(tensor.device()) == tensor.device(), "Expected all tensors to be on the same device, ",
                "but found ", *device, " and ", tensor.device(), " in ", name);
    device = tensor.device();
  };
  for (const auto& value : torch::jit::last(stack, count)) {
    if (value.isTensor()) see(value.toTensor(), false);
    else if (value.isTensorList())
      for (const Tensor& each : value.toTensorVector()) see(each, false);
    else if (value.isOptionalTensorList())
      for (const Bias& each : value.toOptionalTensorVector())
        if (each) see(*each, true);
  }
  // CUDA takes a number that is a tensor of the CPU where two tensors are combined entry by entry.
  const bool two = op.hasTag(at::Tag::pointwise) && tensors <= 3;  // and a result
  const bool numbers = two || name == "aten::where" || indexes || has("fill");
  for (const auto& each : from_cpu)
    TORCH_CHECK(numbers && each.dim() == 0, "Expected all tensors to be on the same device, but found ",
                device.value_or(at::kCPU), " and cpu in ", name);
}

void run(const c10::OperatorHandle& op, torch::jit::Stack* stack) {
  static const std::unordered_set<std::string> sizes = {  // of results depend on numbers
      "aten::nonzero", "aten::masked_select", "aten::equal", "aten::_unique2", "aten::unique_consecutive",
      "aten::unique_dim", "aten::repeat_interleave", "aten::is_nonzero", "aten::bincount"};
  const auto& name = op.schema().name();
  const auto count = op.schema().arguments().size();
  TORCH_CHECK_NOT_IMPLEMENTED(name.rfind("aten::", 0) == 0, "Could not run '", name, "' with arguments from fakegpu.");
  check_devices(op, *stack, count);
  if (sizes.count(name)) waiting(name);
  at::Generator own, drawn;
  for (auto& value : torch::jit::last(*stack, count)) {
    if (!value.isGenerator()) continue;
    own = value.toGenerator();
    TORCH_CHECK(own.device().type() == kType, "Expected a fakegpu generator but found ", own.device(), " in ", name);
    drawn = at::make_generator<at::CPUGeneratorImpl>();
    drawn.set_state(own.get_state());
    const_cast<c10::IValue&>(value) = drawn;
  }
  within([&] { at::native::cpu_fallback(op, stack, /*error_on_views=*/true); });
  if (own.defined()) own.set_state(drawn.get_state());
}

// PyTorch has no CPU kernel under these names.

Tensor on_device(const Tensor& tensor, c10::Device device) {
  return tensor.defined() ? within([&] { return tensor.to(device); }) : tensor;
}

Tensor convolve(const Tensor& input, const Tensor& weight, const Bias& bias, Sizes stride, Sizes padding,
                Sizes dilation, bool transposed, Sizes output_padding, int64_t groups) {
  const auto own = bias && bias->defined() ? Bias(on_cpu(*bias)) : std::nullopt;
  return on_device(at::convolution(on_cpu(input), on_cpu(weight), own, stride, padding, dilation, transposed,
                                   output_padding, groups), input.device());
}

// What CUDA's cell keeps for the gradient: r, z, n, the hidden state, and its gates of n.
std::tuple<Tensor, Tensor> gru(const Tensor& inputs, const Tensor& hiddens, const Tensor& hidden,
                               const Bias& input_bias, const Bias& hidden_bias) {
  const auto gates = [](const Tensor& of, const Bias& bias) {
    return (bias && bias->defined() ? of + *bias : of).chunk(3, 1);
  };
  const auto from = gates(inputs, input_bias), back = gates(hiddens, hidden_bias);
  const auto r = (from[0] + back[0]).sigmoid(), z = (from[1] + back[1]).sigmoid();
  const auto n = (from[2] + r * back[2]).tanh();
  return {n + z * (hidden - n), at::cat({r, z, n, hidden, back[2]}, 1)};
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> gru_backward(const Tensor& gradient, const Tensor& kept, bool bias) {
  const auto of = kept.chunk(5, 1);
  const auto &r = of[0], &z = of[1], &n = of[2], &hidden = of[3], &back = of[4];
  const auto to_n = gradient * (1 - z) * (1 - n * n), to_z = gradient * (hidden - n) * z * (1 - z);
  const auto to_r = to_n * back * r * (1 - r);
  const auto inputs = at::cat({to_r, to_z, to_n}, 1), hiddens = at::cat({to_r, to_z, to_n * r}, 1);
  return {inputs, hiddens, gradient * z, bias ? inputs.sum(0) : Tensor(), bias ? hiddens.sum(0) : Tensor()};
}

TORCH_LIBRARY_IMPL(aten, PrivateUse1, m) {
  m.impl("empty.memory_format", empty);
  m.impl("empty_strided", empty_strided);
  m.impl("as_strided", as_strided);
  m.impl("view", TORCH_FN(at::native::view));
  m.impl("unfold", TORCH_FN(at::native::unfold));
  m.impl("_reshape_alias", TORCH_FN(at::native::_reshape_alias));
  m.impl("resize_", TORCH_FN(at::native::resize_));
  m.impl("set_.source_Tensor", TORCH_FN(at::native::set_tensor_));
  m.impl("set_.source_Storage", TORCH_FN(at::native::set_));
  m.impl("set_.source_Storage_storage_offset", set_storage);
  m.impl("_copy_from", copy_from);
  m.impl("_copy_from_and_resize", copy_and_resize);
  m.impl("_local_scalar_dense", item);
  m.impl("convolution_overrideable", convolve);
  m.impl("_thnn_fused_gru_cell", gru);
  m.impl("_thnn_fused_gru_cell_backward", gru_backward);
}

TORCH_LIBRARY_IMPL(_, PrivateUse1, m) { m.fallback(torch::CppFunction::makeFromBoxedFunction<&run>()); }
TORCH_LIBRARY_IMPL(_, AutocastPrivateUse1, m) { m.fallback(torch::CppFunction::makeFallthrough()); }

TORCH_LIBRARY(fake_gpu, m) {
  m.def("register() -> ()", [] {
    static Hooks hooks;
    at::RegisterPrivateUse1HooksInterface(&hooks);
  });
  m.def("refuse(bool waits) -> ()", [](bool wanted) { refusing = wanted; });
  m.def("waits() -> int", [] { return waits.load(); });
}

}  // namespace
