// A single step called from Python: by ctypes, reading the tensors and asking whether weights changed takes longer
// than half the step of one state.
#include <Python.h>

#include <ATen/Parallel.h>
#include <ATen/PythonTorchFunctionTLS.h>
#include <ATen/ops/empty_like.h>
#include <c10/core/GradMode.h>
#include <c10/core/impl/LocalDispatchKeySet.h>
#include <c10/core/impl/TorchDispatchModeTLS.h>
#include <torch/csrc/Exceptions.h>
#include <torch/csrc/autograd/python_variable.h>

#include <algorithm>
#include <cstdint>
#include <vector>

namespace {

// As in rollout.h.
struct Array {
  void* data;
  int64_t is_double;
};
struct Call {
  int64_t batch, steps, tile, threads;
  Array states;
  int64_t state_stride;
  Array actions, out;
  int64_t with_start;
  Array grad_state, grad_actions;
  void* stored;
  int64_t train;
  void *grad_weights, *grad_tables;
};
using Run = int64_t (*)(const void* network, int64_t kind, const void* maths, const Call* call);

constexpr const char* kName = "torchrl_gn.step";

// What a step needs, and the tensors that it was made of.
struct Plan {
  PyObject *kept, *attributes, *owners, *names, *tensors;  // owned
  std::vector<uint32_t> versions;
  std::vector<at::ScalarType> types;
  long casts;
  Run run;
  const void *network, *maths;
  int64_t kind, tile, nodes, channels, actions;

  ~Plan() {
    for (PyObject* each : {kept, attributes, owners, names, tensors}) Py_XDECREF(each);
  }
  // As Watched.unchanged, and that no module was cast.
  bool is_current() const {
    PyObject* now = PyDict_GetItemString(attributes, "casts");
    if (!now || PyLong_AsLong(now) != casts) return false;
    for (size_t i = 0; i < versions.size(); ++i) {
      PyObject* one = PyTuple_GET_ITEM(tensors, i);
      if (PyDict_GetItem(PyTuple_GET_ITEM(owners, i), PyTuple_GET_ITEM(names, i)) != one) return false;
      const at::Tensor& tensor = THPVariable_Unpack(one);
      if (tensor._version() != versions[i] || tensor.scalar_type() != types[i]) return false;
    }
    return true;
  }
};

// Whether something must see every operation: a mode, a tracer, a transform of torch.func.
bool observed() {
  using c10::DispatchKey;
  const auto included = c10::impl::tls_local_dispatch_key_set().included_;
  return c10::impl::TorchDispatchModeTLS::any_modes_set() || at::impl::torch_function_mode_enabled() ||
         included.has_any(c10::DispatchKeySet({DispatchKey::FuncTorchDynamicLayerFrontMode, DispatchKey::Tracer}));
}

bool is_plain(const at::Tensor& tensor) {
  const auto type = tensor.scalar_type();
  return tensor.is_cpu() && tensor.layout() == at::kStrided && (type == at::kFloat || type == at::kDouble) &&
         tensor.is_contiguous() && tensor.numel() > 0 && !tensor._fw_grad(0).defined();
}

Array array(const at::Tensor& tensor) {
  return {const_cast<void*>(tensor.const_data_ptr()), tensor.scalar_type() == at::kDouble};
}

// step(plan, state, action): the next state; None if the general way must predict it, or refuse it.
PyObject* step(PyObject*, PyObject* const* given, Py_ssize_t count) {
  HANDLE_TH_ERRORS
  if (count != 3) return PyErr_Format(PyExc_TypeError, "step takes a plan, a state and an action");
  const auto* plan = static_cast<const Plan*>(PyCapsule_GetPointer(given[0], kName));
  if (!plan) return nullptr;
  if (!THPVariable_CheckExact(given[1]) || !THPVariable_CheckExact(given[2]) || observed()) Py_RETURN_NONE;
  const at::Tensor &state = THPVariable_Unpack(given[1]), &action = THPVariable_Unpack(given[2]);
  const int64_t dims = state.dim();
  if (!is_plain(state) || !is_plain(action) || dims < 2 || action.dim() != dims - 1 ||
      state.size(-2) != plan->nodes || state.size(-1) != plan->channels || action.size(-1) != plan->actions ||
      !state.sizes().slice(0, dims - 2).equals(action.sizes().slice(0, dims - 2)) ||
      (at::GradMode::is_enabled() && (state.requires_grad() || action.requires_grad())) || !plan->is_current())
    Py_RETURN_NONE;
  const at::Tensor out = at::empty_like(state);
  Call call{};
  const int64_t size = plan->nodes * plan->channels;
  call.batch = state.numel() / size;
  call.steps = 1;
  call.threads = at::get_num_threads();
  call.tile = std::min(plan->tile, (call.batch + call.threads - 1) / call.threads);
  call.states = array(state);
  call.state_stride = size;
  call.actions = array(action);
  call.out = array(out);
  int64_t other;
  Py_BEGIN_ALLOW_THREADS
  other = plan->run(plan->network, plan->kind, plan->maths, &call);
  Py_END_ALLOW_THREADS
  if (other) Py_RETURN_NONE;
  return THPVariable_Wrap(out);
  END_HANDLE_TH_ERRORS
}

void forget(PyObject* capsule) { delete static_cast<Plan*>(PyCapsule_GetPointer(capsule, kName)); }

// plan(kept, attributes, casts, owners, names, tensors, versions, run, network, kind, maths, tile, nodes, channels, actions)
PyObject* make_plan(PyObject*, PyObject* given) {
  PyObject *kept, *attributes, *owners, *names, *tensors, *versions;
  long casts;
  unsigned long long run, network, maths;
  long long kind, tile, nodes, channels, actions;
  if (!PyArg_ParseTuple(given, "OO!lO!O!O!O!KKLKLLLL", &kept, &PyDict_Type, &attributes, &casts, &PyTuple_Type,
                        &owners, &PyTuple_Type, &names, &PyTuple_Type, &tensors, &PyList_Type, &versions, &run,
                        &network, &kind, &maths, &tile, &nodes, &channels, &actions))
    return nullptr;
  Plan* plan = new Plan{kept, attributes, owners, names, tensors};
  for (PyObject* each : {kept, attributes, owners, names, tensors}) Py_INCREF(each);
  plan->casts = casts;
  plan->run = reinterpret_cast<Run>(run);
  plan->network = reinterpret_cast<const void*>(network);
  plan->maths = reinterpret_cast<const void*>(maths);
  plan->kind = kind, plan->tile = tile, plan->nodes = nodes, plan->channels = channels, plan->actions = actions;
  for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(tensors); ++i) {
    plan->versions.push_back(PyLong_AsUnsignedLong(PyList_GET_ITEM(versions, i)));
    plan->types.push_back(THPVariable_Unpack(PyTuple_GET_ITEM(tensors, i)).scalar_type());
  }
  return PyCapsule_New(plan, kName, forget);
}

PyMethodDef methods[] = {
    {"plan", make_plan, METH_VARARGS, nullptr},
    {"step", reinterpret_cast<PyCFunction>(reinterpret_cast<void*>(step)), METH_FASTCALL, nullptr},
    {nullptr, nullptr, 0, nullptr},
};
PyModuleDef definition = {PyModuleDef_HEAD_INIT, "torchrl_gn_binding", nullptr, -1, methods};

}  // namespace

PyMODINIT_FUNC PyInit_torchrl_gn_binding() { return PyModule_Create(&definition); }
