"""Settings of all tests."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import resource
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import mujoco
import pytest
import torch
from torch import Tensor

from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.dynamics.bound import update_dynamic_normalizers, update_parameter_normalizers
from torchrl_gn.maths import quaternion
from torchrl_gn.networks import Graph, GraphSize
from torchrl_gn.policies import ObservationModel
from torchrl_gn.scenes import ObservationGraph, Scene

from . import zoo
from .sizes import SMALL


@pytest.fixture(scope="session")
def scenes() -> dict[str, Scene]:
    """Scenes by name; ``falling`` has no action."""
    return {name: zoo.load(name) for name in ("pendulum", "swimmer6", "cheetah", "joints", "falling")}


def _random_states(scene: Scene, *batch: int, seed: int = 0, scale: float = 1.0) -> Tensor:
    """``[*batch, N, C]`` float64 states that differ in movable components only."""
    generator = torch.Generator().manual_seed(seed)
    bodies, activated = torch.as_tensor(scene.movable, dtype=torch.float64).split((12, scene.state_size - 13), dim=-1)
    shape = (*batch, scene.num_nodes, 12)
    noise = scale * bodies * torch.randn(shape, generator=generator, dtype=torch.float64)
    offset = torch.zeros(scene.num_nodes, 3, dtype=torch.float64)
    offset[1:, 2] = 0.5
    activations = activated * torch.rand(*batch, *activated.shape, generator=generator, dtype=torch.float64)
    poses = offset + noise[..., :3], quaternion.exp(noise[..., 3:6])
    return torch.cat((*poses, noise[..., 6:], activations), dim=-1)


@pytest.fixture(scope="module")
def quick_processes() -> Iterator[None]:
    """Processes of containers begin as copies of one that has imported the library: seconds less than by "spawn"."""
    before = multiprocessing.get_start_method(allow_none=True)
    multiprocessing.set_forkserver_preload(["torchrl.collectors", "torchrl_gn.envs", "torchrl_gn.training"])
    multiprocessing.set_start_method("forkserver", force=True)
    yield
    multiprocessing.set_start_method(before, force=True)


@pytest.fixture(scope="session")
def random_states() -> Callable[..., Tensor]:
    return _random_states


@pytest.fixture(scope="session")
def random_actions() -> Callable[..., Tensor]:
    def draw(scene: Scene, *batch: int, seed: int = 0) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        bounds = (torch.as_tensor(bound) for bound in (scene.action_low, scene.action_high))
        low, high = (bound.nan_to_num(neginf=-1.0, posinf=1.0) for bound in bounds)
        return low + (high - low) * torch.rand(*batch, scene.num_actions, generator=generator, dtype=torch.float64)

    return draw


@pytest.fixture(scope="session")
def fit(random_states, random_actions) -> Callable[..., ForwardModel]:
    """Take made-up transitions of a scene into a model's statistics."""

    def fit(model: ForwardModel, scene: Scene) -> ForwardModel:
        bound = model.bind(scene)
        state = random_states(scene, 100)
        update_parameter_normalizers(bound)
        generator = torch.Generator().manual_seed(1)
        shape = 100, scene.num_nodes, model.layout.delta_size
        change = 0.02 * torch.randn(shape, generator=generator, dtype=torch.float64)
        change = change * torch.as_tensor(scene.movable)
        update_dynamic_normalizers(bound, state, random_actions(scene, 100), model.layout.apply(state, change))
        return model

    return fit


@pytest.fixture
def make_model(fit) -> Callable[..., ForwardModel]:
    """A small model with random weights and statistics of made-up transitions of a scene."""

    def make(scene: Scene, *, fitted: bool = True, seed: int = 0, **options) -> ForwardModel:
        torch.manual_seed(seed)
        model = ForwardModel.for_scene(scene, **(SMALL | options))
        return fit(model, scene) if fitted else model

    return make


@pytest.fixture(scope="session")
def random_graph() -> Callable[..., Graph]:
    """Random features on a given topology, float64."""

    def make(size: GraphSize, edge_index: Tensor, num_nodes: int, *batch: int, seed: int = 0) -> Graph:
        generator = torch.Generator().manual_seed(seed)

        def features(*shape: int) -> Tensor:
            return torch.randn(*batch, *shape, generator=generator, dtype=torch.float64)

        return Graph(
            features(num_nodes, size.nodes),
            features(edge_index.shape[1], size.edges),
            features(size.globals_),
            edge_index,
        )

    return make


def _branching() -> ObservationGraph:
    return ObservationGraph(
        name="branching",
        observation={"height": 1, "angles": 3, "velocities": 4, "goal": 2},
        nodes={
            "torso": ("height", "velocities[0:2]"),
            "arm": ("velocities[2]",),
            "leg": (),
            "foot": ("velocities[3]",),
        },
        joints={("torso", "arm"): ("angles[0]",), ("torso", "leg"): ("angles[1:3]",), ("leg", "foot"): ()},
        globals_=("goal",),
        actions={("torso", "leg"): (2, 0), ("leg", "foot"): (1,)},
        identity=True,
    )


@pytest.fixture(scope="session")
def observation_graphs() -> dict[str, ObservationGraph]:
    """A chain of equal links, and a tree whose nodes and joints have unlike numbers of features."""
    return {"swimmer3": ObservationGraph.swimmer(3), "branching": _branching()}


@pytest.fixture(scope="session")
def transitions() -> Callable[..., tuple[Tensor, Tensor, Tensor]]:
    """Made-up float64 observations, actions and next observations of a graph, every number on its own scale."""

    def draw(graph: ObservationGraph, count: int = 50, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
        generator = torch.Generator().manual_seed(seed)
        size, actions = graph.num_observations, graph.num_actions
        observation, change = torch.randn(2, count, size, generator=generator, dtype=torch.float64)
        scale = torch.arange(1, size + 1, dtype=torch.float64)
        action = 2 * torch.rand(count, actions, generator=generator, dtype=torch.float64) - 1
        return scale * observation + 1, action, scale * (observation + 0.1 * change) + 1.5

    return draw


@pytest.fixture
def make_observation_model(transitions) -> Callable[..., ObservationModel]:
    """A small float64 model with random weights that has seen made-up transitions."""

    def make(graph: ObservationGraph, *, seed: int = 0, **options) -> ObservationModel:
        torch.manual_seed(seed)
        model = ObservationModel(graph, **({"latent": 4, "hidden": (8,), "mlp_hidden": (8, 8)} | options)).double()
        model.update_normalizers(*transitions(graph))
        return model

    return make


# Small tensors gain nothing from more threads, and threads on a busy machine wait for each other.
THREADS = int(os.environ.get("TORCHRL_GN_TEST_THREADS", "1"))
torch.set_num_threads(THREADS)

# The compiler's cache does not tell one processor's code from another's: pretending to have another needs its own.
if capability := os.environ.get("ATEN_CPU_CAPABILITY"):
    cache = os.path.join(tempfile.gettempdir(), f"torchrl_gn_tests_{os.getuid()}_{capability}")
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", cache)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--one-of-each",
        action="store_true",
        help="run each test with the first of its parameters alone, as CI does with old versions",
    )


@pytest.hookimpl(trylast=True)  # of those that -m leaves
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--one-of-each"):
        return
    first = {item.nodeid.partition("[")[0]: item for item in reversed(items)}
    kept = [item for item in items if first[item.nodeid.partition("[")[0]] is item]
    config.hook.pytest_deselected(items=[item for item in items if item not in set(kept)])
    items[:] = kept


def pytest_configure(config: pytest.Config) -> None:
    # An older MuJoCo gives bodies of jaco other principal axes, in the fourth digit, and its trained model says so.
    if tuple(map(int, mujoco.__version__.split(".")[:2])) < (3, 14):
        config.addinivalue_line("filterwarnings", "ignore::torchrl_gn.scenes.SceneChangedWarning")


def pytest_runtest_setup() -> None:
    """Recipes set the number of threads by their options, TorchRL's SerialEnv raises it when it is closed."""
    torch.set_num_threads(THREADS)


@pytest.fixture
def calls(monkeypatch) -> Callable[..., list]:
    """``calls(owner, name)``: what ``seen`` makes of the arguments of a function's calls; it runs as before."""

    def watch(owner: object, name: str, seen: Callable = lambda *arguments, **_: arguments) -> list:
        made, function = [], getattr(owner, name)

        def watched(*arguments, **options):
            made.append(seen(*arguments, **options))
            return function(*arguments, **options)

        monkeypatch.setattr(owner, name, watched)
        return made

    return watch


@pytest.fixture
def folds(calls) -> list:
    """Every core that is folded during the test, as a specialised model does when weights or values have changed."""
    from torchrl_gn.networks import GNCore

    return calls(GNCore, "fold", lambda core, *_: core)


@pytest.fixture
def ctrl_c(monkeypatch) -> Iterator[Callable[..., None]]:
    """``ctrl_c(owner, name, 3)``: Ctrl-C, or another signal, comes in the third call of a function, before its end."""
    # Where pytest runs in the background, as in CI, its shell may have had it ignore Ctrl-C.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    def interrupt(owner: object, name: str, count: int, number: int = signal.SIGINT) -> None:
        calls, function = itertools.count(1), getattr(owner, name)

        def interrupted(*arguments, **options):
            result = function(*arguments, **options)
            if next(calls) == count:
                os.kill(os.getpid(), number)
            return result

        monkeypatch.setattr(owner, name, interrupted)

    yield interrupt
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def files_end_at() -> Callable[[int], AbstractContextManager]:
    """``with files_end_at(1000):`` files of this process take 1000 bytes, as if the disk were full then."""

    @contextmanager
    def limited(size: int) -> Iterator[None]:
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    return limited


@pytest.fixture
def ends() -> Callable[[int, float], bool]:
    """Whether a process is gone within seconds: a signal takes effect once its receiver is scheduled."""

    def gone(process: int) -> bool:
        try:
            state = Path(f"/proc/{process}/stat").read_text()
        except (FileNotFoundError, ProcessLookupError):
            return True
        return state.rpartition(")")[2].split()[0] == "Z"

    def within(process: int, seconds: float) -> bool:
        deadline = time.monotonic() + seconds
        while not gone(process) and time.monotonic() < deadline:
            time.sleep(0.01)
        return gone(process)

    return within
