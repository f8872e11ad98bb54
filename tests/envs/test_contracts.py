"""Every environment in every container and under every transform of TorchRL: the steps are those taken by hand."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from functools import cache, partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import (
    ActionScaling,
    CatFrames,
    CatTensors,
    ClipTransform,
    Compose,
    DTypeCastTransform,
    EnvBase,
    ExcludeTransform,
    FrameSkipTransform,
    InitTracker,
    MultiAction,
    ObservationNorm,
    ParallelEnv,
    RenameTransform,
    RewardSum,
    SelectTransform,
    SerialEnv,
    StepCounter,
    TargetReturn,
    TimeMaxPool,
    Transform,
    TransformedEnv,
    UnaryTransform,
    VecNormV2,
)
from torchrl.modules import WorldModel

from torchrl_gn.data import Simulator
from torchrl_gn.dynamics import specialize
from torchrl_gn.envs import ModelEnv, SceneEnv, batched, observation_env, suite_env, world_model_env
from torchrl_gn.envs.transform_checks import note_output, refuse_transforms
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import ObservationGraph, load_scene
from torchrl_gn.training import load_pretrained

PUSH, SPEED, STEPS = 0.75, 1.5, 24  # action, speed of the pole that ends an episode [rad/s], steps of a run
LIMIT = 7  # steps of an episode of the suite
ENVS, SUITE = ["scene", "model", "batched scene", "batched model"], ["suite", "observation"]


@cache
def scene():
    return load_scene("pendulum")


@cache
def reward():
    return make_reward("balance", scene())


@cache
def predictor():
    return specialize(load_pretrained("pendulum").bind(scene()))


def fast(state: Tensor) -> Tensor:
    return state[..., 1, 11].abs() > SPEED


def make(kind: str, seed: int = 0) -> EnvBase:
    if kind == "suite":
        return suite_env("cartpole", "swingup", num_envs=2, steps=LIMIT, seed=seed)
    if kind == "observation":
        return observation_env(ObservationGraph.swimmer(3), "swimmer", "swimmer3", num_envs=2, steps=LIMIT, seed=seed)
    if kind.endswith("scene"):
        env: EnvBase = SceneEnv(scene(), reward(), done=fast, seed=seed)
    else:
        env = ModelEnv(predictor(), reward(), done=fast, seed=seed)
    return batched(env, 3) if kind.startswith("batched") else env


class Push(nn.Module):
    """A constant action."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__()
        self.shape = shape

    def forward(self, done: Tensor) -> Tensor:
        return torch.full(self.shape, PUSH)


def push(env: EnvBase) -> TensorDictModule:
    return TensorDictModule(Push(tuple(env.action_spec.shape)), ["done"], ["action"])


def itself(kind: str) -> TensorDictBase:
    return run(make(kind, 3))


def run(env: EnvBase) -> TensorDictBase:
    played = env.rollout(STEPS, push(env), break_when_any_done=False)
    env.close()
    return played


def in_turn(container: Any, kind: str) -> TensorDictBase:
    env = container(2, [partial(make, kind, 3), partial(make, kind, 5)])
    if kind not in SUITE:  # whose seeds are given when they are made
        env.set_seed(3)
    return run(env)


def collected(container: Any, kind: str) -> TensorDictBase:
    env = make(kind, 3)
    frames = STEPS * env.batch_size.numel()
    makers: Any = env if container is Collector else [partial(make, kind, 3), partial(make, kind, 5)]
    options: dict[str, Any] = {}
    if container is MultiSyncCollector:
        frames, options = 2 * frames, {"cat_results": "stack"}
    collector = container(
        makers,
        push(env),
        frames_per_batch=frames,
        total_frames=frames,
        auto_register_policy_transforms=False,
        **options,
    )
    data = next(iter(collector)).clone()
    collector.shutdown()
    return data


CONTAINERS: dict[str, Callable[[str], TensorDictBase]] = {
    "itself": itself,
    "SerialEnv": partial(in_turn, SerialEnv),
    "Collector": partial(collected, Collector),
    "ParallelEnv": partial(in_turn, ParallelEnv),
    "MultiSyncCollector": partial(collected, MultiSyncCollector),
    "MultiAsyncCollector": partial(collected, MultiAsyncCollector),
}
SLOW = ("ParallelEnv", "MultiSyncCollector", "MultiAsyncCollector")  # start processes

pytestmark = pytest.mark.usefixtures("quick_processes")


def by_hand(kind: str, data: TensorDictBase, action: Tensor) -> TensorDict:
    """Expected output of each of the steps ``[*B, T]``."""
    state = data["state"]
    if kind.endswith("scene"):
        simulated = Simulator(scene()).rollout(data["physics"], action.unsqueeze(-2).double())
        after, physics = simulated["state"][..., 1, :, :], {"physics": simulated["physics"][..., 1, :]}
    else:
        after, physics = predictor().step(state, action)[0], {}
    ended = fast(after).unsqueeze(-1)
    rewards = reward()(state, action, after).float()
    entries = {"state": after, "reward": rewards, "terminated": ended, "done": ended}
    return TensorDict({**entries, **physics}, data.shape)


def check_steps(kind: str, data: TensorDictBase, action: Tensor | None = None) -> None:
    """Steps equal a loop's: each starts at the last state, or at a new start after an end; some episodes end."""
    expected = by_hand(kind, data, data["action"] if action is None else action)
    for key, value in expected.items():
        found = data["next", key]
        if value.dtype == torch.bool:
            assert key == "done" or torch.equal(found, value), key
        else:
            torch.testing.assert_close(found, value, rtol=1e-6, atol=1e-7)
    assert torch.equal(data["next", "done"] | expected["done"], data["next", "done"])
    check_resets(data, "state")


def check_resets(data: TensorDictBase, key: str) -> None:
    """Rows ``[..., T]`` go on from the step before, or from a new start after each end, and never elsewhere."""
    done, dims = data["next", "done"][..., :-1, 0], data.ndim
    before, after = data["next", key].movedim(dims - 1, 0)[:-1], data[key].movedim(dims - 1, 0)[1:]
    same = (before == after).flatten(dims).all(-1).movedim(0, -1) if dims > 1 else (before == after).flatten(1).all(-1)
    assert done.any() and not done.all()
    assert torch.equal(same, ~done)
    assert not data["done"].any()


@pytest.mark.parametrize("kind", ENVS)
@pytest.mark.parametrize(
    "container", [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in CONTAINERS]
)
def test_steps_are_those_by_hand_in_every_container(container, kind):
    data = CONTAINERS[container](kind)
    assert data.shape[-1] == STEPS
    check_steps(kind, data)


@pytest.mark.slow
@pytest.mark.parametrize("kind", SUITE)
@pytest.mark.parametrize(
    "container", [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in CONTAINERS]
)
def test_tasks_of_the_suite_are_its_own_in_every_container(container, kind):
    data = CONTAINERS[container](kind)
    assert data.shape[-1] == STEPS
    check_resets(data, "observation")
    done = data["next", "done"].squeeze(-1).reshape(-1, STEPS)
    assert torch.equal(done, ((torch.arange(STEPS) + 1) % LIMIT == 0).expand_as(done))
    rows = data.reshape(-1, STEPS)
    seeds = [seed for given in (3, 5) for seed in np.random.SeedSequence(given).generate_state(2).tolist()]
    if container == "MultiAsyncCollector" and not begins_like(kind, rows[0], seeds[0]):
        seeds = seeds[2:]  # the second worker was faster
    for row, seed in zip(rows.unbind(0), seeds, strict=False):
        check_against_dm_control(kind, row, seed)


def begins_like(kind: str, row: TensorDictBase, seed: int) -> bool:
    try:
        check_against_dm_control(kind, row[:1], seed)
    except AssertionError:
        return False
    return True


def check_against_dm_control(kind: str, row: TensorDictBase, seed: int) -> None:
    from torchrl_gn.scenes.suite_tasks import load_suite_task, suite_modules

    names = ("cartpole", "swingup") if kind == "suite" else ("swimmer", "swimmer3")
    loaded = load_suite_task(*names, seed)
    limit = (LIMIT - 0.5) * loaded.control_timestep()
    own = suite_modules()[2].Environment(
        loaded.physics, loaded.task, time_limit=limit, control_timestep=loaded.control_timestep()
    )
    # TorchRL's wrapper resets once when it is made, and SerialEnv's once more at the first reset.
    given = row["observation"][0].numpy()
    for _ in range(4):
        at = own.reset()
        if np.allclose(flat(at), given, atol=1e-6):
            break
    for now in row.unbind(0):
        np.testing.assert_allclose(now["observation"], flat(at), rtol=1e-5, atol=1e-5)
        at = own.step(now["action"].numpy())
        np.testing.assert_allclose(now["next", "observation"], flat(at), rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(now["next", "reward"], at.reward, rtol=1e-5, atol=1e-6)
        if at.last():
            at = own.reset()


def flat(step: Any) -> np.ndarray:
    return np.concatenate([np.ravel(part) for part in step.observation.values()])


def since_start(done: Tensor) -> Tensor:
    """Steps ``[..., T, 1]`` of the episode before each."""
    steps = torch.zeros(done.shape, dtype=torch.int64)
    for t in range(1, done.shape[-2]):
        steps[..., t, :] = torch.where(done[..., t - 1, :], 0, steps[..., t - 1, :] + 1)
    return steps


def summed(reward: Tensor, done: Tensor) -> Tensor:
    """Sum ``[..., T, 1]`` of the episode's rewards up to each step."""
    total = reward.clone()
    for t in range(1, reward.shape[-2]):
        total[..., t, :] += torch.where(done[..., t - 1, :], 0, total[..., t - 1, :])
    return total


def check_counter(data: TensorDictBase) -> None:
    assert torch.equal(data["step_count"], since_start(data["next", "done"]))
    assert torch.equal(data["next", "truncated"], data["next", "step_count"] >= 5)
    assert (data["next", "step_count"] <= 5).all() and data["next", "truncated"].any()


def check_sum(data: TensorDictBase) -> None:
    expected = summed(data["next", "reward"], data["next", "done"])
    torch.testing.assert_close(data["next", "episode_reward"], expected)


def check_init(data: TensorDictBase) -> None:
    assert torch.equal(data["is_init"], since_start(data["next", "done"]) == 0)
    assert not data["next", "is_init"].any()


def check_norm(key: str, data: TensorDictBase) -> None:
    torch.testing.assert_close(data["normed"], data[key] * 2 + 1)


def check_frames(key: str, data: TensorDictBase) -> None:
    age = since_start(data["next", "done"])
    size, steps = data[key].shape[data.ndim], data.shape[-1]
    rows = data.reshape(-1, steps)
    for row, ages in zip(rows.unbind(0), age.reshape(-1, steps), strict=True):
        for t in range(steps):
            window = [row[key][t - min(back, int(ages[t]))] for back in (2, 1, 0)]
            torch.testing.assert_close(row["frames"][t], torch.cat(window, 0))
    assert data["frames"].shape[data.ndim] == 3 * size


def check_target(data: TensorDictBase) -> None:
    left = 10 - summed(data["next", "reward"], data["next", "done"])
    torch.testing.assert_close(data["next", "target_return"], left, rtol=1e-5, atol=1e-5)


def transforms(key: str) -> dict[str, tuple[Callable[[], Any], Callable[[TensorDictBase], None]]]:
    dim = -2 if key == "state" else -1
    return {
        "StepCounter": (partial(StepCounter, 5), check_counter),
        "RewardSum": (RewardSum, check_sum),
        "InitTracker": (InitTracker, check_init),
        "ActionScaling": (partial(ActionScaling, standard_normal=False), lambda _: None),
        "ObservationNorm": (
            partial(ObservationNorm, loc=1.0, scale=2.0, in_keys=[key], out_keys=["normed"]),
            partial(check_norm, key),
        ),
        "CatFrames": (partial(CatFrames, 3, dim, in_keys=[key], out_keys=["frames"]), partial(check_frames, key)),
        "TargetReturn": (partial(TargetReturn, 10.0), check_target),
    }


@pytest.mark.parametrize("kind", [*ENVS, *SUITE])
@pytest.mark.parametrize("name", list(transforms("state")))
def test_transforms_write_what_they_say(name, kind):
    make_transform, check = transforms("observation" if kind in SUITE else "state")[name]
    env = TransformedEnv(make(kind, 3), make_transform(), auto_unwrap=True)
    data = run(env)
    check(data)
    if kind in SUITE:
        check_resets(data, "observation")
    else:
        check_steps(kind, data, 2 * data["action"] - 1 if name == "ActionScaling" else None)


@pytest.mark.parametrize("kind", ENVS)
@pytest.mark.parametrize("change", [{"loc": 1.0, "scale": 2.0}, {"loc": 0.1, "scale": 1.0}, {"loc": 0.0, "scale": 0.9}])
def test_a_transform_over_the_state_is_harmless_or_refused(kind, change):
    """The model steps from ``state``, the simulation from ``physics``."""
    env = TransformedEnv(make(kind, 3), ObservationNorm(in_keys=["state"], **change), auto_unwrap=True)
    if kind.endswith("model"):
        with pytest.raises(TypeError, match=r"ObservationNorm changes 'state', from which the next step of ModelEnv"):
            run(env)
        start = env.base_env.rand_action(env.base_env.reset())
        start["state"] = start["state"] * change["scale"] + change["loc"]
        with pytest.raises(ValueError, match=r"a quaternion of 'state' .* must write them to another key, out_keys="):
            env.base_env.step(start)  # the transform is not always in sight
        return
    data = run(env)
    expected = by_hand(kind, data.clone().set("state", Simulator(scene()).observe(data["physics"])), data["action"])
    torch.testing.assert_close(data["next", "physics"], expected["physics"], rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(data["next", "state"], expected["state"] * change["scale"] + change["loc"])
    torch.testing.assert_close(data["next", "reward"], expected["reward"])


@pytest.mark.parametrize("kind", ENVS)
def test_a_transform_that_drops_what_a_step_starts_from_is_refused(kind):
    """TorchRL would step from the first state again and again."""
    key = "state" if kind.endswith("model") else "physics"
    dropped = rf"SelectTransform or .* drops '{key}', from which the next step of .*Env"
    for drop in (SelectTransform("reward"), ExcludeTransform(key), CatTensors([key], "all", dim=-1)):
        with pytest.raises(TypeError, match=dropped):
            run(TransformedEnv(make(kind, 3), drop, auto_unwrap=True))
    kept = TransformedEnv(make(kind, 3), SelectTransform("state", "physics"), auto_unwrap=True)
    check_steps(kind, run(kept), None)
    renamed = RenameTransform([key], ["here"], in_keys_inv=[key], out_keys_inv=["here"])
    data = run(TransformedEnv(make(kind, 3), renamed, auto_unwrap=True))
    for at in (data, data["next"]):
        at.rename_key_("here", key)
    check_steps(kind, data, None)


def sines(in_keys: list[str], out_keys: list[str] | None = None) -> Transform:
    return UnaryTransform(in_keys=in_keys, out_keys=out_keys or in_keys, fn=torch.sin)


class Sines(Transform):
    """Transform of a user's own class that replaces entries by their sines."""

    def __init__(self, in_keys: list[str], out_keys: list[str] | None = None) -> None:
        super().__init__(in_keys=in_keys, out_keys=out_keys or in_keys)

    def _apply_transform(self, obs: Tensor) -> Tensor:
        return obs.sin()

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Any) -> Any:
        for one, other in zip(self.in_keys, self.out_keys, strict=True):
            observation_spec[other] = observation_spec[one].clone()
        return observation_spec


@pytest.mark.parametrize(
    "change",
    [
        partial(ObservationNorm, 0.0, 1.0),
        partial(ClipTransform, low=-1.0, high=1.0),
        VecNormV2,
        partial(TimeMaxPool, T=2),
        sines,
        Sines,
    ],
)
@pytest.mark.filterwarnings("ignore:Support of VecNormV2 for unbatched")
@pytest.mark.parametrize(("kind", "key"), [("scene", "physics"), ("model", "state")])
def test_transforms_of_what_a_step_starts_from_are_refused(kind, key, change):
    """Quaternions of unit length do not show all of them."""
    env = TransformedEnv(make(kind), Compose(StepCounter(), change(in_keys=[key])), auto_unwrap=True)
    with pytest.raises(TypeError, match=rf"{type(env.transform[1]).__name__} changes '{key}', from which the next"):
        run(env)
    run(TransformedEnv(make(kind), change(in_keys=[key], out_keys=["other"]), auto_unwrap=True))


@pytest.mark.parametrize(("kind", "key"), [("scene", "physics"), ("model", "state")])
def test_casts_that_lose_digits_of_what_a_step_starts_from_are_refused(kind, key):
    for keys in ({}, {"in_keys": [key], "in_keys_inv": [key]}):
        run(TransformedEnv(make(kind), DTypeCastTransform(torch.float64, torch.float32, **keys), auto_unwrap=True))
        cast = DTypeCastTransform(torch.float64, torch.bfloat16, **keys)
        with pytest.raises(TypeError, match=f"DTypeCastTransform changes '{key}', from which the next"):
            run(TransformedEnv(make(kind), cast, auto_unwrap=True))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["scene", "model"])
def test_transforms_around_worker_processes_write_what_they_say(kind):
    env = ParallelEnv(2, [partial(make, kind, 3), partial(make, kind, 5)])
    env.set_seed(3)
    for name in ("StepCounter", "RewardSum", "InitTracker"):
        env = env.append_transform(transforms("state")[name][0]())
    data = run(env)
    check_steps(kind, data)
    for check in (check_counter, check_sum, check_init):
        check(data)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["scene", "model"])
@pytest.mark.parametrize("misleading", ["skip", "norm"])
def test_transforms_around_worker_processes_that_mislead_them_are_refused(kind, misleading):
    env, key = (
        ParallelEnv(2, [partial(make, kind, 3), partial(make, kind, 5)]),
        "physics" if kind == "scene" else "state",
    )
    change = FrameSkipTransform(2) if misleading == "skip" else ObservationNorm(loc=1e-3, scale=1.0, in_keys=[key])
    with pytest.raises(RuntimeError, match="worker . dead"):  # after it has printed its error
        run(TransformedEnv(env, change))


@pytest.mark.parametrize("key", ["physics", "state"])
def test_workers_tell_what_misleads_them_from_resets_and_ends(key, monkeypatch):
    monkeypatch.setattr(multiprocessing, "parent_process", multiprocessing.current_process)
    env, worker = SimpleNamespace(), partial(_in_worker, key=key)
    first, second, third = (torch.full((2, 3), float(number)) for number in range(3))
    action = torch.zeros(2, 1)
    worker(env, first, action, reset=first, wrote=second)
    worker(env, second, action, wrote=third)
    worker(env, torch.stack((third[0], first[0])), action, reset=first, wrote=third)  # one of two begins anew
    worker(env, third, action, wrote=third)  # a step that diverges
    worker(env, third, action, wrote=third)
    worker(env, second, action, wrote=third)  # from a state of one's own
    with pytest.raises(TypeError, match="would repeat the same step"):
        worker(env, second, action, wrote=third)
    worker(env, 9 + first, action, reset=first, wrote=second)  # a rollout from another state
    worker(env, second, action, wrote=third)
    worker(env, 9 + first, action, reset=first, wrote=second)
    with pytest.raises(TypeError, match=f"changes '{key}'"):
        worker(env, 9 + second, action, wrote=third)


def _in_worker(env, given, action, *, key, wrote, reset=None) -> None:
    if reset is not None:
        note_output(env, reset, reset=True)

    def _run_worker_pipe_shared_mem() -> None:
        step()

    def step() -> None:
        refuse_transforms(env, TensorDict({key: given, "action": action}, [2]), key)

    _run_worker_pipe_shared_mem()
    note_output(env, wrote, reset=False)


@pytest.mark.parametrize("kind", [*ENVS, *SUITE])
def test_all_episodes_of_a_batch_are_played_to_their_own_ends(kind):
    """``break_when_all_done``: where an episode has ended its last step stands."""
    env = TransformedEnv(make(kind, 3), StepCounter(30), auto_unwrap=True)
    data = env.rollout(40, push(env), break_when_all_done=True)
    rows = data.reshape(-1, data.shape[-1])
    for row in rows.unbind(0):
        length = int(row["next", "done"].long().argmax()) + 1
        assert row["next", "step_count"].flatten()[:length].tolist() == [*range(1, length + 1)]
        if kind not in SUITE:
            expected = by_hand(kind, row[:length], row["action"][:length])
            torch.testing.assert_close(row["next", "state"][:length], expected["state"], rtol=1e-6, atol=1e-7)
    assert rows["next", "done"][:, -1].all()


@pytest.mark.parametrize("kind", ENVS)
@pytest.mark.parametrize("inside", [False, True])
def test_frame_skips_are_refused_and_multi_actions_are_right(kind, inside):
    transform = FrameSkipTransform(3)
    if inside:
        env: EnvBase = SerialEnv(2, lambda: TransformedEnv(make(kind, 3), transform.clone(), auto_unwrap=True))
    else:
        env = TransformedEnv(make(kind, 3), transform, auto_unwrap=True)
    with pytest.raises(TypeError, match=r"FrameSkipTransform would repeat .* MultiAction\(\).*load_scene"):
        run(env)
    env = TransformedEnv(make(kind, 3), MultiAction(stack_rewards=False, stack_observations=False), auto_unwrap=True)
    start = env.reset()
    start["action"] = torch.full((*env.batch_size, 3, 1), PUSH)
    now, plain = start.clone(), make(kind, 3)
    found = env.step(start)["next", "state"]
    for _ in range(3):
        now = plain.step(now.set("action", torch.full((*env.batch_size, 1), PUSH)))["next"]
        now = now.select("state", "physics", strict=False)
    assert torch.equal(found, now["state"])


@pytest.mark.slow
@pytest.mark.parametrize("kind", SUITE)
def test_frame_skips_of_the_suite_are_its_own(kind):
    env, plain = TransformedEnv(make(kind, 3), FrameSkipTransform(3), auto_unwrap=True), make(kind, 3)
    skipped, steps = env.step(push(env)(env.reset())), plain.rollout(3, push(plain))
    torch.testing.assert_close(skipped["next", "observation"], steps["next", "observation"][:, -1])
    torch.testing.assert_close(skipped["next", "reward"], steps["next", "reward"].sum(1))


def dreams(size: int = 3) -> EnvBase:
    step = ["state", "action", ("next", "state")]
    world = WorldModel(
        encoder=TensorDictModule(nn.Identity(), in_keys=["state"], out_keys=["state"]),
        dynamics=predictor(),
        reward_head=TensorDictModule(reward(), in_keys=step, out_keys=[("next", "reward")]),
        done_head=TensorDictModule(
            lambda state: fast(state).unsqueeze(-1), in_keys=[("next", "state")], out_keys=[("next", "done")]
        ),
    )
    return world_model_env(world, SceneEnv(scene(), reward(), seed=3), size)


@pytest.mark.parametrize("name", ["none", "StepCounter", "RewardSum", "InitTracker"])
def test_dreams_are_those_by_hand(name):
    env, check = dreams(), lambda _: None
    start = batched(SceneEnv(scene(), reward(), seed=3), 3).reset().select("state")
    if name != "none":
        make_transform, check = transforms("state")[name]
        env = TransformedEnv(env, make_transform())
    data = env.rollout(8, push(env), tensordict=env.reset(start), auto_reset=False, break_when_all_done=True)
    expected = by_hand("model", data, data["action"])
    torch.testing.assert_close(data["next", "state"], expected["state"])
    torch.testing.assert_close(data["next", "reward"], expected["reward"])
    skip = TransformedEnv(dreams(), FrameSkipTransform(2))
    with pytest.raises(TypeError, match="FrameSkipTransform would repeat"):
        skip.step(push(skip)(skip.reset(start)))


def test_dreams_end_within_a_chunk_of_actions():
    start = batched(SceneEnv(scene(), reward(), seed=3), 3).reset().select("state")
    env, chunks = dreams(), TransformedEnv(dreams(), MultiAction(stack_rewards=False))
    actions = torch.ones(3, 30, *env.action_spec.shape[1:])
    now, last, ended = env.reset(start.clone()), start["state"], torch.zeros(3, 1, dtype=torch.bool)
    for action in actions.unbind(1):
        now = env.step(now.set("action", action))["next"]
        last, ended = torch.where(ended.unsqueeze(-1), last, now["state"]), ended | now["done"]
        now = now.exclude("reward", "done")
    after = chunks.step(chunks.reset(start.clone()).set("action", actions))["next"]
    assert 0 < ended.sum() < 3 and torch.equal(after["done"], ended)
    torch.testing.assert_close(after["state"], last)
