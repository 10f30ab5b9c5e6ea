"""How PyTorch's threads wait for work. For the start of a program: PyTorch reads it once, when it is imported."""

import os


def rest_between_loops() -> None:
    """Let PyTorch's OpenMP threads sleep soon after a loop, unless the environment says how they wait.

    By default GNU's OpenMP spins 300 000 turns, for milliseconds, on a core that a native kernel wants: a training step
    takes a quarter longer on two cores, and ten times as long where another program computes too. 10 000 turns are
    enough to stay awake between two operations of PyTorch (`tools/bench_training.py` measures steps).
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", "10000")
