"""Several processes train the same model as one."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from torchrl_gn.training import Workers, join_workers

from .train_together import PRESETS, train


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> list[dict[str, dict[str, torch.Tensor]]]:
    """Final weights of each of two processes, by optimiser."""
    folder = tmp_path_factory.mktemp("together")
    script = Path(__file__).with_name("train_together.py")
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", script, folder]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return [torch.load(folder / f"{rank}.pt") for rank in range(2)]


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_all_end_with_the_same_weights_and_statistics(results, preset):
    first, second = (result[preset] for result in results)
    for name in first:
        assert torch.equal(first[name], second[name]), name


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_one_process_trains_the_same_but_for_rounding(results, preset):
    alone, together = train(Workers(), preset), results[0][preset]
    assert len(alone["losses"]) == 24  # patience ended it: at 80 % of 30 steps, five validations after the best
    assert alone["best"] == 1.0
    # Muon lifts the smallest parts of a gradient to the size of the largest, and their rounding with them.
    rounded = {"core": 1e-3, "losses": 3e-4} if preset == "muon" else {}
    for name, value in alone.items():
        if within := rounded.get(name.split(".")[0]):
            assert (together[name] - value).norm() <= within * value.norm(), name
        else:
            torch.testing.assert_close(together[name], value, rtol=1e-5, atol=1e-6, msg=name)


def test_a_process_alone_needs_no_others():
    with join_workers() as workers:
        assert workers == Workers(rank=0, size=1)
        assert workers.agree(lambda: "mine") == "mine" and workers.mean(2.0) == 2.0
        assert workers.any(True) and not workers.any(False)
        module = torch.nn.Linear(1, 1)
        assert workers.wrap(module) is module
        with workers.first_goes_first():
            workers.wait()


def test_a_device_that_is_not_there_is_named(monkeypatch):
    assert Workers().device("cpu") == torch.device("cpu")
    with pytest.raises(ValueError, match="device=gpu is not known; use cpu or cuda"):
        Workers().device("gpu")
    for name, rank, own in (("cuda:2", "0", 2), ("cuda", "3", 3)):
        with monkeypatch.context() as patch:
            for function, answer in (("is_available", True), ("device_count", 2), ("set_device", None)):
                patch.setattr(torch.cuda, function, lambda *_, answer=answer: answer)
            patch.setenv("LOCAL_RANK", rank)
            with pytest.raises(ValueError, match=f"device={name} is GPU {own}, but there are 2, counted from 0"):
                Workers().device(name)
            assert Workers().device("cuda:1") == torch.device("cuda", 1)
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match="device=cuda needs a GPU and a torch built for it; use device=cpu"):
            Workers().device("cuda")
