"""Compiled code that is read from disk computes what it did when it was compiled, to the last bit."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = """
import hashlib
import torch
from tco.backbones.weights import load_sweep
from tco.consensus import agreed
from tco.contest import settled
from tco.objective import ObjectiveConfig
from tco.options import ConsensusConfig
from tco.toy import wall
from tco.types import Prediction
from tco.warped import warped_difference

scene = wall(4, (96, 128))
views, priors = scene.views, scene.priors
encoded = load_sweep().encode(views, priors)
prediction = load_sweep().decode(encoded)
depth = prediction.depth.detach()
said = agreed(prediction, prediction.cameras, views, priors, ConsensusConfig())
moved = depth[0].clone().requires_grad_()
config = ObjectiveConfig(exposure=True, structure=0.85)
loss = warped_difference(
    moved, torch.ones_like(moved), views, prediction.cameras, (0, [1, 2]), prediction, config
)
loss.backward()
torn = depth.clone()
torn[1, 20:60, 30:90] *= 1.3
mended, taken = settled(torn, prediction.cameras, views, priors.overlap, ConsensusConfig())
assert taken.sum() > 500
for x in (encoded.volume, depth, said.prediction.depth, said.error, loss, moved.grad, mended):
    print(hashlib.sha256(x.detach().contiguous().numpy().tobytes()).hexdigest())
"""


def test_a_second_process_computes_the_same(tmp_path: Path) -> None:
    """The first compiles into an empty folder, the second reads from it."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", SCRIPT]
    kept = []
    told = []
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
        assert done.returncode == 0, done.stderr
        told.append(done.stdout.split())
        kept.append(len(list(tmp_path.rglob("*.nbi"))))
    assert kept[0] == kept[1] > 0 and len(told[0]) == 7
    assert told[0] == told[1]
