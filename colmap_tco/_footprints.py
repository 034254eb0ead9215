"""Measured memory of each network, written by ``python -m benchmarks.memory``; do not edit."""

PROCESS = 500e6
"""Bytes of a process that has imported everything and loaded no network."""

FITS: dict[tuple[str, str, str], tuple[float, float, float]] = {
    ("sweep", "cpu", "forward"): (520e6, 300.0, 3000.0),
    ("sweep", "cpu", "optimised"): (520e6, 300.0, 6000.0),
}
"""(network, device, forward or optimised) → bytes fixed, bytes a pixel and view, bytes a pixel."""
