"""Adaptation to changed effects of a robot's commands."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torchrl_gn.data import Simulator, collect_trajectories
from torchrl_gn.dynamics import Adaptation, AdaptedPredictor, Predictor, RobotChange, specialize
from torchrl_gn.envs import ModelEnv
from torchrl_gn.planners import GradientPlanner
from torchrl_gn.scenes import Scene, with_factors
from torchrl_gn.training import load_pretrained

STEPS = 60
NONE = torch.zeros(0), torch.zeros(0)  # amounts of no variant


@pytest.fixture(scope="module")
def predictor(scenes):
    return specialize(load_pretrained("swimmer6").model.bind(scenes["swimmer6"]), executor="eager")


@pytest.fixture(scope="module")
def unchanged(scenes) -> TensorDict:
    return collect_trajectories(scenes["swimmer6"], 20, STEPS, seed=1)


@pytest.fixture(scope="module")
def adaptation(predictor, unchanged) -> Adaptation:
    return Adaptation(predictor, unchanged)


def simulated(scenes, gain: Tensor, offset: Tensor, *, count: int = 4) -> TensorDict:
    """Trajectories of robots ``[count]`` whose commands act as ``gain * command + offset``."""
    given = collect_trajectories(scenes["swimmer6"], count, STEPS, seed=2)
    acting = gain * given["action"] + offset
    state = Simulator(scenes["swimmer6"]).rollout(given["physics"][:, 0], acting)["state"]
    return TensorDict({"state": state, "action": given["action"]}, [count])


def learned(adaptation: Adaptation, stream: TensorDict, *, steps: int = STEPS):
    belief = adaptation.start(len(stream))
    for step in range(steps):
        belief = adaptation.update(
            belief, stream["state"][:, step], stream["action"][:, step], stream["state"][:, step + 1]
        )
    return belief


def test_it_finds_gains_and_offsets(scenes, adaptation, predictor):
    gain = torch.tensor([0.0, 1.0, 0.5, 1.0, 1.0]).double()
    offset = torch.tensor([0.0, 0.0, 0.0, 0.05, 0.0]).double()
    stream = simulated(scenes, gain, offset)
    found = adaptation.read(learned(adaptation, stream))
    torch.testing.assert_close(found.gain, gain.expand(4, 5), rtol=0, atol=0.05)
    torch.testing.assert_close(found.offset, offset.expand(4, 5), rtol=0, atol=0.02)
    raw = adaptation.read(learned(adaptation, stream), guarded=False)
    off = torch.cat(((raw.gain - gain) / raw.gain_std, (raw.offset - offset) / raw.offset_std))
    assert (off.abs() < 3).double().mean() > 0.9 and raw.gain_std.max() < 0.03
    adapted = AdaptedPredictor(predictor, RobotChange(*(part[0] for part in found)))
    start, actions, true = stream["state"][:, 0], stream["action"], stream["state"]
    off = [
        (model - true).square().mean()
        for model in (predictor.rollout(start, actions)[0], adapted.rollout(start, actions))
    ]
    assert off[1] < 1e-2 * off[0]


def test_a_motor_that_rested_in_the_trajectories_can_change_too(scenes, predictor, unchanged):
    resting = unchanged.select("physics", "action").clone()
    resting["action"][..., 3] = 0.0
    resting["state"] = Simulator(scenes["swimmer6"]).rollout(resting["physics"][:, 0], resting["action"])["state"]
    adaptation = Adaptation(predictor, resting)
    gain, offset = torch.tensor([1.0, 1.0, 1.0, 0.5, 1.0]).double(), torch.tensor([0.0, 0.0, 0.0, 0.1, 0.0]).double()
    found = adaptation.read(learned(adaptation, simulated(scenes, gain, offset)), guarded=False)
    torch.testing.assert_close(found.offset, offset.expand(4, 5), rtol=0, atol=0.04)
    torch.testing.assert_close(found.gain, gain.expand(4, 5), rtol=0, atol=0.08)
    off = (found.gain - gain) / found.gain_std, (found.offset - offset) / found.offset_std
    assert (torch.cat(off)[:, 3].abs() < 4).double().mean() > 0.8
    fresh = adaptation.read(adaptation.start(), guarded=False)
    width = torch.as_tensor(scenes["swimmer6"].action_high - scenes["swimmer6"].action_low).double()
    assert fresh.offset_std[3] > 0.1 * width[3] / 12**0.5


def test_an_unchanged_robot_keeps_its_model(scenes, adaptation):
    ones, zeros = torch.ones(5).double(), torch.zeros(5).double()
    found = adaptation.read(learned(adaptation, simulated(scenes, ones, zeros, count=8)))
    assert (found.gain == 1).double().mean() > 0.9 and (found.gain - 1).abs().max() < 0.05


def test_robots_of_a_batch_are_their_own(scenes, adaptation):
    gain = torch.stack([torch.eye(5)[0], torch.ones(5)]).double().unsqueeze(1)
    stream = simulated(scenes, gain, torch.zeros(5).double(), count=2)
    together = adaptation.read(learned(adaptation, stream, steps=10))
    belief = adaptation.start()
    for step in range(10):
        state, action = stream["state"][0], stream["action"][0]
        belief = adaptation.update(belief, state[step], action[step], state[step + 1])
    for one, both in zip(adaptation.read(belief), together, strict=True):
        torch.testing.assert_close(one, both[0], rtol=1e-4, atol=1e-5)
    assert (together.gain[0, 1:] < 0.2).all() and (together.gain[1] - 1).abs().max() < 0.05


class Servos(torch.nn.Module):
    """Servos of a known law: command j moves body j + 2 along z; their force saturates 5 cm off the command."""

    recurrent, parameters_key = False, None

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.scene, self.layout = scene, scene.layout

    def step(self, state: Tensor, action: Tensor, parameters=None) -> tuple[Tensor, None]:
        after, height, speed = state.clone(), state[..., 2:, 2], state[..., 2:, 9]
        speed = 0.8 * speed + 0.1 * (20 * (action - height)).clamp(-1, 1)
        after[..., 2:, 9], after[..., 2:, 2] = speed, height + 0.2 * speed
        return after, None


def commanded(servos: Servos, gain: Tensor, offset: Tensor, *, seed: int) -> TensorDict:
    """Trajectories of robots ``[20]`` whose noisy servos hold each random command for eight steps."""
    generator = torch.Generator().manual_seed(seed)
    held = 2 * torch.rand(20, 15, 5, generator=generator).double() - 1
    action = held.repeat_interleave(8, 1)
    states = [torch.as_tensor(servos.scene.reference_state).expand(20, -1, -1).clone()]
    for now in action.unbind(1):
        after = servos.step(states[-1], gain * now + offset)[0]
        after[..., 2:, 9] += 1e-3 * torch.randn(20, 5, generator=generator).double()
        states.append(after)
    return TensorDict({"state": torch.stack(states, 1), "action": action}, [20])


def test_it_follows_stiff_servos(scenes):
    """Half of a command, or a shifted zero, is far wider than the range in which their force is linear."""
    servos = Servos(scenes["swimmer6"])
    ones, zeros = torch.ones(5).double(), torch.zeros(5).double()
    adaptation = Adaptation(servos, commanded(servos, ones, zeros, seed=0))  # pyright: ignore[reportArgumentType]
    gain, offset = ones.clone(), zeros.clone()
    gain[1], offset[3] = 0.5, 0.1
    found = adaptation.read(learned(adaptation, commanded(servos, gain, offset, seed=1), steps=120))
    right = ((found.gain - gain).abs() < 0.03).all(-1) & ((found.offset - offset).abs() < 0.02).all(-1)
    assert right.double().mean() > 0.7
    quiet = adaptation.read(learned(adaptation, commanded(servos, ones, zeros, seed=2), steps=120))
    assert (quiet.gain - 1).abs().max() < 0.02 and quiet.offset.abs().max() < 0.02


@pytest.fixture
def loaded(scenes, make_model) -> tuple[Predictor, list[Scene]]:
    """A predictor that reads masses, and variants of two heavier bodies."""
    scene = scenes["swimmer6"]
    variants = [with_factors(scene, {"body_mass": [body]}, [2.0]) for body in ("segment_4", "segment_2")]
    model = make_model(scene).double()
    return specialize(model.bind(scene, parameters_key="parameters"), executor="eager"), variants


def lived(
    predictor: Predictor,
    variants: list[Scene],
    change: RobotChange | None,
    *,
    seed: int,
    middle: float = 0.0,
    size: float = 1.0,
) -> TensorDict:
    """Noisy trajectories of robots that are as the model says, but for a change."""
    generator = torch.Generator().manual_seed(seed)
    model, scene = AdaptedPredictor(predictor, change, variants=variants).double(), predictor.scene
    action = middle + size * (2 * torch.rand(12, 40, scene.num_actions, generator=generator).double() - 1)
    states = [torch.as_tensor(scene.reference_state).expand(12, -1, -1)]
    for now in action.unbind(1):
        after = model.step(states[-1], now)
        noise = 1e-5 * torch.randn(after.shape, generator=generator).double()
        moved = torch.as_tensor(scene.movable).double()
        after[..., 7:] += noise[..., 7:] * moved[:, 6:]
        states.append(after)
    return TensorDict({"state": torch.stack(states, 1), "action": action}, [12])


def test_it_finds_loads_beside_a_dead_motor(loaded):
    predictor, variants = loaded
    ones, zeros = torch.ones(5).double(), torch.zeros(5).double()
    gain, amount = ones.clone(), torch.tensor([0.7, 0.0]).double()
    gain[1] = 0
    change = RobotChange(gain, zeros, zeros, zeros, amount, 0 * amount)
    adaptation = Adaptation(predictor, lived(predictor, variants, None, seed=0), variants=variants)
    found = adaptation.read(learned(adaptation, lived(predictor, variants, change, seed=1), steps=40))
    torch.testing.assert_close(found.amount, amount.expand(12, 2), rtol=0, atol=0.2)
    torch.testing.assert_close(found.gain, gain.expand(12, 5), rtol=0, atol=0.1)
    off = (found.amount - amount) / found.amount_std
    assert found.amount_std.max() < 0.1 and (off.abs() < 3).double().mean() > 0.9
    quiet = adaptation.read(learned(adaptation, lived(predictor, variants, None, seed=2), steps=40))
    assert (quiet.amount == 0).double().mean() > 0.8 and (quiet.gain - 1).abs().max() < 0.1


def test_amounts_mix_the_variants_parameters(loaded):
    predictor, variants = loaded
    ones, zeros = torch.ones(5).double(), torch.zeros(5).double()
    start = torch.as_tensor(predictor.scene.reference_state)
    actions = torch.rand(6, 5, generator=torch.Generator().manual_seed(0)).double()
    for amount, variant in (([1.0, 0.0], variants[0]), ([0.0, 1.0], variants[1]), ([0.0, 0.0], predictor.scene)):
        size = torch.tensor(amount).double()
        adapted = AdaptedPredictor(predictor, RobotChange(ones, ones, zeros, zeros, size, size), variants=variants)
        expected = predictor.rollout(start, actions, predictor.parameters_of(variant))[0]
        torch.testing.assert_close(adapted.rollout(start, actions), expected, rtol=1e-6, atol=1e-9)
        entries = TensorDict({"state": start, "action": actions[0]}, [])
        torch.testing.assert_close(adapted(entries)["next", "state"], expected[1], rtol=1e-6, atol=1e-9)


def test_a_belief_is_a_value_and_a_lost_step_teaches_nothing(scenes, adaptation):
    stream = simulated(scenes, torch.zeros(5).double(), torch.zeros(5).double(), count=2)
    belief = learned(adaptation, stream, steps=3)
    kept = [part.clone() for part in belief]
    after = stream["state"][:, 4].clone()
    after[1, 2, 0] = torch.nan
    new = adaptation.update(belief, stream["state"][:, 3], stream["action"][:, 3], after)
    assert all(torch.equal(part, before) for part, before in zip(belief, kept, strict=True))
    for part, before in zip(new, kept, strict=True):
        assert torch.equal(part[1], before[1]) and not torch.equal(part[0], before[0])


def test_wild_steps_do_not_lead_it_astray(scenes, adaptation):
    gain = torch.tensor([0.0, 1.0, 1.0, 1.0, 1.0]).double()
    stream = simulated(scenes, gain, torch.zeros(5).double())
    stream["state"][:, 15, 1:, 7:10] += 5.0  # 5 m/s in one step, and back in the next
    found = adaptation.read(learned(adaptation, stream))
    torch.testing.assert_close(found.gain, gain.expand(4, 5), rtol=0, atol=0.1)


def test_it_forgets(scenes, predictor, unchanged):
    dead = simulated(scenes, torch.zeros(5).double(), torch.zeros(5).double(), count=2)
    mended = simulated(scenes, torch.ones(5).double(), torch.zeros(5).double(), count=2)
    adaptation = Adaptation(predictor, unchanged, memory=0.2)
    belief = learned(adaptation, dead)
    assert (adaptation.read(belief).gain < 0.1).all()
    for step in range(STEPS):
        belief = adaptation.update(
            belief, mended["state"][:, step], mended["action"][:, step], mended["state"][:, step + 1]
        )
    assert (adaptation.read(belief).gain > 0.9).all()


def test_planners_use_what_is_known(scenes, predictor):
    scene = scenes["swimmer6"]
    adapted = AdaptedPredictor(predictor)
    env = ModelEnv(adapted, lambda *entries: entries[2][..., 1, :1].float())
    start = collect_trajectories(scene, 2, 1, seed=0)["state"][:, 0]
    now = TensorDict({"state": start}, [2])
    actions = torch.rand(2, 4, 5, generator=torch.Generator().manual_seed(0)).requires_grad_()
    torch.testing.assert_close(env.imagine(now, actions)[0], predictor.rollout(start, actions)[0])
    gain, offset = torch.tensor([0.0, 1.0, 0.5, 1.0, 1.0]), torch.tensor([0.0, 0.0, 0.0, 0.2, 0.0])
    adapted.take(RobotChange(gain, gain, offset, gain, *NONE))
    states = env.imagine(now, actions)[0]
    torch.testing.assert_close(states, predictor.rollout(start, gain * actions + offset)[0])
    (gradient,) = torch.autograd.grad(states.sum(), actions)
    assert (gradient[..., 0] == 0).all() and (gradient[..., 1:] != 0).any()
    stepped = env.step(now.set("action", actions[:, 0].detach()))
    torch.testing.assert_close(stepped["next", "state"], states[:, 1], rtol=1e-6, atol=1e-8)
    copy = AdaptedPredictor(predictor)
    copy.load_state_dict(adapted.state_dict())
    assert torch.equal(copy.gain, gain)


def test_it_plans_with_a_dead_motor(scenes, predictor):
    scene = scenes["swimmer6"]
    gain = torch.tensor([0.0, 1.0, 1.0, 1.0, 1.0])
    env = ModelEnv(
        AdaptedPredictor(predictor, RobotChange(gain, gain, 0 * gain, gain, *NONE)), lambda *_: _[2][..., 1, :1].float()
    )
    planner = GradientPlanner(env, 3, 2, samples=4, seed=0)
    start = TensorDict({"state": collect_trajectories(scene, 1, 1, seed=0)["state"][:, 0]}, [1])
    assert planner(start)["action"].shape == (1, 5)


def test_what_cannot_be_adapted_is_refused(scenes, make_model, unchanged, predictor):
    scene = scenes["swimmer6"]
    with pytest.raises(ValueError, match="without hidden state"):
        Adaptation(make_model(scene, core="recurrent").bind(scene), unchanged)
    with pytest.raises(ValueError, match="reads parameters of each sample"):
        Adaptation(make_model(scene).bind(scene, parameters_key="parameters"), unchanged)
    falling = scenes["falling"]
    with pytest.raises(ValueError, match="no commands to adapt"):
        Adaptation(make_model(falling).bind(falling), unchanged)
    with pytest.raises(ValueError, match=r"memory=0, gain_std=0\.5"):
        Adaptation(predictor, unchanged, memory=0)
    heavy = [with_factors(scene, {"body_mass": ["segment_4"]}, [2.0])]
    with pytest.raises(ValueError, match="Variants need a model that reads parameters"):
        Adaptation(predictor, unchanged, variants=heavy)
    blind = make_model(scene, parameters="none").bind(scene, parameters_key="parameters")
    with pytest.raises(ValueError, match="reads no physical parameter in which variant 0 differs"):
        Adaptation(blind, unchanged, variants=heavy)
    other = predictor.own_parameters()
    other["nodes"] = 2 * other["nodes"]
    rows = TensorDict({"state": unchanged["state"][:, 0], "action": unchanged["action"][:, 0]}, [20])
    with pytest.raises(ValueError, match="parameters"):
        AdaptedPredictor(predictor)(rows.set("parameters", other.expand(20)))


def test_other_variants_are_no_unchanged_robot(predictor, unchanged, loaded):
    reading, variants = loaded
    heavy = unchanged.clone()
    heavy["parameters"] = reading.parameters_of(variants[0]).expand(len(heavy))
    for model, options in ((predictor, {}), (reading, {"variants": variants})):
        with pytest.raises(ValueError, match="other parameters"):
            Adaptation(model, heavy, **options)


def test_offsets_of_commands_far_from_zero_err_with_their_gains(scenes, make_model):
    """Commands that are all positive, as a gripper's."""
    predictor = specialize(make_model(scenes["swimmer6"]).double().bind(scenes["swimmer6"]), executor="eager")
    around = {"middle": 0.6, "size": 0.2}
    adaptation = Adaptation(predictor, lived(predictor, [], None, seed=0, **around))
    ones, zeros = torch.ones(5).double(), torch.zeros(5).double()
    change = RobotChange(0.8 * ones, zeros, 0.1 * ones, zeros, *NONE)
    found = adaptation.read(
        learned(adaptation, lived(predictor, [], change, seed=1, **around), steps=40), guarded=False
    )
    off = (found.offset - 0.1) / found.offset_std
    assert 0.3 < off.square().mean().sqrt() < 2.5


def test_a_command_is_clipped_before_the_change_acts(scenes, adaptation, predictor):
    """As MuJoCo clips controls before a weak motor turns them into a torque."""
    gain, none = torch.tensor([0.5, 1.0, 1.0, 1.0, 1.0]), torch.zeros(5)
    adapted = AdaptedPredictor(predictor, RobotChange(gain, none, none, none, *NONE))
    given = collect_trajectories(scenes["swimmer6"], 4, STEPS, seed=2)
    beyond, start = 3 * given["action"].sign(), given["state"][:, 0]
    expected = predictor.rollout(start, gain.double() * beyond.clamp(-1, 1))[0]
    torch.testing.assert_close(adapted.rollout(start, beyond), expected, rtol=0, atol=1e-4)
    states = Simulator(scenes["swimmer6"]).rollout(given["physics"][:, 0], gain.double() * beyond.clamp(-1, 1))["state"]
    found = [
        adaptation.read(learned(adaptation, TensorDict({"state": states, "action": actions}, [4])), guarded=False)
        for actions in (beyond.clamp(-1, 1), beyond)
    ]
    for clipped, raw in zip(*found, strict=True):
        torch.testing.assert_close(raw, clipped, rtol=0, atol=1e-4)


def test_it_measures_without_dropout(scenes, make_model, unchanged):
    bound = make_model(scenes["swimmer6"]).bind(scenes["swimmer6"])
    clear = Adaptation(bound, unchanged)
    for module in list(bound.modules()):
        for name, part in module.named_children():
            if isinstance(part, nn.SiLU):
                setattr(module, name, nn.Sequential(part, nn.Dropout(0.2)))
    assert any(isinstance(each, nn.Dropout) for each in bound.modules())
    dropping = Adaptation(bound.train(), unchanged)
    torch.testing.assert_close(dropping.weight, clear.weight, rtol=1e-3, atol=0)
    step = (unchanged["state"][:, 0], unchanged["action"][:, 0], unchanged["state"][:, 1])
    beliefs = [each.update(each.start(20), *step).moment for each in (clear, dropping)]
    torch.testing.assert_close(*beliefs, rtol=1e-3, atol=1e-3)
    assert bound.training
