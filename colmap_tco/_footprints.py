"""Memory of each network, written by ``python -m benchmarks.memory``; do not edit."""

PROCESS = 3.2e+08
"""Bytes of a process that has imported everything and loaded no network."""

FITS: dict[tuple[str, str, str], tuple[float, float, float]] = {
    ("pipeline", "cpu", "forward"): (4.606e+08, 42.2, 15.8),
    ("pipeline", "cpu", "optimised"): (5.655e+08, 168.5, 2933.4),
    ("sweep", "cpu", "forward"): (5.64e+08, 584.0, 360.6),
    ("sweep", "cpu", "optimised"): (7.046e+08, 306.1, 5658.4),
}
"""Measured: (network, device, forward or optimised) → bytes fixed, bytes a pixel and view, bytes a pixel."""

COUNTS: dict[tuple[str, str, str], tuple[float, float, float]] = {
    ("da3", "bfloat16", "forward"): (3.714e+08, 824.4, 253.7),
    ("da3", "bfloat16", "optimised"): (3.824e+08, 1395.0, 3121.0),
    ("da3", "float32", "forward"): (5.415e+08, 824.4, 253.7),
    ("da3", "float32", "optimised"): (5.531e+08, 2513.7, 3045.0),
    ("da3-small", "bfloat16", "forward"): (9.466e+07, 412.2, 126.9),
    ("da3-small", "bfloat16", "optimised"): (1.001e+08, 713.3, 1587.6),
    ("da3-small", "float32", "forward"): (1.372e+08, 412.2, 126.9),
    ("da3-small", "float32", "optimised"): (1.43e+08, 1284.0, 1548.8),
    ("pi3", "bfloat16", "forward"): (1.929e+09, 283.8, 0.0),
    ("pi3", "bfloat16", "optimised"): (2.012e+09, 1.083e+04, 1718.8),
    ("pi3", "float32", "forward"): (3.835e+09, 356.9, 0.0),
    ("pi3", "float32", "optimised"): (3.93e+09, 1.507e+04, 2522.0),
    ("vggt", "bfloat16", "forward"): (2.949e+09, 509.5, 2697.6),
    ("vggt", "bfloat16", "optimised"): (3.06e+09, 1.318e+04, 2807.6),
    ("vggt", "float32", "forward"): (4.762e+09, 509.5, 2697.6),
    ("vggt", "float32", "optimised"): (4.884e+09, 1.826e+04, 2758.8),
}
"""Counted: (network, type of products, mode) → the same, beside that of pipeline."""
