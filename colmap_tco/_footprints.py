"""Memory of each network, written by ``python -m benchmarks.memory``; do not edit."""

PROCESS = 3.200e08
"""Bytes of a process that has imported everything and loaded no network."""

FITS: dict[tuple[str, str, str], tuple[float, float, float]] = {
    ("pipeline", "cpu", "forward"): (4.606e08, 42.2, 15.8),
    ("pipeline", "cpu", "optimised"): (5.655e08, 168.5, 2933.4),
    ("sweep", "cpu", "forward"): (5.629e08, 580.7, 382.1),
    ("sweep", "cpu", "optimised"): (7.046e08, 306.1, 5658.4),
}
"""Measured: (network, device, forward or optimised) → bytes fixed, bytes a pixel and view, bytes a pixel."""

COUNTS: dict[tuple[str, str, str], tuple[float, float, float]] = {
    ("da3", "bfloat16", "forward"): (3.714e08, 824.4, 253.7),
    ("da3", "bfloat16", "optimised"): (3.846e08, 1674.0, 3745.3),
    ("da3", "float32", "forward"): (5.415e08, 824.4, 253.7),
    ("da3", "float32", "optimised"): (5.554e08, 3016.4, 3654.0),
    ("da3-small", "bfloat16", "forward"): (9.466e07, 412.2, 126.9),
    ("da3-small", "bfloat16", "optimised"): (1.012e08, 855.9, 1905.1),
    ("da3-small", "float32", "forward"): (1.372e08, 412.2, 126.9),
    ("da3-small", "float32", "optimised"): (1.442e08, 1540.8, 1858.5),
    ("mini", "bfloat16", "forward"): (2.286e07, 650.5, 0.0),
    ("mini", "bfloat16", "optimised"): (3.083e07, 2304.9, 1467.0),
    ("mini", "float32", "forward"): (3.352e07, 650.5, 0.0),
    ("mini", "float32", "optimised"): (4.266e07, 3192.6, 1444.1),
    ("pi3", "bfloat16", "forward"): (1.929e09, 283.8, 0.0),
    ("pi3", "bfloat16", "optimised"): (2.029e09, 1.299e04, 2062.6),
    ("pi3", "float32", "forward"): (3.835e09, 356.9, 0.0),
    ("pi3", "float32", "optimised"): (3.949e09, 1.808e04, 3026.4),
    ("vggt", "bfloat16", "forward"): (2.949e09, 509.5, 2697.6),
    ("vggt", "bfloat16", "optimised"): (3.082e09, 1.582e04, 3369.1),
    ("vggt", "float32", "forward"): (4.762e09, 509.5, 2697.6),
    ("vggt", "float32", "optimised"): (4.908e09, 2.191e04, 3310.6),
}
"""Counted: (network, type of products, mode) → the same, beside that of pipeline."""
