"""Runs are logged completely: an offline wandb run and a csv run are read back."""

import csv
import json
import shutil
import struct
import time

import pytest
import torch
from PIL import Image
from safetensors.torch import save_file

from torchrl_gn.training import Tracker, package_versions


def wandb_records(path):
    """Records of an offline run's file: a header of 7 bytes, then LevelDB's log format.

    Blocks of 32 KiB hold pieces, each with a checksum (4 bytes), a length (2) and a type
    (1 whole, 2 first, 3 middle, 4 last).
    """
    data, position, record = path.read_bytes(), 7, b""
    while position + 7 <= len(data):
        if 32768 - position % 32768 < 7:
            position += 32768 - position % 32768
            continue
        length, kind = struct.unpack_from("<HB", data, position + 4)
        if position + 7 + length > len(data):
            break  # still being written
        record += data[position + 7 : position + 7 + length]
        position += 7 + length
        if kind in (1, 4):
            yield record
            record = b""


def read_wandb(folder):
    """Configuration, history, media and names of the artifacts' files of the finished offline run in a folder."""
    from wandb.proto import wandb_internal_pb2

    (path,) = folder.glob("wandb/offline-run-*/*.wandb")
    deadline = time.monotonic() + 300
    while True:
        records = [wandb_internal_pb2.Record.FromString(data) for data in wandb_records(path)]
        kinds = [record.WhichOneof("record_type") for record in records]
        if "exit" in kinds:
            break
        # wandb's own process may still be writing when finish() has returned.
        assert time.monotonic() < deadline, f"{path} has no end: {kinds}"
        time.sleep(0.1)
    config, history, artifacts = {}, [], []
    for kind, record in zip(kinds, records, strict=True):
        if kind in ("run", "config"):
            update = record.run.config.update if kind == "run" else record.config.update
            config |= {item.key: json.loads(item.value_json) for item in update if item.key}
        elif kind == "history":
            items = record.history.item
            history.append({".".join(item.nested_key) or item.key: json.loads(item.value_json) for item in items})
        elif kind == "request" and record.request.HasField("log_artifact"):
            artifacts.append(read_artifact(record.request.log_artifact.artifact))
        elif kind == "artifact":
            artifacts.append(read_artifact(record.artifact))
    return config, history, {file.name.split("_")[0] for file in path.parent.glob("files/media/*/*")}, artifacts


def read_artifact(artifact) -> tuple[str, str, list[str]]:
    """Return the end of an artifact's name (after the run's), its type, and the names of its files."""
    return artifact.name.partition("-")[2], artifact.type, [entry.path for entry in artifact.manifest.contents]


@pytest.fixture
def picture(tmp_path):
    path = tmp_path / "prediction.png"
    Image.new("RGB", (8, 8)).save(path)
    return path


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "rollout.gif"
    frames = [Image.new("RGB", (8, 8), color) for color in ("red", "blue")]
    frames[0].save(path, save_all=True, append_images=frames[1:])
    return path


@pytest.fixture
def checkpoint(tmp_path):
    path = tmp_path / "recurrent" / "checkpoint" / "checkpoint.safetensors"
    path.parent.mkdir(parents=True)
    save_file({"weight": torch.ones(2)}, path)
    return path


@pytest.mark.slow
def test_offline_wandb_run_holds_everything(tmp_path, monkeypatch, picture, video, checkpoint):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    tracker = Tracker("wandb", tmp_path / "log", name="run", config={"seed": 3, "model": {"latent": 128}})
    tracker.log({"train/loss": 0.5, "version/torch": "no number"}, step=1)
    tracker.log({"train/loss": 0.25}, step=2)
    tracker.log_table("errors", [["error", "one step"], ["total", "0.1"]])
    episodes = checkpoint.rename(tmp_path / "ilqg.safetensors")
    shutil.copy(episodes, checkpoint)
    tracker.log_files([picture, video, checkpoint, episodes])
    tracker.close()

    config, history, media, artifacts = read_wandb(tmp_path / "log")
    assert config["seed"] == 3
    assert config["model"] == {"latent": 128}
    assert config["versions"] == package_versions()
    losses = [row["train/loss"] for row in history if "train/loss" in row]
    assert losses == [0.5, 0.25]
    assert not any("version/torch" in row for row in history)
    assert {"errors", "prediction", "rollout"} <= media
    assert ("recurrent-checkpoint-checkpoint", "model", ["checkpoint.safetensors"]) in artifacts
    assert ("ilqg", "episodes", ["ilqg.safetensors"]) in artifacts


def test_csv_run_holds_the_numbers(tmp_path):
    def rows():
        (path,) = tmp_path.glob("**/*.csv")
        with path.open(newline="") as file:
            return list(csv.reader(file))

    tracker = Tracker("csv", tmp_path / "log", name="run", config={"seed": 3})
    for step, value in ((1, 0.5), (2, 0.25)):
        tracker.log({"loss": value, "version/torch": "no number"}, step)
    tracker.log_table("errors", [["a"], ["b"]])
    tracker.close()
    assert rows() == [["step", "loss"], ["1", "0.5"], ["2", "0.25"]]
    tracker.log({"error": 1e-3}, 2)
    tracker.log({"loss": 0.125}, 3)
    assert rows() == [["step", "loss", "error"], ["1", "0.5", ""], ["2", "0.25", "0.001"], ["3", "0.125", ""]]
    resumed = Tracker("csv", tmp_path / "log", name="run", config={"seed": 3})  # from a checkpoint of step 2
    resumed.log({"loss": 0.1}, 3)
    assert rows()[-2:] == [["2", "0.25", "0.001"], ["3", "0.1", ""]]


def test_tensorboard_run_holds_everything(tmp_path, picture, video):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    tracker = Tracker("tensorboard", tmp_path / "log", name="run", config={"seed": 3, "model": {"latent": 128}})
    for step, value in ((1, 0.5), (2, 0.25)):
        tracker.log({"train/loss": value, "version/torch": "no number"}, step)
    tracker.log_table("errors", [["error", "one step"], ["total", 0.1]])
    other = tmp_path / "swimmer3" / picture.name  # of one of several systems
    other.parent.mkdir()
    other.write_bytes(picture.read_bytes())
    tracker.log_files([picture, video, other])
    tracker.close()

    events = EventAccumulator(str(tmp_path / "log" / "run")).Reload()
    assert [(event.step, event.value) for event in events.Scalars("train/loss")] == [(1, 0.5), (2, 0.25)]
    assert set(events.Tags()["images"]) == {"prediction", "rollout", "swimmer3/prediction"}
    assert events.Images("rollout")[0].encoded_image_string == video.read_bytes()
    texts = {tag: events.Tensors(tag)[0].tensor_proto.string_val[0].decode() for tag in events.Tags()["tensors"]}
    assert '"latent": 128' in texts["config/text_summary"]
    assert texts["errors/text_summary"] == "| error | one step |\n| --- | --- |\n| total | 0.1 |"


def test_none_writes_nothing(tmp_path, picture):
    tracker = Tracker("none", tmp_path / "log", name="run", config={})
    tracker.log({"loss": 1.0}, 1)
    tracker.log_table("errors", [["a"], ["b"]])
    tracker.log_files([picture])
    tracker.close()
    assert not (tmp_path / "log").exists()


def test_unknown_logger_is_named(tmp_path):
    with pytest.raises(ValueError, match="tensorbored.*none.*csv.*tensorboard.*wandb"):
        Tracker("tensorbored", tmp_path, name="run", config={})
