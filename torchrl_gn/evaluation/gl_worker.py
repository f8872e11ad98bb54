"""Render geom poses with MuJoCo's OpenGL renderer, in a process of its own.

Started by :mod:`torchrl_gn.evaluation.gl_frames`, with the GL backend in
``MUJOCO_GL``, as a script and not as a module: it needs mujoco and numpy only.
"""

import sys

import mujoco
import numpy as np


def main(folder: str) -> None:
    """Read ``model.mjb`` and ``job.npz`` in ``folder``, write ``frames.npy``."""
    job = np.load(f"{folder}/job.npz")
    model = mujoco.MjModel.from_binary_path(f"{folder}/model.mjb")
    size = int(job["size"])
    model.vis.global_.offwidth = model.vis.global_.offheight = size
    if model.nlight == 0:  # a bare robot file is nearly black otherwise
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.45, 0.8
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    sky = (model.tex_type == int(mujoco.mjtTexture.mjTEXTURE_SKYBOX)).any()
    camera = mujoco.MjvCamera()
    camera.azimuth, camera.elevation, camera.distance = job["camera"]
    positions, matrices, lookat = job["positions"], job["matrices"], job["lookat"]
    frames = np.zeros((*positions.shape[:2], size, size, 3), np.uint8)
    with mujoco.Renderer(model, size, size) as renderer:
        for sequence in range(len(positions)):
            for step in range(positions.shape[1]):
                if not np.isfinite(positions[sequence, step]).all():
                    continue
                # The renderer draws geoms from these two arrays, wherever the joints are.
                data.geom_xpos[:] = positions[sequence, step]
                data.geom_xmat[:] = matrices[sequence, step].reshape(-1, 9)
                camera.lookat[:] = lookat[step]
                renderer.update_scene(data, camera)
                frame = renderer.render()
                frames[sequence, step] = frame if sky else np.where((frame == 0).all(-1, keepdims=True), 245, frame)
    np.save(f"{folder}/frames.npy", frames)


if __name__ == "__main__":
    main(sys.argv[1])
