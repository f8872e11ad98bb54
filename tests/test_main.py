"""The command line lists and draws scenes, and refuses bad names in one message."""

from __future__ import annotations

import contextlib
import io
import re
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from torchrl_gn.__main__ import main
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.scenes import SYSTEMS, KinematicTree, load_scene
from torchrl_gn.training import load_pretrained, pretrained_names, save_checkpoint
from torchrl_gn.training.checkpoint import CHECKPOINT_FILE

from . import zoo


@pytest.fixture(scope="module")
def listed() -> str:
    """Output of ``torchrl-gn list``."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main(["list"]) == 0
    return out.getvalue()


def test_list_names_every_system_and_model(listed):
    systems, models = listed.split("\n\n")
    rows = {line.split()[0]: line.split()[1:] for line in systems.splitlines()}
    assert set(SYSTEMS) <= rows.keys()
    assert rows["cheetah"] == ["8", "9", "6", "10", "ms", "yes"]  # nine joints: three of the root, six of the legs
    assert rows["walker2d"] == ["8", "9", "6", "2.5", "ms", "no"]
    assert {line.split()[0] for line in models.splitlines()} >= set(pretrained_names())


def test_without_a_word_it_lists(listed, capsys):
    assert main([]) == 0
    assert capsys.readouterr().out == listed


def test_list_states_the_errors_of_the_checkpoints(listed):
    rows = [line.split() for line in listed.splitlines()]
    stated = load_pretrained("swimmer6").metrics["swimmer6"]
    (row,) = [row for row in rows if row[:2] == ["swimmer6", "swimmer6"]]
    assert row[2] == "yes"
    assert [float(cell) for cell in row[3:]] == pytest.approx(
        [stated[key] for key in ("one_step_error", "rollout_error_20", "rollout_error_100")], rel=0.06
    )
    trained = {row[1]: row[2] for row in rows if row[:1] == ["swimmerN"] and len(row) == 6}
    assert (trained["swimmer6"], trained["swimmer7"]) == ("yes", "no")


def test_show_prints_the_scene(capsys):
    assert main(["show", "swimmer4"]) == 0
    assert capsys.readouterr().out == f"{load_scene('swimmer4')}\n"


def test_show_takes_a_run_folder_or_its_checkpoint(tmp_path, capsys):
    scene = load_scene("pendulum")
    model = ForwardModel.for_scene(scene, hidden=8)
    save_checkpoint(tmp_path / CHECKPOINT_FILE, model, scene=scene)
    for source in (tmp_path, tmp_path / CHECKPOINT_FILE):
        assert main(["show", str(source)]) == 0
        assert capsys.readouterr().out == f"{scene}\n"


def test_a_robot_known_by_its_joints_has_no_image(tmp_path, capsys):
    tree = KinematicTree("arm", ("a", "b"), 0.02, ((0,), (1,)), action_low=-np.ones(2), action_high=np.ones(2))
    save_checkpoint(tmp_path / CHECKPOINT_FILE, ForwardModel.for_scene(tree, hidden=8), scene=tree)
    assert main(["show", str(tmp_path)]) == 0
    with pytest.raises(SystemExit) as ended:
        main(["show", str(tmp_path), "--image", str(tmp_path / "arm.png")])
    assert ended.value.code == 2 and "known by its joints alone" in capsys.readouterr().err
    assert not (tmp_path / "arm.png").exists()


def test_show_draws_a_file_of_ones_own(tmp_path, capsys):
    file, image = tmp_path / "arm.xml", tmp_path / "new" / "arm.png"
    file.write_text(zoo.mjcf("two_links"))
    assert main(["show", str(file), "--image", str(image)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(image)
    with Image.open(image) as picture:
        assert min(picture.size) > 400
        panel = picture.convert("RGB").crop((20, 70, 460, 510))
        assert len(panel.getcolors(1 << 20)) > 20, "nothing is drawn"


@pytest.mark.slow
def test_doctor_says_what_there_is_and_what_to_switch_on(capsys):
    assert main(["doctor"]) == 0
    sections = dict(part.split("\n", 1) for part in capsys.readouterr().out.strip().split("\n\n"))
    assert {"System", "Versions", "Libraries"} <= sections.keys()
    assert re.search(rf"torch +{re.escape(torch.__version__.partition('+')[0])}", sections["Versions"])
    assert re.search(r"instruction sets +\w", sections["System"]) and re.search(r"GPU +\w", sections["System"])
    products = sections["Matrix products on one thread, GFLOP/s"]
    assert all(
        float(re.search(rf"  {name} +([\d.]+)", products)[1]) >= 0 for name in ("float64", "float32", "bfloat16")
    )
    advice = sections["What to switch on here"]
    assert ("- dtype=torch.bfloat16" in advice) != ("- no dtype=torch.bfloat16" in advice)
    assert "specialize(model" in advice and "device=" in advice


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["show", "pendulm"], "Unknown scene 'pendulm'. Did you mean 'pendulum'?"),
        (["show", "missing.xml"], "MJCF file not found: missing.xml"),
        (["show", "pendulum", "--image", "{tmp}/pendulum.movie"], "unknown file extension: .movie"),
        (["shew"], "invalid choice: 'shew'"),
    ],
)
def test_what_cannot_be_done_is_one_message_and_exit_code_2(arguments, message, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main([argument.format(tmp=tmp_path) for argument in arguments])
    said = capsys.readouterr()
    assert ended.value.code == 2 and message in said.err and said.out == ""
    assert not list(tmp_path.iterdir())


def test_help_imports_nothing_heavy():
    code = (
        "import sys\nfrom torchrl_gn.__main__ import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit as ended:\n    assert ended.code == 0\n"
        "print(sorted({'torch', 'mujoco', 'numpy', 'PIL'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.stderr == "" and "show" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.slow
def test_it_runs_as_a_module():
    done = subprocess.run(
        [sys.executable, "-m", "torchrl_gn", "show", "nothing_like_it"], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert done.stderr.startswith("torchrl-gn: Unknown scene 'nothing_like_it'.")


@pytest.mark.slow
def test_a_reader_that_has_enough_ends_it_quietly():
    command = [sys.executable, "-m", "torchrl_gn", "show", "pendulum"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() == 0
