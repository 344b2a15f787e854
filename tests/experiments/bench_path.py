"""Make the benchmark's modules importable in tests; they are scripts in one folder, not a package."""

import sys
from pathlib import Path

BENCH = Path(__file__).resolve().parents[2] / "experiments" / "bench"

if str(BENCH) not in sys.path:
    sys.path.append(str(BENCH))
