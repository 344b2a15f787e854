"""Errors, consistency and tuned noise in a world that shares no code with the package's own simulator.

    python experiments/bench/independent_figures.py [--tables errors consistency noise] [--seeds 0 1]
        [--beams 32 16] [--motions vehicle handheld] [--starts rest] [--seconds 25] [--imu-rate 200]
        [--recipes default fast_lio2 lio_sam lidar-only loam] [--systems rko-lio kiss-icp] [--data DIR]
        [--json]

``errors`` compares the trajectories with those of peers (see lio_vs_peers.py). ``consistency`` gives NEES and
NIS per degree of freedom with shipped settings, and the run's verdict (see consistency.py). ``noise`` tunes
without truth from 10 times the true noise. ``lidar-only`` is the recipe default without inertial samples.
"""

import argparse
import contextlib
import io
import json
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

_EXPERIMENTS = Path(__file__).resolve().parents[1]
sys.path += [str(_EXPERIMENTS), str(_EXPERIMENTS.parent)]

_LIDAR_ONLY = "lidar-only"
_WITHOUT_IMU = "config.imu.use=false"
_FACTOR = 10.0
_TUNED = {
    "imu.gyro_noise": "gyro_noise",
    "imu.accel_noise": "accel_noise",
    "lidar.range_sigma": "range_sigma",
}
"""Parameters that have a true value, and its name in the recording."""


def main() -> None:
    """Write the recordings and print the tables."""
    options = _options()
    os.environ["OMP_NUM_THREADS"] = "2"
    report: dict[str, Any] = {table: {} for table in options.tables}
    with nullcontext(options.data) if options.data else tempfile.TemporaryDirectory() as folder:
        paths = list(recordings(options, Path(folder)))
        if "errors" in options.tables:
            report["errors"] = {path.name: errors(path, options) for path in paths}
        from lio_jax.commands.runtime import prepare_jax

        prepare_jax()
        import jax

        jax.config.update("jax_enable_x64", True)
        if "consistency" in options.tables:
            report["consistency"] = consistency(paths, options)
        if "noise" in options.tables:
            report["noise"] = noise(paths)
    if options.json:
        print(json.dumps(report))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    tables = ["errors", "consistency", "noise"]
    parser.add_argument("--tables", nargs="+", choices=tables, default=tables)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--beams", nargs="+", type=int, choices=[16, 32], default=[32, 16])
    parser.add_argument("--motions", nargs="+", choices=["vehicle", "handheld"], default=["vehicle"])
    parser.add_argument("--starts", nargs="+", choices=["rest", "moving"], default=["rest"])
    parser.add_argument("--seconds", type=float, default=25.0)
    parser.add_argument("--imu-rate", type=float, default=200.0, help="Hz")
    recipes = ["default", "fast_lio2", "lio_sam", _LIDAR_ONLY, "loam"]
    parser.add_argument("--recipes", nargs="*", default=recipes)
    parser.add_argument("--systems", nargs="*", default=["rko-lio", "kiss-icp"])
    parser.add_argument("--data", type=Path, help="keep the recordings here and reuse those there are")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    return parser.parse_args()


def recordings(options: argparse.Namespace, folder: Path) -> Iterator[Path]:
    """Yield the native folders; those that do not exist yet are simulated."""
    from independent.recording import Recording
    from independent.sensors import Imu, Lidar

    for motion in options.motions:
        for start in options.starts:
            for seed in options.seeds:
                for beams in options.beams:
                    rate = options.imu_rate
                    path = folder / f"{motion}_{start}_{beams}_{rate:g}Hz_{options.seconds:g}s_seed{seed}"
                    if not path.is_dir():
                        made = Recording(seed, options.seconds, motion, start, Lidar(beams), Imu(rate))
                        made.write(path)
                    yield path


def errors(path: Path, options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Run all systems over one recording and print their times and errors."""
    from isolated import run
    from lio_makers import our_maker, our_name, peer_maker
    from lio_vs_peers import print_table, summary_of

    makers = {}
    for name in options.recipes:
        recipe, overrides = _recipe(name)
        makers[our_name(name)] = our_maker(recipe, tuple(overrides), 2)
    makers |= {name: peer_maker(name, 2) for name in options.systems}
    outcomes = run(path, makers, lambda line: print(line, flush=True))
    systems = {name: summary_of(name, outcome, path) for name, outcome in outcomes.items()}
    print_table(path.name, systems)
    return systems


def consistency(paths: list[Path], options: argparse.Namespace) -> list[dict[str, Any]]:
    """Print NEES, NIS and verdict of each recipe on each recording."""
    from consistency import measured

    from lio_jax.run.verdict import in_words

    rows = []
    heading = ["NEES rot", "NEES pos", "NEES pose", "NEES vel", "NIS mean", "NIS med"]
    heading += ["ATE mm", "end mm", "sigma mm"]
    columns = "".join(f"{name:>10}" for name in heading)
    print(f"\n{'recording':38}{'recipe':>11}{columns}  lost, verdict")
    for path in paths:
        for name in options.recipes:
            one = measured(*_recipe(name), _sequence(path))
            cells = "".join(f"{value:10.3g}" for value in one.figures.values())
            words = f"{one.lost_scans}, {in_words(one.verdict)} {' '.join(one.verdict['reasons'])}"
            print(f"{path.name:38}{name:>11}{cells}  {words}", flush=True)
            rows.append({"recording": path.name, "recipe": name, **one._asdict()})
    return rows


def noise(paths: list[Path]) -> list[dict[str, Any]]:
    """Tune ``default`` on each recording alone and print found over true noise with its 95 % interval."""
    rows = []
    print(f"\n{'recording':38}" + "".join(f"{name:>32}" for name in _TUNED))
    for path in paths:
        true = {name: float(_sequence(path).truth_arrays()[key]) for name, key in _TUNED.items()}
        found = _tuned(path, true)
        cells = []
        for low, middle, high in found.values():
            mark = "" if low <= 1 <= high else " outside"
            cells.append(f"{middle:.3f} [{low:.3f}, {high:.3f}]{mark}")
        print(f"{path.name:38}" + "".join(f"{cell:>32}" for cell in cells), flush=True)
        rows.append({"recording": path.name, **found})
    return rows


def _tuned(path: Path, true: dict[str, float]) -> dict[str, list[float]]:
    """Return the ends and the middle of each parameter's interval over its true value."""
    from lio_jax.commands.tune import TuneOptions, tune

    names = [*_TUNED, "registration.information_scale"]
    options = TuneOptions(
        recipe="default",
        assignments=tuple(f"params.{name}={_FACTOR * value}" for name, value in true.items()),
        params_from=None,
        params=",".join(names),
        objective=None,
        optimiser="auto",
        iterations=40,
        patience=10,
        start=0,
        scans=None,
        segment=None,
        seed=0,
        overwrite=True,
    )
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        with contextlib.redirect_stdout(io.StringIO()):
            tune((path,), (), None, Path(folder), options)
        history = json.loads((Path(folder) / "history.json").read_text())
    return _intervals(history, true)


def _intervals(history: Any, true: dict[str, float]) -> dict[str, list[float]]:
    best = min(history["iterates"], key=lambda iterate: iterate["value"])
    found = {}
    for name, x, sigma in zip(history["names"], best["x"], best["sigma"], strict=True):
        name = name.removeprefix("params.")
        if name in true:
            found[name] = [float(np.exp(x + k * sigma) / true[name]) for k in (-1.96, 0.0, 1.96)]
    return found


def _recipe(name: str) -> tuple[str, list[str]]:
    return ("default", [_WITHOUT_IMU]) if name == _LIDAR_ONLY else (name, [])


def _sequence(path: Path) -> Any:
    from lio_jax.data.config import DataConfig
    from lio_jax.data.native import NativeSequence

    return NativeSequence(path, DataConfig())


if __name__ == "__main__":
    main()
