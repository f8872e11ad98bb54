"""Run every recipe at its smallest: ``python .ci/recipes.py FOLDER``, which has a trained model in runs/forward_model.

Each is a copy of a process that has imported them all, which takes longer than most of them do; Hydra reads its command
line. Two run at a time, one of each row. A clean run prints neither warnings nor that something failed.
"""

from __future__ import annotations

import os
import re
import runpy
import shlex
import sys
import tempfile
import time
from pathlib import Path
from typing import IO

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.copies import import_all  # noqa: E402

DATA = "data.train=20 data.validation=5 data.test=5"
LEARNING = (
    "trainer.frames=400 trainer.random_frames=200 trainer.evaluate_frames=200 trainer.frames_per_batch=40 "
    "num_envs=2 evaluate_episodes=1 task.steps=20 trainer.compile=false"
)


def quoted(options: str) -> str:
    """As a list among another recipe's options."""
    return '"[' + ",".join(f"'{option}'" for option in options.split()) + ']"'


# The command lines, a blank line between them.
MODELS = f"""
evaluate checkpoint=runs/forward_model sequences=10 run_dir=runs/evaluate

evaluate checkpoint=acrobot suite_task=acrobot/swingup sequences=5 run_dir=runs/evaluate_suite

publish checkpoint=runs/forward_model file=runs/published.safetensors sequences=5

benchmarks/scaling system=pendulum batches=[20] steps=2 warm_up=1 repeats=1 trajectories=5
    run_dir=runs/benchmarks/scaling

benchmarks/features systems=[pendulum] hidden=8 batches=[1] rounds=1 seconds=0.01 run_dir=runs/benchmarks/features

benchmarks/simulation repeats=1 steps=20 rollouts=4 batch=4 run_dir=runs/benchmarks/simulation

benchmarks/training system=pendulum steps=2 warm_up=1 trajectories=5 run_dir=runs/benchmarks/training

benchmarks/versions other={ROOT} system=pendulum rounds=1 seconds=0.01 batches=[1] rollout_batches=[2] horizon=2
    live_batch=2 live_horizon=2 training_batch=2 run_dir=runs/benchmarks/versions

benchmarks/speed compile=false repeats=1 batches=[1,20] gradient_batches=[2] baselines=[jraph,mujoco]
    step_gradient_batches=[1,20] horizon=5 gradient_horizon=3 training_batch=20 curve_links=[3,6] curve_batches=[1,10]
    curve_hidden=[16,32] curve_horizons=[1,2] run_dir=runs/benchmarks/speed

gpu device=cpu parts=[speed,cores,training,policy] systems=[pendulum] batches=[4] repeats=1 steps=2 cores_batch=4
    "training=['steps=3 {DATA}']"
    "policy=['system=pendulum reward=balance evaluation_reward=balance timestep=null rounds=1 first.trajectories=5
    first.steps=2 updates=2 batch_size=4 horizon=2 episodes=1 steps=50 model_steps=2 evaluate.episodes=1
    evaluate.steps=5']" run_dir=runs/gpu

compare overrides={quoted(DATA)} data_dir=runs/data systems=[pendulum] minutes=0.01 only=[default,MLP]
    run_dir=runs/compare

compare experiment=ablation overrides={quoted(DATA)} data_dir=runs/data steps=3 seeds=[0]
    "only=[two GNs,'no global update, no skip']" run_dir=runs/ablation

compare experiment=swimmers overrides={quoted(DATA)} data_dir=runs/data minutes=0.01 zero_shot=[swimmer7]
    only=[default] run_dir=runs/swimmers

mlp_baseline overrides={quoted(DATA)} data_dir=runs/data systems=[pendulum] sizes=[[1,8]]
    "optimizers=[['optimizer=muon']]" keep=1 screen_minutes=0.01 minutes=0.02 seeds=[0] run_dir=runs/mlp_baseline

benchmarks/work_precision system=swimmer3 checkpoints=[runs/forward_model] repeats=1 rollouts=10 batches=[1,20]
    state_steps=200 run_dir=runs/benchmarks/work_precision

stability checkpoint=pendulum steps=100 rollouts=2 limits=false run_dir=runs/stability
"""
CONTROL = f"""
inference_model steps=10 baselines=true {DATA} test.systems=10 run_dir=runs/inference_model

real_robot steps=5 simulated.episodes=40 run_dir=runs/real_robot

ensemble system=pendulum members=2 steps=5 hidden=8 data.train=20 data.calibration=20 data.test=10 data.other=10
    run_dir=runs/ensemble

pessimism system=pendulum reward=balance members=2 hidden=8 train_steps=5 "data={{trajectories: 20, length: 10}}"
    horizon=4 steps=6 episodes=2 "gn={{iterations: 1, warm_up: 1, samples: 2}}" run_dir=runs/pessimism

adaptation system=swimmer6 seconds=[0.1] robots=2 calibration=5 test=5 length=25
    "faults=[{{command: 0, gain: 0.0}}]" run_dir=runs/adaptation

identify_parameters robots=1 window=100 run_dir=runs/identify_parameters

contacts steps=5 "episodes={{train: 10, validation: 3, test: 3}}" run_dir=runs/contacts

mpc system=swimmer6 planner=[gn,ilqg,cem,mppi,random] horizon=4 steps=3 episodes=2 gn.warm_up=2 gn.samples=4
    run_dir=runs/mpc

mpc checkpoint=runs/inference_model variants=true planner=[gn,ilqg,cem] horizon=3 steps=2 gn.warm_up=2 gn.samples=4
    video=false run_dir=runs/mpc_identified

benchmarks/planning system=pendulum iterations=[1] "baselines={{ilqg: [1]}}" episodes=1 steps=2
    overrides={quoted("horizon=3 gn.warm_up=1 gn.samples=2")} run_dir=runs/benchmarks/planning

plan_and_learn system=pendulum rounds=1 episodes=2 steps=100 minutes=0.01 value=true policy=true
    planning={quoted("horizon=3 gn.warm_up=2 gn.samples=2 gn.iterations=1 video=false")}
    training={quoted(DATA)} run_dir=runs/plan_and_learn

value episodes=[runs/plan_and_learn/executed1/gn.safetensors] fit.iterations=2 fit.steps=5 imitate.steps=5
    run_dir=runs/value

suite only=[pendulum/swingup] rounds=1 jobs=1 frames=[400] "overrides=['first.trajectories=2','first.length=50',
    'first.steps=5','updates=3','batch_size=8','steps=50','model_steps=3','reward_steps=3','evaluate.episodes=1',
    'evaluate.steps=20']" run_dir=runs/suite

shac first.trajectories=2 first.length=50 first.steps=5 rounds=2 updates=3 batch_size=8 steps=50 model_steps=3
    reward_steps=3 evaluate.episodes=2 evaluate.steps=20 run_dir=runs/shac

svg task=cheetah_run {LEARNING} run_dir=runs/svg

learning_curves seeds=[0] overrides={quoted(LEARNING)} run_dir=runs/curves

data_shift policy=runs/curves/SVG_0/seed0 minutes=0.01 seeds=[0] swimming={{train:20,test:5}}
    random={{train:20,validation:5,test:5}} sequences=5 run_dir=runs/policy_shift

benchmarks/svg repeats=1 compile=false batch_size=20 num_envs=2 horizons=[0,1] run_dir=runs/benchmarks/svg
"""


def start(command: list[str], output: IO[bytes]) -> int:
    """Be ``python recipes/NAME.py ...`` in a copy of this process; return its id."""
    if not (number := os.fork()):
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
        sys.argv = [str(ROOT / "recipes" / f"{command[0]}.py"), *command[1:]]
        runpy.run_path(sys.argv[0], run_name="__main__")
        sys.exit()
    return number


def main(folder: str) -> int:
    """Run both rows in a folder; return 1 if a recipe failed."""
    import_all()
    os.chdir(folder)
    rows = [iter([" ".join(each.split()) for each in row.strip().split("\n\n")]) for row in (MODELS, CONTROL)]
    running, failed = {}, []

    def start_next(row: int) -> None:
        if command := next(rows[row], None):
            output = tempfile.TemporaryFile()
            running[start(shlex.split(command), output)] = row, command, output, time.monotonic()

    for row in range(len(rows)):
        start_next(row)
    while running:
        number, status, used = os.wait4(-1, 0)
        row, command, output, began = running.pop(number)
        start_next(row)
        output.seek(0)
        said = output.read().decode(errors="replace")
        well = status == 0 and not re.search("warning|failed", said, re.IGNORECASE)
        failed += [] if well else [command]
        seconds = f"{time.monotonic() - began:.0f} s, {used.ru_utime + used.ru_stime:.0f} of the processor"
        print(f"\n=== {command}\n{said}--- {'passed' if well else 'FAILED, or warned'}, {seconds}", flush=True)
    for command in failed:
        print(f"failed: {command}")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
