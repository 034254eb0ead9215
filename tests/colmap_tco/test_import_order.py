"""The order in which pycolmap and the other users of zlib are imported (see ``_pycolmap.load``)."""

from __future__ import annotations

import subprocess
import sys

WRITE = """
import sys, tempfile, pathlib
{first}
import gzip, cv2, numpy as np
from PIL import Image
folder = pathlib.Path(tempfile.mkdtemp())
noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
Image.fromarray(noise).save(folder / "a.png")
assert cv2.imwrite(str(folder / "b.png"), noise)
np.savez_compressed(folder / "c.npz", noise)
assert gzip.decompress(gzip.compress(noise.tobytes())) == noise.tobytes()
assert (np.asarray(Image.open(folder / "a.png")) == noise).all()
"""


def run(code: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_compression_works_after_pycolmap_is_loaded() -> None:
    done = run(WRITE.format(first="from colmap_tco import _pycolmap; _pycolmap.load()"))
    assert done.returncode == 0, done.stderr[-2000:]


def test_settings_are_imported_without_pycolmap_torch_or_opencv() -> None:
    """The command line imports these modules for their settings, and must answer --help at once."""
    modules = ("workspace", "mapping", "views", "priors", "chunks", "tracks")
    code = "import sys; " + "; ".join(f"import colmap_tco.{name}" for name in modules)
    heavy = ("pycolmap", "torch", "cv2", "PIL", "scipy", "numba", "open3d")
    done = run(code + f"; print([m for m in {heavy} if m in sys.modules])")
    assert done.stdout.strip() == "[]", done.stdout + done.stderr
