"""Draw the pictures of the examples again: ``python .ci/docs/pictures.py [EXAMPLE ...]``."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

DOCS = Path(__file__).resolve().parents[2] / "docs"
NAMES = sys.argv[1:] or sorted(path.stem for path in (DOCS / "examples").glob("*.py"))

for name in NAMES:
    picture = DOCS / "images" / "examples" / f"{name}.png"
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(DOCS / "examples" / f"{name}.py"), str(picture)]
        subprocess.run(command, check=True, cwd=folder, env={**os.environ, "PYTHONPATH": str(DOCS.parent)})
    image = Image.open(picture).convert("RGB")
    image.thumbnail((900, 900), Image.Resampling.LANCZOS)
    image.quantize(128, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(picture, optimize=True)
