"""Named bodies of a scene, as a reward reads them."""

from __future__ import annotations

import numpy as np

from torchrl_gn.scenes.scene import Attachment, Scene


def find_body(scene: Scene, name: str) -> Attachment:
    """Node that carries a named body, and the body's fixed offset from the node's frame.

    Args:
        scene: where to look.
        name: a node's own name, or the name of a body welded into a node.

    Returns:
        The node and the offset, the identity for a node's own name.

    Raises:
        ValueError: the scene has no body of this name.
    """
    if name in scene.node_names:
        return Attachment(scene.node_names.index(name), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    if name in scene.attachments:
        return scene.attachments[name]
    known = ", ".join([*scene.node_names, *scene.attachments])
    raise ValueError(f"scene {scene.name!r} has no body {name!r}; it has: {known}")
