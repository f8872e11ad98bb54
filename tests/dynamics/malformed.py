"""Malformed calls of the native operators, by hand: ``python -m tests.dynamics.malformed [--rounds 3000] [--seed 0]``.

Each call is a good one with one or two things wrong. It must be refused by an exception that says why, or give what
copies of its arguments give that lie in memory as usual. With sanitizers, see ``test_native_memory.py``.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tests import zoo
from torchrl_gn.dynamics import ForwardModel, PairContacts, specialize
from torchrl_gn.dynamics.executors import NativeExecutor
from torchrl_gn.dynamics.executors.native.operators import load_operators
from torchrl_gn.dynamics.executors.native.structure import seal
from torchrl_gn.dynamics.executors.native.tape import CODES

REFUSALS = ValueError, NotImplementedError, RuntimeError, TypeError, IndexError, MemoryError
FAULTS = "INTERNAL ASSERT", "std::", "vector::", "bad allocation"
SIZES = 0, 1, -1, 2, 3, 7, 24, 10**6, 2**31, 2**32, 2**62, 2**63 - 1, -(2**63)
Changed = tuple[str, Any]


class Call:
    """An operator with its arguments by name."""

    def __init__(self, name: str, **arguments: Any) -> None:
        self.name, self.arguments = name, arguments

    def run(self) -> list[Tensor]:
        """Results, and arguments changed in place."""
        out = getattr(torch.ops.torchrl_gn, self.name)(*self.arguments.values())
        if out is None:
            return [*self.arguments["parameters"], *self.arguments["moments"]]
        return [out] if isinstance(out, Tensor) else list(out)

    def results(self) -> list[Tensor]:
        """Results without the buffer for gradients, which has gaps."""
        return self.run()[: 1 if self.name == "rollout_keeping" else None]

    def copied(self, change: Callable[[Tensor], Tensor]) -> Call:
        def of(value: Any) -> Any:
            if isinstance(value, list):
                return [of(each) for each in value]
            return change(value) if isinstance(value, Tensor) else value

        return Call(self.name, **{name: of(value) for name, value in self.arguments.items()})


def plain(tensor: Tensor) -> Tensor:
    """Return a contiguous copy."""
    return tensor.detach().clone(memory_format=torch.contiguous_format)


# Good calls


def good_calls() -> list[Call]:
    operators, calls = load_operators(), []
    for name, dtype, products in (
        ("pendulum", torch.float32, None),
        ("joints", torch.float64, None),
        ("pendulum", torch.float32, torch.bfloat16),
    ):
        if products is not None and not operators.has_bfloat16():
            continue
        scene = zoo.load(name)
        torch.manual_seed(0)
        features = ForwardModel.for_scene(scene).features
        features = [each for each in features if not isinstance(each, PairContacts)]  # these have one variant's geoms
        model = ForwardModel.for_scene(scene, features=features, latent=6, hidden=(8,)).to(dtype)
        for normalizer in model.modules():
            if hasattr(normalizer, "m2"):
                normalizer.load_state_dict(
                    {key: torch.ones_like(each) for key, each in normalizer.state_dict().items()}
                )
        bound = model.requires_grad_(False).bind(scene)
        predictor = specialize(bound, dtype=products)
        trained, kinds = bound.prepared_for_training(), [(predictor.executor, predictor.program(), 13, 5)]
        if products is None:
            kinds.append((trained.executor, trained.program, 12, 5))
            of_samples = specialize(model.bind(scene, parameters_key="parameters"))
            parameters = of_samples.own_parameters().expand(3).clone()
            parameters["child_anchor"] *= 1 + 0.1 * torch.rand(3, 1, 1, dtype=torch.float64)
            prepared = of_samples.prepared(parameters)
            kinds.append((prepared.executor, prepared.program, 13, 3))
        for executor, program, channels, count in kinds:
            assert isinstance(executor, NativeExecutor) and executor.reason is None
            core = program.core
            given = {"structure": executor.structure}
            given |= {each: getattr(core, each) for each in ("weights", "tables", "sample_tables", "numbers")}
            state = bound.reference_state.expand(count, -1, -1).clone()
            state[count // 2 :, :, 2] += 0.1  # of the other state maths
            actions = 0.1 * torch.ones(count, 3, scene.num_actions, dtype=torch.float64)
            for many in (False, True)[: 1 + (channels == 13)]:
                calls += _of_model(given, state, actions if many else actions[:, 0].clone(), channels, many)
    matrices = [torch.randn(size) for size in ((3, 5), (17, 2), (8, 8))]
    for dtype in (torch.float32, torch.float64):
        lists = [[each.to(dtype).clone() for each in matrices] for _ in range(3)]
        lists = dict(zip(("parameters", "gradients", "moments"), lists, strict=True))
        calls.append(Call("muon_", **lists, momentum=0.9, rate=0.1, polynomials=[3.0, -4.0, 2.0] * 2, threads=2))
        for weights in (False, True):
            numbers = torch.cat([each.flatten() for each in matrices]).to(dtype)
            calls.append(Call("pack", numbers=numbers, shapes=[3, 5, 17, 2, 8, 8], weights=weights))
    return calls


def _of_model(given: dict, state: Tensor, actions: Tensor, channels: int, many: bool) -> list[Call]:
    both, options = {"state": state, "actions": actions}, {"many": many, "threads": 2}
    calls = [Call("rollout", **both, **given, channels=channels, **options)]
    paired = given["weights"].dtype == torch.bfloat16
    for keep in (0, 1, 2)[: 3 - many]:
        calls.append(Call("rollout_keeping", **both, **given, channels=channels, **options, keep=keep))
        of_weights = keep == 2 or (keep == 0 and not paired)
        if keep == 2 and paired:
            continue
        out, stored = calls[-1].run()
        both_too = {"gradient": torch.ones_like(out), "states": out if many else state, "actions": actions}
        given_too = both_too | given | {"stored": stored} | options
        for of_inputs in (True, False)[: 1 + of_weights]:
            calls.append(Call("rollout_adjoint", **given_too, of_weights=of_weights, of_inputs=of_inputs))
    return calls


# What is wrong


def _misaligned(tensor: Tensor) -> Tensor:
    content = bytearray(1) + plain(tensor).view(-1).view(torch.uint8).numpy().tobytes()
    return torch.frombuffer(content, dtype=tensor.dtype, offset=1).view(tensor.shape)


def _resized(tensor: Tensor, share: float) -> Tensor:
    tensor = plain(tensor)
    if not tensor.numel():
        raise ValueError
    tensor.untyped_storage().resize_(int(share * tensor.untyped_storage().nbytes()))
    return tensor


def _random(tensor: Tensor) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    bits = torch.randint(256, (tensor.numel() * tensor.element_size(),), generator=generator, dtype=torch.uint8)
    return bits.view(tensor.dtype).view(tensor.shape)


class Own(Tensor):
    """A subclass of tensors, as users define them."""


WRONG: dict[str, Callable[[Tensor], Tensor]] = (
    {
        "apart": lambda x: torch.stack((x, x), -1)[..., 0],
        "by columns": lambda x: x.mT.contiguous().mT,
        "behind others": lambda x: torch.cat((x.flatten()[:1], x.flatten()))[1:].view(x.shape),
        "one for all": lambda x: x[:1].expand_as(x),
        "misaligned": _misaligned,
        "negative": lambda x: torch._neg_view(-x),  # pyright: ignore[reportPrivateImportUsage]
        "efficient zeros": lambda x: torch._efficientzerotensor(  # pyright: ignore[reportPrivateImportUsage]
            x.shape, dtype=x.dtype
        ),
        "with a gradient": lambda x: plain(x).requires_grad_(),
        "computed": lambda x: plain(x).requires_grad_() * 1,
        "a parameter": lambda x: torch.nn.Parameter(plain(x)),
        "a subclass": lambda x: x.as_subclass(Own),  # pyright: ignore[reportArgumentType]
        "meta": lambda x: x.to("meta"),
        "sparse": lambda x: x.to_sparse(),
        "compressed": lambda x: x.to_sparse_csr(),
        "mkldnn": lambda x: x.to_mkldnn(),
        "nested": lambda x: torch.nested.nested_tensor(list(x)),
        "shorter": lambda x: x[:-1],
        "longer": lambda x: torch.cat((x, x[:1])),
        "narrower": lambda x: x[..., :-1],
        "flat": lambda x: x.flatten(),
        "a dimension more": lambda x: x[None],
        "a dimension less": lambda x: x[0],
        "turned": lambda x: x.mT,
        "empty": lambda x: x[:0],
        "one number": lambda x: x.flatten()[0],
        "huge": lambda x: x.flatten()[:1].expand(2**45),
        "released": lambda x: _resized(x, 0),
        "cut": lambda x: _resized(x, 0.5),
        "NaN": lambda x: x * float("nan"),
        "infinite": lambda x: x + float("inf"),
        "large": lambda x: x * 1e30 + 1e30,
        "random": _random,
    }
    | {
        str(dtype): lambda x, dtype=dtype: x.to(dtype)
        for dtype in (
            torch.float16,
            torch.bfloat16,
            torch.float32,
            torch.float64,
            torch.int64,
            torch.bool,
            torch.complex64,
        )
    }
)


def _structure(words: Tensor, draw: random.Random) -> Changed:
    """Other words, some with the right sum: those must be refused if they would leave their memory."""
    array = words.numpy().copy()
    header = array[:8].tolist()
    blocks = [(0, 8), (header[4], 14), (header[5], 40), (int(array[header[4] + 3]), 18 * int(array[header[4] + 2]))]
    blocks += [(0, len(array))] * 2
    for _ in range(draw.choice((1, 1, 2, 5))):
        start, size = draw.choice(blocks)
        index = start + draw.randrange(size)
        how = draw.choice(("size", "near", "other", "bit", "half", "cut", "grown", "noise"))
        if how in ("cut", "grown"):
            array = np.concatenate((array, array[:index]))[: index if how == "cut" else None]
            if len(array) > 2 and draw.random() < 0.5:
                array[2] = len(array)
            break
        if how == "noise":
            array[max(index, 8) :] = np.random.default_rng(index).integers(-(2**62), 2**62, len(array) - max(index, 8))
        elif how == "bit":
            array[index] ^= np.int64(1) << np.int64(draw.randrange(63))
        elif how == "half":  # one of an instruction's fields
            array.view(np.uint16)[4 * index + draw.randrange(4)] = draw.choice(
                (0, 1, CODES["look_up"], len(CODES) - 1, len(CODES), 1000, 0xFFFF)
            )
        else:
            other = {"size": draw.choice(SIZES), "near": int(array[index]) + draw.choice((-1, 1))}
            array[index] = np.array(other.get(how, int(array[draw.randrange(len(array))]))).astype(np.int64)
    sealed = draw.random() < 0.7 and len(array) >= 8
    if sealed:
        seal(array)
    return "sealed words" if sealed else "words", torch.from_numpy(array)


def _list(numbers: list, draw: random.Random) -> Changed:
    numbers = list(numbers)
    how = draw.choice(("one", "sign", "shorter", "longer", "more"))
    index = draw.randrange(len(numbers))
    if how == "one":
        numbers[index] = type(numbers[0])(draw.choice(SIZES))
    elif how == "sign":  # as many in all
        numbers[index : index + 2] = [-each for each in numbers[index : index + 2]]
    elif how == "shorter":
        del numbers[index]
    elif how == "longer":
        numbers.insert(index, type(numbers[0])(draw.choice(SIZES)))
    else:
        size = draw.choice((1, 4, 20, 2**16, 2**32, 2**62))
        numbers += [type(numbers[0])(each) for each in (size, 4, -size, 4)]
    return f"list, {how}", numbers


def _tensors(call: Call, name: str, draw: random.Random) -> Changed:
    given: list = list(call.arguments[name])
    index, how = draw.randrange(len(given)), draw.choice(("shorter", "twice", "alias", "overlap", *["one"] * 6))
    if how == "shorter":
        del given[index]
    elif how == "twice":
        given.append(given[index])
    elif how == "alias":
        other = draw.choice(("parameters", "gradients", "moments"))
        given[index] = call.arguments[other][index % len(call.arguments[other])]
    elif how == "overlap":
        whole = torch.randn(given[index].numel() + 1, dtype=given[index].dtype)
        given[index] = whole[1:].view(given[index].shape)
        given[index - 1] = whole[: given[index - 1].numel()].view(-1, 1)
    else:
        how = draw.choice(list(WRONG))
        given[index] = WRONG[how](given[index])
    return f"tensors, {how}", given


def break_call(call: Call, draw: random.Random) -> str:
    """Change one argument; return its name and the change."""
    name = draw.choice([name for name, value in call.arguments.items() if value is not None or draw.random() < 0.1])
    name = "structure" if "structure" in call.arguments and draw.random() < 0.2 else name
    value = call.arguments[name]
    if isinstance(value, bool):
        what, value = "other", not value
        if name == "many" and value and draw.random() < 0.5:  # with actions that fit
            call.arguments["actions"] = call.arguments["actions"].unsqueeze(-2)
    elif isinstance(value, int):
        value = draw.choice(SIZES)
        what = str(value)
    elif isinstance(value, float):
        value = draw.choice((0.0, -1.0, 1e300, float("nan"), float("inf")))
        what = str(value)
    elif value is None or isinstance(value, Tensor) and draw.random() < 0.1:
        others = [each for each in call.arguments.values() if isinstance(each, Tensor)]
        what, value = "another argument", draw.choice(others)
    elif isinstance(value, list):
        what, value = _list(value, draw) if not isinstance(value[0], Tensor) else _tensors(call, name, draw)
    elif name == "structure" and draw.random() < 0.8:
        what, value = _structure(value, draw)
    else:
        what = draw.choice(list(WRONG))
        value = WRONG[what](value)
    call.arguments[name] = value
    return f"{name}: {what}"


# One round


def outcome(good: Call, draw: random.Random) -> tuple[str, str]:
    """Return the change of the call, and ``"refused"``, ``"right"``, ``"another model"`` or the fault."""
    call, whats, lost = good.copied(plain), [], False
    for _ in range(draw.choice((1, 1, 1, 2))):
        try:
            whats.append(break_call(call, draw))
        except (RuntimeError, TypeError, ValueError, IndexError):  # torch makes no such tensor
            whats.append("unchanged")
        if lost := any(each.endswith((": released", ", released", ": cut", ", cut")) for each in whats):
            break  # torch itself would read beyond its memory
    what = f"{call.name} {', '.join(whats)}"
    words = call.arguments.get("structure")
    try:
        copy = None if lost else call.copied(lambda tensor: tensor if tensor.is_meta else plain(tensor))
    except (RuntimeError, NotImplementedError):
        copy = None
    try:
        found = call.results()
    except REFUSALS as error:
        text = str(error)
        named = bool(text) and not any(fault in text for fault in FAULTS)
        return what, "refused" if named else f"unnamed {type(error).__name__}: {text[:300]}"
    if lost:
        return what, "accepted what has no memory"
    if words is not None and not words.is_meta and not torch.equal(plain(words), good.arguments["structure"]):
        return what, "another model" if "sealed" in what else "accepted words that were changed"
    if any(each.requires_grad for each in found):
        try:
            sum(each.sum() for each in found if each.requires_grad).backward()  # pyright: ignore
        except REFUSALS as error:
            if any(fault in str(error) for fault in FAULTS):
                return what, f"unnamed in the gradient: {error}"
    try:
        wanted = None if copy is None else copy.results()
    except REFUSALS as error:
        return what, f"accepted, which a copy is not: {error}"
    if wanted is None:
        return what, "accepted what cannot be copied"
    same = len(found) == len(wanted) and all(map(_same, found, wanted))
    return what, "right" if same else "another result than of copies"


def _same(a: Tensor, b: Tensor) -> bool:
    if a.shape != b.shape or a.dtype != b.dtype or a.is_meta or b.is_meta:
        return a.shape == b.shape and a.is_meta and b.is_meta
    return torch.equal(plain(a).view(-1).view(torch.uint8), plain(b).view(-1).view(torch.uint8))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="round to begin with")
    parser.add_argument("--only", default="", help="operator")
    parser.add_argument("--threads", type=int, default=1, help="rounds at once")
    parser.add_argument("--fork", action="store_true", help="each call in a process of its own")
    given = parser.parse_args(arguments)
    calls = [call for call in good_calls() if given.only in call.name]
    names = sorted({call.name for call in calls})
    for call in calls:
        call.copied(plain).run()

    def one(index: int) -> tuple[str, str, str]:
        draw, name = random.Random(f"{given.seed} {index}"), names[index % len(names)]
        call = draw.choice([call for call in calls if call.name == name])
        return name, *(_forked if given.fork else outcome)(call, draw)

    done: Counter[tuple[str, str]] = Counter()
    failed = 0
    with ThreadPoolExecutor(given.threads) as pool:
        rounds = range(given.first, given.first + given.rounds)
        for index, (name, what, found) in zip(rounds, pool.map(one, rounds), strict=True):
            known = found in ("refused", "right", "another model")
            done[name, found if known else "wrong"] += 1
            if not known:
                failed += 1
                sys.stdout.write(f"{index}: {what}: {found}\n")
                sys.stdout.flush()
    for (name, found), count in sorted(done.items()):
        sys.stdout.write(f"{name:16} {found:14} {count}\n")
    sys.stdout.write(f"{failed} of {given.rounds} wrong\n")
    return min(failed, 1)


def _forked(call: Call, draw: random.Random) -> tuple[str, str]:
    read, write = os.pipe()
    if not (child := os.fork()):
        os.close(read)
        what, found = outcome(call, draw)
        os.write(write, f"{what}\n{found}".encode()[:4000])
        os._exit(0)
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        text = pipe.read().decode(errors="replace")
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    what, _, found = text.partition("\n")
    return (what, found) if code == 0 else (call.name, f"ended with code {code}")


if __name__ == "__main__":
    raise SystemExit(main())
