"""The keyframe that a scene starts from."""

from __future__ import annotations

import mujoco

_KEYFRAMES = ("home", "stand")


def reference_keyframe(model: mujoco.MjModel) -> int | None:
    """Return the keyframe ``home``, else ``stand``, else the first; None without keyframes."""
    names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_KEY, key) for key in range(model.nkey)]
    return next((names.index(name) for name in _KEYFRAMES if name in names), 0 if names else None)
