"""Measured memory of each network, written by ``python -m benchmarks.memory``; do not edit."""

PROCESS = 3.2e08
"""Bytes of a process that has imported everything and loaded no network."""

FITS: dict[tuple[str, str, str], tuple[float, float, float]] = {
    ("sweep", "cpu", "forward"): (4.838e08, 215.6, 1422.3),
    ("sweep", "cpu", "optimised"): (7.292e08, 274.2, 4132.8),
}
"""(network, device, forward or optimised) → bytes fixed, bytes a pixel and view, bytes a pixel."""
