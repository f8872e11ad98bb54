"""One scene's step as standalone C++ source: the executor's code, then structure and weights as arrays."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from torchrl_gn.dynamics.executors.native.build import SOURCES
from torchrl_gn.networks.packed_layers import PackedLayers

_ORDER = ("structure.h", "kernels.h", "network.h", "tape.h", "call.h", "threads.h", "rollout.h")
_OPERATORS = {"engine.h", "muon.h", "structure_check.h"}  # headers for the PyTorch operators alone
_TYPES = {"i": "int32_t", "l": "int64_t", "f": "float", "d": "double"}


@dataclass(frozen=True)
class Description:
    """The description of a scene in the header."""

    name: str  # prefix of all names, a C identifier
    scene: str
    timestep: float  # seconds
    nodes: tuple[str, ...]
    channels: tuple[str, ...]  # components of a node's state with their sizes
    actions: tuple[str, ...]  # name and bounds of each


def header(about: Description, shape: tuple[int, int]) -> str:
    """Return the header of the functions; ``shape`` is ``[N, C]`` of a state."""
    return _filled(
        _HEADER,
        about,
        TIMESTEP=f"{about.timestep:.17g}",
        NODES=str(shape[0]),
        CHANNELS=str(shape[1]),
        ACTIONS=str(len(about.actions)),
        NODE_NAMES=_listed(about.nodes),
        CHANNEL_NAMES=", ".join(about.channels),
        ACTION_NAMES=_listed(about.actions),
    )


def example(about: Description) -> str:
    """Return a short C program that calls the functions."""
    return _filled(_EXAMPLE, about)


def source(about: Description, structure: Tensor, core: PackedLayers, rest: np.ndarray) -> str:
    """Return the C++ source of the functions; ``rest`` is a state at rest ``[N, C]``."""
    weights, tables = core.weights.numpy(), core.tables.numpy()
    kind = _TYPES[weights.dtype.char]
    arrays = {"STRUCTURE": structure.numpy(), "WEIGHTS": weights, "TABLES": tables, "NUMBERS": core.numbers.numpy()}
    includes, engine = _engine()
    return _filled(
        _SOURCE,
        about,
        INCLUDES=includes,
        ENGINE=engine,
        ARRAYS="\n".join(_array(name, each) for name, each in arrays.items()),
        TYPE=kind,
        REST=_numbers(rest),
    )


def _engine() -> tuple[str, str]:
    """Return the standard headers, and the executor's code without the PyTorch operators."""
    files = {path.name: path.read_text() for path in SOURCES if path.suffix == ".h" and path.name not in _OPERATORS}
    if files.keys() != set(_ORDER):
        raise RuntimeError(f"The native executor has the files {sorted(files)}, not {sorted(_ORDER)}.")
    text = "\n".join(files[name] for name in _ORDER)
    includes = sorted(set(re.findall(r"^#include <.*>$", text, re.MULTILINE)))
    # An unnamed namespace around the code hides all names, so that one program can hold several models.
    text = text.replace(' __attribute__((visibility("hidden")))', "")
    text = re.sub(r"^#(?:include|pragma once).*\n", "", text, flags=re.MULTILINE)
    return "\n".join(includes), re.sub(r"\n{3,}", "\n\n", text).strip()


def _array(name: str, values: np.ndarray) -> str:
    return f"const {_TYPES[values.dtype.char]} {name}[] = {{\n{_numbers(values)}\n}};"


def _numbers(values: np.ndarray) -> str:
    """Format numbers so that they are read back bit for bit; no numbers give a zero, as C++ has no empty arrays."""
    form = {"f": "%.9g", "d": "%.17g"}.get(values.dtype.char, "%d")
    least = -(2**63)  # C++ has no literal for this number
    text = _wrapped("INT64_MIN" if value == least else form % value for value in values.ravel().tolist() or [0])
    return text.replace("inf", "INFINITY").replace("nan", "NAN")


def _wrapped(items: Iterable[str], count: int = 8) -> str:
    rows = list(items)
    return ",\n".join(", ".join(rows[i : i + count]) for i in range(0, len(rows), count))


def _listed(names: tuple[str, ...]) -> str:
    return "".join(f"\n *   {index}: {_comment(name)}" for index, name in enumerate(names)) or " none"


def _comment(text: str) -> str:
    return " ".join(text.replace("*/", "* /").split())


def _filled(template: str, about: Description, **values: str) -> str:
    """Return the template with each ``@KEY@`` replaced."""
    values = {"NAME": about.name, "UPPER": about.name.upper(), "SCENE": _comment(about.scene), **values}
    return re.sub(r"@([A-Z_]+)@", lambda match: values[match[1]], template)


_HEADER = """\
/* Learned forward model of @SCENE@, control step @TIMESTEP@ s; written by torchrl_gn. Float64, row-major.
 *
 * State: [@UPPER@_NODES][@UPPER@_CHANNELS].
 * Channels of a node: @CHANNEL_NAMES@.
 * Nodes:@NODE_NAMES@
 * Actions:@ACTION_NAMES@
 *
 * Build with GCC or Clang:
 *   g++ -O3 -std=c++17 -march=native @NAME@.cpp main.c
 * Without -march=native (or -mavx2 -mfma) it is three to eight times as slow, and GCC warns of its vector ABI, which
 * does not matter here.
 *
 * Functions may be called from several threads at once. They return 0, or 1 without memory, or where no maths is known
 * for states whose channels that cannot move are not as in @NAME@_rest.
 */
#ifndef @UPPER@_H
#define @UPPER@_H

#define @UPPER@_NODES @NODES@
#define @UPPER@_CHANNELS @CHANNELS@
#define @UPPER@_STATE (@UPPER@_NODES * @UPPER@_CHANNELS)
#define @UPPER@_ACTIONS @ACTIONS@
#define @UPPER@_TIMESTEP @TIMESTEP@

#ifdef __cplusplus
extern "C" {
#endif

/* A state of the system at rest. */
extern const double @NAME@_rest[@UPPER@_STATE];

/* The state after one control step.
 *   state, next: [STATE]; action: [ACTIONS]
 */
int @NAME@_step(const double* state, const double* action, double* next);

/* States under actions.
 *   batch, steps: B samples, T steps; threads: at most so many, 1 for the caller's alone
 *   start: [B][STATE]; actions: [B][T][ACTIONS]
 *   states: [B][T + 1][STATE], the start first
 */
int @NAME@_rollout(int batch, int steps, int threads, const double* start, const double* actions, double* states);

/* Gradient of a scalar function of the states of a rollout.
 *   states: [B][T + 1][STATE], as @NAME@_rollout wrote them; actions: [B][T][ACTIONS]
 *   grad_states: [B][T + 1][STATE], the function's gradient in the states
 *   grad_start: [B][STATE] and grad_actions: [B][T][ACTIONS], its gradient in start and actions. Channels that cannot
 *   move count as copied from the start.
 */
int @NAME@_rollout_gradient(int batch, int steps, int threads, const double* states, const double* actions,
                            const double* grad_states, double* grad_start, double* grad_actions);

#ifdef __cplusplus
}
#endif

#endif
"""

_EXAMPLE = """\
/* Simulate 100 steps without control; the last state's gradient in the first action. */
#include <stdio.h>

#include "@NAME@.h"

enum { STEPS = 100, LAST = STEPS * @UPPER@_STATE };
static double actions[STEPS * @UPPER@_ACTIONS + 1], states[LAST + @UPPER@_STATE], weights[LAST + @UPPER@_STATE];
static double of_start[@UPPER@_STATE], of_actions[STEPS * @UPPER@_ACTIONS + 1];

int main(void) {
  int i, error = @NAME@_rollout(1, STEPS, 1, @NAME@_rest, actions, states);
  if (error) return error;
  for (i = 0; i < @UPPER@_STATE; ++i)
    printf("%12.6f%s", states[LAST + i], (i + 1) % @UPPER@_CHANNELS ? " " : "\\n");
  for (i = 0; i < @UPPER@_STATE; ++i) weights[LAST + i] = 1; /* of the sum of the last state's channels */
  error = @NAME@_rollout_gradient(1, STEPS, 1, states, actions, weights, of_start, of_actions);
  for (i = 0; i < @UPPER@_ACTIONS; ++i) printf("d sum / d action %d: %g\\n", i, of_actions[i]);
  return error;
}
"""

_SOURCE = """\
// Learned forward model of @SCENE@: see @NAME@.h. Written by torchrl_gn (MIT License, (c) 2026 torchrl_gn authors).
#include "@NAME@.h"

@INCLUDES@

namespace {

@ENGINE@

// The scene.
@ARRAYS@

gn::Array array(const double* data) { return {const_cast<double*>(data), 1}; }

int run(gn::Call call, bool adjoint) try {
  const gn::Structure structure{STRUCTURE};
  const gn::Network<@TYPE@> network(structure, WEIGHTS, TABLES);
  call.threads = std::max<int64_t>(call.threads, 1);
  call.tile = std::min(gn::kTile, (call.batch + call.threads - 1) / call.threads);
  call.numbers = NUMBERS;
  return !gn::run(structure, network, call, adjoint);
} catch (const std::exception&) {
  return 1;
}

}  // namespace

extern "C" {

extern const double @NAME@_rest[@UPPER@_STATE] = {
@REST@
};

int @NAME@_step(const double* state, const double* action, double* next) {
  gn::Call call{};
  call.batch = call.steps = call.threads = 1;
  call.states = array(state), call.state_stride = @UPPER@_STATE;
  call.actions = array(action), call.out = array(next);
  return run(call, false);
}

int @NAME@_rollout(int batch, int steps, int threads, const double* start, const double* actions, double* states) {
  gn::Call call{};
  call.batch = batch, call.steps = steps, call.threads = threads, call.with_start = 1;
  call.states = array(start), call.state_stride = @UPPER@_STATE;
  call.actions = array(actions), call.out = array(states);
  return run(call, false);
}

int @NAME@_rollout_gradient(int batch, int steps, int threads, const double* states, const double* actions,
                            const double* grad_states, double* grad_start, double* grad_actions) {
  gn::Call call{};
  call.batch = batch, call.steps = steps, call.threads = threads, call.with_start = 1;
  call.states = array(states), call.state_stride = (steps + int64_t{1}) * @UPPER@_STATE;
  call.actions = array(actions), call.out = array(grad_states);
  call.grad_state = array(grad_start), call.grad_actions = array(grad_actions);
  return run(call, true);
}
}
"""
