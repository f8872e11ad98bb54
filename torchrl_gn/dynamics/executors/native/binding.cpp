// A single step, and its gradient, called from Python: by ctypes and Python's autograd functions, reading the tensors,
// asking whether weights changed and keeping what a gradient needs take longer than the step of one state.
#include <Python.h>

#include <ATen/Parallel.h>
#include <ATen/PythonTorchFunctionTLS.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <c10/core/GradMode.h>
#include <c10/core/impl/LocalDispatchKeySet.h>
#include <c10/core/impl/TorchDispatchModeTLS.h>
#include <torch/csrc/Exceptions.h>
#include <torch/csrc/autograd/functions/basic_ops.h>
#include <torch/csrc/autograd/functions/utils.h>
#include <torch/csrc/autograd/python_variable.h>
#include <torch/csrc/autograd/saved_variable.h>

#include <algorithm>
#include <cstdint>
#include <memory>
#include <type_traits>
#include <vector>

#include "call.h"

namespace {

using gn::Array;
using gn::Call;
using torch::autograd::Node;
using torch::autograd::variable_list;
using Owner = decltype(torch::autograd::Edge::function);  // shared_ptr or, in newer torch, intrusive_ptr
using Run = int64_t (*)(const void* network, int64_t kind, const void* maths, const Call* call);
using RunAdjoint = void (*)(const void* network, int64_t kind, const void* maths, const Call* call);

constexpr const char* kName = "torchrl_gn.step";

struct WithGil {
  PyGILState_STATE state = PyGILState_Ensure();
  ~WithGil() { PyGILState_Release(state); }
};

// What a step needs, and the tensors that it was made of.
struct Plan {
  PyObject *kept, *prepare, *executor, *attributes, *owners, *names, *tensors;  // owned
  std::vector<uint32_t> versions;
  std::vector<at::ScalarType> types;
  long version, casts;
  Run run;
  RunAdjoint run_adjoint;
  const void *network, *maths;
  int64_t kind, stored, tile, nodes, channels, actions;
  bool prepared = false;  // for gradients

  ~Plan() {
    if (!Py_IsInitialized()) return;
    WithGil gil;
    for (PyObject* each : {kept, prepare, executor, attributes, owners, names, tensors}) Py_XDECREF(each);
  }
  static bool is(PyObject* attributes, const char* name, long value) {
    PyObject* now = PyDict_GetItemString(attributes, name);
    return now && PyLong_AsLong(now) == value;
  }
  // As Watched.unchanged, and that no module was cast.
  bool is_current() const {
    if (!is(attributes, "casts", casts)) return false;
    for (size_t i = 0; i < versions.size(); ++i) {
      PyObject* one = PyTuple_GET_ITEM(tensors, i);
      if (PyDict_GetItem(PyTuple_GET_ITEM(owners, i), PyTuple_GET_ITEM(names, i)) != one) return false;
      const at::Tensor& tensor = THPVariable_Unpack(one);
      if (tensor._version() != versions[i] || tensor.scalar_type() != types[i]) return false;
    }
    return true;
  }
  // Whether gradients can be computed; if not, a Python error is set.
  bool prepare_gradients() {
    if (prepared) return true;
    PyObject* done = PyObject_CallNoArgs(prepare);
    Py_XDECREF(done);
    return prepared = done != nullptr;
  }
};
using PlanPointer = std::shared_ptr<Plan>;

// Whether something must see every operation: a mode, a tracer, a transform of torch.func.
bool observed() {
  using c10::DispatchKey;
  const auto included = c10::impl::tls_local_dispatch_key_set().included_;
  return c10::impl::TorchDispatchModeTLS::any_modes_set() || at::impl::torch_function_mode_enabled() ||
         included.has_any(c10::DispatchKeySet({DispatchKey::FuncTorchDynamicLayerFrontMode, DispatchKey::Tracer}));
}

bool is_plain(const at::Tensor& tensor) {
  const auto type = tensor.scalar_type();
  return tensor.has_storage() && tensor.is_cpu() && tensor.layout() == at::kStrided &&
         (type == at::kFloat || type == at::kDouble) && tensor.is_contiguous() && tensor.numel() > 0 &&
         !tensor._fw_grad(0).defined();
}

Array array(const at::Tensor& tensor) {
  return {const_cast<void*>(tensor.const_data_ptr()), tensor.scalar_type() == at::kDouble};
}

Call make_call(const Plan& plan, const at::Tensor& state, const at::Tensor& action, const at::Tensor& out) {
  Call call{};
  const int64_t size = plan.nodes * plan.channels;
  call.batch = state.numel() / size;
  call.steps = 1;
  call.threads = at::get_num_threads();
  call.tile = std::min(plan.tile, (call.batch + call.threads - 1) / call.threads);
  call.states = array(state);
  call.state_stride = size;
  call.actions = array(action);
  call.out = array(out);
  return call;
}

struct SpecializedStepBackward : Node {
  PlanPointer plan;
  torch::autograd::SavedVariable state, action;
  at::Tensor stored;
  Call call;

  std::string name() const override { return "SpecializedStepBackward"; }
  void release_variables() override { state.reset_data(), action.reset_data(); }

  variable_list apply(variable_list&& gradients) override {
    if (!gradients[0].defined()) return variable_list(2);
    const at::Tensor x = state.unpack(), u = action.unpack();  // refuses what was freed, or changed in place
    {
      WithGil gil;
      if (!Plan::is(plan->executor, "version", plan->version))
        throw std::runtime_error("The model's weights changed between a prediction and its gradient; predict again.");
    }
    const bool differentiable = at::GradMode::is_enabled();
    variable_list found;
    {
      at::NoGradGuard no_grad;
      const at::Tensor gradient = gradients[0].contiguous();
      TORCH_CHECK(is_plain(gradient), "A native step takes no such gradient; use executor='eager'.");
      found = {at::empty_like(x), at::empty_like(u)};
      Call adjoint = call;
      adjoint.states = array(x), adjoint.actions = array(u), adjoint.out = array(gradient);
      adjoint.grad_state = array(found[0]), adjoint.grad_actions = array(found[1]);
      plan->run_adjoint(plan->network, plan->kind, plan->maths, &adjoint);
    }
    if (!differentiable) return found;
    const char* message = "Native gradients are of first order; use executor='eager'.";
    auto error = own<Owner>(new torch::autograd::Error(message, torch::autograd::collect_next_edges(x, u)));
    for (at::Tensor& each : found) torch::autograd::set_history(each, error);
    return found;
  }

  template <class P>
  static P own(Node* node) {
    if constexpr (std::is_same_v<P, std::shared_ptr<Node>>) return P(node, [](Node* one) { delete one; });
    else return P::unsafe_steal_from_new(node);
  }
};

// step(plan, state, action): the next state; None if the general way must predict it, or refuse it.
PyObject* step(PyObject*, PyObject* const* given, Py_ssize_t count) {
  HANDLE_TH_ERRORS
  if (count != 3) return PyErr_Format(PyExc_TypeError, "step takes a plan, a state and an action");
  const auto* pointer = static_cast<const PlanPointer*>(PyCapsule_GetPointer(given[0], kName));
  if (!pointer) return nullptr;
  const PlanPointer plan = *pointer;
  if (!THPVariable_CheckExact(given[1]) || !THPVariable_CheckExact(given[2]) || observed()) Py_RETURN_NONE;
  const at::Tensor &state = THPVariable_Unpack(given[1]), &action = THPVariable_Unpack(given[2]);
  const int64_t dims = state.dim();
  if (!is_plain(state) || !is_plain(action) || dims < 2 || action.dim() != dims - 1 ||
      state.size(-2) != plan->nodes || state.size(-1) != plan->channels || action.size(-1) != plan->actions ||
      !state.sizes().slice(0, dims - 2).equals(action.sizes().slice(0, dims - 2)) || !plan->is_current())
    Py_RETURN_NONE;
  const bool differentiable = at::GradMode::is_enabled() && (state.requires_grad() || action.requires_grad());
  at::Tensor out, stored;
  Call call;
  {
    at::NoGradGuard no_grad;
    out = at::empty_like(state);
    call = make_call(*plan, state, action, out);
    if (differentiable) {
      if (call.batch > plan->tile) Py_RETURN_NONE;  // more to keep for the gradient: the general way has a pool for it
      if (!plan->prepare_gradients()) return nullptr;
      stored = at::empty({call.batch * plan->stored}, at::dtype(plan->kind == 1 ? at::kDouble : at::kFloat));
      call.stored = stored.data_ptr();
    }
  }
  int64_t other;
  Py_BEGIN_ALLOW_THREADS
  other = plan->run(plan->network, plan->kind, plan->maths, &call);
  Py_END_ALLOW_THREADS
  if (other) Py_RETURN_NONE;
  if (differentiable) {
    auto* node = new SpecializedStepBackward;
    const Owner owner = SpecializedStepBackward::own<Owner>(node);
    node->plan = plan, node->stored = stored, node->call = call;
    node->state = torch::autograd::SavedVariable(state, false);
    node->action = torch::autograd::SavedVariable(action, false);
    node->set_next_edges(torch::autograd::collect_next_edges(state, action));
    torch::autograd::set_history(out, owner);
  }
  return THPVariable_Wrap(out);
  END_HANDLE_TH_ERRORS
}

void forget(PyObject* capsule) { delete static_cast<PlanPointer*>(PyCapsule_GetPointer(capsule, kName)); }

// make_plan(kept, prepare, executor, version, attributes, casts, owners, names, tensors, versions, run, run_adjoint,
//           network, kind, stored, maths, tile, nodes, channels, actions)
PyObject* make_plan(PyObject*, PyObject* given) {
  PyObject *kept, *prepare, *executor, *attributes, *owners, *names, *tensors, *versions;
  long version, casts;
  unsigned long long run, run_adjoint, network, maths;
  long long kind, stored, tile, nodes, channels, actions;
  if (!PyArg_ParseTuple(given, "OOO!lO!lO!O!O!O!KKKLLKLLLL", &kept, &prepare, &PyDict_Type, &executor, &version,
                        &PyDict_Type, &attributes, &casts, &PyTuple_Type, &owners, &PyTuple_Type, &names, &PyTuple_Type,
                        &tensors, &PyList_Type, &versions, &run, &run_adjoint, &network, &kind, &stored, &maths, &tile,
                        &nodes, &channels, &actions))
    return nullptr;
  auto plan = std::make_shared<Plan>();
  plan->kept = kept, plan->prepare = prepare, plan->executor = executor, plan->attributes = attributes;
  plan->owners = owners, plan->names = names, plan->tensors = tensors;
  for (PyObject* each : {kept, prepare, executor, attributes, owners, names, tensors}) Py_INCREF(each);
  plan->version = version, plan->casts = casts;
  plan->run = reinterpret_cast<Run>(run), plan->run_adjoint = reinterpret_cast<RunAdjoint>(run_adjoint);
  plan->network = reinterpret_cast<const void*>(network), plan->maths = reinterpret_cast<const void*>(maths);
  plan->kind = kind, plan->stored = stored, plan->tile = tile;
  plan->nodes = nodes, plan->channels = channels, plan->actions = actions;
  for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(tensors); ++i) {
    plan->versions.push_back(PyLong_AsUnsignedLong(PyList_GET_ITEM(versions, i)));
    plan->types.push_back(THPVariable_Unpack(PyTuple_GET_ITEM(tensors, i)).scalar_type());
  }
  return PyCapsule_New(new PlanPointer(plan), kName, forget);
}

PyMethodDef methods[] = {
    {"make_plan", make_plan, METH_VARARGS, nullptr},
    {"step", reinterpret_cast<PyCFunction>(reinterpret_cast<void*>(step)), METH_FASTCALL, nullptr},
    {nullptr, nullptr, 0, nullptr},
};
PyModuleDef definition = {PyModuleDef_HEAD_INIT, "torchrl_gn_binding", nullptr, -1, methods};

}  // namespace

PyMODINIT_FUNC PyInit_torchrl_gn_binding() { return PyModule_Create(&definition); }
