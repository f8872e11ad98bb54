"""Logging to one wide csv file, or with TorchRL's loggers."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

from torchrl_gn.training.checkpoint import CHECKPOINT_FILE, package_versions
from torchrl_gn.training.csv_log import CsvLog
from torchrl_gn.training.run_folder import plain_config

LoggerKind = Literal["none", "csv", "tensorboard", "wandb"]


class Tracker:
    """Logger of a run's numbers, figures, videos and configuration; ImportError if wandb or tensorboard is missing.

    Args:
        kind: wandb runs offline without an account (API key or login), and ``wandb sync`` uploads later; csv writes
            ``numbers.csv``, with a row per step and a column per name.
        folder: the logger's folder, inside the run folder.
    """

    def __init__(self, kind: LoggerKind, folder: Path, *, name: str, config: Mapping[str, Any]) -> None:
        if kind not in get_args(LoggerKind):
            raise ValueError(f"logger={kind!r} is not known; use one of {list(get_args(LoggerKind))}.")
        self.kind, self._run = kind, folder.parent
        self._logger: Any = None
        self._csv: CsvLog | None = None
        if kind in ("none", "csv"):
            self._csv = CsvLog(folder / "numbers.csv") if kind == "csv" else None
            return
        from torchrl.record.loggers import get_logger

        config, versions = plain_config(config), package_versions()
        options: dict[str, Any] = {}
        if kind == "wandb":
            options["wandb_kwargs"] = {
                "offline": not _has_account(),
                "project": "torchrl_gn",
                "config": config,
                # The folder identifies the run, so resuming extends its log.
                "id": hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:16],
                "log_env_packages": False,
            }
            os.environ.setdefault("WANDB_SILENT", "true")
        folder.mkdir(parents=True, exist_ok=True)
        self._logger = get_logger(kind, logger_name=str(folder), experiment_name=name, **options)
        if kind == "wandb":
            self._logger.experiment.config.update({"versions": versions})
        else:
            text = json.dumps({**config, "versions": versions}, indent=2)
            self._logger.experiment.add_text("config", f"```json\n{text}\n```")

    def log(self, numbers: Mapping[str, float], step: int) -> None:
        """Log numbers at a step; skip other entries."""
        numbers = {name: float(value) for name, value in numbers.items() if isinstance(value, (int, float))}
        if self._csv is not None and numbers:
            self._csv.log(numbers, step)
        elif self._logger is not None:
            for name, value in numbers.items():
                self._logger.log_scalar(name, value, step=step)

    def log_files(self, paths: Sequence[Path]) -> None:
        """Log files: wandb takes figures, videos and checkpoints (as artifacts), tensorboard figures and GIFs."""
        if self._logger is None:
            return
        for path in paths:
            if self.kind == "wandb":
                self._log_to_wandb(path)
            elif self.kind == "tensorboard" and path.suffix in (".png", ".gif"):
                from tensorboard.compat.proto import summary_pb2

                # Write the encoded file: the writer's own methods decode it, and need moviepy for GIFs.
                proto: Any = summary_pb2  # creates its classes at import, unseen by type checkers
                image = proto.Summary.Image(encoded_image_string=path.read_bytes())
                summary = proto.Summary(value=[proto.Summary.Value(tag=self._tag(path), image=image)])
                self._logger.experiment._get_file_writer().add_summary(summary)

    def _log_to_wandb(self, path: Path) -> None:
        import wandb

        run = self._logger.experiment
        if path.suffix == ".png":
            run.log({self._tag(path): wandb.Image(str(path))})
        elif path.suffix in (".gif", ".mp4"):
            run.log({self._tag(path): wandb.Video(str(path), format="gif" if path.suffix == ".gif" else "mp4")})
        elif path.suffix == ".safetensors":
            # Named by its whole path: a run may hold several checkpoints and recorded episodes.
            kind = "model" if path.name == CHECKPOINT_FILE.name else "episodes"
            artifact = wandb.Artifact(f"{run.id}-{self._tag(path).replace('/', '-')}", type=kind)
            artifact.add_file(str(path))
            run.log_artifact(artifact)

    def _tag(self, path: Path) -> str:
        """Name a file by its path in the run folder, without suffix."""
        path, run = path.resolve(), self._run.resolve()
        return str(path.relative_to(run).with_suffix("")) if path.is_relative_to(run) else path.stem

    def log_table(self, name: str, rows: Sequence[Sequence[Any]]) -> None:
        """Log a table whose first row holds the titles; csv skips it."""
        titles, *data = rows
        if self.kind == "wandb":
            import wandb

            self._logger.experiment.log({name: wandb.Table(columns=list(titles), data=[list(row) for row in data])})
        elif self.kind == "tensorboard":
            lines = [titles, ["---"] * len(titles), *data]
            self._logger.experiment.add_text(name, "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines))

    def finish(self, numbers: Mapping[str, float], paths: Sequence[Path], step: int = 0) -> None:
        """Log the final numbers and files, and close."""
        self.log(numbers, step)
        self.log_files(paths)
        self.close()

    def close(self) -> None:
        if self.kind == "wandb":
            self._logger.experiment.finish()
        elif self.kind == "tensorboard":
            self._logger.experiment.close()


def _has_account() -> bool:
    if os.environ.get("WANDB_MODE") == "offline":
        return False
    return bool(os.environ.get("WANDB_API_KEY")) or any(
        (Path.home() / name).exists() and "wandb" in (Path.home() / name).read_text(errors="ignore")
        for name in (".netrc", "_netrc")
    )
