"""Videos of rollouts: truth beside prediction."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from torchrl_gn.atomic import atomic_path
from torchrl_gn.drawing import scene_drawing
from torchrl_gn.drawing.canvas import GRID, INK, PREDICTION, TRUTH
from torchrl_gn.scenes import Scene

if TYPE_CHECKING:
    from PIL import Image

_SHORTEST_FRAME = 0.02  # seconds; viewers slow down GIFs with shorter frames
_HEADER = 58  # pixels above the panels
_GAP = 8  # pixels around and between them


def rollout_video(
    scene: Scene,
    truth: Tensor,
    prediction: Tensor | None,
    path: str | os.PathLike,
    *,
    speed: float = 1.0,
    size: int = 360,
    labels: tuple[str, str] = ("truth", "prediction"),
) -> Path:
    """Write a rollout as a video: the truth on the left; on the right the prediction, with the truth pale behind.

    Args:
        truth: ``[T + 1, N, 13]`` true states, finite.
        prediction: ``[T + 1, N, 13]`` predicted states, or None; frames of non-finite states show a note instead.
        path: file to write: ``.gif``, or ``.mp4`` (needs imageio-ffmpeg).
        speed: 1 is real time. States are skipped to keep frames at least 20 ms long.

    Raises:
        OSError: if there is no space; an earlier file is kept.
    """
    path = Path(path)
    if path.suffix not in (".gif", ".mp4"):
        raise ValueError(f"A video's name must end in .gif or .mp4, got {path.name!r}.")
    if not 0 < speed < math.inf:
        raise ValueError(f"speed must be positive and finite, got {speed}.")
    every = frame_stride(scene.timestep / speed)
    frames = rollout_frames(scene, truth, prediction, every=every, size=size, labels=labels)
    seconds = every * scene.timestep / speed
    with atomic_path(path) as temporary:
        (_write_gif if path.suffix == ".gif" else _write_mp4)(temporary, frames, seconds)
    return path


def frame_stride(interval: float) -> int:
    """Return the number of states, ``interval`` seconds apart, per frame of at least 20 ms."""
    return max(1, math.ceil(_SHORTEST_FRAME / interval - 1e-6))


def rollout_frames(
    scene: Scene,
    truth: Tensor,
    prediction: Tensor | None = None,
    *,
    every: int = 1,
    size: int = 360,
    labels: tuple[str, str] = ("truth", "prediction"),
) -> Iterator[Image.Image]:
    """Draw the RGB frames of :func:`rollout_video` with even widths and heights, one per ``every`` states."""
    sequences = [_to_numpy(scene, "Truth", truth)]
    if prediction is not None:
        if prediction.shape != truth.shape:
            raise ValueError(f"Prediction is {list(prediction.shape)}, truth is {list(truth.shape)}: they must agree.")
        sequences.append(_to_numpy(scene, "Prediction", prediction))
    if not np.isfinite(sequences[0]).all():
        raise ValueError("The true states contain values that are not finite.")
    if every < 1 or size < 32 or size % 2:
        raise ValueError(f"every must be at least 1 and size an even number from 32, got {every} and {size}.")
    drawing = scene_drawing(scene, sequences[0][::every], size)

    def frames() -> Iterator[Image.Image]:
        motions = [drawing.truth, *(drawing.motion(states[::every]) for states in sequences[1:])]
        for step in range(len(drawing.truth.valid)):
            row = zip(motions, (TRUTH, PREDICTION), (False, True), strict=False)
            panels = [drawing.panel(step, motion, color, ghost=ghost) for motion, color, ghost in row]
            yield _compose(scene.name, step * every * scene.timestep, panels, size, labels)

    return frames()


def _compose(name: str, time: float, row: list[Image.Image], size: int, labels: tuple[str, str]) -> Image.Image:
    from PIL import Image, ImageDraw, ImageFont

    image = Image.new("RGB", (_GAP + len(row) * (size + _GAP), _HEADER + size + _GAP), "white")
    draw = ImageDraw.Draw(image)
    draw.text((_GAP + 2, 16), name, INK, ImageFont.load_default(17), "lm")
    draw.text((image.width - _GAP - 2, 16), f"t = {time:.2f} s", INK, ImageFont.load_default(17), "rm")
    for number, (panel, label, color) in enumerate(zip(row, labels, (TRUTH, PREDICTION), strict=False)):
        left = _GAP + number * (size + _GAP)
        draw.text((left + size // 2, 44), label, color, ImageFont.load_default(15), "mm")
        image.paste(panel.reduce(panel.width // size), (left, _HEADER))
        draw.rectangle((left, _HEADER, left + size - 1, _HEADER + size - 1), outline=GRID)
    return image


def _write_gif(path: Path, frames: Iterator[Image.Image], seconds: float) -> None:
    from PIL import Image

    pictures = list(frames)
    # One palette for all frames, from a sample of them, keeps colours from flickering.
    sample = pictures[:: max(1, len(pictures) // 6)]
    colors = Image.fromarray(np.concatenate([np.asarray(picture) for picture in sample])).quantize(128)
    pictures = [picture.quantize(palette=colors, dither=Image.Dither.NONE) for picture in pictures]
    # GIF counts in hundredths of a second: round the running time, not each frame, to stay in real time.
    end_times = [round(100 * seconds * (number + 1)) for number in range(len(pictures))]
    durations = [10 * max(2, end - start) for start, end in zip([0, *end_times], end_times, strict=False)]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=durations, loop=0, optimize=False)


def _write_mp4(path: Path, frames: Iterator[Image.Image], seconds: float) -> None:
    try:
        import imageio_ffmpeg
    except ImportError:
        raise ImportError("Writing .mp4 needs ffmpeg: pip install imageio-ffmpeg, or write a .gif.") from None
    first = next(frames)
    rate: Any = 1 / seconds  # need not be a whole number, despite the annotation
    options: dict[str, Any] = {"quality": 8, "macro_block_size": 2, "ffmpeg_log_level": "error"}
    count, full = 0, f"ffmpeg could not write the whole video to {path.parent}: free some space, or write a .gif."
    try:
        with closing(imageio_ffmpeg.write_frames(str(path), first.size, fps=rate, **options)) as writer:
            writer.send(None)
            for frame in itertools.chain([first], frames):
                writer.send(frame.tobytes())
                count += 1
        # ffmpeg may fail silently once it has all frames.
        written, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    except (OSError, RuntimeError) as error:  # whose messages have many lines
        raise OSError(full) from error
    if (written or 0) < count:
        raise OSError(full)


def _to_numpy(scene: Scene, what: str, states: Tensor) -> np.ndarray:
    if states.ndim != 3 or states.shape[0] == 0 or states.shape[1:] != (scene.num_nodes, scene.state_size):
        expected = f"[T + 1, {scene.num_nodes}, {scene.state_size}]"
        raise ValueError(f"{what} of scene {scene.name!r} must be {expected}, got {list(states.shape)}.")
    return states.detach().double().cpu().numpy()
