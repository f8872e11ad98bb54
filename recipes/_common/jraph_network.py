"""The forward model's network in jraph, with our weights, as a baseline of its speed."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.networks import GNCore, Graph
from torchrl_gn.scenes import Scene

try:
    import jax  # pyright: ignore[reportMissingImports]
    import jax.numpy as jnp  # pyright: ignore[reportMissingImports]
    import jraph  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise ImportError(f"{error}; baselines=[jraph] needs: pip install 'jax[cpu]' jraph") from error

_TOLERANCE = 1e-5  # largest difference between jraph's outputs and ours, relative to their norm
_ACTIVATIONS = {
    "relu": jax.nn.relu,
    "silu": jax.nn.silu,
    "gelu": functools.partial(jax.nn.gelu, approximate=False),
    "tanh": jnp.tanh,
}


class JraphBaseline:
    """The network alone, graph features in and output nodes out, written with jraph under ``jax.jit``.

    Raises:
        RuntimeError: if its outputs differ from our network's.
    """

    def __init__(self, model: ForwardModel, scene: Scene, threads: int) -> None:
        limit_threads(threads)
        self._network = JraphNetwork(model.core)  # type: ignore[arg-type]
        self._reference = model.bind(scene, reference=True)

    def step(self, state: Tensor, action: Tensor) -> Callable[[], object]:
        """Return the call for one step of states ``[B, N, 13]`` under actions ``[B, A]``."""
        graph, expected = self._seen(state, action)
        inputs = batched(graph)
        found = torch.from_numpy(np.array(self._network.predict(inputs))).view_as(expected)
        if (error := float((found - expected).norm() / expected.norm())) > _TOLERANCE:
            raise RuntimeError(f"jraph's outputs differ from the core's by {error:.1e} of their norm.")
        return lambda: self._network.predict(inputs)

    def rollout(self, state: Tensor, actions: Tensor) -> None:
        """Return None: the network alone makes no rollouts."""

    def gradient(self, state: Tensor, action: Tensor) -> Callable[[], object]:
        """Return the call for the gradients of node and edge features, given the gradient of the output nodes."""
        inputs = batched(self._seen(state, action)[0])
        gradient = self._network.predict(inputs)  # gradient of half the outputs' sum of squares
        return lambda: self._network.gradient(inputs, gradient)

    @torch.no_grad()
    def _seen(self, state: Tensor, action: Tensor) -> tuple[Graph, Tensor]:
        """Return the graph that the core reads in a step, and its output nodes."""
        seen: list[tuple[Graph, Tensor]] = []
        core = self._reference.model.core
        handle = core.register_forward_hook(lambda _, inputs, output: seen.append((inputs[0], output.nodes)))
        self._reference.step(state, action)
        handle.remove()
        return seen[0]


def limit_threads(count: int) -> None:
    """Restrict this process, and so XLA's thread pools, to ``count`` cores; call it before JAX is first used.

    JAX then computes in the calling thread: on one core, handing work to another thread would take longer.
    """
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    if count == 1:
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_multi_thread_eigen=false".strip()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])


class JraphNetwork:
    """A :class:`~torchrl_gn.networks.GNCore` that pools by sums, as two ``jraph.GraphNetwork`` under ``jax.jit``.

    Float32. Graphs are batched by ``jraph.batch_np``; weights are arguments of the compiled functions.
    """

    def __init__(self, core: GNCore) -> None:
        self.weights = {name: _weights(block) for name, block in (("first", core.first), ("second", core.second))}
        network = functools.partial(_network, _ACTIVATIONS[core.activation])

        def vjp(weights: Any, graph: Any, gradient: Any) -> Any:
            def outputs(nodes: Any, edges: Any) -> Any:
                return network(weights, graph._replace(nodes=nodes, edges=edges))

            return jax.vjp(outputs, graph.nodes, graph.edges)[1](gradient)

        self._predict, self._gradient = jax.jit(network), jax.jit(vjp)

    def predict(self, graph: Any) -> Any:
        """Return the output nodes ``[B * N, F_out]`` of a batched graph."""
        return self._predict(self.weights, graph).block_until_ready()

    def gradient(self, graph: Any, gradient: Any) -> tuple[Any, Any]:
        """Return the gradients of node and edge features, given the gradient of the output nodes."""
        return jax.block_until_ready(self._gradient(self.weights, graph, gradient))


def batched(graph: Graph) -> Any:
    """Return the samples of a graph with features ``[B, ...]`` as one ``jraph.GraphsTuple``."""
    senders, receivers = graph.edge_index.numpy()
    counts = {"n_node": np.array([graph.nodes.shape[-2]]), "n_edge": np.array([len(senders)])}
    ends = {"senders": senders, "receivers": receivers}
    samples = zip(*(part.numpy() for part in graph.features), strict=True)
    graphs = [jraph.GraphsTuple(nodes=n, edges=e, globals=g[None], **ends, **counts) for n, e, g in samples]
    return jax.tree_util.tree_map(jnp.asarray, jraph.batch_np(graphs))


def _weights(block: nn.Module) -> dict[str, list[tuple[Any, Any]]]:
    """Return weights ``[in, out]`` and biases of a GN block's MLPs."""
    mlps = {name: getattr(block, f"{name}_mlp") for name in ("edge", "node", "global")}
    return {name: [_layer(each) for each in mlp if isinstance(each, nn.Linear)] for name, mlp in mlps.items() if mlp}


@torch.no_grad()
def _layer(linear: nn.Linear) -> tuple[Any, Any]:
    return jnp.asarray(linear.weight.T.numpy()), jnp.asarray(linear.bias.numpy())


def _network(activation: Callable, weights: Any, graph: Any) -> Any:
    first = _block(activation, weights["first"])(graph)
    both = graph._replace(
        nodes=jnp.concatenate((graph.nodes, first.nodes), -1),
        edges=jnp.concatenate((graph.edges, first.edges), -1),
        globals=jnp.concatenate((graph.globals, first.globals), -1),
    )
    return _block(activation, weights["second"])(both).nodes


def _block(activation: Callable, weights: Any) -> Callable:
    def mlp(name: str, *inputs: Any) -> Any:
        hidden = jnp.concatenate(inputs, -1)
        *others, (weight, bias) = weights[name]
        for each, shift in others:
            hidden = activation(hidden @ each + shift)
        return hidden @ weight + bias

    def update_edges(edges: Any, sent: Any, received: Any, globals_: Any) -> Any:
        return mlp("edge", globals_, sent, received, edges)

    def update_nodes(nodes: Any, sent: Any, received: Any, globals_: Any) -> Any:
        return mlp("node", globals_, nodes, received)

    def update_globals(nodes: Any, edges: Any, globals_: Any) -> Any:
        return mlp("global", globals_, nodes, edges)

    return jraph.GraphNetwork(update_edges, update_nodes, update_globals if "global" in weights else None)
