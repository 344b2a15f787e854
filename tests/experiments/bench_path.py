"""Lets the tests import the benchmark's modules, which are scripts beside each other and no package."""

import sys
from pathlib import Path

BENCH = Path(__file__).resolve().parents[2] / "experiments" / "bench"

if str(BENCH) not in sys.path:
    sys.path.append(str(BENCH))
