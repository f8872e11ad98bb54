"""Files of a policy that was learned from a terminal."""

from __future__ import annotations

import json
import math

import pytest
import torch
from omegaconf import OmegaConf

from _common.progress import learning, report_learning
from learning_curves import make_runs, pairs_won, second_half
from torchrl_gn.training import (
    RunFolder,
    Tracker,
    load_pretrained,
)

CONFIG = {"checkpoint_seconds": 1000}


@pytest.fixture
def tracker(tmp_path) -> Tracker:
    return Tracker("none", tmp_path / "log", name="run", config=CONFIG)


def learn(trainer, path, resumed, tracker) -> None:
    """Train as the recipes do."""
    with learning(trainer, path, resumed, tracker, config=CONFIG) as log:
        for progress in trainer.run():
            log(progress)


@pytest.mark.slow
def test_an_interrupted_run_is_saved_and_goes_on(make_learner, tracker, tmp_path):
    path, trainer = tmp_path / "c.safetensors", make_learner(frames=100)
    evaluate = trainer.evaluate

    def interrupt() -> float:
        if trainer.frames == 100:
            raise KeyboardInterrupt
        return evaluate()

    trainer.evaluate = interrupt
    with pytest.raises(KeyboardInterrupt):
        learn(trainer, path, None, tracker)
    resumed = load_pretrained(path)
    assert resumed.config == CONFIG and resumed.training["progress"]["frames"] == 100
    again = make_learner(resumed.agent, frames=140)
    learn(again, path, resumed, tracker)
    saved = load_pretrained(path).training
    assert saved["progress"]["frames"] == 140 and saved["curve"]["frames"] == [0, 100, 140]
    assert torch.equal(saved["buffer"]["action"][:100], resumed.training["buffer"]["action"])


def test_a_report_holds_the_curve_and_its_last_tenth(make_learner, tracker, tmp_path, capsys):
    trainer, run = make_learner(), RunFolder(tmp_path / "run", "svg")
    trainer.frames, trainer.updates, trainer.seconds = 200, 50, 4.0
    trainer.curve.returns = [float(value) for value in range(20)]
    trainer.curve.frames = [10.0 * value for value in range(20)]
    report_learning(trainer, run, tracker, label="SVG(1)", seed=7)
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    expected = {"return": 19, "best_return": 19, "last_tenth_return": 18.5, "frames": 200, "seed": 7}
    expected |= {"updates_per_second": 12.5, "frames_per_second": 50}
    assert all(math.isclose(metrics[name], value) for name, value in expected.items())
    assert json.loads((tmp_path / "run" / "curve.json").read_text())["returns"] == trainer.curve.returns
    printed = capsys.readouterr().out.split()
    assert all(str(path) in printed for path in (*run.written, run.checkpoint))


def test_the_second_half_of_a_curve_begins_after_half_of_the_frames():
    curve = {"frames": [0, 100, 200, 300, 400], "returns": [1.0, 2.0, 4.0, 8.0, 16.0]}
    assert second_half(curve) == 12.0 and second_half({"frames": [0], "returns": [3.0]}) == 3.0


def test_pairs_of_seeds_are_won_by_the_higher_return():
    won = pairs_won({"ours": [1.0, 3.0], "theirs": [0.0, 2.0, 3.0]})
    assert won == {"ours/pairs_won/theirs": 3, "theirs/pairs_won/ours": 2}  # one is a draw


def test_finished_curves_go_on_with_more_frames(tmp_path):
    def run(*overrides: str):
        agents = {"DDPG": {"recipe": "ddpg", "overrides": []}}
        options = {"agents": agents, "only": ["DDPG"], "seeds": [0], "threads": 1, "overrides": list(overrides)}
        return make_runs(OmegaConf.create(options), tmp_path)["DDPG"][0]

    finished = run("trainer.frames=100")
    finished.folder.mkdir(parents=True)
    (finished.folder / "metrics.json").write_text("{}")
    (finished.folder / "options.json").write_text(json.dumps(finished.overrides))
    assert finished.is_done() and not run("trainer.frames=200").is_done()
    with pytest.raises(ValueError, match=r"finished run with none of these, not agent\.policy=graph"):
        run("trainer.frames=100", "agent.policy=graph").is_done()
