"""A planner at work: its tasks, its plan, and that the plan is the planner's own."""

from __future__ import annotations

import torch

from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import load_scene
from torchrl_gn.viewer.planning import LivePlanner, tasks_of
from torchrl_gn.viewer.world import LiveWorld


def test_tasks_are_those_that_the_library_has(scenes):
    assert tasks_of(scenes["pendulum"]) == ("balance",)
    assert tasks_of(scenes["cheetah"])[0] == "forward" and "spin" in tasks_of(scenes["cheetah"])
    assert tasks_of(scenes["swimmer6"])[0] == "reach"
    assert tasks_of(scenes["joints"]) == ()
    for task in tasks_of(scenes["cheetah"]):
        make_reward(task, scenes["cheetah"])
    walker = load_scene("suite:walker/run")
    (name,) = tasks_of(walker)
    assert "suite" in name


def test_a_plan_leads_where_the_model_predicts(scenes, make_model):
    scene = scenes["pendulum"]
    model = make_model(scene).bind(scene)
    planner, world = LivePlanner(scene, model, "balance"), LiveWorld(scene, model)
    planner.begin(world.moment.state)
    action, plan = planner.act(world.moment.physics, world.moment.state)
    assert action.shape == (1,) and plan.shape == (51, 2, 13)
    with torch.no_grad():
        after = model.step(world.moment.state, torch.from_numpy(action))[0]
    torch.testing.assert_close(torch.from_numpy(plan[1]), after, rtol=1e-5, atol=1e-6)
    world.step(action)
    reward = planner.reward_of(world.moment.state, action, world.moment.state)
    expected = make_reward("balance", scene)(*(world.moment.state[None],), None, world.moment.state[None])
    assert reward == float(expected)
    _, later = planner.act(world.moment.physics, world.moment.state)
    assert torch.equal(torch.from_numpy(later[0]), world.moment.state)


def test_without_a_model_it_plans_on_the_true_physics(scenes):
    scene = scenes["pendulum"]
    planner, world = LivePlanner(scene, None, "balance"), LiveWorld(scene)
    planner._planner.horizon = 4
    planner.begin(world.moment.state)
    action, plan = planner.act(world.moment.physics, world.moment.state)
    world.step(action)
    torch.testing.assert_close(torch.from_numpy(plan[1]), world.moment.state)


def test_a_task_with_a_target_draws_one_and_keeps_it(scenes, make_model):
    scene = scenes["swimmer6"]
    planner, world = LivePlanner(scene, make_model(scene).bind(scene), "reach"), LiveWorld(scene)
    planner.begin(world.moment.state)
    target = planner.target.clone()
    torch.testing.assert_close((target - world.moment.state[1, :3]).norm().item(), 1.0)
    planner._planner.warm_up = 1
    planner.act(world.moment.physics, world.moment.state)
    assert torch.equal(planner.target, target)
    planner.begin(world.moment.state)
    assert not torch.equal(planner.target, target)
