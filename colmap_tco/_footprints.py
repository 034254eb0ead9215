"""Measured memory of each network, written by ``python -m benchmarks.memory``; do not edit."""

PROCESS = 3.22e08
"""Bytes of a process that has imported everything and loaded no network."""

FITS: dict[tuple[str, str, str], tuple[float, float, float]] = {
    ("sweep", "cpu", "forward"): (5.713e08, 644.4, 0.0),
    ("sweep", "cpu", "optimised"): (7.091e08, 440.8, 5072.7),
}
"""(network, device, forward or optimised) → bytes fixed, bytes a pixel and view, bytes a pixel."""

COUNTS: dict[tuple[str, str, str], tuple[float, float, float]] = {
}
"""Counted, to be added to that of pipeline: (network, type of products, mode) → the same."""
