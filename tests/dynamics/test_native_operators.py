"""The native executor's operators: pure functions with gradients, shapes for compilers, and checks of arguments."""

from __future__ import annotations

import functools
import gc
import pickle
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.dynamics import SpecializedPredictor, specialize
from torchrl_gn.dynamics.executors.native.structure import seal
from torchrl_gn.dynamics.executors.native.tape import CODES
from torchrl_gn.networks.packed_layers import PackedLayers

from ..compiling import compiles
from .native import equal, vjp, with_compiler

pytestmark = with_compiler

OPS = torch.ops.torchrl_gn


def model(predictor: SpecializedPredictor) -> dict[str, torch.Tensor | None]:
    """Arguments of operators besides states and actions."""
    core = predictor.program().core
    assert isinstance(core, PackedLayers)
    names = ("weights", "tables", "sample_tables", "numbers")
    return {"structure": predictor.executor.structure, **{name: getattr(core, name) for name in names}}


def rollout(predictor, state, actions, *, channels=13, threads=1, **changed):
    """The operator of a predictor, with other arguments; ``many`` if actions have one dimension more."""
    given = model(predictor) | changed
    return OPS.rollout(state, actions, *given.values(), channels, actions.ndim == state.ndim, threads)


# Values and gradients


@pytest.mark.parametrize("state_dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["swimmer6", "cheetah", "joints"])
def test_a_predictor_is_its_operator(quick, inputs, name, dtype, state_dtype):
    predictor = quick(name, dtype)
    for batch in ((), (1,), (3,), (2, 3), (60,)):
        state, actions = (each.to(state_dtype) for each in inputs(predictor, *batch))
        states = predictor.rollout(state, actions)[0]
        after, hidden = predictor.step(state, actions[..., 0, :])
        assert torch.equal(rollout(predictor, state, actions), states) and hidden is None
        assert torch.equal(rollout(predictor, state, actions[..., 0, :]), after)
        assert torch.equal(states[..., 1, :, :], after) and after.dtype == state_dtype


@pytest.mark.parametrize("activation", ["relu", "silu", "gelu", "tanh"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_steps_that_are_computed_again_give_the_same_gradient(quick, inputs, dtype, activation):
    predictor = quick("joints", dtype, activation=activation)
    for count in (1, 26):
        state, actions = inputs(predictor, count)
        states, kept = OPS.rollout_keeping(state, actions, *model(predictor).values(), 13, True, 2, 1)
        assert kept.numel() > 0
        found = [
            OPS.rollout_adjoint(states.cos(), states, actions, *model(predictor).values(), given, True, 2, False, True)[
                :2
            ]
            for given in (kept, kept.new_empty(0))
        ]
        assert equal(*found) and found[0][1].norm() > 0


@pytest.mark.parametrize("many", [False, True])
def test_gradients_of_weights_are_the_same_without_those_of_states(quick, inputs, many):
    predictor = quick("joints", torch.float32)
    state, actions = inputs(predictor, 26)
    state[1, :, 2] += 0.1  # of the other state maths
    actions, given = actions if many else actions[:, 0].clone(), model(predictor).values()
    out, kept = OPS.rollout_keeping(state, actions, *given, 13, many, 1, 0 if many else 2)
    rest = (out.cos(), out if many else state, actions, *given, kept, many, 1, True)
    all_, alone = (OPS.rollout_adjoint(*rest, of_inputs) for of_inputs in (True, False))
    assert torch.equal(alone[2], all_[2]) and torch.equal(alone[3], all_[3]) and all_[2].norm() > 0
    assert all_[0].norm() > 0 and not alone[0].numel() and not alone[1].numel()


@pytest.mark.parametrize("many", [False, True])
@pytest.mark.parametrize("name", ["pendulum", "joints"])
def test_gradients_are_the_finite_differences(quick, inputs, name, many):
    predictor = quick(name, torch.float64)
    state, actions = inputs(predictor, 2)
    state[1, :, 2] += 0.1  # of the other state maths
    given, names = model(predictor), ("weights", "tables")
    varied = torch.as_tensor(predictor.scene.movable).any(-1)
    state = torch.where(varied[:, None], state, state)

    def function(actions, *packed):
        return rollout(predictor, state, actions if many else actions[:, 0], **dict(zip(names, packed, strict=True)))

    leaf = actions.clone().requires_grad_()
    assert torch.autograd.gradcheck(function, (leaf, *(given[name] for name in names)), fast_mode=True)
    # Packed weights hold every matrix twice, but the gradient is that of the first: changed as pack() does, along a
    # direction of the plain ones.
    shapes = predictor.executor.shapes
    plain = torch.cat([each.flatten() for each in predictor.program().core.plain_weights()])
    weights = plain.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda weights: function(actions, OPS.pack(weights, shapes.weights, True), given["tables"]),
        weights,
        fast_mode=True,
    )
    tables = given["tables"].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda tables: function(actions, given["weights"], tables), tables, fast_mode=True)


@pytest.mark.parametrize("batch", [(), (1,), (3,), (2, 3), (24,), (60,)])
def test_a_steps_gradient_is_that_of_a_rollout(quick, inputs, batch):
    predictor = quick()
    state, actions = inputs(predictor, *batch, steps=1)
    leaves, gradient = (state.requires_grad_(), actions.requires_grad_()), torch.randn_like(state)
    expected = torch.autograd.grad(predictor.rollout(*leaves)[0][..., 1, :, :], leaves, gradient)
    found = torch.autograd.grad(predictor.step(state, actions[..., 0, :])[0], leaves, gradient)
    assert equal(found, expected)
    only = torch.autograd.grad(predictor.step(state.detach(), actions[..., 0, :])[0].sum(), actions)[0]  # expanded
    whole = torch.autograd.grad(predictor.step(*leaves[:1], actions[..., 0, :])[0], actions, torch.ones_like(state))[0]
    assert torch.equal(only, whole)


def test_gradients_add_up_over_steps_and_threads(quick, inputs):
    predictor = quick(dtype=torch.float64)
    state, actions = inputs(predictor, 3, steps=1)

    def through(step, action) -> torch.Tensor:
        leaf = action.clone().requires_grad_()
        after = state
        for _ in range(5):
            after = step(after, leaf)
        after.square().sum().backward()
        assert leaf.grad is not None
        return leaf.grad

    expected = through(lambda state, action: predictor.rollout(state, action)[0][..., 1, :, :], actions).squeeze(1)

    def work(_: int) -> torch.Tensor:
        return through(lambda state, action: predictor.step(state, action)[0], actions[:, 0])

    assert torch.equal(work(0), expected)
    with ThreadPoolExecutor(3) as pool:
        assert all(torch.equal(each, expected) for each in pool.map(work, range(30)))


def test_what_gradients_refuse(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 3)
    leaf = actions.requires_grad_()
    for predict in (
        lambda state: predictor.step(state, leaf[:, 0])[0],
        lambda state: predictor.rollout(state, leaf)[0],
    ):
        after = predict(state)
        after.sum().backward()
        with pytest.raises(RuntimeError, match="second time"):
            after.sum().backward()
        first = torch.autograd.grad(predict(state).square().sum(), leaf, create_graph=True)[0]
        with pytest.raises(RuntimeError, match="first order.*executor='eager'"):
            torch.autograd.grad(first.sum(), leaf)
        (linear,) = torch.autograd.grad(predict(state).sum(), leaf, create_graph=True)  # of a constant gradient
        with pytest.raises(RuntimeError, match="first order.*executor='eager'"):
            torch.autograd.grad(linear.sum(), leaf)


def test_inputs_that_change_in_place_before_the_gradient(quick, inputs):
    predictor = quick()
    for many in (False, True):
        for index in range(3):  # state, action, the prediction
            state, actions = inputs(predictor, 3)
            leaf = torch.zeros(1, dtype=torch.float64, requires_grad=True)
            given = [state + leaf, (actions if many else actions[:, 0]) + leaf]
            given.append((predictor.rollout if many else predictor.step)(*given)[0])
            loss = given[2].sum()
            given[index].detach().add_(1)
            if (index, many) in ((0, True), (2, False)):  # a rollout's first state is the start; a step reads its own
                loss.backward()
            else:
                with pytest.raises(RuntimeError, match="modified by an inplace operation"):
                    loss.backward()


@pytest.mark.slow
def test_a_gradient_outlives_its_predictor(wide, inputs):
    predictor = specialize(wide("pendulum"))
    state, actions = inputs(predictor, 3)
    leaf = actions.requires_grad_()
    expected = torch.autograd.grad(predictor.rollout(state, leaf)[0].sum(), leaf)[0]
    after = predictor.rollout(state, leaf)[0]
    del predictor
    gc.collect()
    assert torch.equal(torch.autograd.grad(after.sum(), leaf)[0], expected)


def test_hooks_and_partial_gradients(quick, inputs):
    """Autograd beyond plain backward: hooks, saved-tensor hooks, retained graphs, batches of gradients."""
    predictor = quick()
    state, actions = inputs(predictor, 3)
    leaf = actions.clone().requires_grad_()
    expected = torch.autograd.grad(predictor.rollout(state, leaf)[0].sum(), leaf)[0]
    with torch.autograd.graph.save_on_cpu():
        after = predictor.rollout(state, leaf)[0]
    for _ in range(2):
        assert torch.equal(torch.autograd.grad(after.sum(), leaf, retain_graph=True)[0], expected)
    both = torch.stack((torch.ones_like(after), 2 * torch.ones_like(after)))
    found = torch.autograd.grad(after, leaf, both, is_grads_batched=True, retain_graph=True)[0]
    assert equal(found, (expected, 2 * expected))
    seen = []
    leaf.register_hook(seen.append)
    after.sum().backward()
    assert torch.equal(seen[0], expected)


# Compilers


def compiled(function, backend: str = "aot_eager", **options):
    return torch.compile(function, fullgraph=True, backend=backend, **options)


@pytest.mark.slow
@pytest.mark.parametrize("many", [False, True])
@pytest.mark.parametrize("of_weights", [False, True])
def test_operators_pass_torchs_own_checks(quick, inputs, many, of_weights):
    predictor = quick("pendulum", torch.float64)
    state, actions = inputs(predictor, 2)
    state[1, :, 2] += 0.1
    actions, given = actions if many else actions[:, 0].clone(), model(predictor)
    if of_weights:
        for name in ("weights", "tables"):
            given[name] = given[name].clone().requires_grad_()
    leaves = state.requires_grad_(), actions.requires_grad_()
    torch.library.opcheck(OPS.rollout.default, (*leaves, *given.values(), 13, many, 2))
    given = {name: None if each is None else each.detach() for name, each in given.items()}
    state, actions = state.detach(), actions.detach()
    out, kept = OPS.rollout_keeping(state, actions, *given.values(), 13, many, 1, 0)
    torch.library.opcheck(OPS.rollout_keeping.default, (state, actions, *given.values(), 13, many, 1, 0))
    rest = (out if many else state, actions, *given.values(), kept, many, 1, of_weights)
    for of_inputs in (True, False)[: 1 + of_weights]:
        torch.library.opcheck(OPS.rollout_adjoint.default, (torch.ones_like(out), *rest, of_inputs))
    numbers = torch.randn(23, requires_grad=True)
    torch.library.opcheck(OPS.pack.default, (numbers, [3, 5, 2, 4], many))


@pytest.mark.slow
@compiles
@pytest.mark.parametrize("backend", ["aot_eager", pytest.param("inductor", marks=pytest.mark.slow)])
def test_a_compiled_function_steps_and_differentiates(quick, inputs, backend):
    predictor = quick("pendulum")

    def step(state, actions):
        return predictor.step(state, actions[:, 0])[0].square()

    def rollout(state, actions):
        return predictor.rollout(state, actions)[0].square()

    for function in (step, rollout):
        fast = compiled(function, backend, dynamic=True)
        for count in (7, 5, 9):  # as many as nothing else
            state, actions = inputs(predictor, count)
            with torch.compiler.set_stance("default" if count == 7 else "fail_on_recompile"):
                results = []
                for way in (function, fast):
                    leaf = actions.clone().requires_grad_()
                    out = way(state, leaf)
                    results.append((out.detach(), *torch.autograd.grad(out.sum(), leaf)))
            for expected, found in zip(*results, strict=True):
                torch.testing.assert_close(found, expected)


def operators_of(function, *arguments) -> int:
    """How many operators of ours a compiler puts into its graph."""
    graphs = []

    def backend(graph, _):
        graphs.append(graph)
        return graph

    torch.compile(function, fullgraph=True, backend=backend)(*arguments)
    return sum("torchrl_gn" in str(node.target) for graph in graphs for node in graph.graph.nodes)


@pytest.mark.slow
@compiles
def test_a_compiled_model_takes_new_weights(wide, inputs):
    bound = wide("pendulum")
    predictor = specialize(bound)
    state, actions = inputs(predictor, 2)
    given = TensorDict({"state": state, "action": actions[:, 0]}, [2])
    run = compiled(predictor)
    before = run(given.clone())["next", "state"]
    with torch.no_grad():
        for weight in bound.model.parameters():
            weight.mul_(1.5)
    predictor.refresh(bound)
    after = run(given.clone())["next", "state"]
    assert not torch.equal(before, after)
    assert torch.equal(after, predictor(given.clone())["next", "state"])
    assert operators_of(lambda *given: predictor.rollout(*given)[0], state, actions) == 1


# What they read


def damaged(index: int, value: int):
    return lambda words: torch.where(torch.arange(len(words)) == index, value, words)


REFUSED = {
    "no structure": ({"structure": damaged(0, 0)}, "damaged"),
    "another format": ({"structure": damaged(1, 99)}, "of another version"),
    "cut off": ({"structure": lambda words: words[:-1]}, "damaged"),
    "short": ({"structure": lambda words: words[:3]}, "damaged"),
    "another word": (
        {"structure": lambda words: words + (torch.arange(len(words)) == len(words) - 1)},
        "the sum of all",
    ),
    "floating-point words": ({"structure": lambda words: words.double()}, "contiguous int64"),
    "words apart": ({"structure": lambda words: words.repeat_interleave(2)[::2]}, "contiguous int64"),
    "fewer weights": ({"weights": lambda weights: weights[1:]}, "packed weights do not fit"),
    "weights apart": ({"weights": lambda weights: weights.repeat_interleave(2)[::2]}, "packed weights do not fit"),
    "weights of two dtypes": ({"weights": lambda weights: weights.double()}, "packed weights do not fit"),
    "16 bits": ({"weights": lambda weights: weights.half()}, "float32, float64 or bfloat16"),
    "fewer tables": ({"tables": lambda tables: tables[1:]}, "packed weights do not fit"),
    "tables of samples": ({"sample_tables": lambda _: torch.zeros(16)}, "tables of each sample"),
    "fewer numbers": ({"numbers": lambda numbers: numbers[:, 1:]}, "numbers of the native step"),
    "numbers of others": ({"numbers": lambda numbers: numbers.repeat(2, 1)}, "numbers of the native step"),
    "float32 numbers": ({"numbers": lambda numbers: numbers.float()}, "numbers of the native step"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_a_model_that_does_not_fit_is_refused(quick, inputs, kind):
    predictor = quick("pendulum")
    state, actions = inputs(predictor, 3)
    changes, message = REFUSED[kind]
    given = model(predictor)
    changed = {name: change(given[name]) for name, change in changes.items()}
    with pytest.raises((ValueError, RuntimeError), match=message):
        rollout(predictor, state, actions, **changed)


def test_states_and_actions_that_do_not_fit_are_refused(quick, inputs):
    predictor = quick("pendulum")
    state, actions = inputs(predictor, 3)
    wrong = pytest.raises(ValueError, match="do not fit the native step")
    for states, given in (
        (state[:2], actions),
        (state, actions[:2]),
        (state[:, :1], actions[:, 0]),
        (state, actions[..., :0]),
        (state.flatten(1), actions),
        (state.transpose(1, 2), actions),
    ):
        with wrong:
            rollout(predictor, states, given)
    for states, given in ((state.half(), actions), (state[:0], actions[:0]), (state, actions[:, :0])):
        with pytest.raises(NotImplementedError, match="native"):  # torch can
            rollout(predictor, states, given)
    with pytest.raises(ValueError, match="gives no 12 channels"):
        rollout(predictor, state, actions, channels=12)
    states, kept = OPS.rollout_keeping(state, actions, *model(predictor).values(), 13, True, 1, 1)
    rest = (states, actions, *model(predictor).values())
    with pytest.raises(ValueError, match="gradient does not fit"):
        OPS.rollout_adjoint(states[:, 1:], *rest, kept, True, 1, False, True)
    for some in (states[:, :1], states[:, 1:]):
        with wrong:
            OPS.rollout_adjoint(states, some, *rest[1:], kept, True, 1, False, True)
    for other in (kept[1:], kept.double()):
        with pytest.raises(ValueError, match="is of another call"):
            OPS.rollout_adjoint(states, *rest, other, True, 1, False, True)
    with pytest.raises(ValueError, match="one step alone"):
        OPS.rollout_keeping(state, actions, *model(predictor).values(), 13, True, 1, 2)
    for gradient in (states.mT, states.half(), states[0]):
        with pytest.raises(ValueError, match="gradient does not fit"):
            OPS.rollout_adjoint(gradient, *rest, kept, True, 1, False, True)
    with pytest.raises(ValueError, match="is of another call"):
        OPS.rollout_adjoint(states, *rest, kept, True, 3, False, True)  # threads that share the samples otherwise
    for keep in (-1, 3):
        with pytest.raises(ValueError, match="0, 1 or 2"):
            OPS.rollout_keeping(state, actions, *model(predictor).values(), 13, True, 1, keep)
    with pytest.raises(ValueError, match="channels"):
        rollout(predictor, state, actions, channels=2**62 + 13)


@pytest.mark.parametrize("weights", [False, True])
@pytest.mark.parametrize(
    ("count", "shapes", "message"),
    [
        (14, [3, 5], "do not have the shapes given"),
        (15, [3, 5, 7], "rows and columns"),
        (0, [2, 8, -4, 4], r"\[-4, 4\]"),
        (15, [-3, -5], r"\[-3, -5\]"),
        (0, [2**32, 2**32], "No matrix to pack"),  # a product that is 0 in 64 bits
        (0, [2**28, 2**28] * 256, "No matrix to pack"),
    ],
)
def test_shapes_to_pack_that_do_not_fit_are_refused(count, shapes, message, weights):
    for device in ("cpu", "meta"):
        with pytest.raises(ValueError, match=message):
            OPS.pack(torch.zeros(count, device=device), shapes, weights)


def forged(words: torch.Tensor, part: str) -> torch.Tensor:
    """Another structure with the right sum, as structure.h has its parts."""
    words = words.clone()
    network, maths = int(words[4]), int(words[5])
    layers = int(words[network + 3])
    gather = int(words[layers + 8])
    places = {
        "header": (4, 2**40),
        "network": (network + 6, 2**40),  # numbers of a sample
        "layer": (layers + 12, 16),  # place of its weights
        "gather": (int(words[gather + 8]), 99),  # an item
        "order of gradients": (gather + 5, 1 - int(words[gather + 5])),  # whether it overwrites
        "state maths": (int(words[maths + 14]), 99),  # a channel that varies
        "tape": (int(words[maths + 18]), len(CODES)),  # an instruction
        "tape of a table": (int(words[maths + 18]), CODES["look_up"]),  # which its constant does not begin
    }
    index, value = places[part]
    words[index] = value
    seal(words.numpy())
    return words


@pytest.mark.parametrize(
    "part", ["header", "network", "layer", "gather", "order of gradients", "state maths", "tape", "tape of a table"]
)
def test_a_structure_that_would_leave_its_memory_is_refused(quick, inputs, part):
    predictor = quick("pendulum")
    state, actions = inputs(predictor, 3)
    with pytest.raises(ValueError, match=rf"damaged \((a|the) {part.removesuffix(' of a table')}\)"):
        rollout(predictor, state, actions, structure=forged(predictor.executor.structure, part))


def test_a_structure_is_checked_again_when_it_is_written_to(quick, inputs):
    predictor = quick("pendulum")
    state, actions = inputs(predictor, 3)
    words = predictor.executor.structure.clone()
    expected = rollout(predictor, state, actions, structure=words)
    words.numpy()[100:] = -1  # of which torch does not know: the copy is used that was checked
    assert torch.equal(rollout(predictor, state, actions, structure=words), expected)
    words[100] = -1
    with pytest.raises(ValueError, match="damaged"):
        rollout(predictor, state, actions, structure=words)
    words.copy_(predictor.executor.structure)
    assert torch.equal(rollout(predictor, state, actions, structure=words), expected)


def test_a_change_has_no_rollout(wide, inputs):
    bound = wide("pendulum")
    trained, (state, actions) = bound.prepared_for_training(), inputs(bound, 3)
    core = trained.program.core
    given = trained.executor.structure, core.weights, core.tables, core.sample_tables, core.numbers
    for operator, rest in ((OPS.rollout, ()), (OPS.rollout_keeping, (1,))):
        with pytest.raises(ValueError, match="has no rollout"):
            operator(state, actions, *given, 12, True, 1, *rest)


def test_tensors_without_memory_are_refused(quick, inputs):
    """Tensors as sharded training leaves them: torch itself reads beyond their storage."""
    predictor = quick("pendulum")
    state, actions = inputs(predictor, 3)
    given = {"state": state, "actions": actions, **model(predictor)}
    for name, tensor in given.items():
        for share in (0, 0.5):
            if tensor is None or not tensor.numel():
                continue
            short = tensor.clone()
            short.untyped_storage().resize_(int(share * short.untyped_storage().nbytes()))
            with pytest.raises(ValueError, match="less memory than numbers"):
                OPS.rollout(*(given | {name: short}).values(), 13, True, 1)


def test_a_structure_is_the_same_wherever_it_lies(quick, inputs):
    predictor = quick("pendulum")
    state, actions = inputs(predictor, 3)
    expected = predictor.rollout(state, actions)[0]
    words = predictor.executor.structure
    for moved in (pickle.loads(pickle.dumps(words)), torch.cat((words[:5], words))[5:].share_memory_()):
        assert torch.equal(rollout(predictor, state, actions, structure=moved), expected)


def test_each_call_may_have_its_own_threads(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 30)
    expected = vjp(predictor, state, actions)[0]
    for threads in (0, 1, 5, 100, 2**63 - 1, -(2**63)):
        assert torch.equal(rollout(predictor, state, actions, threads=threads), expected)


def test_predictions_under_another_dispatch(quick, inputs):
    """Within modes that see all operations, or on the meta device, shapes are right."""
    predictor = quick("pendulum")
    state, actions = inputs(predictor, 3)
    given = {name: None if each is None else each.to("meta") for name, each in model(predictor).items()}
    out = functools.partial(OPS.rollout, state.to("meta"))(actions.to("meta"), *given.values(), 13, True, 1)
    assert out.is_meta and out.shape == (3, 4, *state.shape[1:])
    for name in given:
        if given[name] is not None:
            with pytest.raises(NotImplementedError, match="meta device"):
                rollout(predictor, state, actions, **{name: given[name]})
    for few in (state[0, 0, 0], state[0, 0], state[0]):
        for many in (False, True):
            with pytest.raises(ValueError, match="do not fit"):
                OPS.rollout(few.to("meta"), actions.to("meta"), *given.values(), 13, many, 1)
